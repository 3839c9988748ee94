"""The robustness benchmark: its grids, its rules, and what can go wrong with a sweep."""

import csv
import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, both_precisions, both_robots, excerpt, refused, task_of
from test_policy import random_policy

from jaxpend import Scenario, cli, load_policy, save_policy
from jaxpend.boards import Board, v2
from jaxpend.cli import commands
from jaxpend.controllers import Feedback, Zero
from jaxpend.controllers.callback import PythonLaw
from jaxpend.controllers.catalogue import find_controller
from jaxpend.criteria import ScoreV3
from jaxpend.designs import competition
from jaxpend.robustness import CRITERIA, Strip, benchmark, passes, strips
from jaxpend.scenario import delay_steps, random_pulses
from jaxpend.score import official
from jaxpend.sweep import mildest_failure, survey, sweep, upright
from jaxpend.variations import VARIATIONS, vary

KEY = jax.random.key(3)
SHORT = 0.4
GAINS = np.asarray(excerpt("trajectories_pendubot")["lqr_K"], "f4")
LEANING = np.array([np.pi + 0.05, -0.03, 0, 0], "f4")


def balance(t, x):
    """The reference's LQR of the pendubot, which holds it upright."""
    off = x - jnp.array([jnp.pi, 0, 0, 0], x.dtype)
    return jnp.stack([-jnp.sum(GAINS * off), jnp.zeros_like(t)])


BALANCE = Feedback(balance)
NEAR_UPRIGHT = Scenario(competition("pendubot"), x0=LEANING)


def official_grids():
    path = Path(__file__).parent / "data" / "robustness_grid.json"
    return json.loads(path.read_text())


@pytest.mark.x64
@both_robots
def test_grids_and_counts_are_the_official_ones(robot):
    golden, rows = official_grids(), strips(competition(robot))
    for row in rows:
        if row.variation != "perturbation":
            np.testing.assert_array_equal(row.values, golden["grids"][row.variation])
    assert [r.variation for r in rows[:-1]] == [*golden["grids"]]
    names = {"responsiveness": "torque_responsiveness"}
    for criterion in CRITERIA:
        runs = sum(len(r.values) * r.repetitions for r in rows if r.criterion == criterion)
        assert runs == golden["n_simulations"][names.get(criterion, criterion)]
    assert sum(len(r.values) * r.repetitions for r in rows) == 722


def test_success_is_a_box_around_upright_with_wrapped_angles():
    inside = [[np.pi, 0, 0, 0], [np.pi + 0.34, -0.34, 0.99, -0.99], [-np.pi, 2 * np.pi, 0, 0]]
    inside += [[3 * np.pi - 0.3, -4 * np.pi + 0.3, 0, 0]]
    outside = [[np.pi + 0.36, 0, 0, 0], [np.pi, -0.36, 0, 0], [np.pi, 0, 1.0, 0]]
    outside += [[np.pi, 0, 0, -1.01], [0, 0, 0, 0], [np.pi, np.pi, 0, 0], [np.nan, 0, 0, 0]]
    assert upright(jnp.array(inside)).all()
    assert not upright(jnp.array(outside)).any()


def test_more_than_half_of_the_repetitions_must_succeed():
    np.testing.assert_array_equal(passes([0.4, 0.5, 0.6, 1.0]), [False, False, True, True])


SAMPLE_VALUES = {"delay": 0.0055, "velocity_delay": 0.02, "responsiveness": 0.7}


