"""The page of ``jaxpend.report``: policies judged, charts drawn, HTML and pictures written."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jinja2
import numpy as np

from .. import __version__
from ..boards import HEADINGS, v2
from ..config import GradientRun, SACRun, SNESRun, TrainRun
from ..config_files import to_mapping
from ..controllers.files import load_controller, read_header
from ..designs import competition
from ..files import write_atomically
from ..robots import active_joint
from ..robustness import CRITERIA, benchmark
from ..runs.reader import RunRecord, StageRecord, remarks
from ..runs.statistics import interquartile_mean, interval
from ..score import V2_OFFICIAL, nominal_run, score_v2
from . import figures as plots
from .animation import gif, keyframes
from .charts import draw_angles, draw_curves, draw_height, draw_phase, draw_torque, draw_velocities

__all__ = ["Judged", "judge", "write"]


@dataclasses.dataclass(frozen=True)
class Judged:
    """A policy on the plant of the v2 boards, in float64, and in the robustness benchmark."""

    score: float
    criteria: dict[str, float]
    success: bool
    t: Any  # (n,) s
    x: Any  # (n, 4) rad, rad/s
    u: Any  # (n - 1, 2) N m
    header: dict  # of the policy file
    robustness: dict | None

    @property
    def up(self) -> float | None:
        """Swing-up time, s; None without success."""
        return self.criteria["swingup_time"] if self.success else None


def judge(found: RunRecord, robustness: bool = True) -> Judged | None:
    """The swing-up of the best policy so far, its official score (float64) and its robustness.

    None where there is no policy yet. The policies of several seeds share one compilation.
    """
    if found.policy is None:
        return None

    with jax.enable_x64(True):
        run, c = nominal_run(load_controller(found.policy, robot=found.robot), v2(found.robot).task)
        score = float(score_v2(c))
    report = None
    if robustness:
        policy = load_controller(found.policy, robot=found.robot)
        nominal = competition(found.robot)
        report = benchmark(policy, nominal, jax.random.key(0)).as_dict()
    x = np.asarray(run.x)
    whole = np.isfinite(x).all(axis=1).cumprod().sum()  # samples until it diverged, if it did
    return Judged(
        score=score,
        criteria={name: float(value) for name, value in vars(c).items() if name != "success"},
        success=bool(c.success),
        t=np.asarray(run.t)[:whole],
        x=x[:whole],
        u=np.asarray(run.u)[: whole - 1],
        header=read_header(found.policy),
        robustness=report and {"robot": found.robot} | report,
    )


def _curve(run: RunRecord, stage: StageRecord, column: str):
    """Two arrays: what is on x and on y, where the column has a number.

    The column "best" is the best official score so far, those of earlier stages included.
    """
    scores = {stage.name: stage.scores for stage in run.stages}
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


def _swing_charts(judged: Judged, robot: str, end: float) -> list[Any]:
    """Angles, velocities, torque and height up to ``end`` s: functions of axes."""
    joint, plant = active_joint(robot), competition(robot)
    limit, length = float(plant.torque_limit[joint]), np.asarray(plant.length)
    options = {"end": end, "up": judged.up}
    return [
        partial(draw_angles, t=judged.t, x=judged.x, **options),
        partial(draw_velocities, t=judged.t, x=judged.x, **options),
        partial(draw_torque, t=judged.t, u=judged.u, joint=joint, limit=limit, **options),
        partial(draw_height, t=judged.t, x=judged.x, length=length, **options),
    ]


def _window(judged: Judged) -> float:
    """How much of a run shows its swing-up, whole seconds."""
    whole = float(round(judged.t[-1]))
    return whole if judged.up is None else min(whole, max(3.0, float(round(2.5 * judged.up))))


def _criteria(judged: Judged) -> list[dict]:
    """The five criteria of the score, and what each costs of it."""
    share = {n: math.tanh(math.pi * judged.criteria[n] / norm) for n, norm in V2_OFFICIAL.items()}
    share = {n: value if math.isfinite(value) else 1.0 for n, value in share.items()}
    return [
        {
            "title": title,
            "value": f"{judged.criteria[name]:{form}}",
            "unit": unit,
            "cost": share[name] / len(share),
        }
        for name, (title, unit, form) in HEADINGS.items()
    ]


def _board(robot: str, own: Sequence[tuple[str, float, float | None]]) -> list[dict]:
    """Published rows and our own, the best score first."""

    rows = [(*row, False) for row in v2(robot).published]
    rows += [(*row, True) for row in own]
    names = ("title", "score", "robustness", "own")
    return [dict(zip(names, row, strict=True)) for row in sorted(rows, key=lambda r: -r[1])]


def _flat(config: Mapping, prefix: str = "") -> dict[str, Any]:
    flat = {}
    for name, value in config.items():
        deeper = isinstance(value, Mapping)
        flat |= _flat(value, f"{prefix}{name}.") if deeper else {prefix + name: value}
    return flat


def _changed(config: Mapping) -> list[tuple[str, Any, Any]]:
    """Fields that are not as the package has them by default: name, value, default."""

    kinds = (SACRun, GradientRun, SNESRun, TrainRun)
    fields = {kind: {field.name for field in dataclasses.fields(kind)} for kind in kinds}
    kind = min(kinds, key=lambda kind: len(fields[kind] ^ config.keys()))
    default = _flat(to_mapping(kind(robot=config["robot"]))) if config else {}
    return [
        (name, value, default.get(name, ""))
        for name, value in _flat(config).items()
        if name not in default or default[name] != value
    ]


# --- writing -------------------------------------------------------------------------------


def _draw(judged: Judged, robot: str, name: str, folder: Path) -> dict[str, list[str]]:
    """Charts of a swing-up and of robustness for the page; the same as files in ``folder``."""
    end, whole = _window(judged), float(round(judged.t[-1]))
    phases = [partial(draw_phase, x=judged.x, joint=joint) for joint in (0, 1)]
    charts = {
        "first": _swing_charts(judged, robot, end),
        "phase": phases,
        "whole": _swing_charts(judged, robot, whole) if end < whole else [],
    }
    title = f"{robot}, {name}"
    wide = {"size": (7.0, 2.4), "title": title}
    plots.save(plots.stack(_swing_charts(judged, robot, end), **wide), folder / "swingup.png")
    plots.save(plots.stack(phases, columns=2, title=title), folder / "phase.png")
    length = competition(robot).length
    gif(folder / "swingup.gif", judged.t, judged.x, length, end=end)
    if judged.robustness:
        plots.write_robustness(judged.robustness, folder)
    over_time = [f"{what} over time" for what in ("angles", "velocities", "torque", "height")]
    labels = {
        "first": over_time,
        "phase": ["phase portrait of joint 1", "phase portrait of joint 2"],
        "whole": [f"{label}, the whole run" for label in over_time],
    }
    drawn = {
        part: [
            plots.svg(plots.panel(draw), f"{part}{k}", f"{title}: {labels[part][k]}")
            for k, draw in enumerate(draws)
        ]
        for part, draws in charts.items()
    }
    if judged.robustness:
        label = f"{title}: fraction of runs that end upright along every grid of the benchmark"
        drawn["strips"] = [plots.svg(plots.strips_figure(judged.robustness), "strips", label)]
    return drawn


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
                "robustness": found and found.robustness and found.robustness["overall"],
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


def write(runs: Sequence[RunRecord], folder: Path, *, title: str, robustness: bool = True) -> Path:
    """Judge what the runs have left, and write ``report.html`` and the pictures of ``report/``.

    Args:
        runs: one run, or the seeds of one configuration.
        folder: to write into.
        title: name of the run, or of the folder of seeds.
        robustness: run the benchmark for every seed.

    Returns:
        The path of the page.
    """
    pictures, robot = folder / "report", runs[0].robot
    judged = [judge(run, robustness) for run in runs]
    rows = _seed_table(runs, judged)
    shown = max((k for k, j in enumerate(judged) if j), key=lambda k: judged[k].score, default=None)
    made_by = runs[0].made_by
    learning = list(_learning(runs))
    if learning:
        sheet = plots.stack([draw for _, draw in learning], columns=3, title=f"{robot}, {title}")
        plots.save(sheet, pictures / "learning.png")
    context = {
        "title": title,
        "robot": robot,
        "remarks": remarks(runs),
        "finished": all(run.result or not run.config for run in runs),
        "seeds": rows if len(runs) > 1 else [],
        "stages": runs[0].results if len(runs) == 1 else {},
        "learning": [
            (stage, plots.svg(plots.panel(d), f"learning{k}", f"{stage}: {d.keywords['title']}"))
            for k, (stage, d) in enumerate(learning)
        ],
        "config": [{"name": n, "value": v, "default": d} for n, v, d in _changed(runs[0].config)],
        "whole_config": _flat(runs[0].config),
        "versions": {"jaxpend": __version__, "jax": jax.__version__, "numpy": np.__version__},
    }
    if shown is not None:
        made_by = made_by or judged[shown].header.get("provenance", {})
        context |= _best(runs, judged, rows, shown, title)
        context["charts"] = _draw(judged[shown], robot, runs[shown].name, pictures)
        context["files"] = sorted(path.name for path in pictures.iterdir())
    page = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxpend.report"), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.ChainableUndefined,
    ).get_template("report.html")  # fmt: skip
    path = folder / "report.html"
    write_atomically(path, page.render(context, made_by=made_by))
    return path


def _best(runs, judged, rows, shown: int, title: str) -> dict[str, Any]:
    """What the page says where there is a policy: about the best one, and about all."""
    best, run = judged[shown], runs[shown]
    scores = _summary([j and j.score for j in judged])
    robust = _summary([row["robustness"] for row in rows])
    own = [(run.name, best.score, rows[shown]["robustness"])]
    if len(runs) > 1:  # the best of several is no fair row alone
        own.append((f"mean of {title}", scores["mean"], robust and robust["mean"]))
    six = best.robustness["scores"] if best.robustness else {}
    return {
        "best": best,
        "shown": run.name,
        "seconds": rows[shown]["seconds"],
        "window": _window(best),
        "scores": scores,
        "robust": robust,
        "criteria": _criteria(best),
        "six": {CRITERIA[name]: share for name, share in six.items()},
        "board": _board(run.robot, own),
        "film": _film(runs, judged, shown),
    }


def _film(runs: Sequence[RunRecord], judged: Sequence[Judged | None], shown: int) -> dict[str, Any]:
    """What the page plays: every seed that has a policy."""
    robot = runs[0].robot
    plant, joint = competition(robot), active_joint(robot)
    known = [(run.name, j) for run, j in zip(runs, judged, strict=True) if j]
    return {
        "joint": joint,
        "length": np.asarray(plant.length, float).round(6).tolist(),
        "limit": float(plant.torque_limit[joint]),
        "first": [name for name, _ in known].index(runs[shown].name),
        "runs": [{"name": n} | keyframes(j.t, j.x, j.u, joint, j.up) for n, j in known],
    }
