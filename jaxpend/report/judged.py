"""What a run's policy does: its official run, its score and its robustness, judged once."""

import dataclasses
import math
from functools import partial
from typing import Any

import jax
import numpy as np

from ..boards import HEADINGS, Board
from ..controllers.catalogue import find_controller
from ..controllers.files import read_header
from ..fleet import judge_fleet
from ..hardware import PRESETS
from ..plant import forward_kinematics
from ..robots import ROBOTS
from ..robustness import benchmark
from ..runs.reader import RunRecord
from ..score import official, official_run
from ..task import Task

__all__ = ["Judged", "criteria_costs", "held", "judge"]

ROBOTS_JUDGED = 200


@dataclasses.dataclass(frozen=True)
class Judged:
    """A policy on a task, in float64, and in the robustness benchmark."""

    task: Task
    score: float
    criteria: dict[str, float]
    success: bool
    t: Any  # (n,) s; up to where the run diverged, if it did
    x: Any  # (n, 4) rad, rad/s
    u: Any  # (n - 1, 2) N m
    points: Any  # (n, 2, 2) m, elbow and end effector, x and y
    header: dict  # of the policy file
    report: dict | None  # of the benchmark, as it is written to a file
    fleet: dict | None  # of robots that differ, as ``jaxpend hardware`` writes it to a file
    held: Any  # (n, 2) s, from when to when somebody held the arm

    @property
    def up(self) -> float | None:
        """Swing-up time, s; None without success, and where it is not that of one run."""
        stands = self.success and not self.task.chance
        return self.criteria["swingup_time"] if stands else None

    @property
    def robustness(self) -> float | None:
        """Overall robustness, the median over keys; None where it was not measured."""
        return self.report["overall"] if self.report else None

    @property
    def reach(self) -> float:
        """What the end effector of the robot reaches when it is stretched, m."""
        return float(np.linalg.norm(np.diff(self.points[0], axis=0, prepend=0), axis=-1).sum())

    @property
    def whole(self) -> float:
        """Length of the time axis that shows all of the run, whole seconds."""
        return max(1.0, float(round(self.t[-1])))

    @property
    def window(self) -> float:
        """How much of the run shows its swing-up, whole seconds."""
        if self.task.resets:
            return min(self.whole, 10.0)
        if self.up is None:
            return self.whole
        return min(self.whole, max(3.0, float(round(2.5 * self.up))))


def judge(
    run: RunRecord, board: Board, robustness: bool = True, controller: str | None = None
) -> Judged | None:
    """The official run of a run's best policy so far, its score, and its robustness.

    The policies of several seeds share one compilation.

    Args:
        run: its policy is judged; the result is None where there is none yet.
        board: whose task it is judged on.
        robustness: run the benchmark too, or judge on a fleet of robots, as the board has it.
        controller: as in ``find_controller``, with the run's policy; alone, where that is the
            one that ships with the package.
    """
    if run.policy is None:
        return None
    task, report, fleet = board.task, None, None
    policy = None if controller and run.policy in ROBOTS else run.policy
    found = partial(find_controller, policy, controller, task)
    with jax.enable_x64(True):
        trajectory, said = official_run(found(), board)
        plant = task.plant if (drawn := board.drawn(0)) is None else drawn.plant
        points = jax.vmap(forward_kinematics, (None, 0))(plant, trajectory.x)
    if board.draws > 1:
        said = official(found(), board)
    if robustness and board.trials is not None:
        report = {"robot": run.robot} | benchmark(found(), board, jax.random.key(0)).as_dict()
    if robustness and task.spread is not None:
        many = judge_fleet(found(), task, jax.random.key(0), robots=ROBOTS_JUDGED)
        preset = next((n for n, spread in PRESETS.items() if spread == task.spread), board.name)
        fleet = {"robot": run.robot, "preset": preset} | many.as_dict()
    x = np.asarray(trajectory.x)
    samples = np.isfinite(x).all(axis=1).cumprod().sum()  # the first one is the start
    return Judged(
        task=task,
        score=said["score"],
        criteria=said["criteria"],
        success=said["success"],
        t=np.asarray(trajectory.t)[:samples],
        x=x[:samples],
        u=np.asarray(trajectory.u)[: samples - 1],
        points=np.asarray(points)[:samples],
        header=read_header(policy) if policy else {},
        report=report,
        fleet=fleet,
        held=held(board),
    )


def held(board: Board) -> np.ndarray:
    """When somebody holds the arm in the draw of seed 0, (n, 2) s."""
    drawn = board.drawn(0)
    if drawn is None or (resets := drawn.resets) is None:
        return np.zeros((0, 2))
    first, steps = np.asarray(resets.first), np.asarray(resets.steps)
    return board.task.dt * np.stack([first, first + steps], axis=-1)


def criteria_costs(judged: Judged) -> list[tuple[str, str, float]]:
    """Every criterion of the score: heading, value with unit, cost; none for another score."""
    norms = dict(getattr(judged.task.scoring, "norms", ()))
    rows = []
    for name, norm in norms.items():
        heading, unit, form, _ = HEADINGS[name]
        value = judged.criteria[name]
        share = math.tanh(math.pi * value / norm)
        share = share if math.isfinite(share) else 1.0
        rows.append((heading, f"{value:{form}} {unit}", share / len(norms)))
    return rows
