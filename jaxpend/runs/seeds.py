"""The table of several seeds."""

from collections.abc import Mapping

from rich.table import Table

from ..terminal import console

__all__ = ["seeds_table"]


def seeds_table(group: Mapping) -> None:
    """Print a ``statistics.summary``."""
    table = Table(title=f"{group['robot']}: official v2 score of {len(group['seeds'])} seeds")
    headings = ("", "median", "interquartile mean", "95 %", "lowest to highest")
    for heading in headings:
        table.add_column(heading, justify="right" if heading else "left")
    for found in group["stages"].values():
        ends = (found["interval"], (found["lowest"], found["highest"]))
        points = (f"{found[key]:.4f}" for key in ("median", "interquartile_mean"))
        ranges = ("" if e is None else f"{e[0]:.4f} to {e[1]:.4f}" for e in ends)
        table.add_row(found["heading"], *points, *ranges)
    console.print(table)
