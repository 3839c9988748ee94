"""Checkpoints on disk: arrays by orbax, and a manifest that says whether they are whole.

A checkpoint is a numbered folder. Its manifest is written last and has the size and checksum of
every file, so that a write cut short, or a file damaged later, is seen before it is read.
"""

import contextlib
import errno
import json
import logging
import os
import shutil
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import JaxpendError
from ..files import write_atomically
from ..terminal import console

__all__ = ["Checkpoints"]

MANIFEST = "manifest.json"
UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO)


@contextlib.contextmanager
def _orbax() -> Iterator[Any]:
    """A checkpointer that says nothing on the terminal; what goes wrong is an exception."""
    import orbax.checkpoint as ocp  # half a second

    logger, others = logging.getLogger("absl"), sys.unraisablehook
    before, logger.disabled = logger.disabled, True

    def unless_late(unraisable):
        if str(unraisable.exc_value) != "Event loop is closed":
            others(unraisable)

    # Where one write fails, the others' threads come back, at any time, to a loop that is gone.
    sys.unraisablehook = unless_late
    try:
        with ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
            yield checkpointer
        sys.unraisablehook = others
    finally:
        logger.disabled = before


def _is_key(leaf) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _files(folder: Path) -> dict[str, list[int]]:
    """Size and CRC-32 of every file of a checkpoint but the manifest."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path != folder / MANIFEST:
            content = path.read_bytes()
            files[str(path.relative_to(folder))] = [len(content), zlib.crc32(content)]
    return files


def _reason(error: Exception) -> str:
    """What the operating system said, which tensorstore buries in paragraphs."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    said = [os.strerror(code) for code in UNWRITABLE if os.strerror(code) in str(error)]
    return said[0] if said else str(error).splitlines()[0]


class Checkpoints:
    """The newest ``keep`` checkpoints in a folder, which is made when the first is written."""

    def __init__(self, folder: str | Path, keep: int = 2):
        self.folder, self.keep = Path(folder).absolute(), keep

    def _numbered(self) -> list[Path]:
        """Folders of checkpoints, whole or not, the newest first."""
        if not self.folder.is_dir():
            return []
        return sorted((p for p in self.folder.iterdir() if p.name.isdecimal()), reverse=True)

    def save(self, tree: Any, about: dict) -> None:
        """Write the arrays of a pytree and a JSON object; then drop what is too old.

        Raises:
            JaxpendError: it cannot be written; the older checkpoints stay.
        """
        leaves = [jax.random.key_data(x) if _is_key(x) else x for x in jax.tree.leaves(tree)]
        arrays = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        there = self._numbered()
        path = self.folder / f"{int(there[0].name) + 1 if there else 1:06d}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with _orbax() as checkpointer:
                checkpointer.save(path, arrays)
            write_atomically(path / MANIFEST, json.dumps({"about": about, "files": _files(path)}))
        except (OSError, ValueError, RuntimeError) as error:
            self._drop([path])
            text = f"cannot write a checkpoint to {self.folder}: {_reason(error)}"
            raise JaxpendError(text) from error
        finished = [p for p in there if (p / MANIFEST).exists()]
        self._drop([p for p in there if p not in finished[: self.keep - 1]])

    def _drop(self, unwanted: list[Path]) -> None:
        """Remove checkpoints, and what a process that was killed while it wrote one has left."""
        kept = {p.name for p in self._numbered()} - {p.name for p in unwanted}
        if self.folder.is_dir():
            for path in self.folder.iterdir():
                if path.name not in kept:
                    shutil.rmtree(path, ignore_errors=True)

    def newest(self, like: Any) -> tuple[Any, dict] | None:
        """The newest good checkpoint as a pytree of ``like(about)``'s structure, and its object.

        ``like`` is given the JSON object. Warns of every checkpoint that it has to pass over.
        None: there is none, or none was ever finished.

        Raises:
            JaxpendError: there were some, and all are damaged.
        """
        damaged = False
        for path in self._numbered():
            try:
                manifest = json.loads((path / MANIFEST).read_text())
                if manifest["files"] != _files(path):
                    raise ValueError("its files are not those that were written")
                with _orbax() as checkpointer:
                    arrays = checkpointer.restore(path)
                return self._rebuild(arrays, like(manifest["about"])), manifest["about"]
            except (OSError, ValueError, KeyError, TypeError) as error:
                unfinished = isinstance(error, FileNotFoundError)
                damaged |= not unfinished
                what = "was not finished" if unfinished else "is damaged"
                console.print(f"checkpoint {path} {what}; using the one before it", soft_wrap=True)
        if damaged:
            raise JaxpendError(
                f"no checkpoint in {self.folder} is whole; choose another name or remove the run"
            )
        return None

    @staticmethod
    def _rebuild(arrays: dict[str, np.ndarray], like: Any) -> Any:
        leaves, structure = jax.tree.flatten(like)
        if len(leaves) != len(arrays):
            raise ValueError("it has other arrays")
        values = [jnp.asarray(arrays[name]) for name in sorted(arrays)]
        values = [
            jax.random.wrap_key_data(v) if _is_key(leaf) else v
            for v, leaf in zip(values, leaves, strict=True)
        ]
        return jax.tree.unflatten(structure, values)

    def clear(self) -> None:
        """Remove all of them: the run is finished."""
        shutil.rmtree(self.folder, ignore_errors=True)
