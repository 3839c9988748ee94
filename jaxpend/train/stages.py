"""The stages of training: each a state that moves on in chunks and can be judged in between.

All arrays that a stage needs to go on are in its state, so that a checkpoint of the state is a
checkpoint of the stage. Chunks do not depend on time, only on the configuration.
"""

import dataclasses
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from .. import gradient, sac, snes
from ..boards import v2
from ..config import GradientConfig, GuardConfig, SACConfig, SNESConfig
from ..controller import Controller
from ..controllers.guard import guard
from ..controllers.search_space import kinds
from ..score import imperfect, nominal, score_v2

__all__ = ["SAC", "SNES", "Gradient", "Imitation", "Stage"]

# Of the scenarios on which candidates are compared: no seed of a run, and no key of the benchmark.
VALIDATION_SEED = 2**31 - 1


@partial(jax.jit, static_argnames=("robot", "count"))
def _validation(controller: Controller, robot: str, count: int) -> jax.Array:
    """Mean v2 score over random imperfect scenarios, always the same."""
    key = jax.random.key(VALIDATION_SEED)
    return score_v2(imperfect(controller, v2(robot).task, key, count)).mean()


def value(
    config: GradientConfig | SNESConfig, controller: Controller, score: float, robot: str
) -> float:
    """What candidates are compared by, given their official score.

    It is the score itself; of a search that meets scenarios its weighted mean with the mean score
    over ``config.validation`` of them, which stay the same.
    """
    if not config.scenarios:
        return score
    weight = config.scenario_weight
    mean = float(_validation(controller, robot, config.validation))
    return (1 - weight) * score + weight * mean


class Stage:
    """What the stages share; every method is pure."""

    name: ClassVar[str]  # in metrics, file names and results
    title: ClassVar[str]  # for people
    unit: ClassVar[str]  # what ``done`` counts
    column: ClassVar[str]  # the same in the metrics
    ties: ClassVar[bool] = False  # whether a policy as good as the best replaces it

    total: int

    def start(self, seed: int, before: Any) -> Any:
        """The state before the first chunk; ``before`` is the ``outcome`` of the last stage."""
        raise NotImplementedError

    def like(self) -> Any:
        """A state without numbers: the structure that checkpoints are read into."""
        raise NotImplementedError

    def policy_like(self) -> Any:
        """The same of a policy."""
        raise NotImplementedError

    def done(self, state: Any) -> int:
        """How much of ``total`` is done."""
        raise NotImplementedError

    def advance(self, states: list) -> list[tuple[Any, dict]]:
        """The next chunk of one run, or of several at the same step; states and metrics."""
        raise NotImplementedError

    def judge(self, state: Any, metrics: dict) -> tuple[dict, list[tuple[Controller, float]]]:
        """A row of metrics, and policies with their scores, the last one of training first."""
        raise NotImplementedError

    def note(self, row: dict) -> str:
        """What a row of metrics says, for people."""
        raise NotImplementedError

    def watched(self, state: Any) -> Any:
        """What has to be finite, besides the metrics."""
        raise NotImplementedError

    def rekey(self, state: Any, number: int) -> Any:
        """The same state, to go on from with other random numbers."""
        return state.replace(key=jax.random.fold_in(state.key, number))

    def outcome(self, state: Any, best: Controller | None) -> Any:
        """What the next stage starts from."""
        return best


class Imitation(Stage):
    """The actor imitates demonstrations; its state is (SAC state, learner)."""

    name, title, unit, column = "imitation", "imitating demonstrations", "updates", "updates"
    CHUNK = 2000  # updates

    def __init__(self, config: SACConfig):
        self.config, self.total = config, config.demonstrations.updates

    def start(self, seed, before):
        return sac.begin(self.config, jax.random.key(seed))

    def like(self):
        return sac.structure(self.config)

    def policy_like(self):
        return None

    def done(self, state):
        return int(state[1].done)

    def advance(self, states):
        count = min(self.CHUNK, self.total - self.done(states[0]))
        after = []
        for state, learner in states:
            learner, loss = sac.imitate_chunk(self.config, state, learner, count)
            after.append(((state, learner), {"loss": loss}))
        return after

    def judge(self, state, metrics):
        return metrics, []

    def note(self, row):
        return f"loss {float(row['loss']):.5f}"

    def watched(self, state):
        return state[1].params, state[1].opt_state

    def rekey(self, state, number):
        return state[0], super().rekey(state[1], number)

    def outcome(self, state, best):
        return state[0].replace(actor=state[1].params)


