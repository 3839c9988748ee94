"""The criteria and scores of the RealAIGym leaderboards, as pure functions of a trajectory.

The definitions are those of the RealAIGym ``double_pendulum`` benchmark (Wiebe et al.,
"Reinforcement learning for athletic intelligence", IJCAI 2024 competition track). Everything
accepts leading batch axes and can be jitted, vmapped and (where smooth) differentiated.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp

from .errors import JaxpendError
from .plant import Plant, tip_height
from .pytree import Pytree, pytree

__all__ = [
    "EPSILON", "HEIGHT", "V1_DEFAULT", "V1_OFFICIAL", "V2_HARDWARE", "V2_OFFICIAL", "Criteria",
    "ScoreV2", "ScoreV3", "criteria", "score_v1", "score_v2", "score_v3", "upright",
]  # fmt: skip

HEIGHT = 0.9  # of the stretched height above joint 1: the line that a swing-up has to cross
# criterion -> (weight, normalisation); the sums of the leaderboard's own configurations.
V1_OFFICIAL = {
    "swingup_time": (0.2, 10.0), "max_tau": (0.1, 6.0), "energy": (0.1, 100.0),
    "integ_tau": (0.1, 60.0), "tau_cost": (0.1, 360.0), "tau_smoothness": (0.2, 12.0),
    "velocity_cost": (0.2, 1000.0),
}  # fmt: skip
V1_DEFAULT = {
    "swingup_time": (0.2, 10.0), "max_tau": (0.1, 1.0), "integ_tau": (0.1, 10.0),
    "tau_smoothness": (0.6, 1.0), "velocity_cost": (0.2, 1000.0),
}  # fmt: skip
# criterion -> normalisation; the terms of v2 have equal weight.
V2_OFFICIAL = {
    "swingup_time": 20.0, "energy": 60.0, "tau_cost": 20.0, "tau_smoothness": 0.1,
    "velocity_cost": 400.0,
}  # fmt: skip
V2_HARDWARE = V2_OFFICIAL | {"tau_cost": 100.0, "tau_smoothness": 4.0}


@pytree
class Criteria(Pytree):
    """What the leaderboards measure; every field has the batch shape of the trajectories."""

    swingup_time: jax.Array  # s, start of the time above the line that lasts to the end
    max_tau: jax.Array  # N m
    energy: jax.Array  # J, sum of |torque x angle change|
    integ_tau: jax.Array  # N m s
    tau_cost: jax.Array  # N^2 m^2 s
    tau_smoothness: jax.Array  # N m, standard deviation of the torque changes
    velocity_cost: jax.Array  # rad^2/s
    uptime: jax.Array  # s above the line
    number_of_swingups: jax.Array  # rises above the line more than 1 s apart
    success: jax.Array  # bool, above the line at the end

    @property
    def diverged(self) -> jax.Array:
        """Whether the trajectory holds NaN or infinities; its score is that of a failure."""
        return ~jnp.isfinite(self.velocity_cost)


def _swingup_index(up: jax.Array) -> jax.Array:
    """Index of the swing-up: the reference looks at samples 1 to N - 2 only, from the end."""
    inner = up[..., 1:-1]
    position = jnp.arange(1, up.shape[-1] - 1)
    return 1 + jnp.max(jnp.where(inner, 0, position), axis=-1, initial=0)


def _count_swingups(t: jax.Array, up: jax.Array, deadtime: float = 1.0) -> jax.Array:
    """Rises above the line more than ``deadtime`` s after the one counted before."""
    t, up = jnp.moveaxis(jnp.broadcast_to(t, up.shape), -1, 0), jnp.moveaxis(up, -1, 0)

    def step(carry, now):
        count, t_counted, was_up = carry
        t, is_up = now
        counts = is_up & ~was_up & (t - t_counted > deadtime)
        return (count + counts, jnp.where(counts, t, t_counted), is_up), None

    zeros = jnp.zeros(up.shape[1:])
    start = (zeros.astype(int), zeros.astype(t.dtype) - deadtime, zeros.astype(bool))
    return jax.lax.scan(step, start, (t, up))[0][0]


def criteria(
    t: jax.Array, x: jax.Array, u: jax.Array, plant: Plant, *, height=HEIGHT, t_final=10.0
) -> Criteria:
    """The leaderboard's criteria of one trajectory or a batch of them.

    Args:
        t: (..., N) or (..., N + 1) time stamps, s; an array or lists of numbers, like all three.
        x: (..., N, 4) or (..., N + 1, 4) states. The official path stores as many states as
            torques, so a last state beyond them is dropped here too.
        u: (..., N, 2) applied torques, N m.
        plant: gives the link lengths; one for the whole batch.
        height: the line, as a fraction of the stretched height above joint 1.
        t_final: s; a trajectory that ends before 0.99 of it has an infinite swing-up time.

    Raises:
        JaxpendError: shapes that do not fit together or fewer than three samples.
    """
    try:
        t, x, u = (jnp.asarray(values) for values in (t, x, u))
    except (TypeError, ValueError) as error:
        raise JaxpendError(f"criteria need arrays of numbers for t, x and u: {error}") from None
    n = u.shape[-2] if u.ndim > 1 else 0
    fits = t.ndim > 0 and x.ndim > 1 and t.shape[-1] == x.shape[-2] and t.shape[-1] in (n, n + 1)
    if n < 3 or not fits or x.shape[-1] != 4 or u.shape[-1] != 2:
        shapes = f"got t {t.shape}, x {x.shape}, u {u.shape}"
        need = "t (..., N or N+1), x (..., N or N+1, 4), u (..., N, 2) with N > 2"
        raise JaxpendError(f"criteria need {need}; {shapes}")
    t, x = t[..., :n], x[..., :n, :]
    up = tip_height(plant.length, x) > height * (plant.length[0] + plant.length[1])
    dt, held, moves = jnp.diff(t)[..., None], u[..., :-1, :], jnp.diff(x[..., :2], axis=-2)
    stamps = jnp.broadcast_to(t, up.shape)
    index = _swingup_index(up)
    swingup_time = jnp.take_along_axis(stamps, index[..., None], axis=-1)[..., 0]
    swingup_time = jnp.where(stamps[..., -1] < 0.99 * t_final, jnp.inf, swingup_time)
    since_last = jnp.diff(t, prepend=jnp.zeros_like(t[..., :1]))
    return Criteria(
        swingup_time=swingup_time,
        max_tau=jnp.max(jnp.abs(u), axis=(-2, -1)),
        energy=jnp.sum(jnp.abs(moves * held), axis=(-2, -1)),
        integ_tau=jnp.sum(jnp.abs(held) * dt, axis=(-2, -1)),
        tau_cost=jnp.sum(held**2 * dt, axis=(-2, -1)),
        tau_smoothness=jnp.sum(jnp.std(jnp.diff(u, axis=-2), axis=-2), axis=-1),
        velocity_cost=jnp.sum(x[..., :-1, 2:] ** 2 * dt, axis=(-2, -1)),
        uptime=jnp.sum(jnp.where(up, since_last, 0.0), axis=-1),
        number_of_swingups=_count_swingups(t, up),
        success=swingup_time < stamps[..., -1],
    )


def score_v1(c: Criteria, terms: Mapping[str, tuple[float, float]] = V1_OFFICIAL) -> jax.Array:
    """``success (1 - sum_i w_i c_i / n_i)``; NaN, as there, where the trajectory was too short."""
    cost = sum(weight * getattr(c, name) / norm for name, (weight, norm) in terms.items())
    failed = jnp.where(jnp.isinf(c.swingup_time), jnp.nan, 0.0)
    return jnp.where(c.success, 1.0 - cost, failed)


def score_v2(c: Criteria, norms: Mapping[str, float] = V2_OFFICIAL) -> jax.Array:
    """``success (1 - mean_i tanh(pi c_i / n_i))``, in [0, 1); 0 for a failed or diverged run."""
    penalties = [jnp.tanh(jnp.pi * getattr(c, name) / norm) for name, norm in norms.items()]
    return jnp.where(c.success, 1.0 - sum(penalties) / len(penalties), 0.0)


def score_v3(c: Criteria, t_final: float = 60.0) -> jax.Array:
    """``uptime / t_final``; the leaderboard's runs last 60 s."""
    return c.uptime / t_final


