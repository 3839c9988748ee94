"""The torque limit: what is learned within 0.5 to 6 N m, and what is possible there.

    python experiments/torque_limits.py

writes torque_limits.json, .md and .png beside this file. The ceiling is the best score of a
trajectory: of the shipped swing-up where it fits, else of the one that `jaxpend optimise` finds.
What is already in the folder of runs is kept, so an interrupted study goes on where it was, and so
are the ceilings of the file, and its rows of other limits, recipes or seeds.
"""

import argparse
import itertools
import json
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

# One thread, as the runs.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import numpy as np
from seeds import ROBOTS, STAGES, folder_of, train

from jaxpend import designs
from jaxpend.boards import v2
from jaxpend.controllers import load_reference, tvlqr
from jaxpend.errors import JaxpendError
from jaxpend.report.figures import PALETTE, save, stack
from jaxpend.score import official
from jaxpend.trajopt.search import Search, find

HERE = Path(__file__).parent
LIMITS = (0.5, 1.0, 2.0, 3.0, 6.0)  # N m
TITLES = {"low_torque": "low torque", "plain": "plain"}
NAMES = ("recipe", "robot", "torque_limit", "seed")
STYLES = {"low_torque": ("one", "o"), "plain": ("two", "s")}


def ceiling(robot: str, limit: float, runs: Path, starts: int) -> dict:
    """Best score of a swing-up within the limit, followed by TVLQR, and its peak torque, N m."""
    path = runs / f"ceiling-{robot}.json"
    if path.exists():
        return json.loads(path.read_text())
    with jax.enable_x64(True):
        reference = load_reference(robot)
        found = f"optimised, {starts} starts a horizon"
        if np.abs(reference.u).max() <= limit:
            found = "shipped"
            measured = official(tvlqr(designs.competition(robot, limit), reference), robot)
        else:

            def say(line):
                print(f"{robot}, {limit:g} N m: {line}", file=sys.stderr)

            config = Search(torque_limit=limit, starts=starts)
            try:
                measured = find(v2(robot).task, config, say=say)[0][1]
            except JaxpendError:  # no start stood within the horizon
                measured = {"score": None, "criteria": {"energy": None, "max_tau": None}}
    spent = {"energy": measured["criteria"]["energy"], "peak": measured["criteria"]["max_tau"]}
    result = {"score": measured["score"], "found": found} | spent
    path.write_text(json.dumps(result))
    return result


def flags(recipe: str, limit: float) -> list[str]:
    """A limit, and what of the reward and the starts follows from it.

    Torque costs in proportion to its square in N m, as in the score; what a torque catches near
    upright is in proportion to it.
    """
    given = {"torque-limit": limit}
    if recipe == "low_torque":
        reward = {"reward.rho1": 0.3 * limit**2, "reward.rho2": 0.1 * limit**2}
        given |= reward | {"upright-spread": min(0.01 * limit, 0.03)}
    return [word for name, value in given.items() for word in (f"--sac.env.{name}", f"{value:g}")]


def row_of(recipe: str, robot: str, limit: float, seed: int, runs: Path) -> dict:
    """The row of a run, trained and judged unless it is there."""
    kept = folder_of(recipe, robot, seed, runs) / "row.json"
    if kept.exists():
        return json.loads(kept.read_text())
    row = train(recipe, robot, seed, runs, flags(recipe, limit)) | {"torque_limit": limit}
    kept.write_text(json.dumps(row))
    return row


def final(row: dict) -> float:
    """The score after the last stage."""
    return row[[name for name in STAGES if name in row][-1]]["score"]


