"""The learning environment: reward and dynamics by other means, and its door to Brax."""

import dataclasses
import math
import subprocess
import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env as BraxEnv
from brax.envs.wrappers import training
from conftest import assert_close, both_robots, refused

from jaxpend import JaxpendError, designs
from jaxpend.boards import v2, v3
from jaxpend.controllers import OpenLoop
from jaxpend.env import Env, EnvConfig, Reward, restarted, surrogate_reward, truncated
from jaxpend.interop.brax import DoublePendulum
from jaxpend.observation import KINDS, Observation
from jaxpend.plant import rk4_step, total_energy
from jaxpend.rollout import rollout
from jaxpend.scenario import Pulses
from jaxpend.variations import sample

LINE = {"acrobot": 0.375, "pendubot": 0.35}
# The end effector of the second state lies between the lines of the two robots.
STATES = {
    "top": [math.pi - 0.2, 0.3, 1.5, -2.5],
    "between": [math.pi - math.acos(0.36 / 0.5), 0.0, -1.0, 0.5],
    "bent": [math.pi, 2.5, 3.0, 1.0],
    "hanging": [0.3, -0.4, -6.0, 4.0],
}
ZERO = jnp.zeros(())
step = jax.jit(lambda env, state, action: env.step(state, action), static_argnums=0)


def make(robot="pendubot", **options) -> Env:
    """The environment of the v2 task."""
    return Env(EnvConfig(**options), v2(robot).task)


def paper_reward(robot, x, action, previous):
    """The formula of the paper in plain numpy, the energies from the links' own velocities."""
    p = designs.competition(robot)
    (m1, m2), (l1, l2), (r1, r2), (i1, i2) = p.mass, p.length, p.com, p.inertia
    q1, q2, w1, w2 = x
    y = -l1 * np.cos(q1) - l2 * np.cos(q1 + q2)
    v = 9.81 * (-m1 * r1 * np.cos(q1) - m2 * (l1 * np.cos(q1) + r2 * np.cos(q1 + q2)))
    elbow = np.array([l1 * np.cos(q1), l1 * np.sin(q1)]) * w1
    turning = np.array([r2 * np.cos(q1 + q2), r2 * np.sin(q1 + q2)]) * (w1 + w2)
    about_com = i2 - m2 * r2**2
    t = (i1 * w1**2 + m2 * np.sum((elbow + turning) ** 2) + about_com * (w1 + w2) ** 2) / 2
    da = action - previous
    if y > LINE[robot]:
        return v + 2 * (1 + np.cos(q2)) ** 2 - t - 0.1 * action**2 - 0.15 * abs(da)
    return v - 0.02 * action**2 - 0.15 * abs(da) - 0.02 * (w1**2 + w2**2)


@both_robots
@pytest.mark.parametrize("where", STATES)
@pytest.mark.parametrize(("action", "previous"), [(0.0, 0.0), (0.7, -0.5), (-1.0, 0.2)])
@pytest.mark.x64
def test_reward_is_the_papers(robot, where, action, previous):
    env = make(robot)
    x = np.array(STATES[where])
    reward = surrogate_reward(env.plant, env.config.reward, env.line, x, action, previous)
    assert_close(reward, paper_reward(robot, x, action, previous))


def test_the_cases_lie_on_both_sides_of_the_line():
    length = designs.competition("acrobot").length
    y = {k: -length @ np.cos([x[0], x[0] + x[1]]) for k, x in STATES.items()}
    assert y["top"] > 0.375 > y["between"] > 0.35 > y["bent"] > y["hanging"]
    assert make("acrobot").line == 0.375
    assert make("pendubot").line == 0.35
    assert make("acrobot", reward=Reward(line=0.4)).line == 0.4


