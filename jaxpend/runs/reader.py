"""What run folders hold, read from their files alone and without jax.

A run says of its own stages what people want to see of them (``stage.Stage.about``, in
``run.json``). Runs of version 0.1 say nothing; what can be shown of them is guessed from their
configuration and metrics. Whatever is in the files, what cannot be read is one sentence.
"""

import contextlib
import dataclasses
import datetime
import fcntl
import json
import os
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import JaxpendError
from ..robots import ROBOTS, SHIPPED

__all__ = [
    "RunRecord", "StageRecord", "Unreadable", "find", "listing", "read_json", "read_result",
    "read_rows", "read_run", "remarks", "seed_folders",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class StageRecord:
    """What a run says of one of its stages, as in ``stage.Stage``."""

    name: str
    title: str
    unit: str
    column: str
    total: int
    heading: str
    charts: tuple[tuple[str, dict[str, str], str, bool], ...]  # as in ``stage.Chart``
    scores: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """What one run has left on disk so far."""

    name: str
    robot: str
    config: dict[str, Any]  # empty for a policy without a run
    stages: tuple[StageRecord, ...]
    rows: list[dict[str, Any]]  # of metrics.jsonl, numbers only, in the order of the stages
    result: dict[str, Any] | None  # None: not finished
    policy: str | None  # path, or robot for what ships with the package; None: none yet
    # Texts (command, version), the ``plant``, and what is ``changed``: name -> value, default.
    made_by: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def progress(self) -> dict[str, tuple[int, int]]:
        """Name of a stage -> how far it is, and how far it is to go, which it may go beyond."""
        done = {}
        for stage in self.stages:
            steps = [row[stage.column] for row in self.rows if row["stage"] == stage.name]
            done[stage.name] = (min(max(steps, default=0), stage.total), stage.total)
        return done

    @property
    def results(self) -> dict[str, dict[str, Any]]:
        """Heading -> official result of what the run started from, and of its stages."""
        headings = {"start": "start"} | {s.name: s.heading for s in self.stages if s.heading}
        result = self.result or {}
        return {title: result[name] for name, title in headings.items() if name in result}


# --- from files to values of the right types -----------------------------------------------


class Unreadable(JaxpendError):
    """A file of a run that is not what it should be."""

    def __init__(self, path: Path, what: str):
        super().__init__(f"{path} is not {what}; the run cannot be read")
        self.path = path


def read_json(path: Path) -> Any:
    """What a file says; None: there is no such file. Raises ``Unreadable``."""
    try:
        return json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, RecursionError):
        raise Unreadable(path, "valid JSON") from None


# Shapes of what files say, for ``_has``.
CHART = (str, {...: str}, str, bool)
STAGE = {
    "name": str, "title": str, "unit": str, "column": str, "total": float, "heading": str,
    "charts": [CHART], "scores": [str],
}  # fmt: skip
SAID = {"stages": [STAGE], "plant": {...: float}, "changed": {...: (object, object)}}


