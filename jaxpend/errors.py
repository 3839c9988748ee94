"""What the commands turn into one sentence and exit code 2."""

import traceback
from pathlib import Path

__all__ = ["JaxpendError", "blame", "choose"]


class JaxpendError(Exception):
    """Bad input from a person: the message says what is wrong and what would be right."""


def choose(what: str, name: object, known) -> str:
    """Return ``name`` if it is one of ``known``; else raise a ``JaxpendError`` that lists them."""
    if name in known:
        return name  # type: ignore[return-value]
    raise JaxpendError(f"unknown {what} {name!r}; known: {', '.join(map(str, known))}")


def blame(error: BaseException) -> str:
    """What went wrong in a user's own code, in one line, with the file and line of their error."""
    own = str(Path(__file__).parent)
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if "site-packages" not in frame.filename and not frame.filename.startswith((own, "<frozen"))
    ]
    said = (str(error).strip() or "no message").splitlines()[0]
    where = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {said}{where}"
