"""Flax networks of SAC: a tanh-Gaussian actor, action values, and the policy made of an actor."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from ..controllers.policy import ACTIVATIONS, Policy
from ..env import Env

__all__ = [
    "Actor", "Params", "Trunk", "Twins", "act", "constant_log_std", "distribution", "squashed",
    "to_policy",
]  # fmt: skip

LOG_STD_RANGE = (-10.0, 2.0)

Params = Mapping[str, Any]  # of a Flax network: {"params": {layer: ...}}


class Trunk(nn.Module):
    """Dense layers, each followed by an optional layer normalisation and the activation."""

    hidden: Sequence[int]
    activation: str
    layer_norm: bool = False

    @nn.compact
    def __call__(self, h: Array) -> Array:
        """Features (..., hidden[-1]) of inputs (..., n)."""
        for width in self.hidden:
            h = nn.Dense(width)(h)
            h = nn.LayerNorm()(h) if self.layer_norm else h
            h = ACTIVATIONS[self.activation](h)
        return h


class Actor(nn.Module):
    """Mean and log standard deviation (..., 1) of the action before the tanh.

    It sees ``EnvState.obs``, not what is for the critics alone, such as the previous action: the
    reward depends on it, but a policy that feeds its last action back acts differently at 500 Hz
    than at the 100 Hz it was trained at.
    """

    hidden: Sequence[int]
    activation: str

    @nn.compact
    def __call__(self, obs: Array) -> tuple[Array, Array]:
        """For observations (..., obs_size)."""
        h = Trunk(self.hidden, self.activation)(obs)
        mean = nn.Dense(1, name="mean")(h)
        log_std = nn.Dense(1, name="log_std")(h)
        return mean, jnp.clip(log_std, *LOG_STD_RANGE)


class Twins(nn.Module):
    """Two independent action values."""

    hidden: Sequence[int]
    activation: str
    layer_norm: bool
    outputs: int = 1

    @nn.compact
    def __call__(self, obs: Array, privileged: Array, action: Array) -> Array:
        """Outputs (..., 2, outputs) of what is seen and actions (...,)."""
        inputs = jnp.concatenate([obs, privileged, action[..., None]], axis=-1)
        values = []
        for _ in range(2):
            h = Trunk(self.hidden, self.activation, self.layer_norm)(inputs)
            values.append(nn.Dense(self.outputs)(h))
        return jnp.stack(values, axis=-2)


def squashed(mean: Array, log_std: Array, noise: Array) -> tuple[Array, Array]:
    """tanh(mean + std noise) for a mean and a logarithm of std (..., 1), as of ``Actor``.

    ``noise`` (..., 1) is standard normal. Returns the action (...,) and its log-probability
    (...,), computed from the sample before the tanh with
    ``log(1 - tanh(v)^2) = 2 (log 2 - v - softplus(-2 v))`` (Haarnoja et al., 2018, appendix C).
    """
    v = mean + jnp.exp(log_std) * noise
    log_prob = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    log_prob = log_prob - 2 * (jnp.log(2.0) - v - jax.nn.softplus(-2 * v))
    return jnp.tanh(v)[..., 0], log_prob[..., 0]


def distribution(actor: Actor, params: Params, obs: Array) -> tuple[Array, Array]:
    """Mean and log standard deviation (..., 1) of an ``Actor`` for observations (..., obs_size)."""
    return cast(tuple[Array, Array], actor.apply(params, obs))


def act(actor: Actor, params: Params, obs: Array, key: Array) -> tuple[Array, Array]:
    """A random action and its log-probability, as ``squashed``, for observations (..., obs_size).

    ``key`` is consumed.
    """
    mean, log_std = distribution(actor, params, obs)
    return squashed(mean, log_std, jax.random.normal(key, mean.shape, mean.dtype))


def constant_log_std(actor_params: Params, log_std: float) -> Params:
    """Actor parameters with the same log standard deviation in every state."""
    params = dict(actor_params["params"])
    head = jax.tree.map(jnp.zeros_like, params["log_std"])
    params["log_std"] = head | {"bias": head["bias"] + log_std}
    return {"params": params}


def to_policy(actor_params: Params, actor: Actor, env: Env) -> Policy:
    """The greedy policy of an actor as a ``Controller`` of plain arrays."""
    params, config = actor_params["params"], env.config
    trunk = params["Trunk_0"]
    dense = [trunk[f"Dense_{i}"] for i in range(len(actor.hidden))] + [params["mean"]]
    return Policy(
        layers=tuple((d["kernel"], d["bias"]) for d in dense),
        torque_limit=jnp.asarray(config.torque_limit, jnp.float32),
        robot=env.task.robot,
        observation=config.observation,
        activation=actor.activation,
        control_dt=config.dt,
    )
