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
from ..robustness import KEYS
from ..runs.reader import RunRecord, StageRecord, remarks
from ..runs.statistics import interquartile_mean, interval
from . import figures
from .animation import gif, keyframes
from .charts import draw_angles, draw_curves, draw_height, draw_phase, draw_torque, draw_velocities
from .judged import Judged, criteria_costs, judge

__all__ = ["write"]

LABELS = tuple(f"{what} over time" for what in ("angles", "velocities", "torque", "height"))


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


def _learning(runs: Sequence[RunRecord]) -> Iterator[tuple[str, Any]]:
    """Title of a stage, and a chart: a function of axes. Of several runs, the first column."""
    # Seeds have the same stages; of an old run that has just begun, not all charts are known.
    for stage in max((run.stages for run in runs), key=lambda s: sum(len(x.charts) for x in s)):
        for title, columns, ylabel, log in stage.charts:
            shown = list(columns.items())
            if len(runs) > 1:
                title += f", {shown[0][0]}" * (len(shown) > 1)
                shown = shown[:1]
            curves = {label: [_curve(run, stage, name) for run in runs] for label, name in shown}
            curves = {k: v for k, v in curves.items() if any(len(x) for x, _ in v)}
            if curves:
                options = {"xlabel": stage.unit, "ylabel": ylabel, "log": log}
                yield stage.title, partial(draw_curves, title=title, curves=curves, **options)


# --- the swing-up ----------------------------------------------------------------------------


def _swing_charts(judged: Judged, board: Board, end: float) -> list[Callable]:
    """Angles, velocities, torque and height up to ``end`` s: functions of axes."""
    task = board.task
    limit, reach = task.torque_limit, float(task.plant.length.sum())
    options = {"end": end, "up": judged.up}
    line = {"y": judged.points[:, 1, 1], "reach": reach, "height": task.height}
    return [
        partial(draw_angles, t=judged.t, x=judged.x, **options),
        partial(draw_velocities, t=judged.t, x=judged.x, **options),
        partial(draw_torque, t=judged.t, u=judged.u, joint=task.joint, limit=limit, **options),
        partial(draw_height, t=judged.t, **line, **options),
    ]


def _draw(judged: Judged, board: Board, title: str, folder: Path) -> dict[str, list[str]]:
    """Charts of a swing-up and of robustness for the page; the same as files in ``folder``."""
    end, task = judged.window, board.task
    first = _swing_charts(judged, board, end)
    phases = [partial(draw_phase, x=judged.x, joint=joint) for joint in (0, 1)]
    rest = _swing_charts(judged, board, judged.whole) if end < judged.whole else []
    whole = [f"{label}, the whole run" for label in LABELS]
    drawn = {
        "first": _svgs("first", first, LABELS, title),
        "phase": _svgs("phase", phases, [f"phase portrait of joint {n}" for n in (1, 2)], title),
        "whole": _svgs("whole", rest, whole, title),
    }
    sheet = figures.stack(first, size=(7.0, 2.4), title=title)
    figures.save(sheet, folder / "swingup.png")
    figures.save(figures.stack(phases, columns=2, title=title), folder / "phase.png")
    reach = float(task.plant.length.sum())
    gif(folder / "swingup.gif", judged.t, judged.points, reach, task.height, end=end)
    if judged.report:
        figures.write_robustness(judged.report, folder)
        label = f"{title}: fraction of runs that end upright along every grid of the benchmark"
        drawn["strips"] = [figures.svg(figures.strips_figure(judged.report), "strips", label)]
    return drawn


def _svgs(part: str, draws: Sequence[Any], labels: Sequence[str], title: str) -> list[str]:
    """Charts as elements of the page, with ids and words for a screen reader."""
    return [
        figures.svg(figures.panel(draw), f"{part}{k}", f"{title}: {label}")
        for k, (draw, label) in enumerate(zip(draws, labels, strict=False))
    ]


def _film(
    runs: Sequence[RunRecord], judged: Sequence[Judged | None], shown: int, board: Board
) -> dict[str, Any]:
    """What the page plays: every seed that has a policy."""
    task = board.task
    known = [(run.name, j) for run, j in zip(runs, judged, strict=True) if j]
    return {
        "joint": task.joint,
        "reach": float(task.plant.length.sum()),
        "height": task.height,
        "limit": task.torque_limit,
        "first": [name for name, _ in known].index(runs[shown].name),
        "runs": [
            {"name": name} | keyframes(j.t, j.x, j.u, j.points, task.joint, j.up)
            for name, j in known
        ],
    }


# --- tables ----------------------------------------------------------------------------------


def _ranking(board: Board, own: Sequence[tuple[str, float, float | None]]) -> list[dict]:
    """Published rows and our own, the best score first."""
    rows = [(*row, False) for row in board.published] + [(*row, True) for row in own]
    names = ("title", "score", "robustness", "own")
    return [dict(zip(names, row, strict=True)) for row in sorted(rows, key=lambda r: -r[1])]


def _seed_table(runs: Sequence[RunRecord], judged: Sequence[Judged | None]) -> list[dict]:
    """A row for every seed."""
    rows = []
    for run, found in zip(runs, judged, strict=True):
        seconds = [stage.get("seconds") for stage in run.results.values()]
        rows.append(
            {
                "name": run.name,
                "finished": run.result is not None,
                "judged": found,
                "robustness": found and found.robustness,
                "seconds": sum(filter(None, seconds)) or None,
            }
        )
    return rows