@pytest.mark.x64
def test_coefficients_and_floor_are_those_of_the_configuration():
    plant = designs.competition("pendubot")
    other = Reward(alpha=3.0, beta=0.5, rho1=1.0, rho2=2.0, phi1=3.0, phi2=4.0, eta=5.0, energy=6.0)
    names = ("alpha", "beta", "rho1", "rho2", "phi1", "phi2", "eta", "energy")
    zeroed = dict.fromkeys(names, 0.0)
    for where in ("top", "hanging"):
        x = jnp.array(STATES[where])

        def earned(reward, x=x):
            return float(surrogate_reward(plant, reward, 0.0, x, 0.5, -0.1))

        nothing = Reward(**zeroed)
        terms = [
            earned(dataclasses.replace(nothing, **{name: getattr(other, name)})) - earned(nothing)
            for name in zeroed
        ]
        np.testing.assert_allclose(earned(other), earned(nothing) + sum(terms), rtol=1e-9)
        # Each side of the line has its own terms, and only those.
        below = {"rho2", "phi2", "eta", "energy"}
        at_work = {name for name, term in zip(zeroed, terms, strict=True) if term != 0}
        assert at_work == (set(zeroed) - below if where == "top" else below)
        assert (earned(other) < -0.5) == (where == "hanging")
        assert earned(dataclasses.replace(other, floor=-0.5)) == max(earned(other), -0.5)
        assert earned(dataclasses.replace(other, floor=-1e6)) == earned(other)


@both_robots
@pytest.mark.x64
def test_energy_charges_the_distance_from_that_of_upright(robot):
    """Too much costs as much as too little, and below the line alone."""
    plant, kinds = designs.competition(robot), (Reward(energy=2.0), Reward())

    def charged(x):
        charging, free = (surrogate_reward(plant, kind, 0.3, x, 0.0, 0.0) for kind in kinds)
        return float(free - charging)

    upright, hanging = (total_energy(plant, jnp.array([q, 0.0, 0.0, 0.0])) for q in (np.pi, 0.0))
    assert_close(charged(jnp.zeros(4)), 2 * (upright - hanging))
    # Spinning through the lowest point, with a fifth more or less than it takes to stand.
    moment = 2 * total_energy(plant, jnp.array([0.0, 0.0, 1.0, 0.0])) - 2 * hanging
    for share in (0.8, 1.0, 1.2):
        speed = np.sqrt(2 * share * (upright - hanging) / moment)
        x = jnp.array([0.0, 0.0, speed, 0.0])
        expected = 2 * abs(share - 1) * float(upright - hanging)
        np.testing.assert_allclose(charged(x), expected, atol=1e-8)
    assert charged(jnp.array([np.pi, 0.0, 3.0, 0.0])) == 0


@both_robots
def test_a_step_is_one_of_the_plant_under_torque_on_the_driven_joint(robot):
    env = make(robot, torque_limit=2.5, dt=0.02)
    x = jnp.array(STATES["bent"], jnp.float32)
    after = step(env, env.observe(x, jnp.asarray(-0.3), None, None, ZERO), 0.6)
    u = np.zeros(2, "f4")
    u[designs.active_joint(robot)] = 0.6 * 2.5
    expected = rk4_step(designs.competition(robot), x, u, 0.02)
    assert_close(after.x, expected)
    assert not np.allclose(expected, rk4_step(designs.competition(robot), x, 0 * u, 0.02))
    # The reward is of the state arrived in and charges the change from the action before.
    assert_close(after.reward, paper_reward(robot, np.float64(expected), 0.6, -0.3), times=5)
    assert_close(after.obs, Observation()(expected))
    assert_close(after.privileged, [0.6])


def test_actions_are_clipped_to_the_torque_limit():
    env = make()
    start = env.reset(jax.random.key(0))
    for beyond, limit in ((3.0, 1.0), (-1.5, -1.0)):
        clipped = step(env, start, beyond)
        chex.assert_trees_all_equal(clipped, step(env, start, limit))
        assert clipped.action == limit


def test_what_is_no_single_action_is_refused_at_trace_time():
    env = make()
    with pytest.raises(AssertionError, match="shape"):
        step(env, env.reset(jax.random.key(0)), jnp.zeros(1))


def test_environments_of_the_same_values_are_the_same_to_jit():
    assert make() == make()
    assert hash(make()) == hash(make())
    assert make() != make("acrobot")


