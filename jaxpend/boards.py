"""Boards as values: a task with its official trials, and what is published of it.

What judges takes a ``Board``; what learns takes its ``task.Task`` alone, so that training cannot
touch official keys or grids, and another board is a value.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from . import designs
from .controller import robot_of
from .criteria import V2_HARDWARE, V2_OFFICIAL, ScoreV2, ScoreV3
from .errors import JaxpendError, choose
from .hardware import PRESETS
from .plant import Plant
from .pytree import in_default
from .resets import official_resets
from .robots import ROBOTS
from .scenario import Scenario
from .task import Task
from .variations import RANGES

__all__ = [
    "BOARDS", "CRITERIA", "HARDWARE", "HEADINGS", "V2", "V3", "Board", "Strip", "board",
    "hardware", "named_board", "own_task", "strips", "task_of", "v2", "v3",
]  # fmt: skip


# The six criteria of robustness in the order of the boards, and their headings there.
CRITERIA = {
    "model": "Model",
    "velocity_noise": "Velocity noise",
    "torque_noise": "Torque noise",
    "responsiveness": "Torque step response",
    "delay": "Time delay",
    "perturbation": "Perturbations",
}


@dataclasses.dataclass(frozen=True)
class Strip:
    """One row of grid values of one criterion of robustness."""

    criterion: str
    variation: str  # name in ``VARIATIONS``
    values: np.ndarray  # (n,) SI units
    repetitions: int = 1


def strips(plant: Plant) -> list[Strip]:
    """The grids of the v2 boards around a nominal plant: 15 strips, 722 runs."""
    nominal = {name: np.asarray(value, float) for name, value in vars(plant).items()}
    m, r, inertia = nominal["mass"], nominal["com"], nominal["inertia"]
    grid = {name: np.linspace(*ends, 21) for name, ends in RANGES.items()}
    around = {"m1r1": m[0] * r[0], "I1": inertia[0], "m2r2": m[1] * r[1], "m2": m[1]}
    around |= {"I2": inertia[1]}
    model = ("Ir", "m1r1", "I1", "b1", "cf1", "m2r2", "m2", "I2", "b2", "cf2")
    return [
        *(Strip("model", name, grid[name] * around.get(name, 1.0)) for name in model),
        Strip("velocity_noise", "velocity_noise", grid["velocity_noise"], 10),
        Strip("torque_noise", "torque_noise", grid["torque_noise"], 10),
        Strip("responsiveness", "responsiveness", grid["responsiveness"]),
        Strip("delay", "delay", grid["delay"]),
        Strip("perturbation", "perturbation", np.ones(50)),
    ]


@partial(jax.jit, static_argnames="task")
def _robot(task: Task, seed: int) -> Scenario:
    return task.robot_of(jax.random.key(seed))


@dataclasses.dataclass(frozen=True)
class Board:
    """A task with its official trials and the rows that are published."""

    name: str
    task: Task
    # Of robustness, around the nominal plant; None: the board does not ask for it.
    trials: Callable[[Plant], list[Strip]] | None = strips
    # Title, performance, robustness.
    published: tuple[tuple[str, float, float | None], ...] = ()
    draws: int = 1  # official draws, from 0 on, that a score is the mean of
    columns: tuple[str, ...] = tuple(V2_OFFICIAL)  # criteria that its tables show

    @property
    def robot(self) -> str:
        """ "acrobot" or "pendubot"."""
        return self.task.robot

    def drawn(self, seed: int) -> Scenario | None:
        """The official trial of a seed, in jax's default float type; None: the nominal plant."""
        task, scenario = self.task, Scenario(self.task.plant)
        if task.spread is not None:
            with jax.enable_x64(False):  # the same robot in either precision
                robot = _robot(task, seed)
            return in_default(robot)
        if not task.resets:
            return None
        plant = scenario.plant  # which is traced in a batch: friction has to be known to be none
        if not np.any(plant.coulomb_friction):
            scenario = scenario.replace(plant=plant.replace(coulomb_friction=None))
        resets = official_resets(seed, task.resets, dt=task.dt, duration=task.duration)
        return task.with_resets(scenario, resets)


# The criteria that tables show: heading, unit, format, and a short heading for a terminal.
HEADINGS = {
    "swingup_time": ("swing-up", "s", ".2f", "swing-up"),
    "energy": ("energy", "J", ".2f", "energy"),
    "tau_cost": ("torque cost", "N²m²s", ".2f", "torque"),
    "tau_smoothness": ("smoothness", "N m", ".4f", "smooth"),
    "velocity_cost": ("velocity cost", "rad²/s", ".1f", "velocity"),
    "uptime": ("time up", "s", ".2f", "time up"),
    "number_of_swingups": ("swing-ups", "1", ".1f", "swing-ups"),
}
# Performance and robustness, as published (arXiv 2409.08938 and the boards).
_PUBLISHED = {
    "acrobot": (
        ("Evolutionary SAC", 0.524, 0.692),
        ("HistorySAC", 0.655, 0.751),
        ("AR-EAPO", 0.633, 0.727),
        ("TVLQR", 0.504, 0.607),
        ("iLQR MPC", 0.345, 0.343),
        ("iLQR Riccati gains", 0.396, 0.138),
    ),
    "pendubot": (
        ("Evolutionary SAC", 0.596, 0.796),
        ("HistorySAC", 0.682, 0.770),
        ("AR-EAPO", 0.659, 0.913),
        ("TVLQR", 0.526, 0.767),
        ("iLQR MPC", 0.353, 0.674),
        ("iLQR Riccati gains", 0.536, 0.255),
    ),
}
V2 = {
    robot: Board("v2", Task(robot, designs.COMPETITION), published=_PUBLISHED[robot])
    for robot in ROBOTS
}

