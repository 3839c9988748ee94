"""The observer sees what the sensors do not say, and the rescue takes over what has failed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from conftest import assert_close, both_precisions, both_robots, refused

from jaxpend import Scenario, designs, load_policy, rollout
from jaxpend.controllers import Feedback, Zero, guard, load_reference, tvlqr
from jaxpend.controllers.guard import Guarded, Observer, Rescue, observer
from jaxpend.controllers.policy import network_in
from jaxpend.plant import mass_matrix, rk4_step
from jaxpend.pytree import Pytree, pytree
from jaxpend.robustness import strips
from jaxpend.scenario import delay_steps
from jaxpend.stepping import called_every
from jaxpend.sweep import upright

KEY = jax.random.key(0)
run = jax.jit(rollout, static_argnames=("duration",))


@pytree
class Late(Pytree):
    """A controller that does nothing at first."""

    main: Any
    start: jax.Array  # () s

    def reset(self, key):
        return self.main.reset(key)

    def __call__(self, carry, t, x):
        after, torque = self.main(carry, t - self.start, x)
        return after, jnp.where(t < self.start, 0.0, torque)


def swinging(dtype, robot="pendubot"):
    """A plant, and torques that keep both links moving."""
    plant = jax.tree.map(lambda v: jnp.asarray(v, dtype), designs.competition(robot))
    joint = designs.active_joint(robot)

    def law(t, x):
        torque = 2.0 * jnp.sin(7.0 * t) - 0.1 * x[2 + joint]
        return jnp.where(jnp.arange(2) == joint, torque, 0.0)

    return plant, Feedback(law)


def watched(scenario, controller, key=KEY, **options):
    """True and estimated states (N, 4) of a run of 2 s, and what the observer knows at the end."""
    seer = observer(designs.competition("pendubot"), **options)
    trajectory = run(scenario, controller, key, duration=2.0)

    def step(memory, now):
        measured, torque = now
        memory, estimate = seer(memory, measured)
        return seer.applied(memory, torque), estimate

    memory, estimate = jax.lax.scan(
        step, seer.reset(), (trajectory.x_measured, trajectory.u_command)
    )
    return trajectory.x[:-1], estimate, memory


@both_precisions
def test_on_the_nominal_plant_the_estimate_is_the_state(dtype):
    plant, law = swinging(dtype)
    x0 = jnp.asarray([0.3, -0.2, 0.5, 1.0], dtype)
    true, estimate, _ = watched(Scenario(plant, x0=x0), law)
    assert np.abs(true[:, 2:]).max() > 3  # it moves
    # In float32 the rounding of an angle, over a step, is a velocity of 1e-4 rad/s.
    assert_close(estimate, true, times=20)


@pytest.mark.x64
@pytest.mark.parametrize("noise", [(1e-2, 0.0), (3e-3, 0.0), (0.0, 0.5), (0.0, 5.0), (3e-3, 0.5)])
def test_noise_of_any_level_is_found_and_averaged_away(noise):
    plant, law = swinging("float64")
    spread = np.repeat(noise, 2)
    x0 = jnp.array([0.3, -0.2, 0.5, 1.0])
    scenario = Scenario(plant, x0=x0, measurement_noise=jnp.asarray(spread))
    true, estimate, memory = watched(scenario, law)
    error = np.sqrt(np.mean((estimate - true)[500:] ** 2, axis=0))
    for part, level in ((slice(0, 2), noise[0]), (slice(2, 4), noise[1])):
        if level:
            assert error[part].max() < 0.6 * level
    # Half the mean squared change of an innovation is the variance, averaged over 50 calls here.
    found = np.sqrt(0.5 * np.asarray(memory.change))
    for row, level in zip(found, noise, strict=True):
        if level:
            np.testing.assert_allclose(row, level, rtol=0.5)
    # Angles of 3 mrad, differentiated over one call, are a velocity of 2 rad/s.
    assert error[2:].max() < 0.4


@pytest.mark.x64
def test_the_gains_are_those_of_the_stationary_riccati_equation():
    """Of one joint, at the least noise; scipy solves the same equation in another form."""
    plant, law = swinging("float64")
    least, wanders, dt = np.array([1e-3, 0.1]), 50.0, 0.002
    options = {"angle_noise": least[0], "velocity_noise": least[1], "disturbance": wanders}
    memory = watched(Scenario(plant, x0=jnp.array([0.3, -0.2, 0.5, 1.0])), law, **options)[2]
    f = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
    h, q = np.eye(2, 3), np.diag([0, 0, wanders**2 * dt])
    before = scipy.linalg.solve_discrete_are(f.T, h.T, q, np.diag(least**2))
    gain = before @ h.T @ np.linalg.inv(h @ before @ h.T + np.diag(least**2))
    after = (np.eye(3) - gain @ h) @ before
    for joint in range(2):
        p = jax.tree.map(lambda leaf, joint=joint: leaf[joint], memory.covariance)
        found = [[p.aa, p.av, p.ad], [p.av, p.vv, p.vd], [p.ad, p.vd, p.dd]]
        np.testing.assert_allclose(found, after, rtol=1e-6)


@pytest.mark.x64
def test_a_wrong_model_costs_little_and_less_where_more_disturbance_is_expected():
    plant, law = swinging("float64")
    heavy = Scenario(plant.replace(mass=plant.mass * 1.25, damping=plant.damping + 0.05))
    errors = []
    for disturbance in (1.0, 30.0, 300.0):
        true, estimate, _ = watched(heavy, law, disturbance=disturbance)
        errors.append(np.abs(estimate - true)[50:, 2:].max())
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 0.02 * np.abs(true[:, 2:]).max()


@pytest.mark.x64
def test_the_observer_of_older_files_looks_at_angles_alone():
    plant, law = swinging("float64")
    trajectory = run(Scenario(plant, x0=jnp.array([0.3, -0.2, 0.5, 1.0])), law, KEY, duration=0.5)
    seer = Observer(plant, jnp.array([0.5, 100.0, 8000.0]))
    memory = seer.reset()
    for k in range(20):
        measured = trajectory.x[k].at[2:].add(0.0 if k == 0 else 5.0)
        memory, estimate = seer(memory, measured)
        memory = seer.applied(memory, trajectory.u_command[k])
        assert_close(estimate, trajectory.x[k])


@both_robots
def test_the_guard_leaves_a_swing_up_that_works_alone(robot):
    plant = designs.competition(robot)
    main = tvlqr(plant, load_reference(robot))
    alone = run(Scenario(plant), main, KEY)
    guarded = run(Scenario(plant), guard(main, robot), KEY)
    assert np.abs(guarded.x - alone.x).max() < 0.02
    assert upright(guarded.x[-1])


@both_robots
def test_rescue_brings_up_what_has_failed_and_only_that(robot):
    scenario, lost = Scenario(designs.competition(robot)), Zero()
    rescued = run(scenario, guard(lost, robot, after=0.5), KEY)
    before = rescued.t[:-1] <= 0.5
    assert np.all(np.asarray(rescued.u)[before] == 0)
    assert np.any(np.asarray(rescued.u)[~before] != 0)
    assert upright(rescued.x[-1])
    left = run(scenario, guard(lost, robot, rescue=False), KEY)
    assert not upright(left.x[-1])


def test_rescue_takes_over_for_good():
    """Near upright again, the failed controller stays off."""
    one = Feedback(lambda t, x: jnp.ones(2))
    two = Feedback(lambda t, x: jnp.full(2, 2.0))
    both = Guarded(one, rescue=Rescue(two, jnp.asarray(1.0), jnp.asarray(0.3)))
    memory, torques = both.reset(KEY), []
    for t, angle in [(0.5, 0.0), (1.5, np.pi), (2.0, np.pi - 0.4), (2.5, np.pi)]:
        memory, torque = both(memory, jnp.asarray(t), jnp.array([angle, 0.0, 0.0, 0.0]))
        torques.append(float(torque[0]))
    assert torques == [1, 1, 2, 2]


@pytest.mark.x64
def test_too_much_energy_is_a_failure_at_any_time():
    plant = designs.competition("acrobot")
    upright = jnp.array([jnp.pi, 0.0, 0.0, 0.0])
    rescue = guard(Zero(), "acrobot", excess=0.5).rescue
    inertia = np.asarray(mass_matrix(plant, upright))[1, 1]
    for energy, failed in ((0.49, False), (0.51, True)):
        spinning = upright.at[3].set(np.sqrt(2 * energy / inertia))
        assert rescue.failed(jnp.array(0.1), spinning) == failed
    # A guard of a file that knows no such limit.
    assert not rescue.replace(excess=None, plant=None).failed(jnp.array(0.1), spinning)


def test_what_spins_is_stopped_before_it_is_too_fast():
    """A driven joint that pushes by itself: TVLQR misses the top and spins it up."""
    plant = designs.competition("pendubot")
    pushing = Scenario(plant.replace(damping=np.array([-0.086, 0.0])))
    main = tvlqr(plant, load_reference("pendubot"), r=10.0)
    assert upright(run(pushing, guard(main, "pendubot"), KEY).x[-1])
    assert not upright(run(pushing, guard(main, "pendubot", excess=np.inf), KEY).x[-1])


def test_velocity_noise_and_delay_do_not_reach_a_guarded_controller():
    """The worst velocity noise of the benchmark, under which the bare controller fails."""
    robot, plant = "acrobot", designs.competition("acrobot")
    worst = next(s for s in strips(plant) if s.variation == "velocity_noise").values[-1]
    main = tvlqr(plant, load_reference(robot))
    noisy = Scenario(plant, measurement_noise=worst * np.array([0.0, 0.0, 1.0, 1.0]))
    late = Scenario(plant, delay=delay_steps(0.04, mode="vel"))
    for wrong in (noisy, late):
        assert not upright(run(wrong, main, KEY).x[-1])
        assert upright(run(wrong, guard(main, robot, rescue=False), KEY).x[-1])


@both_precisions
def test_vmap_is_a_loop_and_jit_is_eager(dtype):
    plant, law = swinging(dtype)
    plants = jax.tree.map(lambda a: jnp.stack([a, 1.05 * a]), plant)
    guarded = guard(law, "pendubot", after=0.05)
    short = jax.jit(lambda p: rollout(Scenario(p), guarded, KEY, duration=0.1).x)
    batch = jax.vmap(short)(plants)
    assert batch.dtype == dtype
    for i in range(2):
        one = jax.tree.map(lambda a, i=i: a[i], plants)
        assert_close(batch[i], short(one), times=5)
    memory, x = guarded.reset(KEY), jnp.asarray([0.1, 0.2, 0.3, 0.4], dtype)
    eager = guarded(memory, jnp.asarray(1.0, dtype), x)
    jitted = jax.jit(lambda c, *now: c(*now))(guarded, memory, jnp.asarray(1.0, dtype), x)
    jax.tree.map(lambda a, b: assert_close(a, b), eager[1], jitted[1])


def test_a_model_is_one_integration_step_ahead():
    """Without a measurement error the estimate is the integrator's, whatever came before."""
    plant = designs.competition("acrobot")
    seer, x = observer(plant), jnp.array([0.4, -0.3, 1.0, 2.0])
    memory, _ = seer(seer.reset(), x)
    memory = seer.applied(memory, jnp.array([9.0, 99.0]))  # more than there is
    ahead = rk4_step(plant, x, jnp.asarray(plant.torque_limit, x.dtype), 0.002)
    _, estimate = seer(memory, ahead)
    assert_close(estimate, ahead)


