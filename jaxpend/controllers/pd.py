"""Proportional-derivative control of the driven joint: the simplest reference."""

from typing import ClassVar

import jax
import jax.numpy as jnp

from ..controller import Memoryless
from ..designs import active_joint
from ..fields import NotNegative
from ..plant import Plant, deviation
from ..pytree import check_constant, pytree
from .search_space import FACTOR

__all__ = ["PD", "pd"]


@pytree
class PD(Memoryless):
    """``-kp (theta - target) - kd omega`` on every joint whose gains are not zero."""

    SEARCHED: ClassVar = {"proportional": FACTOR, "derivative": FACTOR}
    target: jax.Array  # (2,) rad; compared modulo one turn
    proportional: jax.Array  # (2,) N m/rad
    derivative: jax.Array  # (2,) N m s/rad
    torque_limit: jax.Array  # (2,) N m

    def __call__(self, carry, t, x):
        """Torque (2,), N m."""
        error = deviation(x, jnp.concatenate([self.target, jnp.zeros_like(self.target)]))
        torque = -self.proportional * error[:2] - self.derivative * error[2:]
        return carry, jnp.clip(torque, -self.torque_limit, self.torque_limit)


def pd(plant: Plant, robot: str, *, kp: float = 10.0, kd: float = 1.0) -> PD:
    """PD that drives the actuated joint of ``robot`` to its angle at upright.

    ``kp`` in N m/rad and ``kd`` in N m s/rad. Raises ``JaxpendError`` for an unknown robot, or
    gains that are negative or not finite.
    """
    check_constant(NotNegative, kp, "kp")
    check_constant(NotNegative, kd, "kd")
    limit = plant.torque_limit
    driven = jnp.arange(2) == active_joint(robot)
    upright = jnp.array([jnp.pi, 0.0], limit.dtype)
    return PD(upright, driven * limit.dtype.type(kp), driven * limit.dtype.type(kd), limit)