@pytest.mark.parametrize("name", VARIATIONS)
def test_a_variation_changes_what_it_names_and_nothing_else(name):
    base = Scenario(competition("pendubot"), measurement_noise=np.full(4, 0.3, "f4"))
    value = SAMPLE_VALUES.get(name, 0.25)
    varied = vary(base, {name: [value, 2 * value]}, key=KEY)
    before = {jax.tree_util.keystr(k): v for k, v in jax.tree_util.tree_leaves_with_path(base)}
    after = {jax.tree_util.keystr(k): v for k, v in jax.tree_util.tree_leaves_with_path(varied)}
    changed = {k for k, v in after.items() if k not in before or np.any(v != before[k])}
    first = jax.tree.map(lambda leaf: leaf[0], varied)
    plant = first.plant
    now = {
        "Ir": plant.motor_inertia, "m1r1": plant.mass[0] * plant.com[0], "I1": plant.inertia[0],
        "b1": plant.damping[0], "cf1": plant.coulomb_friction[0],
        "m2r2": plant.mass[1] * plant.com[1], "m2": plant.mass[1], "I2": plant.inertia[1],
        "b2": plant.damping[1], "cf2": plant.coulomb_friction[1], "m1": plant.mass[0],
        "l1": plant.length[0], "l2": plant.length[1], "gravity": plant.gravity,
        "velocity_noise": first.measurement_noise[2:], "process_noise": first.process_noise,
        "position_noise": first.measurement_noise[:2], "responsiveness": first.responsiveness,
        "torque_noise": None if first.torque_noise is None else first.torque_noise[0],
        "delay": None if first.delay is None else first.delay * 0.00275,
        "velocity_delay": None if first.delay is None else first.delay[2:] * 0.002,
        "perturbation": None,
    }[name]  # fmt: skip
    if now is not None:
        np.testing.assert_allclose(now, value, rtol=1e-6)
    assert len({key.split(".")[1 if "plant" not in key else 2] for key in changed}) == 1
    assert all(
        np.asarray(v).dtype == np.asarray(before[k]).dtype for k, v in after.items() if k in before
    )


def test_noise_on_velocities_keeps_that_on_positions_and_skips_passive_joints():
    base = Scenario(competition("pendubot"), measurement_noise=np.full(4, 0.3, "f4"))
    varied = vary(base, {"velocity_noise": [0.1], "torque_noise": [0.4]}, key=KEY)
    np.testing.assert_allclose(varied.measurement_noise[0], [0.3, 0.3, 0.1, 0.1])
    np.testing.assert_allclose(varied.torque_noise[0], [0.4, 0])
    steps = [delay_steps(d)[0] for d in official_grids()["grids"]["delay"]]
    delayed = vary(base, {"delay": official_grids()["grids"]["delay"]}, key=KEY).delay
    np.testing.assert_array_equal(delayed[:, 0], steps)
    assert steps == list(range(21))


def test_random_pulses_are_distributed_as_in_the_reference():
    pulses = jax.jit(jax.vmap(random_pulses))(jax.random.split(KEY, 400))
    centres = np.sort(np.asarray(pulses.time).reshape(400, 6), axis=1)
    gaps = np.diff(centres, axis=1, prepend=0.0)
    assert gaps.min() >= 1.0 - 1e-5
    assert gaps.max() <= 1.5 + 1e-5
    np.testing.assert_allclose(gaps.mean(axis=0), 1.25, atol=0.03)
    width, amplitude = np.asarray(pulses.width), np.asarray(pulses.amplitude)
    assert width.min() >= 0.05
    assert width.max() <= 0.1
    assert np.abs(amplitude).min() >= 0.5
    assert np.abs(amplitude).max() <= 5.0
    np.testing.assert_allclose(np.abs(amplitude).mean(), 2.75, atol=0.1)
    np.testing.assert_allclose((amplitude > 0).mean(), 0.5, atol=0.05)
    # Either joint may get any of the pulses.
    assert 0.4 < (np.asarray(pulses.time)[:, 0].mean(axis=1) < 4.375).mean() < 0.6


def few_strips():
    """Two or three values of every criterion, mild and hopeless."""
    return [
        Strip("model", "m2", np.array([0.6, 0.63, 2.5])),
        Strip("model", "b2", np.array([0.0, 0.01])),
        Strip("velocity_noise", "velocity_noise", np.array([0.0, 8.0]), 4),
        Strip("torque_noise", "torque_noise", np.array([0.0, 0.1]), 4),
        Strip("responsiveness", "responsiveness", np.array([0.002, 1.0])),
        Strip("delay", "delay", np.array([0.0, 0.3])),
        Strip("perturbation", "perturbation", np.array([0.0, 1.0])),
    ]


