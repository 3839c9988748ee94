"""Judging: the criteria and the score of a controller's run of a task, and the official one.

The definitions are in ``jaxpend.criteria``, whose names can be imported from here.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from .boards import Board, Task, board
from .config import Objective
from .controller import Controller, check_controller, check_form, check_robot
from .criteria import (
    V1_DEFAULT,
    V1_OFFICIAL,
    V2_HARDWARE,
    V2_OFFICIAL,
    Criteria,
    ScoreV2,
    ScoreV3,
    criteria,
    score_v1,
    score_v2,
    score_v3,
    upright,
)
from .plant import Plant
from .rollout import Trajectory, rollout
from .scenario import Scenario
from .variations import LONGEST_DELAY

__all__ = [
    "V1_DEFAULT", "V1_OFFICIAL", "V2_HARDWARE", "V2_OFFICIAL", "Criteria", "ScoreV2", "ScoreV3",
    "combined", "criteria", "imperfect", "nominal", "nominal_run", "official", "performance",
    "score_v1", "score_v2", "score_v3",
]  # fmt: skip


def performance(
    controller: Controller, scenario: Scenario | Plant, key: jax.Array, task: Task, **options: Any
) -> Criteria:
    """Criteria of a run on the time grid of a task, on a plant or on a scenario around one.

    ``key`` is that of ``rollout``, ``options`` are its other ones.
    """
    run = rollout(scenario, controller, key, dt=task.dt, duration=task.duration, **options)
    return task.criteria(run, scenario.plant if isinstance(scenario, Scenario) else scenario)


def imperfect(
    controller: Controller, task: Task, key: jax.Array, count: int
) -> tuple[Criteria, jax.Array]:
    """Criteria (count,) of runs in random imperfect scenarios of a task, and which end upright.

    Upright, (count,) bool, is meant as in the robustness benchmark. ``key`` is consumed.
    """
    key_scenarios, key_runs = jax.random.split(key)
    scenarios = jax.vmap(task.sample)(jax.random.split(key_scenarios, count))

    def one(scenario: Scenario, key: jax.Array) -> tuple[Criteria, jax.Array]:
        options: dict[str, Any] = {"dt": task.dt, "duration": task.duration}
        run = rollout(scenario, controller, key, delay_slots=LONGEST_DELAY + 1, **options)
        return task.criteria(run, scenario.plant), upright(run.x[-1])

    return jax.vmap(one)(scenarios, jax.random.split(key_runs, count))


def combined(
    objective: Objective, score: jax.Array, met: tuple[Criteria, jax.Array], task: Task
) -> jax.Array:
    """What a controller is worth (), of its score () and of ``imperfect`` runs that it met."""
    c, stands = met
    outcome = stands if objective.outcome == "success" else task.score(c)
    return (1 - objective.weight) * score + objective.weight * outcome.mean()


@partial(jax.jit, static_argnames="task")
def nominal(controller: Controller, task: Task) -> Criteria:
    """``performance`` on the nominal plant, compiled once a kind of controller."""
    return performance(controller, task.plant, jax.random.key(0), task)


@partial(jax.jit, static_argnames="task")
def nominal_run(controller: Controller, task: Task) -> tuple[Trajectory, Criteria]:
    """What ``nominal`` judges, and its criteria."""
    key = jax.random.key(0)
    run = rollout(task.plant, controller, key, dt=task.dt, duration=task.duration)
    return run, task.criteria(run)


def _in_float64(leaf: Any) -> Any:
    return jnp.asarray(leaf, "f8") if jnp.issubdtype(jnp.result_type(leaf), jnp.floating) else leaf


def official(controller: Controller, judged_on: Board | str) -> dict[str, Any]:
    """Score, success and criteria of a controller as plain numbers, computed in float64.

    Args:
        controller: any controller.
        judged_on: a board, or "acrobot" or "pendubot" for the v2 board of that robot.

    Raises:
        JaxpendError: it is no controller, or one of the other robot.
    """
    task = board(judged_on).task
    check_form(controller)
    check_robot(controller, task.robot)
    with jax.enable_x64(True):
        controller = jax.tree.map(_in_float64, controller)
        check_controller(controller)
        c = nominal(controller, task)
        names = [name for name in vars(c) if name != "success"]
        return {
            "robot": task.robot,
            "score": float(task.score(c)),
            "success": bool(c.success),
            "diverged": bool(c.diverged),
            "criteria": {name: float(getattr(c, name)) for name in names},
        }


if __name__ == "__main__":
    from .cli.app import main

    main("score")
