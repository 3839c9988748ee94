"""An observer and a rescue around a controller, for plants and sensors that are not nominal.

The observer is a Kalman filter (Kalman, 1960) on the nominal model. Beside the state it estimates
the acceleration ``d`` that the model does not explain, which it takes for a random walk, and each
joint has a filter of its own for (angle, velocity, d):

    x-  = f(x, u) + (d dt^2 / 2, d dt),   e = z - x-,   x = x- + K e,   d = d + k e

with ``f`` one integration step, ``z`` the measured state and gains K, k of the filter. How noisy
angles and velocities are is not known before, and it is estimated from what is measured: noise
changes the innovation ``e`` from call to call, a wrong model or a delay moves it slowly, so that
half the mean square of its change is the variance of the noise (compare Mehra, "Approaches to
adaptive filtering", 1972). Velocities that are noisy are then hardly looked at, and neither are
angles; where only one of them is noisy the other one leads. On the nominal plant the estimate is
exact but for rounding.

A swing-up that has failed is left to a rescue: a controller for which time does not matter, such
as energy shaping with LQR at the top. It takes over when the top is not reached in time, or when
there is more energy than a swing-up needs: a motor that goes on pushing would then spin the arm
faster than it can be stopped. It keeps control until the end of the run.
"""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from ..controller import Controller, check_controller, check_robot
from ..criteria import upright
from ..designs import competition
from ..errors import JaxpendError
from ..plant import UPRIGHT, Plant, deviation, rk4_step, total_energy
from ..pytree import Pytree, pytree, static
from ..rollout import rollout
from ..scenario import DT
from ..stepping import Startable
from .energy import energy_shaping
from .hybrid import with_lqr
from .search_space import FACTOR

__all__ = ["Guarded", "KalmanFilter", "Observer", "Rescue", "guard", "observer"]

# How far LQR is trusted when it ends a rescue: ``fraction`` and ``hysteresis`` of its ellipsoid.
# Chosen on random scenarios by experiments/guard.py, as is all below.
REGION = {
    "acrobot": {"fraction": 3.0, "hysteresis": 4.0},
    "pendubot": {"fraction": 2.0, "hysteresis": 1.5},
}
# J, of the energy that a rescue aims at (``EnergyShaping``), for a plant that is heavier than the
# model or has friction; the acrobot is better off without.
SURPLUS = {"acrobot": None, "pendubot": 0.7}
MARGIN = 1.1  # of time and energy, beyond what the controller needs on the nominal plant


FORGETTING = 0.1  # s, the time over which noise is averaged


@pytree
class Covariance(Pytree):
    """Of the errors of angle a, velocity v and unexplained acceleration d of both joints."""

    aa: jax.Array  # (2,) rad^2, as all others in SI units
    av: jax.Array
    ad: jax.Array
    vv: jax.Array
    vd: jax.Array
    dd: jax.Array

    def ahead(self, dt: float, wandering: jax.Array) -> "Covariance":
        """One call later: F P F' + Q, F being motion at constant acceleration, Q of d alone."""
        h = 0.5 * dt**2
        # Entries of F P, by row and column.
        aa = self.aa + dt * self.av + h * self.ad
        av = self.av + dt * self.vv + h * self.vd
        ad = self.ad + dt * self.vd + h * self.dd
        vv, vd = self.vv + dt * self.vd, self.vd + dt * self.dd
        dd = self.dd + wandering
        return Covariance(aa + dt * av + h * ad, av + dt * ad, ad, vv + dt * vd, vd, dd)

    def corrected(self, column: tuple, variance: jax.Array, noise: jax.Array):
        """Gains of a measured value and P after it: P - k p', k = p / (variance + noise).

        ``column`` p are the covariances of a, v and d with the value, ``variance`` is its own.
        """
        gain = tuple(entry / (variance + noise) for entry in column)
        (ka, kv, kd), (a, v, d) = gain, column
        after = Covariance(
            self.aa - ka * a, self.av - ka * v, self.ad - ka * d,
            self.vv - kv * v, self.vd - kv * d, self.dd - kd * d,
        )  # fmt: skip
        return gain, after


@pytree
class Seen(Pytree):
    """What a Kalman filter knows; the last axis of (..., 2) is the joint."""

    started: jax.Array  # () bool
    x: jax.Array  # (4,) estimated state
    d: jax.Array  # (2,) rad/s^2, acceleration that the model does not explain
    torque: jax.Array  # (2,) N m, applied since
    covariance: Covariance
    innovation: jax.Array  # (2, 2) the last one, of angles and of velocities
    change: jax.Array  # (2, 2) its mean squared change


