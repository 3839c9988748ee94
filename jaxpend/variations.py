"""Named imperfections: batches of scenarios in which one thing, or several, goes wrong.

``vary(scenario, {"m2": masses, "delay": delays}, key=key)`` is a batch of scenarios, one for
each pair of values. Everything the robustness benchmark, severity curves and maps need is a
call of it with the right values.

``sample(plant, key)`` is a scenario with one random imperfection, spread as in the benchmark: the
distributions are the benchmark's, not its grid points. It is traced, so a batch of them is
``jax.vmap(sample)``, and training can draw new ones inside a jitted function.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .errors import JaxpendError, choose
from .fields import Positive, checked
from .plant import Plant
from .scenario import DT, DURATION, Scenario, delay_steps, random_pulses

__all__ = [
    "INERTIAL", "LONGEST_DELAY", "RANGES", "VARIATIONS", "Variation", "numbers", "sample", "vary",
]  # fmt: skip

# (batch of n scenarios in numpy arrays, n values, n keys) -> batch of scenarios
Apply = Callable[[Scenario, np.ndarray, jax.Array], Scenario]


@dataclasses.dataclass(frozen=True)
class Variation:
    """One thing that can be wrong, and how."""

    apply: Apply
    field: str  # of a ``Scenario``, or of its plant, that it changes
    title: str
    unit: str
    least: float = -np.inf  # values below make no sense
    in_steps: bool = False  # seconds that the reference cuts off to whole steps
    draws: bool = False  # whether a run of it depends on a key


def _plant(
    title: str, unit: str, field: str, index: int | None = None, *,
    per: tuple[str, int] | None = None, least: float = -np.inf,
) -> Variation:  # fmt: skip
    """Set an entry of a plant's field to the value, or to the value over another entry."""

    def apply(scenario, values, keys):
        plant = scenario.plant
        if per is not None:
            values = values / getattr(plant, per[0])[:, per[1]]
        old = getattr(plant, field)
        changed = np.zeros((len(values), 2), scenario.dtype) if old is None else np.array(old)
        changed[... if index is None else (slice(None), index)] = values
        return scenario.replace(plant=plant.replace(**{field: changed}))

    return Variation(apply, field, title, unit, least)


def _noise(title: str, unit: str, field: str, entries: list[int]) -> Variation:
    """Set entries of one of the (4,) standard deviations to the value, keeping the others."""

    def apply(scenario, values, keys):
        old = getattr(scenario, field)
        changed = np.zeros((len(values), 4), scenario.dtype) if old is None else np.array(old)
        changed[:, entries] = values[:, None]
        return scenario.replace(**{field: changed})

    return Variation(apply, field, title, unit, 0, draws=True)


def _torque_noise(scenario, values, keys):
    """Noise on the driven joints only, as in the benchmark."""
    sigma = values[:, None] * (scenario.plant.torque_limit > 0)
    return scenario.replace(torque_noise=sigma.astype(scenario.dtype))


def _responsiveness(scenario, values, keys):
    return scenario.replace(responsiveness=values.astype(scenario.dtype))


def _delay(title: str, lagging: list[int]) -> Variation:
    """Let some of the measured components lag by at least so many steps."""

    def apply(scenario, values, keys):
        delay = (values[:, None] * np.array(lagging)).astype("i4")
        if scenario.delay is not None:
            delay = np.maximum(delay, scenario.delay)
        return scenario.replace(delay=delay)

    return Variation(apply, "delay", title, "s", 0, in_steps=True)


_many_pulses = jax.jit(jax.vmap(random_pulses))


def _perturbation(scenario, values, keys):
    """A random series of pulses for each key, its amplitudes times the value."""
    pulses = jax.tree.map(lambda a: np.asarray(a, scenario.dtype), _many_pulses(keys))
    scale = values[:, None, None].astype(scenario.dtype)
    return scenario.replace(pulses=pulses.replace(amplitude=pulses.amplitude * scale))


