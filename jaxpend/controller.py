"""The controller protocol, and the simplest controllers on it."""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from .pytree import pytree, static

__all__ = ["Controller", "Feedback", "OpenLoop", "Zero"]


class Controller(Protocol):
    """Anything that turns measured states into torques. Pure, and itself a pytree."""

    def reset(self, key: jax.Array) -> Any:
        """Memory (any pytree) at the start of a run; ``key`` is consumed."""
        ...

    def __call__(self, carry: Any, t: jax.Array, x: jax.Array) -> tuple[Any, jax.Array]:
        """New memory and torque (2,), N m, from memory, time (s) and measured state (4,)."""
        ...


class Memoryless:
    """A controller whose torque depends on time and state alone."""

    def reset(self, key: jax.Array) -> None:
        """No memory."""
        return None


@pytree
class Zero(Memoryless):
    """No torque."""

    def __call__(self, carry, t, x):
        """Zeros, shape (2,)."""
        return carry, jnp.zeros(2, x.dtype)


@pytree
class Feedback(Memoryless):
    """A law ``law(t, x) -> torque (2,)`` written in jax."""

    law: Callable = static()

    def __call__(self, carry, t, x):
        """The law at time ``t`` and state ``x``."""
        return carry, self.law(t, x)


@pytree
class OpenLoop(Memoryless):
    """Recorded torques, held from one time stamp to the next; the last one is held on."""

    t: jax.Array  # (N,) s, increasing
    u: jax.Array  # (N, 2) N m

    def __call__(self, carry, t, x):
        """The torque of the latest stamp that is not after ``t``."""
        index = jnp.searchsorted(self.t, t, side="right") - 1
        return carry, self.u[jnp.clip(index, 0, self.u.shape[0] - 1)]