@pytest.mark.parametrize(("kind", "size"), [("wrapped", 4), ("sincos", 6), ("state", 4)])
def test_only_the_critics_see_the_previous_action(kind, size):
    env = make(observation=Observation(kind))
    state = step(env, env.reset(jax.random.key(0)), 0.25)
    assert (state.obs.shape, state.privileged.shape) == ((size,), (1,))
    assert state.privileged == 0.25
    brax = DoublePendulum(env.config, env.task)
    sizes = brax.observation_size, brax.seen_size, brax.action_size
    assert sizes == (size + 1, size, 1)
    near = [
        env.observe(jnp.array([math.pi, d, 0.0, 0.0]), ZERO, None, None, ZERO).obs
        for d in (-1e-4, 1e-4)
    ]
    jump = np.abs(near[1] - near[0]).max()
    # With wrapped angles the goal lies on the wrap; with sines and cosines nothing jumps there.
    np.testing.assert_allclose(jump, 2.0 if kind == "wrapped" else 0.0, atol=1e-3)


@pytest.mark.parametrize("randomised", [0.0, 1.0])
def test_history_is_what_was_measured_and_done_before_newest_first(randomised):
    view = Observation(history=2)
    env = make("acrobot", observation=view, randomised=randomised)
    state = env.reset(jax.random.key(3))
    measured, true, actions = [], [], [0.0]
    for action in (0.9, -0.5, 0.3, 0.7):
        measured.append(state.world.measured if randomised else state.x)
        true.append(state.x)
        before = [np.zeros((2, 4)), *np.array(measured)[None, :-1]]
        before = np.concatenate(before)[:-3:-1]  # hanging at rest before it began
        pushed = np.append([0.0, 0.0], actions[1:])[:-3:-1]
        past = [np.append(view.of_state(x), a) for x, a in zip(before, pushed, strict=True)]
        critics = [view.of_state(true[-1])] if randomised else []
        seen = np.concatenate([view.of_state(measured[-1]), *past])
        assert_close(state.obs, seen, times=5)
        assert_close(state.privileged, np.concatenate([*critics, [actions[-1]]]), times=5)
        actions.append(action)
        state = step(env, state, action)
    assert state.obs.shape == (view.size,) == (6 + 2 * 7,)
    assert np.abs(np.array(measured)).max() > 0.1


@pytest.mark.parametrize("randomised", [0.0, 1.0])
def test_angles_alone_are_seen_as_they_change_and_no_velocity_matters(randomised):
    view = Observation("angles", max_velocity=10.0, max_turn=0.1, history=2)
    env = make("acrobot", observation=view, randomised=randomised)
    assert view.size == 4 + 2 * 3
    state = env.reset(jax.random.key(3))
    measured = []
    for action in (0.9, -0.5, 0.3):
        measured.append(state.world.measured if randomised else state.x)
        state = step(env, state, action)
    measured.append(state.world.measured if randomised else state.x)
    angles = np.array(measured, np.float64)[:, :2]
    turned = np.sin(np.diff(angles, axis=0))[:-3:-1] / 0.1
    seen = [np.cos(angles[-1]), np.sin(angles[-1]), [*turned[0], 0.3], [*turned[1], -0.5]]
    assert np.abs(turned).min() > 1e-3
    np.testing.assert_allclose(state.obs, np.concatenate(seen), atol=2e-5)
    # Another velocity, and whole turns of everything, look the same.
    past = state.past.at[:, 2:4].add(5.0).at[:, :2].add(2 * math.pi)
    x = jnp.asarray(measured[-1]).at[2:].add(5.0).at[:2].add(2 * math.pi)
    np.testing.assert_allclose(view(x, past), state.obs, atol=1e-4)
    # The critics know the velocity, with or without a scenario.
    true = [np.cos(state.x[:2]), np.sin(state.x[:2]), state.x[2:] / 10, [0.3]]
    np.testing.assert_allclose(state.privileged, np.concatenate(true), atol=1e-6)


def test_angles_alone_are_not_enough_where_the_arm_is_thrown():
    with refused("observation.kind is angles; where the arm is thrown by hand a policy must see"):
        Env(EnvConfig(observation=Observation("angles", history=1)), v3("pendubot").task)


