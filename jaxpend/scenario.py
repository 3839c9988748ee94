"""A scenario: a plant, where it starts, and everything that goes wrong around it.

An imperfection that is ``None`` is left out of the compiled program, so the nominal scenario
costs nothing; one that is an array may differ per rollout under ``jax.vmap``.
"""

import jax
import jax.numpy as jnp
import numpy as np

from ._struct import pytree
from .errors import JaxpendError, choose
from .plant import Plant

__all__ = ["Pulses", "Scenario", "delay_steps"]


@pytree
class Pulses:
    """Gaussian torque pulses ``A exp(-(t - mu)^2 / (2 sigma^2))``, n on each joint."""

    time: jax.Array  # (2, n) s, centre mu
    width: jax.Array  # (2, n) s, standard deviation sigma
    amplitude: jax.Array  # (2, n) N m, A

    def torque(self, t: jax.Array) -> jax.Array:
        """Sum of the pulses at time ``t`` (s), shape (2,), N m."""
        z = (t - self.time) / self.width
        return jnp.sum(self.amplitude * jnp.exp(-0.5 * z * z), axis=-1)


@pytree
class Scenario:
    """What a controller is put into. Only ``plant`` is required; the rest defaults to nominal."""

    plant: Plant
    x0: jax.Array | None = None  # (4,) initial state; None: hanging at rest
    measurement_noise: jax.Array | None = None  # (4,) standard deviation, rad and rad/s
    delay: jax.Array | None = None  # (4,) int, steps by which each measured component lags
    process_noise: jax.Array | None = None  # (4,) standard deviation added after each step
    torque_noise: jax.Array | None = None  # (2,) N m, standard deviation
    responsiveness: jax.Array | None = None  # () fraction of the commanded change made per step
    pulses: Pulses | None = None

    @property
    def dtype(self):
        """The floating-point type that the rollout computes in."""
        types = [jnp.asarray(leaf).dtype for leaf in jax.tree.leaves(self)]
        return jnp.result_type(*(t for t in types if jnp.issubdtype(t, jnp.floating)))


def delay_steps(delay: float, dt: float = 0.002, mode: str = "posvel") -> np.ndarray:
    """Whole steps by which each measured component lags, shape (4,), int.

    Args:
        delay: seconds; ``int(delay / dt)`` steps in float64, as the reference simulator rounds.
        mode: "posvel" delays positions and velocities, "vel" velocities only, "none" nothing.

    Raises:
        JaxpendError: a negative or non-finite delay, or an unknown mode.
    """
    if not (np.isfinite(delay) and delay >= 0):
        raise JaxpendError(f"delay is {delay} s; it must be finite and not negative")
    lagging = {"posvel": [1, 1, 1, 1], "vel": [0, 0, 1, 1], "none": [0, 0, 0, 0]}
    return int(delay / dt) * np.array(lagging[choose("delay mode", mode, lagging)])
