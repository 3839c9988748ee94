"""What a policy sees of the state. One definition for training, rollouts and policy files."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Literal

from .errors import JaxpendError
from .fields import Bounds, Checked, Positive, Scale

if TYPE_CHECKING:
    import jax

__all__ = ["KINDS", "History", "Observation", "Seen"]

History = Annotated[int, Bounds(least=0, most=1000)]
# What a policy of another tool may have seen of a state.
Seen = Literal["wrapped", "sincos", "sincos_clipped", "sincos_by_joint", "state", "angles"]


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

    from .trigonometry import sincos

    sin, cos = sincos(x[:2])
    return jnp.concatenate([cos, sin, x[2:4] / max_velocity])


def _clipped(x: jax.Array, max_velocity: float) -> jax.Array:
    """The same with velocities clipped to [-1, 1]."""
    import jax.numpy as jnp

    seen = _sincos(x, max_velocity)
    return jnp.concatenate([seen[:4], jnp.clip(seen[4:], -1.0, 1.0)])


def _angles(x: jax.Array, max_velocity: float) -> jax.Array:
    """Cosine and sine of both angles, and no velocities."""
    return _sincos(x, max_velocity)[:4]


def _turned(now: jax.Array, before: jax.Array) -> jax.Array:
    """Sine of how far both joints turned (2,), of cosines and sines before and after (4,)."""
    # sin(a - b) = sin a cos b - cos a sin b: whole turns make no difference.
    return now[2:] * before[:2] - now[:2] * before[2:]


def _state(x: jax.Array, max_velocity: float) -> jax.Array:
    """Angles as they are, however many turns, in rad, and scaled velocities."""
    import jax.numpy as jnp

    return jnp.concatenate([x[:2], x[2:4] / max_velocity])


# Name -> function, and the sign of each entry when left and right change places.
KINDS = {
    "wrapped": (_wrapped, (-1,) * 4),
    "sincos": (_sincos, (1, 1, -1, -1, -1, -1)),
    "sincos_clipped": (_clipped, (1, 1, -1, -1, -1, -1)),
    "state": (_state, (-1,) * 4),
    "angles": (_angles, (1, 1, -1, -1)),
}


@dataclasses.dataclass(frozen=True)
class Observation(Checked):
    """How a state (4,), and what came before it, become an observation (``size``,).

    What is seen of a state (``state_size``,) is normalised to ``(seen - mean) / std``, then
    clipped to ``[-clip, clip]``; each of the three may be left out.

    Of the kind ``angles`` no velocity is seen, so that its noise does not matter, but, as the
    past, the sine of how far each joint turned in every period, over ``max_turn``: that tells
    speeds apart up to pi/2 a period. It is not normalised.

    Raises ``JaxpendError`` for an unknown kind, a scale that is not positive, a negative history,
    ``angles`` without any or normalised, or a mean or std that is not of ``state_size``.
    """

    kind: Literal["wrapped", "sincos", "sincos_clipped", "state", "angles"] = "sincos"
    max_velocity: Scale = 20.0  # rad/s, velocities are divided by it
    # Past states and actions that are seen too, one control period apart.
    history: History = 0
    mean: tuple[float, ...] | None = None  # of what is seen of a state; None: 0
    std: tuple[Scale, ...] | None = None  # standard deviations; None: 1
    clip: Positive | None = None  # largest magnitude of what is seen, once normalised; None: any
    max_turn: Scale = 0.1  # rad in a period, what ``angles`` sees of the past is divided by it

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == "angles" and not self.history:
            text = "angles are seen without velocities, but for how they change"
            raise JaxpendError(f"history is 0; {text}; it must be at least 1")
        for name in ("mean", "std", "clip"):
            if self.kind == "angles" and (value := getattr(self, name)) is not None:
                raise JaxpendError(f"{name} is {value}; angles are not normalised; leave it out")
        for name in ("mean", "std"):
            value = getattr(self, name)
            if value is not None and len(value) != self.state_size:
                text = f"{name} is {value}; it must be {self.state_size} values, as many as "
                raise JaxpendError(f"{text}{self.kind!r} sees of a state")

    @property
    def size(self) -> int:
        """Length of the observation."""
        return len(self.mirrored)

    @property
    def state_size(self) -> int:
        """Length of what is seen of one state."""
        return len(KINDS[self.kind][1])

    @property
    def mirrored(self) -> tuple[int, ...]:
        """The factors (``size``,), 1 or -1, that make it the observation of the mirrored state.

        They do so only where it is ``symmetric``.
        """
        signs = KINDS[self.kind][1]
        past = (-1, -1) if self.kind == "angles" else signs
        return signs + (*past, -1) * self.history

    @property
    def symmetric(self) -> bool:
        """Whether left and right look alike: the mean is 0 where a mirror changes the sign."""
        signs = KINDS[self.kind][1]
        return all(s > 0 or not m for s, m in zip(signs, self.mean or (), strict=False))

    def of_state(self, x: jax.Array) -> jax.Array:
        """What is seen of a state (4,): (``state_size``,)."""
        import jax.numpy as jnp

        seen = KINDS[self.kind][0](x, self.max_velocity)
        if self.mean is not None:
            seen = seen - jnp.array(self.mean, seen.dtype)
        if self.std is not None:
            seen = seen / jnp.array(self.std, seen.dtype)
        return seen if self.clip is None else jnp.clip(seen, -self.clip, self.clip)

    def __call__(self, x: jax.Array, past: jax.Array | None = None) -> jax.Array:
        """Observation of a state (4,) and of ``past`` (history, 5), if there is any history.

        A row of ``past`` is a state and the action in it, the newest first.
        """
        now = self.of_state(x)
        if past is None:
            return now
        import jax
        import jax.numpy as jnp

        if self.kind == "angles":
            seen = jax.vmap(lambda x: _angles(x, self.max_velocity))(jnp.vstack([x, past[:, :4]]))
            turned = jax.vmap(_turned)(seen[:-1], seen[1:]) / self.max_turn
            return jnp.concatenate([now, jnp.column_stack([turned, past[:, 4]]).ravel()])
        before = jax.vmap(lambda row: jnp.append(self.of_state(row[:4]), row[4]))(past)
        return jnp.concatenate([now, before.ravel()])