def table(rows: list[dict], ceilings: dict) -> str:
    """A Markdown table with a row for each group of seeds, every seed in it."""
    heads = ["recipe", "robot", "torque limit", "seeds", "after SAC", "in the end", "robustness"]
    heads += ["energy", "peak torque", "ceiling: score", "energy", "peak torque"]
    lines = [
        "v2 score after SAC and in the end, energy (J) and peak torque (N m) of that, and "
        "robustness (median of five benchmark keys), one number a seed; the ceiling is that of "
        "trajectory optimisation. What does not stand has a score of 0.",
        "",
        "| " + " | ".join(heads) + " |",
        "|" + "---|" * len(heads),
    ]
    for recipe, robot, limit in dict.fromkeys(
        (r["recipe"], r["robot"], r["torque_limit"]) for r in rows
    ):
        group = of(rows, recipe, robot, limit)
        numbers = [
            ", ".join(f"{value:.{digits}f}" for value in values)
            for values, digits in (
                ([r["sac"]["score"] for r in group], 3),
                ([final(r) for r in group], 3),
                ([r["robustness"]["median"] for r in group], 2),
                ([r["criteria"]["energy"] for r in group], 1),
                ([r["criteria"]["max_tau"] for r in group], 2),
            )
        ]
        seeds = ", ".join(str(r["seed"]) for r in group)
        best = ceilings[robot][str(limit)]
        cells = [TITLES[recipe], robot, f"{limit:g} N m", seeds, *numbers]
        digits = {"score": 4, "energy": 1, "peak": 2}
        cells += [
            "none found" if best[name] is None else f"{best[name]:.{d}f}"
            for name, d in digits.items()
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def of(rows: list[dict], recipe: str, robot: str, limit: float) -> list[dict]:
    """The rows of one group of seeds."""
    return [
        r for r in rows if (r["recipe"], r["robot"], r["torque_limit"]) == (recipe, robot, limit)
    ]


def draw_over_limits(
    axes, robot: str, rows: list[dict], ceilings: dict, of_row: Callable, name: str, label: str
) -> None:
    """A number over the torque limit: a mark a seed, a line through the medians, the ceiling."""
    limits = sorted(map(float, ceilings[robot]))
    for recipe, (colour, marker) in STYLES.items():
        medians = []
        for limit in limits:
            # Energy and torque of what does not stand say nothing.
            group = [r for r in of(rows, recipe, robot, limit) if name == "score" or final(r)]
            values = [of_row(r) for r in group]
            if not values:
                continue
            axes.scatter(
                [limit] * len(values), values, s=26, color=PALETTE[colour], marker=marker,
                label=None if medians else TITLES[recipe],
            )  # fmt: skip
            medians.append((limit, np.median(values)))
        if medians:
            axes.plot(*zip(*medians, strict=True), color=PALETTE[colour])
    best = np.array([ceilings[robot][str(limit)][name] for limit in limits], float)
    axes.plot(limits, best, "--", color=PALETTE["ink"], label="ceiling")
    axes.set_xscale("log")
    axes.set_xticks(limits, [f"{limit:g}" for limit in limits])
    axes.minorticks_off()
    top = 1.1 * axes.dataLim.y1
    axes.set(xlabel="torque limit [N m]", ylabel=label, ylim=(0, top), title=robot)


def draw(rows: list[dict], ceilings: dict, path: Path) -> None:
    """Score, energy and peak torque over the torque limit, a column a robot."""
    numbers = {
        "score": (final, "v2 score"),
        "energy": (lambda r: r["criteria"]["energy"], "energy [J]"),
        "peak": (lambda r: r["criteria"]["max_tau"], "peak torque [N m]"),
    }
    draws = [
        partial(draw_over_limits, robot=robot, rows=rows, ceilings=ceilings, of_row=of_row,
                name=name, label=label)
        for name, (of_row, label) in numbers.items()
        for robot in ceilings
    ]  # fmt: skip
    figure = stack(draws, columns=2, size=(5.2, 2.8))
    figure.axes[0].legend(loc="lower right")
    save(figure, path)


def main() -> None:
    """Run what is missing, write the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limits", nargs="+", type=float, default=LIMITS)
    parser.add_argument("--recipes", nargs="+", default=["low_torque"], choices=TITLES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=ROBOTS)
    parser.add_argument("--starts", type=int, default=24, help="of the search for the ceiling")
    parser.add_argument("--runs", type=Path, default=Path("runs/torque_limits"))
    parser.add_argument("--finished", action="store_true", help="only runs that are there")
    args = parser.parse_args()
    found = HERE / "torque_limits.json"
    jobs = list(itertools.product(args.recipes, args.robots, args.limits, args.seeds))
    kept = json.loads(found.read_text()) if found.exists() else {"rows": [], "ceilings": {}}
    rows = [r for r in kept["rows"] if tuple(r[name] for name in NAMES) not in jobs]
    limits = sorted({*args.limits, *(r["torque_limit"] for r in rows)})
    folders = {limit: args.runs / f"{limit:g}" for limit in limits}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    ceilings = {
        robot: {
            str(a): kept["ceilings"].get(robot, {}).get(str(a))
            or ceiling(robot, a, folder, args.starts)
            for a, folder in folders.items()
        }
        for robot in sorted({*args.robots, *(r["robot"] for r in rows)})
    }
    for recipe, robot, limit, seed in jobs:
        folder = folder_of(recipe, robot, seed, folders[limit])
        if args.finished and not (folder / "result.json").exists():
            continue
        rows.append(row_of(recipe, robot, limit, seed, folders[limit]))
        # After every run, so that there is something to look at meanwhile.
        rows.sort(key=lambda r: [r[name] for name in NAMES])
        lines = ",\n".join(map(json.dumps, rows))
        found.write_text(f'{{"ceilings": {json.dumps(ceilings)},\n"rows": [\n{lines}\n]}}\n')
        (HERE / "torque_limits.md").write_text(table(rows, ceilings))
        draw(rows, ceilings, HERE / "torque_limits.png")
    print(table(rows, ceilings))


if __name__ == "__main__":
    main()
