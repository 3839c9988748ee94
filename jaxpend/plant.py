"""The double pendulum: parameters, equations of motion, energies, linearisation, integrators.

State ``x = [theta1, theta2, omega1, omega2]`` (rad, rad/s): ``theta1`` from hanging straight
down, ``theta2`` relative to link 1, both counter-clockwise; upright is ``(pi, 0, 0, 0)``.
Torque ``u = [tau1, tau2]`` (N m).

The equations of motion are

    M(theta) alpha + C(theta, omega) omega + F(omega) = G(theta) + B u

(Spong, "The swing up control problem for the acrobot", 1995, with the reflected motor inertia
and friction terms of Wiebe et al., "Open-source dual-purpose acrobot and pendubot platform",
2023). Every function takes one plant and one state; use ``jax.vmap`` for batches of either.
The 2x2 algebra is written out element by element: XLA fuses it, and no device rounds it as it
rounds matrix products.
"""

import jax
import jax.numpy as jnp
import numpy as np

from .pytree import Pytree, pytree

__all__ = [
    "UPRIGHT", "Plant", "coriolis_matrix", "deviation", "dynamics", "euler_step",
    "forward_kinematics", "friction_vector", "gravity_vector", "kinetic_energy", "linearize",
    "mass_matrix", "potential_energy", "rk4_step", "tip_height", "total_energy",
]  # fmt: skip

UPRIGHT = (np.pi, 0.0, 0.0, 0.0)
# Steepness (s/rad) of the arctan that stands for the sign function in Coulomb friction.
COULOMB_STEEPNESS = 100.0


@pytree
class Plant(Pytree):
    """Physical parameters of a double pendulum, SI units. Index 0 is link/joint 1."""

    mass: jax.Array  # (2,) kg
    length: jax.Array  # (2,) m
    com: jax.Array  # (2,) m, joint to centre of mass
    inertia: jax.Array  # (2,) kg m^2, about the joint
    damping: jax.Array  # (2,) N m s/rad, viscous
    coulomb_friction: jax.Array | None  # (2,) N m; None, or known zeros, leave it out
    torque_limit: jax.Array  # (2,) N m, 0 on a passive joint
    actuation: jax.Array  # (2,) diagonal of the input matrix B
    gravity: jax.Array  # () m/s^2
    motor_inertia: jax.Array  # () kg m^2, of the rotor
    gear_ratio: jax.Array  # ()


def _mass_terms(plant: Plant, theta2: jax.Array):
    """The three distinct entries ``(m11, m12, m22)`` of the mass matrix."""
    m2l1 = plant.mass[1] * plant.length[0]
    coupling = m2l1 * plant.com[1] * jnp.cos(theta2)
    ir, gr = plant.motor_inertia, plant.gear_ratio
    m11 = plant.inertia[0] + plant.inertia[1] + m2l1 * plant.length[0] + 2 * coupling
    m11 = m11 + gr**2 * ir + ir
    m12 = plant.inertia[1] + coupling - gr * ir
    m22 = plant.inertia[1] + gr**2 * ir
    return m11, m12, m22


def mass_matrix(plant: Plant, x: jax.Array) -> jax.Array:
    """Mass matrix ``M(theta)``, shape (2, 2), kg m^2, for a state of shape (4,)."""
    m11, m12, m22 = _mass_terms(plant, x[1])
    return jnp.stack([jnp.stack([m11, m12]), jnp.stack([m12, m22])])


def coriolis_matrix(plant: Plant, x: jax.Array) -> jax.Array:
    """Coriolis and centrifugal matrix ``C(theta, omega)``, shape (2, 2), N m s/rad."""
    h = plant.mass[1] * plant.length[0] * plant.com[1] * jnp.sin(x[1])
    first, second = [-2 * h * x[3], -h * x[3]], [h * x[2], jnp.zeros_like(h)]
    return jnp.stack([jnp.stack(first), jnp.stack(second)])


def gravity_vector(plant: Plant, x: jax.Array) -> jax.Array:
    """Gravity torque ``G(theta)`` on the right-hand side, shape (2,), N m."""
    m, g = plant.mass, plant.gravity
    g2 = -m[1] * g * plant.com[1] * jnp.sin(x[0] + x[1])
    g1 = -(m[0] * plant.com[0] + m[1] * plant.length[0]) * g * jnp.sin(x[0]) + g2
    return jnp.stack([g1, g2])