@pytest.fixture(scope="module")
def report():
    options = {"keys": 2, "duration": 1.5, "grids": few_strips(), "scored": True}
    return benchmark(BALANCE, NEAR_UPRIGHT, KEY, **options)


def test_scores_are_the_means_of_what_passes(report):
    assert report.success["m2"][:2].tolist() == [1, 1]
    assert report.success["m2"][2] == 0
    assert report.scores["model"] == pytest.approx(4 / 5)
    assert report.success["velocity_noise"][0] == 1
    assert report.success["velocity_noise"][1] <= 0.5
    assert report.scores["velocity_noise"] == 0.5
    assert report.success["responsiveness"].tolist() == [0, 1]
    assert report.success["delay"].tolist() == [1, 0]
    assert report.overall == pytest.approx(np.mean([report.scores[c] for c in CRITERIA]))
    assert report.simulations == 5 + 8 + 8 + 2 + 2 + 2
    assert set(report.diverged) == set(CRITERIA)


def test_report_has_the_spread_over_keys_and_performance(report):
    assert len(report.overall_by_key) == 2
    assert np.median(report.overall_by_key) == report.overall
    assert np.median(report.scores_by_key["perturbation"]) == report.scores["perturbation"]
    assert set(report.scores_by_key) == {"velocity_noise", "torque_noise", "perturbation"}
    written = report.as_dict()
    json.dumps(written)
    over = written["over_keys"]
    assert over["min"] <= over["mean"] <= over["max"]
    grid = written["criteria"]["model"]["grids"]["m2"]
    assert grid["values"] == [0.6, 0.63, 2.5]
    assert grid["success"] == [1, 1, 0]
    assert len(grid["performance"]) == 3
    assert 0 <= min(grid["performance"]) <= max(grid["performance"]) < 1


def noisy_starts(n):
    return vary(NEAR_UPRIGHT, {"velocity_noise": np.full(n, 0.5)}, key=KEY)


def test_a_key_reproduces_a_sweep_and_chunks_change_nothing():
    scenarios = noisy_starts(5)
    whole = sweep(scenarios, BALANCE, KEY, duration=SHORT)
    again = sweep(scenarios, BALANCE, KEY, duration=SHORT, chunk=2)
    other = sweep(scenarios, BALANCE, jax.random.key(4), duration=SHORT)
    assert whole.x.shape == again.x.shape == (5, 4)
    assert_close(again.x, whole.x)
    assert len(np.unique(whole.x[:, 2])) == 5
    assert not np.any(whole.x[:, 2] == other.x[:, 2])


def test_diverged_rollouts_are_counted_failures_and_touch_no_other():
    starts = np.tile(LEANING, (3, 1))
    starts[1, 2] = 0.9
    scenarios = vary(NEAR_UPRIGHT, {"m2": np.full(3, 0.62)}, key=KEY).replace(x0=starts)
    fragile = Feedback(lambda t, x: jnp.where(x[2] > 0.8, jnp.nan, balance(t, x)))
    outcome = sweep(scenarios, fragile, KEY, duration=SHORT, scored=True)
    assert outcome.diverged.tolist() == [False, True, False]
    assert outcome.success.tolist() == [True, False, True]
    assert np.isfinite(outcome.score).all()
    assert outcome.score[1] == 0
    np.testing.assert_array_equal(outcome.x[0], outcome.x[2])


def test_python_functions_are_judged_like_jax_controllers():
    def law(t, x):
        assert isinstance(x, np.ndarray)
        assert isinstance(t, float)
        assert x.shape == (4,)
        return np.array([-GAINS @ (x - np.array([np.pi, 0, 0, 0])), 0])

    def batched(t, x):
        assert t.shape == x.shape[:1]
        return np.stack([-(x - np.array([np.pi, 0, 0, 0])) @ GAINS, 0 * t], axis=1)

    scenarios = noisy_starts(3)
    expected = sweep(scenarios, BALANCE, KEY, duration=SHORT)
    for judged in (PythonLaw(law), PythonLaw(batched, batched=True)):
        assert_close(sweep(scenarios, judged, KEY, duration=SHORT).x, expected.x, times=5)


