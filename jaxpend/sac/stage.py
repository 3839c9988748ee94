"""The stages of ``jaxpend sac``: imitation of demonstrations, and SAC itself."""

from functools import partial
from typing import Any, Self

import jax
import jax.numpy as jnp

from .. import devices
from ..config import Run, SACConfig
from ..controller import Controller
from ..pytree import Pytree, pytree
from ..score import nominal
from ..stage import Candidates, Chart, Row, Stage, ranked, value
from ..task import Task
from . import algorithm
from .algorithm import Agent, SACState

__all__ = [
    "SAC", "Contestants", "ContestantsState", "Imitation", "ImitationState", "chunk_length",
]  # fmt: skip


@pytree
class ImitationState(Pytree):
    """SAC before its first step, and the actor that imitates."""

    sac: SACState
    learner: Any  # demonstrations.Imitation


class Imitation(Stage[None, ImitationState, SACState]):
    """The actor imitates demonstrations."""

    name, title, unit, column = "imitation", "Imitation", "updates", "updates"
    charts = (Chart("Squared error", {"loss": "loss"}, "of the action", True),)
    CHUNK = 2000  # updates

    def __init__(self, config: SACConfig, task: Task):
        self.agent, self.task = Agent(config, task), task
        self.total = config.demonstrations.updates

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> Self | None:
        config = getattr(run, "sac", None)
        return cls(config, task) if config and config.demonstrations.episodes else None

    def start(self, seed: int, before: None) -> ImitationState:
        return ImitationState(*algorithm.begin(self.agent, jax.random.key(seed)))

    def like(self) -> ImitationState:
        return ImitationState(*algorithm.structure(self.agent))

    def done(self, state: ImitationState) -> int:
        return int(state.learner.done)

    def advance(self, states: list[ImitationState]) -> list[tuple[ImitationState, Row]]:
        count = min(self.CHUNK, self.total - self.done(states[0]))
        after = []
        for state in states:
            learner, loss = algorithm.imitate_chunk(self.agent, state.sac, state.learner, count)
            after.append((state.replace(learner=learner), {"loss": loss}))
        return after

    def judge(self, state: ImitationState, metrics: Row) -> tuple[Row, Candidates]:
        return metrics, []

    def note(self, row: Row) -> str:
        return f"loss {float(row['loss']):.5f}"

    def watched(self, state: ImitationState) -> Any:
        return state.learner.params, state.learner.opt_state

    def rekey(self, state: ImitationState, number: int) -> ImitationState:
        key = jax.random.fold_in(state.learner.key, number)
        return state.replace(learner=state.learner.replace(key=key))

    def outcome(self, state: ImitationState, best: None) -> SACState:
        return algorithm.with_actor(state.sac, state.learner.params)


