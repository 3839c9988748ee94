"""Model predictive control by iLQR: a receding horizon, re-optimised from a warm start.

Every ``every`` steps of the prediction the plan is shifted, followed from the measured state
under its own feedback, and improved by a few iterations of ``jaxpend.ilqr``; in between the plan
is played with its gains. The cost, with ``e = x - x_ref``,

    sum dt (e' Q e + r (u - u_ref)^2) + s (u_k - u_{k-1} - change of u_ref)^2 + e_H' P e_H

has as reference either a swing-up (then ``P`` is the tracking problem's own cost-to-go where
the horizon ends, so that a short horizon is enough), or upright itself (then the controller
finds its own way up).
"""

from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..designs import active_joint
from ..errors import JaxpendError
from ..fields import Count, NotNegative, Positive, checked
from ..plant import Plant, deviation, joint_torque
from ..pytree import check_constant, pytree, static
from ..scenario import DT
from ..stepping import Startable
from ..trajopt.ilqr import Problem, Solution, iterate, solve, warm_start
from ..trajopt.reference import Reference
from ..trajopt.swingup import step
from .lqr import DEFAULT_Q, lqr
from .search_space import FACTOR
from .tvlqr import along

__all__ = ["MPC", "free_mpc", "tracking_mpc"]

STEP_SIZES = (1.0, 0.5, 0.2)
# How far from a grid point, in steps of the prediction, rounding may put a time stamp.
GRID = 0.02


def _features(p: "MPC", k, z, u):
    error = z[:4] - p.x_ref[k]
    change = u - z[4] - (p.u_ref[k] - p.u_ref[jnp.maximum(k - 1, 0)])
    cost = p.dt * (error @ (p.q * error) + p.r * (u - p.u_ref[k]) ** 2)
    return (cost + p.smoothness * change**2)[None]


def _final(p: "MPC", z):
    error = z[:4] - p.x_ref[-1]
    return error @ p.cost_to_go[-1] @ error


# Of one horizon; its ``params`` are what ``MPC.window`` gives.
PROBLEM = Problem(step=step, features=_features, final=_final, outer=lambda p, sums: sums[0])


