"""The observer sees what the sensors do not say, and the rescue takes over what has failed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, both_precisions, both_robots

from jaxpend import JaxpendError, Scenario, designs, rollout
from jaxpend.controllers import Feedback, Zero, guard, load_reference, tvlqr
from jaxpend.controllers.guard import Guarded, Rescue, observer
from jaxpend.plant import mass_matrix, rk4_step
from jaxpend.robustness import strips
from jaxpend.scenario import delay_steps
from jaxpend.sweep import upright

KEY = jax.random.key(0)
run = jax.jit(rollout, static_argnames=("duration",))


def swinging(dtype, robot="pendubot"):
    """A plant, and torques that keep both links moving."""
    plant = jax.tree.map(lambda v: jnp.asarray(v, dtype), designs.competition(robot))
    joint = designs.active_joint(robot)

    def law(t, x):
        torque = 2.0 * jnp.sin(7.0 * t) - 0.1 * x[2 + joint]
        return jnp.where(jnp.arange(2) == joint, torque, 0.0)

    return plant, Feedback(law)


def watched(scenario, controller, bandwidth):
    """True and estimated states (N, 4) of a run of 2 s."""
    seer = observer(designs.competition("pendubot"), bandwidth)
    trajectory = run(scenario, controller, KEY, duration=2.0)

    def step(memory, now):
        measured, torque = now
        memory, estimate = seer(memory, measured)
        return seer.applied(memory, torque), estimate

    seen = (trajectory.x_measured, trajectory.u_command)
    return trajectory.x[:-1], jax.lax.scan(step, seer.reset(), seen)[1]


@both_precisions
def test_on_the_nominal_plant_the_estimate_is_the_state(dtype):
    plant, law = swinging(dtype)
    x0 = jnp.asarray([0.3, -0.2, 0.5, 1.0], dtype)
    true, estimate = watched(Scenario(plant, x0=x0), law, 300.0)
    assert np.abs(true[:, 2:]).max() > 3  # it moves
    # In float32 the rounding of an angle, over a step, is a velocity of 1e-4 rad/s.
    assert_close(estimate, true, times=20)


@pytest.mark.x64
def test_velocity_measurements_after_the_first_are_not_looked_at():
    plant, law = swinging("float64")
    noise = jnp.array([0.0, 0.0, 5.0, 5.0])
    x0 = np.array([0.3, -0.2, 0.5, 1.0])
    seer = observer(plant, 300.0)
    _, estimate = seer(seer.reset(), x0)
    assert_close(estimate, x0)
    true, estimate = watched(Scenario(plant, measurement_noise=noise), law, 300.0)
    # Wrong at first by the noise of the first sample, then not at all.
    assert np.abs(estimate[0, 2:] - true[0, 2:]).max() > 1
    assert np.abs(estimate[50:] - true[50:]).max() < 1e-5


@pytest.mark.x64
def test_a_wrong_model_costs_little_and_less_with_bandwidth():
    plant, law = swinging("float64")
    heavy = Scenario(plant.replace(mass=plant.mass * 1.25, damping=plant.damping + 0.05))
    errors = {}
    for bandwidth in (50.0, 100.0, 200.0):
        true, estimate = watched(heavy, law, bandwidth)
        errors[bandwidth] = np.abs(estimate - true)[50:, 2:].max()
    # Velocity lags by the second derivative of the disturbance over the bandwidth squared.
    assert errors[50.0] > 2 * errors[100.0] > 4 * errors[200.0]
    assert errors[200.0] < 0.02 * np.abs(true[:, 2:]).max()


@pytest.mark.x64
def test_the_error_has_all_its_poles_at_the_bandwidth():
    bandwidth, dt = 120.0, 0.004
    l1, l2, l3 = observer(designs.competition("acrobot"), bandwidth, dt=dt).gain
    predict = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
    correct = np.eye(3) - np.outer([l1, l2, l3], [1, 0, 0])
    # Compared as polynomials: a triple root is found to a third of the digits only.
    found = np.poly(correct @ predict)
    np.testing.assert_allclose(found, np.poly(np.full(3, np.exp(-bandwidth * dt))), atol=1e-12)


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
    seer, x = observer(plant, 300.0), jnp.array([0.4, -0.3, 1.0, 2.0])
    memory, _ = seer(seer.reset(), x)
    memory = seer.applied(memory, jnp.array([9.0, 99.0]))  # more than there is
    ahead = rk4_step(plant, x, jnp.asarray(plant.torque_limit, x.dtype), 0.002)
    _, estimate = seer(memory, ahead)
    assert_close(estimate, ahead)


def test_nonsense_is_refused_and_nothing_is_added_for_nothing():
    plant, main = designs.competition("acrobot"), Zero()
    assert guard(main, "acrobot", bandwidth=0.0, rescue=False) is main
    for wrong in ({"after": 0.0}, {"radius": -1.0}, {"excess": 0.0}, {"bandwidth": -1.0}):
        with pytest.raises(JaxpendError, match="must be positive"):
            guard(main, "acrobot", **wrong)
    with pytest.raises(JaxpendError, match="must be positive"):
        observer(plant, 0.0)
    with pytest.raises(JaxpendError, match="robot"):
        guard(main, "cartpole")
