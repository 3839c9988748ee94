"""Checkpoints on disk: one file of arrays each, whole or not at all.

A checkpoint is ``NUMBER.npz``: the leaves of a pytree under their key paths, and a JSON object as
the header. It is written under another name and then renamed, so that a write cut short is never
taken for a checkpoint; the checksums of its zip format show what was damaged later.
"""

import contextlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..arrays import read_arrays, write_arrays
from ..errors import JaxpendError
from ..files import remove_temporary
from ..terminal import console

__all__ = ["Checkpoints"]


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class Checkpoints:
    """The newest ``keep`` checkpoints in a folder, which is made when the first is written.

    Nothing else in the folder is ever read, changed or removed.
    """

    def __init__(self, folder: str | Path, keep: int = 2):
        self.folder, self.keep = Path(folder).absolute(), keep

    def _numbered(self) -> list[Path]:
        """Files of checkpoints, whole or damaged, the newest first."""
        return sorted(self.folder.glob("[0-9]" * 6 + ".npz"), reverse=True)

    def save(self, tree: Any, about: dict[str, Any]) -> None:
        """Write the arrays of a pytree and a JSON object; then drop what is too old.

        Raises:
            JaxpendError: it cannot be written; the older checkpoints stay.
        """
        arrays = {
            jax.tree_util.keystr(path): np.asarray(jax.random.key_data(x) if _is_key(x) else x)
            for path, x in jax.tree_util.tree_leaves_with_path(tree)
        }
        there = self._numbered()
        path = self.folder / f"{int(there[0].stem) + 1 if there else 1:06d}.npz"
        try:
            write_arrays(path, about, arrays, compressed=False)
        except OSError as error:
            text = f"cannot write a checkpoint to {self.folder}: {error.strerror or error}"
            raise JaxpendError(text) from error
        for old in there[self.keep - 1 :]:
            old.unlink()
        remove_temporary(self.folder)

    def newest(self, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """The newest good checkpoint as a pytree of ``like(about)``'s structure, and its object.

        ``like`` is given the JSON object. Warns of every checkpoint that it has to pass over.
        None: there is none.

        Raises:
            JaxpendError: there were some, and all are damaged.
        """
        numbered = self._numbered()
        for path in numbered:
            try:
                about, arrays = read_arrays(path, "checkpoint")
                return _rebuild(arrays, like(about)), about
            except (JaxpendError, ValueError, KeyError, TypeError):
                text = f"checkpoint {path} is damaged; using the one before it"
                console.print(text, soft_wrap=True)
        if numbered:
            raise JaxpendError(
                f"no checkpoint in {self.folder} is whole; choose another name or remove the run"
            )
        return None

    def clear(self) -> None:
        """Remove all of them: the run is finished."""
        for path in self._numbered():
            path.unlink()
        remove_temporary(self.folder)
        with contextlib.suppress(OSError):  # there are other files in it
            self.folder.rmdir()


def _rebuild(arrays: dict[str, np.ndarray], like: Any) -> Any:
    """The pytree of a structure. Raises ``KeyError`` or ``ValueError`` for arrays of another."""

    def filled(path, leaf):
        value = jnp.asarray(arrays.pop(jax.tree_util.keystr(path)))
        return jax.random.wrap_key_data(value) if _is_key(leaf) else value

    tree = jax.tree_util.tree_map_with_path(filled, like)
    if arrays:
        raise ValueError("there are other arrays")
    return tree
