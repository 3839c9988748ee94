"""A swing-up followed with the gains that iLQR computed for it, then LQR.

    u_k = u*_k + K_k ((x, u_{k-1}) - (x*_k, u*_{k-1}))

The gains are those of the optimised cost itself, so they correct a deviation only where that
improves the score. The feedback includes the last torque, because a change of torque costs
smoothness.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp

from ..plant import Plant, deviation
from ..pytree import pytree
from ..stepping import Startable
from ..trajopt.reference import Reference
from .lqr import DEFAULT_Q, DEFAULT_R, LQR, lqr
from .search_space import OVER_TIME

__all__ = ["Riccati", "riccati"]


@pytree
class Riccati(Startable):
    """Feed-forward and iLQR gains along a trajectory, then the LQR at its end."""

    SEARCHED: ClassVar = {"reference.gain": OVER_TIME}
    reference: Reference
    top: LQR

    def reset(self, key: jax.Array) -> jax.Array:
        """The last torque of the driven joint: none yet."""
        return jnp.zeros((), self.reference.u.dtype)

    def __call__(self, carry, t, x):
        """Last torque and torque (2,), N m: the step nearest to ``t``; past the end, the LQR's."""
        reference, limit = self.reference, self.top.torque_limit
        k, underway = reference.at(t)
        last = carry - reference.u[jnp.maximum(k - 1, 0)]
        error = jnp.append(deviation(x, reference.x[k]), last)
        torque = reference.u[k] + reference.gain[k] @ error
        following = jnp.clip(reference.both(torque), -limit, limit)
        _, holding = self.top(None, t, x)
        torque = jnp.where(underway, following, holding)
        return jnp.sum(torque).astype(carry.dtype), torque


def riccati(
    plant: Plant, reference: Reference, *, q: tuple[float, ...] = DEFAULT_Q, r: float = DEFAULT_R
) -> Riccati:
    """The controller along ``reference``; ``q`` and ``r`` are those of the LQR at its end.

    Raises ``JaxpendError`` as ``lqr``.
    """
    top = lqr(plant, reference.robot, q=q, r=r, dt=reference.dt)
    top = jax.tree.map(lambda v: v.astype(reference.x.dtype), top)
    return Riccati(reference, top.replace(goal=reference.goal))