def _number(value: Any) -> bool:
    """Whether it is a number that can be shown and drawn."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) < 1e300  # which NaN is not


def _has(shape: Any, value: Any) -> bool:
    """Whether a value of JSON has a shape.

    It is a type (``float``: whatever is a ``_number``), ``[of all items]``, ``(of each item,)``,
    ``{name: of this value}`` or ``{...: of all values}``.
    """
    if isinstance(shape, list):
        return isinstance(value, list) and all(_has(shape[0], item) for item in value)
    if isinstance(shape, tuple):
        return isinstance(value, list) and len(value) == len(shape) and all(map(_has, shape, value))
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return False
        parts = dict.fromkeys(value, shape[...]) if ... in shape else shape
        return all(_has(part, value.get(name)) for name, part in parts.items())
    return _number(value) if shape is float else isinstance(value, shape)


def _config(folder: Path) -> dict[str, Any]:
    path = folder / "config.json"
    config = read_json(path)
    if not isinstance(config, dict) or config.get("robot") not in list(ROBOTS):
        raise Unreadable(path, "the configuration of a run")
    return config


def read_result(path: Path) -> dict[str, Any] | None:
    """What ``result.json`` says; None: the run is not finished. Raises ``Unreadable``."""

    def sound(part):
        fits = _has({"score": float}, part) and _number(part.get("seconds") or 0)
        up = {"criteria": {"swingup_time": float}}
        return fits and (not part.get("success") or _has(up, part))

    result = read_json(path)
    if result is None and not path.exists():
        return None
    whole = _has({"score": float}, result)
    if whole and all(sound(result[k]) for k in result.keys() - {"robot", "seed", "score"}):
        return result
    raise Unreadable(path, "the result of a run")


def _stage(said: Mapping[str, Any]) -> StageRecord:
    values = {name: said[name] for name in STAGE}
    values |= {"charts": tuple(map(tuple, said["charts"])), "scores": tuple(said["scores"])}
    return StageRecord(**values)


def _guessed(config: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> list[StageRecord]:
    """The stages of a run of version 0.1: sections of its configuration that have a total.

    A row of its metrics has the stage, the seconds, what counts, and then what was measured.
    """
    totals: dict[str, Any] = {}
    for name, section in config.items():
        if isinstance(section, dict):
            shown = section.get("demonstrations")
            if isinstance(shown, dict) and shown.get("episodes", 1):
                totals["imitation"] = shown.get("updates")
            totals[name] = section.get("steps", section.get("generations"))
    stages = []
    for name, total in totals.items():
        if not (_number(total) and total):
            continue
        keys = dict.fromkeys(key for row in rows if row.get("stage") == name for key in row)
        column, *others = [key for key in keys if key not in ("stage", "seconds")] or ["step"]
        title = name.upper() if len(name) < 5 else name.capitalize()
        shown = [key for key in others if key not in ("rollbacks", "finite")]
        charts = [(key.replace("_", " "), {key: key}, "", False) for key in shown]
        scores = [key for key in others if key in ("score", "mean_score", "individual_score")]
        heading = "" if name == "imitation" else f"after {title}"
        words = (name, title, column.replace("_", " "), column, total, heading)
        stages.append(StageRecord(*words, tuple(charts), tuple(scores)))
    return stages


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of metrics with their numbers; what a crash cut off, and what is no row, is left out."""
    rows = []
    try:
        lines = path.read_text().splitlines()
    except (OSError, ValueError):
        return []
    for line in lines:
        with contextlib.suppress(ValueError, RecursionError):
            row = json.loads(line)
            if isinstance(row, dict) and isinstance(row.get("stage"), str):
                rows.append({k: v for k, v in row.items() if k == "stage" or _number(v)})
    return rows


def read_run(folder: Path) -> RunRecord:
    """A run folder. Raises ``Unreadable`` for a file in it that is not what it should be."""
    config, rows, path = _config(folder), read_rows(folder / "metrics.jsonl"), folder / "run.json"
    said = {} if (said := read_json(path)) is None else said
    blank: dict[str, Any] = {"stages": [], "plant": {}, "changed": {}}
    if not (isinstance(said, dict) and _has(SAID, blank | said)):
        raise Unreadable(path, "what a run says of itself")
    stages = list(map(_stage, said["stages"])) if "stages" in said else _guessed(config, rows)
    order = {stage.name: (k, stage.column) for k, stage in enumerate(stages)}
    once = {}  # a row that came twice counts once
    for row in rows:
        k, column = order.get(row["stage"], (0, ""))
        if column in row:
            once[k, row[column]] = row
    policies = ["policy.npz", *(f"{stage.name}_best.npz" for stage in reversed(stages))]
    return RunRecord(
        name=folder.name,
        robot=config["robot"],
        config=config,
        stages=tuple(stages),
        rows=[once[key] for key in sorted(once)],
        result=read_result(folder / "result.json"),
        policy=next((str(folder / n) for n in policies if (folder / n).exists()), None),
        made_by={k: v for k, v in said.items() if isinstance(v, str) or k in ("plant", "changed")},
    )


def seed_folders(folder: Path) -> list[Path]:
    """The runs of a group of seeds, in the order of the seeds."""
    parts = (path.parent for path in folder.glob("seed*/config.json"))
    return sorted(parts, key=lambda p: (len(p.name), p.name))


def find(run: Path) -> list[RunRecord]:
    """The runs that a path means: a run folder, a folder of seeds, a policy file, or a robot's
    name for the policy that ships with the package.

    Raises:
        JaxpendError: it is none of these, or cannot be read.
    """
    from ..controllers.files import read_header  # loads jax

    if seeds := seed_folders(run):
        return [read_run(seed) for seed in seeds]
    if (run / "config.json").exists():
        return [read_run(run)]
    if run.is_file() or (str(run) in SHIPPED and not run.exists()):
        header = read_header(run)
        made_for = header.get("provenance", {}).get("config")
        board = made_for.get("board") if isinstance(made_for, dict) else None
        record = RunRecord(run.stem, header["robot"], {}, (), [], None, str(run))
        return [dataclasses.replace(record, made_by={"board": board} if board else {})]
    raise JaxpendError(
        f"{run} is not a run: give a folder that training has left (with config.json), a folder "
        f"of seeds, a policy file, or {' or '.join(ROBOTS)} for the policy that ships"
    )