# The third AI Olympics, 2025; the figure of one draw each.
_PUBLISHED_V3 = {
    "acrobot": (
        ("AR-EAPO", 0.658, None),
        ("VIMPPI", 0.648, None),
        ("acados MPC", 0.630, None),
        ("MC-PILCO", 0.307, None),
    ),
    "pendubot": (
        ("VIMPPI", 0.799, None),
        ("AR-EAPO", 0.759, None),
        ("acados MPC", 0.726, None),
        ("MC-PILCO", 0.509, None),
    ),
}
V3 = {
    robot: Board(
        "v3",
        Task(robot, designs.COMPETITION, duration=60.0, scoring=ScoreV3(60.0), resets=15),
        trials=None,
        published=_PUBLISHED_V3[robot],
        draws=1000,
        columns=("uptime", "number_of_swingups", "energy", "tau_cost", "velocity_cost"),
    )
    for robot in ROBOTS
}
# The real robots, of design C.1 with friction and motor inertia.
HARDWARE = {
    robot: Board(
        "hardware",
        Task(
            robot,
            tuple((name, v) for name, v in designs.parameters("C.1/1.0").items()),
            scoring=ScoreV2(tuple(V2_HARDWARE.items())),
            spread=PRESETS["identified"],
            standing=2.0,
        ),
        trials=None,
        draws=200,
    )
    for robot in ROBOTS
}
BOARDS = {"v2": V2, "v3": V3, "hardware": HARDWARE}


def v2(robot: str) -> Board:
    """The v2 board of a robot. Raises ``JaxpendError`` for an unknown one."""
    return named_board(robot, "v2")


def v3(robot: str) -> Board:
    """The v3 board, of global policies. Raises ``JaxpendError`` for an unknown robot."""
    return named_board(robot, "v3")


def named_board(robot: str, name: str) -> Board:
    """The board of a robot by name. Raises ``JaxpendError`` for an unknown robot or name."""
    board = BOARDS[choose("board", name, BOARDS)]
    return board[choose("robot", robot, board)]


def hardware(judged_on: "Board | str") -> Board:
    """A board with the normalisation that runs of the real robots are scored with.

    More torque cost and less smoothness count as good there. The published rows are left out.
    Raises ``JaxpendError`` for a board that is not scored as v2 is.
    """
    simulated = board(judged_on)
    if simulated.task.spread is not None:
        return simulated
    if not isinstance(simulated.task.scoring, ScoreV2):
        raise JaxpendError(f"the {simulated.name} board has no normalisation for real robots")
    task = dataclasses.replace(simulated.task, scoring=ScoreV2(tuple(V2_HARDWARE.items())))
    name = f"{simulated.name}, hardware"
    return dataclasses.replace(simulated, name=name, task=task, published=())


def own_task(controller: Any, task: Task | None = None) -> Task:
    """``task``, or where there is none that of the v2 board of the robot a controller is for.

    Raises ``JaxpendError`` if the controller does not say which robot it is for.
    """
    if task is not None:
        return task
    robot = robot_of(controller)
    if robot is None:
        name = type(controller).__name__
        raise JaxpendError(f"{name} does not know its robot; give a task, as v2(robot).task")
    return v2(robot).task


def board(robot_or_board: "str | Board") -> Board:
    """A board itself, or by a robot's name its v2 board. Raises ``JaxpendError`` for a task."""
    if isinstance(robot_or_board, Task):
        text = "a task is no board; give a board, such as v2(robot), or Board(name, task, None)"
        raise JaxpendError(text)
    return robot_or_board if isinstance(robot_or_board, Board) else v2(robot_or_board)


def task_of(
    robot: str, plant: str | None = "", design: str | None = "", board: str = "v2",
    preset: str = "identified",
) -> Task:  # fmt: skip
    """The task of a robot, on another plant where one is named; the torque limit stays 6 N m.

    Args:
        robot: "acrobot" or "pendubot".
        plant: file of parameters (``designs.read``); empty or None: none.
        design: name of an identified set (``designs.parameters``); empty or None: none.
        board: name of the board whose task it is.
        preset: how real robots differ (``hardware.PRESETS``), on the hardware board.

    Raises:
        JaxpendError: an unknown robot, board, preset or design, a preset on a board without
            robots, plant and design given, or a file that cannot be used.
    """
    task = named_board(robot, board).task
    spread = PRESETS[choose("preset", preset, PRESETS)]
    if task.spread is not None:
        task = dataclasses.replace(task, spread=spread)
    elif spread != PRESETS["identified"]:
        text = f"preset is {preset}; the {board} board has no robots that differ"
        raise JaxpendError(f"{text}, only the hardware board has")
    if plant and design:
        raise JaxpendError(f"plant {plant} and design {design} are both given; there is one plant")
    if plant:
        return task.of(designs.read(plant))
    return task.of(designs.parameters(design)) if design else task
