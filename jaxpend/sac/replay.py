"""Replay: a ring buffer of typed transitions, laid out (time, environment, ...)."""

import chex
import jax
import jax.numpy as jnp

from ..env import Env, EnvState
from ..pytree import Pytree, pytree

__all__ = ["Replay", "Transition", "add", "fill", "init", "mirrored", "sample", "sample_steps"]


@pytree
class Transition(Pytree):
    """One step of one environment; all fields have the same leading axes."""

    obs: jax.Array  # (..., obs_size), what the policy saw
    privileged: jax.Array  # (..., privileged_size), what the critics saw besides
    action: jax.Array  # (...,) in [-1, 1]
    reward: jax.Array  # (...,) scaled
    next_obs: jax.Array  # (..., obs_size), the true next ones, also where an episode was cut
    next_privileged: jax.Array  # (..., privileged_size)
    wanted: jax.Array | None = None  # (...,) the action that a demonstration asks for
    # (...,) factor of the value of the next state; None: that of one step.
    discount: jax.Array | None = None

    @classmethod
    def between(cls, before: EnvState, action: jax.Array, after: EnvState, reward_scale: float):
        """What led from one state to another."""
        reward = reward_scale * after.reward
        return cls(before.obs, before.privileged, action, reward, after.obs, after.privileged)


@pytree
class Replay(Pytree):
    """The last transitions of some environments, or the demonstrations, as of one environment."""

    data: Transition  # (time, environment, ...)
    position: jax.Array  # () int, the time that is written next
    filled: jax.Array  # () int, times that hold something
    cut: jax.Array | None = None  # (time, environment) bool, an episode ended; for several steps


def init(like: Transition, times: int, environments: int, *, steps: int = 1) -> Replay:
    """An empty buffer for transitions of the shapes and types of ``like``, one environment's.

    ``sample_steps`` can give transitions of several steps where ``steps`` is more than 1: it takes
    memory of where episodes ended.
    """
    shape, zero = (times, environments), jnp.zeros((), jnp.int32)
    data = jax.tree.map(lambda v: jnp.zeros(shape + v.shape, v.dtype), like)
    return Replay(data, zero, zero, jnp.zeros(shape, bool) if steps > 1 else None)


def add(replay: Replay, now: Transition, cut: jax.Array) -> Replay:
    """Write a step of all environments, (environment, ...), over the oldest one.

    ``cut`` (environment,) says where an episode ended with it.
    """
    times, environments = replay.data.action.shape
    chex.assert_shape((now.action, now.reward), (environments,))

    def write(old, new):
        return jax.lax.dynamic_update_index_in_dim(old, new, replay.position, axis=0)

    position, filled = (replay.position + 1) % times, jnp.minimum(replay.filled + 1, times)
    cuts = None if replay.cut is None else write(replay.cut, cut)
    return Replay(jax.tree.map(write, replay.data, now), position, filled, cuts)


def fill(replay: Replay, shown: Transition) -> Replay:
    """An empty buffer of one environment, with transitions (n, ...), as many as fit or fewer."""

    def padded(empty, rows):
        return jnp.pad(rows[:, None], [(0, len(empty) - len(rows))] + [(0, 0)] * rows.ndim)

    filled = jnp.asarray(len(shown.action), jnp.int32)
    return replay.replace(data=jax.tree.map(padded, replay.data, shown), filled=filled)


def sample(replay: Replay, key: jax.Array, shape: tuple[int, ...]) -> Transition:
    """Transitions (*shape, ...), each any of the filled ones; ``key`` is consumed."""
    environments = replay.data.action.shape[1]
    flat = jax.random.randint(key, shape, 0, replay.filled * environments)
    time, environment = flat // environments, flat % environments
    return jax.tree.map(lambda v: v[time, environment], replay.data)


def sample_steps(
    replay: Replay, key: jax.Array, shape: tuple[int, ...], steps: int, discount: float
) -> Transition:
    """Transitions (*shape, ...) of up to so many steps each, fewer where an episode ended.

    The reward is the discounted sum of theirs, the next state that of the last one, and
    ``discount`` what its value counts (Sutton, "Learning to predict by the methods of temporal
    differences", 1988). ``key`` is consumed. The buffer must be one of several steps (``init``).
    """
    times, environments = replay.data.action.shape
    key_time, key_environment = jax.random.split(key)
    count = jnp.maximum(replay.filled - steps + 1, 1)
    start = jax.random.randint(key_time, shape, 0, count) + replay.position - replay.filled
    environment = jax.random.randint(key_environment, shape, 0, environments)
    assert replay.cut is not None
    # r_0 + gamma r_1 + ... as far as the episode goes
    reward, last, on = jnp.zeros(shape), start, jnp.ones(shape, bool)
    for i in range(steps):
        now = (start + i) % times
        reward = reward + jnp.where(on, discount**i * replay.data.reward[now, environment], 0.0)
        last = jnp.where(on, start + i, last)
        on = on & ~replay.cut[now, environment]
    first, end = start % times, last % times
    batch = jax.tree.map(lambda v: v[first, environment], replay.data)
    return batch.replace(
        reward=reward,
        next_obs=replay.data.next_obs[end, environment],
        next_privileged=replay.data.next_privileged[end, environment],
        discount=discount ** (last - start + 1).astype(reward.dtype),
    )


def mirrored(env: Env, batch: Transition, key: jax.Array) -> Transition:
    """The same, each by chance as a mirror shows it; ``key`` is consumed."""
    flip = jax.random.bernoulli(key, shape=batch.action.shape)
    obs, privileged = map(jnp.array, env.mirrored)
    one = jnp.ones(())
    wanted = None if batch.wanted is None else -one
    same = None if batch.discount is None else one
    signs = Transition(obs, privileged, -one, one, obs, privileged, wanted, same)

    def seen(value, sign):
        there = jnp.expand_dims(flip, tuple(range(flip.ndim, value.ndim)))
        return value * jnp.where(there, sign, 1)

    return jax.tree.map(seen, batch, signs)