@pytree
class MPC(Startable):
    """iLQR over a receding horizon of H steps. Its memory is the plan."""

    SEARCHED: ClassVar = {"q": FACTOR, "r": FACTOR, "smoothness": FACTOR}
    plant: Plant  # the model it predicts with
    x_ref: jax.Array  # (N + 1, 4) reference; past its end, its last state
    u_ref: jax.Array  # (N,)
    cost_to_go: jax.Array  # (N + 1, 4, 4)
    q: jax.Array  # (4,) 1/(rad^2 s), ..., weights of the deviation
    r: jax.Array  # () 1/(N^2 m^2 s)
    smoothness: jax.Array  # () 1/(N m)^2
    first: Solution  # plan at t = 0
    joint: int = static()
    horizon: int = static(default=100)  # H
    dt: float = static(default=DT)  # s, step of the prediction
    every: int = static(default=5)  # steps between two optimisations
    iterations: int = static(default=2)

    def _torque(self, k: jax.Array) -> jax.Array:
        """Reference torques of steps ``k`` (any shape), zero past the end."""
        last = self.u_ref.shape[0] - 1
        return jnp.where(k > last, 0.0, self.u_ref[jnp.minimum(k, last)])

    def window(self, k: jax.Array) -> "MPC":
        """With the reference cut to the horizon that starts at its step ``k``."""
        ahead = k + np.arange(self.horizon + 1)
        rows = jnp.minimum(ahead, self.x_ref.shape[0] - 1)
        x_ref, u_ref = self.x_ref[rows], self._torque(ahead[:-1])
        return self.replace(x_ref=x_ref, u_ref=u_ref, cost_to_go=self.cost_to_go[rows[-1]][None])

    def reset(self, key: jax.Array) -> tuple[Solution, jax.Array]:
        """The first plan, and no torque applied yet."""
        return self.first, jnp.zeros((), self.x_ref.dtype)

    def _shift(self, plan: Solution, k: jax.Array) -> Solution:
        """The plan from ``every`` steps later; its new end is the reference's torque."""
        n, h = self.every, self.horizon
        z = jnp.concatenate([plan.z[n:], jnp.broadcast_to(plan.z[-1], (n, 5))])
        gain = jnp.concatenate([plan.gain[n:], jnp.zeros((n, 5), plan.gain.dtype)])
        u = jnp.concatenate([plan.u[n:], self._torque(k + np.arange(h - n, h))])
        return plan.replace(z=z, u=u, gain=gain)

    def _recover(self, plan: Solution, k, x, x_ref) -> tuple[Solution, jax.Array]:
        """The plan, and ``x`` with angles on the plan's turn; a plan far from ``x`` is dropped.

        Measured angles may be modulo a turn. The plan says on which turn they are, and where it
        is dropped the reference.
        """
        lost = ~(jnp.max(jnp.abs(deviation(x, plan.z[0, :4])[:2])) < 0.5 * jnp.pi)
        expected = jnp.where(lost, x_ref, plan.z[0, :4])
        anew = plan.replace(
            z=jnp.zeros_like(plan.z),
            u=self._torque(k + np.arange(self.horizon)),
            gain=jnp.zeros_like(plan.gain),
        )
        plan = jax.tree.map(lambda new, old: jnp.where(lost, new, old), anew, plan)
        return plan, expected + deviation(x, expected)

    def _optimise(self, plan: Solution, k, x, last) -> Solution:
        """The plan for the horizon from step ``k``, from the measured state ``x``."""
        window = self.window(k)
        limit = self.plant.torque_limit[self.joint]
        shifted = jax.tree.map(lambda a, b: jnp.where(k == 0, a, b), plan, self._shift(plan, k))
        shifted, x = self._recover(shifted, k, x, window.x_ref[0])
        start = warm_start(PROBLEM, window, jnp.append(x, last), shifted, limit, mu=1e-6)

        def improve(now, _):
            return iterate(PROBLEM, window, now, limit, step_sizes=STEP_SIZES), None

        return jax.lax.scan(improve, start, length=self.iterations)[0]

    def __call__(self, carry: Any, t, x):
        """New plan and torque (2,), N m. The plan is remade when ``t`` falls on its grid."""
        plan, last = carry
        place = t / self.dt
        nearest = jnp.round(place)
        on_grid = jnp.abs(place - nearest) < GRID
        place = jnp.where(on_grid, nearest, place)
        k = jnp.floor(place).astype(int)
        since = k % self.every
        plan = jax.lax.cond(
            on_grid & (since == 0), lambda: self._optimise(plan, k, x, last), lambda: plan
        )
        part = (place - k).astype(last.dtype)
        z = (1 - part) * plan.z[since] + part * plan.z[since + 1]
        u = (1 - part) * plan.u[since] + part * plan.u[since + 1]
        error = jnp.append(deviation(x, z[:4]), jnp.where(on_grid, last - z[4], 0.0))
        limit = self.plant.torque_limit[self.joint]
        # A plan that diverged has no torque, so it gives zero; NaN would spread to the rest of a
        # batch.
        torque = jnp.nan_to_num(u + plan.gain[since] @ error)
        torque = jnp.clip(torque, -limit, limit).astype(last.dtype)
        return (plan, torque), joint_torque(torque, self.joint)


def tracking_mpc(
    plant: Plant,
    reference: Reference,
    *,
    q: tuple[float, ...] = DEFAULT_Q,
    r: float = 10.0,
    smoothness: float = 1.0,
    horizon: int = 100,
    every: int = 5,
    iterations: int = 2,
) -> MPC:
    """MPC that stabilises a swing-up and then the top; ``horizon`` in steps of its ``dt``.

    The other arguments are as in ``tvlqr`` and ``MPC``. Raises ``JaxpendError`` for a horizon,
    ``every`` or ``iterations`` that do not fit, weights that are negative, and as ``lqr``.
    """
    _check(horizon, every, iterations, reference.steps)
    _check_weights(q, r, smoothness)
    gain, cost_to_go, top = along(plant, reference, q=q, r=r)
    dtype = reference.x.dtype
    z = jnp.column_stack([reference.x, jnp.concatenate([jnp.zeros(1, dtype), reference.u])])
    gain = jnp.pad(-gain, ((0, 0), (0, 1)))
    x_ref = jnp.concatenate([reference.x[:-1], reference.goal[None]])
    costs = jnp.concatenate([cost_to_go, top.cost_to_go[None]])
    first = _plan(z[: horizon + 1], reference.u[:horizon], gain[:horizon])
    timing = {"horizon": horizon, "dt": reference.dt, "every": every, "iterations": iterations}
    followed = (x_ref, reference.u, costs)
    return _mpc(plant, reference.robot, followed, (q, r, smoothness), first, **timing)


