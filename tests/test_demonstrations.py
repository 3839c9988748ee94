"""Demonstrations: exact transitions with usable labels, and what imitation makes of them."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close

from jaxpend import JaxpendError
from jaxpend.boards import v2
from jaxpend.controllers import Feedback, Zero
from jaxpend.env import Env, EnvConfig
from jaxpend.sac import Agent, SACConfig, init
from jaxpend.sac.algorithm import structure
from jaxpend.sac.demonstrations import DemonstrationConfig, collect, imitate, imitation, swingups
from jaxpend.sac.networks import Actor, to_policy
from jaxpend.sac.replay import Replay
from jaxpend.score import official

NOISY = DemonstrationConfig(episodes=4, duration=1.0, action_noise=0.4, kicks=0.5)


def make(robot="pendubot") -> Env:
    """The environment of the v2 task."""
    return Env(EnvConfig(), v2(robot).task)


def parts(shown):
    """State, previous action, action, reward, next state of transitions (n, ...)."""

    def state(obs):  # of cosines, sines, scaled velocities
        obs = np.asarray(obs)
        return np.column_stack([np.arctan2(obs[:, 2:4], obs[:, :2]), 20 * obs[:, 4:6]])

    np.testing.assert_array_equal(shown.next_privileged[:, 0], shown.action)
    previous, action, reward = shown.privileged[:, 0], shown.action, shown.reward
    return state(shown.obs), *map(np.asarray, (previous, action, reward)), state(shown.next_obs)


def advance(env, x, previous, action):
    """Next states and rewards by the environment's own step."""

    def one(x, previous, action):
        after = env.step(env.observe(x, previous, None, None, previous), action)
        return after.x, after.reward

    return jax.vmap(one)(x, previous, action)


@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_rows_are_exact_transitions_under_noise(robot):
    env = make(robot)
    law = Feedback(lambda t, x: jnp.full(2, 2.0) * jnp.cos(3 * x[0]))
    shown = collect(NOISY, env, law, jax.random.key(0), reward_scale=0.1)
    chex.assert_tree_shape_prefix(shown, (400,))
    x, previous, action, reward, next_x = parts(shown)
    expected, earned = advance(env, x, previous, action)
    assert_close(next_x, expected, times=5)
    assert_close(reward, 0.1 * np.asarray(earned), times=5)
    # The label is what the controller wanted, the action what it got.
    wanted = np.asarray(shown.wanted)
    assert_close(wanted, 2.0 * np.cos(3 * x[:, 0]) / 3.0, times=5)
    assert np.abs(action - wanted).max() > 0.05
    assert np.abs(action).max() <= 1
    # Within an episode the action becomes the previous one, and only the velocity is kicked.
    x, previous, action, next_x = (v.reshape(4, 100, -1) for v in (x, previous, action, next_x))
    np.testing.assert_array_equal(previous[:, 1:], action[:, :-1])
    assert not previous[:, 0].any()
    np.testing.assert_array_equal(x[:, 1:, :2], next_x[:, :-1, :2])
    kicks = (x[:, 1:, 2:] - next_x[:, :-1, 2:]).std(axis=(1, 2))
    start = np.abs(x[:, 0]).max(axis=1)
    assert np.all(kicks > 0)
    assert kicks.max() < 0.5
    assert np.all(start > 0)
    # Each episode has its own amount of noise, the same share in everything.
    disturbed = (action - wanted.reshape(4, 100, 1)).std(axis=(1, 2))
    np.testing.assert_allclose(disturbed / 0.4, kicks / 0.5, rtol=0.3)
    assert kicks.max() > 2 * kicks.min()


def test_without_noise_every_episode_is_the_same():
    quiet = dataclasses.replace(NOISY, action_noise=0.0, kicks=0.0, start_spread=0.0)
    law = Feedback(lambda t, x: jnp.full(2, 2.0) * jnp.cos(3 * x[0]))
    shown = collect(quiet, make(), law, jax.random.key(0), reward_scale=1.0)
    np.testing.assert_array_equal(shown.action, shown.wanted)
    for leaf in jax.tree.leaves(shown):
        for episode in np.split(np.asarray(leaf), 4):
            np.testing.assert_array_equal(episode, leaf[:100])


