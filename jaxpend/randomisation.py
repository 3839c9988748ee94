"""Random scenarios: one imperfection at a time, spread as in the robustness benchmark.

The distributions are the benchmark's, not its grid points: the criterion is drawn first, then,
uniformly within the range of its grid, how bad it is. All of it is traced, so a batch of
scenarios is ``jax.vmap(sample)``, and training can draw new ones inside a jitted function.
"""

import jax
import jax.numpy as jnp
import numpy as np

from .plant import Plant
from .scenario import Pulses, Scenario, random_pulses

__all__ = ["LONGEST_DELAY", "sample"]

LONGEST_DELAY = 20  # steps of 0.002 s
# Ranges of the grids of jaxpend.robustness.
_SPREAD = 0.25  # relative, of inertial parameters
_DAMPING, _FRICTION, _MOTOR_INERTIA = 0.1, 0.2, 1e-4
_VELOCITY_NOISE, _TORQUE_NOISE, _RESPONSE = 0.5, 1.1, (0.1, 2.0)


def _vary_plant(plant: Plant, which: jax.Array, amount: jax.Array) -> Plant:
    """The plant with parameter ``which`` of ten (none if negative) off by ``amount`` in [-1, 1]."""

    def off(number, joint):
        return jnp.where(which == number, amount, 0.0) * (np.arange(2) == joint)

    return plant.replace(
        motor_inertia=plant.motor_inertia
        + jnp.where(which == 0, _MOTOR_INERTIA * (amount + 1) / 2, 0.0),
        com=plant.com * (1 + _SPREAD * (off(1, 0) + off(5, 1))),
        inertia=plant.inertia * (1 + _SPREAD * (off(2, 0) + off(7, 1))),
        damping=plant.damping + _DAMPING * (off(3, 0) + off(8, 1)),
        coulomb_friction=plant.coulomb_friction + _FRICTION * (off(4, 0) + off(9, 1)),
        mass=plant.mass * (1 + _SPREAD * off(6, 1)),
    )


def sample(plant: Plant, key: jax.Array, share: float = 1.0) -> Scenario:
    """A scenario with one random imperfection; ``key`` is consumed.

    A sixth each: a model parameter, velocity noise, torque noise, torque response, delay,
    disturbance pulses. ``plant`` is the nominal one; all but a ``share`` of the scenarios are
    nominal too.
    """
    key_kind, key_which, key_amount, key_pulses, key_share = jax.random.split(key, 5)
    kind = jax.random.randint(key_kind, (), 0, 6)
    kind = jnp.where(jax.random.uniform(key_share) < share, kind, -1)
    which = jnp.where(kind == 0, jax.random.randint(key_which, (), 0, 10), -1)
    amount = jax.random.uniform(key_amount, minval=-1.0, maxval=1.0)
    share = (amount + 1) / 2  # the same draw on [0, 1]
    slow, fast = _RESPONSE
    pulses: Pulses = random_pulses(key_pulses)
    delay = jnp.where(kind == 4, jnp.round(share * LONGEST_DELAY), 0).astype(jnp.int32)
    noise = jnp.where(kind == 1, _VELOCITY_NOISE * share, 0.0)
    torque_noise = jnp.where(kind == 2, _TORQUE_NOISE * share, 0.0)
    return Scenario(
        _vary_plant(plant, which, amount),
        measurement_noise=noise * jnp.array([0.0, 0.0, 1.0, 1.0]),
        torque_noise=torque_noise * (plant.torque_limit > 0),
        responsiveness=jnp.where(kind == 3, slow + (fast - slow) * share, 1.0),
        delay=jnp.full(4, delay),
        pulses=pulses.replace(amplitude=jnp.where(kind == 5, pulses.amplitude, 0.0)),
    )