@dataclasses.dataclass(frozen=True)
class ScoreV2:
    """``score_v2`` with these normalisations: what a task holds as its score."""

    norms: tuple[tuple[str, float], ...] = tuple(V2_OFFICIAL.items())

    def __call__(self, c: Criteria) -> jax.Array:
        """The score, of the batch shape of ``c``."""
        return score_v2(c, dict(self.norms))


@dataclasses.dataclass(frozen=True)
class ScoreV3:
    """``score_v3`` of a run of ``duration`` s."""

    duration: float = 60.0

    def __call__(self, c: Criteria) -> jax.Array:
        """The score, of the batch shape of ``c``."""
        return score_v3(c, self.duration)


# Success: the final state within these of upright (rad, rad, rad/s, rad/s), strictly.
EPSILON = (0.35, 0.35, 1.0, 1.0)


def upright(x: jax.Array) -> jax.Array:
    """Whether states (..., 4) are within ``EPSILON`` of upright; False where the state is NaN.

    theta1 is taken modulo 2 pi and theta2 wrapped to [-pi, pi), as the benchmark does.
    """
    theta1 = jnp.mod(x[..., 0], 2 * jnp.pi) - jnp.pi
    theta2 = jnp.mod(x[..., 1] + jnp.pi, 2 * jnp.pi) - jnp.pi
    off = (theta1, theta2, x[..., 2], x[..., 3])
    within = [jnp.abs(part) < most for part, most in zip(off, EPSILON, strict=True)]
    return jnp.all(jnp.stack(within), axis=0)
