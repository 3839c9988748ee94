"""Criteria and scores: the reference's numbers, edge cases included."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, both_precisions, both_robots, excerpt, refused, task_of

from jaxpend import JaxpendError, rollout
from jaxpend.controllers import Feedback, Zero
from jaxpend.designs import competition
from jaxpend.score import (
    V1_DEFAULT,
    V2_HARDWARE,
    criteria,
    imperfect,
    official,
    recorded,
    score_v1,
    score_v2,
    score_v3,
)

SCORES = {
    "score_v1_default": lambda c: score_v1(c, V1_DEFAULT),
    "score_v1_official": score_v1,
    "score_v2_official": score_v2,
    "score_v2_hardware": lambda c: score_v2(c, V2_HARDWARE),
    "score_v3_t10": lambda c: score_v3(c, 10.0),
    "score_v3_t60": score_v3,
}


@jax.jit
def judge(t, x, u):
    """Criteria and all scores, under the names that the excerpts use."""
    c = criteria(t, x, u, competition("acrobot"))
    named = {f"metric_{name}": jnp.asarray(value, t.dtype) for name, value in vars(c).items()}
    return named | {name: score(c) for name, score in SCORES.items()}


def synthetic(index, dtype):
    """One of the synthetic trajectories, cut out of where they lie end to end."""
    g = excerpt("metrics_random")
    end = np.cumsum(g["length"])[index]
    return tuple(jnp.asarray(g[k][end - g["length"][index] : end], dtype) for k in ("T", "X", "U"))


KINDS = sorted(excerpt("metrics_random")["kind"])


@pytest.mark.x64
@pytest.mark.parametrize("kind", KINDS)
def test_synthetic_trajectories_of_every_kind(kind):
    g = excerpt("metrics_random")
    index = KINDS.index(kind)
    assert g["kind"][index] == kind
    for name, value in judge(*synthetic(index, "float64")).items():
        assert_close(value, g[name][index], what=name)


@both_precisions
@both_robots
def test_a_recorded_swing_up_of_ten_seconds(robot, dtype):
    g = excerpt(f"trajectories_{robot}")
    series = (jnp.asarray(g[f"swing_{k}"], dtype) for k in ("T", "X", "U"))
    assert g["swing_metric_success"] == 1
    for name, value in judge(*series).items():
        assert_close(value, g[f"swing_{name}"], what=name, times=20 if dtype == "float32" else 1)


@pytest.mark.x64
def test_batched_and_plain_scores_are_the_jitted_ones():
    g = excerpt("metrics_random")
    same_length = [i for i in range(len(KINDS)) if g["length"][i] == 500]
    assert len(same_length) >= 3
    cases = [synthetic(i, "float64") for i in same_length]
    batch = judge(*(jnp.stack(series) for series in zip(*cases, strict=True)))
    for i, case in enumerate(cases):
        single = judge(*case)
        for name, value in batch.items():
            assert_close(value[i], single[name], what=name)
    with jax.disable_jit():
        t, x, u = (series[:8] for series in cases[0])
        plain = criteria(t, x, u, competition("acrobot"))
    for name, value in judge(t, x, u).items():
        if name.startswith("metric_"):
            expected = np.asarray(getattr(plain, name.removeprefix("metric_")), float)
            assert_close(value, expected, what=name)


def held_up(n=5000, dt=0.002, torque=0.0):
    """Upright from the start to the end with a constant torque on joint 2."""
    t = dt * jnp.arange(n)
    x = jnp.tile(jnp.array([jnp.pi, 0.0, 0.0, 0.0]), (n, 1))
    return t, x, jnp.tile(jnp.array([0.0, torque]), (n, 1))


@pytest.mark.x64
def test_scores_of_a_trajectory_worked_out_by_hand():
    t, x, u = held_up(torque=0.5)
    judged = judge(t, x, u)
    assert judged["metric_success"] == 1
    assert_close(judged["metric_integ_tau"], 0.5 * 9.998)
    assert_close(judged["metric_tau_cost"], 0.25 * 9.998)
    assert judged["metric_tau_smoothness"] == judged["metric_energy"] == 0
    penalties = np.tanh(np.pi * np.array([0.002 / 20, 0.25 * 9.998 / 20]))
    assert_close(judged["score_v2_official"], 1 - penalties.sum() / 5)
    # The energy counts angle changes in either direction.
    back_and_forth = x.at[1::2, 1].add(0.01)
    assert_close(judge(t, back_and_forth, u)["metric_energy"], 0.5 * 0.01 * 4999)


@pytest.mark.x64
def test_more_effort_never_scores_better():
    scores = [judge(*held_up(torque=torque))["score_v2_official"] for torque in (0.0, 0.5, 1.0)]
    assert scores[0] > scores[1] > scores[2] > 0


@pytest.mark.x64
def test_imperfect_runs_are_as_random_as_their_key():
    judged = jax.jit(lambda key: imperfect(Zero(), task_of("acrobot"), key, 24)[0].velocity_cost)
    moving = np.asarray(judged(jax.random.key(0)))
    # What hangs is moved by pulses and by torque noise alone: one third of 24, give or take.
    assert 2 < np.sum(moving > 0) < 16
    assert len(np.unique(moving)) == 1 + np.sum(moving > 0)
    np.testing.assert_array_equal(judged(jax.random.key(0)), moving)
    assert np.any(judged(jax.random.key(1)) != moving)


def test_a_run_that_is_not_a_number_fails_with_score_zero():
    t, x, u = held_up()
    judged = judge(t, x.at[2000:].set(jnp.nan), u.at[2000:].set(jnp.nan))
    assert judged["metric_success"] == 0
    assert judged["score_v2_official"] == 0


@pytest.mark.parametrize(
    ("t", "x", "u"),
    [
        ((10,), (10, 4), (8, 2)),
        ((10,), (11, 4), (10, 2)),
        ((10,), (10, 3), (10, 2)),
        ((10,), (10, 4), (10, 1)),
        ((2,), (2, 4), (2, 2)),
        ((10,), (10, 4), (10,)),
    ],
)
def test_shapes_that_do_not_fit_are_one_sentence(t, x, u):
    with pytest.raises(JaxpendError, match=r"criteria need t \(\.\.\., N or N\+1\)") as error:
        criteria(np.zeros(t), np.zeros(x), np.zeros(u), competition("acrobot"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("module", ["jaxpend.score", "jaxpend.robustness"])
def test_judging_loads_no_training_library(module):
    heavy = {"brax", "flax", "optax", "evosax", "mujoco", "matplotlib", "scipy", "rich"}
    code = f"import jax, sys; jax_alone = set(sys.modules); import {module}; "
    code += "print(*{name.split('.')[0] for name in set(sys.modules) - jax_alone})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "jaxpend" in loaded
    assert not loaded & heavy


def test_lists_are_arrays_and_what_is_no_number_is_refused():
    t, x, u = held_up()
    expected = criteria(t, x, u, competition("acrobot"))
    found = criteria(t.tolist(), x.tolist(), u.tolist(), competition("acrobot"))
    np.testing.assert_allclose(found.velocity_cost, expected.velocity_cost, rtol=1e-5)
    with pytest.raises(JaxpendError, match="criteria need arrays of numbers"):
        criteria(["now"], x, u, competition("acrobot"))


def test_a_run_that_diverges_is_said_to():
    spinning = Feedback(lambda t, x: jnp.where(t > 0.1, jnp.nan, 0.0) * x[:2])
    judged = official(spinning, "acrobot")
    assert (judged["diverged"], judged["success"], judged["score"]) == (True, False, 0.0)
    assert not official(Zero(), "acrobot")["diverged"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda run: run.replace(x=run.x.at[3000, 0].set(jnp.nan)), "numbers that are not finite"),
        (lambda run: run.replace(u=run.u.at[3000, 1].set(jnp.nan)), "numbers that are not finite"),
        (lambda run: run.replace(t=run.t.at[3000].set(jnp.inf)), "numbers that are not finite"),
        (lambda run: run.replace(t=run.t[::-1]), "the time stamps of the run go back"),
        (
            lambda run: run.replace(u=run.u.at[9, 0].set(2950.0)),
            "joint 1 has torques of up to 2",
        ),
    ],
)
def test_a_recording_of_no_such_run_is_refused(change, words):
    run = rollout(competition("pendubot"), Zero(), jax.random.key(0))
    assert recorded(run, "pendubot")["score"] == 0.0
    with refused(words):
        recorded(change(run), "pendubot")