class SAC(Stage):
    """SAC on the surrogate reward; judged by the official score."""

    name, title, unit, column = "sac", "SAC", "steps", "env_steps"
    ties = True  # they happen before the first success: the later policy has learned more

    def __init__(self, config: SACConfig):
        self.config, self.total = config, config.steps
        self.vector_steps = max(config.eval_every // config.num_envs, 1)

    def start(self, seed, before):
        return sac.begin(self.config, jax.random.key(seed))[0] if before is None else before

    def like(self):
        return sac.structure(self.config)[0]

    def policy_like(self):
        return jax.eval_shape(partial(sac.greedy_policy, self.config), self.like())

    def done(self, state):
        return int(state.env_steps)

    def advance(self, states):
        if len(states) == 1:
            return [sac.train_chunk(self.config, states[0], self.vector_steps)]
        return sac.train_chunks(self.config, states, self.vector_steps)

    def judge(self, state, metrics):
        policy = sac.greedy_policy(self.config, state)
        c = nominal(policy, v2(policy.robot).task)
        score = float(score_v2(c))
        row = {"updates": int(state.updates), "score": score, "uptime": c.uptime, **metrics}
        return row, [(policy, score)]

    def note(self, row):
        return f"reward {float(row['reward']):.2f}  score {row['score']:.3f}"

    def watched(self, state):
        return state.replace(demonstrations=None)


class Gradient(Stage):
    """The gradient of the smooth score; judged, by ``value``, is where it is."""

    name, title, unit, column = "gradient", "gradient", "steps", "step"

    def __init__(self, config: GradientConfig, policy: Any, robot: str):
        """``policy`` is a controller of the structure that the ascent starts from.

        Raises ``JaxpendError`` if it has nothing to search.
        """
        kinds(policy, config.searched)
        self.config, self.total = config, config.steps
        self.policy, self.robot = policy, robot

    def start(self, seed, before):
        key = jax.random.fold_in(jax.random.key(seed), 2)
        search = gradient.init(self.config, before, key)
        return {"start": before, "search": search, "done": jnp.asarray(0)}

    def like(self):
        return jax.eval_shape(lambda policy: self.start(0, policy), self.policy)

    def policy_like(self):
        return self.policy

    def done(self, state):
        return int(state["done"])

    def advance(self, states):
        count, after = min(self.config.chunk, self.total - self.done(states[0])), []
        for state in states:
            arguments = self.config, state["start"], state["search"], count, v2(self.robot).task
            search, metrics = gradient.improve(*arguments)
            after.append((state | {"search": search, "done": state["done"] + count}, metrics))
        return after

    def judge(self, state, metrics):
        policy = gradient.current(self.config, state["start"], state["search"])
        score = float(score_v2(nominal(policy, v2(self.robot).task)))
        worth = value(self.config, policy, score, self.robot)
        row = {"score": score, "value": worth, "lost": int(state["search"].lost)}
        return row | {name: values[-1] for name, values in metrics.items()}, [(policy, worth)]

    def note(self, row):
        return f"smooth score {float(row['smooth_score']):.4f}  score {row['score']:.4f}"

    def watched(self, state):
        return state["search"].parameters

    def rekey(self, state, number):
        return state | {"search": super().rekey(state["search"], number)}


class SNES(Stage):
    """SNES on the official score from any controller, guarded; its state has that and the search.

    Judged, by ``value``, are the mean controller and the best individual so far; both are
    also scored on the nominal plant and, for the metrics, on fresh noise.
    """

    name, title, unit, column = "snes", "SNES", "generations", "generation"

    def __init__(
        self, config: SNESConfig, policy: Any, robot: str, guarding: GuardConfig | None = None
    ):
        """``policy`` is a controller of the structure that the search starts from, before a guard.

        Raises ``JaxpendError`` if it has nothing to search.
        """
        self.config, self.total, self.robot = config, config.generations, robot
        self.guarded = partial(guard, robot=robot, **dataclasses.asdict(guarding or GuardConfig()))
        shapes = jax.eval_shape(lambda p: p, policy)
        self.policy = self.guarded(jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes))
        kinds(self.policy, config.searched)
        self.fresh_fitness = jax.jit(lambda p, key: snes.fitness(config, p, key, v2(robot).task)[0])

        def evolve_all(policies, searches, count):
            one = lambda p, s: snes.evolve(config, p, s, count, v2(robot).task)  # noqa: E731
            return jax.vmap(one)(policies, searches)

        self.evolve_all = jax.jit(evolve_all, static_argnames="count")

    def _keys(self, seed):
        return jax.random.split(jax.random.fold_in(jax.random.key(seed), 1))

    def start(self, seed, before):
        key_init, key_fresh = self._keys(seed)
        start = self.guarded(before)
        return self._begin(start, key_init, key_fresh)

    def _begin(self, start, key_init, key_fresh):
        search = snes.init(self.config, start, key_init)
        return {"start": start, "search": search, "fresh": key_fresh, "done": jnp.asarray(0)}

    def like(self):
        return jax.eval_shape(self._begin, self.policy, *self._keys(0))

    def policy_like(self):
        return self.policy

    def done(self, state):
        return int(state["done"])

    def advance(self, states):
        count = min(self.config.chunk, self.total - self.done(states[0]))

        both = [(state["start"], state["search"]) for state in states]
        if len(states) == 1:
            after = [snes.evolve(self.config, *both[0], count, v2(self.robot).task)]
        else:
            stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *both)
            found = self.evolve_all(*stacked, count)
            after = [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(len(states))]
        return [
            (old | {"search": search, "done": old["done"] + count}, metrics)
            for old, (search, metrics) in zip(states, after, strict=True)
        ]

    def judge(self, state, metrics):
        start, search = state["start"], state["search"]
        row = {"diverged": int(search.diverged)}
        row |= {name: values[-1] for name, values in metrics.items()}
        key, candidates = jax.random.fold_in(state["fresh"], self.done(state)), []
        found = {"mean": snes.mean_controller, "individual": snes.best_controller}
        for name, policy_of in found.items():
            policy = policy_of(self.config, start, search)
            score = float(score_v2(nominal(policy, v2(self.robot).task)))
            worth = value(self.config, policy, score, self.robot)
            row |= {f"{name}_score": score, f"{name}_value": worth}
            row[f"{name}_fresh_fitness"] = self.fresh_fitness(policy, key)
            candidates.append((policy, worth))
        return row, candidates

    def note(self, row):
        return f"fitness {float(row['mean_fitness']):.3f}  mean {row['mean_score']:.4f}"

    def watched(self, state):
        return state["search"].strategy.mean, state["search"].strategy.std

    def rekey(self, state, number):
        return state | {"search": super().rekey(state["search"], number)}