@both_robots
def test_a_randomised_episode_is_a_rollout_in_its_scenario(robot):
    env = make(robot, randomised=1.0)
    wrong = sample(env.plant, jax.random.key(1))
    wrong = wrong.replace(
        plant=env.plant.replace(mass=env.plant.mass * 1.1),
        responsiveness=jnp.asarray(0.5),
        delay=jnp.full(4, 7),
        measurement_noise=jnp.zeros(4),
        torque_noise=jnp.zeros(2),
        pulses=Pulses(jnp.full((2, 1), 0.1), jnp.full((2, 1), 0.05), jnp.array([[0.4], [-0.2]])),
    )
    state = env.reset(jax.random.key(0))
    state = state.replace(world=state.world.replace(scenario=wrong, measured=state.x))
    actions = np.sin(np.arange(30.0))
    torque = 3.0 * actions[:, None] * (np.arange(2) == designs.active_joint(robot))
    held = OpenLoop(jnp.arange(30) * 0.01 - 1e-4, jnp.asarray(torque, jnp.float32))
    run = rollout(wrong, held, jax.random.key(0), duration=0.3)
    for k, action in enumerate(actions):
        state = step(env, state, jnp.asarray(action, jnp.float32))
        assert_close(state.x, run.x[5 * (k + 1)], times=50)
        if k < 29:
            assert_close(state.world.measured, run.x_measured[5 * (k + 1)], times=50)
        np.testing.assert_array_equal(state.obs, Observation()(state.world.measured))
        np.testing.assert_array_equal(state.privileged[:6], Observation()(state.x))
    assert np.abs(state.x - state.world.measured).max() > 0.01


def test_noise_of_a_scenario_is_measured_and_drawn_anew():
    env = make(randomised=1.0)
    state = env.reset(jax.random.key(0))
    scenario = sample(env.plant, jax.random.key(0), 0.0)
    scenario = scenario.replace(measurement_noise=jnp.array([0.0, 0.1, 0.2, 0.3]))
    state = state.replace(world=state.world.replace(scenario=scenario))
    now = jax.lax.scan(lambda s, _: (env.step(s, ZERO),) * 2, state, length=400)[1]
    error = np.asarray(now.world.measured - now.x)
    assert_close(now.x, np.zeros((400, 4)))
    np.testing.assert_allclose(error.std(axis=0), [0.0, 0.1, 0.2, 0.3], rtol=0.15)
    np.testing.assert_allclose(np.corrcoef(error[1:, 1], error[:-1, 1])[0, 1], 0.0, atol=0.2)


def test_every_episode_has_its_own_scenario():
    env = make(randomised=0.5)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))
    kinds = jax.tree.leaves(states.world.scenario)
    differing = np.array([[not np.array_equal(v, leaf[0]) for v in leaf] for leaf in kinds])
    assert differing.any(axis=1).sum() > 8


def batched(env):
    return training.wrap(env, episode_length=3)


def inner(env):
    return training.VmapWrapper(training.AutoResetWrapper(training.EpisodeWrapper(env, 3, 1)))


@pytest.mark.parametrize(
    ("wrapped", "key"),
    [(batched, jax.random.PRNGKey), (inner, jax.random.PRNGKey), (inner, jax.random.key)],
)
@pytest.mark.parametrize("randomised", [0.0, 1.0])
def test_brax_wrappers_count_truncate_and_reset(wrapped, key, randomised):
    view = Observation(history=2 if randomised else 0)
    bare = DoublePendulum(EnvConfig(observation=view, randomised=randomised))
    assert isinstance(bare, BraxEnv)
    env, keys = wrapped(bare), jax.random.split(key(0), 2)
    state, plain = env.reset(keys), bare.reset(keys[0])
    now = plain.pipeline_state
    np.testing.assert_array_equal(plain.obs, np.concatenate([now.obs, now.privileged]))
    assert now.obs.shape == (bare.seen_size,)
    assert state.obs.shape == (2, env.observation_size)
    actions, wrapped_step = jnp.array([[0.5], [-1.0]]), jax.jit(env.step)
    for k in range(1, 5):
        state = wrapped_step(state, actions)
        plain = step(bare, plain if k != 4 else bare.reset(keys[0]), actions[0])
        assert_close(state.reward[0], plain.reward, times=5)
        np.testing.assert_array_equal(state.done, [float(k == 3)] * 2)
        np.testing.assert_array_equal(state.info["truncation"], [float(k == 3)] * 2)
        expected = bare.reset(keys[0]).obs if k == 3 else plain.obs
        assert_close(state.obs[0], expected, times=5)
    assert plain.done == 0


