"""Physics: against the reference's numbers, and against laws that no sign error survives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, both_precisions, both_robots, excerpt, plant_from
from hypothesis import given
from hypothesis import strategies as st

from jaxpend import plant as physics
from jaxpend.designs import available, load
from jaxpend.trigonometry import arctan, sincos

DT = 0.002
EVALUATED = {
    "M": physics.mass_matrix,
    "C": physics.coriolis_matrix,
    "G": physics.gravity_vector,
    "F": physics.friction_vector,
    "Ekin": physics.kinetic_energy,
    "Epot": physics.potential_energy,
    "Etot": physics.total_energy,
    "fk": physics.forward_kinematics,
}
angle, speed, torque = st.floats(-4, 4), st.floats(-10, 10), st.floats(-6, 6)
states = st.tuples(angle, angle, speed, speed).map(np.array)
torques = st.tuples(torque, torque).map(np.array)
models = st.sampled_from(available()).map(lambda name: load(*name.split("/")))


def golden_rows():
    """Plants, states, torques and the reference's outputs of the random rows."""
    g = excerpt("dynamics")
    columns = [g[k] for k in ("m", "l", "r", "I", "b", "cf")]
    columns += [g[k][:, None] for k in ("g", "Ir", "gr")]
    plants = plant_from(np.concatenate(columns, axis=1), np.full((len(g["x"]), 2), np.inf), g["B"])
    dtype = jnp.result_type(float)
    return plants, jnp.asarray(g["x"], dtype), jnp.asarray(g["tau"], dtype), g


@jax.jit
def all_outputs(plants, x, u):
    """Everything the excerpt has, for a batch, in one program."""

    def one(plant, x, u):
        a, b = physics.linearize(plant, x, u)
        moved = {
            "rhs": physics.dynamics(plant, x, u),
            "rk4_next": physics.rk4_step(plant, x, u, DT),
            "euler_next": physics.euler_step(plant, x, u, DT),
        }
        return {k: f(plant, x) for k, f in EVALUATED.items()} | moved | {"A_sym": a, "B_sym": b}

    return jax.vmap(one)(plants, x, u)


@both_precisions
def test_every_quantity_matches_the_reference(dtype):
    plants, x, u, golden = golden_rows()
    # An ill-conditioned mass matrix and a steep arctan magnify the rounding of float32.
    times = {"rhs": 10, "A_sym": 20, "B_sym": 10, "F": 2, "euler_next": 2}
    for name, value in all_outputs(plants, x, u).items():
        assert value.dtype == dtype
        size = np.max(np.abs(golden[name]), axis=tuple(range(1, golden[name].ndim)), keepdims=True)
        factor = times.get(name, 1) if dtype == "float32" else 1
        assert_close(value / (1 + size), golden[name] / (1 + size), times=factor, what=name)


@both_precisions
@both_robots
def test_single_steps_of_the_reference_runs(robot, dtype):
    g = excerpt(f"trajectories_{robot}")
    plants = plant_from(g["step_params"], g["step_params"][:, 15:], g["step_B"])
    x, u = (jnp.asarray(g[k], dtype) for k in ("step_x", "step_u"))
    for name, step in {"runge_kutta": physics.rk4_step, "euler": physics.euler_step}.items():
        over_samples = jax.vmap(step, (None, 0, 0, None))
        moved = jax.jit(jax.vmap(over_samples, (0, 0, 0, None)))(plants, x, u, DT)
        cases = g["step_integrator"] == name
        assert cases.any()
        assert_close(moved[cases], g["step_x_next"][cases], what=name)


@jax.jit
def energy_along_swing(plant, x0):
    """Total energy before and after 1 s without torque."""
    no_torque = jnp.zeros(2)
    step = lambda x, _: (physics.rk4_step(plant, x, no_torque, DT), None)  # noqa: E731
    x_end, _ = jax.lax.scan(step, x0, length=500)
    return physics.total_energy(plant, x0), physics.total_energy(plant, x_end)


@pytest.mark.x64
@given(states, models)
def test_free_swing_conserves_energy_and_friction_takes_it(x0, plant):
    zero = jnp.zeros(2)
    free = plant.replace(damping=zero, coulomb_friction=zero)
    before, after = energy_along_swing(free, x0)
    assert abs(after - before) < 1e-5 * (1 + abs(before))
    before, after = energy_along_swing(free.replace(damping=zero + 0.01), x0)
    assert after <= before + 1e-9


@jax.jit
def power_balance(plant, x, u):
    """Rate of change of the energy, and the power of torque and friction, W."""
    rate = physics.dynamics(plant, x, u)
    _, gained = jax.jvp(lambda x: physics.total_energy(plant, x), (x,), (rate,))
    driving = plant.actuation * u - physics.friction_vector(plant, x)
    return gained, jnp.sum(driving * x[2:])


@pytest.mark.x64
@given(states, torques, models)
def test_energy_changes_by_the_power_put_in(x, u, plant):
    gained, power = power_balance(plant, x, u)
    np.testing.assert_allclose(gained, power, rtol=1e-8, atol=1e-8)


@jax.jit
def mirrored_steps(plant, x, u):
    """A step, and the step of the mirror image."""
    return physics.rk4_step(plant, x, u, DT), physics.rk4_step(plant, -x, -u, DT)


