"""A scenario: a plant, where it starts, and everything that goes wrong around it.

An imperfection that is ``None`` is left out of the compiled program, so the nominal scenario
costs nothing; one that is an array may differ per rollout under ``jax.vmap``.
"""

from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .errors import JaxpendError, choose
from .fields import Natural, NotNegative, Positive, checked
from .plant import Plant, friction_vector
from .pytree import Pytree, check_constant, pytree
from .resets import Resets

__all__ = [
    "DT", "DURATION", "NEUTRAL", "Compensation", "Encoder", "Pulses", "Scenario", "check_values",
    "delay_steps", "random_pulses", "with_neutral",
]  # fmt: skip

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
class Encoder(Pytree):
    """Angles in steps, and velocities as their differences, through a filter of first order."""

    step: jax.Array  # (2,) rad
    filtered: jax.Array  # () s, time constant of the filter; 0: the differences themselves


@pytree
class Compensation(Pytree):
    """Friction that motors take off by themselves, as the measured velocities say.

    The controller does not know of it, and its torque limit is apart from this one.
    """

    plant: Plant  # that is believed: its friction is taken off
    limit: jax.Array  # (2,) N m; 0: a joint without

    def torque(self, x: jax.Array) -> jax.Array:
        """What is added to the torques at a measured state (4,): (2,) N m."""
        return jnp.clip(friction_vector(self.plant, x), -self.limit, self.limit)


@pytree
class Scenario(Pytree):
    """What a controller is put into. Only ``plant`` is required; the rest defaults to nominal."""

    plant: Plant
    x0: jax.Array | None = None  # (4,) initial state; None: hanging at rest
    measurement_noise: jax.Array | None = None  # (4,) standard deviation, rad and rad/s
    delay: jax.Array | None = None  # (4,) int, steps by which each measured component lags
    delay_jitter: jax.Array | None = None  # () int, steps by which any measurement lags more
    process_noise: jax.Array | None = None  # (4,) standard deviation added after each step
    torque_noise: jax.Array | None = None  # (2,) N m, standard deviation
    responsiveness: jax.Array | None = None  # () fraction of the commanded change made per step
    pulses: Pulses | None = None
    compensation: Compensation | None = None
    encoder: Encoder | None = None  # what measures the angles; None: angles and velocities are
    resets: Resets | None = None  # by hand, in which the controller is not called

    @property
    def longest_delay(self) -> int:
        """Steps by which a measurement of it, or of a batch, lags at most; 0 of traced values."""
        parts = (self.delay, self.delay_jitter)
        known = [p for p in parts if p is not None and not isinstance(p, jax.core.Tracer)]
        return sum(int(np.max(part)) for part in known)

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


def random_pulses(
    key: jax.Array,
    *,
    duration: float = DURATION,
    per_joint: int = 3,
    distance: float = 1.0,
    width: tuple[float, float] = (0.05, 0.1),
    amplitude: tuple[float, float] = (0.5, 5.0),
) -> Pulses:
    """Random disturbance pulses, distributed as in the RealAIGym robustness benchmark.

    Args:
        key: consumed.
        duration: s, of the run.
        per_joint: pulses on each joint.
        distance: s, the least one between any two centres, and from the start.
        width: s, range of the (uniform) standard deviations.
        amplitude: N m, range of the (uniform) amplitudes; the sign is a coin's.

    Raises:
        JaxpendError: a value out of range, or more pulses than fit into the duration.
    """
    n = 2 * checked(Natural, per_joint, "per_joint")
    check_constant(tuple[Positive, Positive], width, "width")
    check_constant(tuple[NotNegative, NotNegative], amplitude, "amplitude")
    check_constant(NotNegative, distance, "distance")
    slack = (duration - (n + 1) * distance) / max(n, 1)
    if n and not slack >= 0:
        raise JaxpendError(f"{n} pulses {distance} s apart do not fit into {duration} s")
    wait_key, joint_key, width_key, amplitude_key = jax.random.split(key, 4)
    centres = jnp.cumsum(distance + slack * jax.random.uniform(wait_key, (n,)))
    shape = (2, per_joint)
    span = amplitude[1] - amplitude[0]
    offset = jax.random.uniform(amplitude_key, shape, minval=-span, maxval=span)
    return Pulses(
        time=jax.random.permutation(joint_key, centres).reshape(shape),
        width=jax.random.uniform(width_key, shape, minval=width[0], maxval=width[1]),
        amplitude=offset + amplitude[0] * jnp.sign(offset),
    )


# What an imperfection of the benchmarks that is there has no effect with.
NEUTRAL: dict[str, Any] = {
    "delay": np.zeros(4, "i4"),
    "delay_jitter": np.zeros((), "i4"),
    "responsiveness": np.ones(()),
    "measurement_noise": np.zeros(4),
    "torque_noise": np.zeros(2),
    "process_noise": np.zeros(4),
    "pulses": Pulses(np.zeros((2, 3)), np.ones((2, 3)), np.zeros((2, 3))),  # type: ignore[arg-type]
}


def with_neutral(scenario: Scenario, fields: Collection[str]) -> Scenario:
    """The scenario with its neutral value in each of the fields that is ``None``.

    "coulomb_friction" is that of the plant; names of other things than imperfections are ignored.
    """
    plant, dtype = scenario.plant, scenario.dtype

    def cast(leaf):
        return leaf.astype(dtype) if leaf.dtype.kind == "f" else leaf

    absent = [name for name in NEUTRAL if name in fields and getattr(scenario, name) is None]
    scenario = scenario.replace(**{n: jax.tree.map(cast, NEUTRAL[n]) for n in absent})
    if "coulomb_friction" in fields and plant.coulomb_friction is None:
        scenario = scenario.replace(plant=plant.replace(coulomb_friction=np.zeros(2, dtype)))
    return scenario


def check_values(scenario: Scenario) -> None:
    """Refuse numbers that mean nothing; one scenario or a batch. Traced values are not looked at.

    Raises:
        JaxpendError: a negative noise, delay, responsiveness, width, filter or limit, a step of an
            encoder that is not positive, or a value that is not finite (torque limits may be
            infinite).
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(scenario)):
        return
    scales = {name: getattr(scenario, name) for name in NEUTRAL if name != "pulses"}
    scales["torque_limit"] = scenario.plant.torque_limit
    scales["pulse width"] = None if scenario.pulses is None else scenario.pulses.width
    if scenario.compensation is not None:
        scales["limit of the compensation"] = scenario.compensation.limit
    if scenario.encoder is not None:
        scales["filter of the encoder"] = scenario.encoder.filtered
        if not np.all(np.asarray(scenario.encoder.step) > 0):
            step = np.min(scenario.encoder.step)
            raise JaxpendError(f"step of the encoder is {step}; it must be positive")
    for name, value in scales.items():
        if value is not None and np.any(np.asarray(value) < 0):
            raise JaxpendError(f"{name} is {np.min(value)}; it must not be negative")
    for path, value in jax.tree_util.tree_leaves_with_path(scenario):
        name = jax.tree_util.keystr(path, simple=True, separator=" ")
        limit = name.endswith("plant torque_limit")
        bad = np.isnan(value) if limit else ~np.isfinite(value)
        if np.any(bad):
            raise JaxpendError(f"{name} holds a value that is not finite")
