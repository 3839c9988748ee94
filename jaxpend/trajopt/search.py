"""``jaxpend optimise``: the best swing-up of a robot, from many random starts.

1. Coarse (100 Hz): random sinusoids of torque over several horizons, one vmapped iLQR each; the
   final cost and the sharpness of the criteria grow from stage to stage. The horizon decides
   when the swing-up arrives, which is what gradients change least.
2. The distinct optima are held upright by LQR for the rest of a common horizon and optimised
   there, so that they may shift what they like, the arrival included.
3. Fine (500 Hz): the best few are refined on the official time grid, and the official score of
   a closed loop (TVLQR) picks the winner.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from .. import designs
from ..config import Search
from ..controllers.lqr import lqr
from ..controllers.tvlqr import tvlqr
from ..score import official
from . import ilqr, swingup
from .reference import Reference

__all__ = ["Search", "find"]

FINE_DT, COARSE_DT = 0.002, 0.01
# (final weight, m line width, W power width) of each stage.
SHORT_STAGES = ((1.0, 0.2, 0.5), (10.0, 0.1, 0.3), (100.0, 0.1, 0.3))
LONG_STAGES = (
    (30.0, 0.1, 0.3), (100.0, 0.05, 0.1), (300.0, 0.03, 0.05), (300.0, 0.02, 0.02),
    (300.0, 0.01, 0.01),
)  # fmt: skip
FINE_STAGES = ((10.0, 0.02, 0.02), (30.0, 0.01, 0.01), (30.0, 0.005, 0.01), (30.0, 0.003, 0.005))
SHORT_ITERATIONS, LONG_ITERATIONS, FINE_ITERATIONS = 60, 100, 40
# Two optima whose objectives differ by less than this are one.
SAME = 1e-4


def _parameters(plant, robot, goal, dt, weight, line_width, power_width):
    """The problem's parameters; the final cost has the shape of the LQR's cost-to-go."""
    top = lqr(plant, robot, dt=None)
    final = (
        jnp.zeros((5, 5)).at[:4, :4].set(top.cost_to_go / top.cost_to_go[0, 0]).at[4, 4].set(0.1)
    )
    return swingup.SwingUp(
        plant, jnp.append(goal, 0.0), weight * final, line_width, power_width,
        joint=designs.active_joint(robot), dt=dt,
    )  # fmt: skip


def _stages(plant, robot, dt, stages, iterations, goal, u, mu=1.0):
    """All stages in turn on a batch of starts: goal (B, 4), u (B, N)."""
    base = _parameters(plant, robot, goal[0], dt, 1.0, 0.1, 0.1)

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, None))
    def solve(goal, u, stage):
        weight, line_width, power_width = stage
        p = base.replace(
            goal=jnp.append(goal, 0.0),
            final_weight=weight * base.final_weight,
            line_width=line_width,
            power_width=power_width,
        )
        limit = plant.torque_limit[p.joint]
        return ilqr.solve(
            swingup.problem(), p, jnp.zeros(5), u, limit, iterations=iterations, mu=mu
        )

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


@partial(jax.jit, static_argnames=("dt", "steps", "joint"))
@partial(jax.vmap, in_axes=(0, 0, None, None, None, None, None))
def _hold(z, goal, gain, plant, dt, steps, joint):
    """States (M, 5) and torques (M,) of LQR from ``z`` (5,)."""
    p = swingup.SwingUp(plant, None, None, None, None, joint=joint, dt=dt)
    limit = plant.torque_limit[joint]

    def step(z, _):
        u = jnp.clip(-gain @ (z[:4] - goal), -limit, limit)
        following = swingup.step(p, z, u)
        return following, (following, u)

    return jax.lax.scan(step, z, length=steps)[1]


@partial(jax.jit, static_argnames=("ratio", "joint"))
@partial(jax.vmap, in_axes=(0, None, None, None))
def _refine(coarse, plant, ratio, joint):
    """The coarse torques as a ramp on the fine grid (N * ratio,), kept on course by the gains."""
    p = swingup.SwingUp(plant, None, None, None, None, joint=joint, dt=FINE_DT)
    n = coarse.u.shape[0]

    def step(z, k):
        i, part = k // ratio, (k % ratio) / ratio
        between = lambda v, j: (1 - part) * v[i] + part * v[j]  # noqa: E731
        # Torques held over a coarse step are right in its middle.
        u = jnp.interp(k + 0.5, ratio * (jnp.arange(n) + 0.5), coarse.u)
        u = u + coarse.gain[i, :4] @ (z[:4] - between(coarse.z, i + 1)[:4])
        u = jnp.clip(u, -plant.torque_limit[joint], plant.torque_limit[joint])
        return swingup.step(p, z, u), u

    return jax.lax.scan(step, coarse.z[0], jnp.arange(n * ratio))[1]


def _coarse(plant, robot, search: Search, say):
    """Goals, turn-by-turn statistics and solutions of steps 1 and 2."""
    joint = designs.active_joint(robot)
    gain = lqr(plant, robot, dt=COARSE_DT).gain[joint]
    goals, torques, labels = [], [], []
    for number, horizon in enumerate(search.horizons):
        goal, u = _random_starts(search, horizon, number)
        found = _stages(plant, robot, COARSE_DT, SHORT_STAGES, SHORT_ITERATIONS, goal, u)
        rest = round((search.horizon - horizon) / COARSE_DT)
        _, held = _hold(found.z[:, -1], goal, gain, plant, COARSE_DT, rest, joint)
        keep = np.array(_distinct(np.asarray(found.cost)), int)
        say(f"horizon {horizon} s: {len(keep)} distinct optima of {search.starts} starts")
        goals.append(goal[keep])
        torques.append(jnp.concatenate([found.u, held], axis=1)[keep])
        cost = np.asarray(found.cost)
        labels += [(horizon, int(np.sum(np.abs(cost - cost[i]) <= SAME))) for i in keep]
    goal, u = jnp.concatenate(goals), jnp.concatenate(torques)
    return goal, labels, _stages(plant, robot, COARSE_DT, LONG_STAGES, LONG_ITERATIONS, goal, u)


def find(robot: str, config: Search = Search(), *, say=lambda line: None):
    """The optimum trajectories found, best official score first: a list of (Reference, report).

    Needs ``jax.enable_x64``. Raises ``JaxpendError`` for an unknown robot or a torque limit that
    is not positive.
    """
    plant, joint = designs.competition(robot, config.torque_limit), designs.active_joint(robot)
    goal, labels, coarse = _coarse(plant, robot, config, say)
    best = np.array(_distinct(np.asarray(coarse.cost), config.keep, same=3 * SAME), int)
    goal, coarse = goal[best], jax.tree.map(lambda v: v[best], coarse)
    # The regularisation may have grown at an optimum; gains to follow it with are those without.
    coarse = _stages(plant, robot, COARSE_DT, LONG_STAGES[-1:], 1, goal, coarse.u, mu=0.01)
    say("refining: " + ", ".join(f"{1 - c:.4f}" for c in np.asarray(coarse.cost)))
    u = _refine(coarse, plant, round(COARSE_DT / FINE_DT), joint)
    fine = _stages(plant, robot, FINE_DT, FINE_STAGES, FINE_ITERATIONS, goal, u)
    fine = _stages(plant, robot, FINE_DT, FINE_STAGES[-1:], 1, goal, fine.u, mu=1e-8)
    gain = lqr(plant, robot, dt=FINE_DT).gain[joint]
    hold = round(config.hold / FINE_DT)
    z, held = _hold(fine.z[:, -1], goal, gain, plant, FINE_DT, hold, joint)
    found = []
    for i, label in enumerate(best):
        reference = Reference(
            x=jnp.concatenate([fine.z[i, :, :4], z[i, :, :4]]),
            u=jnp.concatenate([fine.u[i], held[i]]),
            gain=jnp.concatenate([fine.gain[i], jnp.tile(jnp.append(-gain, 0.0), (hold, 1))]),
            robot=robot,
            dt=FINE_DT,
        )
        measured = official(tvlqr(plant, reference), robot)
        horizon, hits = labels[label]
        turns = round(float(goal[i, 1]) / (2 * np.pi))
        report = {"score": measured["score"], "turns_of_theta2": turns, "first_horizon": horizon,
                  "starts_that_led_there": hits, "criteria": measured["criteria"]}  # fmt: skip
        found.append((reference, report))
    return sorted(found, key=lambda pair: -pair[1]["score"])


if __name__ == "__main__":
    from ..cli.app import main

    main("optimise")
