"""Pictures, and the CSV and JSON files beside them. Imported only by commands that draw."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.figure import Figure

from .cli import emit_json
from .files import write_atomically
from .robustness import CRITERIA
from .variations import VARIATIONS

__all__ = ["map_figure", "robustness_figure", "save", "write_robustness"]

# From failure to success, told apart by eyes of every kind: dark red, pale, dark blue.
COLOURS = "RdYlBu"


def save(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write a figure as PNG, atomically."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    write_atomically(path, buffer.getvalue())


def _bars(axes, result: dict[str, Any], first: bool) -> None:
    """The six scores and the overall one, with the range over keys as whiskers."""
    over, names = result["over_keys"], list(reversed(CRITERIA))
    titles = ["Overall", *(CRITERIA[name] for name in names)]
    values = [result["overall"], *(result["scores"][name] for name in names)]
    ranges = [over["overall"], *(over["scores"].get(n, [result["scores"][n]]) for n in names)]
    colours = ["#333333"] + ["#4575b4"] * len(CRITERIA)
    axes.barh(range(len(values)), values, color=colours, height=0.7)
    for y, (value, spread) in enumerate(zip(values, ranges, strict=True)):
        if len(spread) > 1:
            axes.plot([min(spread), max(spread)], [y, y], color="#fdae61", linewidth=2)
        end = max([value, *spread])
        inside = end > 0.85
        axes.text(
            min(value, min(spread)) - 0.015 if inside else end + 0.015, y, f"{100 * value:.1f}",
            va="center", ha="right" if inside else "left", color="white" if inside else "black",
            fontsize=8,
        )  # fmt: skip
    axes.set_yticks(range(len(titles)), titles if first else [""] * len(titles), fontsize=8)
    axes.set_xlim(0, 1)
    axes.set_xticks([0, 0.5, 1], ["0", "50", "100 %"], fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(result["robot"], fontsize=11, fontweight="bold")


def _strips(axes, result: dict[str, Any], first: bool) -> Any:
    """One row a grid: every value coloured by the fraction of its runs that succeed."""
    rows = [
        (name, grid)
        for criterion in CRITERIA
        for name, grid in result["criteria"][criterion]["grids"].items()
    ]
    for y, (name, grid) in enumerate(rows):
        success, values = np.array(grid["success"]), grid["values"]
        random_series = name == "perturbation"
        success = np.sort(success)[::-1] if random_series else success
        image = axes.imshow(
            success[None], extent=(0, 1, y + 0.42, y - 0.42), aspect="auto", cmap=COLOURS,
            vmin=0, vmax=1, interpolation="nearest",
        )  # fmt: skip
        ends = (
            ("", f"{len(values)} series")
            if random_series
            else (f"{values[0]:.3g}", f"{values[-1]:.3g}")
        )
        axes.text(-0.01, y, ends[0], ha="right", va="center", fontsize=6, color="#555555")
        axes.text(1.01, y, ends[1], ha="left", va="center", fontsize=6, color="#555555")
    axes.set_xlim(-0.16, 1.2)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xticks([])
    labels = [_label(name) for name, _ in rows]
    axes.set_yticks(range(len(rows)), labels if first else [""] * len(rows), fontsize=8)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    return image


def _label(name: str) -> str:
    kind = VARIATIONS[name]
    if name == "perturbation":
        return "perturbations"
    return f"{kind.title} [{kind.unit}]" if kind.unit else kind.title


def robustness_figure(results: Sequence[dict[str, Any]]) -> Figure:
    """Scores and success along every grid, a column for each result (one robot or both).

    ``results`` are ``Report.as_dict()`` with the name of the ``robot`` added.
    """
    figure = Figure(figsize=(2.2 + 3.6 * len(results), 7.2), layout="constrained")
    grid = figure.add_gridspec(2, len(results), height_ratios=[1, 2.2])
    for column, result in enumerate(results):
        _bars(figure.add_subplot(grid[0, column]), result, first=column == 0)
        axes = figure.add_subplot(grid[1, column])
        image = _strips(axes, result, first=column == 0)
    bar = figure.colorbar(image, ax=figure.axes, location="bottom", shrink=0.5, aspect=40, pad=0.02)
    bar.set_label("fraction of runs that end upright", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return figure


def map_figure(result: dict[str, Any]) -> Figure:
    """Success over two imperfections: ``result["map"]`` of the robustness command."""
    (x_name, x), (y_name, y) = result["map"]["values"].items()
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    axes = figure.add_subplot()
    success = np.array(result["map"]["success"]).T
    image = axes.pcolormesh(x, y, success, cmap=COLOURS, vmin=0, vmax=1, shading="nearest")
    axes.set_xlabel(_label(x_name))
    axes.set_ylabel(_label(y_name))
    axes.set_title(f"{result['robot']}: success over two imperfections", fontsize=10)
    figure.colorbar(image, ax=axes, label="fraction of runs that end upright")
    return figure


def _table(result: dict[str, Any]) -> str:
    """The grids as CSV, a row for every value."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    scored = any(
        "performance" in g for c in result["criteria"].values() for g in c["grids"].values()
    )
    writer.writerow(
        ["robot", "criterion", "imperfection", "unit", "value", "success"]
        + ["performance"] * scored
    )
    for criterion, found in result["criteria"].items():
        for name, grid in found["grids"].items():
            columns = [grid["values"], grid["success"], *([grid["performance"]] if scored else [])]
            for value, *numbers in zip(*columns, strict=True):
                unit = VARIATIONS[name].unit
                writer.writerow([result["robot"], criterion, name, unit, value, *numbers])
    return text.getvalue()


def write_robustness(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write picture, CSV and JSON of a result; with the other robot's JSON there, both.

    Returns the paths written: ``ROBOT.json``, ``ROBOT.csv``, ``robustness.png`` (a column for
    each robot found in the folder), and ``ROBOT_map.png`` if there is a map.
    """
    robot = result["robot"]
    written = [folder / f"{robot}.json", folder / f"{robot}.csv", folder / "robustness.png"]
    emit_json(result, written[0])
    write_atomically(written[1], _table(result))
    found = [folder / f"{name}.json" for name in ("acrobot", "pendubot")]
    both = [json.loads(path.read_text()) for path in found if path.exists()]
    save(robustness_figure(both), written[2])
    if "map" in result:
        written.append(folder / f"{robot}_map.png")
        save(map_figure(json.loads(written[0].read_text())), written[-1])
    return written
