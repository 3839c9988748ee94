"""The torque limit: what SAC and SNES reach within 1.5, 3 and 5 N m, and what is possible there.

    python experiments/torque_limits.py

writes torque_limits.json, .md and .png beside this file. The ceiling is the best score of a
trajectory: of the shipped swing-up where it fits, else of the one that `jaxpend optimise` finds.
What is already in the folder of runs is kept, so an interrupted study goes on where it was.
"""

import argparse
import itertools
import json
import os
import sys
from functools import partial
from pathlib import Path

# One thread, as the runs.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import numpy as np
from seeds import ROBOTS, folder_of, train

from jaxpend import designs
from jaxpend.boards import v2
from jaxpend.controllers import load_reference, tvlqr
from jaxpend.report.charts import draw_curves
from jaxpend.report.figures import PALETTE, save, stack
from jaxpend.score import official
from jaxpend.trajopt.search import Search, find

HERE = Path(__file__).parent
LIMITS = (1.5, 3.0, 5.0)  # N m
TITLES = {"plain": "from the reward alone", "shipped": "from demonstrations"}


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
            measured = find(v2(robot).task, config, say=say)[0][1]
    result = {"score": measured["score"], "peak": measured["criteria"]["max_tau"], "found": found}
    path.write_text(json.dumps(result))
    return result


def row_of(recipe: str, robot: str, limit: float, seed: int, runs: Path) -> dict:
    """The row of a run, trained and judged unless it is there, with its learning curve."""
    kept = folder_of(recipe, robot, seed, runs) / "row.json"
    if kept.exists():
        return json.loads(kept.read_text())
    row = train(recipe, robot, seed, runs, ["--sac.env.torque-limit", str(limit)])
    lines = kept.with_name("metrics.jsonl").read_text().splitlines()
    curve = [r for r in map(json.loads, lines) if r["stage"] == "sac"]
    steps = [r["env_steps"] for r in curve]
    best = np.maximum.accumulate([r["score"] for r in curve]).round(4).tolist()
    row |= {"torque_limit": limit, "curve": {"env_steps": steps, "best": best}}
    kept.write_text(json.dumps(row))
    return row


def table(rows: list[dict], ceilings: dict) -> str:
    """A Markdown table with a row for each group of seeds, every seed in it."""
    lines = [
        "Score after SAC and after SNES, and robustness (median of five benchmark keys), one "
        "number a seed; the ceiling is that of trajectory optimisation.",
        "",
        "| recipe | robot | torque limit | seeds | after SAC | after SNES | robustness | ceiling |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for recipe, robot, limit in dict.fromkeys(
        (r["recipe"], r["robot"], r["torque_limit"]) for r in rows
    ):
        group = of(rows, recipe, robot, limit)
        numbers = [
            ", ".join(f"{value:.{digits}f}" for value in values)
            for values, digits in (
                ([r["sac"]["score"] for r in group], 3),
                ([r["snes"]["score"] for r in group], 3),
                ([r["robustness"]["median"] for r in group], 2),
            )
        ]
        seeds = ", ".join(str(r["seed"]) for r in group)
        best = ceilings[robot][str(limit)]["score"]
        cells = [TITLES[recipe], robot, f"{limit:g} N m", seeds, *numbers, f"{best:.4f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def of(rows: list[dict], recipe: str, robot: str, limit: float) -> list[dict]:
    """The rows of one group of seeds."""
    return [
        r for r in rows if (r["recipe"], r["robot"], r["torque_limit"]) == (recipe, robot, limit)
    ]


def draw_finals(axes, robot: str, rows: list[dict], ceilings: dict) -> None:
    """Scores over the torque limit: a mark a seed, a line through the medians, the ceiling."""
    limits = sorted({r["torque_limit"] for r in rows})
    kinds = [
        ("plain", "sac", "SAC", "two", "o"),
        ("plain", "snes", "SAC, SNES", "one", "s"),
        ("shipped", "snes", "with demonstrations", "three", "^"),
    ]
    for shift, (recipe, stage, label, colour, marker) in enumerate(kinds):
        groups = {a: of(rows, recipe, robot, a) for a in limits}
        medians = []
        for i, limit in enumerate(limits):
            scores = [r[stage]["score"] for r in groups[limit]]
            if not scores:
                continue
            at = i + 0.14 * (shift - 1)
            axes.scatter(
                [at] * len(scores), scores, s=26, color=PALETTE[colour], marker=marker,
                label=None if medians else label,
            )  # fmt: skip
            medians.append((at, np.median(scores)))
        if medians:
            axes.plot(*zip(*medians, strict=True), color=PALETTE[colour])
    for i, limit in enumerate(limits):
        best = ceilings[robot][str(limit)]["score"]
        label = "ceiling" if i == 0 else None
        axes.plot([i - 0.3, i + 0.3], [best, best], color=PALETTE["ink"], label=label)
    axes.set_xticks(range(len(limits)), [f"{limit:g}" for limit in limits])
    axes.set(xlabel="torque limit [N m]", ylabel="v2 score", ylim=(-0.02, 0.79))
    axes.set_title(f"{robot}: every seed, and medians")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=4, columnspacing=1.0)


def draw(rows: list[dict], ceilings: dict, path: Path) -> None:
    """For both robots, learning curves of SAC and scores over the torque limit."""
    draws = []
    for robot in dict.fromkeys(r["robot"] for r in rows):
        mine = [r for r in rows if r["robot"] == robot]
        curves = {
            f"{limit:g} N m": [
                (np.array(r["curve"]["env_steps"]), np.array(r["curve"]["best"]))
                for r in of(mine, "plain", robot, limit)
            ]
            for limit in sorted({r["torque_limit"] for r in mine})
        }
        labels = {"xlabel": "environment steps of SAC", "ylabel": "best v2 score so far"}
        draws += [
            partial(draw_curves, title=f"{robot}: SAC", curves=curves, **labels),
            partial(draw_finals, robot=robot, rows=mine, ceilings=ceilings),
        ]
    save(stack(draws, columns=2, size=(5.2, 3.6)), path)


def main() -> None:
    """Run what is missing, write the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limits", nargs="+", type=float, default=LIMITS)
    parser.add_argument("--recipes", nargs="+", default=["plain"], choices=TITLES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=ROBOTS)
    parser.add_argument("--starts", type=int, default=24, help="of the search for the ceiling")
    parser.add_argument("--runs", type=Path, default=Path("runs/torque_limits"))
    parser.add_argument("--finished", action="store_true", help="only runs that are there")
    args = parser.parse_args()
    folders = {limit: args.runs / f"{limit:g}" for limit in args.limits}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    ceilings = {
        robot: {str(a): ceiling(robot, a, folder, args.starts) for a, folder in folders.items()}
        for robot in args.robots
    }
    jobs = itertools.product(args.seeds, args.recipes, args.robots, args.limits)
    rows = []
    for seed, recipe, robot, limit in jobs:
        folder = folder_of(recipe, robot, seed, folders[limit])
        if args.finished and not (folder / "result.json").exists():
            continue
        rows.append(row_of(recipe, robot, limit, seed, folders[limit]))
        # After every run, so that there is something to look at meanwhile.
        lines = ",\n".join(map(json.dumps, rows))
        text = f'{{"ceilings": {json.dumps(ceilings)},\n"rows": [\n{lines}\n]}}\n'
        (HERE / "torque_limits.json").write_text(text)
        (HERE / "torque_limits.md").write_text(table(rows, ceilings))
        draw(rows, ceilings, HERE / "torque_limits.png")
    print(table(rows, ceilings))


if __name__ == "__main__":
    main()