# The ends of the grids of the v2 boards' robustness benchmark. Those of inertial parameters are
# factors of the nominal value.
INERTIAL = (0.75, 1.25)
RANGES: dict[str, tuple[float, float]] = {
    "Ir": (0.0, 1e-4),
    **dict.fromkeys(("m1r1", "I1", "m2r2", "m2", "I2"), INERTIAL),
    **dict.fromkeys(("b1", "b2"), (-0.1, 0.1)),
    **dict.fromkeys(("cf1", "cf2"), (-0.2, 0.2)),
    "velocity_noise": (0.0, 0.5),
    "torque_noise": (0.0, 1.1),
    "responsiveness": (0.1, 2.0),
    "delay": (0.0, 0.04),
}
LONGEST_DELAY = round(RANGES["delay"][1] / DT)  # steps of ``DT``


VARIATIONS: dict[str, Variation] = {
    "Ir": _plant("motor inertia", "kg m²", "motor_inertia", least=0),
    "m1r1": _plant("m₁ r₁", "kg m", "com", 0, per=("mass", 0)),
    "I1": _plant("I₁", "kg m²", "inertia", 0),
    "b1": _plant("damping 1", "N m s/rad", "damping", 0),
    "cf1": _plant("friction 1", "N m", "coulomb_friction", 0),
    "m2r2": _plant("m₂ r₂", "kg m", "com", 1, per=("mass", 1)),
    "m2": _plant("m₂", "kg", "mass", 1, least=0),
    "I2": _plant("I₂", "kg m²", "inertia", 1),
    "b2": _plant("damping 2", "N m s/rad", "damping", 1),
    "cf2": _plant("friction 2", "N m", "coulomb_friction", 1),
    "m1": _plant("m₁", "kg", "mass", 0, least=0),
    "l1": _plant("l₁", "m", "length", 0, least=0),
    "l2": _plant("l₂", "m", "length", 1, least=0),
    "gravity": _plant("gravity", "m/s²", "gravity"),
    "velocity_noise": _noise("velocity noise", "rad/s", "measurement_noise", [2, 3]),
    "position_noise": _noise("position noise", "rad", "measurement_noise", [0, 1]),
    "process_noise": _noise("process noise", "rad, rad/s", "process_noise", [0, 1, 2, 3]),
    "torque_noise": Variation(_torque_noise, "torque_noise", "torque noise", "N m", 0, draws=True),
    "responsiveness": Variation(_responsiveness, "responsiveness", "torque response", "", 0),
    "delay": _delay("delay", [1, 1, 1, 1]),
    "velocity_delay": _delay("velocity delay", [0, 0, 1, 1]),
    "perturbation": Variation(_perturbation, "pulses", "perturbation strength", "", 0, draws=True),
}


def numbers(name: str, values: Any) -> np.ndarray:
    """Values (n,) of the variation ``name``. Raises ``JaxpendError`` for what makes no sense."""
    kind = VARIATIONS[choose("variation", name, VARIATIONS)]
    try:
        values = np.atleast_1d(np.asarray(values, float))
    except (TypeError, ValueError):
        raise JaxpendError(f"{name} is {values!r}; it must be numbers") from None
    if values.ndim != 1 or not values.size:
        shape = values.shape
        raise JaxpendError(f"{name} has values of shape {shape}; give a list of some numbers")
    for value in values[~(np.isfinite(values) & (values >= kind.least))]:
        rule = f"at least {kind.least:g}" if np.isfinite(value) else "finite"
        raise JaxpendError(f"{name} is {value} {kind.unit}; it must be {rule}".rstrip())
    return values


