"""Tables for people, on standard error, so that standard output stays machine-readable."""

import datetime
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from rich import box
from rich.table import Table
from rich.text import Text

from ..terminal import console

if TYPE_CHECKING:
    from ..boards import Board
    from ..identification import Identified

__all__ = [
    "hardware_table", "identified_table", "leaderboard_table", "robustness_table", "runs_table",
    "score_table", "seeds_table",
]  # fmt: skip

HEADINGS_OF_RUNS = ("run", "robot", "stages", "seed", "state", "score", "time", "date")
COLOURS = {"finished": "green", "running": "cyan", "interrupted": "yellow", "broken": "red"}


def _table(*headings: str, **look: Any) -> Table:
    """A table with a column of text, then columns of numbers."""
    table = Table(**look)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left")
    return table


def score_table(results: Mapping[str, Mapping], board: "Board") -> None:
    """Print results of ``score.official``, a column each, and the published scores."""
    from ..boards import HEADINGS  # loads jax

    how = f"mean of {board.draws} draws" if board.draws > 1 else "float64"
    table = _table("", *results, title=f"{board.robot}, {board.name}: score ({how})")
    table.add_row("score", *(Text(f"{r['score']:.4f}", "bold") for r in results.values()))
    table.add_row("success", *("yes" if r.get("success") else "no" for r in results.values()))
    for name in board.columns:
        heading, unit, form, _ = HEADINGS[name]
        cells = (_criterion(result, name, form) for result in results.values())
        table.add_row(f"{heading} [{unit}]", *cells)
    robust = any("standing" in result for result in results.values())
    if robust:
        table.add_row("stands [%]", *map(_standing, results.values()))
    console.print(table)
    if robust:
        text = "stands: in random scenarios, what a stage began with → ended with"
        console.print(f"{text}; SNES begins behind the guard", style="dim")
    if board.published:
        published = ", ".join(f"{title} {score:.3f}" for title, score, _ in board.published)
        console.print(f"published: {published}", style="dim")


def _criterion(result: Mapping[str, Any], name: str, form: str) -> str:
    """A criterion of a run; empty if an older run has none, "-" for when a failed one stood."""
    if name == "swingup_time" and not result.get("success"):
        return "-"
    value = result["criteria"].get(name)
    return "" if value is None else format(value, form)


def _standing(result: Mapping[str, Any]) -> str:
    """Before and after a stage."""
    found = result.get("standing")
    return f"{100 * found['before']:.1f} → {100 * found['after']:.1f}" if found else ""


def robustness_table(result: Mapping[str, Any], board: "Board") -> None:
    """Print six percentages and the overall score of a robustness report (``as_dict``)."""
    from ..boards import CRITERIA  # loads jax

    title = f"{board.robot}, {board.name}: robustness, {result['simulations']} runs"
    title += f" of {board.task.duration:g} s"
    table = _table("", "score [%]", "range over keys [%]", "diverged", title=title)
    over = result["over_keys"]
    several = len(over["overall"]) > 1

    def spread(values: Sequence[float] | None) -> str:
        if not several or not values:
            return ""
        return f"{100 * min(values):.1f} to {100 * max(values):.1f}"

    for name, found in result["criteria"].items():
        drawn = spread(over["scores"].get(name))
        score = f"{100 * result['scores'][name]:.1f}"
        table.add_row(CRITERIA.get(name, name), score, drawn, str(found["diverged"]))
    overall = Text(f"{100 * result['overall']:.1f}", "bold")
    table.add_row("Overall", overall, spread(over["overall"]), "")
    console.print(table)
    seconds = f"{result['run_seconds']:.1f} s for {len(over['overall'])} key" + "s" * several
    median = "scores are medians over the keys; " if several else ""
    console.print(f"{median}{seconds}, compiled in {result['compile_seconds']:.1f} s", style="dim")
    worst = result.get("worst")
    if worst:
        values = ", ".join(f"{k} = {v:.3g}" for k, v in (worst["values"] or {}).items())
        console.print(f"{100 * worst['failures']:.1f} % of combined imperfections fail; {values}")


def hardware_table(result: Mapping[str, Any], name: str) -> None:
    """Print a ``fleet.Fleet`` (``as_dict``): how many robots stand in each condition."""
    title = f"{result['robot']}, {name}: {result['robots']} robots, {result['preset']}"
    table = _table("", "stand [%]", "95 % [%]", "score", "down [s]", "diverged", title=title)
    for condition, found in result["conditions"].items():
        low, high = (100 * end for end in found["interval"])
        down = "" if found["down"] is None else f"{found['down']:.2f}"
        share = Text(f"{100 * found['success']:.1f}", "bold")
        row = (share, f"{low:.1f} to {high:.1f}", f"{found['score']:.3f}", down)
        table.add_row(condition, *row, str(found["diverged"]))
    console.print(table)
    console.print("down: below the line after it was first reached, where it stands", style="dim")


