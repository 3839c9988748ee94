"""Tasks and boards as values: what is controlled and how it is scored; what is published of it.

A ``Task`` is all that a learner may know: environment, SAC, SNES, gradient and trajectory
optimisation take one. A ``Board`` is a task with the official trials and the published rows; what
judges takes one. So training cannot touch official keys or grids, and another board is a value.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from . import designs
from .controller import robot_of
from .criteria import HEIGHT, V2_HARDWARE, Criteria, ScoreV2, criteria
from .errors import JaxpendError, choose
from .plant import Plant
from .robots import ROBOTS, active_joint
from .rollout import Trajectory
from .scenario import DT, Scenario
from .variations import RANGES, sample

__all__ = [
    "CRITERIA", "HEADINGS", "V2", "Board", "Strip", "Task", "board", "hardware", "own_task",
    "strips", "task_of", "v2",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Task:
    """A robot, its plant, the time grid, and the score of a trajectory; hashable, so static in jit.

    Raises ``JaxpendError`` for an unknown robot, or numbers that are not positive and finite.
    """

    robot: str  # "acrobot" or "pendubot"
    parameters: tuple[tuple[str, float], ...]  # of the plant, named as in ``designs.from_dict``
    torque_limit: float = 6.0  # N m, of the driven joint
    dt: float = DT  # s, control and integration period
    duration: float = 10.0  # s
    height: float = HEIGHT  # the line, as a fraction of the stretched height
    scoring: Callable[[Criteria], jax.Array] = ScoreV2()  # hashable

    def __post_init__(self) -> None:
        active_joint(self.robot)
        for name in ("torque_limit", "dt", "duration", "height"):
            if not 0 < getattr(self, name) < np.inf:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")

    @property
    def plant(self) -> Plant:
        """The nominal plant, in jax's default float type at the time of the call."""
        return self.limited(self.torque_limit)

    def limited(self, torque_limit: float) -> Plant:
        """The nominal plant whose driven joint has another torque limit, N m."""
        parameters = dict(self.parameters)
        return designs.from_dict(parameters, robot=self.robot, torque_limit=torque_limit)

    @property
    def joint(self) -> int:
        """Index of the driven joint."""
        return active_joint(self.robot)

    @property
    def steps(self) -> int:
        """Steps of ``dt`` in a run."""
        return round(self.duration / self.dt)

    def sample(self, key: jax.Array, share: float = 1.0) -> Scenario:
        """A random imperfect scenario around the plant, see ``variations.sample``."""
        return sample(self.plant, key, share)

    def criteria(self, run: Trajectory, plant: Plant | None = None) -> Criteria:
        """The criteria of a trajectory; ``plant`` gives the link lengths, by default the task's."""
        plant = self.plant if plant is None else plant
        options = {"height": self.height, "t_final": self.duration}
        return criteria(run.t, run.x, run.u, plant, **options)

    def score(self, c: Criteria) -> jax.Array:
        """The score of criteria, of their batch shape."""
        return self.scoring(c)

    def of(self, parameters: Mapping[str, float]) -> "Task":
        """The same task on another plant.

        ``parameters`` are as in ``designs.from_dict``; the torque limit stays the task's.
        """
        designs.from_dict(parameters, robot=self.robot)
        values = tuple((name, float(value)) for name, value in parameters.items())
        return dataclasses.replace(self, parameters=values)


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


@dataclasses.dataclass(frozen=True)
class Board:
    """A task with its official trials and the rows that are published."""

    name: str
    task: Task
    trials: Callable[[Plant], list[Strip]] = strips  # of robustness, around the nominal plant
    published: tuple[tuple[str, float, float], ...] = ()  # title, performance, robustness

    @property
    def robot(self) -> str:
        """ "acrobot" or "pendubot"."""
        return self.task.robot


# The criteria of the performance score: heading, unit, format, and a short heading for a terminal.
HEADINGS = {
    "swingup_time": ("swing-up", "s", ".2f", "swing-up"),
    "energy": ("energy", "J", ".2f", "energy"),
    "tau_cost": ("torque cost", "N²m²s", ".2f", "torque"),
    "tau_smoothness": ("smoothness", "N m", ".4f", "smooth"),
    "velocity_cost": ("velocity cost", "rad²/s", ".1f", "velocity"),
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


def v2(robot: str) -> Board:
    """The v2 board of a robot. Raises ``JaxpendError`` for an unknown one."""
    return V2[choose("robot", robot, V2)]


def hardware(judged_on: "Board | str") -> Board:
    """A board with the normalisation that runs of the real robots are scored with.

    More torque cost and less smoothness count as good there. The published rows are left out.
    """
    simulated = board(judged_on)
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
    """A board itself, or by a robot's name its v2 board."""
    return robot_or_board if isinstance(robot_or_board, Board) else v2(robot_or_board)


def task_of(robot: str, plant: str | None = "", design: str | None = "") -> Task:
    """The v2 task of a robot, on another plant where one is named; the torque limit stays 6 N m.

    Args:
        robot: "acrobot" or "pendubot".
        plant: file of parameters (``designs.read``); empty or None: none.
        design: name of an identified set (``designs.parameters``); empty or None: none.

    Raises:
        JaxpendError: an unknown robot or design, both given, or a file that cannot be used.
    """
    task = v2(robot).task
    if plant and design:
        raise JaxpendError(f"plant {plant} and design {design} are both given; there is one plant")
    if plant:
        return task.of(designs.read(plant))
    return task.of(designs.parameters(design)) if design else task
