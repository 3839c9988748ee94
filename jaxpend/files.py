"""Writing files so that no reader, and no crash, ever sees half of one; strict JSON for them."""

import contextlib
import errno
import json
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

__all__ = ["TEMPORARY", "remove_temporary", "replacing", "to_json", "write_atomically"]

TEMPORARY = re.compile(r"\..+\.jaxpend-tmp-\d+")  # names of files that are not finished


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: Any, indent: int | None = None) -> str:
    """JSON that every reader takes: arrays as numbers and lists, inf and nan as null."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False)


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """A file to write, which takes the place of ``path`` in one step when all went well.

    A reader, or a crash, sees the old content or the new, whole. What a killed process leaves
    has a name that ``TEMPORARY`` matches and nothing else has. A device or a pipe is written to,
    not replaced, and of a symbolic link what it points to is.
    """
    path = Path(path)
    temporary = path
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open("wb") as file:
                yield file
            return
        path = Path(os.path.realpath(path))
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.jaxpend-tmp-{os.getpid()}")
        try:
            with temporary.open("wb") as file:
                yield file
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:  # a full disk names no file, other errors the temporary one
        if error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise


def write_atomically(path: str | Path, content: bytes | str) -> None:
    """Replace a file as ``replacing`` does."""
    with replacing(path) as file:
        if isinstance(content, str):  # a name of a file that is not UTF-8 has surrogates
            content = content.encode(errors="backslashreplace")
        file.write(content)


def remove_temporary(folder: Path) -> None:
    """Remove what processes that were killed in ``replacing`` have left in a folder."""
    for path in folder.iterdir():
        if TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)