def remarks(runs: Sequence[RunRecord]) -> list[str]:
    """What is not finished, or went wrong on the way, a sentence each."""
    sentences = []
    for run in runs:
        if run.config and run.result is None:
            done = run.progress
            at = [
                f"{s.title} is at {done[s.name][0]:,} of {s.total:,} {s.unit}" for s in run.stages
            ]
            diverged = " and diverged" * any(row.get("finite") == 0 for row in run.rows)
            sentences.append(f"{run.name} is not finished{diverged}: {', '.join(at)}.")
        if back := max((row.get("rollbacks", 0) for row in run.rows), default=0):
            text = f"{run.name} diverged and went back to its last good state {back} time"
            sentences.append(f"{text}{'s' * (back > 1)}.")
    return sentences


# --- the list of runs ----------------------------------------------------------------------


def _locked(folder: Path) -> bool:
    """Whether a process works on the run. Its lock is tried only while the process is there."""
    with contextlib.suppress(OSError, ValueError, OverflowError), (folder / ".lock").open() as file:
        os.kill(int(file.read()), 0)
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _changed(folder: Path) -> str:
    """When a file in it was last written, as ISO 8601."""
    times = []
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            with contextlib.suppress(OSError):  # it is gone already
                times.append(path.lstat().st_mtime)
    newest = max(times, default=folder.stat().st_mtime)
    return datetime.datetime.fromtimestamp(newest).astimezone().isoformat(timespec="seconds")


def _entry(folder: Path) -> dict[str, Any]:
    """One run folder as plain values; ``state`` is finished, running, interrupted or broken."""
    about: dict[str, Any] = {"run": folder.name, "robot": None, "stages": [], "seed": None}
    about |= {"state": "broken", "at": None, "score": None, "seconds": None}
    about["changed"] = _changed(folder)
    try:
        config = _config(folder)
        seed = config.get("seed")
        about |= {"robot": config["robot"], "seed": seed if isinstance(seed, int) else None}
        run = read_run(folder)
    except Unreadable as error:
        return about | {"at": error.path.name}
    last = run.rows[-1] if run.rows else {}
    about["stages"] = [stage.name for stage in run.stages if stage.heading]
    about["seconds"] = last.get("seconds")
    if run.result is not None:
        return about | {"state": "finished", "score": run.result["score"]}
    here = [stage for stage in run.stages if stage.name == last.get("stage")]
    at = f"{here[0].title} {last[here[0].column]:,}/{here[0].total:,}" if here else "the start"
    return about | {"state": "running" if _locked(folder) else "interrupted", "at": at}


def _group(folder: Path) -> dict[str, Any]:
    """A group of seeds: its median score, and its runs."""
    runs = [_entry(part) for part in seed_folders(folder)]
    scores = [run["score"] for run in runs if run["score"] is not None]
    states = [run["state"] for run in runs]
    worst = next(s for s in ("broken", "running", "interrupted", "finished") if s in states)
    return runs[0] | {
        "run": folder.name,
        "seed": [run["seed"] for run in runs],
        "state": worst,
        "at": None if worst == "finished" else f"{states.count('finished')} of {len(runs)} seeds",
        "score": statistics.median(scores) if scores else None,
        "seconds": sum(run["seconds"] or 0 for run in runs),
        "changed": max(run["changed"] for run in runs),
        "runs": runs,
    }


def _natural(path: Path) -> list[Any]:
    """For sorting by name, the numbers in it by their value."""
    return [int(x) if x.isdecimal() else x for x in re.split(r"(\d+)", path.name)]


def listing(folder: str | Path) -> list[dict[str, Any]]:
    """The runs in a folder, by name; a group of seeds is one entry, with its ``runs``.

    Raises:
        JaxpendError: there is no such folder, or no run in it.
    """
    folder, entries = Path(folder), []
    if not folder.is_dir():
        raise JaxpendError(f"there is no folder {folder}; jaxpend train makes runs")
    for path in sorted((p for p in folder.iterdir() if p.is_dir()), key=_natural):
        with contextlib.suppress(PermissionError):  # whatever it is, it is not ours
            if (path / "config.json").exists():
                entries.append(_entry(path))
            elif seed_folders(path):
                entries.append(_group(path))
    if not entries:
        raise JaxpendError(f"there are no runs in {folder}; jaxpend train makes runs")
    return entries
