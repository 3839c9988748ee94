"""Stages: what candidates are compared by, and that a new stage is one class."""

import dataclasses
import json
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused, shipped_network
from training_runs import events_of, rows_of

from jaxpend import Policy, save_policy, stage
from jaxpend.boards import v2
from jaxpend.config import (
    DemonstrationConfig,
    GradientConfig,
    GuardConfig,
    Objective,
    SACConfig,
    SACRun,
    SNESConfig,
    SNESRun,
    TrainRun,
)
from jaxpend.config_files import load_config
from jaxpend.gradient import Contest, Gradient
from jaxpend.pytree import Pytree, pytree
from jaxpend.report import page
from jaxpend.runs.reader import find, listing, remarks
from jaxpend.sac.stage import SAC, Contestants, chunk_length
from jaxpend.score import Criteria, nominal, score_v2
from jaxpend.snes import SNES
from jaxpend.train import train
from jaxpend.train.interrupt import Stopped
from jaxpend.train.loop import stages_of

TASK = v2("pendubot").task


def stands(count):
    return jnp.arange(count) % 8 == 0


@pytest.fixture
def met(monkeypatch):
    """How many scenarios were met; three of four of them end with score 1, the others with 0."""
    counts = []

    def imperfect(controller, task, key, count):
        counts.append(count)
        return Criteria(*jnp.zeros((9, count)), success=jnp.arange(count) % 4 > 0), stands(count)

    monkeypatch.setattr(stage, "imperfect", imperfect)
    stage._validated.clear_cache()
    yield counts
    stage._validated.clear_cache()


@pytest.mark.parametrize(
    ("kind", "config"),
    [
        (Gradient, GradientConfig(scenarios=2, objective=Objective(0.25, validation=8))),
        (Gradient, GradientConfig()),
        (SNES, SNESConfig(population=2, action_noise=0.0)),
    ],
)
def test_candidates_are_compared_by_score_and_by_scenarios_that_stay_the_same(met, kind, config):
    policy = shipped_network()
    search = kind(config, policy, TASK)
    row, candidates = search.judge(search.start(0, policy), {})
    expected = score = float(score_v2(nominal(policy, TASK)))
    if config.scenarios:
        expected = 0.75 * score + 0.25 * 0.75
    assert met == ([8] if config.scenarios else [])
    for _, worth in candidates:
        np.testing.assert_allclose(worth, expected, rtol=1e-5)
    found = row["score"] if kind is Gradient else row["mean_score"]
    np.testing.assert_allclose(found, score, rtol=1e-5)


def test_what_becomes_of_scenarios_counts_as_much_as_the_objective_says(met):
    for outcome, mean in (("score", 0.75), ("success", 0.125)):
        found = stage.value(Objective(0.25, outcome), None, 0.5, TASK)
        np.testing.assert_allclose(found, 0.75 * 0.5 + 0.25 * mean, rtol=1e-6)
    assert stage.value(Objective(), None, 0.5, TASK) == 0.5
    assert met == [256, 256]


def test_the_best_policy_of_sac_is_that_of_its_objective(met):
    config = SACConfig(num_envs=1, actor_hidden=(4,), objective=Objective(0.5, "success", 16))
    search = SAC(config, TASK)
    row, [(_, worth)] = search.judge(search.start(0, None), {})
    assert row["score"] == 0  # an untrained policy does not stand
    np.testing.assert_allclose([worth, row["value"]], 0.5 * 0.125, rtol=1e-6)
    assert met == [16]


def test_every_stage_of_a_recipe_that_looks_at_scenarios_says_by_what_it_compares():
    stages = stages_of(load_config(TrainRun(), "pendubot"), None, TASK)
    assert list(stages) == ["sac", "openings", "gradient", "snes"]
    assert all(found.objective.outcome == "success" for found in stages.values())
    assert all(found.objective.weight for found in stages.values())


# --- a new stage ---------------------------------------------------------------------------


@pytree
class Scale(Pytree):
    """How often the policy has been changed, and the policy."""

    policy: Policy
    done: jax.Array
    key: jax.Array


class Shrinking(stage.Stage[Policy, Scale, Policy]):
    """A stage that nobody else knows: weights shrink, which makes a good policy worse."""

    name, title, unit, column = "shrinking", "Shrinking", "rounds", "round"
    heading, scores = "after shrinking", ("judged",)
    charts = (stage.Chart("Judgement", {"best so far": "best", "now": "judged"}, "v2 score"),)
    total = 3

    def __init__(self, policy, task):
        self.policy, self.task = policy, task

    @classmethod
    def of(cls, run, start, task):
        return cls(start, task) if hasattr(run, "snes") else None

    def start(self, seed, before):
        return Scale(before, jnp.asarray(0), jax.random.key(seed))

    def like(self):
        return jax.eval_shape(lambda policy: self.start(0, policy), self.policy)

    def policy_like(self):
        return self.policy

    def done(self, state):
        return int(state.done)

    def advance(self, states):
        shrunk = [jax.tree.map(lambda leaf: 0.9 * leaf, state.policy) for state in states]
        return [
            (state.replace(policy=policy, done=state.done + 1), {"size": jnp.asarray(0.9)})
            for state, policy in zip(states, shrunk, strict=True)
        ]

    def judge(self, state, metrics):
        score = float(self.task.score(nominal(state.policy, self.task)))
        return {"judged": score, **metrics}, [(state.policy, score)]

    def note(self, row):
        return f"judged {row['judged']:.2f}"

    def watched(self, state):
        return state.policy

    def outcome(self, state, best):
        return best


