"""A swing-up followed with the gains that iLQR computed for it, then LQR.

    u_k = u*_k + K_k ((x, u_{k-1}) - (x*_k, u*_{k-1}))

The gains are those of the optimised cost itself, so they correct only as far as the score gains
by it: the feedback includes the last torque, because a change of torque costs smoothness.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp

from .._struct import pytree
from ..plant import Plant
from .lqr import DEFAULT_Q, DEFAULT_R, LQR, deviation, lqr
from .nominal import Nominal
from .parameters import OVER_TIME

__all__ = ["Riccati", "riccati"]


@pytree
class Riccati:
    """Feed-forward and iLQR gains along a trajectory, then the LQR at its end."""

    SEARCHED: ClassVar = {"nominal.gain": OVER_TIME}
    nominal: Nominal
    top: LQR

    def reset(self, key: jax.Array) -> jax.Array:
        """The last torque of the driven joint: none yet."""
        return jnp.zeros((), self.nominal.u.dtype)

    def __call__(self, carry, t, x):
        """Last torque and torque (2,), N m: the step nearest to ``t``; past the end, the LQR's."""
        nominal = self.nominal
        index = nominal.index(t)
        k = jnp.clip(index, 0, nominal.steps - 1)
        last = carry - nominal.u[jnp.maximum(k - 1, 0)]
        error = jnp.append(deviation(x, nominal.x[k]), last)
        limit = self.top.torque_limit
        following = jnp.clip(nominal.both(nominal.u[k] + nominal.gain[k] @ error), -limit, limit)
        _, holding = self.top(None, t, x)
        torque = jnp.where(index < nominal.steps, following, holding)
        return jnp.sum(torque).astype(carry.dtype), torque


def riccati(
    plant: Plant, nominal: Nominal, *, q: tuple[float, ...] = DEFAULT_Q, r: float = DEFAULT_R
) -> Riccati:
    """The controller along ``nominal``; ``q`` and ``r`` are those of the LQR at its end.

    Raises ``JaxpendError`` as ``lqr``.
    """
    top = lqr(plant, nominal.robot, q=q, r=r, dt=nominal.dt)
    top = jax.tree.map(lambda v: v.astype(nominal.x.dtype), top)
    return Riccati(nominal, top.replace(goal=nominal.goal))
