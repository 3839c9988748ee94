"""What several seeds say together: median, interquartile mean with its interval, range."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from .reader import RESULTS
from .statistics import interquartile_mean, interval
from ..terminal import console

__all__ = ["seeds_table", "summary"]


def _aggregate(scores: Sequence[float]) -> dict:
    """The numbers of one stage; there is no interval of one seed."""
    return {
        "scores": list(scores),
        "median": float(np.median(scores)),
        "interquartile_mean": float(interquartile_mean(scores)),
        "interval": np.array(interval(scores)).tolist() if len(scores) > 1 else None,
        "lowest": min(scores),
        "highest": max(scores),
    }


def summary(results: Sequence[Mapping]) -> dict:
    """Results of the seeds of one robot as one: the scores and their statistics, a stage each.

    ``interval`` is the 95 % bootstrap interval of the interquartile mean.
    """
    stages = [name for name in RESULTS if name in results[0]]
    return {
        "robot": results[0]["robot"],
        "seeds": [result["seed"] for result in results],
        "stages": {name: _aggregate([r[name]["score"] for r in results]) for name in stages},
    }


def seeds_table(group: Mapping) -> None:
    """Print a ``summary``."""
    table = Table(title=f"{group['robot']}: official v2 score of {len(group['seeds'])} seeds")
    headings = ("", "median", "interquartile mean", "95 %", "lowest to highest")
    for heading in headings:
        table.add_column(heading, justify="right" if heading else "left")
    for name, found in group["stages"].items():
        ends = (found["interval"], (found["lowest"], found["highest"]))
        points = (f"{found[key]:.4f}" for key in ("median", "interquartile_mean"))
        ranges = ("" if e is None else f"{e[0]:.4f} to {e[1]:.4f}" for e in ends)
        table.add_row(RESULTS[name], *points, *ranges)
    console.print(table)
