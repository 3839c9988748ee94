"""The optimiser: against exact solutions, against finite differences, inside its box."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import task_of
from scipy.linalg import solve_discrete_are

from jaxpend import JaxpendError, designs
from jaxpend.score import criteria, score_v2
from jaxpend.trajopt import ilqr, swingup
from jaxpend.trajopt import search as optimise


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


A = np.array([[1.0, 0.1], [0.2, 0.9]])
B = np.array([0.0, 0.1])
Q, R = np.diag([1.0, 0.5]), 0.2


def linear_quadratic(p_end):
    """z' = A z + B u with quadratic cost: one iteration must solve it."""
    return ilqr.Problem(
        step=lambda p, z, u: A @ z + B * u,
        features=lambda p, k, z, u: jnp.stack([z @ Q @ z, R * u * u]),
        final=lambda p, z: z @ p_end @ z,
        outer=lambda p, totals: jnp.sum(totals),
    )


def test_linear_quadratic_problem_is_solved_in_one_iteration_with_the_riccati_gain():
    p_end = solve_discrete_are(A, B[:, None], Q, R * np.eye(1))
    gain = (B @ p_end @ A) / (R + B @ p_end @ B)
    z0 = jnp.array([1.0, -0.5])
    found = ilqr.solve(
        linear_quadratic(p_end), None, z0, jnp.zeros(30), 100.0, iterations=1, mu=0.0
    )
    np.testing.assert_allclose(found.cost, z0 @ p_end @ z0, rtol=1e-10)
    np.testing.assert_allclose(found.gain, np.tile(-gain, (30, 1)), rtol=1e-7)
    np.testing.assert_allclose(found.u, -found.z[:-1] @ gain, rtol=1e-7, atol=1e-12)


def test_box_is_respected_and_optimal():
    """With a tight box the result satisfies the first-order conditions of the bounded problem."""
    problem, z0, limit = linear_quadratic(10 * np.eye(2)), jnp.array([0.3, -0.1]), 0.6
    solve = jax.jit(lambda u: ilqr.solve(problem, None, z0, u, limit, iterations=30))
    found = solve(jnp.zeros(20))
    starts = jnp.stack([jnp.zeros(20), jnp.ones(20)])
    np.testing.assert_allclose(jax.vmap(solve)(starts).u[0], found.u, atol=1e-9)
    assert np.abs(found.u).max() == limit

    def cost(u):
        z = z0
        total = 0.0
        for k in range(20):
            total += z @ Q @ z + R * u[k] ** 2
            z = A @ z + B * u[k]
        return total + z @ (10 * np.eye(2)) @ z

    slope = jax.jit(jax.grad(cost))(found.u)
    inside = np.abs(found.u) < limit
    assert inside.any()
    np.testing.assert_allclose(slope[inside], 0.0, atol=1e-5)
    # At a bound, the cost falls outwards only.
    assert np.all(slope[~inside] * np.sign(found.u[~inside]) <= 1e-9)


def swing(robot="pendubot", dt=0.02, weight=10.0):
    plant = designs.competition(robot)
    return swingup.SwingUp(
        plant,
        jnp.array([jnp.pi, 0.0, 0.0, 0.0, 0.0]),
        weight * jnp.diag(jnp.array([1.0, 1.0, 0.1, 0.1, 0.1])),
        0.1,
        0.3,
        task=task_of(robot),
        dt=dt,
    )


@jax.jit
def objective(p, u):
    """The objective, written once more and without ``ilqr``."""
    problem = swingup.problem()

    def step(carry, now):
        z, totals = carry
        k, u = now
        return (problem.step(p, z, u), totals + problem.features(p, k, z, u)), None

    start = (jnp.zeros(5), jnp.zeros(5))
    (z, totals), _ = jax.lax.scan(step, start, (jnp.arange(len(u)), u))
    return problem.outer(p, totals) + problem.final(p, z)


def test_one_step_of_ddp_is_newtons():
    """With one step left, DDP's change is -J'/J'' of the objective (here a plain sum)."""
    p = swing(dt=0.05)
    problem = swingup.problem().replace(outer=lambda p, totals: jnp.sum(totals))
    z0 = jnp.array([2.5, -0.6, 3.0, 1.0, 0.5])

    def cost(u):
        stage = problem.outer(p, problem.features(p, jnp.array(0), z0, u))
        return stage + problem.final(p, problem.step(p, z0, u))

    @jax.jit
    def changes(u):
        z = jnp.stack([z0, problem.step(p, z0, u)])
        backward = jax.vmap(lambda mu: ilqr._backward(problem, p, z, u[None], 50.0, mu, True)[0])
        return backward(jnp.zeros(1))[0, 0], -jax.grad(cost)(u) / jax.hessian(cost)(u)

    np.testing.assert_allclose(*changes(jnp.array(0.7)), rtol=1e-8)


