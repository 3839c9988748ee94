"""Scenarios: rounding of delays, pulses, and types."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, both_robots, excerpt, refused

from jaxpend import JaxpendError, Pulses, Scenario
from jaxpend.designs import competition
from jaxpend.scenario import delay_steps, random_pulses


@both_robots
def test_delays_round_as_in_the_reference(robot):
    g = excerpt(f"imperfections_{robot}")
    for delay, n_delay, mode in zip(g["delay"], g["n_delay"], g["delay_mode"], strict=True):
        lag = n_delay - 1
        expected = {"posvel": [lag] * 4, "vel": [0, 0, lag, lag], "None": [0] * 4}[str(mode)]
        np.testing.assert_array_equal(delay_steps(delay, 0.002, str(mode).lower()), expected)


def test_a_delay_is_cut_off_not_rounded():
    assert delay_steps(0.0379)[0] == 18
    # 0.3 / 0.1 is 2.999... in floating point, and the reference cuts that off.
    assert delay_steps(0.3, dt=0.1)[0] == 2


@pytest.mark.x64
@both_robots
def test_pulses_are_those_of_the_reference(robot):
    g = excerpt(f"perturbation10s_{robot}")
    pulses = Pulses(g["pert_mu"], g["pert_sigma"], g["pert_amplitude"])
    torque = jax.vmap(pulses.torque)(jnp.arange(0, 5000, 25) * 0.002)
    assert_close(torque.T, g["perturbation_array"])


@pytest.mark.parametrize("delay", [-0.1, float("nan"), float("inf")])
def test_impossible_delays_are_refused(delay):
    with pytest.raises(JaxpendError, match="must be finite and not negative"):
        delay_steps(delay)


def test_unknown_delay_mode_lists_the_known_ones():
    with pytest.raises(JaxpendError, match="known: posvel, vel, none"):
        delay_steps(0.01, mode="position")


@pytest.mark.x64
def test_the_widest_type_decides_what_a_rollout_computes_in():
    plant = competition("acrobot")
    assert Scenario(plant, delay=delay_steps(0.01)).dtype == jnp.float64
    narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), plant)
    assert Scenario(narrow, delay=delay_steps(0.01)).dtype == jnp.float32
    assert Scenario(narrow, x0=jnp.zeros(4, jnp.float64)).dtype == jnp.float64


def test_absent_imperfections_are_not_leaves():
    plant = competition("acrobot")
    assert len(jax.tree.leaves(Scenario(plant))) == len(jax.tree.leaves(plant))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"per_joint": -1}, "per_joint is -1; it must not be negative"),
        ({"per_joint": 9}, "18 pulses 1.0 s apart do not fit into 10.0 s"),
        ({"distance": -1.0}, "distance is -1.0; it must not be negative"),
        (
            {"width": (-1.0, 0.0)},
            "width is (-1.0, 0.0); it must be 2 values, each",
        ),
        (
            {"amplitude": (-5.0, 0.5)},
            "amplitude is (-5.0, 0.5); it must be 2 values, each",
        ),
        ({"amplitude": 0.5}, "amplitude is 0.5; it must be 2 values"),
        ({"duration": np.nan}, "6 pulses 1.0 s apart do not fit into nan s"),
    ],
)
def test_pulses_that_make_no_sense_are_refused(options, words):
    with refused(words):
        random_pulses(jax.random.key(0), **options)
