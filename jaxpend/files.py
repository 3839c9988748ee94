"""Writing files so that no reader, and no crash, ever sees half of one; strict JSON for them."""

import json
import math
import os
from pathlib import Path
from typing import Any

__all__ = ["to_json", "write_atomically"]


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


def write_atomically(path: str | Path, content: bytes | str) -> None:
    """Replace a file in one step: a reader, or a crash, sees the old content or the new, whole."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
