"""Robots that differ from the nominal one in everything at once, and judging on many of them."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused

from jaxpend import designs
from jaxpend.boards import HARDWARE, task_of, v2
from jaxpend.cli.app import main
from jaxpend.config import GradientConfig
from jaxpend.controller import Feedback, Zero
from jaxpend.controllers.files import load_policy
from jaxpend.fleet import CONDITIONS, judge_fleet, wilson
from jaxpend.gradient import Gradient
from jaxpend.hardware import PRESETS, Spread, draw
from jaxpend.plant import mass_matrix
from jaxpend.rollout import rollout
from jaxpend.scenario import Encoder, Scenario, check_values
from jaxpend.score import nominal, official, official_run, trial_run

TASK = HARDWARE["pendubot"].task
KEY = jax.random.key(0)


def drawn(spread, count, pushed=True):
    def one(key):
        return draw(spread, TASK.plant, key, pushed=jnp.asarray(pushed), duration=10.0)

    return jax.vmap(one)(jax.random.split(KEY, count))


@pytest.mark.parametrize("name", ["identified", "wide"])
def test_every_parameter_of_a_robot_is_off_within_its_range(name):
    spread, robots, nominal = PRESETS[name], drawn(PRESETS[name], 4000), TASK.plant
    for field, share in {
        "mass": spread.inertial, "com": spread.inertial, "length": spread.inertial,
        "damping": spread.friction, "coulomb_friction": spread.friction,
    }.items():  # fmt: skip
        factor = np.asarray(getattr(robots.plant, field) / getattr(nominal, field))
        assert (np.abs(factor - 1) <= share * 1.0001).all()
        np.testing.assert_allclose(factor.std(axis=0), share / np.sqrt(3), rtol=0.05)
        # Those of the two joints, and of other fields, are drawn apart.
        assert abs(np.corrcoef(factor.T)[0, 1]) < 0.05
    motor = np.asarray(robots.plant.motor_inertia / nominal.motor_inertia)
    np.testing.assert_allclose(motor.std(), spread.friction / np.sqrt(3), rtol=0.05)
    # The inertia about the centre of mass is positive, and the mass matrix positive definite.
    assert (robots.plant.inertia > robots.plant.mass * robots.plant.com**2).all()
    upright = jnp.array([jnp.pi, 0.0, 0.0, 0.0])
    assert (np.linalg.eigvalsh(jax.vmap(mass_matrix, (0, None))(robots.plant, upright)) > 0).all()
    for late, most in ((robots.delay[:, 0], 5), (robots.delay_jitter, 2)):
        assert (late.min(), late.max()) == (0, most)
    assert (robots.responsiveness >= 0.8).all()
    assert not np.asarray(robots.torque_noise[:, 1]).any()


def test_pushes_are_pulses_on_both_joints_that_leave_time_to_stand():
    robots, calm = drawn(Spread(push=(1.0, 2.0)), 300), drawn(Spread(push=(1.0, 2.0)), 300, False)
    size = np.abs(np.asarray(robots.pulses.amplitude))
    assert (size.min() >= 1.0, size.max() <= 2.0) == (True, True)
    assert np.asarray(robots.pulses.time).max() < 8.0
    assert not np.asarray(calm.pulses.amplitude).any()
    np.testing.assert_array_equal(robots.plant.mass, calm.plant.mass)


def test_a_push_on_either_joint_moves_the_arm_but_no_torque_of_the_passive_one_does():
    robot = jax.tree.map(lambda leaf: leaf[0], drawn(Spread(), 1, False))
    still = rollout(robot, Zero(), KEY, duration=1.5)
    drive = Feedback(lambda t, x: jnp.array([0.0, 3.0]))
    np.testing.assert_array_equal(still.x, rollout(robot, drive, KEY, duration=1.5).x)
    for joint in (0, 1):
        push = jnp.zeros((2, 2)).at[joint, 0].set(2.0)
        pulses = robot.pulses.replace(amplitude=push, time=jnp.full((2, 2), 1.0))
        moved = rollout(robot.replace(pulses=pulses), Zero(), KEY, duration=1.5)
        assert np.abs(moved.x - still.x).max() > 0.1


def test_an_encoder_gives_angles_in_steps_and_their_filtered_differences():
    step, dt = 0.01, 0.002
    for filtered in (0.0, 0.006):
        weight = dt / (dt + filtered)
        encoder = Encoder(jnp.full(2, step), jnp.asarray(filtered))
        scenario = Scenario(v2("pendubot").task.plant, jnp.array([1.0, 0.0, 0.3, 0.0]))
        law = Feedback(lambda t, x: jnp.stack([1.5 * jnp.sin(9 * t), 0.0 * t]))
        run = rollout(scenario.replace(encoder=encoder), law, KEY, duration=1.0)
        x, seen = np.asarray(run.x[:-1], float), np.asarray(run.x_measured, float)
        angles = step * np.round(x[:, :2] / step)
        # Rounding of float32 may put an angle into the next step.
        assert (np.abs(seen[:, :2] - angles) < 1e-5).mean() > 0.99
        wanted, speed = [], x[0, 2:]
        for k in range(len(x)):
            if k:
                speed = speed + weight * ((seen[k, :2] - seen[k - 1, :2]) / dt - speed)
            wanted.append(speed)
        np.testing.assert_allclose(seen[:, 2:], wanted, atol=2e-2)
        noisy = scenario.replace(encoder=encoder, measurement_noise=jnp.array([0, 0, 0.5, 0.5]))
        loud = np.asarray(rollout(noisy, law, KEY, duration=1.0).x_measured, float)
        np.testing.assert_allclose((loud - seen)[:, 2:].std(axis=0), 0.5, rtol=0.1)
        np.testing.assert_allclose(loud[:, :2], seen[:, :2], atol=1e-5)


@pytest.mark.parametrize("encoder", [None, Encoder(jnp.full(2, 1e-3), jnp.asarray(0.01))])
def test_with_jitter_any_measurement_may_be_older_by_some_steps(encoder):
    robot = Scenario(TASK.plant, jnp.array([1.0, 0.5, 0.3, 0.0]), encoder=encoder)
    late = robot.replace(delay=jnp.full(4, 3), delay_jitter=jnp.asarray(4))
    law = Feedback(lambda t, x: jnp.stack([1.5 * jnp.sin(9 * t), 0.0 * t]))
    fresh, aged = (np.asarray(rollout(r, law, KEY, duration=1.0).x_measured) for r in (robot, late))
    ages = []
    for k in range(20, len(fresh)):
        same = [age for age in range(10) if (fresh[k - age] == aged[k]).all()]
        assert len(same) >= 1  # angle and velocity are of one time
        ages += same if len(same) == 1 else []
    np.testing.assert_array_equal(np.unique(ages), [3, 4, 5, 6, 7])
    share = np.bincount(ages, minlength=8)[3:] / len(ages)
    np.testing.assert_allclose(share, 0.2, atol=0.08)
    none = rollout(robot.replace(delay_jitter=jnp.asarray(0)), law, KEY, duration=1.0)
    np.testing.assert_array_equal(none.x_measured, fresh)


def test_a_motor_in_the_passive_joint_takes_off_the_friction_that_is_believed():
    passive = 1  # of the pendubot
    robot = jax.tree.map(lambda leaf: leaf[0], drawn(PRESETS["compensated"], 1, False))
    assert robot.compensation.limit.tolist() == [0.0, 0.5]
    x = jnp.array([0.0, 0.0, 3.0, -2.0])
    believed = TASK.plant.damping[passive] * -2.0
    believed += TASK.plant.coulomb_friction[passive] * np.arctan(-200.0)
    np.testing.assert_allclose(robot.compensation.torque(x), [0.0, believed], rtol=1e-5)
    fast = robot.compensation.torque(x.at[3].set(1e4))
    np.testing.assert_allclose(fast, [0.0, 0.5])
    # It reaches the joint, though the controller's torque limit there is 0; on the plant that is
    # believed no friction is left.
    plain = Scenario(TASK.plant.replace(actuation=jnp.ones(2)), jnp.array([0.0, 0.5, 0.0, 0.0]))
    helped = plain.replace(compensation=robot.compensation.replace(plant=plain.plant))
    driven = np.array([1.0, 0.0], "f4")
    free = {name: driven * getattr(plain.plant, name) for name in ("damping", "coulomb_friction")}
    free = plain.replace(plant=plain.plant.replace(**free))
    x, helped, free = (rollout(s, Zero(), KEY, duration=0.3).x for s in (plain, helped, free))
    np.testing.assert_allclose(helped, free, atol=0.02)  # it lags by a step
    assert np.abs(x - free).max() > 0.2


def test_robots_of_another_preset_are_trained_and_judged():
    task = task_of("pendubot", board="hardware", preset="wide")
    assert task.spread == PRESETS["wide"]
    assert task_of("pendubot", board="hardware") == TASK
    with refused("preset is wide; the v2 board has no robots that differ"):
        task_of("pendubot", preset="wide")
    with refused("unknown preset 'odd'"):
        task_of("pendubot", board="hardware", preset="odd")


def test_a_delay_with_its_jitter_has_to_fit_into_the_buffer():
    robot = Scenario(TASK.plant, delay=jnp.full(4, 20), delay_jitter=jnp.asarray(12))
    with refused("a delay of 32 steps does not fit in a buffer of 32 states"):
        rollout(robot, Zero(), KEY)
    with refused("jitter is 0.01; it must be in 0 to 0.005"):
        Spread(delay=0.055, jitter=0.01)
    assert Spread(delay=0.05, jitter=0.01).jitter == 0.01
    with refused("delay_jitter is -1; it must not be negative"):
        check_values(robot.replace(delay_jitter=np.asarray(-1)))


def test_the_hardware_score_is_that_of_robots_and_not_of_the_nominal_plant():
    board = HARDWARE["pendubot"]
    one = board.drawn(3)
    assert one.plant.mass[0] != TASK.plant.mass[0]
    assert one.encoder is not None
    assert not np.asarray(one.pulses.amplitude).any()
    with jax.enable_x64(True):
        again = board.drawn(3)
        assert again.plant.mass.dtype == np.float64
        assert again.encoder.filtered.dtype == np.float64
        np.testing.assert_array_equal(again.plant.mass, one.plant.mass)
        np.testing.assert_array_equal(again.delay, one.delay)
    law = load_policy("hardware_pendubot")
    found = official(law, dataclasses.replace(board, draws=3))
    runs = [trial_run(law, board.drawn(seed), TASK, seed) for seed in range(3)]
    each = [float(TASK.score(criteria)) for _, criteria, _ in runs]
    # Their noise has nothing to do with each other.
    noise = [np.asarray(run.x_measured[1:] - run.x_measured[:-1])[2500:, 2] for run, *_ in runs]
    assert abs(np.corrcoef(noise)[0, 1]) < 0.1
    assert found["draws"]["count"] == 3
    assert np.ptp(each) > 1e-3
    assert found["score"] == pytest.approx(np.mean(each), abs=2e-3)
    # The noise of a run in float64 is another.
    assert official_run(law, board, 1)[1]["score"] == pytest.approx(each[1], abs=0.03)
    assert nominal(law, TASK).success.shape == (TASK.repeats,)


def easy(**fields):
    """Robots that are all but nominal, judged for a second from upright."""
    spread = Spread(
        inertial=1e-3, friction=0.0, encoder=0.0, velocity_noise=0.0, delay=0.0, jitter=0.0,
        torque_noise=0.0, response=1.0, push=(5.0, 6.0),
    )  # fmt: skip
    return dataclasses.replace(TASK, spread=dataclasses.replace(spread, **fields))


def test_what_hangs_does_not_stand_and_has_never_been_up():
    found = judge_fleet(Zero(), easy(), KEY, robots=130)
    assert found.stands.shape == (2, 130)
    assert not found.stands.any()
    np.testing.assert_allclose(found.down[0], 10.0)
    assert found.down[1].max() <= 10.0
    said = found.as_dict()
    assert [said["conditions"][name]["success"] for name in CONDITIONS] == [0.0, 0.0]
    assert said["conditions"]["with pushes"]["down"] is None
    assert len(said["worst"]) == 5
    assert len(said["by"]["mass 1"]["values"]) == 6
    json.dumps(said)


def test_a_spinning_arm_does_not_stand_for_two_seconds():
    t = np.arange(0, 10, 0.002)
    x = np.zeros((3, len(t), 4))
    x[0, :, 0] = np.pi
    x[1, :, 0] = np.pi + 4 * np.sin(9 * t)  # above the line now and then, and at the end
    x[1, -1] = [np.pi, 0, 0.5, 0]
    x[2, :, 0] = np.where(t < 8.1, 0, np.pi)
    np.testing.assert_array_equal(TASK.stands(jnp.asarray(x)), [True, False, False])
    assert np.asarray(v2("pendubot").task.stands(jnp.asarray(x))).all()


def test_wilson_intervals_are_those_of_the_tables():
    np.testing.assert_allclose(wilson(8, 10), [0.4902, 0.9433], atol=1e-4)
    np.testing.assert_allclose(wilson(0, 10), [0.0, 0.2775], atol=1e-4)


def test_a_spread_that_no_robots_have_is_one_sentence():
    for field, value in {
        "delay": 0.1, "inertial": 1.0, "friction": -0.1, "encoder": -1.0, "response": 1.1,
    }.items():  # fmt: skip
        with refused(f"{field} is", start=""):
            Spread(**{field: value})


def test_no_robot_of_any_design_has_an_inertia_that_no_body_has():
    plant = designs.load("C.1", "3.0", robot="pendubot")

    def inertia(key):
        robot = draw(PRESETS["wide"], plant, key, pushed=jnp.asarray(True), duration=10.0).plant
        return robot.inertia - robot.mass * robot.com**2

    assert jax.vmap(inertia)(jax.random.split(KEY, 200)).min() >= -1e-6


def test_what_cannot_be_judged_is_one_sentence():
    with refused("this task has no robots that differ", start=""):
        judge_fleet(Zero(), v2("pendubot").task, KEY)
    with refused("robots is 0", start=""):
        judge_fleet(Zero(), TASK, KEY, robots=0)
    with refused("for the acrobot, not for the pendubot", start="this controller is"):
        judge_fleet(load_policy("acrobot"), TASK, KEY)


def test_the_command_writes_a_picture_and_numbers(monkeypatch, capsys, tmp_path):
    line = f"hardware --controller lqr --robots 3 --out {tmp_path / 'found'} --json -"
    monkeypatch.setattr("sys.argv", ["jaxpend", *line.split()[1:]])
    with pytest.raises(SystemExit) as exit_:
        main("hardware")
    found = json.loads(capsys.readouterr().out)
    assert exit_.value.code == 0
    assert (found["robots"], found["preset"]) == (3, "identified")
    assert {p.name for p in (tmp_path / "found").iterdir()} == {
        "identified_pendubot.png", "identified_pendubot.json",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"push": (float("nan"), 1.0)}, "push is"),
        ({"push": (3.0, 0.5)}, "push is"),
        ({"push": (-1.0, 2.0)}, "push is"),
        ({"push": (1.0, float("inf"))}, "push is"),
        ({"pushes": -1}, "pushes is -1"),
        ({"pushes": 1.5}, "pushes is 1.5"),
        ({"compensation": -0.5}, "compensation is -0.5"),
        ({"jitter": -0.001}, "jitter is -0.001"),
    ],
)
def test_robots_that_make_no_sense_are_refused(fields, words):
    with refused(words):
        Spread(**fields)


def test_tasks_and_sensors_that_make_no_sense_are_refused():
    for standing in (-1.0, float("nan"), 20.0, 1e-4):
        with refused("standing is"):
            dataclasses.replace(TASK, standing=standing)
    with refused("resets or robots that differ, not both"):
        dataclasses.replace(TASK, resets=2)
    with refused("the gradient climbs a smooth v2 score of the nominal plant"):
        Gradient(GradientConfig(steps=1), load_policy("hardware_pendubot"), TASK)
    robot = jax.tree.map(lambda leaf: leaf[0], drawn(PRESETS["compensated"], 1, False))
    check_values(robot)
    for field, bad, words in (
        ("encoder", {"step": np.zeros(2)}, "step of the encoder is 0.0"),
        ("encoder", {"filtered": np.asarray(-0.01)}, "filter of the encoder is -0.01"),
        ("compensation", {"limit": np.array([0, -0.5])}, "limit of the compensation is -0.5"),
    ):
        with refused(words):
            check_values(robot.replace(**{field: getattr(robot, field).replace(**bad)}))
    free = robot.compensation.plant.replace(torque_limit=np.full(2, np.inf))
    check_values(robot.replace(compensation=robot.compensation.replace(plant=free)))


def test_robots_that_nobody_pushes_can_be_drawn():
    scenario = draw(Spread(pushes=0), TASK.plant, jax.random.key(0), pushed=True, duration=2.0)
    assert scenario.pulses.amplitude.shape == (2, 0)
    np.testing.assert_array_equal(scenario.pulses.torque(1.0), 0.0)