def test_brax_sums_the_reward_of_an_episode():
    env = training.EvalWrapper(batched(DoublePendulum(EnvConfig(upright_starts=0.5))))
    state, once, earned = (
        env.reset(jax.random.split(jax.random.PRNGKey(1), 2)),
        jax.jit(env.step),
        [],
    )
    for _ in range(5):
        state = once(state, jnp.array([[0.5], [-1.0]]))
        earned.append(state.reward)
    found = state.info["eval_metrics"]
    np.testing.assert_array_equal(found.episode_steps, 3)
    np.testing.assert_array_equal(found.active_episodes, 0)
    assert_close(found.episode_metrics["reward"], np.sum(earned[:3], axis=0), times=5)


def test_keys_of_either_kind_reset_to_the_same_episode():
    env = DoublePendulum(EnvConfig(randomised=1.0, upright_starts=0.5))
    new, old = (env.reset(key(7)) for key in (jax.random.key, jax.random.PRNGKey))
    np.testing.assert_array_equal(new.obs, old.obs)
    chex.assert_trees_all_equal(*(s.pipeline_state.world.scenario for s in (new, old)))


NORMALISED = {"mean": (0.4, 0.8, 0, 0, 0, 0), "std": (1, 2, 3, 4, 5, 0.1), "clip": 0.5}


@pytest.mark.parametrize("kind", [*KINDS, "normalised"])
@pytest.mark.parametrize("randomised", [0.0, 1.0])
def test_left_and_right_make_no_difference(kind, randomised):
    view = Observation("sincos", history=2, **NORMALISED)
    if kind != "normalised":
        view = Observation(kind, history=2)
    assert view.symmetric
    env = make(observation=view, randomised=randomised)
    world = env.reset(jax.random.key(0)).world
    rng = np.random.default_rng(0)
    x, past, measured = rng.uniform(-3, 3, 4), rng.uniform(-1, 1, (2, 5)), rng.uniform(-3, 3, 4)

    def seen(side):
        there = world.replace(measured=side * measured) if randomised else None
        action = jnp.asarray(side * 0.4)
        return env.observe(jnp.array(side * x), action, jnp.array(side * past), there, ZERO)

    for name, signs in zip(("obs", "privileged"), env.mirrored, strict=True):
        left, right = (np.asarray(getattr(seen(side), name)) for side in (-1, 1))
        np.testing.assert_allclose(left, np.array(signs) * right, atol=1e-6)
        assert not np.allclose(left, right)
    calm = make(observation=view)
    left, right = (calm.step(seen(side).replace(world=None), side * 0.7) for side in (-1, 1))
    np.testing.assert_allclose(left.x, -right.x, rtol=1e-5)
    np.testing.assert_allclose(left.reward, right.reward, rtol=1e-5)


def test_a_share_of_episodes_starts_near_upright_and_only_there():
    env = make(observation=Observation(history=2), upright_starts=0.25, upright_spread=0.05)
    keys = jax.random.split(jax.random.key(0), 4000)
    now = jax.vmap(env.reset)(keys)
    up = np.any(now.x != 0, axis=1)
    np.testing.assert_allclose(up.mean(), 0.25, atol=0.03)  # four standard deviations
    off = np.asarray(now.x)[up] - [math.pi, 0, 0, 0]
    np.testing.assert_allclose(off.std(0), [0.05, 0.05, 0.15, 0.15], rtol=0.1)
    np.testing.assert_allclose(off.mean(0), 0, atol=0.02)
    # It has been there all along, as one that hangs has.
    np.testing.assert_array_equal(now.past[:, 1, :4], now.x)
    np.testing.assert_array_equal(now.past[..., 4], 0)
    # The scenario that is met does not depend on where the episode starts.
    starts = [make(randomised=1.0, upright_starts=share).reset(keys[0]) for share in (0.0, 1.0)]
    chex.assert_trees_all_equal(*(start.world.scenario for start in starts))
    assert starts[0].x[0] == 0 != starts[1].x[0]


