"""Separable natural evolution strategy on a controller's parameters against the official score.

SNES (Wierstra et al., "Natural evolution strategies", JMLR 2014; evosax) starts from a trained
policy, or from any other controller that declares what may be searched
(``controllers/search_space.py``). The fitness of an individual is its score in the task (10 s at
500 Hz on the v2 boards), averaged over rollouts in which a policy's greedy action is un-squashed,
disturbed by Gaussian noise and squashed again (Calì et al., 2024), so that what is found stands
on wide ground. All individuals of a generation meet the same noise: common random numbers make
the comparison fair. Other strategies of evosax stand behind the same options.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from evosax import algorithms

from . import config
from .boards import Task
from .config import SNESConfig
from .controller import Controller, check_controller
from .controllers.policy import change_policies
from .controllers.search_space import coordinates
from .pytree import pytree
from .score import imperfect, performance

__all__ = [
    "SNESConfig",
    "SNESState",
    "best_controller",
    "evolve",
    "fitness",
    "init",
    "mean_controller",
]

STRATEGIES = {name: getattr(algorithms, kind) for name, kind in config.STRATEGIES.items()}


@pytree
class SNESState:
    """Everything that the search changes."""

    strategy: Any  # evosax state: mean and std, in units of ``_Search``, generation counter
    key: jax.Array
    best: jax.Array  # (parameters,) best individual by noisy fitness
    best_fitness: jax.Array  # () its noisy fitness, a score
    diverged: jax.Array  # () int, rollouts that were not finite, so far


def fitness(
    config: SNESConfig, controller: Controller, key: jax.Array, task: Task
) -> tuple[jax.Array, jax.Array]:
    """Fitness of a controller, to be maximised, and how many of its rollouts diverged.

    The mean score of the task over noisy nominal rollouts; with ``config.scenarios``, its
    weighted mean with the mean score over random imperfect scenarios of the task.
    """
    plant = task.plant
    key_noise, key_scenarios = jax.random.split(key)
    noise = jnp.asarray(config.action_noise, jnp.float32) if config.action_noise else None
    noisy, policies = change_policies(controller, lambda p: p.replace(action_noise=noise))
    draws = policies and config.action_noise
    keys = jax.random.split(key_noise, config.rollouts if draws else 1)
    c = jax.vmap(lambda k: performance(noisy, plant, k, task))(keys)
    score, diverged = task.score(c).mean(), jnp.sum(c.diverged)
    if not config.scenarios:
        return score, diverged
    c = imperfect(controller, task, key_scenarios, config.scenarios)
    weight = config.scenario_weight
    score = (1 - weight) * score + weight * task.score(c).mean()
    return score, diverged + jnp.sum(c.diverged)


class _Search:
    """The strategy of a configuration on the coordinates of a controller.

    Only SNES takes a standard deviation for each coordinate. The others search in units of it:
    coordinate = ``unit`` z.
    """

    def __init__(self, config: SNESConfig, controller: Controller):
        flat, weights, self._rebuild = coordinates(controller, config.searched)
        std = jnp.where(weights, config.sigma, config.gain_sigma).astype(flat.dtype)

        def shrunk(generation):
            return config.final_sigma ** (generation / config.generations)

        # Its mean moves by a tenth of sigma a generation; its sigma follows a schedule only.
        options = {"optimizer": optax.adam(0.1), "std_schedule": shrunk}
        options = options if config.strategy == "open_es" else {}
        self.decay = 1.0 if options else config.final_sigma ** (1.0 / config.generations)
        per_coordinate = config.strategy == "snes"
        self.unit = jnp.ones((), flat.dtype) if per_coordinate else std
        self.start = flat / self.unit
        kind = STRATEGIES[config.strategy]
        self.strategy = kind(population_size=config.population, solution=flat, **options)
        with jax.ensure_compile_time_eval():  # LM-MA-ES turns a number of vectors into an int
            self.params = self.strategy.default_params
        if hasattr(self.params, "std_init"):
            first = std if per_coordinate else jnp.ones((), flat.dtype)
            self.params = self.params.replace(std_init=first)

    def rebuild(self, z: jax.Array) -> Controller:
        """The controller at ``z``."""
        return self._rebuild(self.unit * z)


def init(config: SNESConfig, controller: Controller, key: jax.Array) -> SNESState:
    """Search distribution centred on the controller; ``key`` is consumed.

    Raises ``JaxpendError`` as ``check_controller`` and ``search_space.kinds``.
    """
    check_controller(controller)
    search = _Search(config, controller)
    key, key_init = jax.random.split(key)
    state = search.strategy.init(key_init, search.start, search.params)
    state = SNESState(state, key, search.start, jnp.asarray(-jnp.inf), jnp.zeros((), jnp.int32))
    # Weak types would be strong after the first chunk, and ``evolve`` compiled a second time.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf)), state)


@partial(jax.jit, static_argnames=("config", "generations", "task"))
def evolve(
    config: SNESConfig,
    start: Controller,
    state: SNESState,
    generations: int,
    task: Task,
) -> tuple[SNESState, dict[str, jax.Array]]:
    """Run some generations; returns the state and per-generation metrics (generations,).

    ``start`` is what ``init`` got: the origin of the coordinates, and all that is not searched.
    """
    search = _Search(config, start)
    strategy, params = search.strategy, search.params

    def generation(state, _):
        key, key_ask, key_noise, key_tell = jax.random.split(state.key, 4)
        population, inner = strategy.ask(key_ask, state.strategy, params)
        scores, diverged = jax.vmap(lambda p: fitness(config, search.rebuild(p), key_noise, task))(
            population
        )
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


if __name__ == "__main__":
    from .cli.app import main

    main("snes")