@pytree
class KalmanFilter(Pytree):
    """Estimates the state from measurements of unknown noise; its memory is ``Seen``."""

    plant: Plant  # the model; its torque limit clips what was asked for
    least: jax.Array  # (2,) rad and rad/s, the least noise of angles and of velocities
    disturbance: jax.Array  # () rad/s^2 per root second, how fast d wanders
    dt: float = static(default=DT)  # s, between calls

    def called_every(self, dt: float) -> "KalmanFilter":
        """The same for calls every ``dt`` s."""
        return self if dt == self.dt else self.replace(dt=dt)

    def reset(self) -> Seen:
        """Memory before the first measurement."""
        two, four = jnp.zeros((2, 2)), jnp.zeros(4)
        none = four[:2]
        angle, d = none + self.least[0] ** 2, none + FORGETTING * self.disturbance**2
        covariance = Covariance(angle, none, none, none + 1.0, none, d)
        return Seen(jnp.array(False), four, none, none, covariance, two, two)

    def __call__(self, memory: Seen, measured: jax.Array) -> tuple[Seen, jax.Array]:
        """New memory and estimated state (4,), at first the measured one, of a measurement (4,)."""
        dtype, started = memory.x.dtype, memory.started
        ahead = rk4_step(self.plant, memory.x, memory.torque, self.dt)
        ahead = ahead + jnp.concatenate([0.5 * self.dt**2 * memory.d, self.dt * memory.d])
        innovation = (measured - ahead).reshape(2, 2)
        change = (innovation - memory.innovation) ** 2
        change = memory.change + (change - memory.change) * self.dt / FORGETTING
        noise = jnp.maximum(0.5 * change, (self.least**2)[:, None])

        # One measured value after the other, so that nothing is inverted.
        p = memory.covariance.ahead(self.dt, self.disturbance**2 * self.dt)
        first, p = p.corrected((p.aa, p.av, p.ad), p.aa, noise[0])
        second, p = p.corrected((p.av, p.vv, p.vd), p.vv, noise[1])
        left = innovation[1] - first[1] * innovation[0]
        a, v, d = (k * innovation[0] + then * left for k, then in zip(first, second, strict=True))

        estimate = jnp.where(started, ahead + jnp.concatenate([a, v]), measured).astype(dtype)
        true, d, torque = jnp.array(True), memory.d + d, memory.torque
        after = Seen(true, estimate, d, torque, p, innovation, change)
        # The first measurement has nothing that it could be compared with.
        begun = memory.replace(started=true, x=estimate)

        def chosen(new, old):
            return jnp.where(started, new, old).astype(old.dtype)

        return jax.tree.map(chosen, after, begun), estimate

    def applied(self, memory: Seen, torque: jax.Array) -> Seen:
        """Memory that knows the torque (2,), N m, asked for since the last estimate."""
        limit = self.plant.torque_limit
        return memory.replace(torque=jnp.clip(torque, -limit, limit).astype(memory.torque.dtype))


def observer(
    plant: Plant,
    *,
    angle_noise: float = 1e-4,
    velocity_noise: float = 0.2,
    disturbance: float = 300.0,
    dt: float = DT,
) -> KalmanFilter:
    """The observer of a plant, called every ``dt`` s, until a rollout or a loop says how often.

    Args:
        plant: the model.
        angle_noise: rad, standard deviation of measured angles, at least.
        velocity_noise: rad/s, of measured velocities, at least. Velocities that are not noisy may
            still be late, and are not believed more than that.
        disturbance: rad/s^2 per root second, how fast an acceleration changes that the model does
            not explain. More follows a wrong model faster, less averages more noise away.
        dt: s.

    Raises:
        JaxpendError: a value that is not positive and finite.
    """
    values = {"angle_noise": (angle_noise, "rad"), "velocity_noise": (velocity_noise, "rad/s")}
    values |= {"disturbance": (disturbance, "rad/s^2"), "dt": (dt, "s")}
    for name, (value, unit) in values.items():
        if not (math.isfinite(value) and value > 0):
            raise JaxpendError(f"{name} is {value} {unit}; it must be positive and finite")
    least = jnp.asarray([angle_noise, velocity_noise])
    return KalmanFilter(plant, least, jnp.asarray(disturbance, least.dtype), dt)


@pytree
class Observer(Pytree):
    """The observer of policy files of version 0.2, which believes measured angles alone.

    An extended state observer (Han, "From PID to active disturbance rejection control", 2009);
    its memory is (started, x, d, torque), its methods are those of ``KalmanFilter``.
    """

    plant: Plant
    gain: jax.Array  # (3,) l1, l2 (1/s), l3 (1/s^2)
    dt: float = static(default=DT)  # s, between calls

    def called_every(self, dt: float) -> "Observer":
        """For calls every ``dt`` s, of which each corrects as much as it does now."""
        if dt == self.dt:
            return self
        shorter = self.dt / dt
        return self.replace(dt=dt, gain=self.gain * shorter ** jnp.arange(3))

    def reset(self):
        return jnp.array(False), jnp.zeros(4), jnp.zeros(2), jnp.zeros(2)

    def __call__(self, memory, measured: jax.Array):
        started, x, d, torque = memory
        ahead = rk4_step(self.plant, x, torque, self.dt)
        ahead = ahead + jnp.concatenate([0.5 * self.dt**2 * d, self.dt * d])
        error = measured[:2] - ahead[:2]
        estimate = ahead + jnp.concatenate([self.gain[0] * error, self.gain[1] * error])
        estimate = jnp.where(started, estimate, measured).astype(x.dtype)
        d = jnp.where(started, d + self.gain[2] * error, d).astype(d.dtype)
        return (jnp.array(True), estimate, d, torque), estimate

    def applied(self, memory, torque: jax.Array):
        limit = self.plant.torque_limit
        return (*memory[:3], jnp.clip(torque, -limit, limit).astype(memory[3].dtype))