def test_survey_spans_the_product_of_its_values():
    grid = {"m2": [0.6, 0.63, 2.5], "delay": [0.0, 0.3]}
    found = survey(NEAR_UPRIGHT, BALANCE, grid, KEY, repetitions=2, duration=1.5)
    np.testing.assert_array_equal(found.success, [[1, 0], [1, 0], [0, 0]])
    assert found.diverged.shape == (3, 2)
    assert found.score is None


@both_precisions
def test_mildest_failure_is_a_failure_and_harmless_ranges_have_none(dtype):
    ranges = {"delay": (0.0, 0.1), "b2": (0.0, 0.001)}
    found = mildest_failure(NEAR_UPRIGHT, BALANCE, ranges, KEY, samples=64, duration=1.5)
    assert 0 < found["failures"] < 1
    assert found["severity"] == pytest.approx(
        max(found["values"]["delay"] / 0.1, found["values"]["b2"] / 0.001)
    )
    values = {name: [value] for name, value in found["values"].items()}
    assert not survey(NEAR_UPRIGHT, BALANCE, values, KEY, duration=1.5).success.any()
    harmless = {"delay": (0.0, 0.004), "b2": (0.0, 0.001)}
    assert mildest_failure(NEAR_UPRIGHT, BALANCE, harmless, KEY, samples=64, duration=1.5) == {
        "failures": 0.0, "severity": None, "values": None,
    }  # fmt: skip


def test_sweeps_promote_no_rank():
    """Of users who have jax refuse what may be a mistake of theirs."""
    with jax.numpy_rank_promotion("raise"):
        found = survey(NEAR_UPRIGHT, BALANCE, {"delay": [0.0, 0.004]}, KEY, duration=0.2)
        mildest_failure(NEAR_UPRIGHT, BALANCE, {"delay": (0, 0.004)}, KEY, samples=2, duration=0.2)
    np.testing.assert_array_equal(found.success, [1, 1])


PLANT = competition("pendubot")
BROKEN = PLANT.replace(mass=np.array([0.5, np.nan], "f4"))


def varied(plant=PLANT, **changes):
    return vary(Scenario(plant), changes, key=KEY)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: varied(torque_noise=[0.1, -0.1]), "torque_noise is -0.1 N m; it must be at least"),
        (lambda: varied(m2=[np.nan]), "m2 is nan kg; it must be finite"),
        (lambda: varied(delay=[-0.01]), "delay is -0.01 s"),
        (lambda: varied(wind=[1.0]), "unknown variation 'wind'; known: Ir"),
        (lambda: varied(m2=[1.0], b1=[0, 1]), "got [1, 2]"),
        (lambda: sweep(varied(BROKEN, b1=[0.0]), Zero(), KEY), "plant mass holds a value"),
        (lambda: sweep(noisy_starts(2), Zero(), KEY, chunk=0), "chunk is 0"),
        (lambda: benchmark(Zero(), PLANT, KEY, chunk=0), "chunk is 0"),
        (lambda: benchmark(Zero(), PLANT, KEY, keys=0), "keys is 0; it must be at least 1"),
        (lambda: survey(PLANT, Zero(), {"m2": [1]}, KEY, repetitions=0), "repetitions is 0"),
        (lambda: mildest_failure(PLANT, Zero(), {"m2": (0.6, 1)}, KEY, samples=0), "samples is 0"),
        (lambda: random_pulses(KEY, duration=5.0), "6 pulses 1.0 s apart do not fit into 5.0 s"),
    ],
)
def test_bad_input_is_one_sentence(call, words):
    with refused(words):
        call()


