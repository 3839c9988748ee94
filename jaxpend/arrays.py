"""Files of plain arrays and a JSON header: .npz without pickle, whole or not at all."""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import JaxpendError
from .files import replacing

__all__ = ["read_arrays", "write_arrays"]


def write_arrays(
    path: str | Path, header: dict[str, Any], arrays: Mapping[str, Any], *, compressed: bool = True
) -> None:
    """Write a file of named arrays and a header that JSON can hold, atomically.

    Raises ``JaxpendError`` for a header that JSON cannot hold.
    """
    try:
        text = json.dumps(header)
    except (TypeError, ValueError) as error:
        raise JaxpendError(f"cannot write {path}: what it should say of itself: {error}") from None
    save = np.savez_compressed if compressed else np.savez
    with replacing(path) as file:
        save(file, header=np.array(text), **arrays)


def read_arrays(path: Path, what: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file; ``what`` it should be is for the messages.

    Raises:
        JaxpendError: no such file, or not one that ``write_arrays`` wrote.
    """
    try:
        if path.is_char_device():  # /dev/zero has no end
            raise OSError
        content = io.BytesIO(path.read_bytes())  # whole: numpy leaves a broken file open
        with zipfile.ZipFile(content) as file:
            if file.testzip() is not None:  # a checksum that numpy may not come to read
                raise zipfile.BadZipFile
        content.seek(0)
        with np.load(content, allow_pickle=False) as file:
            arrays = dict(file)
        header = json.loads(str(arrays.pop("header")))
        if not isinstance(header, dict):
            raise TypeError
    except FileNotFoundError:
        raise JaxpendError(f"there is no {what} file {path}") from None
    except Exception:  # numpy and zipfile raise a dozen kinds for bytes that are not theirs
        raise JaxpendError(f"{path} is not a {what} file, or it is empty or cut off") from None
    return header, arrays
