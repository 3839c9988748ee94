"""The page of ``jaxpend report``: charts drawn, HTML and pictures written."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jinja2
import numpy as np

from .. import __version__, boards
from ..boards import CRITERIA, Board
from ..config_files import flat
from ..files import write_atomically
from ..hardware import PRESETS
from ..runs.reader import RunRecord, StageRecord, remarks
from ..runs.statistics import interquartile_mean, interval
from . import figures
from .animation import gif, keyframes
from .charts import draw_angles, draw_curves, draw_height, draw_phase, draw_torque, draw_velocities
from .judged import Judged, criteria_costs, judge

__all__ = ["write"]

Draw = Callable[..., None]  # of axes


# --- learning ------------------------------------------------------------------------------


def _curve(run: RunRecord, stage: StageRecord, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays: what is on x and on y, where the column has a number.

    The column "best" is the best official score so far, those of earlier stages included.
    """
    scores = {known.name: known.scores for known in run.stages}
    top, points = -math.inf, []
    for row in run.rows:
        if row.get("finite") == 0:
            continue
        top = max([top, *(row[name] for name in scores[row["stage"]] if name in row)])
        y = top if column == "best" else row.get(column)
        if row["stage"] == stage.name and y is not None and math.isfinite(y):
            points.append((row[stage.column], y))
    return np.array([x for x, _ in points]), np.array([y for _, y in points])


def _learning(runs: Sequence[RunRecord]) -> Iterator[tuple[str, Draw]]:
    """Title of a stage, and a chart. Of several runs, the first column."""
    # Seeds have the same stages; of an old run that has just begun, not all charts are known.
    for stage in max((run.stages for run in runs), key=lambda s: sum(len(x.charts) for x in s)):
        for title, columns, ylabel, log in stage.charts:
            shown, title = list(columns.items()), f"{stage.title}: {title}"
            if len(runs) > 1:
                title += f", {shown[0][0]}" * (len(shown) > 1)
                shown = shown[:1]
            curves = {label: [_curve(run, stage, name) for run in runs] for label, name in shown}
            curves = {k: v for k, v in curves.items() if any(len(x) for x, _ in v)}
            draw = partial(draw_curves, xlabel=stage.unit, ylabel=ylabel, log=log)
            if curves:
                yield stage.title, partial(draw, title=title, curves=curves)


# --- the swing-up ----------------------------------------------------------------------------


def _swing_charts(judged: Judged, end: float) -> list[Draw]:
    """Angles, velocities, torque and height up to ``end`` s."""
    task, t, y = judged.task, judged.t, judged.points[:, 1, 1]
    charts: list[Draw] = [
        partial(draw_angles, x=judged.x),
        partial(draw_velocities, x=judged.x),
        partial(draw_torque, u=judged.u, joint=task.joint, limit=task.torque_limit),
        partial(draw_height, y=y, reach=judged.reach, height=task.height),
    ]
    return [partial(draw, t=t, end=end, up=judged.up, held=judged.held) for draw in charts]


def _svg(draw: Draw, name: str, title: str) -> str:
    """A chart as an element of the page; its own title follows ``title`` for a screen reader."""
    figure = figures.panel(draw)
    return figures.svg(figure, name, f"{title}: {figure.axes[0].get_title('left')}")


def _draw(judged: Judged, title: str, folder: Path) -> dict[str, list[str]]:
    """Charts of a swing-up and of robustness for the page; the same as files in ``folder``."""
    first = _swing_charts(judged, judged.window)
    phases: list[Draw] = [partial(draw_phase, x=judged.x, joint=joint) for joint in (0, 1)]
    rest = _swing_charts(judged, judged.whole) if judged.window < judged.whole else []
    parts = {"first": (first, title), "phase": (phases, title)}
    parts["whole"] = rest, f"{title}, the whole run"
    drawn = {
        part: [_svg(draw, f"{part}{k}", label) for k, draw in enumerate(charts)]
        for part, (charts, label) in parts.items()
    }
    figures.save(figures.stack(first, size=(7.0, 2.4), title=title), folder / "swingup.png")
    figures.save(figures.stack(phases, columns=2, title=title), folder / "phase.png")
    gif(folder / "swingup.gif", judged)
    if judged.report:
        figures.write_robustness(judged.report, folder)
        label = f"{title}: fraction of runs that end upright along every grid of the benchmark"
        drawn["strips"] = [figures.svg(figures.strips_figure(judged.report), "strips", label)]
    if judged.fleet:
        figures.write_hardware(judged.fleet, folder)
        charts = figures.along(judged.fleet)
        drawn["fleet"] = [_svg(draw, f"fleet{k}", title) for k, draw in enumerate(charts)]
    return drawn


# --- tables ----------------------------------------------------------------------------------


def _summary(values: Sequence[float | None]) -> dict[str, Any]:
    """Median, interquartile mean with its interval, and range, of those that are there."""
    known = [value for value in values if value is not None]
    if not known:
        return {}
    summary = {"median": np.median(known), "mean": interquartile_mean(known)}
    return summary | {"interval": interval(known), "range": (min(known), max(known))}


def _seconds(run: RunRecord) -> float:
    """Wall clock of all stages, s; 0 where it is not known."""
    return sum(stage.get("seconds") or 0 for stage in run.results.values())


