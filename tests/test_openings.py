"""Openings: other ways to begin a swing-up, tried and learned; and what is retained meanwhile."""

import dataclasses
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, refused, shipped_network, task_of
from training_runs import arrays_of, result_of, rows_of

from jaxpend import openings, retention
from jaxpend.boards import task_of as any_task
from jaxpend.config import (
    GradientConfig,
    Objective,
    OpeningsConfig,
    SACConfig,
    SNESConfig,
    TrainRun,
)
from jaxpend.gradient import Contest, Gradient
from jaxpend.openings import Opened, Openings, chosen, explore, grid, learn
from jaxpend.retention import change, retained
from jaxpend.rollout import rollout
from jaxpend.scenario import Scenario
from jaxpend.score import nominal
from jaxpend.train.interrupt import Stopped
from jaxpend.train.loop import stages_of, train
from jaxpend.train.seed_run import all_finite

KEY = jax.random.key(0)
TASK = task_of("pendubot")
SMALL = OpeningsConfig(count=1, longest=0.1, rounds=1, updates=1, retained_after=9.0)


@pytest.fixture(autouse=True)
def compiled_anew(monkeypatch):
    """What was compiled with other constants is not used again."""
    yield
    for function in (retained, explore, learn):
        function.clear_cache()


def remembering():
    """The shipped network, which sees two past states and actions too and does not heed them."""
    policy = shipped_network()
    (kernel, bias), *others = policy.layers
    view = dataclasses.replace(policy.observation, history=2)
    kernel = jnp.concatenate([kernel, jnp.zeros((view.size - len(kernel), kernel.shape[1]))])
    return policy.replace(layers=((kernel, bias), *others), observation=view)


def test_what_a_policy_does_where_it_stands_is_retained(monkeypatch):
    monkeypatch.setattr(retention, "SHOWN", 12)
    start = shipped_network()
    kept = retained(start, 9.0, TASK)
    assert kept.obs.shape == (12 * 25, start.observation.size)
    stands = np.asarray(kept.counts).reshape(12, 25)
    assert (stands == stands[:, :1]).all()
    assert 0 < stands[:, 0].sum() < 12
    # Where it stands, cos theta1 is -1 and cos theta2 is 1.
    up = np.asarray(kept.obs).reshape(12, 25, -1)[stands[:, 0] == 1]
    cosines = sorted(np.abs(up[:, -1]).mean(0))[-2:]
    np.testing.assert_allclose(cosines, 1.0, atol=0.05)
    same = change(start, kept, KEY)
    other = start.replace(layers=jax.tree.map(lambda leaf: 1.1 * leaf, start.layers))
    assert same < 1e-9 < 1e-5 < change(other, kept, KEY)
    # What fell counts nothing.
    fell = kept.replace(action=kept.action + jnp.where(kept.counts == 0, 1.0, 0.0))
    assert change(start, fell, KEY) < 1e-9


def test_after_an_opening_a_policy_goes_on_by_itself():
    policy = remembering()
    opened = Opened(policy, jnp.asarray(-0.4), jnp.asarray(0.1))
    run = rollout(TASK.plant, opened, KEY, duration=0.3)
    torque, limit = run.u_command[:, TASK.joint], float(policy.torque_limit)
    np.testing.assert_allclose(torque[:50], -0.4 * limit, rtol=1e-6)
    assert (run.u_command[:, 1 - TASK.joint] == 0).all()
    # The same policy, from the state in which the opening leaves it.
    alone = rollout(Scenario(TASK.plant, run.x[50]), policy, KEY, duration=0.2)
    assert_close(alone.x, run.x[50:])
    # It remembers the opening as its own action: just after it, and no more two periods later.
    obs = retention.seen(opened, run, KEY)
    assert obs.shape == (150, policy.observation.size)
    periods = round(policy.control_dt / 0.002)
    acted = [np.isclose(obs[k], -0.4, atol=1e-6).sum() for k in (50, 50 + 2 * periods)]
    assert acted == [2, 0]


def test_openings_are_of_either_sign_and_none_is_nothing():
    shares, times = grid(OpeningsConfig(longest=1.2))
    assert len(shares) == len(times) == len(set(zip(shares, times, strict=True))) == 480
    np.testing.assert_allclose([shares.min(), np.abs(shares).min(), shares.max()], [-1, 0.1, 1])
    np.testing.assert_allclose([times.min(), times.max()], [0.05, 1.2])


