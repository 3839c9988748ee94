"""The one way this package declares what jax traces: a frozen dataclass that is a pytree.

``flax.struct.dataclass`` does the same job, but importing it loads flax, optax and friends;
physics and judging must load with jax and numpy alone. A controller of your own is

    @pytree
    class Push(Pytree):
        torque: jax.Array  # (2,) N m
        joint: int = static(default=0)

``Pytree`` adds nothing at run time that ``pytree`` does not: it tells type checkers of ``replace``.
"""

import dataclasses
from typing import Any, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

from .fields import checked

__all__ = ["Pytree", "check_constant", "in_default", "pytree", "static"]

T = TypeVar("T")


class Pytree:
    """What every class that ``pytree`` made has."""

    def replace(self, **changes: Any) -> Self:
        """The same with some fields changed. Raises ``TypeError`` for a field there is not."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


def static(**kwargs: Any) -> Any:
    """A field that jax treats as a compile-time constant (hashable, compared by value)."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static))
def pytree(cls: type[T]) -> type[T]:
    """Make ``cls`` a frozen dataclass, register it as a pytree and give it ``replace``."""
    if not hasattr(cls, "replace"):
        cls.replace = Pytree.replace  # type: ignore[attr-defined]
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(cls))


def check_constant(hint: Any, value: Any, name: str) -> None:
    """``fields.checked`` of a number, or of several in a tuple or array; not of what is traced."""
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
        plain = jax.tree.map(lambda v: v.tolist() if hasattr(v, "tolist") else v, value)
        checked(hint, plain, name)


def in_default(tree: T) -> T:
    """A pytree of jax's arrays, floating-point and whole numbers in its default types of them."""

    def converted(leaf: Any) -> Any:
        for kind, default in ((jnp.floating, float), (jnp.signedinteger, int)):
            if jnp.issubdtype(jnp.result_type(leaf), kind):
                return jnp.asarray(leaf, jnp.result_type(default))
        return jnp.asarray(leaf)

    return jax.tree.map(converted, tree)