@both_robots
def test_angles_as_noisy_as_those_of_an_encoder_do_not_throw_a_guarded_policy(robot):
    plant = designs.competition(robot)
    main = guard(network_in(load_policy(robot)), robot)
    noisy = Scenario(plant, measurement_noise=jnp.array([3e-3, 3e-3, 0.0, 0.0]))
    keys = jax.random.split(KEY, 20)
    ends = jax.jit(jax.vmap(lambda key: upright(rollout(noisy, main, key).x[-1])))
    assert ends(keys).mean() >= 0.95


def test_a_slow_swing_up_that_works_is_not_rescued():
    """Hanging for three seconds, then the swing-up; and one that needs more energy than usual."""
    robot = "pendubot"
    plant = designs.competition(robot)
    slow = Late(tvlqr(plant, load_reference(robot), r=10.0), jnp.asarray(3.0))
    alone = run(Scenario(plant), slow, KEY)
    assert upright(alone.x[-1])
    guarded = guard(slow, robot, excess=0.002)
    assert 4.0 < guarded.rescue.after < 6.0
    assert guarded.rescue.excess > 0.004
    np.testing.assert_allclose(run(Scenario(plant), guarded, KEY).x[-1], alone.x[-1], atol=0.01)
    # What does not stand is rescued as asked.
    assert guard(Zero(), robot, excess=0.002).rescue.excess == np.float32(0.002)


