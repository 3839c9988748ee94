"""Tables for people, on standard error, so that standard output stays machine-readable."""

import datetime
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table
from rich.text import Text

from ..terminal import console

if TYPE_CHECKING:
    from ..boards import Board

__all__ = ["leaderboard_table", "robustness_table", "runs_table", "score_table", "seeds_table"]

# Headings of ``leaderboard_table``, in the order of ``boards.HEADINGS`` and ``boards.CRITERIA``.
SHORT = ("up s", "J", "torque²", "steps", "speed²")
SHORT_ROBUSTNESS = ("model", "vel.", "torque", "resp.", "delay", "pulses")
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

    table = _table("", *results, title=f"{board.robot}, {board.name}: score (float64)")
    table.add_row("score", *(Text(f"{r['score']:.4f}", "bold") for r in results.values()))
    table.add_row("success", *("yes" if r.get("success") else "no" for r in results.values()))
    for key, (heading, unit, form) in HEADINGS.items():
        cells = (format(r["criteria"][key], form) for r in results.values())
        table.add_row(f"{heading} [{unit}]", *cells)
    console.print(table)
    if board.published:
        published = ", ".join(f"{title} {score:.3f}" for title, score, _ in board.published)
        console.print(f"published: {published}", style="dim")


def robustness_table(result: Mapping[str, Any], board: "Board") -> None:
    """Print six percentages and the overall score of a robustness report (``as_dict``)."""
    from ..boards import CRITERIA  # loads jax

    title = f"{board.robot}, {board.name}: robustness, {result['simulations']} runs"
    title += f" of {board.task.duration:g} s"
    table = _table("", "score [%]", "over keys [%]", "diverged", title=title)
    over = result["over_keys"]
    several = len(over["overall"]) > 1
    for name, found in result["criteria"].items():
        drawn = over["scores"].get(name) if several else None
        spread = f"{100 * min(drawn):.1f} to {100 * max(drawn):.1f}" if drawn else ""
        score = f"{100 * result['scores'][name]:.1f}"
        table.add_row(CRITERIA.get(name, name), score, spread, str(found["diverged"]))
    spread = f"{100 * over['mean']:.1f} ± {100 * over['std']:.1f}" if several else ""
    table.add_row("Overall", Text(f"{100 * result['overall']:.1f}", "bold"), spread, "")
    console.print(table)
    seconds = f"{result['run_seconds']:.1f} s for {len(over['overall'])} key" + "s" * several
    median = "scores are medians over the keys; " if several else ""
    console.print(f"{median}{seconds}, compiled in {result['compile_seconds']:.1f} s", style="dim")
    worst = result.get("worst")
    if worst:
        values = ", ".join(f"{k} = {v:.3g}" for k, v in (worst["values"] or {}).items())
        console.print(f"{100 * worst['failures']:.1f} % of combined imperfections fail; {values}")


def leaderboard_table(result: Mapping[str, Any], board: "Board") -> None:
    """Print a ``leaderboard.leaderboard``: two tables that fit a terminal of 80 columns.

    That of the robustness only if it was measured.
    """
    from ..leaderboard import cells  # loads jax

    parts = {"performance (float64)": ["score", *SHORT]}
    if any(row["source"] == "measured" and row["robustness"] for row in result["rows"]):
        parts["robustness"] = ["robust", *SHORT_ROBUSTNESS]
    columns = ["score", *SHORT, *SHORT_ROBUSTNESS, "robust"]
    for title, headings in parts.items():
        caption = "* published" if board.published else None
        title = f"{board.robot}, {board.name}: {title}"
        table = _table("controller", *headings, title=title, caption=caption)
        for column in table.columns:
            column.no_wrap = True
        for row in result["rows"]:
            shown = dict(zip(columns, cells(row)[1:], strict=True))
            style = "dim" if row["source"] == "published" else None
            name = row["title"] + ("*" if row["source"] == "published" else "")
            table.add_row(name, *(shown[heading] for heading in headings), style=style)
        console.print(table)


def runs_table(entries: Sequence[Mapping[str, Any]]) -> None:
    """Print what ``runs.reader.listing`` found, a row a run."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("run", "robot", "stages", "seed", "state", "score", "time", "changed"):
        right = heading in ("score", "time")
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    for run in entries:
        seed = f"{len(run['seed'])} seeds" if "runs" in run else run["seed"]
        at = f": {run['at']}" if run["at"] else ""
        state = Text.assemble((run["state"], COLOURS[run["state"]]), at)
        date = datetime.datetime.fromisoformat(run["changed"])
        table.add_row(
            run["run"], run["robot"] or "", ", ".join(s.upper() for s in run["stages"]),
            "" if seed is None else str(seed),
            state,
            "" if run["score"] is None else f"{run['score']:.4f}",
            "" if run["seconds"] is None else f"{run['seconds']:.0f} s",
            f"{date:%d %b %H:%M}",
        )  # fmt: skip
    console.print(table)
    if any("runs" in run for run in entries):
        console.print("the score of several seeds is the median of those finished", style="dim")


def seeds_table(group: Mapping[str, Any]) -> None:
    """Print a ``runs.statistics.summary``."""
    title = f"{group['robot']}: official v2 score of {len(group['seeds'])} seeds"
    headings = ("", "median", "interquartile mean", "95 %", "lowest to highest")
    table = _table(*headings, title=title)
    for found in group["stages"].values():
        ends = (found["interval"], (found["lowest"], found["highest"]))
        points = (f"{found[key]:.4f}" for key in ("median", "interquartile_mean"))
        ranges = ("" if e is None else f"{e[0]:.4f} to {e[1]:.4f}" for e in ends)
        table.add_row(found["heading"], *points, *ranges)
    console.print(table)
