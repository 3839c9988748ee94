"""The one way this package declares what jax traces: a frozen dataclass that is a pytree.

``flax.struct.dataclass`` does the same job, but importing it loads flax, optax and friends;
physics and judging must load with jax and numpy alone.
"""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


def static(**kwargs: Any) -> Any:
    """A field that jax treats as a compile-time constant (hashable, compared by value)."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static))
def pytree(cls: type[T]) -> type[T]:
    """Make ``cls`` a frozen dataclass, register it as a pytree and give it ``replace``."""
    cls.replace = dataclasses.replace  # type: ignore[attr-defined]
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(cls))