# --- writing -------------------------------------------------------------------------------


def _board(run: RunRecord) -> Board:
    """The board of a run; of a run on a plant of its own, on that, and unpublished."""
    plant, on = run.made_by.get("plant"), run.config.get("board") or run.made_by.get("board")
    official = boards.named_board(run.robot, on if on in boards.BOARDS else "v2")
    spread = PRESETS.get(str(run.config.get("preset")))
    if spread and official.task.spread:
        task = dataclasses.replace(official.task, spread=spread)
        name = f"{official.name}, {run.config['preset']}"
        name = official.name if spread == official.task.spread else name
        official = dataclasses.replace(official, name=name, task=task)
    if not plant or plant == dict(official.task.parameters):
        return official
    name = run.config.get("plant") or run.config.get("design") or "a plant of its own"
    name, task = f"{official.name} on {name}", official.task.of(plant)
    return dataclasses.replace(official, name=name, task=task, published=())


def _legible(text: str) -> str:
    """Text that can be written as UTF-8: names of files may have bytes that are none."""
    return text.encode("utf-8", "replace").decode()


def write(
    runs: Sequence[RunRecord],
    folder: Path,
    *,
    title: str,
    robustness: bool = True,
    board: Board | None = None,
    controller: str | None = None,
) -> Path:
    """Judge what the runs have left, and write ``report.html`` and the pictures of ``report/``.

    Args:
        runs: one run, or the seeds of one configuration.
        folder: to write into.
        title: name of the run, or of the folder of seeds.
        robustness: run the benchmark for every seed; what is reported is the median over keys.
        board: to judge on; by default the runs' own.
        controller: judged with the runs' policies, or instead of them; as in ``judge``.

    Returns:
        The path of the page.
    """
    pictures, title = folder / "report", _legible(title)
    runs = [dataclasses.replace(run, name=_legible(run.name)) for run in runs]
    board = _board(runs[0]) if board is None else board
    judged = [judge(run, board, robustness, controller) for run in runs]
    known = [(run, found) for run, found in zip(runs, judged, strict=True) if found]
    context = _about(runs, judged, board, title)
    learning = list(_learning(runs))
    if learning:
        draws = [draw for _, draw in learning]
        sheet = figures.stack(draws, columns=3, title=f"{board.robot}, {title}")
        figures.save(sheet, pictures / "learning.png")
        context["learning"] = [
            (stage, _svg(draw, f"learning{k}", stage)) for k, (stage, draw) in enumerate(learning)
        ]
    if known:
        run, best = max(known, key=lambda pair: pair[1].score)
        if "command" not in runs[0].made_by:
            context["made_by"] = best.header.get("provenance", {})
        context |= _best(known, run, best, board, title if len(runs) > 1 else "")
        context["charts"] = _draw(best, f"{board.robot}, {run.name}", pictures)
        context["files"] = sorted(path.name for path in pictures.iterdir())
    page = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxpend.report"), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.ChainableUndefined,
    ).get_template("report.html")  # fmt: skip
    path = folder / "report.html"
    write_atomically(path, page.render(context))
    return path


def _about(
    runs: Sequence[RunRecord], judged: Sequence[Judged | None], board: Board, title: str
) -> dict[str, Any]:
    """What the page says of the runs, whether there is a policy or not."""
    seeds = [(run, found, _seconds(run)) for run, found in zip(runs, judged, strict=True)]
    return {
        "title": title,
        "board": board,
        "remarks": remarks(runs),
        "finished": all(run.result or not run.config for run in runs),
        "seeds": seeds if len(runs) > 1 else [],
        "stages": runs[0].results if len(runs) == 1 else {},
        "made_by": runs[0].made_by,
        "changed": runs[0].made_by.get("changed", {}),
        "whole_config": flat(runs[0].config),
        "versions": {"jaxpend": __version__, "jax": jax.__version__, "numpy": np.__version__},
    }


def _best(
    known: Sequence[tuple[RunRecord, Judged]], run: RunRecord, best: Judged, board: Board,
    group: str,
) -> dict[str, Any]:  # fmt: skip
    """What the page says where there is a policy: about the best one, and about all of a group."""
    scores = _summary([found.score for _, found in known])
    robust = _summary([found.robustness for _, found in known])
    own = [(run.name, best.score, best.robustness)]
    if group:  # the best of several is no fair row alone
        own.append((f"mean of {group}", scores["mean"], robust.get("mean")))
    ranking = [*((*row, False) for row in board.published), *((*row, True) for row in own)]
    six = best.report["scores"] if best.report else {}
    film = {"joint": board.task.joint, "reach": best.reach, "height": board.task.height}
    film |= {"limit": board.task.torque_limit, "first": [r.name for r, _ in known].index(run.name)}
    return {
        "best": best,
        "shown": run.name,
        "seconds": _seconds(run),
        "keys": len(best.report["over_keys"]["overall"]) if best.report else 0,
        "scores": scores,
        "robust": robust,
        "criteria": criteria_costs(best),
        "six": {CRITERIA.get(name, name): share for name, share in six.items()},
        "fleet": best.fleet,
        "units": figures.UNITS,
        "ranking": sorted(ranking, key=lambda row: -row[1]),
        "film": film | {"runs": [{"name": r.name} | keyframes(found) for r, found in known]},
    }
