"""What does not depend on the machine: how often programs are compiled, and what a chunk copies."""

import contextlib
from functools import partial

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import shipped_network, task_of

from jaxpend import gradient, snes
from jaxpend.config import GradientConfig, SACConfig, SNESConfig
from jaxpend.sac import algorithm
from jaxpend.sac.stage import SAC
from jaxpend.scenario import Scenario
from jaxpend.score import nominal, official
from jaxpend.sweep import sweep
from jaxpend.variations import vary

COMPILED = "/jax/core/compile/backend_compile_duration"
KEY, TASK = jax.random.key(0), task_of("pendubot")
SMALL = SACConfig(
    num_envs=16, warmup_steps=64, batch_size=32, replay_capacity=512, steps=4096, eval_every=320,
    actor_hidden=(8,), critic_hidden=(8,),
)  # fmt: skip


@contextlib.contextmanager
def compilations():
    """Inside, the list holds an entry for every program that is compiled or read from disk."""
    found = []

    def heard(event, seconds, **_):
        if event == COMPILED:
            found.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)


def swept(low):
    scenarios = vary(Scenario(TASK.plant), {"m2": np.linspace(low, 0.64, 5)}, key=KEY)
    return sweep(scenarios, shipped_network(low), KEY, duration=0.1).x


def generations(seed):
    config = SNESConfig(generations=4, population=4, searched="weights")
    start = shipped_network(seed)
    state = snes.init(config, start, jax.random.key(seed))  # evosax compiles that for every search
    return lambda: snes.evolve(config, start, state, 1, TASK)


def ascent(seed):
    config = GradientConfig(steps=4, duration=0.1)
    start = shipped_network(seed)
    state = gradient.init(config, start, jax.random.key(seed), TASK)
    return gradient.improve(config, start, state, 1, TASK)


def trained(stage, seed):
    return algorithm.train_chunk(stage.agent, stage.start(seed, None), 2)


@pytest.mark.parametrize(
    "call",
    [
        partial(partial, swept),
        generations,
        partial(partial, ascent),
        partial(partial, trained, SAC(SMALL, TASK)),
        lambda seed: partial(nominal, shipped_network(seed), TASK),
        lambda seed: partial(official, shipped_network(seed), "pendubot"),
    ],
    ids=["sweep", "SNES", "gradient", "SAC", "nominal", "official"],
)
def test_what_was_computed_once_is_not_compiled_again(call):
    one, other = call(0), call(1)
    with compilations() as first:
        jax.block_until_ready(jax.jit(lambda: jnp.zeros(3) + 1)())
    assert first  # it is heard
    jax.block_until_ready(one())
    with compilations() as again:
        jax.block_until_ready(other())
    assert not again


def test_a_chunk_of_sac_gives_back_no_more_than_it_was_given():
    """Nothing is donated, so that a run that diverged has a way back; no more than one copy."""
    stage = SAC(SMALL, TASK)
    state = stage.start(0, None)
    held = sum(leaf.nbytes for leaf in jax.tree.leaves(jax.tree.map(jnp.asarray, state)))
    memory = algorithm.train_chunk.lower(stage.agent, state, 2).compile().memory_analysis()
    assert memory.argument_size_in_bytes <= 1.05 * held
    assert memory.output_size_in_bytes <= 1.05 * held
