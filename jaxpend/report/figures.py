"""Pictures, and the CSV and JSON files beside them. Imported only by commands that draw.

A chart is a function that draws on the axes it is given: alone, the width of a phone, for the
page of a report (``panel`` and ``svg``), or beside others for a PNG file (``stack``). Figures are
objects that only this package holds: matplotlib's backend and the user's settings stay as they are.
"""

import csv
import io
import json
import re
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ..boards import CRITERIA
from ..files import to_json, write_atomically
from ..fleet import CONDITIONS
from ..variations import VARIATIONS, Variation

__all__ = [
    "PALETTE", "UNITS", "along", "map_figure", "panel", "robustness_figure", "save", "stack",
    "strips_figure", "svg", "write_hardware", "write_robustness",
]  # fmt: skip

# Okabe and Ito's colours, told apart by eyes of every kind. A page puts its own in their place
# (``svg``), by these names, so that it can be light or dark.
PALETTE = {
    "ink": "#1a1d21", "muted": "#5d6570", "grid": "#dfe2e6", "paper": "#fffffe",
    "one": "#0072b2", "two": "#d55e00", "three": "#009e73", "four": "#cc79a7",
}  # fmt: skip
# From failure to success: dark red, pale, dark blue.
COLOURS = "RdYlBu"
STYLE: Any = {
    "axes.edgecolor": PALETTE["muted"], "axes.labelcolor": PALETTE["ink"],
    "axes.facecolor": "none", "axes.titlecolor": PALETTE["ink"], "axes.titlelocation": "left",
    "axes.titlesize": "medium", "axes.titleweight": "bold", "axes.labelsize": "medium",
    "axes.grid": True, "axes.axisbelow": True, "axes.spines.top": False,
    "axes.spines.right": False, "axes.linewidth": 0.8, "grid.color": PALETTE["grid"],
    "grid.linewidth": 0.8, "xtick.color": PALETTE["muted"], "ytick.color": PALETTE["muted"],
    "xtick.labelcolor": PALETTE["ink"], "ytick.labelcolor": PALETTE["ink"],
    "text.color": PALETTE["ink"], "legend.frameon": False, "legend.fontsize": 10,
    "lines.linewidth": 1.8, "lines.solid_joinstyle": "round", "font.size": 11,
    "svg.fonttype": "none", "svg.hashsalt": "jaxpend", "figure.facecolor": PALETTE["paper"],
}  # fmt: skip
# Of quantities of a fleet; all others are shares of the nominal ones.
UNITS = {
    "delay": "delay [s]", "jitter": "jitter [s]", "push": "strongest push [N m]",
    "responsiveness": "response",
}  # fmt: skip
styled = matplotlib.rc_context(STYLE)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # A name may have characters that the font does not have; boxes stand for them.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(buffer, format="png", dpi=150, metadata={"Software": "jaxpend"})
    write_atomically(path, buffer.getvalue())


