"""SAC on probe environments whose answer is known, and its parts one at a time."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from conftest import assert_close, refused

from jaxpend.boards import v2
from jaxpend.config import DemonstrationConfig, SACConfig
from jaxpend.env import EnvConfig, EnvState
from jaxpend.sac import algorithm as sac
from jaxpend.sac import losses
from jaxpend.sac import replay as buffer
from jaxpend.sac.networks import constant_log_std
from jaxpend.sac.replay import Replay, Transition

KEY, TASK = jax.random.key(0), v2("pendubot").task
ROW = 12  # obs (4,), privileged (1,), action, reward, next obs, next privileged


@dataclasses.dataclass(frozen=True)
class Probe:
    """An environment with random starts of the form that SAC asks for."""

    advance: Callable  # (state (4,), previous action, action) -> next state, reward

    def reset(self, key):
        x, zero = jax.random.uniform(key, (4,), minval=-1.0), jnp.zeros(())
        return EnvState(x, zero, None, None, x, zero[None], zero)

    def step(self, state, action):
        x, reward = self.advance(state.x, state.action, action)
        return EnvState(x, action, None, None, x, action[None], reward)


@dataclasses.dataclass(frozen=True)
class Agent(sac.Agent):
    """An agent in a probe."""

    advance: Callable

    @property
    def env(self):
        return Probe(self.advance)


def columns(transition):
    """The fields of transitions (..., ROW) side by side."""
    return np.concatenate(
        [leaf if leaf.ndim > transition.action.ndim else leaf[..., None]
         for leaf in map(np.asarray, jax.tree.leaves(transition))], axis=-1,
    )  # fmt: skip


def transitions(rows, obs_size=4):
    """The inverse; one column more are wanted actions."""
    n, rows = obs_size, jnp.asarray(rows)
    fields = jnp.split(rows, np.cumsum([n, 1, 1, 1, n, 1]), axis=-1)
    obs, privileged, action, reward, next_obs, next_privileged, wanted = fields
    wanted = wanted[..., 0] if wanted.size else None
    now = obs, privileged, action[..., 0], reward[..., 0]
    return Transition(*now, next_obs, next_privileged, wanted)


def changed(agent, **options):
    """The agent with another configuration."""
    return dataclasses.replace(agent, config=dataclasses.replace(agent.config, **options))


def stay(x, previous, action):
    """The state stays, and its first entry is worth itself and 1 more."""
    return x, 1 + x[0]


def credit(x, previous, action):
    """Where x0 > 0 the last action pays off, and the action 0.5 is best; elsewhere nothing."""
    late = x[0] > 0
    x_next = jnp.where(late, jnp.array([-0.5, 0, 0, 0]), jnp.array([0.5, 0, 0, 0]))
    x_next = x_next.at[1].set(jnp.where(late, 0.0, action))
    return x_next, jnp.where(late, x[1] - 4 * (action - 0.5) ** 2, 0.0)


def drift(x, previous, action):
    """Every entry of the transition leaves a trace; the second velocity falls by 1 a step."""
    return x + jnp.stack([action, previous, 0.0 * action, -1.0]), 10 * x[0] + action


small = partial(
    SACConfig, num_envs=16, batch_size=64, warmup_steps=0, replay_capacity=4096, reward_scale=1.0,
    actor_hidden=(16,), critic_hidden=(32,), learning_rate=3e-3, target_rate=0.05,
)  # fmt: skip


def probing(advance, episode_steps=8, max_speed=math.inf, **options):
    """An agent in a probe with episodes of so many steps."""
    env = EnvConfig(dt=1.0, duration=float(episode_steps), max_speed=max_speed)
    return Agent(small(env=env, **options), TASK, advance)


VALUE = probing(stay, discount=0.8, init_temperature=0.5, actor_delay=10**9)
CREDIT = probing(credit, discount=0.9, init_temperature=0.02, target_entropy=-2.0)
BINS = {"critic_bins": 51, "critic_layer_norm": True}
REPLAY = probing(
    drift, episode_steps=5, max_speed=3.5, num_envs=4, replay_capacity=15, warmup_steps=8,
    reward_scale=0.5,
)  # fmt: skip
update = jax.jit(sac.update, static_argnums=0)
interact = jax.jit(sac.interact, static_argnums=0)


def greedy(agent, state, obs):
    """Greedy actions (n,) for what the policy sees (n, 4)."""
    return np.tanh(agent.actor.apply(state.actor, jnp.asarray(obs))[0])[:, 0]


def leaves_equal(a, b):
    """Whether two pytrees are the same, bit by bit."""
    try:
        chex.assert_trees_all_equal(a, b)
    except AssertionError:
        return False
    return True


def without_keys(state):
    """The state with its key as plain numbers."""
    return state.replace(key=jax.random.key_data(state.key))


@pytest.fixture(scope="module")
def solved():
    """A state trained on ``CREDIT``, and the metrics of its one chunk."""
    return sac.train_chunk(CREDIT, sac.init(CREDIT, KEY), 300)


@pytest.mark.parametrize("bins", [{}, BINS | {"critic_range": (-4.0, 12.0)}])
def test_values_bootstrap_through_the_time_limit_with_the_entropy_on_top(bins):
    agent = changed(VALUE, **bins)
    state = sac.init(agent, KEY)
    actor = jax.tree.map(jnp.zeros_like, state.actor)  # tanh(N(0, 1)) everywhere
    state = state.replace(actor=actor)
    start = jax.tree.map(jnp.copy, (state.actor, state.log_temperature, state.critic))
    state, metrics = sac.train_chunk(agent, state, 400)
    v = np.linspace(-8, 8, 4001)
    density = np.exp(-(v**2) / 2) / np.sqrt(2 * np.pi)
    entropy = np.trapezoid(-density * (np.log(density) - np.log(1 - np.tanh(v) ** 2)), v)
    np.testing.assert_allclose(metrics["entropy"], entropy, atol=0.02)
    x = np.zeros((9, 4), "f4")
    x[:, 0] = np.linspace(-0.6, 0.6, 9)
    q = agent.critic.both(state.critic, x, np.zeros((9, 1), "f4"), np.zeros(9, "f4"))
    expected = (1 + x[:, :1] + 0.8 * 0.5 * entropy) / (1 - 0.8)
    np.testing.assert_allclose(q, np.repeat(expected, 2, axis=1), atol=0.6)
    np.testing.assert_allclose(q.mean(), expected.mean(), atol=0.25)
    # The actor and the temperature wait for actor_delay; the critics did not.
    assert leaves_equal((state.actor, state.log_temperature), start[:2])
    assert not leaves_equal(state.critic, start[2])


@pytest.mark.parametrize("bins", [{}, BINS | {"critic_range": (-10.0, 2.0)}])
def test_actions_are_paid_for_now_and_one_step_later(solved, bins):
    state, _ = solved
    if bins:
        agent = changed(CREDIT, **bins)
        state, _ = sac.train_chunk(agent, sac.init(agent, KEY), 300)
    early = greedy(CREDIT, state, [[-0.5, 0, 0, 0]])
    assert early[0] > 0.6
    late = greedy(CREDIT, state, [[0.5, a, 0, 0] for a in (0.7, 0.9)])
    np.testing.assert_allclose(late, 0.5, atol=0.12)


def test_same_key_same_bits_and_another_key_other_bits(solved):
    state, metrics = solved
    again, more = sac.train_chunk(CREDIT, sac.init(CREDIT, KEY), 300)
    assert leaves_equal((without_keys(again), more), (without_keys(state), metrics))
    other = sac.init(CREDIT, jax.random.key(1))
    assert not leaves_equal(other.actor, sac.init(CREDIT, KEY).actor)
    counts = [int(state.env_steps), int(state.updates), int(state.replay.filled)]
    assert counts == [300 * 16, 300 * CREDIT.config.updates_per_step, 4096 // 16]
    assert int(state.replay.position) == 300 - 4096 // 16


def batch_of(agent, more=0):
    """A batch of an update from a fixed seed; with one column more actions are wanted."""
    shape = (agent.config.batch_size, ROW)
    rows = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, shape), jnp.float32)
    return transitions(jnp.pad(rows, ((0, 0), (0, more))))


def with_actor(state, log_std, log_temperature=0.0):
    """The state with a constant standard deviation and a temperature of choice."""
    actor = constant_log_std(state.actor, log_std)
    return state.replace(actor=actor, log_temperature=jnp.array(log_temperature, jnp.float32))


def test_critics_learn_towards_the_lower_target_value_of_the_next_observation():
    state, batch = sac.init(CREDIT, KEY), batch_of(CREDIT)
    shifted = jax.tree.map(lambda w: w + 0.3, state.target)
    state = with_actor(state, -10.0, -20.0).replace(target=shifted)  # no noise, no entropy
    after, metrics = update(CREDIT, state, batch, KEY)
    both = CREDIT.critic.both
    next_seen = batch.next_obs, batch.next_privileged
    next_action = greedy(CREDIT, state, batch.next_obs)
    q_next = np.asarray(both(state.target, *next_seen, next_action))
    assert 0.0 < np.mean(q_next[:, 0] < q_next[:, 1]) < 1.0
    np.testing.assert_array_equal(
        CREDIT.critic.value(state.target, *next_seen, next_action), q_next.min(axis=1)
    )
    target = np.asarray(batch.reward)[:, None] + 0.9 * q_next.min(axis=1, keepdims=True)
    q = np.asarray(both(state.critic, batch.obs, batch.privileged, batch.action))
    np.testing.assert_allclose(metrics["critic_loss"], np.mean((q - target) ** 2), rtol=1e-3)
    np.testing.assert_allclose(metrics["value"], q.mean(), rtol=1e-3)
    # The targets follow at their rate.
    jax.tree.map(
        lambda new, old, learned: assert_close(new, old + 0.05 * (learned - old)),
        after.target, state.target, after.critic,
    )  # fmt: skip


def test_temperature_holds_the_entropy_at_its_target():
    fresh, batch = sac.init(CREDIT, KEY), batch_of(CREDIT)
    for log_std, rises in ((-5.0, True), (0.0, False)):
        after, metrics = update(CREDIT, with_actor(fresh, log_std), batch, KEY)
        assert (metrics["entropy"] < CREDIT.config.target_entropy) == rises
        assert_close(after.log_temperature, 3e-3 if rises else -3e-3)


def test_actor_spreads_out_when_the_temperature_is_high():
    state, entropies = with_actor(sac.init(CREDIT, KEY), -3.0, 5.0), []
    for key in jax.random.split(KEY, 30):
        state, metrics = update(CREDIT, state, batch_of(CREDIT), key)
        entropies.append(float(metrics["entropy"]))
    assert entropies[-1] > entropies[0] + 0.1


def test_imitation_pulls_the_demonstrated_half_towards_the_wanted_actions():
    agent = changed(dataclasses.replace(CREDIT, advance=stay), imitation=100.0)
    state, half = sac.init(agent, KEY), agent.config.batch_size // 2
    batch = batch_of(agent, more=1)
    # Demonstrations live where x0 > 0; the other half wants nothing, whatever its column says.
    sign = jnp.where(jnp.arange(2 * half) < half, 1.0, -1.0)
    obs = batch.obs.at[:, 0].set(sign * (0.5 + 0.5 * jnp.abs(batch.obs[:, 0])))
    batch = batch.replace(obs=obs, wanted=jnp.where(sign > 0, 0.6, -1.0))
    for key in jax.random.split(KEY, 150):
        state, _ = update(agent, state, batch, key)
    actions = greedy(agent, state, obs)
    np.testing.assert_allclose(actions[:half].mean(), 0.6, atol=0.1)
    assert actions[half:].mean() > -0.5


def run_interaction(steps):
    """States before and after each of some vector steps on ``REPLAY``, greedy but for warmup."""
    state = with_actor(sac.init(REPLAY, KEY), -10.0)
    for key in jax.random.split(KEY, steps):
        after, reward = interact(REPLAY, state, key)
        yield state, after, reward
        state = after


def test_replay_holds_the_last_transitions_as_they_were():
    history = list(run_interaction(8))  # 12 rows: the multiple of num_envs below 15
    assert columns(history[0][0].replay.data).shape == (3, 4, ROW)
    for k, (before, after, mean_reward) in enumerate(history):
        replay = after.replay
        assert (replay.position, replay.filled) == ((k + 1) % 3, min(k + 1, 3))
        rows = columns(replay.data)[k % 3]
        x, previous = np.asarray(before.envs.x), np.asarray(before.envs.action)
        action = rows[:, 5]
        np.testing.assert_array_equal(rows[:, :4], x)
        np.testing.assert_array_equal(rows[:, 4], previous)
        assert_close(rows[:, 6], 0.5 * (10 * x[:, 0] + action))
        assert_close(mean_reward, np.mean(10 * x[:, 0] + action), times=5)
        # The true next state, also where the episode was cut and a new one began.
        step = np.stack([action, previous, np.zeros(4), -np.ones(4)], axis=1)
        assert_close(rows[:, 7:11], x + step)
        np.testing.assert_array_equal(rows[:, 11], action)
        wanted = greedy(REPLAY, before, before.envs.obs)
        uniform = 4 * k < REPLAY.config.warmup_steps
        assert np.allclose(action, wanted, atol=1e-3) != uniform
        # What is not being written is kept.
        kept = np.arange(3) != k % 3
        kept = [jax.tree.map(lambda leaf, i=kept: leaf[i], r.data) for r in (replay, before.replay)]
        chex.assert_trees_all_equal(*kept)


def test_several_steps_are_those_that_followed_as_far_as_the_episode_went():
    """Rewards are 2^time in one environment and 3^time in the other: a sum says what is in it."""
    agent = changed(REPLAY, n_step=3)
    replay = sac.init(agent, KEY).replay  # of 3 times
    like = jax.tree.map(lambda leaf: leaf[0, 0], replay.data)
    replay = buffer.init(like, 6, 2, steps=3)
    for time in range(8):  # the first two are written over
        row = jnp.full((2, ROW), float(time)).at[:, 6].set(jnp.array([2.0, 3.0]) ** time)
        replay = buffer.add(replay, transitions(row), jnp.array([time == 4, False]))
    batch = buffer.sample_steps(replay, KEY, (4, 200), 3, 0.5)
    first, reward = np.asarray(batch.obs[..., 0]), np.asarray(batch.reward)
    last, discount = np.asarray(batch.next_obs[..., 0]), np.asarray(batch.discount)
    ended = (reward == [[2.0**3 + 0.5 * 2.0**4]]) | (reward == 2.0**4)
    expected_last = np.where(ended, 4, first + 2)
    np.testing.assert_array_equal(last, expected_last)
    np.testing.assert_array_equal(discount, 0.5 ** (last - first + 1))
    seen = set(zip(first.ravel(), reward.ravel(), strict=True))
    sums = {
        (t, b**t + 0.5 * b ** (t + 1) + 0.25 * b ** (t + 2)) for t in range(2, 6) for b in (2, 3)
    }
    sums -= {(3, 2**3 + 2**3 + 2**3), (4, 2**4 + 2**4 + 2**4)}
    assert seen == sums | {(3, 2**3 + 0.5 * 2**4), (4, 2.0**4)}


def test_one_step_of_several_is_a_plain_step():
    history = list(run_interaction(3))
    replay = history[-1][1].replay
    replay = replay.replace(cut=jnp.zeros(replay.data.action.shape, bool))
    batch = buffer.sample_steps(replay, KEY, (50,), 1, 0.9)
    np.testing.assert_allclose(batch.discount, 0.9, rtol=1e-6)
    rows = {tuple(r) for r in columns(replay.data).reshape(-1, ROW)}
    assert {tuple(r) for r in columns(batch.replace(discount=None))} == rows


def test_actions_do_not_depend_on_what_only_the_critics_see():
    state = with_actor(sac.init(CREDIT, KEY), -1.0)
    envs = state.envs.replace(privileged=state.envs.privileged + 5)
    both = [interact(CREDIT, s, KEY)[0].replay.data for s in (state, state.replace(envs=envs))]
    np.testing.assert_array_equal(both[0].action, both[1].action)
    assert both[0].action[0].std() > 0.1
    assert not np.array_equal(both[0].privileged, both[1].privileged)


def test_episodes_end_by_time_and_by_speed_and_start_anew():
    cut_by, starts = set(), []
    for before, after, _ in run_interaction(12):
        arrived = np.asarray(after.replay.data.next_obs[int(before.env_steps) // 4 % 3])
        late = np.asarray(before.env_time) + 1 >= 5
        fast = np.abs(arrived[:, 2:]).max(axis=1) > 3.5
        ended = late | fast
        cut_by |= {(bool(a), bool(b)) for a, b in zip(late, fast, strict=True)}
        expected = np.where(ended, 0, np.asarray(before.env_time) + 1)
        np.testing.assert_array_equal(after.env_time, expected)
        x, action = np.asarray(after.envs.x), np.asarray(after.envs.action)
        np.testing.assert_array_equal(x[~ended], arrived[~ended])
        assert np.all(np.abs(x[ended]) <= 1)
        assert not action[ended].any()
        np.testing.assert_array_equal(after.envs.obs, x)
        np.testing.assert_array_equal(after.envs.privileged, action[:, None])
        starts.extend(x[ended, 0])
    assert {(True, False), (False, True), (False, False)} <= cut_by
    assert len(set(starts)) == len(starts) > 8  # a fresh key at every reset


def test_exploration_noise_is_held_for_some_steps():
    agent = changed(CREDIT, num_envs=512, noise_repeat=4.0)
    state, held = sac.init(agent, KEY), []
    for key in jax.random.split(KEY, 6):
        before, (state, _) = state, interact(agent, state, key)
        held.append(np.mean(state.noise == before.noise))
        mean, log_std = agent.actor.apply(before.actor, before.envs.obs)
        drawn = columns(state.replay.data)[int(before.replay.position)][:, -1]
        assert_close(drawn, np.tanh(mean + np.exp(log_std) * state.noise)[:, 0])
    # Of 512 each; it begins at 0, with nothing to hold on to.
    np.testing.assert_allclose(held, 0.75, atol=4 * math.sqrt(0.75 * 0.25 / 512))
    np.testing.assert_allclose([state.noise.mean(), state.noise.std()], [0, 1], atol=0.3)
    assert sac.init(CREDIT, KEY).noise is None  # new in every step


def test_the_greedy_policy_is_that_of_the_averaged_actor():
    agent = sac.Agent(small(env=EnvConfig(), average_rate=0.25), TASK)
    state = sac.init(agent, KEY)
    rows = np.random.default_rng(0).uniform(-1, 1, (64, 2 * 7 + 2))
    batch, before = transitions(rows, 6), state.average
    after, _ = update(agent, state, batch, KEY)
    expected = jax.tree.map(lambda old, new: 0.75 * old + 0.25 * new, before, after.actor)
    jax.tree.map(lambda a, b: assert_close(a, b), after.average, expected)
    assert not leaves_equal(after.average, after.actor)
    kernel = after.average["params"]["mean"]["kernel"]
    np.testing.assert_array_equal(sac.greedy_policy(agent, after).layers[-1][0], kernel)
    # What is put in its place, such as an actor that imitates, is where it starts from.
    placed = sac.with_actor(state, after.actor)
    assert leaves_equal(placed.average, after.actor)
    plain = sac.with_actor(sac.init(CREDIT, KEY), after.actor)
    assert plain.average is None


def test_where_episodes_end_is_kept_for_several_steps():
    agent = changed(REPLAY, n_step=2)
    state = sac.init(agent, KEY)
    assert state.replay.cut.shape == (3, 4)
    for k in range(6):
        after = interact(agent, state, jax.random.key(k))[0]
        ended = np.asarray(after.env_time) == 0
        np.testing.assert_array_equal(after.replay.cut[k % 3], ended)
        state = after
    assert sac.init(REPLAY, KEY).replay.cut is None


def test_environments_start_at_different_times_of_the_episode():
    times = np.asarray(sac.init(CREDIT, KEY).env_time)
    assert len(set(times)) > 3
    assert times.min() >= 0
    assert times.max() < 8


def test_batches_come_from_filled_rows_and_half_of_them_from_demonstrations():
    state, filled = sac.init(CREDIT, KEY), jnp.asarray(5)
    marked = transitions(jnp.arange(4096.0).reshape(1024, 4, 1) * jnp.ones(ROW))
    state = state.replace(replay=Replay(marked, filled, filled))
    own = columns(sac.sample(CREDIT, state, KEY))
    assert own.shape == (CREDIT.config.updates_per_step, 64, ROW)
    assert set(own[..., 0].ravel()) == set(range(20))
    assert (own == own[..., :1]).all()
    shown = transitions(-1 - jnp.arange(9.0)[:, None, None] * jnp.ones(ROW + 1))
    state = state.replace(demonstrations=Replay(shown, jnp.asarray(0), jnp.asarray(7)))
    both = columns(sac.sample(CREDIT, state, KEY))
    assert both.shape == (CREDIT.config.updates_per_step, 64, ROW + 1)
    assert set(both[:, :32].ravel()) == set(range(-7, 0))
    assert set(both[:, 32:, :ROW].ravel()) == set(range(20))
    assert not both[:, 32:, ROW].any()


def test_demonstrations_fill_the_front_of_a_buffer_of_one_environment():
    rows = transitions(1 + jnp.arange(3.0 * (ROW + 1)).reshape(3, ROW + 1))
    empty = buffer.init(jax.tree.map(lambda leaf: leaf[0], rows), times=5, environments=1)
    full = buffer.fill(empty, rows)
    assert (full.filled, full.position) == (3, 0)
    np.testing.assert_array_equal(columns(full.data)[:3, 0], columns(rows))
    assert not columns(full.data)[3:].any()
    chex.assert_trees_all_equal_shapes_and_dtypes(empty, full)


def test_what_does_not_fit_together_is_said_at_trace_time():
    state, batch = sac.init(REPLAY, KEY), batch_of(CREDIT)
    with pytest.raises(AssertionError, match="shape"):
        buffer.add(state.replay, batch, jnp.zeros(64, bool))  # 64 environments into a buffer of 4
    with pytest.raises(AssertionError, match="shape"):
        losses.soft_target(batch.reward[:, None], batch.reward, batch.reward, 0.9)
    with pytest.raises(AssertionError, match="rank"):
        losses.squared_error(batch.reward, batch.reward)


def test_mirrored_batches_are_rows_as_they_were_and_what_a_mirror_shows_of_them():
    agent = sac.Agent(small(env=EnvConfig(), mirror=True), TASK)
    wide = 2 * 7 + 2
    row = 1 + jnp.arange(wide + 1.0)  # obs and privileged, action, reward, the next, wanted
    one, none = jnp.asarray(1), jnp.asarray(0)
    state = sac.init(agent, KEY).replace(
        replay=Replay(transitions(row[None, None, :wide], 6), none, one),
        demonstrations=Replay(transitions(row[None, None], 6), none, one),
    )
    signs = np.array([1, 1, -1, -1, -1, -1, -1, -1, 1, 1, 1, -1, -1, -1, -1, -1, -1])
    batches = columns(sac.sample(agent, state, KEY))
    for part, wanted in ((batches[:, :32], wide + 1), (batches[:, 32:], 0)):
        whole = np.append(row[:-1], wanted)
        found, counts = np.unique(part.reshape(-1, wide + 1), axis=0, return_counts=True)
        assert {tuple(f) for f in found} == {tuple(whole), tuple(signs * whole + 0.0)}
        assert counts.min() > 0.3 * counts.sum()  # 128 draws: four standard deviations


def test_nothing_is_learned_during_warmup():
    agent = changed(CREDIT, warmup_steps=3 * 16, updates_per_step=1)
    start = sac.init(agent, KEY)
    learned = [jax.tree.map(jnp.copy, start.actor)]
    state, updates = start, []
    for _ in range(5):
        state, _ = sac.train_chunk(agent, state, 1)
        updates.append(int(state.updates))
        learned.append(jax.tree.map(jnp.copy, state.actor))
    assert updates == [0, 0, 0, 1, 2]
    assert [leaves_equal(learned[0], later) for later in learned[1:]] == [True] * 3 + [False] * 2


def test_learning_rate_decays_over_the_whole_run():
    config = small(steps=16 * 5, updates_per_step=2, final_learning_rate=0.1)
    transformation, rates = sac.Agent(config, TASK).optimizer, []
    state = transformation.init(jnp.zeros(()))
    for _ in range(11):  # under a constant gradient, Adam steps by the learning rate
        change, state = transformation.update(jnp.ones(()), state)
        rates.append(float(optax.apply_updates(jnp.zeros(()), change)))
    np.testing.assert_allclose([rates[0], rates[10]], [-3e-3, -3e-4], rtol=1e-3)
    assert rates == sorted(rates)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"steps": 0}, "steps is 0; it must be positive"),
        ({"learning_rate": -1.0}, "learning_rate is -1.0; it must be positive"),
        ({"discount": 1.0}, "discount is 1.0; it must be below 1"),
        ({"num_envs": 8, "replay_capacity": 7}, "it must hold n_step = 1 steps of all 8"),
        ({"num_envs": 8, "replay_capacity": 23, "n_step": 3}, "it must hold n_step = 3 steps"),
        ({"n_step": 0}, "n_step is 0; it must be at least 1"),
        (
            {"n_step": 2, "demonstrations": DemonstrationConfig(episodes=1)},
            "n_step is 2; with demonstrations it must be 1",
        ),
        ({"activation": "exp"}, "activation is 'exp'; it must be relu, tanh or silu"),
        ({"noise_repeat": 0.5}, "noise_repeat is 0.5; it must be at least 1"),
        ({"critic_bins": 1}, "critic_bins is 1; it must be 0 or at least 2"),
        ({"critic_bins": -1}, "critic_bins is -1; it must not be negative"),
        ({"critic_range": (1.0, 1.0)}, "critic_range is (1.0, 1.0); the first must be lower"),
        ({"critic_range": (0.0, math.inf)}, "critic_range"),
    ],
)
def test_senseless_values_are_one_sentence(values, words):
    with refused(words):
        SACConfig(**values)