def identified_table(found: "Identified", nominal: Mapping[str, float]) -> None:
    """Print what was fitted, beside where the search began."""
    table = _table("", "identified", "+-", "before", title=f"{found.windows} windows")
    for name, spread in found.deviations.items():
        value = found.delay if name == "delay" else found.parameters[name]
        before = f"{nominal.get(name, 0.0):.6g}"
        table.add_row(name, Text(f"{value:.6g}", "bold"), f"{spread:.2g}", before)
    console.print(table)
    angles, velocities = found.noise
    console.print(f"left over: {angles:.2g} rad, {velocities:.2g} rad/s (rms)", style="dim")


def leaderboard_table(result: Mapping[str, Any], board: "Board") -> None:
    """Print a ``leaderboard.leaderboard``: two tables that fit a terminal of 80 columns.

    That of the robustness only if it was measured.
    """
    from ..boards import CRITERIA, HEADINGS  # loads jax
    from ..leaderboard import cells

    # Words below one another, so that all columns fit.
    short = [f"{name}\n[{unit}]" for _, unit, _, name in map(HEADINGS.__getitem__, board.columns)]
    six = [name.replace(" ", "\n").replace("Perturbations", "Pulses") for name in CRITERIA.values()]
    how = f"mean of {board.draws} draws" if board.draws > 1 else "performance (float64)"
    parts = {how: (["score", *short], slice(0, 1 + len(short)))}
    if any(row["source"] == "measured" and row["robustness"] for row in result["rows"]):
        parts["robustness"] = ([*six, "all six"], slice(1 + len(short), None))
    for title, (headings, part) in parts.items():
        table = Table(
            title=f"{board.robot}, {board.name}: {title}", box=box.SIMPLE_HEAD, pad_edge=False,
            show_edge=False, padding=(0, 1, 0, 0), caption="* published" * bool(board.published),
        )  # fmt: skip
        table.add_column("controller", overflow="fold")
        for heading in headings:
            table.add_column(heading, justify="right", no_wrap=True)
        for row in result["rows"]:
            published = row["source"] == "published"
            name = row["title"] + "*" * published
            table.add_row(
                name, *cells(row, board.columns)[1:][part], style="dim" if published else None
            )
        console.print(table)


def runs_table(entries: Sequence[Mapping[str, Any]]) -> None:
    """Print what ``runs.reader.listing`` found, a row a run."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    rows = [_row(run) for run in entries]
    columns = list(zip(HEADINGS_OF_RUNS, *rows, strict=True))
    widths, room = [max(map(len, cells)) for cells in columns], console.width - 2 * len(columns) + 2
    # Where there is no room, cells break between words; the name of a run, which is there to be
    # copied, gets what is left.
    for place in map(HEADINGS_OF_RUNS.index, ("date", "state", "stages")):
        if sum(widths) > room:
            widths[place] = max(map(len, " ".join(columns[place]).split()))
    widths[0] = max(min(widths[0], room - sum(widths[1:])), 8)
    for heading, width in zip(HEADINGS_OF_RUNS, widths, strict=True):
        right = heading in ("score", "time")
        justify: Literal["left", "right"] = "right" if right else "left"
        table.add_column(heading, justify=justify, overflow="fold", width=width)
    for run, row in zip(entries, rows, strict=True):
        table.add_row(*(Text(cell, COLOURS[run["state"]] * (i == 4)) for i, cell in enumerate(row)))
    console.print(table)
    if any("runs" in run for run in entries):
        console.print("the score of several seeds is the median of those finished", style="dim")


def _row(run: Mapping[str, Any]) -> tuple[str, ...]:
    """What is said of a run, in the order of ``HEADINGS_OF_RUNS``."""
    seed = f"{len(run['seed'])} seeds" if "runs" in run else run["seed"]
    return (
        run["run"],
        run["robot"] or "",
        ", ".join(name.upper() for name in run["stages"]),
        "" if seed is None else str(seed),
        f"{run['state']}: {run['at']}" if run["at"] else run["state"],
        "" if run["score"] is None else f"{run['score']:.4f}",
        "" if run["seconds"] is None else f"{run['seconds']:.0f} s",
        f"{datetime.datetime.fromisoformat(run['changed']):%d %b %H:%M}",
    )


def seeds_table(group: Mapping[str, Any]) -> None:
    """Print a ``runs.statistics.summary``."""
    title = f"{group['robot']}: official score of {len(group['seeds'])} seeds"
    headings = ("", "median", "interquartile mean", "95 %", "lowest to highest")
    table = _table(*headings, title=title)
    for found in group["stages"].values():
        ends = (found["interval"], (found["lowest"], found["highest"]))
        points = (f"{found[key]:.4f}" for key in ("median", "interquartile_mean"))
        ranges = ("" if e is None else f"{e[0]:.4f} to {e[1]:.4f}" for e in ends)
        table.add_row(found["heading"], *points, *ranges)
    console.print(table)