def test_command_writes_json_csv_and_pictures(tmp_path, capsys):
    out = tmp_path / "out"
    commands.robustness("acrobot", keys=1, out=out, json="-")
    printed = json.loads(capsys.readouterr().out)
    # The policy that ships is above every published row on both boards.
    best_score, best_robustness = np.max([row[1:] for row in v2("acrobot").published], axis=0)
    assert best_robustness < printed["overall"] < 1
    assert official(load_policy("acrobot"), "acrobot")["score"] > best_score
    assert list(printed["scores"]) == list(CRITERIA)
    assert printed["overall"] == pytest.approx(np.mean(list(printed["scores"].values())))
    assert printed["simulations"] == 722
    assert len(printed["over_keys"]["overall"]) == 1
    for criterion in CRITERIA:
        for grid in printed["criteria"][criterion]["grids"].values():
            assert len(grid["values"]) == len(grid["success"]) in (21, 50)
    assert json.loads((out / "acrobot.json").read_text()) == printed
    rows = list(csv.DictReader((out / "acrobot.csv").read_text().splitlines()))
    assert len(rows) == 14 * 21 + 50
    assert rows[0].keys() == {"robot", "criterion", "imperfection", "unit", "value", "success"}
    assert (out / "robustness.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--robot", "pendubot", "--policy", "policy.npz"], "a policy for the acrobot"),
        (["--robot", "tricycle"], "robot is 'tricycle'; it must be acrobot or pendubot"),
        (["--controller", "no_such_module:law"], "cannot load no_such_module:law"),
        (["--policy", "policy.npz", "--controller", "pd"], "a policy for the acrobot"),
        (["--worst", "-5"], "worst is -5; it must not be negative"),
        (["--torque-limit", "0"], "--torque-limit is 0.0; it must be positive"),
    ],
)
def test_command_refuses_bad_input_in_one_sentence(tmp_path, monkeypatch, capsys, arguments, words):
    save_policy(tmp_path / "policy.npz", random_policy("acrobot", sizes=(8,)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["jaxpend", "robustness", *arguments])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    message = capsys.readouterr().err.strip()
    assert words in message
    assert "\n" not in message
    assert not (tmp_path / "runs").exists()


def test_command_judges_a_python_function_by_name(tmp_path, monkeypatch):
    (tmp_path / "my_laws.py").write_text("def push(t, x):\n    return [1.0, 0.0]\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    law = find_controller(None, "my_laws:push", task_of("pendubot"))
    assert isinstance(law, PythonLaw)
    _, torque = law(None, 0.0, jnp.zeros(4))
    np.testing.assert_array_equal(torque, [1.0, 0.0])


def test_delays_do_not_overwrite_each_other_or_the_scenarios_own():
    base = Scenario(competition("pendubot"))
    for changes in ({"delay": [0.02], "velocity_delay": [0.01]},
                    {"velocity_delay": [0.01], "delay": [0.02]}):  # fmt: skip
        np.testing.assert_array_equal(vary(base, changes, key=KEY).delay, [[10, 10, 10, 10]])
    changes = {"velocity_delay": [0.02], "delay": [0.01]}
    np.testing.assert_array_equal(vary(base, changes, key=KEY).delay, [[5, 5, 10, 10]])
    own = base.replace(delay=np.array([3, 3, 3, 3], "i4"))
    varied = vary(own, {"velocity_delay": [0.0, 0.02]}, key=KEY)
    np.testing.assert_array_equal(varied.delay, [[3, 3, 3, 3], [3, 3, 10, 10]])


def test_grids_of_ones_own():
    """Other criteria, two strips of one variation, and a plant that has no Coulomb friction."""
    plant = NEAR_UPRIGHT.plant.replace(coulomb_friction=None)
    grids = [
        Strip("mass", "m2", np.array([0.6, 2.5])),
        Strip("mass", "m2", np.array([0.61])),
        Strip("rubbing", "cf1", np.array([0.0, 0.01])),
        Strip("shaking", "process_noise", np.array([0.0, 9.0]), 3),
    ]
    near = NEAR_UPRIGHT.replace(plant=plant)
    found = benchmark(BALANCE, near, KEY, grids=grids, keys=2, duration=SHORT)
    assert list(found.scores) == ["mass", "rubbing", "shaking"]
    assert list(found.success) == ["m2", "m2 (2)", "cf1", "process_noise"]
    assert (found.success["m2"].tolist(), found.success["m2 (2)"].tolist()) == ([1, 0], [1])
    assert found.scores["mass"] == pytest.approx(2 / 3)
    assert list(found.scores_by_key) == ["shaking"]
    assert found.scores["shaking"] == 0.5
    grid = found.as_dict()["criteria"]["mass"]["grids"]["m2 (2)"]
    assert (grid["variation"], grid["values"]) == ("m2", [0.61])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: benchmark(BALANCE, NEAR_UPRIGHT, KEY, grids=[]), "grids is empty"),
        (
            lambda: benchmark(BALANCE, NEAR_UPRIGHT, KEY, grids=[Strip("a", "m3", np.ones(1))]),
            "unknown variation 'm3'; known: Ir",
        ),
        (lambda: survey(NEAR_UPRIGHT, BALANCE, {}, KEY), "the grid is empty"),
        (lambda: survey(NEAR_UPRIGHT, BALANCE, {"m2": []}, KEY), "m2 has values of shape (0,)"),
        (lambda: survey(NEAR_UPRIGHT, BALANCE, {"m2": "heavy"}, KEY), "m2 is 'heavy'; it must be"),
        (lambda: survey(NEAR_UPRIGHT, BALANCE, {"m3": [1]}, KEY), "unknown variation 'm3'"),
        (lambda: mildest_failure(NEAR_UPRIGHT, BALANCE, {}, KEY), "there are no ranges"),
        (lambda: vary(NEAR_UPRIGHT, {}, key=KEY), "there are no changes"),
        (lambda: vary(NEAR_UPRIGHT, {"m2": [[1.0]]}, key=KEY), "m2 has values of shape (1, 1)"),
    ],
)
def test_senseless_grids_are_one_sentence(call, words):
    with refused(words):
        call()