def vary(
    scenario: Scenario, changes: Mapping[str, Any], *, key: jax.Array, dt: float = DT
) -> Scenario:
    """A batch of n scenarios: the given one, with the i-th value of every change in the i-th.

    Built in numpy: no compilation, and nothing on a device before a rollout wants it.

    Args:
        scenario: what is not changed.
        changes: name in ``VARIATIONS`` to n values, in SI units; applied in this order.
        key: split once per scenario and change, for those that draw something.
        dt: s, for delays, which are cut off to whole steps of it.

    Raises:
        JaxpendError: an unknown name, values of different number, out of range or not finite, or
            a dt that is not positive.
    """
    dt = checked(Positive, dt, "dt")
    values = {name: numbers(name, given) for name, given in changes.items()}
    sizes = {len(v) for v in values.values()}
    if not sizes:
        raise JaxpendError("there are no changes; give at least one imperfection and its values")
    if len(sizes) != 1:
        raise JaxpendError(f"variations need as many values each; got {sorted(sizes)}")

    n = sizes.pop()
    keys = jax.random.split(key, (n, len(values)))
    batch = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (n, *np.shape(leaf))), scenario)
    for number, (name, its_values) in enumerate(values.items()):
        if VARIATIONS[name].in_steps:
            its_values = np.array([delay_steps(value, dt)[0] for value in its_values])
        batch = VARIATIONS[name].apply(batch, its_values, keys[:, number])
    return batch


def _vary_plant(plant: Plant, which: jax.Array, amount: jax.Array) -> Plant:
    """The plant with parameter ``which`` of ten (none if negative) off by ``amount`` in [-1, 1]."""
    (_, motor_inertia), (_, damping), (_, friction) = (RANGES[n] for n in ("Ir", "b1", "cf1"))
    spread = INERTIAL[1] - 1
    coulomb = plant.coulomb_friction
    coulomb = jnp.zeros_like(plant.damping) if coulomb is None else coulomb

    def off(number, joint):
        return jnp.where(which == number, amount, 0.0) * (np.arange(2) == joint)

    heavier_motor = jnp.where(which == 0, motor_inertia * (amount + 1) / 2, 0.0)
    return plant.replace(
        motor_inertia=plant.motor_inertia + heavier_motor,
        com=plant.com * (1 + spread * (off(1, 0) + off(5, 1))),
        inertia=plant.inertia * (1 + spread * (off(2, 0) + off(7, 1))),
        damping=plant.damping + damping * (off(3, 0) + off(8, 1)),
        coulomb_friction=coulomb + friction * (off(4, 0) + off(9, 1)),
        mass=plant.mass * (1 + spread * off(6, 1)),
    )


def sample(
    plant: Plant,
    key: jax.Array,
    share: float = 1.0,
    *,
    dt: float = DT,
    duration: float = DURATION,
) -> Scenario:
    """A scenario with one random imperfection; ``key`` is consumed.

    A sixth each: a model parameter, velocity noise, torque noise, torque response, delay,
    disturbance pulses. ``plant`` is the nominal one; all but a ``share`` of the scenarios are
    nominal too. It is stepped every ``dt`` s, so that a delay is whole steps of that, none longer
    than in the benchmark, for ``duration`` s: in a run shorter than the benchmark's pulses lie
    closer together, by as much.
    """
    key_kind, key_which, key_amount, key_pulses, key_share = jax.random.split(key, 5)
    kind = jax.random.randint(key_kind, (), 0, 6)
    kind = jnp.where(jax.random.uniform(key_share) < share, kind, -1)
    which = jnp.where(kind == 0, jax.random.randint(key_which, (), 0, 10), -1)
    amount = jax.random.uniform(key_amount, minval=-1.0, maxval=1.0)
    part = (amount + 1) / 2  # the same draw on [0, 1]
    slow, fast = RANGES["responsiveness"]
    pulses = random_pulses(key_pulses, duration=duration, distance=min(1.0, duration / DURATION))
    longest = int(delay_steps(RANGES["delay"][1], dt)[0])
    delay = jnp.where(kind == 4, jnp.round(part * longest), 0).astype(jnp.int32)
    noise = jnp.where(kind == 1, RANGES["velocity_noise"][1] * part, 0.0)
    torque_noise = jnp.where(kind == 2, RANGES["torque_noise"][1] * part, 0.0)
    return Scenario(
        _vary_plant(plant, which, amount),
        measurement_noise=noise * jnp.array([0.0, 0.0, 1.0, 1.0]),
        torque_noise=torque_noise * (plant.torque_limit > 0),
        responsiveness=jnp.where(kind == 3, slow + (fast - slow) * part, 1.0),
        delay=jnp.full(4, delay),
        pulses=pulses.replace(amplitude=jnp.where(kind == 5, pulses.amplitude, 0.0)),
    )