def test_derivatives_of_the_step_match_finite_differences():
    p, problem = swing("acrobot"), swingup.problem()
    z = jnp.array([[1.0, -0.7, 2.0, -3.0, 0.4], [1.1, -0.8, 1.5, -2.0, 0.9]])
    u = jnp.array([0.8])
    f_w, f_ww, _, l_ww = jax.jit(lambda: ilqr._derivatives(problem, p, z, u, True))()
    h = 1e-5

    @jax.jit
    def step(w):
        return problem.step(p, w[:5], w[5])

    w = jnp.append(z[0], u)
    directions = h * np.eye(6)
    numeric = np.stack([(step(w + d) - step(w - d)) / (2 * h) for d in directions], axis=1)
    np.testing.assert_allclose(f_w[0], numeric, rtol=1e-6, atol=1e-8)
    jacobian = jax.jit(jax.jacfwd(step))
    numeric = np.stack([(jacobian(w + d) - jacobian(w - d)) / (2 * h) for d in directions], axis=2)
    np.testing.assert_allclose(f_ww[0], numeric, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(l_ww[0], l_ww[0].T, atol=1e-12)


def test_smooth_score_approaches_the_official_one():
    """On a shipped swing-up the smooth objective is the official penalty to a few thousandths."""
    from jaxpend.controllers import load_reference

    reference = load_reference("pendubot")
    p = swing(dt=reference.dt, weight=0.0).replace(line_width=0.002, power_width=0.002)
    z = jnp.column_stack([reference.x[:-1], jnp.concatenate([reference.u[:1], reference.u[:-1]])])
    problem = swingup.problem()
    features = jax.vmap(problem.features, in_axes=(None, 0, 0, 0))
    totals = jnp.sum(features(p, jnp.arange(reference.steps), z, reference.u), axis=0)
    t = reference.dt * jnp.arange(reference.steps)
    found = criteria(
        t, reference.x[:-1], reference.both(reference.u), p.plant, t_final=float(t[-1])
    )
    names = ("swingup_time", "energy", "tau_cost", "velocity_cost")
    expected = [float(getattr(found, name)) for name in names]
    np.testing.assert_allclose(totals[np.array([0, 1, 2, 4])], expected, rtol=3e-3)
    # The official standard deviation is over this short run, ours over the 5000 steps of 10 s.
    smoothness = jnp.sqrt(totals[3] / reference.steps)
    np.testing.assert_allclose(smoothness, found.tau_smoothness, rtol=1e-2)
    at_rest = found.__class__(**{**vars(found), "tau_smoothness": jnp.sqrt(totals[3] / 5000)})
    assert abs(1 - problem.outer(p, totals) - score_v2(at_rest)) < 1e-3


def test_swing_up_from_several_starts_in_one_vmap():
    """The pendubot reaches the top from sinusoids, where the open-loop gradient is small.

    It cannot be tiny: what instability multiplies, feedback optimises.
    """
    p, problem = swing(weight=100.0), swingup.problem()
    t = 0.02 * jnp.arange(65)
    u = jnp.stack([1.5 * jnp.sin(w * t) for w in (3.0, 6.0)])

    @jax.jit
    @jax.vmap
    def solve(u):
        return ilqr.solve(problem, p, jnp.zeros(5), u, 6.0, iterations=80)

    found = solve(u)
    best = int(jnp.argmin(found.cost))
    np.testing.assert_allclose(found.z[best, -1, :2], [np.pi, 0.0], atol=0.05)
    slope = jax.jit(jax.grad(objective, argnums=1))
    before, after = slope(p, u[best]), slope(p, found.u[best])
    assert np.abs(found.u[best]).max() < 6.0
    assert np.abs(after).max() < 0.05 * np.abs(before).max()


def test_rejected_iteration_keeps_the_trajectory_and_grows_the_regularisation():
    problem, z0 = linear_quadratic(np.eye(2)), jnp.array([1.0, -0.5])
    now = ilqr.initial(problem, None, z0, jnp.zeros(5))
    impossible = now.replace(cost=jnp.array(-1.0))  # nothing is better than this
    after = jax.jit(lambda now: ilqr.iterate(problem, None, now, 6.0))(impossible)
    np.testing.assert_array_equal(after.u, now.u)
    assert after.rejected == 1
    assert after.mu > now.mu


def test_the_search_looks_within_its_torque_limit(monkeypatch):
    searched = []

    def stop(task, *_):
        searched.append(task.plant.torque_limit)
        raise StopIteration

    monkeypatch.setattr(optimise, "_coarse", stop)
    for search in (optimise.Search(), optimise.Search(torque_limit=1.5)):
        with pytest.raises(StopIteration):
            optimise.find(task_of("acrobot"), search)
    np.testing.assert_array_equal(searched, [[0, 6.0], [0, 1.5]])
    with pytest.raises(JaxpendError, match="torque_limit is -1"):
        optimise.find(task_of("acrobot"), optimise.Search(torque_limit=-1.0))
