"""What SAC minimises (Haarnoja et al., 2018, arXiv 1812.05905); n is the size of a batch."""

import math

import chex
import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import erf

__all__ = [
    "actor", "cross_entropy", "histogram", "imitation", "soft_target", "squared_error",
    "temperature_slope",
]  # fmt: skip


def soft_target(
    reward: Array, next_value: Array, next_cost: Array, discount: Array | float
) -> Array:
    """What action values should be, (n,).

    ``next_value`` (n,) is of an action drawn in the next state, ``next_cost`` (n,) the temperature
    times its log-probability, ``discount`` () or (n,). Episodes are truncated, never terminated:
    all bootstrap.
    """
    chex.assert_equal_shape((reward, next_value, next_cost))
    # y = r + gamma (Q'(s', a') - T log pi(a'|s'))
    return reward + discount * (next_value - next_cost)


def squared_error(values: Array, target: Array) -> Array:
    """Mean squared distance of the values (n, critics) to their common target (n,)."""
    chex.assert_equal_shape_prefix((values, target), 1)
    chex.assert_rank((values, target), (2, 1))
    # mean_ij (Q_j(s_i, a_i) - y_i)^2
    return jnp.mean((values - target[:, None]) ** 2)


def histogram(target: Array, edges: Array) -> Array:
    """What each bin has (n, bins) of a normal distribution about a target (n,), all in all 1.

    ``edges`` are (bins + 1,), evenly spaced; the standard deviation is 0.75 bins, a target beyond
    the edges is at the edge (HL-Gauss: Imani and White, 2018; Farebrother et al., 2024).
    """
    chex.assert_rank((target, edges), 1)
    spread = 0.75 * (edges[1] - edges[0])
    target = jnp.clip(target, edges[0], edges[-1])
    # p_b = (F(e_b+1) - F(e_b)) / (F(e_n) - F(e_0)), F(e) = erf((e - y) / (sqrt(2) spread)): the
    # distribution function of N(y, spread^2) but for factors that cancel, and faster.
    below = erf((edges - target[:, None]) / (math.sqrt(2) * spread))
    return jnp.diff(below, axis=-1) / (below[:, -1:] - below[:, :1])


def cross_entropy(logits: Array, target: Array) -> Array:
    """Mean cross-entropy of logits (n, critics, bins) with their common target (n, bins)."""
    chex.assert_rank((logits, target), (3, 2))
    # -mean_ij sum_b p_b(y_i) log softmax(l_j)_b
    return -jnp.sum(target[:, None] * jax.nn.log_softmax(logits), axis=-1).mean()


def actor(value: Array, cost: Array) -> Array:
    """The soft value, negated: ``value`` (n,) of drawn actions, ``cost`` (n,) as above."""
    chex.assert_equal_shape((value, cost))
    # -mean (Q(s, a) - T log pi(a|s))
    return -(value - cost).mean()


def imitation(mean: Array, wanted: Array) -> Array:
    """Mean squared distance of greedy actions to the wanted ones (n,); ``mean`` is before tanh."""
    chex.assert_equal_shape((mean, wanted))
    # mean (tanh(mu(s)) - a*)^2
    return jnp.mean((jnp.tanh(mean) - wanted) ** 2)


def temperature_slope(log_temperature: Array, entropy: Array, target_entropy: float) -> Array:
    """The slope () of the temperature's loss in its logarithm: it holds the entropy at a target."""
    chex.assert_rank((log_temperature, entropy), 0)
    # d/d(log T) of T (H - H*)
    return jnp.exp(log_temperature) * (entropy - target_entropy)
