"""Train seeds for the v3 board and for real robots, and tabulate what every stage brings.

    python experiments/tasks.py --tasks global hardware --seeds 0 1 2
    python experiments/tasks.py --others

writes experiments/tasks.json and tasks.md (or what --out names). A run that is there already is
kept, and one that was stopped goes on. Two runs at a time, one thread each. The second command
prints what the v2 policies that ship, and the classical controllers, do on the v3 board; on real
robots it is `fleet.py` that does.
"""

import argparse
import concurrent.futures
import itertools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from jaxpend.files import write_atomically

HERE = Path(__file__).parent
TASKS = ("global", "hardware")
ROBOTS = ("acrobot", "pendubot")
STAGES = ("sac", "shac", "snes")
CLASSICAL = ("mpc_free", "energy_lqr", "tvlqr", "tvlqr_guarded", "lqr")
THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def command(*words: str, **kwargs: Any) -> str:
    """Standard output of ``jaxpend``."""
    line = [sys.executable, "-m", "jaxpend", *words]
    return subprocess.run(line, stdout=subprocess.PIPE, text=True, check=True, **kwargs).stdout


def fleet(robot: str, policy: Path) -> dict:
    """What ``jaxpend hardware`` says of a policy, kept beside it."""
    kept = policy.with_suffix(".hardware.json")
    if not kept.exists():
        line = ("hardware", "--robot", robot, "--policy", str(policy), "--out", "None", "--json")
        write_atomically(kept, command(*line, "-"))
    return json.loads(kept.read_text())["conditions"]


def others() -> None:
    """Print tables in Markdown of the controllers that were not trained for the v3 board."""
    for robot in ROBOTS:
        classical = ("--controllers", ",".join(CLASSICAL))
        line = ("leaderboard", "--board", "v3", "--robot", robot, *classical)
        print(command(*line, "--policy", robot, "--draws", "100", "--out", "-"))


def train(task: str, robot: str, seed: int, runs: Path) -> dict:
    """One run, judged."""
    name = f"{task}-{robot}-{seed}"
    line = ("train", "--config", f"{task}_{robot}", "--robot", robot, "--seed", str(seed))
    environment = os.environ | {"XLA_FLAGS": THREAD}
    command(*line, "--run", name, "--runs", str(runs), env=environment)
    result = json.loads((runs / name / "result.json").read_text())
    found: dict[str, Any] = {s: {"score": result[s]["score"]} for s in STAGES if s in result}
    found["seconds"] = sum(result[stage]["seconds"] for stage in found)
    if task == "hardware":
        found["fleet"] = fleet(robot, runs / name / "policy.npz")
    else:
        found["interval"] = result["snes"]["draws"]["interval"]
    print(name, found, flush=True)
    return {"task": task, "robot": robot, "seed": seed} | found


def table(rows: list[dict]) -> str:
    """Markdown, a table a task."""
    lines = []
    for task in TASKS:
        its = [row for row in rows if row["task"] == task]
        if not its:
            continue
        shares = ["without pushes", "with pushes"] if task == "hardware" else []
        stages = [stage for stage in STAGES if any(stage in row for row in its)]
        head = ["robot", "seed", *(f"after {s.upper()}" for s in stages)]
        head += [f"stand {share}" for share in shares] + ["training"]
        lines += ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
        for row in sorted(its, key=lambda row: (row["robot"], row["seed"])):
            cells = [row["robot"], str(row["seed"])]
            cells += [f"{row[stage]['score']:.3f}" if stage in row else "" for stage in stages]
            for share in shares:
                found = row["fleet"][share]
                low, high = (100 * end for end in found["interval"])
                cells.append(f"{100 * found['success']:.1f} % ({low:.1f} to {high:.1f})")
            lines.append("| " + " | ".join([*cells, f"{row['seconds']:.0f} s"]) + " |")
        lines.append("")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Train what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--runs", type=Path, default=Path("runs/tasks"))
    parser.add_argument("--out", default="tasks")
    parser.add_argument("--others", action="store_true", help="judge other controllers instead")
    args = parser.parse_args()
    if args.others:
        return others()
    wanted = list(itertools.product(args.tasks, args.robots, args.seeds))
    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(lambda one: train(*one, args.runs), wanted))
    write_atomically(HERE / f"{args.out}.json", json.dumps(rows, indent=1) + "\n")
    write_atomically(HERE / f"{args.out}.md", table(rows))


if __name__ == "__main__":
    main()
