"""What the commands turn into one sentence and exit code 2."""

import os
import traceback

__all__ = ["THEIRS", "JaxpendError", "blame", "choose"]

# What a user's own code may raise: anything, and to leave the program is not what it is asked for.
THEIRS = (Exception, SystemExit)

# Where files begin whose lines are not a user's: this package, Python's own modules, frozen ones.
NOT_THEIRS = (*(os.path.join(os.path.dirname(m), "") for m in (__file__, os.__file__)), "<frozen")


class JaxpendError(Exception):
    """Bad input from a person: the message says what is wrong and what would be right."""


def choose(what: str, name: object, known) -> str:
    """Return ``name`` if it is one of ``known``; else raise a ``JaxpendError`` that lists them."""
    if name in known:
        return name  # type: ignore[return-value]
    raise JaxpendError(f"unknown {what} {name!r}; known: {', '.join(map(str, known))}")


def blame(error: BaseException) -> str:
    """What went wrong in a user's own code, in one line, with the file and line of their error."""
    at = ""
    for frame in traceback.extract_tb(error.__traceback__):
        if "site-packages" not in frame.filename and not frame.filename.startswith(NOT_THEIRS):
            at = f" at {frame.filename}:{frame.lineno}"
    said = (str(error).strip() or "no message").splitlines()[0]
    if isinstance(error, SyntaxError):  # there is no frame of code that was never run
        said, at = error.msg, f" at {error.filename}:{error.lineno}" if error.filename else ""
    return f"{type(error).__name__}: {said}{at}"
