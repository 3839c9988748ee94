"""What a policy sees of the state. One definition for training, rollouts and policy files."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

from .fields import Checked, Natural, Positive

if TYPE_CHECKING:
    import jax

__all__ = ["KINDS", "Observation"]


def _wrapped(x: jax.Array, max_velocity: float) -> jax.Array:
    """Angles mod 2 pi on [-1, 1] and clipped velocities, as Evolutionary SAC has them.

    ``theta1 = pi`` maps to 0, but ``theta2 = 0``, the goal, lies on the wrap from 1 to -1.
    """
    import jax.numpy as jnp  # here: a configuration loads without jax

    angles = (x[:2] % (2 * jnp.pi) - jnp.pi) / jnp.pi
    return jnp.concatenate([angles, jnp.clip(x[2:4] / max_velocity, -1.0, 1.0)])


def _sincos(x: jax.Array, max_velocity: float) -> jax.Array:
    """Cosine and sine of both angles and scaled velocities: no jump anywhere."""
    import jax.numpy as jnp

    angles, velocity = x[:2], x[2:4]
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles), velocity / max_velocity])


# Name -> function, and the sign of each entry when left and right change places.
KINDS = {"wrapped": (_wrapped, (-1,) * 4), "sincos": (_sincos, (1, 1, -1, -1, -1, -1))}


@dataclasses.dataclass(frozen=True)
class Observation(Checked):
    """How a state (4,), and what came before it, become an observation (``size``,).

    Raises ``JaxpendError`` for an unknown kind, a velocity scale that is not positive, or a
    negative history.
    """

    kind: Literal["wrapped", "sincos"] = "sincos"
    max_velocity: Positive = 20.0  # rad/s, velocities are divided by it
    history: Natural = 0  # past states and actions that are seen too, one control period apart

    @property
    def size(self) -> int:
        """Length of the observation."""
        return self.state_size * (1 + self.history) + self.history

    @property
    def state_size(self) -> int:
        """Length of what is seen of one state."""
        return len(KINDS[self.kind][1])

    @property
    def mirrored(self) -> tuple[int, ...]:
        """The factors (``size``,), 1 or -1, that make it the observation of the mirrored state."""
        signs = KINDS[self.kind][1]
        return signs + (*signs, -1) * self.history

    def of_state(self, x: jax.Array) -> jax.Array:
        """What is seen of a state (4,): (``state_size``,)."""
        return KINDS[self.kind][0](x, self.max_velocity)

    def __call__(self, x: jax.Array, past: jax.Array | None = None) -> jax.Array:
        """Observation of a state (4,) and of ``past`` (history, 5), if there is any history.

        A row of ``past`` is a state and the action in it, the newest first.
        """
        now = self.of_state(x)
        if not self.history:
            return now
        import jax
        import jax.numpy as jnp

        before = jax.vmap(lambda row: jnp.append(self.of_state(row[:4]), row[4]))(past)
        return jnp.concatenate([now, before.ravel()])
