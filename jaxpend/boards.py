"""Tasks and boards as values: what is controlled and how it is scored; what is published of it.

A ``Task`` is all that a learner may know: environment, SAC, SNES, gradient and trajectory
optimisation take one. A ``Board`` is a task with the official trials and the published rows; what
judges takes one. So training cannot touch official keys or grids, and another board is a value.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import designs
from .controller import robot_of
from .criteria import (
    HEIGHT,
    V2_HARDWARE,
    V2_OFFICIAL,
    Criteria,
    ScoreV2,
    ScoreV3,
    criteria,
    upright,
)
from .errors import JaxpendError, choose
from .hardware import PRESETS, Spread, draw
from .plant import Plant, tip_height
from .pytree import in_default
from .resets import HOLD, JITTER, Resets, official_resets, random_resets
from .robots import ROBOTS, active_joint
from .rollout import Trajectory
from .scenario import DT, Scenario
from .variations import RANGES, sample

__all__ = [
    "BOARDS", "CRITERIA", "HARDWARE", "HEADINGS", "V2", "V3", "Board", "Strip", "Task", "board",
    "hardware", "named_board", "own_task", "strips", "task_of", "v2", "v3",
]  # fmt: skip


# Of the key of resets: beyond the number of any part that the same key is split into elsewhere,
# since ``fold_in(key, i)`` is the i-th of those.
RESETS_STREAM = 2**31 - 7
TRIALS = 16  # of a task in which chance plays: what a judgement in training is the mean of


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
    spread: Spread | None = None  # how real ones differ; None: one imperfection at a time
    standing: float = 0.0  # s, at the end, for which it has to stand; 0: in its last state
    resets: int = 0  # times in a run that somebody throws the arm, see ``jaxpend.resets``

    def __post_init__(self) -> None:
        active_joint(self.robot)
        for name in ("torque_limit", "dt", "duration", "height"):
            if not 0 < getattr(self, name) < np.inf:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")
        most = int(self.duration / (2 * JITTER + HOLD + self.dt)) - 1
        if self.resets != int(self.resets) or not 0 <= self.resets <= max(most, 0):
            text = f"it must be a whole number, in {self.duration:g} s {max(most, 0)} at most"
            raise JaxpendError(f"resets is {self.resets}; {text}")

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

    @property
    def shipped(self) -> str:
        """Name of the policy that ships for it."""
        kind = "hardware_" if self.spread else "global_" if self.resets else ""
        return f"{kind}{self.robot}"

    @property
    def chance(self) -> bool:
        """Whether chance plays in what the score is of: resets by hand, or robots that differ."""
        return bool(self.resets or self.spread)

    @property
    def repeats(self) -> int:
        """Runs of which training takes the mean score: one, or several where chance plays."""
        return TRIALS if self.chance else 1

    def trial(self, key: jax.Array) -> Scenario:
        """A scenario that the score is of: the nominal plant, with resets that ``key`` draws.

        Of a task with a ``spread`` it is a robot that ``key`` draws, which nobody pushes.
        """
        scenario = Scenario(self.plant) if self.spread is None else self.robot_of(key)
        return self._thrown(scenario, key)

    def robot_of(self, key: jax.Array, plant: Plant | None = None, pushed: Any = False) -> Scenario:
        """A robot of a task with a ``spread``, around its plant; ``key`` is consumed."""
        assert self.spread is not None
        plant = self.plant if plant is None else plant
        return draw(self.spread, plant, key, pushed=pushed, duration=self.duration)

    def sample(self, key: jax.Array, share: float = 1.0) -> Scenario:
        """A trial with random imperfections, in a ``share`` of cases; ``key`` is consumed."""
        return self._thrown(self.imperfect(self.plant, key, share), key)

    def imperfect(self, plant: Plant, key: jax.Array, share: float = 1.0) -> Scenario:
        """Random imperfections around a nominal plant; ``key`` is consumed.

        Of a task with a ``spread`` it is a robot of that, and a ``share`` of them is pushed; else
        it has one imperfection of the robustness benchmark's six kinds (``variations.sample``).
        """
        if self.spread is None:
            return sample(plant, key, share)
        key_robot, key_pushed = jax.random.split(key)
        return self.robot_of(key_robot, plant, jax.random.bernoulli(key_pushed, share))

    def stands(self, x: jax.Array, length: jax.Array | None = None) -> jax.Array:
        """Whether runs, states (..., N, 4), end well: (...) bool.

        Its last state is upright (``criteria.upright``), or, of a task with ``standing``, the tip
        is above the line in all of the last so many s, which a spinning arm's is not; ``length``
        (2,), m, is that of the links, by default the nominal one.
        """
        if not self.standing:
            return upright(x[..., -1, :])
        last = x[..., -round(self.standing / self.dt) :, :]
        length = self.plant.length if length is None else length
        return jnp.all(tip_height(length, last) > self.height * jnp.sum(length), axis=-1)

    def _thrown(self, scenario: Scenario, key: jax.Array) -> Scenario:
        if not self.resets:
            return scenario
        key = jax.random.fold_in(key, RESETS_STREAM)
        resets = random_resets(key, self.resets, dt=self.dt, duration=self.duration)
        return self.with_resets(scenario, resets)

    def with_resets(self, scenario: Scenario, resets: Resets | None) -> Scenario:
        """The scenario with resets, in which both joints are driven, up to the torque limit."""
        ones = np.ones(2, scenario.dtype)
        plant = scenario.plant.replace(torque_limit=self.torque_limit * ones, actuation=ones)
        return scenario.replace(plant=plant, resets=resets)

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
    """A board itself, or by a robot's name its v2 board."""
    return robot_or_board if isinstance(robot_or_board, Board) else v2(robot_or_board)


def task_of(robot: str, plant: str | None = "", design: str | None = "", board: str = "v2") -> Task:
    """The task of a robot, on another plant where one is named; the torque limit stays 6 N m.

    Args:
        robot: "acrobot" or "pendubot".
        plant: file of parameters (``designs.read``); empty or None: none.
        design: name of an identified set (``designs.parameters``); empty or None: none.
        board: name of the board whose task it is.

    Raises:
        JaxpendError: an unknown robot, board or design, plant and design given, or a file that
            cannot be used.
    """
    task = named_board(robot, board).task
    if plant and design:
        raise JaxpendError(f"plant {plant} and design {design} are both given; there is one plant")
    if plant:
        return task.of(designs.read(plant))
    return task.of(designs.parameters(design)) if design else task
