"""Identification: the parameters of a robot, and its delay, from recorded trajectories.

Multiple shooting (Bock, "Recent advances in parameter identification techniques for ODE", 1983):
a recording is cut into short windows, each simulated from an initial state of its own, so that
chaos does not spoil the gradient through the simulator. The weighted squared distance of all
windows to what was measured is the least over the parameters and the initial states. The latter
are eliminated (variable projection; Golub and Pereyra, 1973), and scipy's trust-region method
finds the former. How noisy angles and velocities are is taken from the residuals.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .designs import PAIRS, from_dict
from .errors import JaxpendError, choose
from .plant import Plant, rk4_step
from .rollout import Trajectory

__all__ = ["FITTED", "KNOWN", "Identified", "identify"]

# What recorded motion tells if the masses are known: of m1, r1 and I1 only m1 r1 + m2 l1 and
# I1 + m2 l1^2 matter. The delay (s) is that of measurements.
FITTED = ("r1", "I1", "r2", "I2", "b1", "b2", "cf1", "cf2", "Ir", "delay")
KNOWN = ("m1", "m2", "l1", "l2", "g", *FITTED)
LONGEST_DELAY = 0.1  # s
# The unit of a step of what may be 0; that of others is their nominal value.
SCALES = {"b1": 0.1, "b2": 0.1, "cf1": 0.1, "cf2": 0.1, "Ir": 1e-4, "delay": 0.01}
INNER = 3  # Gauss-Newton steps of the initial states
ROUNDS = 3  # fits, each with the noise that the one before found
START = (0.005, 0.1)  # rad and rad/s, the noise that the first takes
GAP = 1.5  # times the usual step
LOST = 0.2  # rad, more than any sensor is off by
BLURRED = 1e-6  # of the largest strength of a direction: it is not seen


@dataclasses.dataclass(frozen=True)
class Identified:
    """What the recordings say of a robot, SI units."""

    parameters: dict[str, float]  # all of a plant, as ``designs.from_dict`` takes them
    delay: float  # s, from a state to its measurement; 0 where it was not fitted
    deviations: dict[str, float]  # standard deviations of what was fitted
    noise: tuple[float, float]  # rad and rad/s, root mean square of what is left
    windows: int

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers: what the command writes as JSON."""
        return dataclasses.asdict(self)

    def plant(self, **options: Any) -> Plant:
        """It as a plant; options as of ``designs.from_dict``."""
        return from_dict(self.parameters, **options)


