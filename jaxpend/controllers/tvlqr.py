"""Time-varying LQR along a swing-up: finite horizon, ending in the LQR at the top.

    u_k = u*_k - K_k (x - x*_k),   P_N = P of the infinite horizon,
    K_k = (R + B' P B)^-1 B' P A,   P <- Q + A' P (A - B K)

with ``A, B`` the derivatives of one integration step along the trajectory (Tedrake,
"Underactuated robotics", chapter 8).
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Memoryless
from ..plant import Plant, deviation, rk4_step
from ..pytree import pytree
from ..trajopt.reference import Reference
from .lqr import DEFAULT_Q, DEFAULT_R, LQR, delay_tolerant, in_float64, lqr
from .search_space import OVER_TIME

__all__ = ["TVLQR", "along", "tvlqr"]

ARRIVED = 0.1  # rad and rad/s, of every component around upright


@pytree
class TVLQR(Memoryless):
    """Feed-forward and time-varying gains along a trajectory, then the LQR at its end."""

    SEARCHED: ClassVar = {"gain": OVER_TIME}
    reference: Reference
    gain: jax.Array  # (N, 4) N m per state unit, of the driven joint
    top: LQR

    def __call__(self, carry, t, x):
        """Torque (2,), N m: the step nearest to ``t``; past the last one, the LQR's."""
        reference, limit = self.reference, self.top.torque_limit
        k, underway = reference.at(t)
        torque = reference.u[k] - self.gain[k] @ deviation(x, reference.x[k])
        tracking = jnp.clip(reference.both(torque), -limit, limit)
        _, holding = self.top(None, t, x)
        return carry, jnp.where(underway, tracking, holding)


@jax.jit
def _riccati(plant: Plant, reference: Reference, q: jax.Array, r: float, p_end: jax.Array):
    """Gains (N, 4) and costs-to-go (N, 4, 4) of the finite-horizon problem."""

    def step(x, torque):
        return rk4_step(plant, x, reference.both(torque), reference.dt)

    a, b = jax.vmap(jax.jacfwd(step, argnums=(0, 1)))(reference.x[:-1], reference.u)
    q, r = reference.dt * jnp.diag(q), reference.dt * r

    def backward(p, now):
        a, b = now
        gain = (b @ p @ a) / (r + b @ p @ b)
        p = q + a.T @ p @ (a - jnp.outer(b, gain))
        p = 0.5 * (p + p.T)
        return p, (gain, p)

    return jax.lax.scan(backward, p_end, (a, b), reverse=True)[1]


def along(
    plant: Plant, reference: Reference, *, q: tuple[float, ...] = DEFAULT_Q, r: float = DEFAULT_R
) -> tuple[jax.Array, jax.Array, LQR]:
    """Gains (N, 4), costs-to-go (N, 4, 4) and the LQR at the end, of the tracking problem.

    Solved in float64, returned in the dtype of ``reference``. Arguments and errors as ``tvlqr``.
    """
    dtype = reference.x.dtype
    with jax.enable_x64(True):
        exact = in_float64((plant, reference))
        top = lqr(exact[0], reference.robot, q=q, r=r, dt=reference.dt)
        gain, cost_to_go = _riccati(*exact, jnp.asarray(np.asarray(q, float)), r, top.cost_to_go)
        found = jax.tree.map(np.asarray, (gain, cost_to_go, top.replace(goal=reference.goal)))
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), found)


def tvlqr(
    plant: Plant, reference: Reference, *, q: tuple = DEFAULT_Q, r: float = DEFAULT_R, delay=0.0
) -> TVLQR:
    """TVLQR along ``reference``, solved in float64; the result has the dtype of ``reference``.

    Args:
        plant: one plant, concrete arrays.
        reference: the trajectory.
        q: (4,) diagonal of Q, of the tracking and of the LQR at the end.
        r: 1/(N m)^2.
        delay: s; if not 0, the gain at the end is ``delay_tolerant``, and takes over as soon as
            the trajectory has ``ARRIVED``.

    Raises:
        JaxpendError: as ``lqr`` and ``delay_tolerant``.
    """
    gain, _, top = along(plant, reference, q=q, r=r)
    if delay:
        top = delay_tolerant(top, plant, delay, dt=reference.dt)
        off = np.abs(np.asarray(reference.x - reference.goal)).max(axis=1)
        steps = min(int(np.argmax(off < ARRIVED)) or reference.steps, reference.steps)
        reference = reference.replace(
            x=reference.x[: steps + 1], u=reference.u[:steps], gain=reference.gain[:steps]
        )
        gain = gain[:steps]
    return TVLQR(reference, gain, top)
