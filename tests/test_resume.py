"""Runs that diverge or are stopped, alone and in a vmap, and go on; test_train.py kills one."""

import dataclasses
import json
import signal
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training_runs import arrays_of, result_of, rows_of

from jaxpend import JaxpendError, Policy, load_policy, snes
from jaxpend.boards import v2
from jaxpend.config import EnvConfig, SACConfig, SACRun, SNESConfig
from jaxpend.observation import Observation
from jaxpend.runs.checkpoints import Checkpoints
from jaxpend.sac import algorithm
from jaxpend.sac.stage import SAC
from jaxpend.snes import SNES
from jaxpend.train.interrupt import Stopped
from jaxpend.train.loop import train
from jaxpend.train.seed_run import all_finite

SMALL = SACConfig(
    steps=96, eval_every=32, num_envs=8, batch_size=32, replay_capacity=128, warmup_steps=32,
    critic_hidden=(8,), actor_hidden=(8,),
    env=EnvConfig(observation=Observation(history=2), randomised=0.5),
)  # fmt: skip


TASK = v2("pendubot").task


def poison(monkeypatch, *poisoned):
    """Let the calls of these numbers of a chunk return a temperature that is not a number."""
    chunk, calls = algorithm.train_chunk, []

    def train_chunk(agent, state, steps):
        calls.append(state)
        state, metrics = chunk(agent, state, steps)
        if len(calls) in poisoned:
            state = state.replace(log_temperature=state.log_temperature * jnp.nan)
        return state, metrics

    monkeypatch.setattr(algorithm, "train_chunk", train_chunk)
    return calls


def diverging(tmp_path, **options):
    """A run that diverges in its second chunk: why it stopped, and its rows."""
    with pytest.raises(JaxpendError) as error:
        train(SACRun(run="run", runs=str(tmp_path), sac=SMALL, **options))
    return str(error.value), rows_of(tmp_path / "run", "sac")


def test_divergence_stops_with_the_last_good_state_on_disk(tmp_path, capfd, monkeypatch):
    poison(monkeypatch, *range(2, 9))
    text, rows = diverging(tmp_path)
    unit = "environment steps"
    start = f"SAC diverged at 64 {unit}; the last good state, in SAC at 32 of 96 {unit}, is in"
    assert text.startswith(f"{start} {tmp_path / 'run' / 'checkpoints'}, the best policy beside")
    assert "--on-divergence rollback" in text
    assert [(row["env_steps"], row.get("finite", 1)) for row in rows] == [(0, 1), (32, 1), (64, 0)]
    stage = SAC(SMALL, TASK)
    found, about = Checkpoints(tmp_path / "run" / "checkpoints").newest(
        lambda about: {"state": stage.like(), "best": stage.policy_like()}
    )
    assert (int(found["state"].env_steps), about["stage"]) == (32, "sac")
    assert all_finite(found["state"])
    load_policy(tmp_path / "run" / "sac_best.npz")
    assert not (tmp_path / "run" / "result.json").exists()
    assert diverging(tmp_path) == (text, rows)  # the same again, and no row twice
    # Resumed with another answer to it: as often as it may, each time with another key.
    text, rows = diverging(tmp_path, on_divergence="rollback", max_rollbacks=2)
    assert text.startswith(start)
    assert "--on-divergence" not in text
    assert [row["rollbacks"] for row in rows if row.get("finite") == 0] == [0, 1, 2]
    said = capfd.readouterr().err
    assert said.count(f"going on in SAC at 32 of 96 {unit} with another key") == 2


def test_a_rollback_goes_on_from_the_last_chunk_with_another_key(tmp_path, monkeypatch):
    calls = poison(monkeypatch, 2)
    options = {"run": "run", "runs": str(tmp_path), "sac": SMALL, "on_divergence": "rollback"}
    assert train(SACRun(**options))["score"] >= 0
    rows = rows_of(tmp_path / "run", "sac")
    assert [(row["env_steps"], row.get("finite", 1), row["rollbacks"]) for row in rows[1:]] == [
        (32, 1, 0), (64, 0, 0), (64, 1, 1), (96, 1, 1),
    ]  # fmt: skip
    before, after = calls[1:3]
    chex.assert_trees_all_equal(before.replay, after.replay)
    assert not np.array_equal(*(jax.random.key_data(s.key) for s in (before, after)))
    assert rows[2]["reward"] != rows[3]["reward"]


