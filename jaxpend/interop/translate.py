"""Carries the operations of a traced step over to a ``Program``.

What is small (at most ``SMALL`` entries) is taken apart into scalars, so that the physics of an
observer becomes plain arithmetic; what is larger stays a vector.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import Literal

from ..errors import JaxpendError
from .program import KINDS, Builder, Node

__all__ = ["SMALL", "Array", "Translator"]

SMALL = 16  # entries


@dataclasses.dataclass(frozen=True)
class Array:
    """An array in a traced step: scalars in the form of the array, or one flat vector."""

    shape: tuple[int, ...]
    content: Any  # an object array of nodes, or a node

    @classmethod
    def of_scalars(cls, scalars: Sequence[Node], shape: Sequence[int] = ()) -> "Array":
        """Of nodes, in the order of the entries of an array of that shape."""
        content = np.empty(len(scalars), object)
        content[:] = scalars
        return cls(tuple(shape), content.reshape(shape))

    @property
    def is_scalars(self) -> bool:
        """Whether it is taken apart."""
        return isinstance(self.content, np.ndarray)

    @property
    def kind(self) -> str:
        """Of its entries; of none at all "float"."""
        if not self.is_scalars:
            return self.content.kind
        return self.content.flat[0].kind if self.size else "float"

    @property
    def size(self) -> int:
        """Number of entries."""
        return math.prod(self.shape)

    @property
    def small(self) -> bool:
        """Whether operations on it are written entry by entry."""
        return self.is_scalars and self.size <= SMALL


class Translator:
    """Carries out the operations of a jaxpr on ``Array``s.

    Args:
        build: makes the nodes.
        name: of the controller, for errors.
        rules: by the name of a primitive: (translator, arrays, parameters, shape of the result)
            to the result, or a list of results.
    """

    def __init__(self, build: Builder, name: str, rules: dict[str, Callable]):
        self.build, self.name, self.rules = build, name, rules

    def refuse(self, why: str) -> JaxpendError:
        """The error for what cannot be printed."""
        return JaxpendError(f"{self.name} cannot be exported: {why}")

    def __call__(self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Array]) -> list[Array]:
        """The results of a jaxpr. Raises ``JaxpendError`` for an operation that has no rule."""
        known = dict(zip(jaxpr.constvars, map(self.constant, consts), strict=True))
        known |= dict(zip(jaxpr.invars, args, strict=True))

        def read(var: Any) -> Array:
            return self.constant(var.val) if isinstance(var, Literal) else known[var]

        names = [eqn.primitive.name for eqn in jaxpr.eqns]
        if unknown := [name for name in names if name not in self.rules]:
            raise self.refuse(_why(unknown))
        for eqn in jaxpr.eqns:
            shape = getattr(eqn.outvars[0].aval, "shape", ()) if eqn.outvars else ()
            rule = self.rules[eqn.primitive.name]
            found = rule(self, [read(var) for var in eqn.invars], eqn.params, shape)
            results = found if isinstance(found, list) else [found]
            known |= dict(zip(eqn.outvars, results, strict=True))
        return [read(var) for var in jaxpr.outvars]

    def constant(self, value: Any) -> Array:
        """Numbers."""
        array = np.asarray(value)
        if array.dtype.kind not in KINDS:
            raise self.refuse(f"it holds numbers of the type {array.dtype}")
        if array.size > SMALL:
            return Array(array.shape, self.build.constant(array.ravel()))
        return Array.of_scalars([self.build.constant(v) for v in array.ravel()], array.shape)

    def vector(self, array: Array) -> Node:
        """As one flat vector."""
        if not array.is_scalars:
            return array.content
        scalars = list(array.content.flat)
        if not scalars:
            raise self.refuse("it computes with an array that has no entries")
        different = list(dict.fromkeys(scalars))
        if 2 * len(different) > len(scalars):
            return self.build.pack(scalars)
        place = {node: index for index, node in enumerate(different)}
        index = self.build.constant(np.array([place[node] for node in scalars]))
        return self.build.take(self.build.pack(different), index)

    def scalars(self, array: Array) -> np.ndarray:
        """As an object array of scalars."""
        if array.is_scalars:
            return array.content
        entries = [self.build.item(array.content, i) for i in range(array.size)]
        return Array.of_scalars(entries, array.shape).content

    def made(self, vector: Node, shape: Sequence[int]) -> Array:
        """The array of that shape with the entries of a flat vector, taken apart if it is small."""
        array = Array(tuple(shape), vector)
        return Array(array.shape, self.scalars(array)) if array.size <= SMALL else array

    def each(self, op: Callable[..., Node], *args: Array) -> Array:
        """An operation entry by entry; axes that are missing or of length 1 are repeated."""
        shape = np.broadcast_shapes(*(arg.shape for arg in args))
        if all(arg.small for arg in args):
            parts = np.broadcast_arrays(*(arg.content for arg in args))
            entries = zip(*(part.flat for part in parts), strict=True)
            return Array.of_scalars([op(*nodes) for nodes in entries], shape)
        nodes = []
        for arg in args:
            first = arg.content.flat[0] if arg.is_scalars else None
            same = arg.is_scalars and all(node is first for node in arg.content.flat)
            wide = arg if same else self.move(arg, lambda a: np.broadcast_to(a, shape))
            nodes.append(first if same else self.vector(wide))
        found = op(*nodes)
        if found.size is None:
            return Array(shape, np.broadcast_to(np.array(found, object), shape))
        return Array(shape, found)

    def op(self, name: str, *args: Array) -> Array:
        """An operation of ``program.FOLDS``, entry by entry."""
        return self.each(lambda *nodes: self.build.op(name, *nodes), *args)

    def move(self, array: Array, how: Callable[[np.ndarray], np.ndarray]) -> Array:
        """Entries of an array in another order, number or form."""
        if array.is_scalars:
            moved = how(array.content)
            return Array(moved.shape, moved)
        index = how(np.arange(array.size).reshape(array.shape))
        vector = self.build.take(array.content, self.build.constant(index.ravel()))
        return self.made(vector, index.shape)

    def join(self, arrays: Sequence[Array], how: Callable[[list[np.ndarray]], np.ndarray]) -> Array:
        """Entries of several arrays in one."""
        if all(array.is_scalars for array in arrays):
            joined = how([array.content for array in arrays])
            return Array(joined.shape, joined)
        index, start = [], 0
        for array in arrays:
            index.append(start + np.arange(array.size).reshape(array.shape))
            start += array.size
        joined = how(index)
        vector = self.build.concat(self.vector(array) for array in arrays if array.size)
        vector = self.build.take(vector, self.build.constant(joined.ravel()))
        return self.made(vector, joined.shape)

    def chain(self, name: str, scalars: Sequence[Node]) -> Node:
        """Scalars combined, one after the other, by an operation of two arguments."""
        result = scalars[0]
        for scalar in scalars[1:]:
            result = self.build.op(name, result, scalar)
        return result


def _why(primitives: Sequence[str]) -> str:
    """What a step does that cannot be printed, of which these are the operations without a rule."""
    if any(name.startswith(("random_", "threefry", "rng_")) for name in primitives):
        return "it draws random numbers"
    if any("callback" in name or "debug" in name for name in primitives):
        return "it calls Python"
    if "while" in primitives:
        return "a step of it loops for a number of times that is not fixed"
    return f"it uses the operation {primitives[0]} of jax, which has no counterpart there"
