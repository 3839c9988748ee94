"""An observer and a rescue around a controller, for plants and sensors that are not nominal.

An extended state observer (Han, "From PID to active disturbance rejection control", 2009) estimates
state and disturbance from the measured *angles* and the applied torque, so that neither noise nor
delay of the velocity measurement reaches the controller:

    x-  = f(x, u) + (d dt^2 / 2, d dt),   e = q - q-,   x = x- + (l1 e, l2 e),   d = d + l3 e

with ``f`` one integration step of the nominal plant and ``d`` (rad/s^2) the acceleration that it
does not explain. All three poles of the linear error lie at the bandwidth. On the nominal plant
the estimate is exact but for rounding.

A swing-up that has failed is left to a rescue: a controller for which time does not matter, such
as energy shaping with LQR at the top. It takes over when the top is not reached in time, or when
there is more energy than a swing-up needs: a motor that goes on pushing would then spin the arm
faster than it can be stopped. It keeps control until the end of the run.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Controller, check_controller, check_robot
from ..designs import competition
from ..errors import JaxpendError
from ..plant import UPRIGHT, Plant, deviation, rk4_step, total_energy
from ..pytree import Pytree, pytree, static
from ..scenario import DT
from ..stepping import Startable
from .energy import energy_shaping
from .hybrid import with_lqr
from .search_space import FACTOR

__all__ = ["Guarded", "Observer", "Rescue", "guard", "observer"]

# How far LQR is trusted when it ends a rescue: ``fraction`` and ``hysteresis`` of its ellipsoid.
# Chosen on random scenarios by experiments/guard.py, as is all below.
REGION = {
    "acrobot": {"fraction": 3.0, "hysteresis": 4.0},
    "pendubot": {"fraction": 2.0, "hysteresis": 1.5},
}
# J, of the energy that a rescue aims at (``EnergyShaping``), for a plant that is heavier than the
# model or has friction; the acrobot is better off without.
SURPLUS = {"acrobot": None, "pendubot": 0.7}


@pytree
class Observer(Pytree):
    """Estimates the state from measured angles; its memory is (started, x, d, torque)."""

    plant: Plant  # the model; its torque limit clips what was asked for
    gain: jax.Array  # (3,) l1, l2 (1/s), l3 (1/s^2)
    dt: float = static(default=DT)  # s, between calls

    def reset(self):
        """Memory before the first measurement."""
        return jnp.array(False), jnp.zeros(4), jnp.zeros(2), jnp.zeros(2)

    def __call__(self, memory, measured: jax.Array):
        """New memory and estimated state (4,), at first the measured one, of a measurement (4,)."""
        started, x, d, torque = memory
        ahead = rk4_step(self.plant, x, torque, self.dt)
        ahead = ahead + jnp.concatenate([0.5 * self.dt**2 * d, self.dt * d])
        error = measured[:2] - ahead[:2]
        estimate = ahead + jnp.concatenate([self.gain[0] * error, self.gain[1] * error])
        estimate = jnp.where(started, estimate, measured).astype(x.dtype)
        d = jnp.where(started, d + self.gain[2] * error, d).astype(d.dtype)
        return (jnp.array(True), estimate, d, torque), estimate

    def applied(self, memory, torque: jax.Array):
        """Memory that knows the torque (2,), N m, asked for since the last estimate."""
        limit = self.plant.torque_limit
        return (*memory[:3], jnp.clip(torque, -limit, limit).astype(memory[3].dtype))


def observer(plant: Plant, bandwidth: float, *, dt: float = DT) -> Observer:
    """The observer of a plant with all error poles at ``bandwidth`` (rad/s), called every ``dt`` s.

    Raises ``JaxpendError`` if bandwidth or dt is not positive.
    """
    if not (bandwidth > 0 and dt > 0):
        raise JaxpendError(f"bandwidth = {bandwidth} rad/s and dt = {dt} s must be positive")
    # Ackermann's formula for the triple integrator whose error is corrected after predicting.
    a = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
    seen = np.vstack([a[0] @ np.linalg.matrix_power(a, k) for k in range(3)])
    wanted = np.linalg.matrix_power(a - np.exp(-bandwidth * dt) * np.eye(3), 3)
    gain = wanted @ np.linalg.solve(seen, np.array([0.0, 0.0, 1.0]))
    return Observer(plant, jnp.asarray(gain), dt)


@pytree
class Rescue(Pytree):
    """When the main controller counts as failed, and who takes over."""

    SEARCHED: ClassVar = {"after": FACTOR, "radius": FACTOR, "excess": FACTOR}
    controller: Any
    after: jax.Array  # () s, before that it is still swinging up
    radius: jax.Array  # () rad, of either angle around upright
    excess: jax.Array | None = None  # () J, more energy than at upright; None: not looked at
    plant: Plant | None = None  # the model, for the energy

    def failed(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """Whether a swing-up that works would not be in state ``x`` (4,) at time ``t`` (s)."""
        upright = jnp.array(UPRIGHT, x.dtype)
        away = jnp.max(jnp.abs(deviation(x, upright)[:2])) > self.radius
        failed = (t > self.after) & away
        if self.excess is None or self.plant is None:
            return failed
        surplus = total_energy(self.plant, x) - total_energy(self.plant, upright)
        return failed | (surplus > self.excess)


@pytree
class Guarded(Startable):
    """``main`` behind an observer, before a rescue; either may be None."""

    main: Any
    observer: Observer | None = None
    rescue: Rescue | None = None

    def reset(self, key: jax.Array):
        """Memories of the observer, of both controllers, and that nothing has failed."""
        first, second = jax.random.split(key)
        seen = None if self.observer is None else self.observer.reset()
        lost = None
        if self.rescue is not None:
            lost = jnp.array(False), self.rescue.controller.reset(second)
        return seen, lost, self.main.reset(first)

    def __call__(self, carry, t, x):
        """Memory and torque (2,), N m."""
        seen, lost, memory = carry
        if self.observer is not None:
            seen, x = self.observer(seen, x)
        memory, torque = self.main(memory, t, x)
        if self.rescue is not None:
            failed, rescue_memory = lost
            failed = failed | self.rescue.failed(t, x)
            rescue_memory, rescuing = self.rescue.controller(rescue_memory, t, x)
            torque, lost = jnp.where(failed, rescuing, torque), (failed, rescue_memory)
        if self.observer is not None:
            seen = self.observer.applied(seen, torque)
        return (seen, lost, memory), torque


def guard(
    main: Controller,
    robot: str,
    plant: Plant | None = None,
    *,
    bandwidth: float = 800.0,
    rescue: bool = True,
    after: float = 2.0,
    radius: float = 0.3,
    excess: float = 1.2,
) -> Controller:
    """A controller guarded by a model of the plant.

    Args:
        main: the controller; without observer and rescue it is returned as it is.
        robot: "acrobot" or "pendubot".
        plant: the model, concrete arrays; None: the competition's, ``designs.competition``.
        bandwidth: rad/s, of the observer; 0 leaves it out. Less where angles are noisy.
        rescue: whether energy shaping and LQR take over a swing-up that failed.
        after: s, the time that a swing-up may take.
        radius: rad, of either angle around upright; beyond it a swing-up has failed.
        excess: J; with more than that above the energy of upright it has failed at any time.

    Raises:
        JaxpendError: an unknown robot, no controller or one of the other robot, or a value out
            of range.
    """
    check_controller(main)
    check_robot(main, robot)
    plant = jax.tree.map(jnp.asarray, competition(robot) if plant is None else plant)
    if not (after > 0 and radius > 0 and excess > 0):
        raise JaxpendError(
            f"after = {after} s, radius = {radius} rad and excess = {excess} J must be positive"
        )
    seeing = observer(plant, bandwidth) if bandwidth else None
    rescuing = None
    if rescue:
        pumping = energy_shaping(plant, robot, surplus=SURPLUS[robot])
        swingup = with_lqr(pumping, plant, robot, **REGION[robot])
        limits = [jnp.asarray(limit) for limit in (after, radius, excess)]
        rescuing = Rescue(swingup, limits[0], limits[1], limits[2], plant)
    if seeing is None and rescuing is None:
        return main
    return Guarded(main, seeing, rescuing)
