"""What people watch on the terminal: the console, and live progress."""

import time
from typing import NoReturn

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

__all__ = ["LiveProgress", "console"]


class _Console(Console):
    def on_broken_pipe(self) -> NoReturn:
        """Let the command line see that nobody reads any more, like of every other output."""
        raise BrokenPipeError


# Progress and tables go to standard error, so that standard output stays machine-readable.
# Nothing is markup: names of files hold brackets.
console = _Console(stderr=True, markup=False, emoji=False, highlight=False)
if console.width < 40:  # no room for the tables: let the terminal break their lines
    console.width = 80


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
            console.print(f"{self.title}: {self.note}")
        return self

    def __exit__(self, *exception):
        self.bar.__exit__(*exception)

    def report(self, done: int, note: str) -> None:
        """Say that ``done`` of the total is done, and what came of it."""
        self.bar.update(self.task, completed=done, note=note)
        if not console.is_terminal:
            seconds = time.perf_counter() - self.started
            line = f"{self.title} {done:,}/{self.total:,}  {seconds:.0f} s  {note}"
            console.print(line, soft_wrap=True)