def test_saturated_labels_are_left_out():
    env = make()
    law = Feedback(lambda t, x: jnp.where(t < 0.495, 1.5, 9.0) * jnp.ones(2))
    shown = collect(NOISY, env, law, jax.random.key(0), reward_scale=0.1)
    chex.assert_tree_shape_prefix(shown, (4 * 50,))
    assert_close(shown.wanted, np.full(200, 0.5))
    always = Feedback(lambda t, x: jnp.full(2, -3.0))
    with pytest.raises(JaxpendError, match="asks for all the torque all the time"):
        collect(NOISY, env, always, jax.random.key(0), reward_scale=0.1)


def test_a_controller_that_wants_nothing_is_labelled_so():
    shown = collect(NOISY, make(), Zero(), jax.random.key(0), reward_scale=0.1)
    assert not np.asarray(shown.wanted).any()


def test_imitation_of_the_swing_up_swings_up():
    config = DemonstrationConfig(episodes=150, updates=8000, batch_size=256)
    env, actor = make(), Actor((64, 64), "tanh")
    keys = jax.random.split(jax.random.key(0), 3)
    shown = swingups(config, env, keys[0], reward_scale=0.1)
    assert np.abs(shown.wanted).max() < 0.99
    untrained = actor.init(keys[1], shown.obs[0])
    state, count = imitation(config, untrained, keys[2]), jnp.asarray(len(shown.wanted))
    stored = Replay(jax.tree.map(lambda leaf: leaf[:, None], shown), jnp.asarray(0), count)
    for _ in range(4):
        state, loss = imitate(config, actor, state, stored, 2000)

    @jax.jit
    def error(params):
        mean, _ = actor.apply(params, shown.obs)
        return jnp.mean((jnp.tanh(mean[:, 0]) - shown.wanted) ** 2)

    assert error(state.params) < 0.2 * error(untrained)
    np.testing.assert_allclose(loss[-100:].mean(), error(state.params), rtol=0.5)
    before, after = (
        official(to_policy(params, actor, env), "pendubot") for params in (untrained, state.params)
    )
    assert after["success"]
    assert after["score"] > before["score"] + 0.3


def test_sac_starts_from_the_imitating_actor_and_its_demonstrations():
    recipe = DemonstrationConfig(episodes=2, duration=1.0, updates=50, batch_size=32, log_std=-2.0)
    config, task = (
        SACConfig(
            num_envs=4,
            replay_capacity=8,
            actor_hidden=(8,),
            critic_hidden=(8,),
            demonstrations=recipe,
        ),
        v2("pendubot").task,
    )
    agent = Agent(config, task)
    state = init(agent, jax.random.key(0))
    alone = dataclasses.replace(config, demonstrations=DemonstrationConfig())
    untaught = init(Agent(alone, task), jax.random.key(0))
    assert untaught.demonstrations is None
    shown, n = state.demonstrations.data, int(state.demonstrations.filled)
    x, previous, action, reward, next_x = parts(jax.tree.map(lambda leaf: leaf[:n, 0], shown))
    expected, earned = advance(agent.env, x, previous, action)
    assert_close(next_x, expected, times=5)
    assert_close(reward, config.reward_scale * np.asarray(earned), times=5)
    # The same shape for every seed, however many rows were good enough.
    chex.assert_tree_shape_prefix(shown, (2 * 100, 1))
    assert 100 < n < 200
    assert not any(np.asarray(leaf[n:]).any() for leaf in jax.tree.leaves(shown))
    chex.assert_trees_all_equal_shapes_and_dtypes(structure(agent)[0], state)
    head = state.actor["params"]["log_std"]
    assert not np.asarray(head["kernel"]).any()
    np.testing.assert_array_equal(head["bias"], [-2.0])


def test_the_swing_up_is_that_of_the_robot():
    recipe = DemonstrationConfig(episodes=1, duration=4.0, action_noise=0, kicks=0, start_spread=0)
    for robot in ("acrobot", "pendubot"):
        shown = swingups(recipe, make(robot), jax.random.key(0), reward_scale=1.0)
        upright = np.asarray(shown.obs)[-50:, :2] @ [[-1.0], [1.0]]  # cosines
        np.testing.assert_allclose(upright, 2.0, atol=0.05)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"episodes": -1}, "episodes is -1; it must not be negative"),
        ({"delay": -0.1}, "delay is -0.1; it must not be negative"),
        ({"duration": 0.0}, "duration is 0.0; it must be at least 0.01"),
        ({"updates": 0}, "updates is 0; it must be positive"),
        ({"learning_rate": -1.0}, "learning_rate is -1.0; it must be positive"),
    ],
)
def test_senseless_values_are_one_sentence(values, words):
    with pytest.raises(JaxpendError) as error:
        DemonstrationConfig(**values)
    assert str(error.value) == words
