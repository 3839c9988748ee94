"""Iterative LQR (or DDP) for one bounded input: ``lax.scan`` backward and forward, pure, vmappable.

The problem solved is

    min_u  outer(sum_k features(k, z_k, u_k)) + final(z_N)
    z_{k+1} = step(z_k, u_k),  |u_k| <= limit

The usual sum of stage costs is ``outer = sum``. A score that is a concave function of several
sums (the v2 leaderboard: tanh of energy, of torque cost, ...) fits too: each iteration replaces
``outer`` by its tangent, which lies above it where it is concave, so a step that lowers the
tangent problem lowers the score's (majorise and minimise); the line search uses ``outer`` itself.

Equations: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", 2014
(the box is solved in closed form, since the input is a scalar), and Tassa, Erez, Todorov,
"Synthesis and stabilization of complex behaviors through online trajectory optimization", 2012
(regularisation schedule).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from ..pytree import Pytree, pytree, static

__all__ = ["STEP_SIZES", "Problem", "Solution", "initial", "iterate", "solve", "warm_start"]

STEP_SIZES = tuple(2.0**-k for k in range(10))
MU_MIN, MU_MAX = 1e-8, 1e10


@pytree
class Problem(Pytree):
    """What is minimised: functions of arrays and of ``params``, any pytree, first argument."""

    step: Callable = static()  # (params, z (n,), u ()) -> z (n,)
    features: Callable = static()  # (params, k (), z, u) -> (m,)
    final: Callable = static()  # (params, z) -> ()
    outer: Callable = static()  # (params, totals (m,)) -> ()


@pytree
class Solution(Pytree):
    """A trajectory, the feedback around it, and the state of the optimisation."""

    z: jax.Array  # (N + 1, n)
    u: jax.Array  # (N,)
    gain: jax.Array  # (N, n): u = u_k + gain_k . (z - z_k)
    cost: jax.Array  # ()
    mu: jax.Array  # () regularisation
    growth: jax.Array  # () factor of the regularisation schedule
    rejected: jax.Array  # () int, iterations since the last one that improved


def _totals(problem, params, z, u):
    features = jax.vmap(problem.features, in_axes=(None, 0, 0, 0))
    return jnp.sum(features(params, jnp.arange(u.shape[0]), z[:-1], u), axis=0)


def _cost(problem, params, z, u):
    """The objective; infinite where the rollout diverged."""
    totals = _totals(problem, params, z, u)
    cost = problem.outer(params, totals) + problem.final(params, z[-1])
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


def _derivatives(problem, params, z, u, second_order):
    """Jacobian of the step and gradient and Hessian of the stage cost, in w = (z, u), for all k.

    With ``second_order`` also the second derivatives of the step (DDP); else None (iLQR).
    """
    weights = jax.grad(problem.outer, argnums=1)(params, _totals(problem, params, z, u))

    def step(w):
        return problem.step(params, w[:-1], w[-1])

    def stage(w, k):
        return weights @ problem.features(params, k, w[:-1], w[-1])

    w = jnp.concatenate([z[:-1], u[:, None]], axis=1)
    k = jnp.arange(u.shape[0])
    f_w = jax.vmap(jax.jacfwd(step))(w)
    f_ww = jax.vmap(jax.jacfwd(jax.jacfwd(step)))(w) if second_order else None
    return f_w, f_ww, jax.vmap(jax.grad(stage))(w, k), jax.vmap(jax.hessian(stage))(w, k)


def _backward(problem, params, z, u, limit, mu, second_order):
    """Feed-forward (N,) and gains (N, n) of the control-limited Riccati recursion, and validity."""
    n = z.shape[1]

    def step(carry, now):
        v_z, v_zz, valid = carry
        f_w, f_ww, l_w, l_ww, u = now
        q_w = l_w + f_w.T @ v_z
        q_ww = l_ww + f_w.T @ v_zz @ f_w
        if f_ww is not None:
            q_ww = q_ww + jnp.tensordot(v_z, f_ww, 1)
        # Regularising the states, not the input, keeps a step near the old trajectory.
        regular = q_ww[n] + mu * (f_w[:, n] @ f_w)
        valid = valid & (regular[n] > 0)
        curvature = jnp.where(regular[n] > 0, regular[n], 1.0)
        wanted = -q_w[n] / curvature
        change = jnp.clip(wanted, -limit - u, limit - u)
        gain = jnp.where(change == wanted, -regular[:n] / curvature, 0.0)
        q_u, q_uu, q_uz = q_w[n], q_ww[n, n], q_ww[n, :n]
        v_z = q_w[:n] + gain * (q_uu * change + q_u) + q_uz * change
        cross = jnp.outer(gain, q_uz)
        v_zz = q_ww[:n, :n] + q_uu * jnp.outer(gain, gain) + cross + cross.T
        return (v_z, 0.5 * (v_zz + v_zz.T), valid), (change, gain)

    final = partial(problem.final, params)
    start = (jax.grad(final)(z[-1]), jax.hessian(final)(z[-1]), jnp.array(True))
    inputs = (*_derivatives(problem, params, z, u, second_order), u)
    (_, _, valid), (change, gain) = jax.lax.scan(step, start, inputs, reverse=True)
    return change, gain, valid


def _forward(problem, params, z, u, change, gain, limit, step_size, z0):
    """States and inputs under ``u + step_size * change + gain (z' - z)``, clipped to the box."""

    def step(z_new, now):
        z, u, change, gain = now
        u_new = jnp.clip(u + step_size * change + gain @ (z_new - z), -limit, limit)
        following = problem.step(params, z_new, u_new)
        return following, (following, u_new)

    z_new, u_new = jax.lax.scan(step, z0, (z[:-1], u, change, gain))[1]
    return jnp.concatenate([z0[None], z_new]), u_new


def initial(problem: Problem, params: Any, z0: jax.Array, u: jax.Array, mu=1.0) -> Solution:
    """The starting point of ``iterate``: the trajectory of inputs ``u`` (N,) from ``z0`` (n,)."""

    def step(z, u):
        following = problem.step(params, z, u)
        return following, following

    z = jnp.concatenate([z0[None], jax.lax.scan(step, z0, u)[1]])
    return _start(problem, params, z, u, jnp.zeros((*u.shape, *z0.shape), z.dtype), mu)


def warm_start(
    problem: Problem, params: Any, z0: jax.Array, plan: Solution, limit: jax.Array, mu=1.0
) -> Solution:
    """``initial`` from an earlier plan, followed from ``z0`` under its own feedback."""
    old = (plan.z, plan.u, jnp.zeros_like(plan.u), plan.gain)
    z, u = _forward(problem, params, *old, limit, 0.0, z0)
    return _start(problem, params, z, u, plan.gain, mu)


def _start(problem, params, z, u, gain, mu):
    cost = _cost(problem, params, z, u)
    one = jnp.ones_like(cost)
    return Solution(z, u, gain, cost, mu * one, one, jnp.array(0))


def iterate(
    problem: Problem,
    params: Any,
    now: Solution,
    limit: jax.Array,
    *,
    second_order: bool = False,
    step_sizes: tuple[float, ...] = STEP_SIZES,
) -> Solution:
    """One iteration: backward pass, all step sizes in one vmapped forward pass, the best is kept.

    Never worse than ``now``: without an improvement only the regularisation grows (and the gains
    are those of the new backward pass, around the old trajectory).
    """
    change, gain, valid = _backward(problem, params, now.z, now.u, limit, now.mu, second_order)

    def attempt(step_size):
        z, u = _forward(problem, params, now.z, now.u, change, gain, limit, step_size, now.z[0])
        return z, u, _cost(problem, params, z, u)

    z, u, cost = jax.vmap(attempt)(jnp.array(step_sizes, now.z.dtype))
    best = jnp.argmin(cost)
    better = valid & (cost[best] < now.cost)
    easier, harder = jnp.minimum(0.6, now.growth * 0.6), jnp.maximum(1.6, now.growth * 1.6)
    growth = jnp.where(better, easier, harder)
    return Solution(
        z=jnp.where(better, z[best], now.z),
        u=jnp.where(better, u[best], now.u),
        gain=jnp.where(valid, gain, now.gain),
        cost=jnp.where(better, cost[best], now.cost),
        mu=jnp.clip(now.mu * growth, MU_MIN, MU_MAX),
        growth=growth,
        rejected=jnp.where(better, 0, now.rejected + 1),
    )


def solve(
    problem: Problem,
    params: Any,
    z0: jax.Array,
    u: jax.Array,
    limit: jax.Array,
    *,
    iterations: int,
    second_order: bool = False,
    mu: float = 1.0,
) -> Solution:
    """``iterations`` of ``iterate`` from inputs ``u`` (N,), one ``lax.scan``; pure.

    Args:
        problem: what is minimised.
        params: first argument of the problem's functions.
        z0: (n,) fixed first state.
        u: (N,) first guess; clipped to the box.
        limit: () largest absolute input.
        iterations: fixed, so that a batch under ``jax.vmap`` is one program.
        second_order: use second derivatives of the step (DDP) or not (iLQR).
        mu: regularisation at the start.
    """

    def body(now, _):
        return iterate(problem, params, now, limit, second_order=second_order), None

    start = initial(problem, params, z0, jnp.clip(u, -limit, limit), mu)
    return jax.lax.scan(body, start, length=iterations)[0]
