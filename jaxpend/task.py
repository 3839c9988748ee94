"""A task: what is controlled and how it is scored, which is all that a learner may know.

Environment, SAC, SNES, gradient and trajectory optimisation take one.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import designs
from .criteria import HEIGHT, Criteria, ScoreV2, criteria, upright
from .errors import JaxpendError
from .hardware import LONGEST, Spread, draw
from .plant import Plant, tip_height
from .resets import HOLD, JITTER, Resets, random_resets
from .robots import active_joint
from .rollout import SLOTS, Trajectory
from .scenario import DT, DURATION, Scenario
from .variations import sample

__all__ = ["Task"]

# Of the key of resets: beyond the number of any part that the same key is split into elsewhere,
# since ``fold_in(key, i)`` is the i-th of those.
RESETS_STREAM = 2**31 - 7
ROBOTS_STREAM = 2**31 - 9  # the same of the robot of a trial
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
        if self.resets and self.spread:
            raise JaxpendError("a task has resets or robots that differ, not both")
        if self.standing and not self.dt <= self.standing <= self.duration:
            text = f"it must be 0, or {self.dt:g} to {self.duration:g} s"
            raise JaxpendError(f"standing is {self.standing}; {text}")

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
    def delay_slots(self) -> int:
        """Past states that a rollout must keep for the delays of its random scenarios."""
        # Delay and jitter, which are rounded apart, together reach one step beyond the longest.
        return max(SLOTS, round(LONGEST / self.dt) + 2)

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
        if self.spread is not None:
            return self.robot_of(jax.random.fold_in(key, ROBOTS_STREAM))
        return self._thrown(Scenario(self.plant), key)

    def robot_of(self, key: jax.Array, plant: Plant | None = None, pushed: Any = False) -> Scenario:
        """A robot of a task with a ``spread``, around its plant; ``key`` is consumed."""
        assert self.spread is not None
        plant = self.plant if plant is None else plant
        return draw(self.spread, plant, key, pushed=pushed, dt=self.dt, duration=self.duration)

    def sample(self, key: jax.Array, share: float = 1.0) -> Scenario:
        """A trial with random imperfections, in a ``share`` of cases; ``key`` is consumed."""
        scenario = self.imperfect(self.plant, key, share, dt=self.dt, duration=self.duration)
        return self._thrown(scenario, key)

    def imperfect(
        self,
        plant: Plant,
        key: jax.Array,
        share: float = 1.0,
        *,
        dt: float = DT,
        duration: float = DURATION,
    ) -> Scenario:
        """Random imperfections around a nominal plant; ``key`` is consumed.

        Of a task with a ``spread`` it is a robot of that, and a ``share`` of them is pushed; else
        it has one imperfection of the robustness benchmark's six kinds (``variations.sample``).
        What steps it need not be a run of the task, such as an episode of the learning
        environment: ``dt``, of which delays are whole steps, and ``duration``, s, are its own.
        """
        options = {"dt": dt, "duration": duration}
        if self.spread is None:
            return sample(plant, key, share, **options)
        key_robot, key_pushed = jax.random.split(key)
        pushed = jax.random.bernoulli(key_pushed, share)
        return draw(self.spread, plant, key_robot, pushed=pushed, **options)

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
        return criteria(run.t, run.x, run.u, plant, height=self.height, t_final=self.duration)

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
