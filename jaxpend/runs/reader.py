"""What run folders hold, read from their files alone."""

import contextlib
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

__all__ = ["RESULTS", "STAGES", "listing", "runs_table", "seed_folders"]

# Stage -> column of the metrics that says how far it is, field of the configuration it goes to.
STAGES = {
    "sac": ("env_steps", "steps"),
    "gradient": ("step", "steps"),
    "snes": ("generation", "generations"),
}
# What ``result.json`` may have scores of, and how people call it.
RESULTS = {
    "start": "start",
    "sac": "after SAC",
    "gradient": "after the gradient",
    "snes": "after SNES",
}


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def _locked(folder: Path) -> bool:
    """Whether a process works on the run. Its lock is tried only while the process is there."""
    with contextlib.suppress(OSError, ValueError), (folder / ".lock").open() as file:
        os.kill(int(file.read()), 0)
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _progress(folder: Path, config: Mapping) -> tuple[str, float | None]:
    """How far the metrics go, and the seconds of their last row."""
    for line in reversed(_lines(folder / "metrics.jsonl")):
        with contextlib.suppress(ValueError, KeyError, TypeError):  # what a crash cut off
            row = json.loads(line)
            if row["stage"] == "imitation":
                at, of = row["updates"], config["sac"]["demonstrations"]["updates"]
                return f"imitation {at:,}/{of:,}", row.get("seconds")
            column, total = STAGES[row["stage"]]
            of = config[row["stage"]][total]
            return f"{row['stage'].upper()} {row[column]:,}/{of:,}", row.get("seconds")
    return "the start", None


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        return []


def _run(folder: Path, name: str) -> dict[str, Any]:
    """One run folder as plain values; ``state`` is finished, running, interrupted or broken."""
    about = {"run": name, "robot": None, "stages": [], "seed": None, "state": "broken"}
    about |= {"at": None, "score": None, "seconds": None}
    config, result = _json(folder / "config.json"), _json(folder / "result.json")
    newest = max(p.stat().st_mtime for p in folder.iterdir())
    changed = datetime.datetime.fromtimestamp(newest).astimezone()
    about["changed"] = changed.isoformat(timespec="seconds")
    if not isinstance(config, dict) or "robot" not in config:
        return about | {"at": "config.json"}
    about |= {"robot": config["robot"], "seed": config.get("seed")}
    about["stages"] = [
        stage
        for stage, (_, total) in STAGES.items()
        if isinstance(config.get(stage), dict) and config[stage].get(total, 1)
    ]
    at, about["seconds"] = _progress(folder, config)
    if isinstance(result, dict) and isinstance(result.get("score"), int | float):
        return about | {"state": "finished", "score": result["score"]}
    if (folder / "result.json").exists():
        return about | {"at": "result.json"}
    return about | {"state": "running" if _locked(folder) else "interrupted", "at": at}


def seed_folders(folder: Path) -> list[Path]:
    """The runs of a group of seeds, in the order of the seeds."""
    parts = [path.parent for path in folder.glob("seed*/config.json")]
    return sorted(parts, key=lambda p: (len(p.name), p.name))


def _group(folder: Path, name: str) -> dict[str, Any]:
    """A group of seeds: its median score, and its runs."""
    runs = [_run(part, part.name) for part in seed_folders(folder)]
    scores = [run["score"] for run in runs if run["score"] is not None]
    states = [run["state"] for run in runs]
    worst = next(s for s in ("broken", "running", "interrupted", "finished") if s in states)
    return {
        "run": name,
        "robot": runs[0]["robot"],
        "stages": runs[0]["stages"],
        "seed": [run["seed"] for run in runs],
        "state": worst,
        "at": None if worst == "finished" else f"{states.count('finished')} of {len(runs)} seeds",
        "score": statistics.median(scores) if scores else None,
        "seconds": sum(run["seconds"] or 0 for run in runs),
        "changed": max(run["changed"] for run in runs),
        "runs": runs,
    }


def listing(folder: str | Path) -> list[dict[str, Any]]:
    """The runs in a folder, by name; a group of seeds is one entry, with its ``runs``.

    Raises:
        JaxpendError: there is no such folder, or no run in it.
    """
    folder, entries = Path(folder), []
    if not folder.is_dir():
        raise JaxpendError(f"there is no folder {folder}; jaxpend train makes runs")
    natural = lambda p: [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", p.name)]  # noqa: E731
    for path in sorted((p for p in folder.iterdir() if p.is_dir()), key=natural):
        if (path / "config.json").exists():
            entries.append(_run(path, path.name))
        elif seed_folders(path):
            entries.append(_group(path, path.name))
    if not entries:
        raise JaxpendError(f"there are no runs in {folder}; jaxpend train makes runs")
    return entries


def runs_table(entries: Sequence[Mapping[str, Any]]) -> None:
    """Print runs, a row each, on standard error like all tables."""
    from rich import box
    from rich.table import Table

    from ..terminal import console

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("run", "robot", "stages", "seed", "state", "score", "time", "changed"):
        right = heading in ("score", "time")
        table.add_column(heading, justify="right" if right else "left", overflow="fold")
    colours = {"finished": "green", "running": "cyan", "interrupted": "yellow", "broken": "red"}
    groups = False
    for run in entries:
        groups |= "runs" in run
        seed = f"{len(run['seed'])} seeds" if "runs" in run else run["seed"]
        state = f"[{colours[run['state']]}]{run['state']}[/]"
        date = datetime.datetime.fromisoformat(run["changed"])
        table.add_row(
            run["run"], run["robot"] or "", ", ".join(s.upper() for s in run["stages"]),
            "" if seed is None else str(seed),
            f"{state}: {run['at']}" if run["at"] else state,
            "" if run["score"] is None else f"{run['score']:.4f}",
            "" if run["seconds"] is None else f"{run['seconds']:.0f} s",
            f"{date:%d %b %H:%M}",
        )  # fmt: skip
    console.print(table)
    if groups:
        console.print("the score of several seeds is the median of those finished", style="dim")
