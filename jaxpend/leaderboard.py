"""``jaxpend leaderboard``: every controller on a board of a robot, next to the published rows.

Performance is the official score and its criteria (``score.official``); robustness is the
six-criterion benchmark in float32, as ``jaxpend robustness`` runs it.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax

from .boards import HEADINGS, Board
from .controller import Controller
from .controllers.catalogue import CATALOGUE, build, find_controller
from .errors import JaxpendError, choose
from .plant import Plant
from .robustness import CRITERIA, KEYS, benchmark
from .score import official
from .task import Task

__all__ = ["cells", "chosen", "judge", "leaderboard", "markdown", "published"]

Make = Callable[[Plant], Controller]


def published(board: Board) -> list[dict[str, Any]]:
    """The published rows of a board: title, score and robustness."""
    return [
        {"title": title, "source": "published", "score": score, "robustness": robustness}
        for title, score, robustness in board.published
    ]


def judge(
    make: Make, board: Board, *, robustness: bool = True, keys: int = KEYS, seed: int = 0
) -> dict[str, Any]:
    """Performance (float64) and robustness (float32) of a controller, as plain numbers.

    Args:
        make: called as ``make(plant)`` under either precision; gives the controller.
        board: to judge it on.
        robustness: run the benchmark too: seconds for a feedback law, minutes for MPC.
        keys, seed: of ``robustness.benchmark``.
    """
    with jax.enable_x64(True):
        found = official(make(board.task.plant), board)
    result = {name: found[name] for name in ("score", "success", "criteria")}
    if not robustness or board.trials is None:
        return result | {"robustness": None}
    start = time.perf_counter()
    with jax.enable_x64(False):
        report = benchmark(make(board.task.plant), board, jax.random.key(seed), keys=keys)
    return result | {
        "robustness": report.overall,
        "robustness_by_key": report.overall_by_key,
        "robustness_criteria": report.scores,
        "robustness_seconds": time.perf_counter() - start,
    }


def leaderboard(
    board: Board,
    controllers: Mapping[str, tuple[str, Make]],
    *,
    say: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> dict[str, Any]:
    """Judge controllers, and rank them with the published ones by performance.

    Args:
        board: to judge them on.
        controllers: name -> (title, ``make(plant)``).
        say: told what is being judged.
        options: of ``judge``.
    """
    rows: list[dict[str, Any]] = []
    for name, (title, make) in controllers.items():
        say(f"judging {title} ...")
        row = {"name": name, "title": title, "source": "measured"}
        rows.append(row | judge(make, board, **options))
    rows += published(board)
    rows = sorted(rows, key=lambda row: -row["score"])
    return {"robot": board.robot, "columns": board.columns, "rows": rows}


def cells(row: Mapping[str, Any], columns: Sequence[str]) -> list[str]:
    """A row of a board as text: title, score, criteria, six robustness scores, robustness."""

    def shown(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    criteria = row["criteria"] if row.get("success") else {}
    six = row.get("robustness_criteria") or {}
    return [
        row["title"] + (" (published)" if row["source"] == "published" else ""),
        shown(row["score"], ".3f"),
        *(shown(criteria.get(name), HEADINGS[name][2]) for name in columns),
        *(shown(six.get(name), ".2f") for name in CRITERIA),
        shown(row["robustness"], ".3f"),
    ]


def markdown(board: Mapping[str, Any]) -> str:
    """The board as a Markdown table; of several keys, median and range of the robustness."""
    columns = board["columns"]
    shown = [HEADINGS[name] for name in columns]
    criteria = [f"{heading} [{unit}]" for heading, unit, *_ in shown]
    headings = ["controller", "score", *criteria, *CRITERIA.values(), "robustness"]
    measured = any(row["robustness"] is not None for row in board["rows"])
    headings = headings if measured else headings[: 2 + len(criteria)]
    lines = [headings, ["---"] + ["---:"] * (len(headings) - 1)]
    for row in board["rows"]:
        line, by_key = cells(row, columns), row.get("robustness_by_key", ())
        if len(by_key) > 1:
            line[-1] += f" ({min(by_key):.3f} to {max(by_key):.3f})"
        lines.append(line[: len(headings)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def chosen(
    controllers: str | None, policy: str | None, controller: str | None, task: Task
) -> dict[str, tuple[str, Make]]:
    """Name -> (title, make) of what the command line asks for; without names, of all.

    ``policy`` and ``controller``, as in ``find_controller``, name one more than the others.
    """
    robot = task.robot
    names = list(CATALOGUE)
    if controllers is not None:
        names = [name.strip() for name in controllers.split(",") if name.strip()]
    if not names:
        raise JaxpendError(f"there is no controller to judge; known: {', '.join(CATALOGUE)}")
    chosen: dict[str, tuple[str, Make]] = {}
    for name in names:
        title = CATALOGUE[choose("controller", name, CATALOGUE)].title
        chosen[name] = title, partial(build, name, robot=robot, policy=task.shipped)
    if policy or controller:
        if not controller or ":" in controller:  # what is wrong is known at once, and cheaply
            find_controller(policy, controller, task)
        title = " ".join(filter(None, (controller, policy and Path(policy).stem)))
        chosen["own"] = title, lambda plant: find_controller(policy, controller, task)
    return chosen


if __name__ == "__main__":
    from .cli.app import main

    main("leaderboard")
