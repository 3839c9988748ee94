"""The short-horizon actor-critic: its gradient, its critic, that it learns, and what it refuses."""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused, shipped_network

from jaxpend import load_policy, shac
from jaxpend.boards import v2, v3
from jaxpend.config import SHACConfig, TrainRun
from jaxpend.controllers.guard import guard
from jaxpend.controllers.search_space import coordinates
from jaxpend.plant import UPRIGHT, tip_height
from jaxpend.pytree import in_default
from jaxpend.rollout import rollout
from jaxpend.runs.checkpoints import Checkpoints
from jaxpend.scenario import Scenario
from jaxpend.shac import SHAC, Value, ahead, improve, init, targets, up
from jaxpend.train.loop import stages_of

TASK = v3("pendubot").task
SMALL = SHACConfig(
    steps=8, critic_steps=2, num_arms=4, window=0.08, critic_hidden=(8,), critic_updates=2, chunk=3
)
POLICY = load_policy("global_pendubot")
KEY = jax.random.key(0)


def critic_of(config):
    return Value(config.critic_hidden).init(KEY, jnp.zeros(4))


def test_up_is_half_on_the_line_and_whole_above_it():
    length = TASK.plant.length
    angle = np.arccos(-TASK.height)  # of an arm that is straight, with its tip on the line
    x = jnp.array([[angle, 0, 0, 0], [np.pi, 0, 3, 0], [0, 0, 0, 0]])
    np.testing.assert_allclose(tip_height(length, x)[0], 0.9 * length.sum(), rtol=1e-5)
    np.testing.assert_allclose(up(SMALL, TASK, x), [0.5, 1, 0], atol=0.1)
    np.testing.assert_allclose(up(SMALL, TASK, x)[0], 0.5, atol=1e-3)


@pytest.mark.x64
@pytest.mark.parametrize("randomised", [0.0, 1.0])
def test_the_gradient_is_that_of_finite_differences(randomised):
    policy, critic = in_default((POLICY, critic_of(SMALL)))
    z, _, rebuild = coordinates(policy)
    direction = jax.random.normal(KEY, z.shape)
    config = dataclasses.replace(SMALL, randomised=randomised)
    scenario = shac.window(config, TASK, jnp.array([2.8, 0.3, 1.0, -2.0]), jax.random.key(3))
    assert (scenario.delay is not None) == (randomised > 0)

    def worth(z):
        return run(z, scenario)

    @jax.jit
    def run(z, scenario):
        return ahead(config, rebuild(z), critic, scenario, KEY, TASK)[0]

    found = jax.grad(worth)(z) @ direction
    step = 1e-6
    wanted = (worth(z + step * direction) - worth(z - step * direction)) / (2 * step)
    assert abs(wanted) > 1e-4
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


@pytest.mark.x64
def test_the_worth_of_a_window_and_the_targets_are_discounted_sums():
    config = dataclasses.replace(SMALL, horizon=0.1, trace=0.05)
    policy, critic = in_default((POLICY, critic_of(config)))
    scenario = Scenario(TASK.plant, x0=jnp.array([2.8, 0.3, 1.0, -2.0]))
    worth, x = ahead(config, policy, critic, scenario, KEY, TASK)
    rewards, values = up(config, TASK, x[1:]), Value(config.critic_hidden).apply(critic, x)
    steps = len(x) - 1
    assert steps == 20
    g, trace = np.exp(-0.004 / 0.1), np.exp(-0.004 / 0.05)

    def after(t, n):
        """The return of n steps from step t on, and then what the critic says."""
        seen = sum((1 - g) * g**k * rewards[t + k] for k in range(n))
        return seen + g**n * values[t + n]

    np.testing.assert_allclose(worth, after(0, steps), rtol=1e-9)
    found = targets(config, critic, x, TASK)
    assert found.shape == (steps,)
    for t in (0, 7, steps - 1):
        left = steps - t
        wanted = sum((1 - trace) * trace ** (n - 1) * after(t, n) for n in range(1, left))
        wanted += trace ** (left - 1) * after(t, left)
        np.testing.assert_allclose(found[t], wanted, rtol=1e-9)