@pytest.mark.x64
@given(states, torques, models)
def test_mirror_image_moves_as_the_mirror_image(x, u, plant):
    moved, mirrored = mirrored_steps(plant, x, u)
    assert_close(mirrored, -moved)


@jax.jit
def both_sides(plant, x, u):
    """Left and right side of the equations of motion at the acceleration of ``dynamics``."""
    alpha, omega = physics.dynamics(plant, x, u)[2:], x[2:]
    left = physics.mass_matrix(plant, x) @ alpha + physics.coriolis_matrix(plant, x) @ omega
    right = physics.gravity_vector(plant, x) + plant.actuation * u
    return left + physics.friction_vector(plant, x), right


@pytest.mark.x64
@given(states, torques, models)
def test_matrices_and_dynamics_agree(x, u, plant):
    left, right = both_sides(plant, x, u)
    assert_close(left, right, times=10)


@pytest.mark.x64
def test_upright_is_a_saddle_and_hanging_is_stable():
    plant = load("C.1", "1.0").replace(coulomb_friction=jnp.zeros(2), damping=jnp.full(2, 0.01))
    growth = []
    linearize = jax.jit(physics.linearize)
    for theta1 in (0.0, np.pi):
        x, u = jnp.array([theta1, 0.0, 0.0, 0.0]), jnp.zeros(2)
        assert_close(physics.dynamics(plant, x, u), np.zeros(4))
        growth.append(np.linalg.eigvals(linearize(plant, x, u)[0]).real)
    assert np.all(growth[0] < 0)
    assert np.sum(growth[1] > 0) == 2


@pytest.mark.x64
def test_kinematics_give_the_potential_energy_of_masses_at_the_tips():
    plant = load("C.1", "1.0")
    plant = plant.replace(com=plant.length)
    x = jnp.array([0.7, -1.9, 0.0, 0.0])
    position = physics.forward_kinematics(plant, x)
    lifted = plant.gravity * jnp.sum(plant.mass * position[:, 1])
    assert_close(physics.potential_energy(plant, x), lifted)
    # Counter-clockwise seen from the front: a positive angle moves the tip to positive x.
    assert position[0, 0] > 0
    up = physics.forward_kinematics(plant, jnp.array([jnp.pi, 0.0, 0.0, 0.0]))
    assert_close(up[1], [0.0, float(plant.length.sum())])


@pytest.mark.x64
@pytest.mark.parametrize(("name", "order"), [("rk4_step", 4), ("euler_step", 1)])
def test_order_of_the_integrators(name, order):
    plant, step = load("C.1", "1.1"), getattr(physics, name)
    x0, u = jnp.array([2.0, -1.0, 3.0, -4.0]), jnp.array([1.0, -0.5])

    def travel(steps):
        advance = lambda x, _: (step(plant, x, u, 0.08 / steps), None)  # noqa: E731
        return jax.lax.scan(advance, x0, length=steps)[0]

    exact = travel(20000) if order == 1 else travel(2000)
    coarse, fine = (jnp.max(jnp.abs(travel(n) - exact)) for n in (16, 32))
    np.testing.assert_allclose(np.log2(coarse / fine), order, atol=0.1)


@pytest.mark.x64
def test_jitted_and_batched_steps_are_the_plain_ones():
    plants, x, u, _ = golden_rows()
    pick = lambda i: jax.tree.map(lambda leaf: leaf[i], plants)  # noqa: E731
    rows = range(5, 20, 3)
    plain = jnp.stack([physics.rk4_step(pick(i), x[i], u[i], DT) for i in rows])
    batched = jax.jit(jax.vmap(physics.rk4_step, (0, 0, 0, None)))(plants, x, u, DT)
    assert_close(batched[np.array(rows)], plain)


def test_fast_sine_and_cosine_of_single_precision():
    x = np.concatenate([np.linspace(-9, 9, 5001), np.linspace(-8000, 8000, 99_999)]).astype("f4")
    for found, exact in zip(sincos(x), (np.sin, np.cos), strict=True):
        np.testing.assert_allclose(found, exact(x.astype(float)), atol=1e-7)
    slopes = jax.vmap(jax.jacfwd(sincos))(x[:5001])
    np.testing.assert_allclose(slopes[0], np.cos(x[:5001].astype(float)), atol=2e-6)
    np.testing.assert_allclose(slopes[1], -np.sin(x[:5001].astype(float)), atol=2e-6)
    # Of a diverged arm: bounded, and not a number where there is none.
    assert np.abs(sincos(np.float32([1e9, -1e30, 3e38]))).max() <= 1
    assert np.isnan(sincos(np.float32([np.nan, np.inf]))).all()


def test_fast_arctan_of_single_precision():
    x = np.concatenate([np.linspace(-6, 6, 5001), [0.0, np.inf, -np.inf], np.logspace(-9, 9, 99)])
    x = x.astype("f4")
    np.testing.assert_allclose(arctan(x), np.arctan(x.astype(float)), atol=2e-7)
    slope = jax.vmap(jax.grad(arctan))(x[:5001])
    np.testing.assert_allclose(slope, 1 / (1 + x[:5001].astype(float) ** 2), atol=2e-6)
    assert np.isnan(arctan(np.float32(np.nan)))
