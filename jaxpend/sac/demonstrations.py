"""Demonstrations of an optimised swing-up, for imitation and for SAC's replay buffer.

The shipped swing-up, stabilised by TVLQR, is run under noise in the learning environment. The
label of a row is the action the controller wanted, not the disturbed one it got, so that a
policy that imitates it learns to return from where noise leads (Laskey et al., "DART: noise
injection for robust imitation learning", 2017).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from .. import designs
from ..config import DemonstrationConfig
from ..controller import Controller
from ..env import DoublePendulum
from ..errors import JaxpendError
from ..pytree import pytree
from ..scenario import random_pulses
from .networks import Actor

__all__ = ["DemonstrationConfig", "Imitation", "collect", "imitate", "imitation", "swingups"]

SATURATED = 0.99  # of the torque limit


def collect(
    config: DemonstrationConfig,
    env: DoublePendulum,
    controller: Controller,
    key: jax.Array,
    *,
    reward_scale: float,
) -> tuple[jax.Array, jax.Array]:
    """Run a controller, called at the environment's control period, under noise.

    It acts on the true state, also where a policy sees a measured one (Chen et al., "Learning by
    cheating", 2019). Returns the rows of ``sac.Replay``, every one an exact transition (velocity
    jumps fall between rows), and the wanted actions (n,). Rows in which the controller wants all
    the torque there is are left out: it has lost the swing-up there and has nothing to teach.
    ``key`` is consumed.

    Raises:
        JaxpendError: nothing is left.
    """
    joint, limit = designs.active_joint(env.config.robot), env.config.torque_limit
    steps = round(config.duration / env.config.dt)

    def episode(key):
        key_level, key_start, key_controller, key_action, key_kick, key_pulse, key_reset = (
            jax.random.split(key, 7)
        )
        level = jax.random.uniform(key_level) ** 2
        start = level * config.start_spread * jax.random.normal(key_start, (4,))
        noise = level * config.action_noise * jax.random.normal(key_action, (steps,))
        pulses = random_pulses(key_pulse)
        bursts = jax.vmap(pulses.torque)(env.config.dt * jnp.arange(steps))[:, joint]
        noise = noise + config.pulses * bursts / limit
        kicks = level * config.kicks * jax.random.normal(key_kick, (steps, 2))

        def step(carry, now):
            before, memory = carry
            k, disturbance, kick = now
            memory, torque = controller(memory, k * env.config.dt, before.pipeline_state["x"])
            wanted = jnp.clip(torque[joint] / limit, -1.0, 1.0)
            action = jnp.clip(wanted + disturbance, -1.0, 1.0)
            after = env.step(before, action[None])
            paid = jnp.stack([action, reward_scale * after.reward])
            row = jnp.concatenate([before.obs, paid, after.obs])
            return (env.kicked(after, jnp.pad(kick, (2, 0))), memory), (row, wanted)

        first = env.kicked(env.reset(key_reset), start), controller.reset(key_controller)
        return jax.lax.scan(step, first, (jnp.arange(steps), noise, kicks))[1]

    rows, wanted = jax.jit(jax.vmap(episode))(jax.random.split(key, config.episodes))
    rows, wanted = rows.reshape(-1, rows.shape[-1]), wanted.reshape(-1)
    teaches = np.abs(np.asarray(wanted)) < SATURATED
    if not teaches.any():
        raise JaxpendError("the demonstrating controller asks for all the torque all the time")
    return rows[teaches], wanted[teaches]


def swingups(
    config: DemonstrationConfig, env: DoublePendulum, key: jax.Array, *, reward_scale: float
) -> tuple[jax.Array, jax.Array]:
    """``collect`` with the shipped swing-up of the environment's robot under TVLQR."""
    from ..controllers import load_reference, tvlqr  # loads scipy

    controller = tvlqr(env.plant, load_reference(env.config.robot), r=10.0, delay=config.delay)
    return collect(config, env, controller, key, reward_scale=reward_scale)


@pytree
class Imitation:
    """An actor on its way to the demonstrated actions."""

    params: dict
    opt_state: optax.OptState
    key: jax.Array  # the same all the way: an update's key depends on its number alone
    done: jax.Array  # () int, updates


def _adam(config: DemonstrationConfig) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.updates, 1e-3))


def imitation(config: DemonstrationConfig, params: dict, key: jax.Array) -> Imitation:
    """Before the first update. ``key`` is consumed."""
    return Imitation(params, _adam(config).init(params), key, jnp.zeros((), jnp.int32))


@partial(jax.jit, static_argnames=("config", "actor", "updates"))
def imitate(
    config: DemonstrationConfig,
    actor: Actor,
    state: Imitation,
    obs: jax.Array,
    wanted: jax.Array,
    updates: int,
    count: jax.Array | int | None = None,
) -> tuple[Imitation, jax.Array]:
    """Fit the actor's greedy action to the wanted ones; returns the state and losses (updates,).

    Minimises the mean squared error of tanh(mean) at the observations (n, observation_size).
    ``count`` is the number of them, if they are not all filled.
    """
    count = len(obs) if count is None else count
    keys = jax.random.split(state.key, config.updates)

    def step(carry, key):
        params, opt_state = carry
        index = jax.random.randint(key, (config.batch_size,), 0, count)

        def loss(params):
            mean, _ = actor.apply(params, obs[index])
            return jnp.mean((jnp.tanh(mean[:, 0]) - wanted[index]) ** 2)

        error, grads = jax.value_and_grad(loss)(params)
        change, opt_state = _adam(config).update(grads, opt_state)
        return (optax.apply_updates(params, change), opt_state), error

    now = jax.lax.dynamic_slice_in_dim(keys, state.done, updates)
    (params, opt_state), errors = jax.lax.scan(step, (state.params, state.opt_state), now)
    return state.replace(params=params, opt_state=opt_state, done=state.done + updates), errors
