"""What the commands turn into one sentence and exit code 2."""

__all__ = ["JaxpendError", "choose"]


class JaxpendError(Exception):
    """Bad input from a person: the message says what is wrong and what would be right."""


def choose(what: str, name: object, known) -> str:
    """Return ``name`` if it is one of ``known``; else raise a ``JaxpendError`` that lists them."""
    if name in known:
        return name  # type: ignore[return-value]
    raise JaxpendError(f"unknown {what} {name!r}; known: {', '.join(map(str, known))}")
