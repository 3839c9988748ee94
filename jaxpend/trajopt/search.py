"""``jaxpend optimise``: the best swing-up of a robot, from many random starts.

1. Coarse (100 Hz): random sinusoids of torque over several horizons, one vmapped iLQR each; the
   final cost and the sharpness of the criteria grow from stage to stage. There are several
   horizons, because the horizon decides when the swing-up arrives, and gradients hardly change it.
2. The distinct optima are held upright by LQR for the rest of a common horizon and optimised
   there, so that the time of arrival may change too.
3. Fine (500 Hz): the best few are refined on the official time grid, and the official score of
   a closed loop (TVLQR) picks the winner.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..boards import Board
from ..config import Search
from ..controllers.lqr import lqr
from ..controllers.tvlqr import tvlqr
from ..errors import JaxpendError
from ..score import official
from ..task import Task
from . import ilqr, swingup
from .reference import Reference

__all__ = ["Search", "find"]

COARSE_DT = 0.01  # s
# (final weight, m line width, W power width) of each stage.
SHORT_STAGES = ((1.0, 0.2, 0.5), (10.0, 0.1, 0.3), (100.0, 0.1, 0.3))
LONG_STAGES = (
    (30.0, 0.1, 0.3), (100.0, 0.05, 0.1), (300.0, 0.03, 0.05), (300.0, 0.02, 0.02),
    (300.0, 0.01, 0.01),
)  # fmt: skip
FINE_STAGES = ((10.0, 0.02, 0.02), (30.0, 0.01, 0.01), (30.0, 0.005, 0.01), (30.0, 0.003, 0.005))
SHORT_ITERATIONS, LONG_ITERATIONS, FINE_ITERATIONS = 60, 100, 40
# Two optima whose objectives differ by less than this are counted as one.
SAME = 1e-4


def _stages(task, dt, stages, iterations, goal, u, mu=1.0):
    """All stages in turn on a batch of starts: goal (B, 4), u (B, N)."""
    top = lqr(task.plant, task.robot, dt=None).cost_to_go  # the shape of the final cost
    final = jnp.zeros((5, 5)).at[:4, :4].set(top / top[0, 0]).at[4, 4].set(0.1)

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, None))
    def solve(goal, u, stage):
        weight, line, power = stage
        goal = jnp.append(goal, 0.0)
        p = swingup.SwingUp(task.plant, goal, weight * final, line, power, task, dt)
        limit = p.plant.torque_limit[p.joint]
        start = (p, jnp.zeros(5), u, limit)
        return ilqr.solve(swingup.problem(), *start, iterations=iterations, mu=mu)

    for stage in stages:
        solution = solve(goal, u, stage)
        u = solution.u
    return solution


def _random_starts(search: Search, horizon: float, number: int):
    """Goals (B, 4), theta2 on three turns, and sums of three sinusoids (B, N) of up to 3 N m."""
    rng = np.random.default_rng([search.seed, number])
    t = np.arange(round(horizon / COARSE_DT)) * COARSE_DT
    shape = (search.starts, 3, 1)
    size = rng.uniform(0.25, 1.5, (search.starts, 1, 1))
    rate, phase = rng.uniform(0.2, 2.0, shape), rng.uniform(0, 2 * np.pi, shape)
    u = np.sum(size * np.sin(2 * np.pi * rate * t + phase), axis=1)
    turns = rng.choice([0, 0, 0, -1, 1], search.starts)
    goal = np.zeros((search.starts, 4))
    goal[:, 0], goal[:, 1] = np.pi, 2 * np.pi * turns
    return jnp.asarray(goal), jnp.asarray(u)


def _distinct(cost: np.ndarray, limit: int | None = None, same: float = SAME) -> list[int]:
    """Indices of different finite costs, best first."""
    kept: list[int] = []
    for i in np.argsort(cost):
        if cost[i] < 1.0 and all(abs(cost[i] - cost[k]) > same for k in kept):
            kept.append(int(i))
    return kept[:limit]


@partial(jax.jit, static_argnames=("dt", "steps", "task"))
@partial(jax.vmap, in_axes=(0, 0, None, None, None, None, None))
def _hold(z, goal, gain, plant, dt, steps, task):
    """States (M, 5) and torques (M,) of LQR from ``z`` (5,)."""
    p = swingup.SwingUp(plant, None, None, None, None, task=task, dt=dt)
    limit = plant.torque_limit[p.joint]

    def step(z, _):
        u = jnp.clip(-gain @ (z[:4] - goal), -limit, limit)
        following = swingup.step(p, z, u)
        return following, (following, u)

    return jax.lax.scan(step, z, length=steps)[1]


@partial(jax.jit, static_argnames=("ratio", "task"))
@partial(jax.vmap, in_axes=(0, None, None, None))
def _refine(coarse, plant, ratio, task):
    """The coarse torques as a ramp on the fine grid (N * ratio,), kept on course by the gains."""
    p = swingup.SwingUp(plant, None, None, None, None, task=task, dt=task.dt)
    limit = plant.torque_limit[p.joint]
    n = coarse.u.shape[0]

    def step(z, k):
        i, part = k // ratio, (k % ratio) / ratio
        # Torques held over a coarse step are right in its middle.
        u = jnp.interp(k + 0.5, ratio * (jnp.arange(n) + 0.5), coarse.u)
        expected = (1 - part) * coarse.z[i] + part * coarse.z[i + 1]
        u = u + coarse.gain[i, :4] @ (z[:4] - expected[:4])
        u = jnp.clip(u, -limit, limit)
        return swingup.step(p, z, u), u

    return jax.lax.scan(step, coarse.z[0], jnp.arange(n * ratio))[1]


def _coarse(task, search: Search, say):
    """Goals, turn-by-turn statistics and solutions of steps 1 and 2."""
    plant = task.plant
    gain = lqr(plant, task.robot, dt=COARSE_DT).gain[task.joint]
    goals, torques, labels = [], [], []
    for number, horizon in enumerate(search.horizons):
        goal, u = _random_starts(search, horizon, number)
        found = _stages(task, COARSE_DT, SHORT_STAGES, SHORT_ITERATIONS, goal, u)
        rest = round((search.horizon - horizon) / COARSE_DT)
        _, held = _hold(found.z[:, -1], goal, gain, plant, COARSE_DT, rest, task)
        keep = np.array(_distinct(np.asarray(found.cost)), int)
        say(f"horizon {horizon} s: {len(keep)} distinct optima of {search.starts} starts")
        goals.append(goal[keep])
        torques.append(jnp.concatenate([found.u, held], axis=1)[keep])
        cost = np.asarray(found.cost)
        labels += [(horizon, int(np.sum(np.abs(cost - cost[i]) <= SAME))) for i in keep]
    goal, u = jnp.concatenate(goals), jnp.concatenate(torques)
    return goal, labels, _stages(task, COARSE_DT, LONG_STAGES, LONG_ITERATIONS, goal, u)


def find(
    task: Task, config: Search = Search(), *, say: Callable[[str], Any] = lambda line: None
) -> list[tuple[Reference, dict[str, Any]]]:
    """The optimum trajectories found, best official score first: a list of (Reference, report).

    The torque limit is ``config.torque_limit``, not the task's. Needs ``jax.enable_x64``. Raises
    ``JaxpendError`` for a torque limit that is not positive, or if no start came to an optimum.
    """
    board = Board("found", task)
    task = dataclasses.replace(task, torque_limit=config.torque_limit)
    plant = task.plant
    goal, labels, coarse = _coarse(task, config, say)
    best = np.array(_distinct(np.asarray(coarse.cost), config.keep, same=3 * SAME), int)
    if not best.size:
        raise JaxpendError("no start came to an optimum; give more starts or torque")
    goal, coarse = goal[best], jax.tree.map(lambda v: v[best], coarse)
    # The regularisation may have grown at an optimum; the gains for following it are computed
    # without regularisation.
    coarse = _stages(task, COARSE_DT, LONG_STAGES[-1:], 1, goal, coarse.u, mu=0.01)
    say("refining: " + ", ".join(f"{1 - c:.4f}" for c in np.asarray(coarse.cost)))
    u = _refine(coarse, plant, round(COARSE_DT / task.dt), task)
    fine = _stages(task, task.dt, FINE_STAGES, FINE_ITERATIONS, goal, u)
    fine = _stages(task, task.dt, FINE_STAGES[-1:], 1, goal, fine.u, mu=1e-8)
    gain = lqr(plant, task.robot, dt=task.dt).gain[task.joint]
    hold = round(config.hold / task.dt)
    z, held = _hold(fine.z[:, -1], goal, gain, plant, task.dt, hold, task)
    found = []
    for i, label in enumerate(best):
        reference = Reference(
            x=jnp.concatenate([fine.z[i, :, :4], z[i, :, :4]]),
            u=jnp.concatenate([fine.u[i], held[i]]),
            gain=jnp.concatenate([fine.gain[i], jnp.tile(jnp.append(-gain, 0.0), (hold, 1))]),
            robot=task.robot,
            dt=task.dt,
        )
        measured = official(tvlqr(plant, reference), board)
        horizon, hits = labels[label]
        turns = round(float(goal[i, 1]) / (2 * np.pi))
        report = {"score": measured["score"], "turns_of_theta2": turns, "first_horizon": horizon,
                  "starts_that_led_there": hits, "criteria": measured["criteria"]}  # fmt: skip
        found.append((reference, report))
    return sorted(found, key=lambda pair: -pair[1]["score"])


if __name__ == "__main__":
    from ..cli.app import main

    main("optimise")
