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

from ..config import DemonstrationConfig
from ..controller import Controller
from ..controllers import load_reference, tvlqr
from ..env import Env
from ..errors import JaxpendError
from ..pytree import Pytree, pytree
from ..scenario import random_pulses
from . import losses, replay
from .networks import Actor, Params
from .replay import Replay, Transition

__all__ = ["DemonstrationConfig", "Imitation", "collect", "imitate", "imitation", "swingups"]

SATURATED = 0.99  # of the torque limit


def collect(
    config: DemonstrationConfig,
    env: Env,
    controller: Controller,
    key: jax.Array,
    *,
    reward_scale: float,
) -> Transition:
    """Run a controller, called at the environment's control period, under noise.

    It acts on the true state, also where a policy sees a measured one (Chen et al., "Learning by
    cheating", 2019). Returns transitions (n, ...), every one exact (velocity jumps fall between
    them), with the wanted actions. Those in which the controller wants all the torque there is
    are left out: it has lost the swing-up there and has nothing to teach. ``key`` is consumed.

    Raises:
        JaxpendError: nothing is left.
    """
    joint, limit = env.task.joint, env.config.torque_limit
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
            memory, torque = controller(memory, k * env.config.dt, before.x)
            wanted = jnp.clip(torque[joint] / limit, -1.0, 1.0)
            action = jnp.clip(wanted + disturbance, -1.0, 1.0)
            after = env.step(before, action)
            shown = Transition.between(before, action, after, reward_scale).replace(wanted=wanted)
            return (env.kicked(after, jnp.pad(kick, (2, 0))), memory), shown

        first = env.kicked(env.reset(key_reset), start), controller.reset(key_controller)
        return jax.lax.scan(step, first, (jnp.arange(steps), noise, kicks))[1]

    shown = jax.jit(jax.vmap(episode))(jax.random.split(key, config.episodes))
    teaches = np.abs(np.asarray(shown.wanted)) < SATURATED
    if not teaches.any():
        raise JaxpendError("the demonstrating controller asks for all the torque all the time")
    return jax.tree.map(lambda v: v[teaches], shown)


def swingups(
    config: DemonstrationConfig, env: Env, key: jax.Array, *, reward_scale: float
) -> Transition:
    """``collect`` with the shipped swing-up of the environment's robot under TVLQR."""
    reference = load_reference(env.task.robot)
    controller = tvlqr(env.plant, reference, r=10.0, delay=config.delay)
    return collect(config, env, controller, key, reward_scale=reward_scale)


@pytree
class Imitation(Pytree):
    """An actor on its way to the demonstrated actions."""

    params: Params
    opt_state: optax.OptState
    key: jax.Array  # the same all the way: an update's key depends on its number alone
    done: jax.Array  # () int, updates


def _adam(config: DemonstrationConfig) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.updates, 1e-3))


def imitation(config: DemonstrationConfig, params: Params, key: jax.Array) -> Imitation:
    """Before the first update. ``key`` is consumed."""
    return Imitation(params, _adam(config).init(params), key, jnp.zeros((), jnp.int32))


@partial(jax.jit, static_argnames=("config", "actor", "updates"))
def imitate(
    config: DemonstrationConfig, actor: Actor, learner: Imitation, shown: Replay, updates: int
) -> tuple[Imitation, jax.Array]:
    """Fit the actor's greedy action to the wanted ones; returns the learner and losses (updates,).

    Batches are drawn from the demonstrations ``shown``.
    """
    keys = jax.random.split(learner.key, config.updates)

    def step(carry, key):
        params, opt_state = carry
        batch = replay.sample(shown, key, (config.batch_size,))

        def loss(params):
            mean, _ = actor.apply(params, batch.obs)
            return losses.imitation(mean[:, 0], jnp.asarray(batch.wanted))

        error, grads = jax.value_and_grad(loss)(params)
        change, opt_state = _adam(config).update(grads, opt_state)
        return (optax.apply_updates(params, change), opt_state), error

    now = jax.lax.dynamic_slice_in_dim(keys, learner.done, updates)
    start = learner.params, learner.opt_state
    (params, opt_state), errors = jax.lax.scan(step, start, now)
    done = learner.done + updates
    return learner.replace(params=params, opt_state=opt_state, done=done), errors