def test_nonsense_is_refused_and_nothing_is_added_for_nothing():
    plant, main = designs.competition("acrobot"), Zero()
    assert guard(main, "acrobot", observe=False, rescue=False) is main
    wrong = [{"after": 0.0}, {"radius": -1.0}, {"excess": 0.0}, {"angle_noise": -1.0}]
    for options in [*wrong, {"velocity_noise": np.inf}, {"velocity_noise": np.nan}]:
        with refused("must be positive"):
            guard(main, "acrobot", **options)
    for options in ({"disturbance": 0.0}, {"dt": -0.002}):
        with refused("it must be positive and finite"):
            observer(plant, **options)
    with refused("robot"):
        guard(main, "cartpole")


@both_robots
@pytest.mark.parametrize("dt", [0.001, 0.005, 0.01])
def test_the_observer_counts_on_the_period_at_which_it_is_called(robot, dt):
    policy, plant = load_policy(robot), designs.competition(robot)
    run = rollout(plant, policy, KEY, dt=dt, duration=5.0)
    assert upright(run.x[-1])
    stepper = policy.start(dt=dt)
    torques = np.array([stepper.torque(x) for x in run.x_measured[:20]])
    np.testing.assert_allclose(torques, run.u_command[:20], atol=1e-4)


def test_a_controller_in_a_tuple_is_called_at_the_period_too():
    own = load_policy("pendubot").observer
    assert called_every(own, own.dt) is own
    assert called_every((own, [own], 1), 0.01)[1][0].dt == 0.01
    older = Observer(own.plant, jnp.array([0.5, 40.0, 800.0]))
    np.testing.assert_allclose(called_every(older, 0.004).gain, [0.5, 20.0, 200.0])
