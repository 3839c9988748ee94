"""Separable natural evolution strategy on a controller's parameters against the official score.

SNES (Wierstra et al., "Natural evolution strategies", JMLR 2014; evosax) starts from a trained
policy, or from any other controller that declares what may be searched
(``controllers/search_space.py``). The fitness of an individual is its score in the task (10 s at
500 Hz on the v2 boards), averaged over rollouts in which a policy's greedy action is un-squashed,
disturbed by Gaussian noise and squashed again (Calì et al., 2024), so that the score of what is
found does not depend on exact torques. All individuals of a generation meet the same noise: common
random numbers make the comparison fair. Other strategies of evosax can be chosen by ``strategy``.
"""

import dataclasses
from functools import partial
from typing import Any, Self

import jax
import jax.numpy as jnp
import optax

from . import devices
from .boards import own_task
from .config import GuardConfig, Run, SNESConfig, SNESRun
from .controller import Controller, check_controller
from .controllers.guard import guard
from .controllers.policy import change_policies
from .controllers.search_space import coordinates
from .errors import JaxpendError
from .pytree import Pytree, pytree
from .score import combined, imperfect, performance
from .stage import Candidates, Chart, Row, SearchStage, SearchState
from .task import Task

__all__ = [
    "SNES", "STRATEGIES", "SNESConfig", "SNESState", "best_controller", "evolve", "fitness", "init",
    "mean_controller",
]  # fmt: skip

STRATEGIES = {  # and what evosax calls them
    "snes": "SNES",
    "sep_cma_es": "Sep_CMA_ES",
    "lm_ma_es": "LM_MA_ES",
    "open_es": "Open_ES",
}
# Bytes of parameters that a CPU keeps near: of large networks a few at a time are faster.
NEAR = 1.2e6


@pytree
class SNESState(Pytree):
    """Everything that the search changes."""

    strategy: Any  # evosax state: mean and std, in units of ``_Search``, generation counter
    key: jax.Array
    best: jax.Array  # (parameters,) best individual by noisy fitness
    best_fitness: jax.Array  # () its noisy fitness, a score
    diverged: jax.Array  # () int, rollouts that were not finite, so far


def fitness(
    config: SNESConfig, controller: Controller, key: jax.Array, task: Task | None = None
) -> tuple[jax.Array, jax.Array]:
    """Fitness of a controller, to be maximised, and how many of its rollouts diverged.

    The mean score of the task over its noisy trials; with ``config.scenarios`` what
    ``score.combined`` makes of it and of random imperfect scenarios of the task. ``task`` may be
    left out for a controller that knows its robot (``boards.own_task``).
    """
    task = own_task(controller, task)
    key_noise, key_scenarios = jax.random.split(key)
    noise = jnp.asarray(config.action_noise, jnp.float32) if config.action_noise else None
    noisy, policies = change_policies(controller, lambda p: p.replace(action_noise=noise))
    draws = task.chance or (policies and config.action_noise)
    keys = jax.random.split(key_noise, config.rollouts if draws else 1)
    c = jax.vmap(lambda k: performance(noisy, task.trial(k), k, task))(keys)
    score, diverged = task.score(c).mean(), jnp.sum(c.diverged)
    if config.scenarios:
        met = imperfect(controller, task, key_scenarios, config.scenarios)
        score = combined(config.objective, score, met, task)
        diverged = diverged + jnp.sum(met[0].diverged)
    return score, diverged