def test_a_share_of_episodes_starts_anywhere_among_those_that_do_not_start_upright():
    env = make(upright_starts=0.25, upright_spread=1e-6, random_starts=0.5)
    x = np.asarray(jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4000)).x)
    hanging = (x == 0).all(1)
    up = ~hanging & (np.abs(x - [math.pi, 0, 0, 0]) < 1e-4).all(1)
    np.testing.assert_allclose([hanging.mean(), up.mean()], 0.25, atol=0.03)
    anywhere = x[~hanging & ~up]
    # Uniform angles fill the circle, velocities are Gaussian.
    np.testing.assert_allclose(anywhere[:, :2].std(0), math.pi / math.sqrt(3), rtol=0.05)
    assert np.abs(anywhere[:, :2]).max() <= math.pi
    np.testing.assert_allclose(anywhere[:, 2:].std(0), 5.0, rtol=0.1)


def test_nobody_who_trains_waits_for_brax():
    code = "import sys, jaxpend.env, jaxpend.sac; assert 'brax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_episodes_are_cut_off_at_the_time_limit_and_beyond_the_greatest_speed():
    env = make(duration=0.05, max_speed=10.0)
    x = jnp.array([[9.0, -9.0, 9.9, -9.9], [0.0, 0.0, 10.1, 0.0], [0.0, 0.0, 0.0, -10.1]])
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3)).replace(x=x)
    for steps in (4, 5, 6):
        over = truncated(env.config, state, jnp.full(3, steps))
        np.testing.assert_array_equal(over, [steps >= 5, True, True])
        first = jax.tree.map(lambda leaf: leaf[0], state)
        assert truncated(env.config, first, steps) == over[0]
    assert not truncated(EnvConfig(duration=0.05), state, jnp.full(3, 4)).any()
    now = restarted(jnp.array([True, False, True]), state.replace(x=-x), state)
    np.testing.assert_array_equal(now.x, x * jnp.array([[-1], [1], [-1]]))


def test_episode_steps():
    assert EnvConfig().episode_steps == 1000
    assert EnvConfig(dt=0.02, duration=5.0).episode_steps == 250


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"torque_limit": 0.0}, "torque_limit is 0.0; it must be positive"),
        ({"torque_limit": -3.0}, "torque_limit is -3.0; it must be positive"),
        ({"dt": math.nan}, "dt is nan; it must be positive"),
        ({"duration": -1.0}, "duration is -1.0; it must be at least 0.01"),
        ({"max_speed": 0.0}, "max_speed is 0.0; it must be positive"),
        ({"upright_starts": -0.1}, "upright_starts is -0.1; it must not be negative"),
        ({"upright_spread": 0.0}, "upright_spread is 0.0; it must be positive"),
        ({"randomised": 1.5}, "randomised is 1.5; it must be at most 1"),
        ({"random_starts": -0.5}, "random_starts is -0.5; it must not be negative"),
        (
            {"upright_starts": 0.5, "random_starts": 0.6},
            "upright_starts and random_starts are 0.5 and 0.6; they are shares of one whole",
        ),
    ],
)
def test_senseless_values_are_one_sentence(values, words):
    with pytest.raises(JaxpendError) as error:
        EnvConfig(**values)
    assert str(error.value) == words


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"config": "pendubot"}, "config is of the type str; it must be of EnvConfig"),
        ({"task": "acrobot"}, "task is of the type str; it must be of Task"),
        ({"task": v2("acrobot")}, "task is of the type Board; it must be of Task"),
    ],
)
def test_the_brax_door_refuses_what_is_no_configuration_and_no_task(options, words):
    with refused(words):
        DoublePendulum(**options)


def test_the_brax_door_takes_one_action_of_any_type():
    env = DoublePendulum()
    state = env.reset(jax.random.key(0))
    after = env.step(state, np.zeros(1))
    chex.assert_trees_all_equal_shapes_and_dtypes(after.pipeline_state, state.pipeline_state)
    for shape in ((), (2,)):
        with refused(f"the action has shape {shape}; it must be (1,)"):
            env.step(state, jnp.zeros(shape))
