"""Identification: what is fitted to simulated recordings of a plant is that plant."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused

from jaxpend import designs
from jaxpend.cli import commands
from jaxpend.controllers import OpenLoop
from jaxpend.identification import FITTED, identify
from jaxpend.interop.csv import load_csv, save_csv
from jaxpend.rollout import Trajectory, rollout
from jaxpend.scenario import Scenario

NOMINAL = designs.parameters("C.1/1.0")
TRUTH = NOMINAL | {
    "r1": 0.21, "I1": 0.022, "r2": 0.24, "I2": 0.0475, "b1": 0.02, "b2": 0.005, "cf1": 0.07,
    "cf2": 0.04, "Ir": 8e-5,
}  # fmt: skip
DELAY, DT = 6, 0.002  # steps; s
NOISE = (1e-3, 0.05)  # rad, rad/s


def recording(robot, seed, duration=6.0):
    """A run of the true plant under a sum of sines on the motor, measured late and with noise."""
    rng, t = np.random.default_rng(seed), np.arange(0, duration + DT, DT)
    waves = zip(
        rng.uniform(0.3, 1.2, 6), rng.uniform(0.2, 2.5, 6), rng.uniform(0, 6, 6), strict=True
    )
    torque = sum(size * np.sin(2 * np.pi * rate * t + phase) for size, rate, phase in waves)
    with jax.enable_x64(True):
        scenario = Scenario(
            designs.from_dict(TRUTH, robot=robot),
            measurement_noise=jnp.repeat(jnp.array(NOISE), 2),
            delay=jnp.full(4, DELAY),
        )
        both = jnp.stack([torque, 0 * torque] if robot == "pendubot" else [0 * torque, torque], 1)
        key, play = jax.random.key(seed), OpenLoop(jnp.asarray(t - DT / 2), both)
        run = rollout(scenario, play, key, dt=DT, duration=duration)
        x, u = np.asarray(run.x_measured), np.asarray(run.u_command)
        return Trajectory(t=np.asarray(run.t)[: len(u)], x=x, u=u, x_measured=x, u_command=u)


@pytest.fixture(scope="module")
def recordings():
    return [recording("pendubot", 1), recording("acrobot", 2)]


def test_the_true_plant_is_found_with_its_uncertainty(recordings):
    found = identify(recordings, NOMINAL)
    assert set(found.deviations) == set(FITTED)
    values = found.parameters | {"delay": found.delay}
    for name, true in (TRUTH | {"delay": DELAY * DT}).items():
        assert abs(values[name] / true - 1) < 0.02, name
        if name in FITTED:
            assert 0 < found.deviations[name] < 0.02 * true
            assert abs(values[name] - true) < 5 * found.deviations[name], name
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.1)
    assert float(found.plant(robot="acrobot").com[0]) == pytest.approx(0.21, rel=0.02)


def test_what_is_not_fitted_stays(recordings):
    fixed = TRUTH | {"r2": 0.3}
    found = identify(recordings[:1], fixed, ("r2", "delay"))
    assert found.parameters == fixed | {"r2": found.parameters["r2"]}
    assert found.parameters["r2"] == pytest.approx(0.24, rel=0.02)


def test_angles_may_be_wrapped(recordings):
    run = recordings[0]
    wrapped = np.concatenate([np.remainder(run.x[:, :2], 2 * np.pi), run.x[:, 2:]], axis=1)
    assert (np.abs(np.diff(wrapped[:, 0])) > 3).any()
    plain, same = (identify([r], TRUTH, ("r1", "delay")) for r in (run, run.replace(x=wrapped)))
    assert same.parameters["r1"] == pytest.approx(plain.parameters["r1"], rel=1e-6)


def test_what_says_nothing_is_refused(recordings):
    run = recordings[0]
    with refused("do not tell m1 and r1 apart"):
        identify([run], TRUTH, ("m1", "r1", "delay"))
    still = run.replace(x=np.zeros_like(run.x), u=np.zeros_like(run.u))
    with refused("the recordings do not show delay; leave it out"):
        identify([still], NOMINAL, ("r1", "delay"))
    with refused("no plant was found that moves like the recordings"):
        identify([run.replace(x=run.x[::-1].copy())], NOMINAL, ("r1",), window=1.0)
    for change, words in (
        ({"x": run.x[:, :2]}, "it must have (N,), (N, 4), (N, 2)"),
        ({"u": run.u[:, 0]}, "it must have (N,), (N, 4), (N, 2)"),
        ({"x": np.full_like(run.x, np.nan)}, "recording 1 holds numbers that are not finite"),
    ):
        with refused(words):
            identify([run.replace(**change)], NOMINAL)
    with refused("g is 0 where the search starts; to be fitted it must be positive"):
        identify([run], {**NOMINAL, "g": 0.0}, ("g",))
    with refused("unknown parameter to identify 'tl1'"):
        identify([run], NOMINAL, ("tl1",))
    for names in ((), ("r1", "r1")):
        with refused("name some, each once"):
            identify([run], NOMINAL, names)
    for window in (0.0, -1.0, np.nan, np.inf):
        with refused("it must be positive and finite"):
            identify([run], NOMINAL, window=window)


def test_recordings_with_gaps_or_too_short_ones_are_refused(recordings):
    run = recordings[0]

    def part(index):
        return run.replace(t=run.t[index], x=run.x[index], u=run.u[index])

    gap = np.delete(np.arange(len(run.u)), slice(1000, 1100))
    with refused("recording 2 has a gap of 0.202 s at 1.998 s"):
        identify([run, part(gap)], NOMINAL)
    with refused("shorter than two windows of 0.25 s"):
        identify([part(slice(0, 200))], NOMINAL)
    with refused("recording 1 has 2 samples"):
        identify([part(slice(0, 2))], NOMINAL)
    with refused("time steps; identify them one by one"):
        identify([run, part(slice(None, None, 2))], NOMINAL)
    with refused("there are no recordings"):
        identify([], NOMINAL)


def test_the_command_writes_a_plant_that_commands_take(recordings, tmp_path, capsys):
    files, out = (tmp_path / "1.csv",), tmp_path / "robot.yaml"
    save_csv(files[0], recordings[0])
    np.testing.assert_array_equal(load_csv(files[0]).x, recordings[0].x)
    out.write_text("# A plant identified from another.csv\n")  # what it wrote it may replace
    commands.identify(files, out, design="C.1/1.0", parameters=("r1", "cf1", "delay"), json="-")
    found = json.loads(capsys.readouterr().out)
    assert designs.read(out) == found["parameters"]
    assert f"delay of measurements: {found['delay']:.5g} s" in out.read_text()
    out.write_text("my own notes")
    with refused("it is there and is something else"):
        commands.identify(files, out)
    with refused("--plant and --design are both given"):
        commands.identify(files, tmp_path / "new.yaml", plant="a", design="C.1/1.0")
