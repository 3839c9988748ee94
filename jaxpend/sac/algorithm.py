"""Soft actor-critic (Haarnoja et al., 2018, arXiv 1812.05905) in Flax and Optax, all on device.

``init`` and ``train_chunk`` are pure; a chunk is one jitted ``lax.scan`` over environment steps,
each followed by gradient updates. Episodes are truncated, never terminated: every target
bootstraps from the true next state.
"""

import dataclasses
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import optax

from .. import devices
from ..config import SACConfig
from ..controllers.policy import Policy
from ..env import Env, EnvState, restarted, truncated
from ..pytree import Pytree, pytree
from ..task import Task
from . import losses, replay
from .critics import Critic, HistogramCritic, TwinCritic
from .demonstrations import Imitation, imitate, imitation, swingups
from .networks import Actor, Params, act, constant_log_std, distribution, squashed, to_policy
from .replay import Replay, Transition

__all__ = [
    "Agent", "SACState", "begin", "greedy_policy", "imitate_chunk", "init", "interact", "sample",
    "structure", "train_chunk", "train_chunks", "update", "with_actor",
]  # fmt: skip

Metrics = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class Agent:
    """What learns, and where: all that stays the same in training; hashable, so static in jit."""

    config: SACConfig
    task: Task

    @cached_property
    def env(self) -> Env:
        """The environment."""
        return Env(self.config.env, self.task)

    @cached_property
    def actor(self) -> Actor:
        """The network that acts."""
        return Actor(self.config.actor_hidden, self.config.activation)

    @cached_property
    def critic(self) -> Critic:
        """What judges actions."""
        config = self.config
        form = (config.critic_hidden, config.activation, config.critic_layer_norm)
        if config.critic_bins:
            return HistogramCritic(*form, config.critic_bins, config.critic_range)
        return TwinCritic(*form)

    @cached_property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam with cosine decay over the whole run."""
        config = self.config
        total = max(config.steps // config.num_envs * config.updates_per_step, 1)
        rate, last = config.learning_rate, config.final_learning_rate
        return optax.adam(optax.cosine_decay_schedule(rate, total, alpha=last))


@pytree
class SACState(Pytree):
    """Everything that training changes."""

    actor: Params
    critic: Params
    target: Params  # of the critic, following slowly
    log_temperature: jax.Array  # ()
    actor_opt: optax.OptState
    critic_opt: optax.OptState
    temperature_opt: optax.OptState
    replay: Replay
    demonstrations: Replay | None  # of one shape, so that all seeds compile the same
    envs: EnvState  # (num_envs, ...)
    env_time: jax.Array  # (num_envs,) int, steps into the episode
    key: jax.Array
    env_steps: jax.Array  # () int
    updates: jax.Array  # () int
    noise: jax.Array | None = None  # (num_envs, 1) of exploration, where it is to last
    average: Params | None = None  # of the actor, with ``config.average_rate``


def init(agent: Agent, key: jax.Array) -> SACState:
    """Fresh networks, an empty replay buffer and environments at random times of an episode.

    With ``config.demonstrations`` the actor starts from imitation of the optimised swing-up, and
    half of every batch is drawn from its demonstrations (Ball et al., "Efficient online
    reinforcement learning with offline data", 2023). ``key`` is consumed.
    """
    state, learner = begin(agent, key)
    if learner is None:
        return state
    learner, _ = imitate_chunk(agent, state, learner, agent.config.demonstrations.updates)
    return with_actor(state, learner.params)


def with_actor(state: SACState, params: Params) -> SACState:
    """The state with another actor, from which its average, where there is one, starts too."""
    average = None if state.average is None else params
    return state.replace(actor=params, average=average)


def begin(agent: Agent, key: jax.Array) -> tuple[SACState, Imitation | None]:
    """``init`` before imitation, and the imitation that is to be done with ``imitate_chunk``."""
    key, key_demonstrate, key_imitate = jax.random.split(key, 3)
    state, config = _fresh(agent, key), agent.config
    if state.demonstrations is None:
        return state, None
    recipe = config.demonstrations
    shown = swingups(recipe, agent.env, key_demonstrate, reward_scale=config.reward_scale)
    params = constant_log_std(state.actor, recipe.log_std)
    state = state.replace(demonstrations=replay.fill(state.demonstrations, shown))
    return state, imitation(recipe, params, key_imitate)


@partial(jax.jit, static_argnames=("agent", "updates"))
def imitate_chunk(
    agent: Agent, state: SACState, learner: Imitation, updates: int
) -> tuple[Imitation, jax.Array]:
    """``updates`` steps of imitating the demonstrations; returns the learner and its mean loss."""
    recipe, shown = agent.config.demonstrations, state.demonstrations
    learner, errors = imitate(recipe, agent.actor, learner, shown, updates)
    return learner, errors.mean()


def structure(agent: Agent) -> tuple[SACState, Imitation | None]:
    """What ``begin`` returns, as shapes and types without numbers."""

    def shown(key):
        state, recipe = _fresh(agent, key), agent.config.demonstrations
        return state, imitation(recipe, state.actor, key) if recipe.episodes else None

    return jax.eval_shape(shown, jax.random.key(0))


@partial(jax.jit, static_argnames="agent")
def _fresh(agent: Agent, key: jax.Array) -> SACState:
    config, env, opt = agent.config, agent.env, agent.optimizer
    key, key_actor, key_critic, key_env, key_time = jax.random.split(key, 5)
    envs = jax.vmap(env.reset)(jax.random.split(key_env, config.num_envs))
    one = jax.tree.map(lambda leaf: leaf[0], envs)
    zero = jnp.zeros((), jnp.int32)
    actor = agent.actor.init(key_actor, one.obs)
    critic = agent.critic.init(key_critic, one.obs, one.privileged, one.action)
    log_temperature = jnp.log(jnp.asarray(config.init_temperature, jnp.float32))
    like, recipe = Transition.between(one, one.action, one, 1.0), config.demonstrations
    demonstrations = None
    if recipe.episodes:
        times = recipe.episodes * round(recipe.duration / config.env.dt)
        demonstrations = replay.init(like.replace(wanted=one.action), times, 1)
    return SACState(
        actor=actor,
        critic=critic,
        target=jax.tree.map(jnp.copy, critic),
        log_temperature=log_temperature,
        actor_opt=opt.init(actor),
        critic_opt=opt.init(critic),
        temperature_opt=opt.init(log_temperature),
        replay=replay.init(
            like, config.replay_capacity // config.num_envs, config.num_envs, steps=config.n_step
        ),
        demonstrations=demonstrations,
        envs=envs,
        # Spread out, so that the environments are not all in the same phase of an episode.
        env_time=jax.random.randint(key_time, (config.num_envs,), 0, config.env.episode_steps),
        key=key,
        env_steps=zero,
        updates=zero,
        noise=jnp.zeros((config.num_envs, 1)) if config.noise_repeat > 1 else None,
        average=jax.tree.map(jnp.copy, actor) if config.average_rate < 1 else None,
    )


def update(
    agent: Agent, state: SACState, batch: Transition, key: jax.Array
) -> tuple[SACState, Metrics]:
    """One gradient step on critic, actor and temperature from a batch (n, ...) of ``sample``.

    The actor maximises the soft value under the critic, less the weighted distance to demonstrated
    actions, which are the first half of the batch. ``key`` is consumed.
    """
    config, actor, critic, opt = agent.config, agent.actor, agent.critic, agent.optimizer
    key_critic, key_actor = jax.random.split(key)
    temperature = jnp.exp(state.log_temperature)

    next_action, log_prob = act(actor, state.actor, batch.next_obs, key_critic)
    discount = config.discount if batch.discount is None else batch.discount
    (loss_q, value), grads = jax.value_and_grad(critic.loss, has_aux=True)(
        state.critic, state.target, batch, next_action, temperature * log_prob, discount
    )
    updates, critic_opt = opt.update(grads, state.critic_opt)
    critic_params = optax.apply_updates(state.critic, updates)

    def actor_loss(params):
        action, log_prob = act(actor, params, batch.obs, key_actor)
        value = critic.value(critic_params, batch.obs, batch.privileged, action)
        loss = losses.actor(value, temperature * log_prob)
        if batch.wanted is not None:
            shown = config.batch_size // 2
            mean, _ = actor.apply(params, batch.obs[:shown])
            loss += config.imitation * losses.imitation(mean[:, 0], batch.wanted[:shown])
        return loss, -log_prob.mean()

    (loss_pi, entropy), grads = jax.value_and_grad(actor_loss, has_aux=True)(state.actor)
    updates, actor_opt = opt.update(grads, state.actor_opt)
    learns = state.env_steps >= config.actor_delay
    updates = jax.tree.map(lambda u: jnp.where(learns, u, 0.0), updates)
    slope = losses.temperature_slope(state.log_temperature, entropy, config.target_entropy)
    step, temperature_opt = opt.update(slope, state.temperature_opt)
    actor_params = optax.apply_updates(state.actor, updates)
    average = None
    if state.average is not None:
        average = optax.incremental_update(actor_params, state.average, config.average_rate)
    state = state.replace(
        actor=actor_params,
        average=average,
        critic=critic_params,
        target=optax.incremental_update(critic_params, state.target, config.target_rate),
        log_temperature=state.log_temperature + jnp.where(learns, step, 0.0),
        actor_opt=actor_opt,
        critic_opt=critic_opt,
        temperature_opt=temperature_opt,
        updates=state.updates + 1,
    )
    metrics = {"critic_loss": loss_q, "actor_loss": loss_pi, "entropy": entropy, "value": value}
    return state, metrics


def interact(agent: Agent, state: SACState, key: jax.Array) -> tuple[SACState, jax.Array]:
    """One step of every environment into the replay buffer; returns the mean reward too.

    ``key`` is consumed.
    """
    config, env, before = agent.config, agent.env, state.envs
    key_action, key_uniform, key_reset = jax.random.split(key, 3)
    mean, log_std = distribution(agent.actor, state.actor, before.obs)
    noise = jax.random.normal(key_action, mean.shape, mean.dtype)
    if state.noise is not None:
        # Noise of one step hardly moves the arm, noise that lasts does (Hollenstein et al.,
        # "Action noise in off-policy deep reinforcement learning", 2022).
        key_anew, share = jax.random.fold_in(key_action, 1), 1 / config.noise_repeat
        anew = jax.random.bernoulli(key_anew, share, noise.shape)
        noise = jnp.where(anew, noise, state.noise)
        state = state.replace(noise=noise)
    action, _ = squashed(mean, log_std, noise)
    uniform = jax.random.uniform(key_uniform, action.shape, minval=-1.0, maxval=1.0)
    action = jnp.where(state.env_steps < config.warmup_steps, uniform, action)
    after = devices.split(jax.vmap(env.step))(before, action)
    now = Transition.between(before, action, after, config.reward_scale)
    over = truncated(config.env, after, state.env_time + 1)
    fresh = jax.vmap(env.reset)(jax.random.split(key_reset, config.num_envs))
    state = state.replace(
        replay=replay.add(state.replay, now, over),
        envs=restarted(over, fresh, after),
        env_time=jnp.where(over, 0, state.env_time + 1),
        env_steps=state.env_steps + config.num_envs,
    )
    return state, after.reward.mean()


def sample(agent: Agent, state: SACState, key: jax.Array) -> Transition:
    """Batches for one step of all environments, (updates_per_step, batch_size, ...).

    With demonstrations they are the first half, and the other half wants the action 0. With
    ``config.mirror`` every other transition is mirrored, by chance. ``key`` is consumed.
    """
    config = agent.config
    if config.mirror:
        key, key_mirror = jax.random.split(key)
    if config.n_step > 1:
        shape = config.updates_per_step, config.batch_size
        batch = replay.sample_steps(state.replay, key, shape, config.n_step, config.discount)
    elif state.demonstrations is None:
        batch = replay.sample(state.replay, key, (config.updates_per_step, config.batch_size))
    else:
        key_own, key_demo = jax.random.split(key)
        half, rest = config.batch_size // 2, config.batch_size - config.batch_size // 2
        own = replay.sample(state.replay, key_own, (config.updates_per_step, rest))
        demo = replay.sample(state.demonstrations, key_demo, (config.updates_per_step, half))
        own = own.replace(wanted=jnp.zeros_like(own.action))
        batch = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), demo, own)
    return replay.mirrored(agent.env, batch, key_mirror) if config.mirror else batch


@partial(jax.jit, static_argnames=("agent", "vector_steps"))
def train_chunk(agent: Agent, state: SACState, vector_steps: int) -> tuple[SACState, Metrics]:
    """``vector_steps`` steps of all environments, with their updates; returns mean metrics.

    ``state`` is not donated: where the new one is not finite, training goes back to the old.
    """
    config = agent.config

    def learn(state, key):
        key_batch, key_update = jax.random.split(key)
        keys = jax.random.split(key_update, config.updates_per_step)
        batches = devices.spread(sample(agent, state, key_batch), axis=1)
        return jax.lax.scan(lambda s, i: update(agent, s, *i), state, (batches, keys))

    def idle(state, key):
        shapes = jax.eval_shape(learn, state, key)[1]
        return state, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def step(state, _):
        key, key_env, key_learn = jax.random.split(state.key, 3)
        state, reward = interact(agent, state.replace(key=key), key_env)
        state, metrics = jax.lax.cond(
            state.env_steps > config.warmup_steps, learn, idle, state, key_learn
        )
        return state, metrics | {"reward": reward}

    state, metrics = jax.lax.scan(step, state, length=vector_steps)
    metrics = jax.tree.map(jnp.mean, metrics)
    return state, metrics | {"temperature": jnp.exp(state.log_temperature)}


@partial(jax.jit, static_argnames=("agent", "vector_steps"))
def train_chunks(
    agent: Agent, states: list[SACState], vector_steps: int
) -> list[tuple[SACState, Metrics]]:
    """``train_chunk`` of several runs at the same step, in one vmap.

    What counts steps is the same in all runs and not batched: a batched condition would become a
    select that copies the replay buffers at every step.
    """
    first = states[0]

    def chunk(state):
        shared = state.replay.replace(position=first.replay.position, filled=first.replay.filled)
        state = state.replace(replay=shared, env_steps=first.env_steps, updates=first.updates)
        return train_chunk(agent, state, vector_steps)

    after = jax.vmap(chunk)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
    return [jax.tree.map(lambda leaf, i=i: leaf[i], after) for i in range(len(states))]


def greedy_policy(agent: Agent, state: SACState) -> Policy:
    """The deterministic policy as a ``Controller``.

    With ``config.average_rate`` it is that of the averaged actor (Polyak and Juditsky, 1992), which
    wanders less from judgement to judgement than the actor does.
    """
    actor = state.actor if state.average is None else state.average
    return to_policy(actor, agent.actor, agent.env)