def _checked(number: int, run: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (N,), states (N, 4) and torques (N, 2) of a recording."""
    t, x, u = (np.asarray(values, float) for values in (run.t, run.x, run.u))
    if t.ndim != 1 or x.shape[1:] != (4,) or u.shape[1:] != (2,) or len(x) < len(t):
        shapes = f"t {t.shape}, x {x.shape}, u {u.shape}"
        raise JaxpendError(f"recording {number} has {shapes}; it must have (N,), (N, 4), (N, 2)")
    if not all(np.isfinite(values).all() for values in (t, x, u)):
        raise JaxpendError(f"recording {number} holds numbers that are not finite")
    count = min(len(t), len(u))
    t, x, u = t[:count], x[:count].copy(), u[:count]
    steps = np.diff(t)
    if count < 3 or not (steps > 0).all():
        text = "it must hold three samples or more, each later than the one before"
        raise JaxpendError(f"recording {number} has {count} samples; {text}")
    usual = float(np.median(steps))
    if (worst := float(steps.max())) > GAP * usual:
        where = float(t[int(np.argmax(steps))])
        text = f"its steps are {usual:.4g} s long elsewhere; cut it there into two recordings"
        raise JaxpendError(
            f"recording {number} has a gap of {worst:.4g} s at {where:.4g} s; {text}"
        )
    x[:, :2] = np.unwrap(x[:, :2], axis=0)
    return t, x, u


def _cut(recordings: Sequence[Trajectory], window: float) -> tuple[np.ndarray, ...]:
    """The windows of all recordings, n of K steps; what is left at an end is not used.

    Times (n, K + 1), states (n, K + 1, 4), and, from ``LONGEST_DELAY`` before, times (n, M) and
    the integral of the torques up to them (n, M, 2), N m s.
    """
    if not recordings:
        raise JaxpendError("there are no recordings; give one or more")
    runs = [_checked(number, run) for number, run in enumerate(recordings, 1)]
    step = float(np.median(np.diff(runs[0][0])))
    length = max(round(window / step), 2)
    pieces: list[tuple[np.ndarray, ...]] = []
    for t, x, u in runs:
        before = int(np.ceil(LONGEST_DELAY / np.median(np.diff(t)))) + 1
        impulse = np.concatenate([np.zeros((1, 2)), np.cumsum(u[:-1] * np.diff(t)[:, None], 0)])
        # Before the recording there was no torque.
        early = t[0] + (t[1] - t[0]) * np.arange(-before, 0)
        knots, impulse = np.append(early, t), np.concatenate([np.zeros((before, 2)), impulse])
        for start in range(0, len(t) - length, length):
            end = start + length + 1
            around = slice(start, before + end)
            pieces.append((t[start:end], x[start:end], knots[around], impulse[around]))
    if len(pieces) < 2:
        raise JaxpendError(
            f"the recordings are shorter than two windows of {window:g} s; record more"
        )
    sizes = {len(piece[2]) for piece in pieces}
    if len(sizes) > 1:
        raise JaxpendError("the recordings have different time steps; identify them one by one")
    return tuple(np.stack(parts) for parts in zip(*pieces, strict=True))


def _plant(values: Mapping[str, Any]) -> Plant:
    """A plant of traced parameters, both joints driven."""
    pair = {name: jnp.stack([values[f"{v}1"], values[f"{v}2"]]) for name, v in PAIRS.items()}
    free = {"torque_limit": jnp.full(2, jnp.inf), "actuation": jnp.ones(2)}
    rest = {"gravity": values["g"], "motor_inertia": values["Ir"], "gear_ratio": values["gr"]}
    return Plant(**pair, **free, **rest)


def _distance(names, base, weights, theta, x0, t, x, knots, impulse):
    """Weighted residuals (K + 1, 4) of a window that starts in ``x0``.

    The measurement lags, which is as if the torque did: over a step acts the mean of what was
    commanded so much earlier, which changes smoothly with the delay.
    """
    values = {**base, **dict(zip(names, theta, strict=True))}
    plant, past = _plant(values), t - values["delay"]
    moved = jax.vmap(lambda column: jnp.interp(past, knots, column), 1, 1)(impulse)

    def step(x, now):
        duration, push = now
        return rk4_step(plant, x, push / duration, duration), x

    last, states = jax.lax.scan(step, x0, (jnp.diff(t), jnp.diff(moved, axis=0)))
    return weights * (jnp.concatenate([states, last[None]]) - x)


@partial(jax.jit, static_argnames="names")
def _projected(names, base, weights, theta, starts, windows):
    """Residuals (n, R), their slope in ``theta`` (n, R, p), and better initial states (n, 4).

    Both are those that remain when every window has its best initial state.
    """

    def one(start, *window):
        def both(theta, x0):
            found = _distance(names, base, weights, theta, x0, *window).ravel()
            return found, found

        slopes = jax.jacfwd(both, 1, has_aux=True)

        def improve(x0, _):
            slope, off = slopes(theta, x0)
            return x0 - jnp.linalg.solve(slope.T @ slope, slope.T @ off), None

        x0, _ = jax.lax.scan(improve, start, length=INNER)
        (slope, free), off = jax.jacfwd(both, (0, 1), has_aux=True)(theta, x0)
        free = jnp.linalg.qr(free)[0]
        return off - free @ (free.T @ off), slope - free @ (free.T @ slope), x0

    return jax.vmap(one)(starts, *windows)


class _Fit:
    """The least-squares problem in the parameters, with the last point that was asked for."""

    def __init__(self, names, base, weights, starts, windows):
        self.fixed, self.starts, self.windows = (names, base, weights), starts, windows
        self.at: np.ndarray | None = None

    def __call__(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (n,) and their slope (n, p)."""
        if self.at is None or not np.array_equal(self.at, theta):
            off, slope, starts = _projected(*self.fixed, theta, self.starts, self.windows)
            if not jnp.isfinite(off).all():  # too far: scipy goes less far
                return np.full(off.size, 1e6), np.zeros((off.size, len(theta)))
            self.at, self.starts = theta.copy(), starts
            self.found = np.asarray(off).ravel(), np.asarray(slope).reshape(-1, len(theta))
        return self.found


def _refuse_blurred(names: Sequence[str], slope: np.ndarray, scales: np.ndarray) -> None:
    """Refuse parameters that the recordings cannot tell apart."""
    _, strength, directions = np.linalg.svd(slope * scales, full_matrices=False)
    if strength[-1] > BLURRED * strength[0]:
        return
    mixed = [n for n, part in zip(names, directions[-1], strict=True) if abs(part) > 0.05]
    if len(mixed) == 1:
        raise JaxpendError(f"the recordings do not show {mixed[0]}; leave it out of the parameters")
    text = f"the recordings do not tell {', '.join(mixed[:-1])} and {mixed[-1]} apart"
    raise JaxpendError(f"{text}; leave one out of the parameters")


def identify(
    recordings: Sequence[Trajectory],
    nominal: Mapping[str, float],
    fitted: Sequence[str] = FITTED,
    *,
    window: float = 0.25,
) -> Identified:
    """Fit parameters of a plant, and the delay of measurements, to recorded trajectories.

    Args:
        recordings: measured states (N, 4) and commanded torques (N, 2), as ``load_csv`` gives
            them; of one robot, on one time grid without gaps. Both links should move, fast and
            slowly.
        nominal: all parameters of a plant, as ``designs.from_dict`` takes them: where the search
            starts, and what is not fitted.
        fitted: names, of ``KNOWN``.
        window: s, the length of a piece that is simulated at once.

    Raises:
        JaxpendError: a recording with gaps, too short ones, an unknown parameter, one that is not
            positive where the search starts, some that the recordings do not tell apart, or
            nothing that moves like them.
    """
    names = tuple(fitted)
    for name in names:
        choose("parameter to identify", name, KNOWN)
    if not names or len(set(names)) != len(names):
        raise JaxpendError(f"the parameters to identify are {list(names)}; name some, each once")
    if not 0 < window < math.inf:
        raise JaxpendError(f"window is {window} s; it must be positive and finite")
    plain = from_dict(nominal)  # refuses what no plant has
    base = dict.fromkeys(SCALES, 0.0) | {"g": float(plain.gravity), "gr": float(plain.gear_ratio)}
    base |= {name: float(v) for name, v in nominal.items() if name not in ("tl1", "tl2")}
    for name in names:
        if name not in SCALES and not base[name] > 0:
            text = f"{name} is {base[name]:g} where the search starts; to be fitted it must be"
            raise JaxpendError(f"{text} positive")
    scales = np.array([SCALES.get(name, abs(base[name])) for name in names])
    windows = _cut(recordings, window)
    with jax.enable_x64(True):
        theta, slope, noise = _solved(names, base, scales, jax.tree.map(jnp.asarray, windows))
    if noise[0] > LOST:
        raise JaxpendError(
            f"no plant was found that moves like the recordings: {noise[0]:.2g} rad are left over; "
            "try a shorter window, other parameters, or start from a plant more like it"
        )
    _refuse_blurred(names, slope, scales)
    spread = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope)))
    values = {name: float(value) for name, value in zip(names, theta, strict=True)}
    delay = values.pop("delay", 0.0)
    return Identified(
        parameters={**nominal, **values},
        delay=delay,
        deviations={name: float(s) for name, s in zip(names, spread, strict=True)},
        noise=(float(noise[0]), float(noise[1])),
        windows=len(windows[0]),
    )


def _solved(names, base, scales, windows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best parameters (p,), the slope there (n, p), and the noise of angles and velocities."""
    from scipy.optimize import least_squares

    low = np.array([0.0 if name in SCALES else 1e-3 * base[name] for name in names])
    high = np.array([LONGEST_DELAY if name == "delay" else np.inf for name in names])
    # What may be 0 starts a little above, where the search can go both ways.
    theta = np.maximum([base[name] for name in names], low + 0.05 * scales)
    noise, starts = np.array(START), windows[1][:, 0]
    for _ in range(ROUNDS):
        fit = _Fit(names, base, 1 / np.repeat(noise, 2), starts, windows)
        theta = least_squares(
            lambda z, fit=fit: fit(z)[0], theta, lambda z, fit=fit: fit(z)[1],
            bounds=(low, high), x_scale=scales,
        ).x  # fmt: skip
        (left, slope), starts = fit(theta), fit.starts
        each = left.reshape(-1, 4) * np.repeat(noise, 2)
        noise = np.sqrt([np.mean(each[:, :2] ** 2), np.mean(each[:, 2:] ** 2)]) + 1e-9
    return theta, slope, noise
