"""Linear quadratic regulator at the upright equilibrium, and the region where it may act.

    u = -K (x - x*),   A' P + P A - P B R^-1 B' P + Q = 0,   K = R^-1 B' P

with ``A, B`` the linearisation at ``x* = (pi, 0, 0, 0)``. The cost-to-go ``V = e' P e`` gives the
region: the ellipsoid ``V <= level``. Angles are compared modulo one turn.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Memoryless
from ..designs import active_joint
from ..errors import JaxpendError
from ..plant import UPRIGHT, Plant, deviation, linearize
from ..pytree import pytree
from ..scenario import DT
from .search_space import FACTOR

__all__ = ["DEFAULT_Q", "DEFAULT_R", "LQR", "delay_tolerant", "in_float64", "lqr"]

# Bryson's rule: 1 / (largest acceptable value)^2 of rad, rad, rad/s, rad/s.
DEFAULT_Q = (1.0, 1.0, 0.1, 0.1)
DEFAULT_R = 1.0


@pytree
class LQR(Memoryless):
    """State feedback around a fixed point, clipped to the torque limit."""

    SEARCHED: ClassVar = {"gain": FACTOR}

    gain: jax.Array  # (2, 4) N m per state unit; the passive joint's row is zero
    cost_to_go: jax.Array  # (4, 4) P of V = e' P e
    goal: jax.Array  # (4,)
    torque_limit: jax.Array  # (2,) N m

    def value(self, x: jax.Array) -> jax.Array:
        """Cost-to-go ``V`` of a state (4,): scalar, small near the goal."""
        error = deviation(x, self.goal)
        return error @ self.cost_to_go @ error

    def __call__(self, carry, t, x):
        """``-K (x - goal)``, shape (2,), N m."""
        torque = -self.gain @ deviation(x, self.goal)
        return carry, jnp.clip(torque, -self.torque_limit, self.torque_limit)


def in_float64(tree: Any) -> Any:
    """A pytree with its arrays in float64, which has to be enabled."""
    return jax.tree.map(lambda v: jnp.asarray(np.asarray(v), jnp.float64), tree)


_linearize = jax.jit(linearize)


def _upright(plant: Plant, joint: int, dt: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A (4, 4) and B (4, 1) of the linearisation at upright, float64.

    With ``dt`` (s) those of steps of it, with zero-order hold.
    """
    from scipy.linalg import expm

    with jax.enable_x64(True):
        linear = _linearize(in_float64(plant), jnp.array(UPRIGHT), jnp.zeros(2))
        a, b = (np.asarray(matrix) for matrix in linear)
    b = b[:, joint : joint + 1]
    if dt is None:
        return a, b
    held = expm(dt * np.block([[a, b], [np.zeros((1, 5))]]))
    return held[:4, :4], held[:4, 4:]


def lqr(
    plant: Plant,
    robot: str,
    *,
    q: tuple[float, ...] = DEFAULT_Q,
    r: float = DEFAULT_R,
    dt: float | None = DT,
) -> LQR:
    """LQR at upright for the driven joint of ``robot``, solved in float64 on the host (scipy).

    Args:
        plant: one plant, concrete arrays; the result has its dtype.
        robot: "acrobot" or "pendubot".
        q: (4,) diagonal of Q: 1/rad^2, 1/rad^2, s^2/rad^2, s^2/rad^2.
        r: 1/(N m)^2.
        dt: s; the discrete problem with zero-order hold, or with None the continuous one.

    Raises:
        JaxpendError: q, r or dt out of range, or a plant that has no stabilising solution.
    """
    from scipy.linalg import LinAlgError, solve_continuous_are, solve_discrete_are

    joint = active_joint(robot)
    weights = np.asarray(q, float)
    good = weights.shape == (4,) and (weights >= 0).all() and np.isfinite(weights).all()
    if not good or not 0 < r < np.inf or not (dt is None or 0 < dt < np.inf):
        raise JaxpendError(
            f"LQR needs finite q of 4 values >= 0, r > 0 and dt > 0; got {q}, {r}, {dt}"
        )
    dtype = jnp.result_type(plant.mass)
    a, b = _upright(plant, joint, dt)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise JaxpendError(f"no LQR for this plant and dt = {dt}: its linear model is not finite")
    if not b.any():
        text = f"joint {joint + 1} of this plant has no motor, as the {robot} has"
        raise JaxpendError(f"no LQR: {text}")
    try:
        if dt is None:
            p = solve_continuous_are(a, b, np.diag(weights), r * np.eye(1))
            k = b.T @ p / r
        else:
            p = solve_discrete_are(a, b, dt * np.diag(weights), dt * r * np.eye(1))
            k = b.T @ p @ a / (dt * r + b.T @ p @ b)
    except LinAlgError as error:
        raise JaxpendError(f"no LQR for this plant and these weights: {error}") from None
    gain = np.zeros((2, 4))
    gain[joint] = k[0]
    values = (gain, p, UPRIGHT, plant.torque_limit)
    return LQR(*(jnp.asarray(value, dtype) for value in values))


def _growth(a: np.ndarray, b: np.ndarray, gain: np.ndarray, steps: int) -> float:
    """How fast the slowest mode of ``u_k = -gain x_(k - steps)`` grows, 1/step; negative: decays.

    ``a`` (4, 4) and ``b`` (4, 1) are of one step, ``gain`` is (4,). The delayed loop is linear in
    the state and the torques that are on their way.
    """
    loop = a - b * gain
    if steps:
        loop = np.zeros((4 + steps, 4 + steps))
        loop[:4, :4], loop[:4, -1], loop[4, :4] = a, b[:, 0], -gain
        loop[5:, 4:-1] = np.eye(steps - 1)
    return float(np.log(np.abs(np.linalg.eigvals(loop)).max()))


def delay_tolerant(top: LQR, plant: Plant, delay: float, *, dt: float = DT) -> LQR:
    """An LQR with a softer gain, that holds measurements delayed by anything up to ``delay`` (s).

    The gain is the static feedback whose slowest mode decays fastest in the worst of three loops:
    without delay, with half of it and with all (Nelder-Mead from the LQR's gain, float64). The
    cost-to-go stays the LQR's, as a measure of how far away a state is.

    Raises ``JaxpendError`` if delay or dt are out of range, or no such gain was found.
    """
    from scipy.optimize import minimize

    if not (np.isfinite(delay) and delay >= 0 and dt > 0):
        raise JaxpendError(f"delay = {delay} s must not be negative, dt = {dt} s be positive")
    start, steps = np.asarray(top.gain, float), round(delay / dt)
    joint = int(np.abs(start).sum(axis=1).argmax())
    a, b = _upright(plant, joint, dt)

    def worst(z):
        gain = start[joint] * (1 + z)
        return max(_growth(a, b, gain, delayed) for delayed in {0, steps // 2, steps})

    z = np.zeros(4)
    for size in (0.3, 0.3, 0.1, 0.1):  # anew, because its simplex shrinks too early
        simplex = z + size * np.vstack([np.zeros(4), np.eye(4)])
        options = {"initial_simplex": simplex, "maxiter": 400}
        z = minimize(worst, z, method="Nelder-Mead", options=options).x
    if worst(z) >= 0:
        raise JaxpendError(f"no gain was found that tolerates a delay of {delay} s")
    gain = np.zeros((2, 4))
    gain[joint] = start[joint] * (1 + z)
    return top.replace(gain=jnp.asarray(gain, top.gain.dtype))
