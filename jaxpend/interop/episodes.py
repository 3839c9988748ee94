"""Episodes of the learning environment as compiled functions: of one, and of a batch in one call.

What steps from outside jax, one call after the other, uses these; a trainer in jax has ``Env``.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..env import Env, EnvState, restarted, truncated
from ..plant import forward_kinematics
from ..pytree import Pytree, pytree

__all__ = ["Compiled", "Episode", "Outcome", "compiled"]


@pytree
class Episode(Pytree):
    """An episode at one time."""

    state: EnvState
    steps: jax.Array  # () int, since it began
    key: jax.Array  # of the episodes that follow


class Outcome(NamedTuple):
    """What a step shows: of the episode that went on, before the next one begins."""

    obs: jax.Array  # (obs_size,)
    state: jax.Array  # (4,) the true one
    reward: jax.Array  # ()
    over: jax.Array  # () bool


class Compiled(NamedTuple):
    """The functions of an environment: of one episode, and of a batch of them (n, ...)."""

    begin: Callable  # data of a key (2,) -> Episode
    follow: Callable  # Episode -> Episode, the next one
    step: Callable  # Episode, action (1,) -> Episode, Outcome
    begin_all: Callable  # data of keys (n, 2) -> Episode
    follow_all: Callable  # Episode -> Episode, the next ones
    # Episode, actions (n, 1) -> Episode, in which the next one has begun where one is over, its
    # observations and true states, and the Outcome of before
    step_all: Callable
    points: Callable  # state (4,) -> (2, 2), see ``forward_kinematics``


@cache
def compiled(env: Env) -> Compiled:
    """What is compiled for an environment, shared by all of the same configuration."""

    def follow(key):
        key, key_now = jax.random.split(key)
        return Episode(env.reset(key_now), jnp.zeros((), jnp.int32), key)

    def begin(data):
        return follow(jax.random.wrap_key_data(data, impl="threefry2x32"))

    def step(now, action):
        action = action[0].astype(jnp.result_type(float))
        state, steps = env.step(now.state, action), now.steps + 1
        outcome = Outcome(state.obs, state.x, state.reward, truncated(env.config, state, steps))
        return now.replace(state=state, steps=steps), outcome

    def step_all(now, actions):
        after, outcome = jax.vmap(step)(now, actions)
        # To draw random scenarios is slow, and in most steps no episode is over.
        after = jax.lax.cond(
            outcome.over.any(),
            lambda: restarted(outcome.over, jax.vmap(follow)(after.key), after),
            lambda: after,
        )
        return after, after.state.obs, after.state.x, outcome

    return Compiled(
        begin=jax.jit(begin),
        follow=jax.jit(lambda now: follow(now.key)),
        step=jax.jit(step),
        begin_all=jax.jit(jax.vmap(begin)),
        follow_all=jax.jit(lambda now: jax.vmap(follow)(now.key)),
        step_all=jax.jit(step_all),
        points=jax.jit(partial(forward_kinematics, env.plant)),
    )
