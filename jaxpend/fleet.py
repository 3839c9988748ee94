"""How often a controller stands on a fleet of real robots, without and with pushes.

Each robot of a fleet is drawn by ``hardware.draw``: all of its parameters, its sensors and its
motor differ from the nominal ones at once. The same robots are tried twice, and in the second try
disturbance pulses push both joints. A robot stands if ``Task.stands`` says so.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import devices
from .controller import Controller, check_controller, check_form, check_robot
from .criteria import Criteria
from .errors import JaxpendError
from .hardware import draw
from .plant import Plant, tip_height
from .rollout import rollout
from .scenario import Scenario
from .sweep import at_least_one
from .task import Task

__all__ = ["CONDITIONS", "Fleet", "judge_fleet", "off", "wilson"]

CHUNK = 100  # robots at a time
BINS = 6  # of each quantity, in which the share of robots that stand is given
WORST = 5  # robots that are written down
CONDITIONS = ("without pushes", "with pushes")
# Fields of a plant, by the names of ``off``.
PARAMETERS = {
    "mass": "mass", "com": "centre", "length": "length", "inertia": "inertia",
    "damping": "damping", "coulomb_friction": "friction",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Fleet:
    """What became of n robots, in each of ``CONDITIONS``."""

    stands: np.ndarray  # (2, n) bool
    score: np.ndarray  # (2, n) of the task
    down: np.ndarray  # (2, n) s below the line after it was first reached; the rest if it never was
    diverged: np.ndarray  # (2, n) bool
    quantities: dict[str, np.ndarray]  # (n,) how each robot is off, see ``off``

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers: what the command writes as JSON."""
        result: dict[str, Any] = {"robots": self.stands.shape[1], "conditions": {}}
        for i, name in enumerate(CONDITIONS):
            good = self.stands[i]
            result["conditions"][name] = {
                "success": float(good.mean()),
                "interval": wilson(int(good.sum()), len(good)),
                "score": float(self.score[i].mean()),
                "down": float(self.down[i][good].mean()) if good.any() else None,
                "diverged": int(self.diverged[i].sum()),
            }
        varied = {name: values for name, values in self.quantities.items() if np.ptp(values)}
        result["by"] = {name: self._along(values) for name, values in varied.items()}
        order = np.lexsort((-self.down.sum(axis=0), self.stands.sum(axis=0)))[:WORST]
        result["worst"] = [
            {name: float(values[robot]) for name, values in self.quantities.items()}
            | {"stands": dict(zip(CONDITIONS, self.stands[:, robot].tolist(), strict=True))}
            for robot in order
        ]
        return result

    def _along(self, values: np.ndarray) -> dict[str, list[float]]:
        """Share of robots that stand in each of ``BINS`` equally full bins of a quantity."""
        bins = np.array_split(np.argsort(values, kind="stable"), min(BINS, len(values)))
        found = {"values": [float(values[rows].mean()) for rows in bins]}
        shares = {
            n: [float(s[rows].mean()) for rows in bins]
            for n, s in zip(CONDITIONS, self.stands, strict=True)
        }
        return found | shares


def wilson(successes: int, trials: int) -> list[float]:
    """Ends of the 95 % interval of a share, by the score of Wilson (1927)."""
    from scipy.stats import binomtest

    return list(binomtest(successes, trials).proportion_ci(0.95, "wilson"))


def off(scenario: Scenario, nominal: Plant, dt: float) -> dict[str, jax.Array]:
    """How a robot differs from the nominal one: factors of parameters (), and the rest in SI.

    Its delays are in steps of ``dt`` s.
    """
    plant, found = scenario.plant, {}
    for field, name in PARAMETERS.items():
        for joint in (0, 1):
            before = getattr(nominal, field)[joint]
            if before:
                found[f"{name} {joint + 1}"] = getattr(plant, field)[joint] / before
    if nominal.motor_inertia:
        found["motor inertia"] = plant.motor_inertia / nominal.motor_inertia
    assert scenario.delay is not None
    assert scenario.responsiveness is not None
    assert scenario.pulses is not None
    assert scenario.delay_jitter is not None
    found |= {"delay": dt * scenario.delay[0], "jitter": dt * scenario.delay_jitter}
    found["responsiveness"] = scenario.responsiveness
    return found | {"push": jnp.abs(scenario.pulses.amplitude).max(initial=0.0)}


@partial(jax.jit, static_argnames="task")
def _tried(controller: Controller, keys: jax.Array, task: Task) -> tuple[Any, ...]:
    """What becomes of the robots of some keys, pushed or not, and how they are off."""
    spread, line = task.spread, task.height
    assert spread is not None

    def one(controller: Controller, key: jax.Array, pushed: jax.Array) -> tuple[Any, ...]:
        key_robot, key_run = jax.random.split(key)
        grid: dict[str, Any] = {"dt": task.dt, "duration": task.duration}
        scenario = draw(spread, task.plant, key_robot, pushed=pushed, **grid)
        run = rollout(scenario, controller, key_run, delay_slots=task.delay_slots, **grid)
        c: Criteria = task.criteria(run, scenario.plant)
        length = scenario.plant.length
        up = tip_height(length, run.x) > line * jnp.sum(length)
        down = task.dt * jnp.sum(~up & (jnp.cumsum(up) > 0))
        down = jnp.where(up.any(), down, task.duration)
        good = task.stands(run.x, length) & ~c.diverged
        return (good, task.score(c), down, c.diverged), off(scenario, task.plant, task.dt)

    def both(controller: Controller, key: jax.Array) -> tuple[Any, ...]:
        found, quantities = jax.vmap(partial(one, controller, key))(jnp.array([False, True]))
        return found, {name: pair[1] for name, pair in quantities.items()}

    return devices.split(jax.vmap(both, in_axes=(None, 0)), controller)(keys)


def judge_fleet(
    controller: Controller,
    task: Task,
    key: jax.Array,
    *,
    robots: int = 1000,
    say: Callable[[int], None] = lambda done: None,
) -> Fleet:
    """Try a controller on a fleet of robots, in jax's default float type.

    Args:
        controller: one for all.
        task: with a ``spread``, which says how they differ.
        key: split once a robot.
        robots: how many.
        say: told how many are done, after each chunk.

    Raises:
        JaxpendError: a task without robots, one robot too few, what is no controller, or one for
            the other robot.
    """
    at_least_one(robots=robots)
    if task.spread is None:
        raise JaxpendError("this task has no robots that differ; take that of the hardware board")
    check_form(controller)
    check_robot(controller, task.robot)
    check_controller(controller)
    keys, parts = jax.random.split(key, robots), []
    for rows in devices.pieces(robots, CHUNK):
        found = devices.compute(_tried, controller, keys[rows], task=task)
        parts.append(jax.tree.map(np.asarray, found))
        say(int(rows[-1]) + 1)
    stands, score, down, diverged = (
        np.concatenate([part[0][i] for part in parts])[:robots].T for i in range(4)
    )
    names = parts[0][1]
    quantities = {n: np.concatenate([part[1][n] for part in parts])[:robots] for n in names}
    return Fleet(stands, score, down, diverged, quantities)