def test_a_board_gives_its_time_grid_and_its_score():
    task = dataclasses.replace(v2("pendubot").task, duration=SHORT, scoring=ScoreV3(SHORT))
    board = Board("short", task, trials=lambda plant: [Strip("model", "m2", np.array([0.6, 0.7]))])
    standing = Scenario(task.plant, x0=LEANING)
    options = {"grids": board.trials(task.plant), "scored": True, "duration": SHORT}
    expected = benchmark(BALANCE, standing, KEY, scoring=ScoreV3(SHORT), **options)
    np.testing.assert_allclose(expected.performance["m2"], 1.0, atol=0.01)
    found = benchmark(BALANCE, board, KEY, scored=True)
    assert (found.overall, found.simulations) == (0.0, 2)  # it hangs for so short a time
    np.testing.assert_array_equal(found.performance["m2"], 0.0)
    # 10 s would be enough to fall out of the time grid: the score is that of the board, too.
    with_v2 = benchmark(BALANCE, standing, KEY, **options)
    assert np.all(with_v2.performance["m2"] < 1.0)


def test_a_sweep_is_of_one_whole_batch():
    batch = vary(Scenario(PLANT), {"m2": [0.5, 0.6, 0.7]}, key=KEY)
    for scenarios, words in (
        (batch.replace(x0=jnp.zeros((2, 4))), "leading axes [(2,), (3,)]; they must be the same"),
        (Scenario(PLANT), "Scenario is no batch of scenarios"),
        (PLANT, "Plant is no batch of scenarios"),
    ):
        with refused(words):
            sweep(scenarios, Zero(), KEY, duration=0.02)
    with refused("repetitions is 1.5; it must be an integer"):
        survey(PLANT, Zero(), {"m2": [0.5]}, KEY, repetitions=1.5)
    with refused("dt is 0.0; it must be positive"):
        vary(Scenario(PLANT), {"delay": [0.01]}, key=KEY, dt=0.0)
    for ends in ((0.5, 0.6, 0.7), 0.5, ("a", 1)):
        with refused("the range of m2 is"):
            mildest_failure(PLANT, Zero(), {"m2": ends}, KEY, samples=2)