def free_mpc(
    plant: Plant,
    robot: str,
    *,
    q: tuple[float, ...] = (0.1, 0.1, 0.02, 0.02),
    r: float = 1.0,
    smoothness: float = 1.0,
    horizon: int = 80,
    dt: float = 0.02,
    every: int = 1,
    iterations: int = 3,
    first_iterations: int = 200,
    starts: int = 16,
    key: jax.Array | None = None,
) -> MPC:
    """MPC that finds its own way up: the reference is upright, the final cost that of LQR.

    The plan from hanging is the best of ``starts`` random sinusoids (drawn from ``key``, default
    ``jax.random.key(0)``), each optimised for ``first_iterations``; the other arguments are as in
    ``MPC``. Raises ``JaxpendError`` as ``tracking_mpc``, and for a dt, ``starts`` or
    ``first_iterations`` that is not positive.
    """
    _check(horizon, every, iterations, horizon)
    _check_weights(q, r, smoothness)
    dt, starts = checked(Positive, dt, "dt"), checked(Count, starts, "starts")
    first_iterations = checked(Count, first_iterations, "first_iterations")
    top = lqr(plant, robot, dt=dt)
    dtype = plant.mass.dtype
    zeros = jnp.zeros((horizon + 1, 5), dtype)
    first = _plan(zeros, zeros[1:, 0], zeros[1:])
    timing = {"horizon": horizon, "dt": dt, "every": every, "iterations": iterations}
    upright = (top.goal[None], jnp.zeros(1, dtype), top.cost_to_go[None])
    mpc = _mpc(plant, robot, upright, (q, r, smoothness), first, **timing)
    key = jax.random.key(0) if key is None else key
    return mpc.replace(first=_first_plan(mpc, key, starts, first_iterations))


def _mpc(plant, robot, reference, weights, first, **timing) -> MPC:
    """Of states, torques and costs-to-go to follow, and weights of state, torque and change."""
    x_ref, u_ref, costs = reference
    q, r, smoothness = (jnp.asarray(weight, x_ref.dtype) for weight in weights)
    joint = active_joint(robot)
    return MPC(plant, x_ref, u_ref, costs, q, r, smoothness, first, joint, **timing)


def _plan(z: jax.Array, u: jax.Array, gain: jax.Array) -> Solution:
    zero = jnp.zeros((), z.dtype)
    return Solution(z, u, gain, zero, zero + 1, zero + 1, jnp.array(0))


@partial(jax.jit, static_argnames=("starts", "iterations"))
def _first_plan(mpc: MPC, key: jax.Array, starts: int, iterations: int) -> Solution:
    """The best plan from hanging, of several random sinusoids of up to 2 Hz and 2 N m."""
    rate_key, phase_key, size_key = jax.random.split(key, 3)
    rate = 4 * jnp.pi * jax.random.uniform(rate_key, (starts, 1))
    phase = 2 * jnp.pi * jax.random.uniform(phase_key, (starts, 1))
    size = 2 * jax.random.uniform(size_key, (starts, 1))
    u = size * jnp.sin(rate * mpc.dt * np.arange(mpc.horizon) + phase)
    z0 = jnp.zeros(5, mpc.x_ref.dtype)
    limit = mpc.plant.torque_limit[mpc.joint]
    window = mpc.window(jnp.array(0))
    optimise = partial(solve, PROBLEM, window, z0, limit=limit, iterations=iterations)
    plans = jax.vmap(optimise)(u.astype(z0.dtype))
    return jax.tree.map(lambda v: v[jnp.argmin(plans.cost)], plans)


def _check(horizon: int, every: int, iterations: int, longest: int) -> None:
    for name, value in {"every": every, "horizon": horizon, "iterations": iterations}.items():
        checked(int, value, name)
    if not (1 <= every < horizon <= longest and iterations >= 1):
        raise JaxpendError(
            f"MPC needs 1 <= every < horizon <= {longest} and iterations >= 1; "
            f"got every = {every}, horizon = {horizon}, iterations = {iterations}"
        )


def _check_weights(q: tuple[float, ...], r: float, smoothness: float) -> None:
    """Refuse weights that are no weights."""
    check_constant(tuple[NotNegative, NotNegative, NotNegative, NotNegative], q, "q")
    check_constant(Positive, r, "r")
    check_constant(NotNegative, smoothness, "smoothness")