@pytest.mark.parametrize(
    ("steps", "chunks"),
    [(96, [4, 4, 4]), (88, [4, 4, 3]), (65, [3, 3, 3]), (33, [4, 1]), (32, [4]), (1, [1])],
)
def test_sac_ends_at_its_budget_in_whole_steps_of_all_environments(monkeypatch, steps, chunks):
    def train_chunk(config, state, vector_steps):
        found.append(vector_steps)
        return state.replace(env_steps=state.env_steps + 8 * vector_steps), {}

    monkeypatch.setattr(algorithm, "train_chunk", train_chunk)
    found, small = [], dataclasses.replace(SMALL, steps=steps)
    stage, state = SAC(small, TASK), SimpleNamespace(env_steps=0)
    state.replace = lambda env_steps: SimpleNamespace(env_steps=env_steps, replace=state.replace)
    while stage.done(state) < stage.total:
        ((state, _),) = stage.advance([state])
    assert found == chunks
    assert stage.done(state) == 8 * sum(chunks) < steps + 8


def test_a_shorter_last_chunk_changes_nothing_before_it(tmp_path):
    for steps in (96, 88):
        train(
            SACRun(run=f"{steps}", runs=str(tmp_path), sac=dataclasses.replace(SMALL, steps=steps))
        )
    longer, shorter = (rows_of(tmp_path / run, "sac") for run in ("96", "88"))
    assert [row["env_steps"] for row in shorter] == [0, 32, 64, 88]
    assert shorter[:3] == longer[:3]


def test_seeds_in_one_vmap_stop_resume_and_come_to_what_they_come_to_alone(tmp_path, monkeypatch):
    config = SACRun(seeds=2, seed=4, run="alone", runs=str(tmp_path), sac=SMALL)
    train(config)
    together = dataclasses.replace(config, run="together", vmap="yes")
    looks = []

    def look(agreed):
        looks.append(None)
        if len(looks) == 2:
            raise Stopped(signal.SIGINT)

    monkeypatch.setattr("jaxpend.train.loop.stop_if_asked", look)
    with pytest.raises(
        Stopped, match="stopped in SAC at 32 of 96 environment steps; everything is in "
    ):
        train(together)
    assert not (tmp_path / "together" / "seeds.json").exists()
    group = train(together)
    for seed in (4, 5):
        loop, vmap = (tmp_path / run / f"seed{seed}" for run in ("alone", "together"))
        assert [row["env_steps"] for row in rows_of(loop, "sac")] == [0, 32, 64, 96]
        for a, b in zip(rows_of(loop), rows_of(vmap), strict=True):
            assert (a.keys(), a.pop("stage")) == (b.keys(), b.pop("stage"))
            np.testing.assert_allclose(list(a.values()), list(b.values()), rtol=1e-3, atol=1e-4)
        a, b = arrays_of(loop / "sac_last.npz"), arrays_of(vmap / "sac_last.npz")
        for key in a:
            np.testing.assert_allclose(a[key], b[key], rtol=1e-3, atol=1e-4)
    assert json.loads((tmp_path / "together" / "seeds.json").read_text()) == group
    assert group["seeds"] == [4, 5]
    scores = [result_of(tmp_path / "together" / f"seed{s}")["score"] for s in (4, 5)]
    assert group["stages"]["sac"]["scores"] == scores


def test_searches_in_one_vmap_come_to_what_they_come_to_alone(monkeypatch):
    def fitness(config, policy, key, task):
        distance = sum(jnp.sum((leaf - 0.1) ** 2) for leaf in jax.tree.leaves(policy.layers))
        return -distance, jnp.zeros((), jnp.int32)

    monkeypatch.setattr(snes, "fitness", fitness)
    snes.evolve.clear_cache()
    policy = Policy(((jnp.zeros((6, 1)), jnp.zeros(1)),), torque_limit=jnp.asarray(3.0))
    stage = SNES(SNESConfig(generations=6, population=4, chunk=4), policy, TASK)
    states = [stage.start(seed, policy) for seed in (1, 2)]
    loop = [stage.advance([state])[0] for state in states]
    # Of the same types as before, weak or strong, so that the next chunk is not compiled again.
    before, after = (jax.tree.map(jax.typeof, s.search) for s in (states[0], loop[0][0]))
    assert before == after
    for alone, together in zip(loop, stage.advance(states), strict=True):
        assert jax.tree.structure(alone) == jax.tree.structure(together)
        assert stage.done(alone[0]) == stage.done(together[0]) == 4
        for a, b in zip(*map(stage.watched, (alone[0], together[0])), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)
    assert not np.array_equal(*(state.search.strategy.mean for state, _ in loop))
    assert stage.done(stage.advance([loop[0][0]])[0][0]) == 6  # and not beyond the last
    snes.evolve.clear_cache()
