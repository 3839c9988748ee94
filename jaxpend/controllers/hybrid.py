"""Two controllers and a region: one swings up, the other holds the top; hysteresis between them."""

from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp

from ..controller import Controller, check_controller
from ..fields import Bounds, Positive
from ..plant import Plant, deviation
from ..pytree import Pytree, check_constant, pytree
from ..stepping import Startable
from .lqr import LQR, lqr
from .search_space import FACTOR

__all__ = ["Ellipsoid", "Hybrid", "Tolerances", "ellipsoid", "ellipsoid_of_torque", "with_lqr"]


@pytree
class Ellipsoid(Pytree):
    """Entered where ``e' P e <= inner``, left where it exceeds ``outer``."""

    SEARCHED: ClassVar = {"inner": FACTOR, "outer": FACTOR}
    matrix: jax.Array  # (4, 4) P
    goal: jax.Array  # (4,)
    inner: jax.Array  # ()
    outer: jax.Array  # ()

    def __call__(self, x: jax.Array, inside: jax.Array) -> jax.Array:
        """Whether state ``x`` (4,) counts as inside, given whether it did before."""
        error = deviation(x, self.goal)
        return error @ self.matrix @ error <= jnp.where(inside, self.outer, self.inner)


@pytree
class Tolerances(Pytree):
    """Entered where ``|e| <= inner`` in every component, left where one exceeds ``outer``."""

    SEARCHED: ClassVar = {"inner": FACTOR, "outer": FACTOR}
    goal: jax.Array  # (4,)
    inner: jax.Array  # (4,) rad, rad, rad/s, rad/s
    outer: jax.Array  # (4,)

    def __call__(self, x: jax.Array, inside: jax.Array) -> jax.Array:
        """Whether state ``x`` (4,) counts as inside, given whether it did before."""
        tolerance = jnp.where(inside, self.outer, self.inner)
        return jnp.all(jnp.abs(deviation(x, self.goal)) <= tolerance)


def ellipsoid(top: LQR, inner: float, *, hysteresis: float = 4.0) -> Ellipsoid:
    """The set of states whose cost-to-go is at most ``inner``; left at ``hysteresis`` times it."""
    level = jnp.asarray(inner, top.cost_to_go.dtype)
    return Ellipsoid(top.cost_to_go, top.goal, level, hysteresis * level)


def ellipsoid_of_torque(top: LQR, fraction: float = 1.0, *, hysteresis: float = 4.0) -> Ellipsoid:
    """The largest cost-to-go ellipsoid in which LQR asks for at most ``fraction`` of the limit.

    ``max K e`` over ``e' P e <= c`` is ``sqrt(c K P^-1 K')``. Inside it the linear closed loop
    does not saturate, so there LQR may be trusted as far as the linearisation holds.
    """
    row = top.gain[jnp.argmax(top.torque_limit)]
    reach = row @ jnp.linalg.solve(top.cost_to_go, row)
    level = (fraction * jnp.max(top.torque_limit)) ** 2 / reach
    return Ellipsoid(top.cost_to_go, top.goal, level, hysteresis * level)


@pytree
class Hybrid(Startable):
    """``swingup`` outside the region, ``top`` inside it. Both keep their own memory."""

    swingup: Any
    top: Any
    region: Any  # (x, inside) -> inside: Ellipsoid, Tolerances or a user's own

    def reset(self, key: jax.Array):
        """Not inside, and the two controllers' memories; ``key`` is split between them."""
        first, second = jax.random.split(key)
        return jnp.array(False), self.swingup.reset(first), self.top.reset(second)

    def __call__(self, carry, t, x):
        """Memory and torque (2,), N m. Both controllers see every measurement."""
        inside, swing_memory, top_memory = carry
        inside = self.region(x, inside)
        swing_memory, swing_torque = self.swingup(swing_memory, t, x)
        top_memory, top_torque = self.top(top_memory, t, x)
        torque = jnp.where(inside, top_torque, swing_torque)
        return (inside, swing_memory, top_memory), torque


def with_lqr(
    swingup: Controller, plant: Plant, robot: str, *, fraction: float = 1.0, hysteresis: float = 4.0
) -> Hybrid:
    """``swingup`` with LQR at the top, switched by the ellipsoid where LQR does not saturate.

    ``fraction`` and ``hysteresis`` are those of ``ellipsoid_of_torque``. Raises ``JaxpendError``
    for a fraction that is not positive or a hysteresis below 1.
    """
    check_constant(Positive, fraction, "fraction")
    check_constant(Annotated[float, Bounds(least=1)], hysteresis, "hysteresis")
    check_controller(swingup)
    top = lqr(plant, robot)
    return Hybrid(swingup, top, ellipsoid_of_torque(top, fraction, hysteresis=hysteresis))