def test_a_new_stage_is_one_class(tmp_path, monkeypatch, capfd):
    """It is trained, resumed, listed, reported and in TensorBoard, and no table knows it."""
    save_policy(tmp_path / "start.npz", shipped_network())
    run = SNESRun(policy=str(tmp_path / "start.npz"), runs=str(tmp_path / "runs"), run="new")
    run = dataclasses.replace(run, tensorboard=True)
    looks = iter([None, None, Stopped(signal.SIGINT)])

    def look(agreed):
        if (now := next(looks, None)) is not None:
            raise now

    monkeypatch.setattr("jaxpend.train.loop.stop_if_asked", look)
    with pytest.raises(Stopped, match="stopped in Shrinking at 2 of 3 rounds"):
        train(run, kinds=(Shrinking,))
    (entry,) = listing(tmp_path / "runs")
    assert (entry["stages"], entry["at"]) == (["shrinking"], "Shrinking 2/3")
    result = train(run, kinds=(Shrinking,))
    assert result["shrinking"]["score"] == result["score"] > 0.5
    said = capfd.readouterr().err.replace("\n", " ")
    assert f"best {result['score']:.4f}, kept since 0" in said
    folder = tmp_path / "runs" / "new"
    # TensorBoard has what the metrics have, over the column of the stage.
    rows = rows_of(folder)
    assert [row["round"] for row in rows] == [1, 2, 3]
    steps = [step for tag, step, _ in events_of(folder) if tag == "shrinking/judged"]
    assert steps == [1, 2, 3]
    (found,) = find(folder)
    assert list(found.results) == ["start", "after shrinking"]
    assert found.policy == str(folder / "policy.npz")
    assert remarks([found]) == []
    text = page.write([found], folder, title="new", robustness=False).read_text()
    for words in ("<h3>Shrinking</h3>", "Shrinking: Judgement", "after shrinking"):
        assert words in text


def test_progress_says_whether_the_best_is_new(tmp_path, capfd):
    save_policy(tmp_path / "start.npz", shipped_network())
    run = SNESRun(policy=str(tmp_path / "start.npz"), runs=str(tmp_path), run="growing")

    class Growing(Shrinking):
        def advance(self, states):
            return [(s.replace(done=s.done + 1), {"size": jnp.asarray(1.0)}) for s in states]

        def judge(self, state, metrics):
            row, _ = super().judge(state, metrics)
            return row, [(state.policy, min(self.done(state), 2) / 10)]

    train(run, kinds=(Growing,))
    said = [line for line in capfd.readouterr().err.splitlines() if line.startswith("Shrinking ")]
    notes = [line.partition("  best ")[2] for line in said]
    assert notes == ["0.1000, improved", "0.2000, improved", "0.2000, kept since 2"]


def test_a_plant_file_that_has_changed_makes_another_run(tmp_path):
    save_policy(tmp_path / "start.npz", shipped_network())
    plant, parameters = tmp_path / "plant.json", dict(TASK.parameters)
    plant.write_text(json.dumps(parameters))
    run = SNESRun(policy=str(tmp_path / "start.npz"), runs=str(tmp_path), run="heavy")
    run = dataclasses.replace(run, plant=str(plant))
    train(run, kinds=(Shrinking,))
    folder = tmp_path / "heavy"
    assert json.loads((folder / "run.json").read_text())["plant"] == parameters
    (folder / "result.json").unlink()
    moved = plant.rename(tmp_path / "moved.json")
    train(dataclasses.replace(run, plant=str(moved)), kinds=(Shrinking,))  # the same plant
    name = next(iter(parameters))
    moved.write_text(json.dumps(parameters | {name: 2 * parameters[name]}))
    with refused(f"{folder} holds a run with plant.{name} {parameters[name]}, not"):
        train(dataclasses.replace(run, plant=str(moved)), kinds=(Shrinking,))


def test_chunks_are_of_one_length_where_they_can_be():
    assert chunk_length(12_500, 781) == 625  # the shipped recipes: not 781 and a rest of four
    assert chunk_length(18_750, 250) == 250
    assert chunk_length(12, 4) == 4
    assert chunk_length(3, 8) == 8  # less than a chunk in all: ``advance`` makes it shorter
    assert chunk_length(10_007, 100) == 100  # a prime: the last one is shorter
    assert chunk_length(5, 1) == 1


