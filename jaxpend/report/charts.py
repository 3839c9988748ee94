"""Charts of a swing-up and of learning: each draws on the axes it is given (see ``plots``)."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, MultipleLocator, NullFormatter

from ..runs.statistics import interquartile_mean, interval
from .figures import PALETTE

__all__ = [
    "draw_angles", "draw_curves", "draw_height", "draw_phase", "draw_torque", "draw_velocities",
]  # fmt: skip

# --- a swing-up ----------------------------------------------------------------------------


def _turns(value: float, _position: int = 0) -> str:
    """An angle in multiples of pi: "0", "π/2", "-3π/2"."""
    halves = round(2 * value / np.pi)
    if halves == 0:
        return "0"
    number, sign = abs(halves), "\N{MINUS SIGN}" if halves < 0 else ""
    if number % 2:
        return f"{sign}{'' if number == 1 else number}π/2"
    return f"{sign}{'' if number == 2 else number // 2}π"


def _angle_axis(axis, values: np.ndarray) -> None:
    """Ticks at half turns, turns, or less often where the arm went round and round.

    Plain radians where it hardly moved, or too far.
    """
    turns = (values.max() - values.min()) / np.pi
    steps = [s for s in (0.5, 1, 2, 4, 10, 20, 40, 100, 200) if turns / s <= 6]
    if steps and turns > 0.75:
        axis.set_major_locator(MultipleLocator(steps[0] * np.pi))
        axis.set_major_formatter(FuncFormatter(_turns))


def _legend(axes) -> None:
    """Beside the title, where no data are."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.1, borderpad=0.2,
        handlelength=0.9, handletextpad=0.4, columnspacing=1.0, fontsize=9,
    )  # fmt: skip


def _goals(x: np.ndarray) -> tuple[float, float]:
    """The angles of upright, rad, that are nearest to the last of the states (n, 4)."""
    full = 2 * np.pi
    turn1, turn2 = round((x[-1, 0] - np.pi) / full), round(x[-1, 1] / full)
    return np.pi + turn1 * full, turn2 * full


def _over_time(axes, title: str, ylabel: str, end: float, up: float | None, held) -> None:
    """Time from 0 to ``end`` s, a line where the swing-up is done, bands where a hand holds it."""
    for first, last in held:
        if first < end:
            axes.axvspan(first, min(last, end), color=PALETTE["four"], alpha=0.35, linewidth=0)
    axes.set_title(title)
    axes.set_ylabel(ylabel)
    axes.set_xlabel("time [s]")
    axes.set_xlim(0, end)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    if up is not None:
        axes.axvline(up, color=PALETTE["ink"], linewidth=1, linestyle=(0, (1, 1.5)))


def _goal(axes, height: float, colour: str, text: str = "") -> None:
    """A dashed line across the axes, with what it is below its right end."""
    axes.axhline(height, color=PALETTE[colour], linewidth=1, linestyle=(0, (5, 3)), alpha=0.8)
    if text:
        axes.annotate(
            text, (1, height), xycoords=("axes fraction", "data"), xytext=(0, -3),
            textcoords="offset points", ha="right", va="top", fontsize=10, color=PALETTE[colour],
        )  # fmt: skip


def draw_angles(axes, t, x, end: float, up: float | None = None, held=()) -> None:
    """Both angles over time (n,), s, of states (n, 4), with the goal as dashed lines."""
    shown, goals = t <= end, _goals(x)
    for joint, colour in enumerate(("one", "two")):
        axes.plot(t[shown], x[shown, joint], color=PALETTE[colour], label="θ" + "₁₂"[joint])
        _goal(axes, goals[joint], colour)
    _angle_axis(axes.yaxis, np.append(x[shown, :2], goals))
    _over_time(axes, "Angles", "angle [rad]", end, up, held)
    if up is not None:
        axes.annotate(
            f"up at {up:.2f} s", (up, 0), xycoords=("data", "axes fraction"),
            xytext=(5, 5), textcoords="offset points", va="bottom", fontsize=10,
        )  # fmt: skip
    _legend(axes)


def draw_velocities(axes, t, x, end: float, up: float | None = None, held=()) -> None:
    """Both velocities over time; the goal is 0."""
    shown = t <= end
    for joint, colour in enumerate(("one", "two")):
        axes.plot(t[shown], x[shown, 2 + joint], color=PALETTE[colour], label="ω" + "₁₂"[joint])
    _goal(axes, 0, "muted")
    _over_time(axes, "Velocities", "velocity [rad/s]", end, up, held)
    _legend(axes)


