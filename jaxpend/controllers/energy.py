"""Energy shaping with collocated partial feedback linearisation.

The torque of the driven joint ``a`` cancels what else accelerates it,

    tau = (v - alpha_a(x, 0)) / (M^-1)_aa    so that    alpha_a = v,

and ``v`` holds the joint near its upright angle while it feeds energy (J) into the motion:

    v = -kp (theta_a - theta_a*) - kd omega_a + cap tanh((E* - E) (ke . omega + kick) / cap)

Source: Spong, "The swing up control problem for the acrobot", 1995, and Fantoni, Lozano, Spong,
"Energy based control of the pendubot", 2000. It circles through the top; a ``Hybrid`` with LQR
catches it there. On a plant that is heavier than the model, or has friction, it never reaches the
top; with a ``surplus`` the energy aimed at rises and falls, so that the pendulum passes the top
again and again.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Memoryless
from ..designs import active_joint
from ..plant import UPRIGHT, Plant, deviation, dynamics, mass_matrix, total_energy
from ..pytree import check_constant, pytree, static
from .search_space import FACTOR

__all__ = ["EnergyShaping", "energy_shaping"]

# Found by random search on the official score, followed by LQR: (kp, kd, ke1, ke2, cap, kick).
GAINS = {
    "acrobot": (15.7, 4.3, -15.2, 0.72, 195.0, 0.3),
    "pendubot": (22.0, 6.0, 7.9, -0.16, 34.0, 0.3),
}
PERIOD = 1.5  # s, in which the surplus goes up and down once: about that of two swings


@pytree
class EnergyShaping(Memoryless):
    """Pumps the total energy to that of upright; needs the plant, as a model."""

    SEARCHED: ClassVar = dict.fromkeys(("kp", "kd", "ke", "cap", "kick", "surplus"), FACTOR)
    plant: Plant
    kp: jax.Array  # () 1/s^2
    kd: jax.Array  # () 1/s
    ke: jax.Array  # (2,) 1/(J s), of both joints' velocities
    cap: jax.Array  # () 1/s^2, largest acceleration that the pumping may ask for
    kick: jax.Array  # () 1/(J s^2), starts the motion at the bottom, where omega gives no sign
    joint: int = static()
    surplus: jax.Array | None = None  # () J, added to E* at most; None: nothing

    def __call__(self, carry, t, x):
        """Torque (2,), N m, zero on the passive joint."""
        plant, a = self.plant, self.joint
        upright = jnp.array(UPRIGHT, x.dtype)
        wanted_energy = total_energy(plant, upright)
        if self.surplus is not None:
            triangle = 1 - jnp.abs(2 * jnp.mod(t / PERIOD, 1) - 1)
            wanted_energy = wanted_energy + self.surplus * triangle
        missing = wanted_energy - total_energy(plant, x)
        error = deviation(x, upright)
        wanted = (
            -self.kp * error[a]
            - self.kd * x[2 + a]
            + self.cap * jnp.tanh(missing * (self.ke @ x[2:] + self.kick) / self.cap)
        )
        free = dynamics(plant, x, jnp.zeros(2, x.dtype))[2 + a]
        mass = mass_matrix(plant, x)
        determinant = mass[0, 0] * mass[1, 1] - mass[0, 1] ** 2
        torque = (wanted - free) * determinant / mass[1 - a, 1 - a]
        limit = plant.torque_limit
        return carry, jnp.clip(jnp.where(np.arange(2) == a, torque, 0.0), -limit, limit)


def energy_shaping(
    plant: Plant, robot: str, gains: tuple | None = None, *, surplus: float | None = None
) -> EnergyShaping:
    """Energy shaping for ``robot``; ``gains`` (kp, kd, ke1, ke2, cap, kick), default tuned ones.

    ``surplus`` (J) is as in ``EnergyShaping``. Raises ``JaxpendError`` for an unknown robot, or
    gains that are not six finite numbers.
    """
    joint = active_joint(robot)
    if gains is not None:
        check_constant(tuple[float, float, float, float, float, float], gains, "gains")
    dtype = plant.mass.dtype
    kp, kd, *ke, cap, kick = jnp.asarray(GAINS[robot] if gains is None else gains, dtype)
    more = None if surplus is None else jnp.asarray(surplus, dtype)
    return EnergyShaping(plant, kp, kd, jnp.stack(ke), cap, kick, joint, more)
