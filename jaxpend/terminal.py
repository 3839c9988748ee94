"""What people read on the terminal: score tables and live progress."""

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from .boards import HEADINGS, v2

__all__ = ["LiveProgress", "console", "robustness_table", "score_table"]

# Progress and tables go to standard error, so that standard output stays machine-readable.
console = Console(stderr=True)


def score_table(results: Mapping[str, Mapping], robot: str) -> None:
    """Print official results (``score.official``), a column each, and the published scores."""
    table = Table(title=f"{robot}: official v2 score (float64)")
    table.add_column("")
    for name in results:
        table.add_column(name, justify="right")
    table.add_row("score", *(f"[bold]{r['score']:.4f}[/bold]" for r in results.values()))
    table.add_row("success", *("yes" if r["success"] else "no" for r in results.values()))
    for key, (heading, unit, form) in HEADINGS.items():
        cells = (format(r["criteria"][key], form) for r in results.values())
        table.add_row(f"{heading} \\[{unit}]", *cells)
    console.print(table)
    published = ", ".join(f"{name} {score:.3f}" for name, score, _ in v2(robot).published)
    console.print(f"published: {published}", style="dim")


def robustness_table(result: dict[str, Any], robot: str) -> None:
    """Six percentages and the overall score, on standard error like all reports."""
    from .robustness import CRITERIA  # loads jax

    table = Table(title=f"{robot}: robustness, {result['simulations']} runs of 10 s")
    for heading in ("", "score [%]", "over keys [%]", "diverged"):
        table.add_column(heading, justify="right" if heading else "left")
    over = result["over_keys"]
    several = len(over["overall"]) > 1
    for name, title in CRITERIA.items():
        drawn = over["scores"].get(name) if several else None
        spread = f"{100 * min(drawn):.1f} to {100 * max(drawn):.1f}" if drawn else ""
        diverged = str(result["criteria"][name]["diverged"])
        table.add_row(title, f"{100 * result['scores'][name]:.1f}", spread, diverged)
    spread = f"{100 * over['mean']:.1f} ± {100 * over['std']:.1f}" if several else ""
    table.add_row("Overall", f"[bold]{100 * result['overall']:.1f}[/bold]", spread, "")
    console.print(table)
    seconds = f"{result['run_seconds']:.1f} s for {len(over['overall'])} key" + "s" * several
    console.print(f"{seconds}, compiled in {result['compile_seconds']:.1f} s", style="dim")
    worst = result.get("worst")
    if worst:
        values = ", ".join(f"{k} = {v:.3g}" for k, v in (worst["values"] or {}).items())
        console.print(f"{100 * worst['failures']:.1f} % of combined imperfections fail; {values}")


class LiveProgress:
    """A progress bar on a terminal, a line per report elsewhere. Use it as a context manager.

    Until the first report it says what is going on (compilation, mostly), so that this is not
    mistaken for a hang; the time left is estimated from then on.
    """

    def __init__(self, title: str, total: int, note: str = "compiling ..."):
        self.title, self.total, self.started = title, total, time.perf_counter()
        self.bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self.task = self.bar.add_task(title, total=total, note=note)
        self.note = note

    def __enter__(self):
        self.bar.__enter__()
        if not console.is_terminal:
            console.print(f"{self.title}: {self.note}", highlight=False)
        return self

    def __exit__(self, *exception):
        self.bar.__exit__(*exception)

    def report(self, done: int, note: str) -> None:
        """Say that ``done`` of the total is done, and what came of it."""
        self.bar.update(self.task, completed=done, note=note)
        if not console.is_terminal:
            seconds = time.perf_counter() - self.started
            line = f"{self.title} {done:,}/{self.total:,}  {seconds:.0f} s  {note}"
            console.print(line, highlight=False, soft_wrap=True)