def energy_above_upright(plant: Plant, x: jax.Array) -> jax.Array:
    """Energy () of state ``x`` (4,), J, beyond that of standing upright."""
    return total_energy(plant, x) - total_energy(plant, jnp.array(UPRIGHT, x.dtype))


@pytree
class Rescue(Pytree):
    """When the main controller counts as failed, and who takes over."""

    SEARCHED: ClassVar = {"after": FACTOR, "radius": FACTOR, "excess": FACTOR}
    controller: Any
    after: jax.Array  # () s, before that it is still swinging up
    radius: jax.Array  # () rad, of either angle around upright
    excess: jax.Array | None = None  # () J, more energy than at upright; None: not looked at
    plant: Plant | None = None  # the model, for the energy

    def away(self, x: jax.Array) -> jax.Array:
        """Whether an angle of state ``x`` (4,) is not within ``radius`` of upright."""
        return jnp.max(jnp.abs(deviation(x, jnp.array(UPRIGHT, x.dtype))[:2])) > self.radius

    def failed(self, t: jax.Array, x: jax.Array) -> jax.Array:
        """Whether a swing-up that works would not be in state ``x`` (4,) at time ``t`` (s)."""
        failed = (t > self.after) & self.away(x)
        if self.excess is None or self.plant is None:
            return failed
        return failed | (energy_above_upright(self.plant, x) > self.excess)


@pytree
class Guarded(Startable):
    """``main`` behind an observer, before a rescue; either may be None."""

    main: Any
    observer: KalmanFilter | Observer | None = None
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


def _patient(main: Controller, plant: Plant, rescue: Rescue) -> Rescue:
    """A rescue that waits longer, or for more energy, if ``main`` needs that on the nominal plant.

    A swing-up that works is not interrupted, however slow it is.
    """
    after, excess = _needed(main, plant, rescue)
    return rescue.replace(after=after, excess=excess)


@jax.jit
def _needed(main: Controller, plant: Plant, rescue: Rescue) -> tuple[jax.Array, jax.Array]:
    """``after`` and ``excess`` of a rescue, or more if a run on the nominal plant stands so."""
    x = rollout(plant, main, jax.random.key(0)).x
    late = DT * jnp.max(jnp.where(jax.vmap(rescue.away)(x), jnp.arange(len(x)), 0))
    most = jax.vmap(energy_above_upright, (None, 0))(plant, x).max()

    def more(limit: jax.Array, needed: jax.Array) -> jax.Array:
        grown = jnp.maximum(limit, MARGIN * needed).astype(limit.dtype)
        return jnp.where(upright(x[-1]), grown, limit)

    assert rescue.excess is not None
    return more(rescue.after, late), more(rescue.excess, most)


def guard(
    main: Controller,
    robot: str,
    plant: Plant | None = None,
    *,
    observe: bool = True,
    angle_noise: float = 1e-4,
    velocity_noise: float = 0.2,
    rescue: bool = True,
    after: float = 2.0,
    radius: float = 0.3,
    excess: float = 1.2,
) -> Controller:
    """A controller guarded by a model of the plant.

    Args:
        main: the controller, concrete arrays; without observer and rescue it is returned as it is.
        robot: "acrobot" or "pendubot".
        plant: the model, concrete arrays; None: the competition's, ``designs.competition``.
        observe: whether the controller sees the estimate of ``observer`` and not what is measured.
        angle_noise: rad, see ``observer``.
        velocity_noise: rad/s, see ``observer``.
        rescue: whether energy shaping and LQR take over a swing-up that failed.
        after: s, the time that a swing-up may take; longer where ``main`` takes longer and stands.
        radius: rad, of either angle around upright; beyond it a swing-up has failed.
        excess: J; with more than that above the energy of upright it has failed at any time, or
            with more than ``main`` needs on the nominal plant.

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
    noise = {"angle_noise": angle_noise, "velocity_noise": velocity_noise}
    seeing = observer(plant, **noise) if observe else None
    rescuing = None
    if rescue:
        pumping = energy_shaping(plant, robot, surplus=SURPLUS[robot])
        swingup = with_lqr(pumping, plant, robot, **REGION[robot])
        limits = [jnp.asarray(limit) for limit in (after, radius, excess)]
        rescuing = Rescue(swingup, limits[0], limits[1], limits[2], plant)
        rescuing = _patient(main, plant, rescuing)
    if seeing is None and rescuing is None:
        return main
    return Guarded(main, seeing, rescuing)