def test_arms_are_thrown_and_put_anywhere_and_never_lost(monkeypatch):
    marked = jnp.array([1.0, 2.0, 3.0, 4.0])
    monkeypatch.setattr(shac, "_thrown", lambda task, x, key: marked)
    config = dataclasses.replace(SMALL, thrown=0.5, anywhere=0.25, kicks=0.0)
    x = jnp.tile(jnp.array(UPRIGHT), (4000, 1))
    x = x.at[:10, 2].set(jnp.nan).at[10:20, 3].set(1e3)
    keys = jax.random.split(KEY, 4000)
    after = np.asarray(jax.vmap(partial(shac.elsewhere, config, TASK))(x, keys))
    assert np.isfinite(after).all()
    assert np.abs(after[:20, 2:]).max() < shac.FASTEST
    shares = [(after == state).all(axis=1).mean() for state in (x, marked, 0)]
    np.testing.assert_allclose(shares, [0.25, 0.5, 0.05], atol=0.03)
    kicked = dataclasses.replace(config, thrown=0.0, anywhere=0.0, kicks=0.03)
    off = np.asarray(jax.vmap(partial(shac.elsewhere, kicked, TASK))(x, keys) - x)[20:]
    assert (off != 0).any(axis=1).all()
    # Of u^2 normal, u uniform, the standard deviation is the square root of 1/5.
    np.testing.assert_allclose(off.std(axis=0), 0.03 * np.array([1, 1, 10, 10]) / 5**0.5, rtol=0.1)


def test_some_windows_are_in_random_scenarios_with_delays_in_steps_of_the_window():
    config = dataclasses.replace(SMALL, randomised=0.5)
    x = jnp.array(UPRIGHT)
    met = jax.vmap(lambda key: shac.window(config, TASK, x, key))(jax.random.split(KEY, 1200))
    delay = np.asarray(met.delay)[:, 0]
    assert (delay > 0).mean() == pytest.approx(0.5 / 6, abs=0.03)
    assert delay.max() == 10  # 40 ms in steps of 4 ms


@pytest.mark.x64
def test_the_step_is_the_natural_gradient():
    """Against the equation with the whole matrix, which few parameters allow."""
    kernel, bias = jax.random.normal(KEY, (POLICY.observation.size, 1)), jnp.zeros(1)
    policy = in_default(POLICY).replace(layers=((0.3 * kernel, bias),))
    z, _, rebuild = coordinates(policy)
    assert len(z) <= shac.ITERATIONS
    slope = jax.random.normal(jax.random.key(1), z.shape)
    x = jax.random.normal(jax.random.key(2), (300, 4)) * jnp.array([2.0, 2.0, 5.0, 5.0])

    def actions(z):
        return jax.vmap(lambda x: rebuild(z)((None, None), 0.0, x)[1].sum())(x) / 6.0

    jacobian = np.asarray(jax.jacobian(actions)(z))
    matrix = jacobian.T @ jacobian / len(x) + shac.DAMPING * np.eye(len(z))
    wanted = np.linalg.solve(matrix, slope)
    wanted /= np.sqrt(wanted @ matrix @ wanted)
    found = shac.natural(rebuild, z, slope, x)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-6)
    assert slope @ found > 0
    assert np.isfinite(shac.natural(rebuild, z, 0 * slope, x)).all()


@pytest.mark.parametrize(
    ("gained", "taken"),
    [
        (lambda size: size, 1.0),  # the further the better
        (lambda size: 1 - abs(size - 0.5), 0.5),
        (lambda size: 1 - abs(size - 0.2), 0.25),
        (lambda size: -size, 0.0),  # worse everywhere
        (lambda size: jnp.nan * size, 0.0),
    ],
)
def test_of_a_step_the_part_is_taken_that_gains_most(gained, taken):
    config = dataclasses.replace(SMALL, trust=0.02)
    z, _, rebuild = coordinates(POLICY)
    state = init(config, POLICY, KEY, TASK).replace(steps=jnp.asarray(5))
    slope, x = jax.random.normal(KEY, z.shape), jnp.zeros((4, 21, 4))
    whole = shac._trust(config, jnp.asarray(3)) * shac.natural(rebuild, z, slope, x[:, 0])

    def worth(other):
        return gained(jnp.linalg.norm(other - z) / jnp.linalg.norm(whole))

    after = shac._climb(config, rebuild, state, slope, x, worth).parameters
    np.testing.assert_allclose(after - z, taken * whole, rtol=1e-2, atol=1e-6)