def _summary(values: Sequence[float | None]) -> dict[str, float] | None:
    """Median, interquartile mean with its interval, and range, of those that are there."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    low, high = interval(known)
    summary = {"median": np.median(known), "mean": interquartile_mean(known), "low": low}
    summary |= {"high": high, "least": min(known), "most": max(known)}
    return {name: float(value) for name, value in summary.items()}


# --- writing -------------------------------------------------------------------------------


def _board(run: RunRecord) -> Board:
    """The v2 board of a run's robot; of a run on a plant of its own, on that, and unpublished."""
    official, plant = boards.v2(run.robot), run.made_by.get("plant")
    if not plant or plant == dict(official.task.parameters):
        return official
    name = run.config.get("plant") or run.config.get("design") or "a plant of its own"
    return Board(f"{official.name} on {name}", official.task.of(plant))


def _legible(text: str) -> str:
    """Text that can be written as UTF-8: names of files may have bytes that are none."""
    return text.encode("utf-8", "replace").decode()


def write(
    runs: Sequence[RunRecord],
    folder: Path,
    *,
    title: str,
    robustness: bool = True,
    keys: int = KEYS,
    board: Board | None = None,
) -> Path:
    """Judge what the runs have left, and write ``report.html`` and the pictures of ``report/``.

    Args:
        runs: one run, or the seeds of one configuration.
        folder: to write into.
        title: name of the run, or of the folder of seeds.
        robustness: run the benchmark for every seed.
        keys: of the benchmark; what is reported is the median over them.
        board: to judge on; by default the v2 board of the runs' robot.

    Returns:
        The path of the page.
    """
    pictures, title = folder / "report", _legible(title)
    runs = [dataclasses.replace(run, name=_legible(run.name)) for run in runs]
    board = _board(runs[0]) if board is None else board
    judged = [judge(run, board, keys if robustness else 0) for run in runs]
    rows = _seed_table(runs, judged)
    shown = max((k for k, j in enumerate(judged) if j), key=lambda k: judged[k].score, default=None)
    made_by = runs[0].made_by
    context = _about(runs, rows, board, title)
    learning = list(_learning(runs))
    if learning:
        heading = f"{board.robot}, {title}"
        sheet = figures.stack([draw for _, draw in learning], columns=3, title=heading)
        figures.save(sheet, pictures / "learning.png")
        context["learning"] = [
            (
                stage,
                figures.svg(figures.panel(d), f"learning{k}", f"{stage}: {d.keywords['title']}"),
            )
            for k, (stage, d) in enumerate(learning)
        ]
    if shown is not None:
        if "command" not in made_by:
            made_by = judged[shown].header.get("provenance", {})
        context |= _best(runs, judged, rows, shown, board, title)
        heading = f"{board.robot}, {runs[shown].name}"
        context["charts"] = _draw(judged[shown], board, heading, pictures)
        context["files"] = sorted(path.name for path in pictures.iterdir())
    page = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxpend.report"), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.ChainableUndefined,
    ).get_template("report.html")  # fmt: skip
    path = folder / "report.html"
    write_atomically(path, page.render(context, made_by=made_by))
    return path


def _about(runs: Sequence[RunRecord], rows: list[dict], board: Board, title: str) -> dict[str, Any]:
    """What the page says of the runs, whether there is a policy or not."""
    changed = runs[0].made_by.get("changed", {})
    return {
        "title": title,
        "robot": board.robot,
        "board": board.name,
        "published": bool(board.published),
        "score_name": f"official {board.name} score" if board.published else board.name,
        "height": board.task.height,
        "duration": board.task.duration,
        "rate": round(1 / board.task.dt),
        "remarks": remarks(runs),
        "finished": all(run.result or not run.config for run in runs),
        "seeds": rows if len(runs) > 1 else [],
        "stages": runs[0].results if len(runs) == 1 else {},
        "config": [{"name": n, "value": v, "default": d} for n, (v, d) in changed.items()],
        "whole_config": flat(runs[0].config),
        "versions": {"jaxpend": __version__, "jax": jax.__version__, "numpy": np.__version__},
    }


def _best(runs, judged, rows, shown: int, board: Board, title: str) -> dict[str, Any]:
    """What the page says where there is a policy: about the best one, and about all."""
    best, run = judged[shown], runs[shown]
    scores = _summary([j and j.score for j in judged])
    robust = _summary([row["robustness"] for row in rows])
    own = [(run.name, best.score, best.robustness)]
    if len(runs) > 1:  # the best of several is no fair row alone
        own.append((f"mean of {title}", scores["mean"], robust and robust["mean"]))
    six = best.report["scores"] if best.report else {}
    return {
        "best": best,
        "shown": run.name,
        "seconds": rows[shown]["seconds"],
        "window": best.window,
        "keys": len(best.report["over_keys"]["overall"]) if best.report else 0,
        "scores": scores,
        "robust": robust,
        "criteria": criteria_costs(best, board),
        "six": {CRITERIA.get(name, name): share for name, share in six.items()},
        "ranking": _ranking(board, own),
        "film": _film(runs, judged, shown, board),
    }
