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

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from .pytree import Pytree, pytree
from .trigonometry import arctan, sincos

__all__ = [
    "UPRIGHT", "Plant", "coriolis_matrix", "deviation", "dynamics", "euler_step",
    "forward_kinematics", "friction_vector", "gravity_vector", "joint_torque", "kinetic_energy",
    "linearize", "mass_matrix", "mass_terms", "potential_energy", "rk4_step", "tip_height",
    "total_energy",
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


def _sines(x: jax.Array) -> tuple[jax.Array, ...]:
    """Sine and cosine of ``theta1``, then those of ``theta1 + theta2``."""
    return *sincos(x[0]), *sincos(x[0] + x[1])


def mass_terms(plant: Plant, cos2: jax.Array):
    """The three distinct entries ``(m11, m12, m22)`` of the mass matrix, kg m^2, (...) each.

    ``cos2`` (...) is the cosine of ``theta2``.
    """
    m2l1 = plant.mass[1] * plant.length[0]
    coupling = m2l1 * plant.com[1] * cos2
    ir, gr = plant.motor_inertia, plant.gear_ratio
    m11 = plant.inertia[0] + plant.inertia[1] + m2l1 * plant.length[0] + 2 * coupling
    m11 = m11 + gr**2 * ir + ir
    m12 = plant.inertia[1] + coupling - gr * ir
    m22 = plant.inertia[1] + gr**2 * ir
    return m11, m12, m22


def mass_matrix(plant: Plant, x: jax.Array) -> jax.Array:
    """Mass matrix ``M(theta)``, shape (2, 2), kg m^2, for a state of shape (4,)."""
    m11, m12, m22 = mass_terms(plant, sincos(x[1])[1])
    return jnp.stack([jnp.stack([m11, m12]), jnp.stack([m12, m22])])


def coriolis_matrix(plant: Plant, x: jax.Array) -> jax.Array:
    """Coriolis and centrifugal matrix ``C(theta, omega)``, shape (2, 2), N m s/rad."""
    h = plant.mass[1] * plant.length[0] * plant.com[1] * sincos(x[1])[0]
    first, second = [-2 * h * x[3], -h * x[3]], [h * x[2], jnp.zeros_like(h)]
    return jnp.stack([jnp.stack(first), jnp.stack(second)])


def _gravity_terms(plant: Plant, sin1: jax.Array, sin12: jax.Array):
    """Both gravity torques, of the sines of ``theta1`` and ``theta1 + theta2``."""
    m, g = plant.mass, plant.gravity
    g2 = -m[1] * g * plant.com[1] * sin12
    return -(m[0] * plant.com[0] + m[1] * plant.length[0]) * g * sin1 + g2, g2


def gravity_vector(plant: Plant, x: jax.Array) -> jax.Array:
    """Gravity torque ``G(theta)`` on the right-hand side, shape (2,), N m."""
    sin1, _, sin12, _ = _sines(x)
    return jnp.stack(_gravity_terms(plant, sin1, sin12))


def _friction(plant: Plant, joint: int, omega: jax.Array) -> jax.Array:
    """Friction torque of a joint."""
    viscous, coulomb = plant.damping[joint] * omega, plant.coulomb_friction
    known = not isinstance(coulomb, jax.core.Tracer)
    if coulomb is None or (known and not np.asarray(coulomb).any()):
        return viscous  # the arctan is much of the cost of a step
    return viscous + coulomb[joint] * arctan(COULOMB_STEEPNESS * omega)


def friction_vector(plant: Plant, x: jax.Array) -> jax.Array:
    """Friction torque ``F(omega) = b omega + c arctan(100 omega)``, shape (2,), N m."""
    return jnp.stack([_friction(plant, 0, x[2]), _friction(plant, 1, x[3])])


def _accelerations(plant: Plant, theta1, theta2, omega1, omega2, u):
    """Both entries of ``alpha``. Sines and cosines are taken once."""
    (sin1, cos1), (sin2, cos2) = sincos(theta1), sincos(theta2)
    m11, m12, m22 = mass_terms(plant, cos2)
    g1, g2 = _gravity_terms(plant, sin1, sin1 * cos2 + cos1 * sin2)
    h = plant.mass[1] * plant.length[0] * plant.com[1] * sin2
    f1 = g1 + plant.actuation[0] * u[0] + h * omega2 * (2 * omega1 + omega2)
    f2 = g2 + plant.actuation[1] * u[1] - h * omega1 * omega1
    f1, f2 = f1 - _friction(plant, 0, omega1), f2 - _friction(plant, 1, omega2)
    det = m11 * m22 - m12 * m12
    return (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det


def dynamics(plant: Plant, x: jax.Array, u: jax.Array) -> jax.Array:
    """Time derivative of the state, ``[omega, alpha]``, shape (4,), for torque ``u`` (2,).

    ``alpha = M^-1 (G + B u - C omega - F)``. The torque is not clipped here.
    """
    return jnp.stack([x[2], x[3], *_accelerations(plant, x[0], x[1], x[2], x[3], u)])


def joint_torque(torque: jax.Array, joint: int) -> jax.Array:
    """Torques (..., 2) of a torque (...) on a joint, 0 or 1, and none on the other.

    Put together of two entries: a batch stays fast on a CPU then, unlike by a mask (``rk4_step``).
    """
    none = jnp.zeros_like(torque)
    return jnp.stack([none, torque] if joint else [torque, none], axis=-1)


def kinetic_energy(plant: Plant, x: jax.Array) -> jax.Array:
    """Kinetic energy ``omega' M omega / 2``, scalar, J."""
    m11, m12, m22 = mass_terms(plant, sincos(x[1])[1])
    return 0.5 * (m11 * x[2] ** 2 + 2 * m12 * x[2] * x[3] + m22 * x[3] ** 2)


def potential_energy(plant: Plant, x: jax.Array) -> jax.Array:
    """Potential energy, scalar, J, zero at the height of joint 1."""
    _, cos1, _, cos12 = _sines(x)
    y1 = -plant.com[0] * cos1
    y2 = -plant.length[0] * cos1 - plant.com[1] * cos12
    return plant.gravity * (plant.mass[0] * y1 + plant.mass[1] * y2)


def total_energy(plant: Plant, x: jax.Array) -> jax.Array:
    """Kinetic plus potential energy, scalar, J."""
    return kinetic_energy(plant, x) + potential_energy(plant, x)


def forward_kinematics(plant: Plant, x: jax.Array) -> jax.Array:
    """Positions of elbow and end effector, shape (2, 2) = [link][x, y], m, joint 1 at (0, 0)."""
    sin1, cos1, sin12, cos12 = _sines(x)
    elbow_x, elbow_y = plant.length[0] * sin1, -plant.length[0] * cos1
    end_x, end_y = elbow_x + plant.length[1] * sin12, elbow_y - plant.length[1] * cos12
    return jnp.stack([jnp.stack([elbow_x, elbow_y]), jnp.stack([end_x, end_y])])


def tip_height(length: jax.Array, x: jax.Array) -> jax.Array:
    """Height of the end effector above joint 1, m, of states (..., 4): shape (...)."""
    return -length[0] * sincos(x[..., 0])[1] - length[1] * sincos(x[..., 0] + x[..., 1])[1]


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


# A function that is compiled by itself in a program is traced, batched, differentiated and lowered
# once for all its calls there; XLA puts them together again.
_traced_once = jax.jit


def rk4_step(plant: Plant, x: jax.Array, u: jax.Array, dt: float) -> jax.Array:
    """State after ``dt`` seconds by the classical fourth-order Runge-Kutta rule, torque held."""
    friction = plant.coulomb_friction
    if not isinstance(friction, jax.core.Tracer | None) and not np.asarray(friction).any():
        plant = plant.replace(coulomb_friction=None)  # inside, one cannot see that it is zero
    return _traced_once(_rk4_step)(plant, x, u, dt)


@jax.custom_jvp
def _rk4_step(plant, x, u, dt):
    """The step with the four entries of the state apart from each other up to the end.

    Of a batch each is one contiguous vector then, which a CPU works on many entries at a time.
    """

    def slope(parts):
        theta1, theta2, omega1, omega2 = parts
        alpha = _traced_once(_accelerations)(plant, theta1, theta2, omega1, omega2, u)
        return omega1, omega2, *alpha

    return jnp.stack(_runge_kutta(slope, (x[0], x[1], x[2], x[3]), dt))


def _rk4_whole(plant, x, u, dt):
    """The same step of the state as a whole, of which a derivative is faster."""

    def slope(whole):
        # Keeps XLA from fusing the stages into one kernel, which recomputes the earlier ones.
        return (jax.lax.optimization_barrier(_traced_once(dynamics)(plant, whole[0], u)),)

    return _runge_kutta(slope, (x,), dt)[0]


def _runge_kutta(slope, start, dt):
    """The parts of a state after a step, of the parts ``start``."""

    def ahead(time, k):
        return tuple(p + time * s for p, s in zip(start, k, strict=True))

    k1 = slope(start)
    k2 = slope(ahead(0.5 * dt, k1))
    k3 = slope(ahead(0.5 * dt, k2))
    k4 = slope(ahead(dt, k3))
    slopes = zip(start, k1, k2, k3, k4, strict=True)
    return [p + dt / 6 * (a + 2 * (b + c) + d) for p, a, b, c, d in slopes]


@partial(_rk4_step.defjvp, symbolic_zeros=True)
def _rk4_derivative(primals, tangents):
    """That of ``_rk4_whole``, in what has a tangent alone."""
    leaves, structure = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents, is_leaf=lambda t: isinstance(t, SymbolicZero))
    moving = [i for i, slope in enumerate(slopes) if not isinstance(slope, SymbolicZero)]

    def step(*those):
        moved = dict(zip(moving, those, strict=True))
        whole = [moved.get(i, leaf) for i, leaf in enumerate(leaves)]
        return _rk4_whole(*jax.tree.unflatten(structure, whole))

    return jax.jvp(step, [leaves[i] for i in moving], [slopes[i] for i in moving])
