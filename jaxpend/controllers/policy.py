"""A neural network policy as a controller."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from .. import config
from ..designs import active_joint
from ..errors import JaxpendError
from ..observation import Observation
from ..plant import joint_torque
from ..pytree import Pytree, pytree, static
from ..stepping import Startable
from .search_space import WEIGHT

__all__ = [
    "ACTIVATIONS", "SQUASHES", "Memory", "Policy", "change_policies", "network_in", "policies_in",
]  # fmt: skip

ACTIVATIONS = {name: getattr(jax.nn, name) for name in config.ACTIVATIONS}
# What makes an action in [-1, 1] of the network's output: tanh in SAC, clipping in most of PPO.
SQUASHES = {"tanh": jnp.tanh, "clip": lambda pre: jnp.clip(pre, -1.0, 1.0)}
FASTEST = 0.001  # s, the shortest time between calls at which a history still goes back far enough


@pytree
class Memory(Pytree):
    """The calls of a policy so far, the newest first; as many as its history may need."""

    x: jax.Array  # (N, 4) measured states
    actions: jax.Array  # (N,) in them
    t: jax.Array  # () s, of the last call; -inf before the first

    def past(self, history: int, period: float, t: jax.Array, x: jax.Array) -> jax.Array:
        """What an ``Observation`` calls ``past``, (history, 5), at time ``t`` and state ``x``.

        States are those of 1, 2, ... periods ago; actions the means over the periods from then
        on. Called once a period, as in training, those are the actions there were; called more
        often they change as smoothly as the mean. Before the first call the state was the same,
        and the action 0.
        """
        # Calls in a period. Before the first call t - self.t is infinite, and this is 0.
        calls = jnp.round(period / (t - self.t)).astype(jnp.int32)
        calls = jnp.clip(calls, 1, len(self.x) // history)
        ago = jnp.arange(1, history + 1) * calls - 1
        states = jnp.where(jnp.isfinite(self.t), self.x[ago], x)
        sums = jnp.append(0.0, jnp.cumsum(self.actions)[ago]).astype(self.actions.dtype)
        return jnp.column_stack([states, (sums[1:] - sums[:-1]) / calls])

    def after(self, t: jax.Array, x: jax.Array, action: jax.Array) -> "Memory":
        """With a call at time ``t`` in state ``x`` that acted so."""
        states = jnp.concatenate([x[None], self.x[:-1]])
        states = jnp.where(jnp.isfinite(self.t), states, x)  # the first state was there before
        actions = jnp.append(action, self.actions[:-1]).astype(self.actions.dtype)
        return Memory(states, actions, jnp.asarray(t, self.t.dtype))


@pytree
class Policy(Startable):
    """Multi-layer perceptron from an observation of the state to the driven joint's torque.

    With ``observation.history`` it sees past states and actions too, as far apart as in training
    (``control_dt``), however often it is called. ``action_noise`` is the standard deviation of
    the noise added to the action before it is squashed (SNES trains with it); None means greedy
    and costs nothing.
    """

    SEARCHED: ClassVar = {"layers": WEIGHT}
    layers: tuple[tuple[jax.Array, jax.Array], ...]  # (kernel (in, out), bias (out,)) each
    torque_limit: jax.Array  # () N m, torque at action 1
    action_noise: jax.Array | None = None  # ()
    robot: str = static(default="pendubot")
    observation: Observation = static(default=Observation())
    activation: str = static(default="relu")
    squash: str = static(default="tanh")  # a name in ``SQUASHES``
    control_dt: float = static(default=0.01)  # s, the period it was trained at

    def pre_action(self, obs: jax.Array) -> jax.Array:
        """The action before squashing, scalar, for an observation (``observation.size``,)."""
        h = obs
        *hidden, (kernel, bias) = self.layers
        for w, b in hidden:
            h = ACTIVATIONS[self.activation](h @ w + b)
        return (h @ kernel + bias)[0]

    def greedy(self, obs: jax.Array) -> jax.Array:
        """The action in [-1, 1] without noise, scalar, for an observation."""
        return SQUASHES[self.squash](self.pre_action(obs))

    def reset(self, key: jax.Array) -> tuple[jax.Array | None, Memory | None]:
        """The key for the action noise and the memory, or None where there is no such thing."""
        memory, dtype = None, jnp.result_type(float)
        if history := self.observation.history:
            calls = history * max(round(self.control_dt / FASTEST), 1)
            states, never = jnp.zeros((calls, 4), dtype), jnp.asarray(-jnp.inf, dtype)
            memory = Memory(states, jnp.zeros(calls, dtype), never)
        return None if self.action_noise is None else key, memory

    def look(self, carry, t: jax.Array, x: jax.Array) -> jax.Array:
        """What is seen (``observation.size``,) at time ``t`` in a measured state (4,)."""
        memory, past = carry[1], None
        if memory is not None:
            past = memory.past(self.observation.history, self.control_dt, t, x)
        return self.observation(x, past)

    def __call__(self, carry, t, x):
        """Torque (2,), N m, zero on the passive joint."""
        key, memory = carry
        pre = self.pre_action(self.look(carry, t, x))
        if self.action_noise is not None:
            key, key_noise = jax.random.split(key)
            pre = pre + self.action_noise * jax.random.normal(key_noise, (), pre.dtype)
        action = SQUASHES[self.squash](pre)
        if memory is not None:
            memory = memory.after(t, x, action)
        torque = joint_torque(self.torque_limit * action, active_joint(self.robot))
        return (key, memory), torque


def _is_policy(part: Any) -> bool:
    return isinstance(part, Policy)


def change_policies(controller: Any, change: Callable[[Policy], Policy]) -> tuple[Any, int]:
    """A controller with every policy in it changed, and how many those are."""
    parts, structure = jax.tree.flatten(controller, is_leaf=_is_policy)
    changed = [change(part) if _is_policy(part) else part for part in parts]
    return jax.tree.unflatten(structure, changed), sum(map(_is_policy, parts))


def policies_in(controller: Any) -> list[Policy]:
    """All policies in a controller."""
    return [part for part in jax.tree.leaves(controller, is_leaf=_is_policy) if _is_policy(part)]


def network_in(controller: Any, where: str | Path = "the controller") -> Policy:
    """The one policy in a controller. Raises ``JaxpendError``, naming ``where``, if it has none."""
    found = policies_in(controller)
    if len(found) != 1:
        raise JaxpendError(f"{where} holds {len(found)} neural networks; one is needed")
    return found[0]
