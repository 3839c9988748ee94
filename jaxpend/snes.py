"""Separable natural evolution strategy on a policy's parameters against the official score.

SNES (Wierstra et al., "Natural evolution strategies", JMLR 2014; evosax) starts from a trained
policy. The fitness of an individual is its official v2 score (10 s at 500 Hz), averaged over
rollouts whose greedy action is un-squashed, disturbed by Gaussian noise and squashed again
(Calì et al., 2024), so that what is found stands on wide ground. All individuals of a
generation meet the same noise: common random numbers make the comparison fair.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from evosax.algorithms import SNES
from jax.flatten_util import ravel_pytree

from . import designs
from ._struct import pytree
from .config import SNESConfig
from .controllers.policy import Policy
from .randomisation import LONGEST_DELAY, sample
from .score import performance, score_v2

__all__ = ["SNESConfig", "SNESState", "evolve", "fitness", "init"]


@pytree
class SNESState:
    """Everything that the search changes."""

    strategy: Any  # evosax state: mean and std (parameters,), generation counter
    key: jax.Array
    best: jax.Array  # (parameters,) best individual by noisy fitness
    best_fitness: jax.Array  # () its noisy fitness, a score
    diverged: jax.Array  # () int, rollouts that were not finite, so far


def split_parameters(config: SNESConfig, policy: Policy):
    """The searched parameters as a flat vector, and the function that puts them back."""
    kept = policy.layers[-1:] if config.searched == "hidden" else ()
    searched = policy.layers[: len(policy.layers) - len(kept)]
    flat, unravel = ravel_pytree(searched)
    return flat, lambda vector: policy.replace(layers=(*unravel(vector), *kept))


def fitness(config: SNESConfig, policy: Policy, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Fitness of a policy, to be maximised, and how many of its rollouts diverged.

    The mean v2 score over noisy nominal rollouts; with ``config.scenarios``, its weighted mean
    with the mean v2 score over random imperfect scenarios (``randomisation.sample``).
    """
    plant = designs.competition(policy.robot)
    key_noise, key_scenario, key_run = jax.random.split(key, 3)
    noise = jnp.asarray(config.action_noise, jnp.float32) if config.action_noise else None
    noisy = policy.replace(action_noise=noise)
    keys = jax.random.split(key_noise, config.rollouts if config.action_noise else 1)
    c = jax.vmap(lambda k: performance(noisy, plant, k))(keys)
    # A diverged rollout has score 0 already; its velocity says that it diverged.
    score, diverged = score_v2(c).mean(), jnp.sum(~jnp.isfinite(c.velocity_cost))
    if not config.scenarios:
        return score, diverged
    wrong = jax.vmap(lambda k: sample(plant, k))(jax.random.split(key_scenario, config.scenarios))
    keys = jax.random.split(key_run, config.scenarios)
    slots = LONGEST_DELAY + 1
    c = jax.vmap(lambda s, k: performance(policy, s, k, delay_slots=slots))(wrong, keys)
    weight = config.scenario_weight
    score = (1 - weight) * score + weight * score_v2(c).mean()
    return score, diverged + jnp.sum(~jnp.isfinite(c.velocity_cost))


def _strategy(config: SNESConfig, policy: Policy):
    flat, rebuild = split_parameters(config, policy)
    return SNES(population_size=config.population, solution=flat), flat, rebuild


def init(config: SNESConfig, policy: Policy, key: jax.Array) -> SNESState:
    """Search distribution centred on the policy."""
    strategy, flat, _ = _strategy(config, policy)
    key, key_init = jax.random.split(key)
    params = strategy.default_params.replace(std_init=jnp.asarray(config.sigma, flat.dtype))
    state = strategy.init(key_init, flat, params)
    return SNESState(state, key, flat, jnp.asarray(-jnp.inf), jnp.zeros((), jnp.int32))


@partial(jax.jit, static_argnames=("config", "generations"))
def evolve(config: SNESConfig, policy: Policy, state: SNESState, generations: int):
    """Run some generations; returns the state and per-generation metrics (generations,).

    ``policy`` gives the parameters that are not searched, and the form of those that are.
    """
    strategy, _, rebuild = _strategy(config, policy)
    params = strategy.default_params
    decay = config.final_sigma ** (1.0 / config.generations)

    def generation(state, _):
        key, key_ask, key_noise, key_tell = jax.random.split(state.key, 4)
        population, inner = strategy.ask(key_ask, state.strategy, params)
        scores, diverged = jax.vmap(lambda p: fitness(config, rebuild(p), key_noise))(population)
        # The one place that negates: evosax minimises.
        inner, _ = strategy.tell(key_tell, population, -scores, inner, params)
        inner = inner.replace(std=inner.std * decay)
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
        return state, metrics | {"sigma": inner.std.mean()}

    return jax.lax.scan(generation, state, length=generations)


def mean_policy(config: SNESConfig, policy: Policy, state: SNESState) -> Policy:
    """The policy at the centre of the search distribution."""
    return split_parameters(config, policy)[1](state.strategy.mean)


def best_policy(config: SNESConfig, policy: Policy, state: SNESState) -> Policy:
    """The individual with the best noisy fitness so far."""
    return split_parameters(config, policy)[1](state.best)


if __name__ == "__main__":
    from .config import SNESRun
    from .train import command

    command(SNESRun, "jaxpend.snes", "SNES on the official score, from a policy file.")
