"""Soft actor-critic (Haarnoja et al., 2018, arXiv 1812.05905) in Flax and Optax, all on device.

``init`` and ``train_chunk`` are pure; a chunk is one jitted ``lax.scan`` over environment steps,
each followed by gradient updates. Episodes are truncated, never terminated: every target
bootstraps from the true next state.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import optax

from ..config import SACConfig
from ..controllers.policy import Policy
from ..env import DoublePendulum
from ..pytree import pytree
from .demonstrations import Imitation, imitate, imitation, swingups
from .networks import Actor, TwinCritic, constant_log_std, sample_action, to_policy

__all__ = ["SACConfig", "SACState", "greedy_policy", "init", "train_chunk"]


@pytree
class Replay:
    """Ring buffer of transitions: observation, action, scaled reward, next observation."""

    rows: jax.Array  # (capacity, 2 observation_size + 2)
    position: jax.Array  # () int, next row to write
    size: jax.Array  # () int, rows filled


@pytree
class Demonstrations:
    """Rows of demonstrations; as many as there could be, so that all seeds compile the same."""

    rows: jax.Array  # (capacity, 2 observation_size + 3) as in Replay, and wanted actions
    size: jax.Array  # () int, rows filled


@pytree
class SACState:
    """Everything that training changes."""

    actor: dict
    critic: dict
    target: dict
    log_temperature: jax.Array
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    temperature_opt: optax.OptState
    replay: Replay
    demonstrations: Demonstrations | None
    env_x: dict  # brax State, batched over environments
    env_time: jax.Array  # (num_envs,) int, steps into the episode
    key: jax.Array
    env_steps: jax.Array  # () int
    updates: jax.Array  # () int


def networks(config: SACConfig) -> tuple[Actor, TwinCritic]:
    """The actor and the critics of a configuration."""
    seen = DoublePendulum(config.env).seen_size
    actor = Actor(config.actor_hidden, config.activation, seen)
    return actor, TwinCritic(config.critic_hidden, config.activation, config.critic_layer_norm)


def optimizer(config: SACConfig) -> optax.GradientTransformation:
    """Adam with cosine decay over the whole run."""
    total = config.steps // config.num_envs * config.updates_per_step
    schedule = optax.cosine_decay_schedule(
        config.learning_rate, max(total, 1), alpha=config.final_learning_rate
    )
    return optax.adam(schedule)


def init(config: SACConfig, key: jax.Array) -> SACState:
    """Fresh networks, an empty replay buffer and environments at random times of an episode.

    With ``config.demonstrations`` the actor starts from imitation of the optimised swing-up, and
    half of every batch is drawn from its demonstrations (Ball et al., "Efficient online
    reinforcement learning with offline data", 2023). ``key`` is consumed.
    """
    state, learner = begin(config, key)
    if learner is None:
        return state
    learner, _ = imitate_chunk(config, state, learner, config.demonstrations.updates)
    return state.replace(actor=learner.params)


def begin(config: SACConfig, key: jax.Array) -> tuple[SACState, Imitation | None]:
    """``init`` before imitation, and the imitation that is to be done with ``imitate_chunk``."""
    key, key_demonstrate, key_imitate = jax.random.split(key, 3)
    state, recipe = _fresh(config, key), config.demonstrations
    if not recipe.episodes:
        return state, None
    env = DoublePendulum(config.env)
    rows, wanted = swingups(recipe, env, key_demonstrate, reward_scale=config.reward_scale)
    size = jnp.asarray(len(rows), jnp.int32)
    missing = recipe.episodes * round(recipe.duration / config.env.dt) - len(rows)
    rows = jnp.pad(jnp.concatenate([rows, wanted[:, None]], axis=1), ((0, missing), (0, 0)))
    params = constant_log_std(state.actor, recipe.log_std)
    state = state.replace(demonstrations=Demonstrations(rows, size))
    return state, imitation(recipe, params, key_imitate)


@partial(jax.jit, static_argnames=("config", "updates"))
def imitate_chunk(config: SACConfig, state: SACState, learner: Imitation, updates: int):
    """``updates`` steps of imitating the demonstrations; returns the learner and its mean loss."""
    recipe, shown = config.demonstrations, state.demonstrations
    actor, size = networks(config)[0], DoublePendulum(config.env).observation_size
    obs, wanted = shown.rows[:, :size], shown.rows[:, -1]
    learner, losses = imitate(recipe, actor, learner, obs, wanted, updates, shown.size)
    return learner, losses.mean()


def structure(config: SACConfig) -> tuple[SACState, Imitation | None]:
    """What ``begin`` returns, as a structure without numbers, and without the right shapes."""

    def shown(key):
        state, recipe = _fresh(config, key), config.demonstrations
        if not recipe.episodes:
            return state, None
        return state.replace(
            demonstrations=Demonstrations(jnp.zeros(()), jnp.zeros(()))
        ), imitation(recipe, state.actor, key)

    return jax.eval_shape(shown, jax.random.key(0))


@partial(jax.jit, static_argnames="config")
def _fresh(config: SACConfig, key: jax.Array) -> SACState:
    env = DoublePendulum(config.env)
    actor, critic = networks(config)
    key, key_actor, key_critic, key_env, key_time = jax.random.split(key, 5)
    obs, action = jnp.zeros(env.observation_size), jnp.zeros(1)
    actor_params = actor.init(key_actor, obs)
    critic_params = critic.init(key_critic, obs, action)
    log_temperature = jnp.log(jnp.asarray(config.init_temperature))
    opt = optimizer(config)
    capacity = config.replay_capacity // config.num_envs * config.num_envs
    zero = jnp.zeros((), jnp.int32)
    return SACState(
        actor=actor_params,
        critic=critic_params,
        target=jax.tree.map(jnp.copy, critic_params),
        log_temperature=log_temperature,
        actor_opt=opt.init(actor_params),
        critic_opt=opt.init(critic_params),
        temperature_opt=opt.init(log_temperature),
        demonstrations=None,
        replay=Replay(jnp.zeros((capacity, 2 * env.observation_size + 2)), zero, zero),
        env_x=jax.vmap(env.reset)(jax.random.split(key_env, config.num_envs)),
        # Spread out, so that the environments are not all in the same phase of an episode.
        env_time=jax.random.randint(key_time, (config.num_envs,), 0, config.env.episode_steps),
        key=key,
        env_steps=zero,
        updates=zero,
    )


def soft_value(actor_params, critic_params, config: SACConfig, log_temperature, obs, key):
    """``min_i Q_i(s, a) - T log pi(a|s)`` with a drawn from the policy; returns it and log pi."""
    actor, critic = networks(config)
    action, log_prob = sample_action(*actor.apply(actor_params, obs), key)
    q = critic.apply(critic_params, obs, action).min(axis=-1)
    return q - jnp.exp(log_temperature) * log_prob, log_prob


def update(config: SACConfig, state: SACState, batch: jax.Array, key: jax.Array):
    """One gradient step on critics, actor and temperature from a batch of ``sample``.

    The critics minimise the squared distance to ``r + gamma V(s')``, V being the soft value under
    the target critics. The actor maximises the soft value under the critics, less the weighted
    distance to demonstrated actions.
    """
    opt, (actor, critic_net) = optimizer(config), networks(config)
    key_critic, key_actor = jax.random.split(key)
    n = DoublePendulum(config.env).observation_size
    columns = (n, n + 1, n + 2, 2 * n + 2)
    obs, action, reward, next_obs, wanted = jnp.split(batch, columns, axis=1)
    next_value, _ = soft_value(
        state.actor, state.target, config, state.log_temperature, next_obs, key_critic
    )
    target = reward[:, 0] + config.discount * next_value

    def critic_loss(params):
        q = critic_net.apply(params, obs, action)
        return jnp.mean((q - target[:, None]) ** 2), q.mean()

    (loss_q, value), grads = jax.value_and_grad(critic_loss, has_aux=True)(state.critic)
    updates, critic_opt = opt.update(grads, state.critic_opt)
    critic = optax.apply_updates(state.critic, updates)

    def actor_loss(params):
        value, log_prob = soft_value(params, critic, config, state.log_temperature, obs, key_actor)
        loss = -value.mean()
        if wanted.size:
            shown = config.batch_size // 2
            greedy = jnp.tanh(actor.apply(params, obs[:shown])[0])
            loss += config.imitation * jnp.mean((greedy - wanted[:shown]) ** 2)
        return loss, -log_prob.mean()

    (loss_pi, entropy), grads = jax.value_and_grad(actor_loss, has_aux=True)(state.actor)
    updates, actor_opt = opt.update(grads, state.actor_opt)
    learns = state.env_steps >= config.actor_delay
    updates = jax.tree.map(lambda u: jnp.where(learns, u, 0.0), updates)
    # d/d log(temperature) of temperature (entropy - target)
    slope = jnp.exp(state.log_temperature) * (entropy - config.target_entropy)
    step, temperature_opt = opt.update(slope, state.temperature_opt)
    step = jnp.where(learns, step, 0.0)
    state = state.replace(
        actor=optax.apply_updates(state.actor, updates),
        critic=critic,
        target=optax.incremental_update(critic, state.target, config.target_rate),
        log_temperature=state.log_temperature + step,
        actor_opt=actor_opt,
        critic_opt=critic_opt,
        temperature_opt=temperature_opt,
        updates=state.updates + 1,
    )
    metrics = {"critic_loss": loss_q, "actor_loss": loss_pi, "entropy": entropy, "value": value}
    return state, metrics


def interact(config: SACConfig, state: SACState, key: jax.Array):
    """One step of every environment into the replay buffer; returns the mean reward too."""
    env = DoublePendulum(config.env)
    actor, _ = networks(config)
    key_action, key_uniform, key_reset = jax.random.split(key, 3)
    before = state.env_x
    action, _ = sample_action(*actor.apply(state.actor, before.obs), key_action)
    uniform = jax.random.uniform(key_uniform, action.shape, minval=-1.0, maxval=1.0)
    action = jnp.where(state.env_steps < config.warmup_steps, uniform, action)
    after = jax.vmap(env.step)(before, action)
    reward = config.reward_scale * after.reward[:, None]
    rows = jnp.concatenate([before.obs, action, reward, after.obs], axis=1)
    replay, capacity = state.replay, state.replay.rows.shape[0]
    replay = Replay(
        rows=jax.lax.dynamic_update_slice(replay.rows, rows, (replay.position, 0)),
        position=(replay.position + config.num_envs) % capacity,
        size=jnp.minimum(replay.size + config.num_envs, capacity),
    )
    speed = jnp.abs(after.pipeline_state["x"][:, 2:]).max(axis=1)
    truncated = state.env_time + 1 >= config.env.episode_steps
    truncated |= speed > config.env.max_speed
    fresh = jax.vmap(env.reset)(jax.random.split(key_reset, config.num_envs))

    def restart(new, old):
        return jnp.where(truncated.reshape((-1,) + (1,) * (old.ndim - 1)), new, old)

    state = state.replace(
        replay=replay,
        env_x=jax.tree.map(restart, fresh, after),
        env_time=jnp.where(truncated, 0, state.env_time + 1),
        env_steps=state.env_steps + config.num_envs,
    )
    return state, after.reward.mean()


def sample(config: SACConfig, state: SACState, key: jax.Array) -> jax.Array:
    """Batches of replay rows for one vector step, (updates_per_step, batch_size, columns).

    With demonstrations they come first, and there is a last column of wanted actions, which are 0
    in the other half. With ``config.mirror`` every other row is mirrored, by chance.
    """
    if config.mirror:
        key, key_mirror = jax.random.split(key)
        rows = _sample(config, state, key)
        signs = DoublePendulum(config.env).mirrored
        signs = jnp.array([*signs, -1, 1, *signs, -1][: rows.shape[-1]], rows.dtype)
        flip = jax.random.bernoulli(key_mirror, shape=(*rows.shape[:-1], 1))
        return rows * jnp.where(flip, signs, 1)
    return _sample(config, state, key)


def _sample(config: SACConfig, state: SACState, key: jax.Array) -> jax.Array:
    """``sample`` without a mirror."""

    def draw(rows, size, key, count):
        return rows[jax.random.randint(key, (config.updates_per_step, count), 0, size)]

    if state.demonstrations is None:
        return draw(state.replay.rows, state.replay.size, key, config.batch_size)
    key_own, key_demo = jax.random.split(key)
    half = config.batch_size // 2
    own = draw(state.replay.rows, state.replay.size, key_own, config.batch_size - half)
    demo = draw(state.demonstrations.rows, state.demonstrations.size, key_demo, half)
    return jnp.concatenate([demo, jnp.pad(own, ((0, 0), (0, 0), (0, 1)))], axis=1)


@partial(jax.jit, static_argnames=("config", "vector_steps"))
def train_chunk(config: SACConfig, state: SACState, vector_steps: int):
    """``vector_steps`` steps of all environments, with their updates; returns mean metrics.

    ``state`` is not donated: where the new one is not finite, training goes back to the old.
    """

    def learn(state, key):
        key_batch, key_update = jax.random.split(key)
        keys = jax.random.split(key_update, config.updates_per_step)
        batches = sample(config, state, key_batch)
        return jax.lax.scan(lambda s, i: update(config, s, *i), state, (batches, keys))

    def idle(state, key):
        shapes = jax.eval_shape(learn, state, key)[1]
        return state, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def step(state, _):
        key, key_env, key_learn = jax.random.split(state.key, 3)
        state, reward = interact(config, state.replace(key=key), key_env)
        state, metrics = jax.lax.cond(
            state.env_steps > config.warmup_steps, learn, idle, state, key_learn
        )
        return state, metrics | {"reward": reward}

    state, metrics = jax.lax.scan(step, state, length=vector_steps)
    metrics = jax.tree.map(jnp.mean, metrics)
    return state, metrics | {"temperature": jnp.exp(state.log_temperature)}


@partial(jax.jit, static_argnames=("config", "vector_steps"))
def train_chunks(config: SACConfig, states: list[SACState], vector_steps: int):
    """``train_chunk`` of several runs at the same step, in one vmap: [(state, metrics), ...].

    What counts steps is the same in all runs and not batched: a batched condition would become a
    select that copies the replay buffers at every step.
    """
    axes = SACState(**{f.name: 0 for f in dataclasses.fields(SACState)}).replace(
        replay=Replay(0, None, None), env_steps=None, updates=None
    )

    def per_axis(batched, shared, *trees):
        def part(axis, *parts):
            return shared(*parts) if axis is None else jax.tree.map(batched, *parts)

        return jax.tree.map(part, axes, *trees, is_leaf=lambda axis: axis is None)

    stacked = per_axis(lambda *leaves: jnp.stack(leaves), lambda first, *_: first, *states)
    chunk = jax.vmap(partial(train_chunk, config, vector_steps=vector_steps), (axes,), (axes, 0))
    after, metrics = chunk(stacked)
    return [
        (
            per_axis(lambda leaf, i=i: leaf[i], lambda shared: shared, after),
            {name: value[i] for name, value in metrics.items()},
        )
        for i in range(len(states))
    ]


def greedy_policy(config: SACConfig, state: SACState) -> Policy:
    """The deterministic policy as a ``Controller``."""
    return to_policy(state.actor, networks(config)[0], config.env)