def test_the_critic_learns_alone_first_and_then_what_a_policy_has_lost():
    """A policy that has become timid stands up sooner after some steps."""
    *hidden, (kernel, bias) = POLICY.layers
    timid = POLICY.replace(layers=(*hidden, (0.3 * kernel, 0.3 * bias)))
    config = SHACConfig(steps=180, critic_steps=60, num_arms=48, dt=0.01, trust=0.03)
    start = init(config, timid, KEY, TASK)
    keys = jax.random.split(jax.random.key(1), 256)
    x = jax.vmap(partial(shac._thrown, TASK, jnp.array(UPRIGHT)))(keys)

    @jax.jit
    def share(policy):
        def states(x):
            scenario = Scenario(TASK.plant, x0=x)
            return rollout(scenario, policy, KEY, dt=config.dt, duration=1.5).x

        return up(config, TASK, jax.vmap(states)(x)).mean()

    alone, metrics = improve(config, timid, start, 60, TASK)
    losses = np.asarray(metrics["critic_loss"])
    assert losses[-10:].mean() < 0.3 * losses[:3].mean()
    np.testing.assert_array_equal(alone.parameters, start.parameters)
    assert not np.array_equal(alone.x, start.x)
    state = alone
    for _ in range(2):
        state, metrics = improve(config, timid, state, 60, TASK)
        assert np.isfinite(metrics["slope"]).all()
    assert (np.asarray(state.parameters) != np.asarray(start.parameters)).mean() > 0.5
    assert int(state.steps) == 180
    assert int(state.lost) == 0
    before, after = share(timid), share(shac.current(config, timid, state))
    assert after > before + 0.05


def test_the_stage_goes_on_from_a_checkpoint_as_if_nothing_had_been(tmp_path):
    stages = stages_of(TrainRun(board="v3", shac=SMALL), None, TASK)
    assert list(stages) == ["sac", "shac", "snes"]
    stage = SHAC(dataclasses.replace(SMALL, randomised=0.5), POLICY, TASK)
    state, checkpoints = stage.start(0, POLICY), Checkpoints(tmp_path)
    for count in (3, 6, 8):
        checkpoints.save({"state": state}, {})
        ((after, metrics),) = stage.advance([state])
        read, _ = checkpoints.newest(lambda _: {"state": stage.like()})
        ((again, _),) = stage.advance([read["state"]])
        chex.assert_trees_all_equal(after, again)
        assert stage.done(after) == count
        assert np.isfinite(metrics["slope"]).all()
        assert not np.array_equal(after.search.parameters, state.search.parameters)
        state = after
    row, [(policy, worth)] = stage.judge(state, metrics)
    assert worth == row["score"]
    assert row["lost"] == 0
    assert stage.policy_like().layers[0][0].shape == policy.layers[0][0].shape
    other = stage.rekey(state, 1)
    assert not np.array_equal(jax.random.key_data(other.search.key), state.search.key)


@pytest.mark.parametrize(
    ("policy", "task", "words"),
    [
        (shipped_network(), v2("pendubot").task, "this task has another score"),
        (guard(POLICY, "pendubot"), TASK, "not Guarded"),
        (load_policy("hardware_pendubot"), TASK, "not one with a memory"),
        (lambda x: x, TASK, "controller"),
    ],
)
def test_what_it_cannot_improve_is_refused(policy, task, words):
    with refused(words):
        init(SMALL, policy, KEY, task)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"steps": 600}, "steps is 600; it must be more than the 600 of critic_steps"),
        ({"dt": 0.6}, "dt is 0.6; it must not be longer than window"),
        ({"trust": 0.0}, "trust is 0.0"),
        ({"thrown": 0.99, "anywhere": 0.1}, "thrown and anywhere are 0.99 and 0.1"),
    ],
)
def test_values_that_mean_nothing_are_refused(options, words):
    with refused(words):
        SHACConfig(**options)
