"""The parameters of a controller that are searched, as one vector.

A class names them in ``SEARCHED``, by key path from itself: ``{"gain": FACTOR}``; those that its
parts name are added. There are three kinds of coordinates ``z``, so that a step of one size suits
parameters of any size:

    WEIGHT     leaf = z                               of order 1 anyway: weights of a network
    FACTOR     leaf = start exp(z)                    z is a fraction; zeros and signs stay
    OVER_TIME  leaf = start exp(z between the knots)  gains along a trajectory, time first
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.tree_util import keystr

from ..errors import JaxpendError

__all__ = ["FACTOR", "KNOTS", "OVER_TIME", "WEIGHT", "Rebuild", "coordinates", "kinds"]

# What ``searched`` may be besides key paths.
WHOLE = ("all", "weights", "hidden")
WEIGHT, FACTOR, OVER_TIME = "weight", "factor", "over time"
# Of ``OVER_TIME``, evenly spaced, because a thousand independent gains are too many to search.
KNOTS = 16


def _declared(part: Any, hidden: bool, prefix: str = "") -> dict[str, str]:
    """Key path -> kind, of what a part and its parts say; ``hidden`` as in ``kinds``."""
    said = dict(getattr(part, "SEARCHED", {}))
    if hidden and (kind := said.pop("layers", None)):
        said |= {f"layers.{i}": kind for i in range(len(part.layers) - 1)}
    found = {prefix + name: kind for name, kind in said.items()}
    for field in dataclasses.fields(part) if dataclasses.is_dataclass(part) else ():
        if not field.metadata.get("static"):
            found |= _declared(getattr(part, field.name), hidden, f"{prefix}{field.name}.")
    return found


def _named_leaves(controller):
    """Key path -> leaf, and the structure."""
    found, structure = jax.tree_util.tree_flatten_with_path(controller)
    return {keystr(path, simple=True, separator="."): leaf for path, leaf in found}, structure


def _is_under(path: str, name: str) -> bool:
    return path == name or path.startswith(name + ".")


def kinds(controller: Any, searched: str = "all") -> dict[str, str]:
    """Key path -> kind of the leaves that ``searched`` names, in the order of the pytree.

    Args:
        controller: any pytree.
        searched: "all" that its classes declare, "weights" for what of that is a ``WEIGHT``,
            "hidden" for all but the output layers of policies, or key paths separated by commas.
            A part, such as ``top`` or ``swingup.layers``, stands for what is declared in it, and
            for all of it where nothing is; what no class declares is a ``FACTOR``.

    Raises:
        JaxpendError: nothing of that name, or nothing declared.
    """
    named, _ = _named_leaves(controller)
    leaves = [p for p, v in named.items() if jnp.issubdtype(jnp.result_type(v), jnp.floating)]
    said = _declared(controller, searched == "hidden")
    declared = {p: kind for p in leaves for name, kind in said.items() if _is_under(p, name)}
    found = declared if searched in WHOLE else {}
    if searched == "weights":
        found = {path: kind for path, kind in declared.items() if kind == WEIGHT}
    for name in () if searched in WHOLE else map(str.strip, searched.split(",")):
        below = [p for p in leaves if _is_under(p, name)]
        if not below:
            known = ", ".join(leaves)
            raise JaxpendError(f"the controller has no parameter {name!r}; known: {known}")
        here = {p: declared[p] for p in below if p in declared}
        found |= here or dict.fromkeys(below, FACTOR)
    if not found:
        text = f"{type(controller).__name__} declares no searched parameters; name some of: "
        raise JaxpendError(text + ", ".join(leaves))
    return {path: found[path] for path in leaves if path in found}


def _between_knots(steps: int) -> np.ndarray:
    """(steps, KNOTS) weights of linear interpolation."""
    place = np.linspace(0, KNOTS - 1, steps)
    return np.maximum(1 - np.abs(place[:, None] - np.arange(KNOTS)), 0)


Rebuild = Callable[[jax.Array], Any]


def coordinates(controller: Any, searched: str = "all") -> tuple[jax.Array, np.ndarray, Rebuild]:
    """The searched parameters as a vector (n,), which of them are weights (n,), and the function
    from a vector to the controller. Works under ``jax.jit``. Arguments and errors as ``kinds``.
    """
    chosen = kinds(controller, searched)
    leaves, structure = _named_leaves(controller)

    def place(leaf, kind):
        if kind == WEIGHT:
            return leaf
        return jnp.zeros_like(leaf, shape=(KNOTS, *leaf.shape[1:]) if kind == OVER_TIME else None)

    def moved(leaf, kind, z):
        if kind == WEIGHT:
            return z
        if kind == OVER_TIME:
            z = jnp.tensordot(jnp.asarray(_between_knots(leaf.shape[0]), z.dtype), z, 1)
        return leaf * jnp.exp(z)

    places = [place(jnp.asarray(leaves[path]), kind) for path, kind in chosen.items()]
    flat, unravel = ravel_pytree(places)
    is_weight = [kind == WEIGHT for kind in chosen.values()]
    weights = np.repeat(is_weight, [np.size(z) for z in places])

    def rebuild(vector):
        new = dict(zip(chosen, unravel(vector), strict=True))
        new = {p: moved(leaves[p], kind, new[p]) for p, kind in chosen.items()}
        return jax.tree.unflatten(structure, [new.get(p, leaf) for p, leaf in leaves.items()])

    return flat, weights, rebuild
