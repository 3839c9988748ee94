"""What commands write: JSON, and where it may go."""

import json
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ..errors import JaxpendError
from ..files import to_json, write_atomically

__all__ = [
    "MARKDOWN", "check_apart", "check_file", "check_folder", "check_json", "check_results",
    "drop_unwritable", "emit", "emit_json",
]  # fmt: skip

MARKDOWN = (b"| controller ",)  # how tables begin that commands write


def emit(text: str, target: str | Path | None) -> None:
    """Write text to standard output ("-") or, atomically, to a file; None: nowhere."""
    if str(target) == "-":
        check_file("-")
        _print(text)
    elif target is not None:
        write_atomically(target, text)


def _print(text: str) -> None:
    try:
        sys.stdout.write(text)
    except UnicodeEncodeError:  # a terminal that knows no superscripts
        coding = sys.stdout.encoding
        sys.stdout.write(text.encode(coding, "replace").decode(coding))


def emit_json(value: Any, target: str | Path | None) -> None:
    """``emit`` a value as JSON."""
    emit(to_json(value, indent=2) + "\n", target)


def check_file(path: str | Path | None, begins: tuple[bytes, ...] = ()) -> None:
    """Raise ``JaxpendError`` if a file could not be written; None and "-" are as in ``emit``.

    So too if one is there that does not begin as what is written instead, where ``begins`` says
    that. Commands ask before they compute, so that a mistyped name does not cost minutes.
    """
    if path is None:
        return
    if str(path) == "-":
        if sys.stdout is None:
            raise JaxpendError("standard output is closed; name a file instead of -")
        return
    if Path(path).is_dir():
        raise JaxpendError(f"cannot write {path}: it is a folder")
    target = Path(path) if Path(path).exists() else Path(os.path.realpath(path))
    check_folder(target.parent)
    if begins and Path(path).is_file():
        with Path(path).open("rb") as file:
            start = file.read(max(map(len, begins)))
        if start and not start.startswith(begins):
            raise _other(path)


def _other(path: str | Path) -> JaxpendError:
    text = f"cannot write {path}: it is there and is something else; choose another name"
    return JaxpendError(text)


def check_json(
    path: str | Path | None, key: str, out: Path | None = None, names: Iterable[str] = ()
) -> None:
    """``check_file``, and refuse a file that is not such JSON: objects with a ``key``, or one.

    ``names`` are files in the folder ``out`` that are written too, so that it must be none of them.
    """
    check_file(path)
    if out is not None:
        for name in names:
            check_apart(json=path, out=out / name)
    if path is None or str(path) == "-" or not Path(path).is_file():
        return
    try:
        there = json.loads(Path(path).read_bytes() or "[]")
    except (ValueError, RecursionError):
        raise _other(path) from None
    each = there if isinstance(there, list) else [there]
    if not all(isinstance(one, dict) and key in one for one in each):
        raise _other(path)


def check_folder(path: str | Path | None) -> None:
    """Raise ``JaxpendError`` if no file could be written into a folder, made where it is not."""
    if path is None:
        return
    there = Path(path)
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise JaxpendError(f"cannot write into {path}: {there} is not a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise JaxpendError(f"cannot write into {path}: {there} is not writable")


def check_results(folder: Path | None, names: Iterable[str], *marked: tuple[str, bytes]) -> None:
    """``check_folder``, and refuse files in it that are not of this program; None: no folder.

    Files of those names are of this program where one of the ``marked``, names and what such a
    file holds, is there too. The files are pictures among others, so that it is asked whether
    matplotlib can be used.
    """
    check_folder(folder)
    if folder is None:
        return
    if os.environ.get("MPLBACKEND"):
        try:
            import matplotlib  # noqa: F401
        except ValueError:
            text = f"MPLBACKEND is {os.environ['MPLBACKEND']!r}, which matplotlib does not know"
            raise JaxpendError(f"{text}; leave it unset") from None
    for name, mark in marked:
        if (folder / name).is_file() and mark in (folder / name).read_bytes():
            return
    for name in names:
        if (folder / name).exists():
            text = f"cannot write {folder / name}: it is there and is something else"
            raise JaxpendError(f"{text}; choose another folder")


def check_apart(**files: Any) -> None:
    """Refuse two options that name one file, or both of them standard output."""
    first, second = files
    one, other = (path and str(path) for path in files.values())
    if one == other == "-":
        raise JaxpendError(f"--{first} and --{second} are both standard output; name a file")
    if one and other and os.path.realpath(one) == os.path.realpath(other):
        raise JaxpendError(f"--{first} and --{second} are both {one}; name two files")


def drop_unwritable() -> None:
    """Let what a closed pipe or a full disk does not take go nowhere.

    Python would try again when it shuts down, and print that it failed.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