# --- contests ------------------------------------------------------------------------------


def test_the_best_policy_of_each_part_goes_on(monkeypatch):
    config = SACConfig(
        steps=16, num_envs=4, contestants=2, eval_every=4, replay_capacity=64,
        actor_hidden=(4,), critic_hidden=(4,),
    )  # fmt: skip
    worths = iter([0.1, 0.5, 0.2, 0.6, 0.6])  # at the start, then after each step
    monkeypatch.setattr("jaxpend.sac.stage.value", lambda *rest: next(worths))
    search = SAC.of(SACRun(sac=config), None, TASK)
    assert (type(search), search.total) == (Contestants, 16)

    def moved(states):
        [sac] = states
        actor = jax.tree.map(lambda leaf: leaf + 1, sac.actor)
        return [(sac.replace(actor=actor, env_steps=sac.env_steps + 4), {})]

    monkeypatch.setattr(search.inner, "advance", moved)
    state = search.start(0, None)
    search.judge(state, {})
    seen, policies = [], []
    while search.done(state) < search.total:
        [(state, row)] = search.advance([state])
        _, [(last, worth)] = search.judge(state, row)
        seen.append((search.done(state), worth))
        policies.append(last)
    assert seen == [(4, 0.5), (8, 0.2), (12, 0.6), (16, 0.6)]
    np.testing.assert_allclose(state.worths, [0.5, 0.6])
    best = search.outcome(state, None)
    first, _, _, tied = (policy.layers[0][0] for policy in policies)
    assert not np.array_equal(first, tied)
    np.testing.assert_array_equal(best[0].layers[0][0], tied)  # the later one has learned more
    np.testing.assert_array_equal(best[1].layers[0][0], first)
    # What goes on from one controller takes the best.
    after = SNES(SNESConfig(population=2), shipped_network(), TASK).start(0, best)
    np.testing.assert_array_equal(after.start.layers[0][0], tied)


def test_contestants_may_have_demonstrations():
    shown = DemonstrationConfig(episodes=1, duration=0.1)
    config = SACConfig(contestants=2, demonstrations=shown, steps=100, replay_capacity=64)
    state = Contestants(config, TASK).like()
    assert state.sac.demonstrations is not None
    assert len(state.policies) == len(state.worths) == 2


def test_a_contest_leaves_out_half_again_and_again(monkeypatch):
    """What a contestant is worth is a number that it carries."""
    policies = tuple(shipped_network(bias=b) for b in (0.3, 0.1, 0.4, 0.2))

    def bias(policy):
        return float(policy.layers[-1][1][0])

    origin = bias(shipped_network())
    config = GradientConfig(steps=8, chunk=1)
    run = TrainRun(gradient=config, sac=SACConfig(contestants=4))
    contest = Gradient.of(run, policies[0], TASK)
    assert type(contest) is Contest
    moves = []

    def search(states, count):
        moves.append(round(bias(states[0].start) - origin, 3))
        return [(states[0].search, {"smooth_score": jnp.ones(1)})]

    monkeypatch.setattr(contest.inner, "search", search)
    monkeypatch.setattr(contest.inner, "compared", lambda p: (0.0, bias(p) - origin))
    state = contest.start(0, policies)
    assert len(contest.judge(state, {})[1]) == 4
    kept = []
    while contest.done(state) < contest.total:
        moves.clear()
        [(state, row)] = contest.advance([state])
        row, candidates = contest.judge(state, row)
        assert row["contestants"] == len(moves) == len(candidates)
        np.testing.assert_allclose(candidates[0][1], 0.4, atol=1e-5)
        kept.append(sorted(moves))
    assert kept == [[0.1, 0.2, 0.3, 0.4]] * 2 + [[0.3, 0.4]] * 2 + [[0.4]] * 4


@pytest.mark.parametrize(("contestants", "kept"), [(2, "2211"), (3, "3221"), (5, "5321")])
def test_the_last_halving_is_in_the_middle(contestants, kept):
    contest = Contest(GradientConfig(steps=80), shipped_network(), TASK, contestants)
    times = {2: (0, 39, 40, 79), 3: (0, 20, 39, 40), 5: (9, 10, 20, 40)}[contestants]
    assert [contest.kept(done) for done in times] == list(map(int, kept))
    assert contest.kept(79) == 1


def test_snes_is_left_out_where_it_has_no_generations(tmp_path):
    none = SNESConfig(generations=0)
    assert SNES.of(TrainRun(snes=none), shipped_network(), TASK) is None
    with refused("snes.generations is 0", start=""):
        SNES.of(SNESRun(snes=none), shipped_network(), TASK)
    with refused("snes.generations is 0; a guard needs some", start=""):
        TrainRun(snes=none, guard=GuardConfig(observe=True))
