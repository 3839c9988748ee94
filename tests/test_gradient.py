"""The gradient through the simulator: what it is, what it does with lost runs, what it achieves."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, refused, shipped_network, task_of
from jax.flatten_util import ravel_pytree

from jaxpend import Policy, Scenario, designs, gradient, retention
from jaxpend.config import GradientConfig, Objective
from jaxpend.controllers import energy_shaping, guard
from jaxpend.controllers.search_space import coordinates
from jaxpend.plant import rk4_step
from jaxpend.scenario import Pulses
from jaxpend.score import nominal, official, score_v2

KEY = jax.random.key(0)
TASK = task_of("pendubot")


def network(robot="pendubot", width=5):
    """A small random policy."""
    rng = np.random.default_rng(1)
    sizes = ((6, width), (width, 1))
    layers = tuple((jnp.asarray(rng.normal(size=s)), jnp.zeros(s[1])) for s in sizes)
    return Policy(layers, jnp.asarray(3.0), robot=robot, activation="tanh")


def numeric(function, z, direction, h=1e-5):
    """Central difference."""
    return (function(z + h * direction) - function(z - h * direction)) / (2 * h)


@pytest.mark.x64
@pytest.mark.parametrize(("robot", "of"), [("acrobot", "performance"), ("pendubot", "robustness")])
def test_gradient_agrees_with_finite_differences(robot, of):
    start = network(robot)
    config = GradientConfig(duration=0.4, scenario_duration=0.4, memory=np.inf, power_width=0.1)
    z, _, rebuild = coordinates(start)
    pulses = Pulses(jnp.full((2, 1), 0.2), jnp.full((2, 1), 0.05), jnp.array([[0.7], [-0.4]]))
    wrong = Scenario(
        designs.competition(robot), jnp.array([2.9, 0.2, 0.3, -0.1]), pulses=pulses,
        measurement_noise=jnp.array([0.0, 0.0, 0.1, 0.1]), delay=np.full(4, 3),
        torque_noise=jnp.array([0.1, 0.1]), responsiveness=jnp.asarray(0.4),
    )  # fmt: skip
    function = {
        "performance": lambda z: gradient.performance(config, rebuild(z), task_of(robot)),
        "robustness": lambda z: gradient.robustness(config, rebuild(z), wrong, KEY, task_of(robot)),
    }[of]
    function, slope = jax.jit(function), jax.jit(jax.grad(function))(z)
    for direction in np.random.default_rng(0).normal(size=(3, len(z))):
        difference = numeric(function, z, direction)
        assert abs(difference) > 1e-6
        np.testing.assert_allclose(slope @ direction, difference, rtol=1e-5)


def test_a_fading_gradient_leaves_values_alone_and_shrinks_with_time():
    plant = designs.competition("acrobot")

    @partial(jax.jit, static_argnums=0)
    def after(integrate, x):
        def step(x, _):
            return integrate(plant, x, jnp.array([0.0, 0.3]), 0.01), None

        return jax.lax.scan(step, x, length=5)[0]

    x, fading = jnp.array([0.3, -0.5, 1.0, 2.0]), gradient._fading(0.1)
    assert_close(after(fading, x), after(rk4_step, x), times=0.1)
    true = jax.jacobian(after, 1)(rk4_step, x)
    assert_close(jax.jacobian(after, 1)(fading, x), np.exp(-0.05 / 0.1) * true)
    assert gradient._fading(np.inf) is rk4_step


def test_uprightness_is_highest_at_rest_on_any_turn_and_half_at_the_edge_of_success():
    top = np.array([np.pi, 0, 0, 0], "f4")
    assert_close(gradient.uprightness(top + 2 * np.pi * np.array([1, -1, 0, 0], "f4")), 1.0)
    assert_close(gradient.uprightness(top + np.array([0, 0, 0, 1], "f4")), 0.5)
    edge = gradient.uprightness(top + np.array([[0.35, 0, 0, 0], [0, -0.35, 0, 0]], "f4"))
    np.testing.assert_allclose(edge, 0.5, atol=0.01)
    assert gradient.uprightness(np.zeros(4, "f4")) < 0.05


def test_smooth_score_of_a_whole_run_is_nearly_the_official_one():
    config, policy = GradientConfig(duration=10.0), shipped_network()
    smooth = jax.jit(lambda p: gradient.performance(config, p, TASK))(policy)
    np.testing.assert_allclose(smooth, official(policy, "pendubot")["score"], atol=2e-3)


def toy_slope(monkeypatch, share=lambda scenario: 1.0):
    """``slope`` of objectives whose gradients are known: ones, and ``share`` in a scenario."""

    def total(controller):
        return ravel_pytree(controller.layers)[0].sum()

    def robustness(config, p, scenario, key, task):
        return share(scenario) * total(p)

    monkeypatch.setattr(gradient, "performance", lambda config, p, task: total(p))
    monkeypatch.setattr(gradient, "robustness", robustness)
    return jax.jit(lambda *arguments: gradient.slope(*arguments), static_argnums=(0, 2))


def test_a_run_that_is_not_finite_is_left_out_and_counted(monkeypatch):
    slope = toy_slope(monkeypatch, lambda scenario: jnp.where(scenario.delay[0] > 0, jnp.nan, 2.0))
    start = network()
    z, _, _ = coordinates(start)
    config = GradientConfig(scenarios=20, objective=Objective(0.25), clip=1e9)
    ascent, lost, metrics = slope(config, start, TASK, z, KEY)
    assert 1 <= lost <= 10
    np.testing.assert_allclose(ascent, 0.75 * 1 + 0.25 * 2, rtol=1e-6)
    np.testing.assert_allclose(metrics["uprightness"], 2 * z.sum(), rtol=1e-5)
    # The nominal run too; and if nothing is left, nothing moves.
    gone = start.replace(layers=jax.tree.map(lambda leaf: leaf * jnp.nan, start.layers))
    ascent, lost, _ = slope(config, gone, TASK, coordinates(gone)[0], KEY)
    assert lost == 21
    np.testing.assert_array_equal(ascent, 0)


def test_each_run_is_clipped_before_they_are_averaged(monkeypatch):
    slope = toy_slope(monkeypatch, lambda scenario: jnp.where(scenario.delay[0] > 0, 1e6, 1e-3))
    start = network()
    z, _, _ = coordinates(start)
    plain = GradientConfig(clip=0.5)
    assert_close(jnp.linalg.norm(slope(plain, start, TASK, z, KEY)[0]), 0.5)
    robust = GradientConfig(clip=0.5, scenarios=20, objective=Objective(1.0))
    ascent, lost, _ = slope(robust, start, TASK, z, KEY)
    assert lost == 0
    assert jnp.linalg.norm(ascent) < 0.5 * 10 / 20


def test_it_improves_the_policy_and_repeats_itself():
    off = shipped_network(bias=0.05)
    config = GradientConfig(steps=40, learning_rate=1e-4)
    state, metrics = gradient.improve(config, off, gradient.init(config, off, KEY), 40, TASK)
    smooth = np.asarray(metrics["smooth_score"])
    assert smooth[-1] > smooth[0] + 0.003
    found = gradient.current(config, off, state)
    before, after = (float(score_v2(nominal(p, TASK))) for p in (off, found))
    assert after > before + 0.003
    assert state.lost == 0
    again, _ = gradient.improve(config, off, gradient.init(config, off, KEY), 40, TASK)
    np.testing.assert_array_equal(again.parameters, state.parameters)


def test_retention_pulls_back_to_what_the_start_did(monkeypatch):
    monkeypatch.setattr(retention, "SHOWN", 8)
    start = shipped_network()
    config = GradientConfig(steps=30, retention=1e4, duration=0.02, learning_rate=1e-3)
    begun = gradient.init(config, start, KEY, TASK)
    away = begun.replace(parameters=begun.parameters + 0.01)
    _, metrics = gradient.improve(config, start, away, 30, TASK)
    assert metrics["change"][-5:].mean() < 0.5 * metrics["change"][0]
    free = dataclasses.replace(config, retention=0.0)
    assert gradient.init(free, start, KEY).retained is None


def test_an_ascent_that_loses_goes_back_to_its_best_with_half_the_rate(monkeypatch):
    """Judged are, in turn, the start and what each step has come to."""
    worths = iter([0.6, 0.65, 0.64, 0.62, 0.66])
    monkeypatch.setattr(gradient.Gradient, "compared", lambda *_: (0.0, next(worths)))
    monkeypatch.setattr(gradient, "slope", lambda c, s, t, z, k: (jnp.ones_like(z), 0, {}))
    config = GradientConfig(steps=40, chunk=1, learning_rate=0.5, duration=0.1)
    stage = gradient.Gradient(config, start := network(), TASK)
    states = [stage.start(0, start)]
    for _ in range(4):
        [(state, row)] = stage.advance(states[-1:])
        _, [(policy, worth)] = stage.judge(state, row)
        states.append(state)
    search = [state.search for state in states]
    np.testing.assert_allclose([s.rate for s in search], [1, 1, 1, 0.5, 0.5])
    # The third step lost 0.03, more than the tolerance, the second one less.
    assert np.any(search[2].parameters != search[1].parameters)
    np.testing.assert_array_equal(search[3].parameters, search[1].parameters)
    assert search[3].worth == search[1].worth
    before, again = search[2], search[4]
    step, half = before.parameters - search[1].parameters, again.parameters - search[3].parameters
    np.testing.assert_allclose(half, step / 2, rtol=1e-4)
    assert worth == again.worth == again.best.worth
    np.testing.assert_array_equal(
        policy.layers[0][0], gradient.current(config, start, again).layers[0][0]
    )


def test_retention_is_of_a_policy_alone():
    config = GradientConfig(retention=1.0)
    with refused("it needs a policy without a guard"):
        gradient.init(config, energy_shaping(designs.competition("acrobot"), "acrobot"), KEY)
    with refused("it needs a policy without a guard, and not Guarded"):
        gradient.Gradient(config, guard(shipped_network(), "pendubot"), TASK)
    late = dataclasses.replace(config, retained_after=10.0)
    with refused("gradient.retained_after is 10.0 s; it must be less than the 10 s of a run"):
        gradient.Gradient(late, shipped_network(), TASK)


def test_jitted_as_eager():
    start, config = network(), GradientConfig(duration=0.04)
    arguments = config, start, TASK, coordinates(start)[0], KEY
    eager, _, metrics = gradient.slope(*arguments)
    jitted, _, expected = jax.jit(gradient.slope, static_argnums=(0, 2))(*arguments)
    assert_close(jitted, eager)
    assert_close(metrics["smooth_score"], expected["smooth_score"])


def test_scenarios_come_from_the_key():
    start = network()
    config = GradientConfig(
        steps=1, duration=0.02, scenario_duration=0.5, scenarios=2, objective=Objective(0.8)
    )
    ends = []
    for seed in (0, 0, 1):
        begun = gradient.init(config, start, jax.random.key(seed))
        state, metrics = gradient.improve(config, start, begun, 1, TASK)
        ends.append((float(metrics["uprightness"][0]), np.asarray(state.parameters)))
    np.testing.assert_array_equal(ends[0][1], ends[1][1])
    assert ends[0][0] != ends[2][0]


def test_gains_of_any_controller_climb_with_a_step_of_their_own():
    start = energy_shaping(designs.competition("acrobot"), "acrobot")
    config = GradientConfig(
        steps=3, duration=0.5, gain_learning_rate=0.01, learning_rate=1.0, final_learning_rate=1.0
    )
    begun = gradient.init(config, start, KEY)
    state, metrics = gradient.improve(config, start, begun, 3, task_of("acrobot"))
    # The first steps of Adam are as long as its rate.
    moved = np.abs(np.asarray(state.parameters))
    np.testing.assert_allclose(moved, 0.03, rtol=0.05)
    assert metrics["smooth_score"][-1] > metrics["smooth_score"][0]
    found = gradient.current(config, start, state)
    assert found.kp != start.kp
    np.testing.assert_array_equal(found.plant.mass, start.plant.mass)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"steps": -1}, "steps is -1; it must not be negative"),
        ({"clip": 0.0}, "clip is 0.0; it must be positive"),
        ({"memory": float("nan")}, "memory is nan; it must be positive"),
        ({"scenarios": -1}, "scenarios is -1; it must not be negative"),
        ({"scenarios": 4}, "scenarios is 4; with objective.weight 0 they count nothing"),
        ({"tolerance": 0.0}, "tolerance is 0.0; it must be positive"),
        ({"retention": -1.0}, "retention is -1.0; it must not be negative"),
    ],
)
def test_senseless_values_are_one_sentence(values, words):
    with refused(words):
        dataclasses.replace(GradientConfig(), **values)