def test_explored_with_the_smoothness_of_the_policy_itself(monkeypatch):
    monkeypatch.setattr(openings, "SHARES", np.array([0.1, 0.5]))
    monkeypatch.setattr(openings, "TIMES", np.array([1.0]))
    policy, config = shipped_network(), dataclasses.replace(SMALL, longest=0.042)
    c, scores = explore(config, policy, TASK)
    own = nominal(policy, TASK)
    for i, share in enumerate((0.1, 0.5)):
        run = nominal(Opened(policy, jnp.asarray(share), jnp.asarray(0.042)), TASK)
        assert_close(c.swingup_time[i], run.swingup_time)
        assert float(run.tau_smoothness) != float(own.tau_smoothness)
        smooth = TASK.score(run.replace(tau_smoothness=own.tau_smoothness))
        np.testing.assert_allclose(scores[i], smooth, atol=1e-5)


@pytest.mark.parametrize(
    ("count", "own", "found"),
    [(9, 1.0, [4, 2, 3, 0]), (1, 1.0, [4]), (9, 2.0, [1, 4, 0]), (2, 10.0, [1, 4]), (0, 1.0, [])],
)
def test_the_best_that_differ_are_learned(count, own, found):
    times = np.array([2.5, 1.1, 1.2, 1.99, 1.4, 5.0])
    scores = np.array([0.4, 0.9, 0.5, 0.45, 0.8, 0.0])
    assert chosen(times, scores, own, count) == found


def test_a_policy_learns_to_begin_as_with_an_opening():
    policy = shipped_network()
    config = OpeningsConfig(longest=0.3, rounds=3, updates=200, retained_after=9.0)
    opened = Opened(policy, jnp.asarray(-0.4), jnp.asarray(0.3))
    found = learn(config, opened, TASK, KEY)

    def torques(controller):
        run = rollout(TASK.plant, controller, KEY, duration=0.3)
        return np.asarray(run.u_command[:, TASK.joint])

    wanted, before, after = map(torques, (opened, policy, found))
    assert np.abs(after - wanted).mean() < 0.2 * np.abs(before - wanted).mean()
    kept = retained(policy, 9.0, TASK)
    assert change(found, kept, KEY) < 1e-3
    without = dataclasses.replace(config, retention=0.0)
    assert change(found, kept, KEY) < 0.5 * change(learn(without, opened, TASK, KEY), kept, KEY)


def test_all_that_tried_go_on_and_what_they_learned_beside_them(monkeypatch):
    """What a policy is worth is its last bias here; what is learned is worth 1 more."""

    def bias(policy):
        return round(float(policy.layers[-1][1][0] - shipped_network().layers[-1][1][0]), 3)

    def learned(self, opened, key):
        *hidden, (kernel, last) = opened.policy.layers
        return opened.policy.replace(layers=(*hidden, (kernel, last + 1)))

    monkeypatch.setattr(Openings, "learned", learned)
    monkeypatch.setattr(Openings, "compared", lambda self, policy: (0.1, bias(policy)))
    ways = iter([[3], [], [5]])
    monkeypatch.setattr(openings, "chosen", lambda *rest: next(ways))
    criteria = nominal(shipped_network(), TASK)
    every = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (480,)), criteria)
    scores = jnp.linspace(0, 0.9, 480)
    monkeypatch.setattr(openings, "explore", lambda *rest, task: (every, scores))
    run = TrainRun(openings=SMALL, sac=SACConfig(contestants=3), snes=SNESConfig(generations=0))
    run = dataclasses.replace(run, gradient=GradientConfig(steps=8))
    stage = Openings.of(run, shipped_network(), TASK)
    before = tuple(shipped_network(bias=b) for b in (0.3, 0.2, 0.1))
    state = stage.start(0, before)
    row, [(first, worth)] = stage.judge(state, {})
    assert (bias(first), worth, row) == (0.3, 0.3, {"score": 0.1})
    said = []
    while stage.done(state) < stage.total:
        [(state, row)] = stage.advance([state])
        row, candidates = stage.judge(state, row)
        best = round(candidates[0][1], 3)
        said.append((stage.done(state), row["learned"], best, len(candidates)))
    assert said == [(1, 1, 1.3, 2), (2, 0, 1.3, 3), (3, 1, 1.3, 5)]
    *after, nothing = stage.outcome(state, None)
    assert [bias(policy) for policy in after] == [1.3, 1.1, 0.3, 0.2, 0.1]
    assert not any(leaf.any() for leaf in jax.tree.leaves(nothing.layers))
    contest = Gradient.of(run, shipped_network(), TASK)
    assert (type(contest), contest.contestants) == (Contest, 6)