class _Search:
    """The strategy of a configuration on the coordinates of a controller.

    Only SNES takes a standard deviation for each coordinate. The others search in units of it:
    coordinate = ``unit`` z, and ``rebuild`` gives the controller at a z.
    """

    def __init__(self, config: SNESConfig, controller: Controller):
        flat, weights, rebuild = coordinates(controller, config.searched)
        std = jnp.where(weights, config.sigma, config.gain_sigma).astype(flat.dtype)

        def shrunk(generation):
            return config.final_sigma ** (generation / config.generations)

        # Its mean moves by a tenth of sigma a generation; its sigma follows a schedule only.
        options = {"optimizer": optax.adam(0.1), "std_schedule": shrunk}
        options = options if config.strategy == "open_es" else {}
        self.decay = 1.0 if options else config.final_sigma ** (1.0 / config.generations)
        per_coordinate = config.strategy == "snes"
        self.unit = jnp.ones((), flat.dtype) if per_coordinate else std
        self.start, self.rebuild = flat / self.unit, lambda z: rebuild(self.unit * z)
        with jax.ensure_compile_time_eval():  # evosax computes when it is imported
            from evosax import algorithms
        kind = getattr(algorithms, STRATEGIES[config.strategy])
        self.strategy = kind(population_size=config.population, solution=flat, **options)
        with jax.ensure_compile_time_eval():  # LM-MA-ES turns a number of vectors into an int
            self.params = self.strategy.default_params
        if hasattr(self.params, "std_init"):
            first = std if per_coordinate else jnp.ones((), flat.dtype)
            self.params = self.params.replace(std_init=first)


