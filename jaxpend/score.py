"""Judging: the criteria and the score of a controller's run of a task, and the official one.

The definitions are in ``jaxpend.criteria``, whose names can be imported from here.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import devices
from .boards import Board, board
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
)
from .errors import JaxpendError
from .plant import Plant
from .pytree import in_default
from .resets import held
from .rollout import Trajectory, rollout
from .scenario import Scenario
from .task import Task

__all__ = [
    "V1_DEFAULT", "V1_OFFICIAL", "V2_HARDWARE", "V2_OFFICIAL", "Criteria", "ScoreV2", "ScoreV3",
    "combined", "criteria", "imperfect", "nominal", "official", "official_run", "performance",
    "recorded", "score_v1", "score_v2", "score_v3", "trial_run",
]  # fmt: skip

# N m, with which a robot's passive joint may be driven against its friction.
PASSIVE = 0.5
CHUNK = 50  # draws of a board that are judged at a time
# s; a clock that begins further from 0 than this did not start with the run, and is shifted.
LATE = 0.1


def performance(
    controller: Controller, scenario: Scenario | Plant, key: jax.Array, task: Task, **options: Any
) -> Criteria:
    """Criteria of a run on the time grid of a task, on a plant or on a scenario around one.

    ``key`` is that of ``rollout``, ``options`` are its other ones.
    """
    options = _of_task(task) | options
    run = rollout(scenario, controller, key, **options)
    return task.criteria(run, scenario.plant if isinstance(scenario, Scenario) else scenario)


def _of_task(task: Task) -> dict[str, Any]:
    """Options of ``rollout``: the time grid of a task, and room for the delays that it draws."""
    return {"dt": task.dt, "duration": task.duration, "delay_slots": task.delay_slots}


def imperfect(
    controller: Controller, task: Task, key: jax.Array, count: int
) -> tuple[Criteria, jax.Array]:
    """Criteria (count,) of runs in random imperfect scenarios of a task, and which end upright.

    Upright, (count,) bool, is meant as in ``Task.stands``. ``key`` is consumed.
    """
    key_scenarios, key_runs = jax.random.split(key)
    scenarios = jax.vmap(task.sample)(jax.random.split(key_scenarios, count))

    def one(
        controller: Controller, scenario: Scenario, key: jax.Array
    ) -> tuple[Criteria, jax.Array]:
        run = rollout(scenario, controller, key, **_of_task(task))
        return task.criteria(run, scenario.plant), task.stands(run.x, scenario.plant.length)

    every = jax.vmap(one, in_axes=(None, 0, 0))
    return devices.split(every, controller)(scenarios, jax.random.split(key_runs, count))


def combined(
    objective: Objective, score: jax.Array, met: tuple[Criteria, jax.Array], task: Task
) -> jax.Array:
    """What a controller is worth (): the weighted mean of its score () and of random scenarios.

    ``met`` is what ``imperfect`` says of them: criteria, and which end upright, (count,).
    """
    c, stands = met
    outcome = stands if objective.outcome == "success" else task.score(c)
    return (1 - objective.weight) * score + objective.weight * outcome.mean()


@partial(jax.jit, static_argnames="task")
def nominal(controller: Controller, task: Task) -> Criteria:
    """``performance`` in what the score is of, compiled once a kind of controller.

    That is the nominal plant; of a task in which chance plays (``Task.chance``) it is
    ``task.repeats`` trials (trials,), always the same.
    """
    key = jax.random.key(0)
    if task.repeats == 1:
        return performance(controller, task.trial(key), key, task)
    keys = jax.random.split(key, task.repeats)
    return jax.vmap(lambda key: performance(controller, task.trial(key), key, task))(keys)


@partial(jax.jit, static_argnames="task")
def trial_run(
    controller: Controller, scenario: Scenario | None, task: Task, seed: int | jax.Array = 0
) -> tuple[Trajectory, Criteria, jax.Array]:
    """A run on the time grid of a task, its criteria, and how hard it drove the passive joint.

    The last is the largest torque (), N m, that the controller wanted there. Without a scenario it
    is on the nominal plant, whose numbers are then constants of the program. ``seed`` () is that
    of the noise.
    """
    key, scenario = jax.random.key(seed), scenario or Scenario(task.plant)
    run = rollout(scenario, controller, key, **_of_task(task))
    passive = jnp.abs(run.u_command[:, 1 - task.joint])
    if scenario.resets is not None:
        pushed = held(scenario.resets, np.arange(len(passive))).any(axis=-1)
        passive = jnp.where(pushed, 0.0, passive)
    return run, task.criteria(run, scenario.plant), passive.max()


@partial(jax.jit, static_argnames="task")
def _trials(
    controller: Controller, scenarios: Scenario, seeds: jax.Array, task: Task
) -> tuple[Criteria, jax.Array]:
    every = jax.vmap(lambda c, scenario, seed: trial_run(c, scenario, task, seed)[1:], (None, 0, 0))
    return devices.split(every, controller)(scenarios, seeds)


@partial(jax.jit, static_argnames="task")
def _criteria(run: Trajectory, task: Task) -> Criteria:
    return task.criteria(run)


def _ready(controller: Controller, task: Task) -> Controller:
    """The controller in jax's default float type.

    Raises ``JaxpendError`` if it cannot be judged on the task.
    """
    check_form(controller)
    check_robot(controller, task.robot)
    controller = in_default(controller)
    check_controller(controller)
    return controller


def official(controller: Controller, judged_on: Board | str) -> dict[str, Any]:
    """Score, success and criteria of a controller as plain numbers, computed in float64.

    Of a board of several draws, all but the robot are means over them, computed in float32;
    "draws" says how many there are, and of their scores the standard deviation and the interval
    in which the mean is with 95 % confidence (None of one draw). It succeeds if more than half of
    the runs end above the line, as the robustness benchmark counts repetitions.

    Args:
        controller: any controller.
        judged_on: a board, or "acrobot" or "pendubot" for the v2 board of that robot.

    Raises:
        JaxpendError: it is no controller, one of the other robot, or one that drives the passive
            joint where the plant would let it.
    """
    judged_on = board(judged_on)
    if not judged_on.task.chance:
        return official_run(controller, judged_on)[1]
    task, found = judged_on.task, []
    with jax.enable_x64(False):
        ready = _ready(controller, task)
        for seeds in devices.pieces(judged_on.draws, CHUNK):
            scenarios = [judged_on.drawn(seed) for seed in seeds.tolist()]
            batch = jax.tree.map(lambda *leaves: np.stack(leaves), *scenarios)
            c, passive = devices.compute(_trials, ready, batch, seeds, task=task)
            _refuse_passive(float(passive.max()), task)
            found.append(jax.tree.map(np.asarray, c))
    count = judged_on.draws
    c = jax.tree.map(lambda *parts: np.concatenate(parts)[:count].astype(float), *found)
    scores = np.asarray(task.score(c), float)
    mean, spread, interval = float(scores.mean()), None, None
    if count > 1:
        spread = float(scores.std(ddof=1))
        error = 1.96 * spread / count**0.5
        interval = [mean - error, mean + error]
    return _plain(c, scores, task) | {
        "draws": {"count": count, "std": spread, "interval": interval}
    }


def official_run(
    controller: Controller, judged_on: Board | str, seed: int = 0
) -> tuple[Trajectory, dict[str, Any]]:
    """A run that ``official`` judges, in float64, and its score, success and criteria.

    ``seed`` is that of the draw, on a board of several: there it is the same robot and the same
    resets as in ``official``, with noise of its own, since jax draws other numbers in float64.
    Other arguments, and errors, are those of ``official``.
    """
    judged_on = board(judged_on)
    task = judged_on.task
    with jax.enable_x64(True):
        ready = _ready(controller, task)
        run, c, passive = trial_run(ready, judged_on.drawn(seed), task, seed)
        _refuse_passive(float(passive), task)
        return run, _plain(c, task.score(c), task)


def _refuse_passive(torque: float, task: Task) -> None:
    """Refuse a controller that drives the passive joint, where it is not held by the plant."""
    if task.resets and torque > 0:
        raise JaxpendError(
            f"the controller drives joint {2 - task.joint} with up to {torque:.3g} N m; the "
            f"{task.robot} is driven at joint {task.joint + 1} alone"
        )


def recorded(run: Trajectory, judged_on: Board | str, *, regular: bool = True) -> dict[str, Any]:
    """What ``official`` says of a controller, of a trajectory that is there already.

    Args:
        run: of another simulator, or of a robot; with as many states as torques, or one more.
        judged_on: a board, as in ``official``; ``boards.hardware`` for runs of a robot.
        regular: refuse what the board's simulation cannot give: other time stamps than those of
            its grid, torques of the passive joint. False: the run of a robot, whose clock is not
            exact, and whose passive joint may be driven against its friction. Its clock may begin
            anywhere: if that is more than 0.1 s from 0, time counts from the first stamp; a first
            stamp nearer to 0 stays as it is, as the boards take it.

    Raises:
        JaxpendError: it is none of this board's runs: longer, or of another robot, or, where it
            must be regular, on another time grid or with torques beyond the limit; or it holds
            numbers that are not finite, or time stamps that go back.
    """
    task = board(judged_on).task
    try:
        t, x, u = (np.asarray(values, float) for values in (run.t, run.x, run.u))
    except (AttributeError, TypeError, ValueError):
        text = "a Trajectory whose t (N,), x (N, 4) and u (N, 2) are arrays of numbers"
        raise JaxpendError(f"the run cannot be read; it must be {text}") from None
    count = len(t) if t.ndim == 1 else 0
    if count < 3 or u.shape not in ((count, 2), (count - 1, 2)) or x.shape != (count, 4):
        shapes = f"t {t.shape}, x {x.shape}, u {u.shape}"
        raise JaxpendError(f"the run has {shapes}; it must have three or more (N,), (N, 4), (N, 2)")
    if not all(np.isfinite(values).all() for values in (t, x, u)):
        raise JaxpendError("the run holds numbers that are not finite")
    if (np.diff(t) < 0).any():
        raise JaxpendError("the time stamps of the run go back")
    began = float(t[0]) if abs(t[0]) > LATE else 0.0
    if (lasts := float(t[-1]) - began) > 1.01 * task.duration:
        raise JaxpendError(
            f"the run lasts {lasts:.7g} s; a run of this board lasts {task.duration:g}"
        )
    steps = np.diff(t)
    worst = int(np.argmax(abs(steps - task.dt)))
    if regular and (abs(steps[worst] - task.dt) > 1e-5 or abs(t[0]) > 1e-5):
        raise JaxpendError(
            f"the run starts at {t[0]:g} s and has a step of {steps[worst]:.6g} s; a simulated run "
            f"of this board starts at 0 and has steps of {task.dt:g} s (a robot's: --hardware)"
        )
    driven, passive = (float(abs(u[:, joint]).max()) for joint in (task.joint, 1 - task.joint))
    if regular and task.spread is None and driven > 1.01 * task.torque_limit:
        text = f"torques of up to {driven:.3g} N m; this board allows {task.torque_limit:g} N m"
        raise JaxpendError(f"joint {task.joint + 1} has {text} (a robot's: --hardware)")
    if passive > (1e-6 if regular else max(driven, PASSIVE)) and not task.resets:
        raise JaxpendError(
            f"joint {2 - task.joint} has torques of up to {passive:.3g} N m, but the {task.robot} "
            f"is driven at joint {task.joint + 1}; the run is that of another robot"
        )
    with jax.enable_x64(True):
        # As arrays: of lists, jax would take every number for an argument of its own.
        arrays = Trajectory(t - began, x, u, x, u)  # type: ignore[arg-type]
        c = _criteria(in_default(arrays), task)
        return _plain(c, task.score(c), task)


def _plain(c: Criteria, scores: Any, task: Task) -> dict[str, Any]:
    """Score, success and criteria of a run, or the means of several, as plain numbers."""
    found = {name: np.asarray(values).mean() for name, values in vars(c).items()}
    success = found.pop("success")
    return {
        "robot": task.robot,
        "score": float(np.asarray(scores).mean()),
        "success": bool(success > 0.5),
        "diverged": bool(np.asarray(c.diverged).any()),
        "criteria": {name: float(value) for name, value in found.items()},
    }


if __name__ == "__main__":
    from .cli.app import main

    main("score")
