"""A real robot: everything is a little wrong at once, from one robot to the next.

A ``Spread`` says how far the parameters of a robot may be from those that were identified, and
what its sensors and motor are like; ``PRESETS`` holds some. ``draw`` makes a scenario of it: one
robot, which is the same for a whole run.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

from .errors import JaxpendError
from .plant import Plant
from .scenario import DT, DURATION, Compensation, Encoder, Scenario, random_pulses

__all__ = ["LONGEST", "PRESETS", "Spread", "draw"]


LONGEST = 0.06  # s, of a delay: what a rollout's buffer of past states holds by default


@dataclasses.dataclass(frozen=True)
class Spread:
    """How robots of one design differ; hashable. Uniform, where nothing else is said."""

    inertial: float = 0.1  # share by which masses, centres, lengths and inertias are off
    friction: float = 0.5  # the same of damping, Coulomb friction and motor inertia
    encoder: float = 2 * math.pi / 4096  # rad, a step of the measured angles
    filtered: float = 0.008  # s, time constant of the velocities, which are differences of angles
    angle_noise: float = 0.0  # rad, largest standard deviation
    velocity_noise: float = 0.1  # rad/s, largest standard deviation
    delay: float = 0.01  # s, longest, of measurements
    jitter: float = 0.004  # s, longest, by which any measurement comes later still
    torque_noise: float = 0.05  # N m, largest standard deviation
    response: float = 0.8  # least share of a change of the torque that a step makes; 1: all
    push: tuple[float, float] = (0.5, 3.0)  # N m, of a disturbance pulse, where there are pushes
    pushes: int = 2  # on each joint in a run
    # N m, up to which a motor in the passive joint takes off the friction that is believed.
    compensation: float = 0.0

    def __post_init__(self) -> None:
        most_of = {"inertial": 1.0, "friction": 1.0, "response": 1.0, "delay": LONGEST}
        most_of["jitter"] = round(LONGEST - self.delay, 9)
        for name, most in most_of.items():
            if not 0 <= getattr(self, name) <= most:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be in 0 to {most:g}")
        if not self.inertial < 1:
            raise JaxpendError("inertial is 1; a robot without mass is none")
        for name in ("encoder", "filtered", "angle_noise", "velocity_noise", "torque_noise",
                     "compensation"):  # fmt: skip
            if not 0 <= getattr(self, name) < math.inf:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must not be negative")
        low, high = self.push
        if not 0 <= low <= high < math.inf:
            raise JaxpendError(f"push is {self.push}; it must be a range of N m, from 0 on")
        if self.pushes != int(self.pushes) or self.pushes < 0:
            raise JaxpendError(f"pushes is {self.pushes}; it must be a whole number, from 0 on")


# "identified": as well as a robot is known after identification. "wide": as one that is not.
# "compensated": as identified, with the friction compensation that the boards allow.
# "authors": up to the worst that the noisy training of Evolutionary SAC drew (arXiv 2409.08938):
# noise of 0.02, a delay of 0.06 s, a response of 0.85, pulses of 0.4 to 0.6 N m.
PRESETS = {
    "identified": Spread(),
    "wide": Spread(inertial=0.25, friction=1.0),
    "compensated": Spread(compensation=0.5),
    "authors": Spread(
        inertial=0.0, friction=0.0, encoder=0.0, filtered=0.0, angle_noise=0.02,
        velocity_noise=0.02, delay=0.06, jitter=0.0, torque_noise=0.0, response=0.85,
        push=(0.4, 0.6),
    ),
}  # fmt: skip


def draw(
    spread: Spread,
    plant: Plant,
    key: jax.Array,
    *,
    pushed: Any,
    duration: float,
    dt: float = DT,
) -> Scenario:
    """A robot with its sensors and motor; ``key`` is consumed, ``pushed`` is a bool (), traced.

    Pushes end 2 s before the end of a run of ``duration`` s, so that it can stand after them; one
    shorter than 10 s has them, and that time, as much closer. Delays are in steps of ``dt`` s.
    """
    key_plant, key_rest, key_pulses = jax.random.split(key, 3)
    parts = jax.random.uniform(key_plant, (6, 2), minval=-1.0, maxval=1.0)
    mass, com, length, inertia, damping, coulomb = parts
    rest = jax.random.uniform(key_rest, (7,))
    friction = jnp.zeros(2) if plant.coulomb_friction is None else plant.coulomb_friction
    motor = 1 + spread.friction * (2 * rest[0] - 1)
    # Of the inertia, that about the centre of mass is off, and never negative: no body's is. That
    # of some identified models is.
    about_com = jnp.maximum(plant.inertia - plant.mass * plant.com**2, 0.0)
    new_mass = plant.mass * (1 + spread.inertial * mass)
    new_com = plant.com * (1 + spread.inertial * com)
    robot = plant.replace(
        mass=new_mass,
        com=new_com,
        length=plant.length * (1 + spread.inertial * length),
        inertia=new_mass * new_com**2 + about_com * (1 + spread.inertial * inertia),
        damping=plant.damping * (1 + spread.friction * damping),
        coulomb_friction=friction * (1 + spread.friction * coulomb),
        motor_inertia=plant.motor_inertia * motor,
        actuation=jnp.ones(2),  # pushes move the passive joint too; its torque limit stays 0
    )
    angle, speed = spread.angle_noise * rest[1], spread.velocity_noise * rest[2]
    share = min(1.0, duration / DURATION)
    pulses = random_pulses(
        key_pulses,
        duration=duration - 2.0 * share,
        per_joint=spread.pushes,
        distance=share,
        amplitude=spread.push,
    )
    encoder = compensation = None
    if spread.compensation:
        limit = jnp.where(plant.torque_limit > 0, 0.0, spread.compensation)
        compensation = Compensation(plant, limit)
    if spread.encoder:
        encoder = Encoder(jnp.full(2, spread.encoder), jnp.asarray(spread.filtered))
    return Scenario(
        robot,
        measurement_noise=jnp.stack([angle, angle, speed, speed]),
        delay=jnp.full(4, jnp.round(spread.delay / dt * rest[3]).astype(jnp.int32)),
        delay_jitter=jnp.round(spread.jitter / dt * rest[6]).astype(jnp.int32),
        torque_noise=spread.torque_noise * rest[4] * (plant.torque_limit > 0),
        responsiveness=spread.response + (1 - spread.response) * rest[5],
        pulses=pulses.replace(amplitude=jnp.where(pushed, pulses.amplitude, 0.0)),
        encoder=encoder,
        compensation=compensation,
    )
