"""A scenario: a plant, where it starts, and everything that goes wrong around it.

An imperfection that is ``None`` is left out of the compiled program, so the nominal scenario
costs nothing; one that is an array may differ per rollout under ``jax.vmap``.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from .errors import JaxpendError, choose
from .plant import Plant
from .pytree import Pytree, pytree

__all__ = ["DT", "DURATION", "Pulses", "Scenario", "check_values", "delay_steps", "random_pulses"]

# Of the boards, and of everything here that does not say otherwise, s.
DT = 0.002  # control and integration period
DURATION = 10.0


@pytree
class Pulses(Pytree):
    """Gaussian torque pulses ``A exp(-(t - mu)^2 / (2 sigma^2))``, n on each joint."""

    time: jax.Array  # (2, n) s, centre mu
    width: jax.Array  # (2, n) s, standard deviation sigma
    amplitude: jax.Array  # (2, n) N m, A

    def torque(self, t: jax.Array) -> jax.Array:
        """Sum of the pulses at time ``t`` (s), shape (2,), N m."""
        z = (t - self.time) / self.width
        return jnp.sum(self.amplitude * jnp.exp(-0.5 * z * z), axis=-1)


@pytree
class Scenario(Pytree):
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


def delay_steps(delay: float, dt: float = DT, mode: str = "posvel") -> np.ndarray:
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


# Random pulses of the benchmark: (joints, pulses on each), the least distance in s between any
# two centres and from the start, ranges of the standard deviation in s and the amplitude in N m.
PULSES, DISTANCE, WIDTH, AMPLITUDE = (2, 3), 1.0, (0.05, 0.1), (0.5, 5.0)


def random_pulses(key: jax.Array, *, duration: float = DURATION) -> Pulses:
    """Three pulses on each joint, as random as in the RealAIGym robustness benchmark.

    ``key`` is consumed, ``duration`` (s) is that of the run. Raises ``JaxpendError`` if the pulses
    do not fit into it.
    """
    n = math.prod(PULSES)
    slack = (duration - (n + 1) * DISTANCE) / n
    if slack < 0:
        raise JaxpendError(f"{n} pulses {DISTANCE} s apart do not fit into {duration} s")
    wait_key, joint_key, width_key, amplitude_key = jax.random.split(key, 4)
    centres = jnp.cumsum(DISTANCE + slack * jax.random.uniform(wait_key, (n,)))
    span = AMPLITUDE[1] - AMPLITUDE[0]
    offset = jax.random.uniform(amplitude_key, PULSES, minval=-span, maxval=span)
    return Pulses(
        time=jax.random.permutation(joint_key, centres).reshape(PULSES),
        width=jax.random.uniform(width_key, PULSES, minval=WIDTH[0], maxval=WIDTH[1]),
        amplitude=offset + AMPLITUDE[0] * jnp.sign(offset),
    )


def check_values(scenario: Scenario) -> None:
    """Refuse numbers that mean nothing; one scenario or a batch. Traced values are not looked at.

    Raises:
        JaxpendError: a negative noise, delay, responsiveness, width or torque limit, or a value
            that is not finite (torque limits may be infinite).
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(scenario)):
        return
    names = ("measurement_noise", "delay", "process_noise", "torque_noise", "responsiveness")
    scales = {name: getattr(scenario, name) for name in names}
    scales["torque_limit"] = scenario.plant.torque_limit
    scales["pulse width"] = None if scenario.pulses is None else scenario.pulses.width
    for name, value in scales.items():
        if value is not None and np.any(np.asarray(value) < 0):
            raise JaxpendError(f"{name} is {np.min(value)}; it must not be negative")
    for path, value in jax.tree_util.tree_leaves_with_path(scenario):
        name = jax.tree_util.keystr(path, simple=True, separator=" ")
        bad = np.isnan(value) if name == "plant torque_limit" else ~np.isfinite(value)
        if np.any(bad):
            raise JaxpendError(f"{name} holds a value that is not finite")
