"""What each stage of the recipe brings: score and robustness after it, of every seed.

    python experiments/stages.py runs/learned/learned-*

writes stages.md and stages.json beside this file. A policy is judged twice: alone, and behind the
guard that the run puts around what the gradient ends with; guarded also in random scenarios, of
which training sees none. What is already in the folder of a run is kept.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
from seeds import STAGES

from jaxpend import load_policy
from jaxpend.boards import v2
from jaxpend.config import TrainRun
from jaxpend.config_files import load_config
from jaxpend.controllers import guard
from jaxpend.controllers.policy import network_in
from jaxpend.robustness import benchmark
from jaxpend.score import official
from jaxpend.stage import standing

HERE = Path(__file__).parent
CELL = "{score:.3f} / {alone:.3f} / {guarded:.3f} / {stands:.3f}"
COLUMNS = ("score", "alone", "guarded", "stands")


def robustness(controller, robot: str) -> float:
    """Of one benchmark key."""
    return benchmark(controller, robot, jax.random.key(0), keys=1).overall


def judged(folder: Path) -> dict:
    """Stage -> score, and robustness alone and guarded, of the best policy of each stage."""
    kept = folder / "stages.json"
    if kept.exists():
        return json.loads(kept.read_text())
    run, found = load_config(TrainRun(), folder / "config.json"), {}
    for stage in STAGES:
        policy = load_policy(folder / f"{stage}_best.npz")
        network = network_in(policy)
        guarded = policy
        if guarded is network:
            guarded = guard(network, run.robot, **dataclasses.asdict(run.guard))
        found[stage] = {
            "score": official(policy, run.robot)["score"],
            "alone": robustness(network, run.robot),
            "guarded": robustness(guarded, run.robot),
            "stands": standing(guarded, v2(run.robot).task),
        }
    found = {"robot": run.robot, "seed": run.seed, "stages": found}
    kept.write_text(json.dumps(found) + "\n")
    return found


def table(rows: list[dict]) -> str:
    """A Markdown table with a row for each seed, and the medians."""
    lines = [
        "Score / robustness alone / guarded (one benchmark key) / share of 1024 random scenarios",
        "in which it stands guarded, of the best policy of each stage.",
        "",
        "| robot | seed | " + " | ".join(STAGES.values()) + " |",
        "|---" * (2 + len(STAGES)) + "|",
    ]

    def line(robot, seed, numbers):
        cells = [CELL.format(**numbers[s]) for s in STAGES]
        return f"| {robot} | {seed} | " + " | ".join(cells) + " |"

    for robot in dict.fromkeys(row["robot"] for row in rows):
        group = [row for row in rows if row["robot"] == robot]
        lines += [line(robot, row["seed"], row["stages"]) for row in group]
        medians = {
            s: {c: float(np.median([row["stages"][s][c] for row in group])) for c in COLUMNS}
            for s in STAGES
        }
        lines.append(line(robot, "median", medians))
    return "\n".join(lines) + "\n"


def main() -> None:
    """Judge what is missing and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="run folders")
    rows = [judged(folder) for folder in parser.parse_args().folders]
    rows.sort(key=lambda row: (row["robot"], row["seed"]))
    (HERE / "stages.json").write_text(json.dumps(rows, indent=1) + "\n")
    (HERE / "stages.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