@styled
def svg(figure: Figure, name: str, label: str) -> str:
    """A figure as an ``<svg>`` element for a page that defines ``--ink``, ``--one``, ...

    ``name`` keeps its ids apart from those of other figures; ``label`` is what a screen reader
    says.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    for variable, colour in PALETTE.items():
        text = text.replace(colour, f"var(--{variable})")
    label = label.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    return text.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


@styled
def stack(
    draws: Sequence[Callable[..., Any]],
    columns: int = 1,
    size: tuple[float, float] = (4.4, 2.9),
    title: str = "",
) -> Figure:
    """Charts in a grid on one figure, each called with its axes; ``size`` of each in inches."""
    rows = -(-len(draws) // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    for number, draw in enumerate(draws):
        draw(figure.add_subplot(rows, columns, number + 1))
    if title:
        figure.suptitle(title, fontweight="bold", parse_math=False)
    return figure


def panel(draw: Callable[..., Any], *data: Any, **options: Any) -> Figure:
    """``draw(axes, *data, **options)`` alone on a figure."""
    return stack([lambda axes: draw(axes, *data, **options)])


# --- fleets --------------------------------------------------------------------------------


def _along(axes, name: str, found: dict[str, list[float]]) -> None:
    """The share of robots that stand over one quantity, a curve for each condition."""
    for colour, condition in zip(("one", "two"), CONDITIONS, strict=True):
        values = [100 * share for share in found[condition]]
        axes.plot(found["values"], values, "o-", color=PALETTE[colour], label=condition)
    axes.set(title=name, ylim=(-3, 103), ylabel="stand [%]")


def along(result: dict[str, Any]) -> list[Callable[..., Any]]:
    """Charts of a ``fleet.Fleet`` (``as_dict``): the share that stands over each quantity."""
    return [
        partial(_along, name=UNITS.get(name, f"{name} / nominal"), found=found)
        for name, found in result["by"].items()
    ]


def write_hardware(result: dict[str, Any], folder: Path) -> Path:
    """Picture and JSON of a ``fleet.Fleet`` (``as_dict``), in a folder; the path of the picture."""
    title = f"{result['robot']}: robots that stand, {result['preset']}"
    figure = stack(along(result), columns=4, size=(3.2, 2.4), title=title)
    figure.axes[0].legend()
    path = folder / f"{result['preset']}_{result['robot']}.png"
    folder.mkdir(parents=True, exist_ok=True)
    # The numbers first: by them the next call knows the picture.
    write_atomically(path.with_suffix(".json"), to_json(result, indent=2) + "\n")
    save(figure, path)
    return path


# --- robustness ----------------------------------------------------------------------------


def _grids(result: dict[str, Any]) -> list[tuple[str, str, Variation, dict[str, Any]]]:
    """Every grid of a result: its criterion, its name, what it varies, and the grid itself."""
    return [
        (criterion, name, VARIATIONS[grid.get("variation", name)], grid)
        for criterion, found in result["criteria"].items()
        for name, grid in found["grids"].items()
    ]


def _bars(axes, result: dict[str, Any]) -> None:
    """The six scores and the overall one: medians over keys, with the range as whiskers."""
    over, scores = result["over_keys"], result["scores"]
    names = list(reversed(scores))
    titles = ["Overall", *(CRITERIA.get(name, name) for name in names)]
    values = [result["overall"], *(scores[name] for name in names)]
    ranges = [over["overall"], *(over["scores"].get(n, [scores[n]]) for n in names)]
    colours = [PALETTE["ink"]] + [PALETTE["one"]] * len(names)
    axes.barh(range(len(values)), values, color=colours, height=0.7)
    for y, (value, spread) in enumerate(zip(values, ranges, strict=True)):
        if len(spread) > 1:
            axes.plot([min(spread), max(spread)], [y, y], color="#e69f00", linewidth=2)
        low, high = min(value, *spread), max(value, *spread)
        inside = high > 0.85
        axes.text(
            low - 0.015 if inside else high + 0.015, y, f"{100 * value:.1f}",
            va="center", ha="right" if inside else "left",
            color=PALETTE["paper" if inside else "ink"],
        )  # fmt: skip
    axes.set_yticks(range(len(values)), titles)
    axes.tick_params(axis="y", length=0)
    axes.set_xlim(0, 1)
    axes.set_xticks([0, 0.5, 1], ["0", "50", "100 %"])
    axes.grid(False)
    axes.set_title(result["robot"], loc="center")


def _strips(axes, result: dict[str, Any], margin: float = 0.18) -> Any:
    """One row a grid: every value coloured by the fraction of the first key's runs that succeed.

    ``margin`` is the room for the ends of a grid, in widths of a row.
    """
    small = {"va": "center", "fontsize": 9, "color": PALETTE["muted"]}
    labels = []
    for y, (_, _, variation, grid) in enumerate(_grids(result)):
        success, values = np.array(grid["success"]), grid["values"]
        first, last = f"{values[0]:.3g}", f"{values[-1]:.3g}"
        if variation is VARIATIONS["perturbation"]:  # random series, in no order
            success, first, last = np.sort(success)[::-1], "", f"{len(values)} series"
        image = axes.imshow(
            success[None], extent=(0, 1, y + 0.42, y - 0.42), aspect="auto", cmap=COLOURS,
            vmin=0, vmax=1, interpolation="nearest",
        )  # fmt: skip
        axes.text(-0.015, y, first, ha="right", **small)
        axes.text(1.015, y, last, ha="left", **small)
        labels.append(_label(variation))
    axes.set_xlim(-margin, 1 + 1.1 * margin)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xticks([])
    axes.set_yticks(range(len(labels)), labels)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    axes.grid(False)
    return image


def _label(variation: Variation) -> str:
    if variation is VARIATIONS["perturbation"]:
        return "perturbations"
    return f"{variation.title} [{variation.unit}]" if variation.unit else variation.title


def _success_bar(figure: Figure, image) -> None:
    bar = figure.colorbar(image, ax=figure.axes, location="bottom", shrink=0.6, aspect=40, pad=0.02)
    bar.set_label("fraction of runs that end upright")


@styled
def robustness_figure(results: Sequence[dict[str, Any]]) -> Figure:
    """Scores and success along every grid, a column for each result (one robot or both).

    ``results`` are ``Report.as_dict()`` with the name of the ``robot`` added.
    """
    figure = Figure(figsize=(3.2 + 4.4 * len(results), 9), layout="constrained")
    axes = figure.subplots(2, len(results), sharey="row", squeeze=False, height_ratios=[1, 2.2])
    for result, (upper, lower) in zip(results, axes.T, strict=True):
        _bars(upper, result)
        image = _strips(lower, result)
    _success_bar(figure, image)
    return figure


@styled
def strips_figure(result: dict[str, Any]) -> Figure:
    """Success along every grid of one result, no wider than a phone."""
    figure = Figure(figsize=(4.4, 6), layout="constrained")
    _success_bar(figure, _strips(figure.add_subplot(), result, margin=0.38))
    return figure


@styled
def map_figure(result: dict[str, Any]) -> Figure:
    """Success over two imperfections: ``result["map"]`` of the robustness command."""
    (x_name, x), (y_name, y) = result["map"]["values"].items()
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.grid(False)
    success = np.array(result["map"]["success"]).T
    image = axes.pcolormesh(x, y, success, cmap=COLOURS, vmin=0, vmax=1, shading="nearest")
    axes.set_xlabel(_label(VARIATIONS[x_name]))
    axes.set_ylabel(_label(VARIATIONS[y_name]))
    axes.set_title(f"{result['robot']}: success over two imperfections")
    figure.colorbar(image, ax=axes, label="fraction of runs that end upright")
    return figure


def _table(result: dict[str, Any]) -> str:
    """The grids as CSV, a row for every value."""
    text, grids = io.StringIO(), _grids(result)
    numbers = ["success"] + ["performance"] * any("performance" in grid for *_, grid in grids)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["robot", "criterion", "imperfection", "unit", "value", *numbers])
    for criterion, name, variation, grid in grids:
        for row in zip(grid["values"], *(grid[number] for number in numbers), strict=True):
            writer.writerow([result["robot"], criterion, name, variation.unit, *row])
    return text.getvalue()


def _is_result(path: Path) -> bool:
    """Whether a file is a result of the robustness benchmark."""
    try:
        return "over_keys" in json.loads(path.read_text())
    except (OSError, ValueError, TypeError):
        return False


def write_robustness(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write picture, CSV and JSON of a result; with the other robot's JSON there, both.

    Returns the paths written: ``ROBOT.json``, ``ROBOT.csv``, ``robustness.png`` (a column for
    each robot found in the folder), and ``ROBOT_map.png`` if there is a map.
    """
    robot = result["robot"]
    written = [folder / f"{robot}.json", folder / f"{robot}.csv", folder / "robustness.png"]
    write_atomically(written[0], to_json(result, indent=2) + "\n")
    write_atomically(written[1], _table(result))
    found = [folder / f"{name}.json" for name in ("acrobot", "pendubot")]
    both = [json.loads(path.read_text()) for path in found if _is_result(path)]
    save(robustness_figure(both), written[2])
    if "map" in result:
        written.append(folder / f"{robot}_map.png")
        save(map_figure(json.loads(written[0].read_text())), written[-1])
    return written