def draw_torque(
    axes, t, u, joint: int, limit: float, end: float, up: float | None = None, held=()
) -> None:
    """Torque of the driven joint, N m, held between time stamps, with its limits dashed."""
    stamps = t[: len(u)]
    shown = stamps <= end
    axes.step(stamps[shown], u[shown, joint], where="post", color=PALETTE["three"])
    _goal(axes, -limit, "muted")
    _goal(axes, limit, "muted", f"limit ±{limit:g} N m")
    axes.set_ylim(-1.12 * limit, 1.12 * limit)
    _over_time(axes, "Torque", f"torque τ{'₁₂'[joint]} [N m]", end, up, held)


def draw_height(
    axes, t, y, reach: float, height: float, end: float, up: float | None = None, held=()
) -> None:
    """Height of the end effector over time, and the line that it has to cross.

    Args:
        axes: to draw on.
        t, y: (n,) s, and m above joint 1.
        reach: m, what it reaches when it is stretched.
        height: the line, as a fraction of ``reach``.
        end, up: s, of the time axis and of the swing-up; None without success.
        held: (n, 2) s, from when to when somebody holds the arm.
    """
    shown = t <= end
    axes.plot(t[shown], y[shown], color=PALETTE["ink"])
    _goal(axes, height * reach, "three", f"{height:g} line")
    axes.set_ylim(-1.12 * reach, 1.12 * reach)
    _over_time(axes, "Height of the end effector", "height [m]", end, up, held)


def draw_phase(axes, x, joint: int) -> None:
    """Velocity over angle of one joint, from rest to the goal."""
    angle, velocity, goal = x[:, joint], x[:, 2 + joint], _goals(x)[joint]
    axes.plot(angle, velocity, color=PALETTE[("one", "two")[joint]], linewidth=1.4)
    mark = {"color": PALETTE["ink"], "marker": "o", "linestyle": "none", "markeredgewidth": 1.6}
    axes.plot(angle[0], velocity[0], label="start", markersize=6, **mark)
    # The ring lies around the dot where start and goal are the same angle, as of joint 2.
    axes.plot(goal, 0, label="goal", markersize=14, markerfacecolor="none", **mark)
    _angle_axis(axes.xaxis, np.append(angle, goal))
    number = "₁₂"[joint]
    axes.set_xlabel(f"angle θ{number} [rad]")
    axes.set_ylabel(f"velocity ω{number} [rad/s]")
    axes.set_title(f"Phase portrait, joint {joint + 1}")
    _legend(axes)


# --- learning ------------------------------------------------------------------------------


def _thousands(value: float, _position: int = 0) -> str:
    """Steps: "250k", "1.5M"."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def _calm(axes, least: float = 0.01) -> None:
    """Make an axis span at least this share of its values, so that noise does not fill it."""
    low, high = axes.get_ylim()
    missing = least * max(abs(low), abs(high)) - (high - low)
    if missing > 0:
        axes.set_ylim(low - missing / 2, high + missing / 2)


def _log_axis(axes) -> None:
    """A logarithmic axis with plain numbers."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.yaxis.set_major_locator(LogLocator(subs=(1,) if high > 300 * low else (1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


Curves = Mapping[str, Sequence[tuple[np.ndarray, np.ndarray]]]


def draw_curves(
    axes, title: str, curves: Curves, *, xlabel: str, ylabel: str = "", log: bool = False
) -> None:
    """Learning curves: label -> for every seed what is on x and on y, each (n,).

    One seed is drawn as it is. Of several, every one is thin, and the interquartile mean over
    those x that all have is thick, in its bootstrap band.
    """
    for (label, seeds), colour in zip(curves.items(), ("one", "two", "three"), strict=False):
        seeds = [(x, y) for x, y in seeds if len(x)]
        several = len(seeds) > 1
        for x, y in seeds:
            thin = {"linewidth": 0.8, "alpha": 0.55} if several else {"label": label}
            marker = "o" if len(x) == 1 else None
            axes.plot(x, y, color=PALETTE[colour], marker=marker, **thin)
        if several:
            common = sorted(set.intersection(*(set(x.tolist()) for x, _ in seeds)))
            ys = np.array([[y[list(x).index(at)] for at in common] for x, y in seeds])
            low, high = interval(ys)
            axes.fill_between(common, low, high, color=PALETTE[colour], alpha=0.22, linewidth=0)
            mean = interquartile_mean(ys)
            axes.plot(common, mean, color=PALETTE[colour], linewidth=2.6, label=label)
    positive = any(np.any(y > 0) for seeds in curves.values() for _, y in seeds)
    if log and positive:
        _log_axis(axes)
    else:
        _calm(axes)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(_thousands))
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.set_title(title)
    if len(curves) > 1:
        _legend(axes)