def test_the_stage_is_there_where_something_is_learned():
    config = TrainRun(openings=SMALL, snes=SNESConfig(generations=0))
    assert list(stages_of(config, None, TASK)) == ["sac", "openings"]
    assert list(stages_of(TrainRun(snes=SNESConfig(generations=0)), None, TASK)) == ["sac"]


def test_one_policy_tries_and_learns(monkeypatch):
    monkeypatch.setattr(openings, "APART", 0.001)  # another time, however near, is another way
    stage = Openings(SMALL, Objective(), shipped_network(), TASK, 1)
    state = stage.start(0, shipped_network())  # of SAC without contestants

    def forms(tree):
        return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)

    assert forms(stage.like()) == forms(state)
    [(after, row)] = stage.advance([state])
    assert (stage.done(after), row["learned"]) == (1, 1)
    assert abs(row["share"]) in np.abs(openings.SHARES)
    assert np.isfinite(after.worths).all()
    assert stage.note(row).startswith("score 0.69")
    again = stage.advance([state])[0][0]
    jax.tree.map(np.testing.assert_array_equal, after.policies, again.policies)
    # With another key it learns from other runs.
    other = stage.advance([stage.rekey(state, 1)])[0][0]
    assert not np.array_equal(other.policies[1].layers[0][0], after.policies[1].layers[0][0])


def test_what_diverged_is_not_learned(monkeypatch):
    monkeypatch.setattr(openings, "APART", 0.001)
    spoilt = shipped_network(bias=np.nan)
    monkeypatch.setattr(Openings, "learned", lambda *rest: spoilt)
    stage = Openings(SMALL, Objective(), shipped_network(), TASK, 1)
    [(state, row)] = stage.advance([stage.start(0, shipped_network())])
    assert row["learned"] == 0
    assert stage.note(row).endswith("no other way found")
    assert all_finite(stage.watched(state))


def test_a_run_that_is_stopped_between_two_policies_ends_as_one_that_is_not(tmp_path, monkeypatch):
    monkeypatch.setattr(openings, "APART", 0.001)
    sac = SACConfig(
        steps=8, num_envs=4, contestants=2, eval_every=4, replay_capacity=64, actor_hidden=(4,),
        critic_hidden=(4,),
    )  # fmt: skip
    run = TrainRun(sac=sac, openings=SMALL, snes=SNESConfig(generations=0), runs=str(tmp_path))
    shipped = shipped_network()
    monkeypatch.setattr("jaxpend.sac.algorithm.greedy_policy", lambda *rest: shipped)
    whole = train(dataclasses.replace(run, run="whole"))
    looks = iter([None, None, None, Stopped(signal.SIGINT)])

    def look(agreed):
        if (now := next(looks, None)) is not None:
            raise now

    monkeypatch.setattr("jaxpend.train.loop.stop_if_asked", look)
    halves = dataclasses.replace(run, run="halves")
    with pytest.raises(Stopped, match="stopped in Openings at 1 of 2 policies"):
        train(halves)
    train(halves)
    assert result_of(tmp_path / "halves") == result_of(tmp_path / "whole")
    assert rows_of(tmp_path / "halves") == rows_of(tmp_path / "whole")
    rows = rows_of(tmp_path / "whole", "openings")
    assert [row["policies"] for row in rows] == [0, 1, 2]
    assert [row.get("learned") for row in rows] == [None, 1, 1]
    assert whole["score"] == whole["openings"]["score"] > 0.6
    one, other = (arrays_of(tmp_path / name / "policy.npz") for name in ("whole", "halves"))
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])


def test_openings_are_of_runs_that_a_v2_score_judges():
    thrown = any_task("pendubot", "", "", "v3", "identified")
    with refused("openings are compared by the v2 score of the nominal plant"):
        Openings(SMALL, Objective(), shipped_network(), thrown, 1)
    late = dataclasses.replace(SMALL, retained_after=10.0)
    with refused("openings.retained_after is 10.0 s; it must be less than the 10 s of a run"):
        Openings(late, Objective(), shipped_network(), TASK, 1)
    long = dataclasses.replace(SMALL, longest=9.5)
    with refused("openings.longest is 9.5 s; it must be at most 9.4 s, 0.6 s less than a run"):
        Openings(long, Objective(), shipped_network(), TASK, 1)
    with refused("count is 101; it must be at most 100", start=""):
        OpeningsConfig(count=101)
