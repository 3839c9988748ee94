"""How little torque a swing-up needs: the recipes `low_torque_ROBOT` over torque limits.

    python experiments/low_torque.py

writes low_torque.json, .md and .png beside this file: score, energy, peak torque and swing-up time
of a policy within each limit, and of the best swing-up that trajectory optimisation finds there,
followed by TVLQR. A run that is in the folder of runs is kept, so that an interrupted study goes
on where it was.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax

from jaxpend.boards import v2
from jaxpend.files import write_atomically
from jaxpend.report.figures import PALETTE, save, stack
from jaxpend.trajopt.search import Search, find

HERE = Path(__file__).parent
THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
ROBOTS = ("acrobot", "pendubot")
LIMITS = (0.5, 1.0, 1.5, 2.0, 3.0, 6.0)  # N m
SHOWN = {
    "score": "v2 score", "energy": "energy [J]", "max_tau": "peak torque [N m]",
    "swingup_time": "swing-up [s]",
}  # fmt: skip


def numbers(result: dict) -> dict:
    """Of what ``score.official`` says those that are shown; none where it does not stand."""
    if not result["success"]:
        return {"score": 0.0}
    criteria = result["criteria"] | {"score": result["score"]}
    return {name: criteria[name] for name in SHOWN}


def learned(robot: str, limit: float, runs: Path) -> dict:
    """A run of the recipe within a limit: what every stage came to."""
    folder = runs / f"{robot}-{limit:g}"
    if not (folder / "result.json").exists():
        line = [sys.executable, "-m", "jaxpend", "train", "--config", f"low_torque_{robot}"]
        line += ["--robot", robot, "--sac.env.torque-limit", str(limit), "--devices", "1"]
        line += ["--runs", str(runs), "--run", folder.name]
        subprocess.run(line, check=True, env=os.environ | {"XLA_FLAGS": THREAD})
    result = json.loads((folder / "result.json").read_text())
    found = {stage: numbers(result[stage]) for stage in ("sac", "gradient")}
    return found | {"seconds": sum(result[stage]["seconds"] for stage in ("sac", "gradient"))}


def optimised(robot: str, limit: float, runs: Path, starts: int) -> dict:
    """The best swing-up within a limit."""
    kept = runs / f"optimised-{robot}-{limit:g}-{starts}.json"
    if not kept.exists():

        def say(line):
            print(f"{robot}, {limit:g} N m: {line}", file=sys.stderr)

        config = Search(torque_limit=limit, starts=starts)
        with jax.enable_x64(True):
            found = find(v2(robot).task, config, say=say)
        write_atomically(kept, json.dumps(numbers(found[0][1]) if found else {"score": 0.0}))
    return json.loads(kept.read_text())


def table(rows: list[dict]) -> str:
    """Markdown: a row for each robot and limit."""
    head = ["robot", "limit", "SAC", "then the gradient", "energy", "peak torque", "swing-up"]
    head += ["optimised: score", "energy", "peak torque", "swing-up", "training"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        cells = [row["robot"], f"{row['limit']:g} N m", f"{row['sac']['score']:.3f}"]
        for found in (row["gradient"], row["optimised"]):
            cells.append(f"{found['score']:.3f}")
            cells += [f"{found[name]:.2f}" if name in found else "-" for name in list(SHOWN)[1:]]
        lines.append("| " + " | ".join([*cells, f"{row['seconds']:.0f} s"]) + " |")
    return "\n".join(lines) + "\n"


def draw_over_limits(axes, rows: list[dict], robot: str, name: str) -> None:
    """One number over the torque limit: SAC, the policy, and the optimised swing-up."""
    kinds = {
        "sac": ("SAC", "two", "o:"), "gradient": ("SAC, gradient", "one", "s-"),
        "optimised": ("trajectory optimisation", "ink", "^--"),
    }  # fmt: skip
    for kind, (label, colour, form) in kinds.items():
        mine = [r for r in rows if r["robot"] == robot and name in r[kind]]
        x, y = [r["limit"] for r in mine], [r[kind][name] for r in mine]
        axes.plot(x, y, form, color=PALETTE[colour], label=label, markersize=5)
    limits = list(dict.fromkeys(row["limit"] for row in rows))
    if name == "max_tau":
        axes.plot(limits, limits, color=PALETTE["muted"], linewidth=0.8, label="the limit")
    axes.set(title=f"{robot}: {SHOWN[name]}", xlabel="torque limit [N m]", xscale="log")
    axes.set_xticks(limits, [f"{limit:g}" for limit in limits])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)


def main() -> None:
    """Run what is missing, write the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limits", nargs="+", type=float, default=LIMITS)
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=ROBOTS)
    parser.add_argument("--starts", type=int, default=16, help="of the trajectory optimisation")
    parser.add_argument("--runs", type=Path, default=Path("runs/low_torque"))
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    rows = []
    for robot, limit in itertools.product(args.robots, args.limits):
        row = {"robot": robot, "limit": limit} | learned(robot, limit, args.runs)
        rows.append(row | {"optimised": optimised(robot, limit, args.runs, args.starts)})
        write_atomically(HERE / "low_torque.json", json.dumps(rows, indent=1) + "\n")
        write_atomically(HERE / "low_torque.md", table(rows))
    draws = [
        partial(draw_over_limits, rows=rows, robot=robot, name=name)
        for robot in args.robots
        for name in SHOWN
    ]
    save(stack(draws, columns=len(SHOWN), size=(3.6, 3.0)), HERE / "low_torque.png")
    print(table(rows))


if __name__ == "__main__":
    main()
