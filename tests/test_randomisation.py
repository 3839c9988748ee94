"""Random scenarios: one imperfection each, within the ranges of the benchmark's grids."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxpend.boards import HARDWARE, v2
from jaxpend.designs import competition
from jaxpend.robustness import strips
from jaxpend.rollout import SLOTS
from jaxpend.variations import LONGEST_DELAY, sample

PLANT = competition("acrobot")
NOMINAL = {name: np.asarray(value) for name, value in vars(PLANT).items()}


@pytest.fixture(scope="module")
def scenarios():
    """2000 of them, as numpy arrays."""
    keys = jax.random.split(jax.random.key(0), 2000)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda key: sample(PLANT, key)))(keys))


def off(scenarios):
    """Which of the six criteria each scenario has something of, (6, n)."""
    plant = [np.asarray(getattr(scenarios.plant, name)) != NOMINAL[name] for name in NOMINAL]
    return np.stack(
        [
            np.any([p.reshape(len(p), -1).any(axis=1) for p in plant], axis=0),
            scenarios.measurement_noise.any(axis=1),
            scenarios.torque_noise.any(axis=1),
            scenarios.responsiveness != 1,
            scenarios.delay.any(axis=1),
            scenarios.pulses.amplitude.any(axis=(1, 2)),
        ]
    )


def test_one_thing_is_wrong_and_each_is_a_sixth(scenarios):
    wrong = off(scenarios)
    assert wrong.sum(axis=0).max() == 1
    share = wrong.mean(axis=1)
    # Four standard deviations of a share of 1/6 in 2000 draws; a delay may round to none.
    np.testing.assert_allclose(share, 1 / 6, atol=4 * np.sqrt(5 / 36 / 2000))


def test_ranges_are_those_of_the_benchmarks_grids(scenarios):
    grids = {strip.variation: strip.values for strip in strips(PLANT)}
    plant = scenarios.plant
    drawn = {
        "Ir": plant.motor_inertia, "m1r1": NOMINAL["mass"][0] * plant.com[:, 0],
        "I1": plant.inertia[:, 0], "b1": plant.damping[:, 0],
        "cf1": plant.coulomb_friction[:, 0], "m2r2": NOMINAL["mass"][1] * plant.com[:, 1],
        "m2": plant.mass[:, 1], "I2": plant.inertia[:, 1], "b2": plant.damping[:, 1],
        "cf2": plant.coulomb_friction[:, 1], "velocity_noise": scenarios.measurement_noise[:, 2],
        "torque_noise": scenarios.torque_noise[:, 1],
        "responsiveness": scenarios.responsiveness, "delay": 0.002 * scenarios.delay[:, 0],
    }  # fmt: skip
    for name, values in drawn.items():
        low, high = grids[name].min(), grids[name].max()
        width = high - low
        assert values.min() >= low - 1e-6 * width, name
        assert values.max() <= high + 1e-6 * width, name
        assert values.max() - values.min() > 0.75 * width, name
    assert scenarios.delay.max() == LONGEST_DELAY
    assert not scenarios.torque_noise[:, 0].any()
    assert not scenarios.measurement_noise[:, :2].any()


def drawn_by(draw, count=200):
    keys = jax.random.split(jax.random.key(0), count)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(draw))(keys))


@pytest.mark.parametrize("task", [v2("acrobot").task, HARDWARE["acrobot"].task])
def test_delays_and_pulses_are_of_the_runs_time_grid(task):
    """Of the task's where its runs are meant, of that of what steps it where an episode is."""
    longest, lasts = (0.04, 3.0) if task.spread is None else (0.014, 3.0 - 0.6)
    slow = dataclasses.replace(task, dt=0.01, duration=3.0)
    found = drawn_by(slow.sample)
    assert 0 < 0.01 * found.delay.max() <= longest + 1e-6
    assert found.pulses.time.min() > 0
    assert 0.75 * lasts < found.pulses.time.max() <= lasts
    usual = drawn_by(task.sample)
    episodes = drawn_by(lambda key: slow.imperfect(slow.plant, key))
    jax.tree.map(np.testing.assert_array_equal, episodes, usual)
    fine = dataclasses.replace(task, dt=0.0005)
    lags = drawn_by(fine.sample)
    assert usual.delay.max() < lags.delay.max()
    assert lags.longest_delay < fine.delay_slots
    assert task.delay_slots == SLOTS


def test_all_but_a_share_are_nominal():
    keys = jax.random.split(jax.random.key(5), 400)
    some = jax.jit(lambda share: jax.vmap(lambda key: sample(PLANT, key, share))(keys))
    wrong = [off(jax.tree.map(np.asarray, some(share))).any(axis=0) for share in (0.0, 0.3)]
    assert not wrong[0].any()
    np.testing.assert_allclose(wrong[1].mean(), 0.3, atol=0.1)


def test_a_plant_without_coulomb_friction_gets_some():
    plant = PLANT.replace(coulomb_friction=None)
    drawn = jax.jit(jax.vmap(lambda key: sample(plant, key)))(
        jax.random.split(jax.random.key(0), 99)
    )
    assert drawn.plant.coulomb_friction.shape == (99, 2)
    assert np.abs(drawn.plant.coulomb_friction).max() > 0.01