def chunk_length(total: int, most: int) -> int:
    """The longest chunk of at most ``most`` steps that divides ``total``, for one compilation.

    If that is less than half as long as it may be, ``most``: then the last chunk is shorter.
    """
    fitting = [length for length in range(most // 2 + 1, most + 1) if total % length == 0]
    return fitting[-1] if fitting else most


class SAC(Stage[SACState | None, SACState, Controller]):
    """SAC on the surrogate reward; judged by ``stage.value``."""

    name, title, unit, column = "sac", "SAC", "environment steps", "env_steps"
    heading, scores = "after SAC", ("score",)
    charts = (
        Chart("Official score", {"best so far": "best", "now": "score"}, "score"),
        Chart("Reward", {"reward": "reward"}, "mean of a step"),
        Chart("Temperature", {"temperature": "temperature"}, log=True),
        Chart("Entropy of the policy", {"entropy": "entropy"}, "nats"),
        Chart("Loss of the critics", {"loss": "critic_loss"}, log=True),
        Chart("Loss of the actor", {"loss": "actor_loss"}),
    )
    ties = True  # they happen before the first success: the later policy has learned more

    def __init__(self, config: SACConfig, task: Task):
        self.agent, self.task, self.total = Agent(config, task), task, config.steps
        self.objective = config.objective
        self.vector_steps = chunk_length(
            -(-config.steps // config.num_envs), max(config.eval_every // config.num_envs, 1)
        )

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> Stage | None:
        config = getattr(run, "sac", None)
        if config and config.contestants > 1:
            return Contestants(config, task)
        return cls(config, task) if config else None

    def start(self, seed: int, before: SACState | None) -> SACState:
        if before is not None:
            return before
        return algorithm.begin(self.agent, jax.random.key(seed))[0]

    def like(self) -> SACState:
        return algorithm.structure(self.agent)[0]

    def policy_like(self) -> Controller | None:
        return jax.eval_shape(partial(algorithm.greedy_policy, self.agent), self.like())

    def done(self, state: SACState) -> int:
        return int(state.env_steps)

    def advance(self, states: list[SACState]) -> list[tuple[SACState, Row]]:
        # The last chunk is as long as what is left, in whole steps of all environments.
        left = -(-(self.total - self.done(states[0])) // self.agent.config.num_envs)
        steps = min(self.vector_steps, left)
        # A step of SAC is too small to be shared among the cores of a processor, unless asked.
        if not devices.asked() and jax.default_backend() == "cpu":
            return self._trained(states, steps)
        return devices.compute(partial(self._trained, steps=steps), states)

    def _trained(self, states: list[SACState], steps: int) -> list[tuple[SACState, Row]]:
        if len(states) == 1:
            return [algorithm.train_chunk(self.agent, states[0], steps)]
        return algorithm.train_chunks(self.agent, states, steps)

    def judge(self, state: SACState, metrics: Row) -> tuple[Row, Candidates]:
        policy = algorithm.greedy_policy(self.agent, state)
        c = nominal(policy, self.task)
        score = float(self.task.score(c).mean())
        worth = value(self.objective, policy, score, self.task)
        row = {"updates": int(state.updates), "score": score, "uptime": c.uptime.mean(), **metrics}
        return row | {"value": worth}, [(policy, worth)]

    def note(self, row: Row) -> str:
        return f"reward {float(row['reward']):.2f}  score {row['score']:.3f}"

    def watched(self, state: SACState) -> Any:
        return state.replace(demonstrations=None)

    def rekey(self, state: SACState, number: int) -> SACState:
        return state.replace(key=jax.random.fold_in(state.key, number))


@pytree
class ContestantsState(Pytree):
    """SAC, and the best policies of equal parts of it."""

    sac: SACState
    policies: tuple[Controller, ...]
    worths: jax.Array  # (contestants,) what they are compared by; -inf before a part


class Contestants(Stage[SACState | None, ContestantsState, tuple[Controller, ...]]):
    """SAC, of which the best policy of each of several equal parts goes on to the next stage.

    Late policies are much alike; those of different parts swing up in different ways.
    """

    name, title, unit, column = SAC.name, SAC.title, SAC.unit, SAC.column
    heading, scores, charts, ties = SAC.heading, SAC.scores, SAC.charts, SAC.ties

    def __init__(self, config: SACConfig, task: Task):
        self.inner, self.agent, self.total = SAC(config, task), Agent(config, task), config.steps
        self.objective, self.task = config.objective, task

    def _unjudged(self, sac: SACState) -> ContestantsState:
        count = self.agent.config.contestants
        policies: tuple[Controller, ...] = (algorithm.greedy_policy(self.agent, sac),) * count
        return ContestantsState(sac, policies, jnp.full(count, -jnp.inf))

    def start(self, seed: int, before: SACState | None) -> ContestantsState:
        return self._unjudged(self.inner.start(seed, before))

    def like(self) -> ContestantsState:
        return jax.eval_shape(self._unjudged, self.inner.like())

    def policy_like(self) -> Controller | None:
        return self.inner.policy_like()

    def done(self, state: ContestantsState) -> int:
        return self.inner.done(state.sac)

    def _part(self, state: ContestantsState) -> int:
        count = self.agent.config.contestants
        return min(self.done(state) * count // self.total, count - 1)

    def advance(self, states: list[ContestantsState]) -> list[tuple[ContestantsState, Row]]:
        after = []
        moved = self.inner.advance([state.sac for state in states])
        for state, (sac, metrics) in zip(states, moved, strict=True):
            row, [(policy, worth)] = self.inner.judge(sac, metrics)
            policies, part = list(state.policies), self._part(state)
            if worth >= state.worths[part]:
                policies[part] = policy
                state = state.replace(worths=state.worths.at[part].set(worth))
            after.append((state.replace(sac=sac, policies=tuple(policies)), row))
        return after

    def judge(self, state: ContestantsState, metrics: Row) -> tuple[Row, Candidates]:
        if not metrics:
            return self.inner.judge(state.sac, metrics)
        return metrics, [(algorithm.greedy_policy(self.agent, state.sac), metrics["value"])]

    def note(self, row: Row) -> str:
        return self.inner.note(row)

    def watched(self, state: ContestantsState) -> Any:
        return self.inner.watched(state.sac)

    def rekey(self, state: ContestantsState, number: int) -> ContestantsState:
        return state.replace(sac=self.inner.rekey(state.sac, number))

    def outcome(self, state: ContestantsState, best: Controller) -> tuple[Controller, ...]:
        """The best policies, the best of all first."""
        return tuple(state.policies[i] for i in ranked(state.worths))
