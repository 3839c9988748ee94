"""Critics: what judges the actions of an actor. Another critic is another class of this form."""

import dataclasses
from typing import Protocol, cast

import jax
import jax.numpy as jnp
from jax import Array

from . import losses
from .networks import Params, Twins
from .replay import Transition

__all__ = ["Critic", "HistogramCritic", "TwinCritic"]


class Critic(Protocol):
    """A hashable value; ``params`` are what ``init`` returns, n is the size of a batch."""

    def init(self, key: Array, obs: Array, privileged: Array, action: Array) -> Params:
        """Parameters for what is seen and done, of these shapes; ``key`` is consumed."""

    def value(self, params: Params, obs: Array, privileged: Array, action: Array) -> Array:
        """What the actor climbs, (...,): the expected return of actions (...,)."""

    def loss(
        self, params: Params, target: Params, batch: Transition, next_action: Array,
        next_cost: Array, discount: Array | float,
    ) -> tuple[Array, Array]:  # fmt: skip
        """The loss () and the mean value () on a batch (n, ...).

        ``target`` are slowly following parameters, ``next_action`` (n,) is drawn by the actor
        in the next state, ``next_cost`` (n,) the temperature times its log-probability;
        ``discount`` is of one step, or (n,) of all steps of a transition.
        """


@dataclasses.dataclass(frozen=True)
class TwinCritic:
    """Two independent action values, of which the lower counts (Fujimoto et al., 2018)."""

    hidden: tuple[int, ...]
    activation: str
    layer_norm: bool = False

    @property
    def network(self) -> Twins:
        """Of both values."""
        return Twins(self.hidden, self.activation, self.layer_norm)

    def both(self, params: Params, obs: Array, privileged: Array, action: Array) -> Array:
        """Both values (..., 2)."""
        return cast(Array, self.network.apply(params, obs, privileged, action))[..., 0]

    def init(self, key, obs, privileged, action):
        return self.network.init(key, obs, privileged, action)

    def value(self, params, obs, privileged, action):
        return self.both(params, obs, privileged, action).min(axis=-1)

    def loss(self, params, target, batch, next_action, next_cost, discount):
        """The squared distance of both values to the soft target."""
        next_value = self.value(target, batch.next_obs, batch.next_privileged, next_action)
        goal = losses.soft_target(batch.reward, next_value, next_cost, discount)
        q = self.both(params, batch.obs, batch.privileged, batch.action)
        return losses.squared_error(q, goal), q.mean()


@dataclasses.dataclass(frozen=True)
class HistogramCritic(TwinCritic):
    """Two independent distributions of the return over bins, of which the lower mean counts.

    They are learned as classes are, by cross-entropy (Farebrother et al., "Stop regressing", 2024).
    """

    bins: int = 101
    range: tuple[float, float] = (-100.0, 150.0)  # of returns, which are cut off at its ends

    @property
    def network(self) -> Twins:
        """The logits of both distributions."""
        return Twins(self.hidden, self.activation, self.layer_norm, self.bins)

    @property
    def edges(self) -> Array:
        """Of the bins, (bins + 1,)."""
        return jnp.linspace(*self.range, self.bins + 1)

    def logits(self, params: Params, obs: Array, privileged: Array, action: Array) -> Array:
        """Of both distributions, (..., 2, bins)."""
        return cast(Array, self.network.apply(params, obs, privileged, action))

    def means(self, logits: Array) -> Array:
        """Means (..., 2) of distributions (..., 2, bins)."""
        return jax.nn.softmax(logits) @ ((self.edges[1:] + self.edges[:-1]) / 2)

    def both(self, params: Params, obs: Array, privileged: Array, action: Array) -> Array:
        """The means of both, (..., 2)."""
        return self.means(self.logits(params, obs, privileged, action))

    def loss(self, params, target, batch, next_action, next_cost, discount):
        """The cross-entropy of both distributions with one about the soft target."""
        next_value = self.value(target, batch.next_obs, batch.next_privileged, next_action)
        goal = losses.soft_target(batch.reward, next_value, next_cost, discount)
        logits = self.logits(params, batch.obs, batch.privileged, batch.action)
        loss = losses.cross_entropy(logits, losses.histogram(goal, self.edges))
        return loss, self.means(logits).mean()