def _group(population: int, parameters: int) -> int:
    """How many individuals are judged at a time: a divisor of all, for one compilation."""
    if jax.default_backend() != "cpu":
        return population
    most = max(int(NEAR // (4 * parameters)), 1)
    return max(size for size in range(1, population + 1) if population % size == 0 and size <= most)


def init(config: SNESConfig, controller: Controller, key: jax.Array) -> SNESState:
    """Search distribution centred on the controller; ``key`` is consumed.

    Raises ``JaxpendError`` as ``check_controller`` and ``search_space.kinds``.
    """
    check_controller(controller)
    search = _Search(config, controller)
    key, key_init = jax.random.split(key)
    state = search.strategy.init(key_init, search.start, search.params)
    state = SNESState(state, key, search.start, jnp.asarray(-jnp.inf), jnp.zeros((), jnp.int32))
    # jax would change weak types after the first chunk and compile ``evolve`` again, so all types
    # are made strong here.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf)), state)


@partial(jax.jit, static_argnames=("config", "generations", "task"))
def evolve(
    config: SNESConfig,
    start: Controller,
    state: SNESState,
    generations: int,
    task: Task | None = None,
) -> tuple[SNESState, dict[str, jax.Array]]:
    """Run some generations; returns the state and per-generation metrics (generations,).

    ``start`` is what ``init`` got: the origin of the coordinates, and all that is not searched.
    ``task`` may be left out for a controller that knows its robot (``boards.own_task``).
    """
    task = own_task(start, task)
    search = _Search(config, start)
    strategy, params = search.strategy, search.params

    def generation(state, _):
        key, key_ask, key_noise, key_tell = jax.random.split(state.key, 4)
        population, inner = strategy.ask(key_ask, state.strategy, params)

        def judged(start, unit, key, individuals):
            rebuild = coordinates(start, config.searched)[-1]
            return jax.lax.map(
                lambda p: fitness(config, rebuild(unit * p), key, task),
                individuals,
                batch_size=_group(*individuals.shape),
            )

        scores, diverged = devices.split(judged, start, search.unit, key_noise)(population)
        if config.strategy == "lm_ma_es":  # evosax weighs what it remembers by place, not by rank
            order = jnp.argsort(-scores)
            population, scores = population[order], scores[order]
            inner = inner.replace(z=inner.z[order])
        # The one place that negates: evosax minimises.
        inner, _ = strategy.tell(key_tell, population, -scores, inner, params)
        inner = inner.replace(std=inner.std * search.decay)
        top = jnp.argmax(scores)
        better = scores[top] > state.best_fitness
        state = SNESState(
            strategy=inner,
            key=key,
            best=jnp.where(better, population[top], state.best),
            best_fitness=jnp.maximum(scores[top], state.best_fitness),
            diverged=state.diverged + diverged.sum(),
        )
        metrics = {"mean_fitness": scores.mean(), "max_fitness": scores[top]}
        return state, metrics | {"sigma": (search.unit * inner.std).mean()}

    return jax.lax.scan(generation, state, length=generations)


def mean_controller(config: SNESConfig, start: Controller, state: SNESState) -> Controller:
    """The controller at the centre of the search distribution."""
    return _Search(config, start).rebuild(state.strategy.mean)


def best_controller(config: SNESConfig, start: Controller, state: SNESState) -> Controller:
    """The individual with the best noisy fitness so far."""
    return _Search(config, start).rebuild(state.best)


class SNES(SearchStage):
    """The stage of training: SNES from any controller, which is guarded before the search.

    Judged, by ``stage.value``, are the mean controller and the best individual so far; both are
    also scored as ``score.nominal`` does and, for the metrics, on fresh noise.
    """

    name, title, unit, column = "snes", "SNES", "generations", "generation"
    heading, scores = "after SNES", ("mean_score", "individual_score")
    charts = (
        Chart("Fitness", {"mean": "mean_fitness", "best": "max_fitness"}, "noisy score"),
        Chart("Official score", {"best so far": "best", "mean": "mean_score"}, "score"),
        Chart("Standard deviation", {"sigma": "sigma"}, "of the parameters"),
    )

    def __init__(
        self, config: SNESConfig, policy: Any, task: Task, guarding: GuardConfig | None = None
    ):
        """``policy`` is a controller of the structure that the search starts from, unguarded."""
        self.guarding, self.task = dataclasses.asdict(guarding or GuardConfig()), task
        shapes = jax.eval_shape(lambda p: p, policy)
        zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        super().__init__(config, self.prepared(zeros), task)
        self.fresh_fitness = jax.jit(lambda p, key: fitness(config, p, key, task)[0])

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> Self | None:
        config = getattr(run, "snes", None)
        if config and not config.generations and isinstance(run, SNESRun):
            raise JaxpendError("snes.generations is 0; a run of SNES alone needs some")
        if not (config and config.generations):
            return None
        return cls(config, start, task, getattr(run, "guard", None))

    def prepared(self, controller: Controller) -> Controller:
        return guard(controller, self.task.robot, self.task.plant, **self.guarding)

    def begin(self, seed: int, controller: Controller) -> SearchState:
        key, fresh = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1))
        return SearchState(controller, init(self.config, controller, key), jnp.asarray(0), fresh)

    def search(self, states: list[SearchState], count: int) -> list[tuple[SNESState, Row]]:
        def chunk(start, search):
            return evolve(self.config, start, search, count, self.task)

        both = [(state.start, state.search) for state in states]
        if len(states) == 1:
            return [devices.compute(chunk, *both[0])]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *both)
        found = devices.compute(jax.vmap(chunk), *stacked)
        return [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(len(states))]

    def judge(self, state: SearchState, metrics: Row) -> tuple[Row, Candidates]:
        row: Row = {"diverged": int(state.search.diverged)}
        row |= {name: values[-1] for name, values in metrics.items()}
        assert state.fresh is not None
        key, candidates = jax.random.fold_in(state.fresh, self.done(state)), []
        for name, policy_of in {"mean": mean_controller, "individual": best_controller}.items():
            policy = policy_of(self.config, state.start, state.search)
            score, worth = self.compared(policy)
            row |= {f"{name}_score": score, f"{name}_value": worth}
            row[f"{name}_fresh_fitness"] = self.fresh_fitness(policy, key)
            candidates.append((policy, worth))
        return row, candidates

    def note(self, row: Row) -> str:
        return f"fitness {float(row['mean_fitness']):.3f}  mean {row['mean_score']:.4f}"

    def watched(self, state: SearchState) -> tuple[jax.Array, jax.Array]:
        return state.search.strategy.mean, state.search.strategy.std


if __name__ == "__main__":
    from .cli.app import main

    main("snes")