def _arctan(x: jax.Array) -> jax.Array:
    """``arctan``; in float32 to 1.4e-7 by one division and a short polynomial.

    XLA's own took three quarters of the time of a float32 step on a CPU. The reduction to
    [0, tan(pi/8)] and the coefficients are those of Moshier's Cephes library (``atanf``).
    """
    if jnp.result_type(x) != jnp.float32:
        return jnp.arctan(x)
    a = jnp.abs(x)
    middle, far = a > 0.41421356, a > 2.41421356
    numerator = jnp.where(far, -1.0, jnp.where(middle, a - 1.0, a))
    r = numerator / jnp.where(far, a, jnp.where(middle, a + 1.0, 1.0))
    offset = jnp.where(far, jnp.pi / 2, jnp.where(middle, jnp.pi / 4, 0.0))
    z = r * r
    p = ((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z - 3.33329491539e-1
    y = offset + (p * z * r + r)
    return jnp.where(x < 0, -y, y)


def friction_vector(plant: Plant, x: jax.Array) -> jax.Array:
    """Friction torque ``F(omega) = b omega + c arctan(100 omega)``, shape (2,), N m."""
    viscous, coulomb = plant.damping * x[2:4], plant.coulomb_friction
    known = not isinstance(coulomb, jax.core.Tracer)
    if coulomb is None or (known and not np.asarray(coulomb).any()):
        return viscous  # the arctan is most of the cost of a step
    return viscous + coulomb * _arctan(COULOMB_STEEPNESS * x[2:4])


def dynamics(plant: Plant, x: jax.Array, u: jax.Array) -> jax.Array:
    """Time derivative of the state, ``[omega, alpha]``, shape (4,), for torque ``u`` (2,).

    ``alpha = M^-1 (G + B u - C omega - F)``. The torque is not clipped here.
    """
    m11, m12, m22 = _mass_terms(plant, x[1])
    gravity, friction = gravity_vector(plant, x), friction_vector(plant, x)
    omega1, omega2 = x[2], x[3]
    h = plant.mass[1] * plant.length[0] * plant.com[1] * jnp.sin(x[1])
    f1 = gravity[0] + plant.actuation[0] * u[0] + h * omega2 * (2 * omega1 + omega2) - friction[0]
    f2 = gravity[1] + plant.actuation[1] * u[1] - h * omega1 * omega1 - friction[1]
    det = m11 * m22 - m12 * m12
    alpha1 = (m22 * f1 - m12 * f2) / det
    alpha2 = (m11 * f2 - m12 * f1) / det
    return jnp.stack([omega1, omega2, alpha1, alpha2])


def kinetic_energy(plant: Plant, x: jax.Array) -> jax.Array:
    """Kinetic energy ``omega' M omega / 2``, scalar, J."""
    m11, m12, m22 = _mass_terms(plant, x[1])
    return 0.5 * (m11 * x[2] ** 2 + 2 * m12 * x[2] * x[3] + m22 * x[3] ** 2)


def potential_energy(plant: Plant, x: jax.Array) -> jax.Array:
    """Potential energy, scalar, J, zero at the height of joint 1."""
    y1 = -plant.com[0] * jnp.cos(x[0])
    y2 = -plant.length[0] * jnp.cos(x[0]) - plant.com[1] * jnp.cos(x[0] + x[1])
    return plant.gravity * (plant.mass[0] * y1 + plant.mass[1] * y2)


def total_energy(plant: Plant, x: jax.Array) -> jax.Array:
    """Kinetic plus potential energy, scalar, J."""
    return kinetic_energy(plant, x) + potential_energy(plant, x)


def forward_kinematics(plant: Plant, x: jax.Array) -> jax.Array:
    """Positions of elbow and end effector, shape (2, 2) = [link][x, y], m, joint 1 at (0, 0)."""
    elbow_x = plant.length[0] * jnp.sin(x[0])
    elbow_y = -plant.length[0] * jnp.cos(x[0])
    end_x = elbow_x + plant.length[1] * jnp.sin(x[0] + x[1])
    end_y = elbow_y - plant.length[1] * jnp.cos(x[0] + x[1])
    return jnp.stack([jnp.stack([elbow_x, elbow_y]), jnp.stack([end_x, end_y])])


def tip_height(length: jax.Array, x: jax.Array) -> jax.Array:
    """Height of the end effector above joint 1, m, of states (..., 4): shape (...)."""
    return -length[0] * jnp.cos(x[..., 0]) - length[1] * jnp.cos(x[..., 0] + x[..., 1])


def deviation(x: jax.Array, goal: jax.Array) -> jax.Array:
    """``x - goal``, (4,), with the angles wrapped to [-pi, pi)."""
    angle = jnp.remainder(x[:2] - goal[:2] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return jnp.concatenate([angle, x[2:] - goal[2:]])


def linearize(plant: Plant, x: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Jacobians ``A = d dynamics / dx`` (4, 4) and ``B = d dynamics / du`` (4, 2)."""
    return jax.jacfwd(dynamics, argnums=(1, 2))(plant, x, u)


def euler_step(plant: Plant, x: jax.Array, u: jax.Array, dt: float) -> jax.Array:
    """State after ``dt`` seconds by explicit Euler, torque held; shape (4,)."""
    return x + dt * dynamics(plant, x, u)


def rk4_step(plant: Plant, x: jax.Array, u: jax.Array, dt: float) -> jax.Array:
    """State after ``dt`` seconds by the classical fourth-order Runge-Kutta rule, torque held."""

    def slope(x):
        # Keeps XLA from fusing the stages into one kernel, which recomputes the earlier ones.
        return jax.lax.optimization_barrier(dynamics(plant, x, u))

    k1 = slope(x)
    k2 = slope(x + 0.5 * dt * k1)
    k3 = slope(x + 0.5 * dt * k2)
    k4 = slope(x + dt * k3)
    return x + dt / 6 * (k1 + 2 * (k2 + k3) + k4)
