"""Train several seeds of both robots, two single-threaded runs at a time, and tabulate them.

    python experiments/seeds.py
    python experiments/seeds.py --recipes demonstrated --seeds 0 1 2 --out demonstrated

writes experiments/seeds.json and experiments/seeds.md (or what --out names). A run that is already
there is kept, so an interrupted sweep goes on where it was.
"""

import argparse
import concurrent.futures
import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from jaxpend import Scenario, load_policy, save_policy
from jaxpend.boards import v2
from jaxpend.controller import Controller
from jaxpend.controllers.policy import network_in
from jaxpend.criteria import upright
from jaxpend.files import write_atomically
from jaxpend.rollout import final_state
from jaxpend.score import official
from jaxpend.variations import vary

HERE = Path(__file__).parent
ROBOTS = ("acrobot", "pendubot")
STAGES = {"sac": "SAC", "openings": "openings", "gradient": "gradient", "snes": "SNES"}
# What a recipe changes of the file that it begins with (``ALONE``, or the demonstrated one).
RECIPES = {
    "demonstrated": [],
    "no pulses": ["--sac.demonstrations.pulses", "0"],
    "with gradient": [
        "--gradient.steps", "600", "--snes.sigma", "0.0003", "--snes.generations", "100",
    ],
    "no SAC": ["--sac.steps", "32"],  # fewer than the actor's delay: imitation alone
    "memory": ["--sac.env.observation.history", "4"],
    "randomised": ["--sac.env.randomised", "0.8"],
    "randomised memory": ["--sac.env.randomised", "0.8", "--sac.env.observation.history", "4"],
    "robust SNES": [
        "--snes.scenarios", "16", "--snes.objective.weight", "0.5", "--snes.generations", "60",
    ],
    "plain": [],
    "learned": [],
    "low_torque": [],
}  # fmt: skip
# From the reward alone, without imitation: the configuration of each.
ALONE = {"plain": "plain", "learned": "{}", "low_torque": "low_torque"}
# What is taken from the policy that the demonstrated recipe ended with; nothing is trained again.
TAKEN = {
    "no observer": {"observer": None},
    "no rescue": {"rescue": None},
}
# One thread a run: two runs side by side use two cores better than one run does.
THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def robustness(robot: str, policy: Path) -> dict:
    """Robustness of a policy over five benchmark keys: median, lowest, highest; six criteria.

    With a guard, "network" is the median of its network alone.
    """
    command = [sys.executable, "-m", "jaxpend.robustness", "--robot", robot, "--out", "None"]
    command += ["--policy", str(policy), "--keys", "5", "--json", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    overall, by_key = (found["over_keys"][name] for name in ("overall", "scores"))
    criteria = {n: float(np.median(by_key.get(n, [v]))) for n, v in found["scores"].items()}
    found = {"median": float(np.median(overall)), "lowest": min(overall), "highest": max(overall)}
    found |= {"criteria": criteria}
    network = network_in(guarded := load_policy(policy))
    if network is not guarded:
        path = policy.with_name("network.npz")
        save_policy(path, network)
        found |= {"network": robustness(robot, path)["median"]}
    return found


def folder_of(recipe: str, robot: str, seed: int, runs: Path) -> Path:
    """The run folder of one run."""
    return runs / f"{recipe}-{robot}-{seed}".replace(" ", "-")


def train(recipe: str, robot: str, seed: int, runs: Path, flags: Sequence[str] = ()) -> dict:
    """One run of `python -m jaxpend.train`, with more flags; returns a row of the table."""
    folder = folder_of(recipe, robot, seed, runs)
    if not (folder / "result.json").exists():
        # Relative: the command goes into the policy files.
        config = ALONE.get(recipe, "demonstrated_{}").format(robot)
        command = [sys.executable, "-m", "jaxpend.train", "--config", config]
        command += ["--robot", robot, "--seed", str(seed)]
        command += ["--runs", str(runs), "--run", folder.name]
        command += [*RECIPES[recipe], *flags]
        environment = os.environ | {"XLA_FLAGS": THREAD}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    result = json.loads((folder / "result.json").read_text())
    rows = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    first = next(row for row in rows if row["stage"] == "sac")
    keys = ("score", "success", "seconds")
    return {
        "recipe": recipe,
        "robot": robot,
        "seed": seed,
        "imitation": None if recipe in ALONE else first["score"],
        **{n: {k: result[n][k] for k in keys} for n in STAGES if n in result},
        "criteria": result[[n for n in STAGES if n in result][-1]]["criteria"],
        "robustness": judged(robot, folder),
    }


def with_angle_noise(robot: str, controller: Controller, runs: int = 256) -> float:
    """Share of runs on the nominal plant that end upright with 3 mrad of noise on the angles."""
    scenario = Scenario(v2(robot).task.plant)
    noisy = vary(scenario, {"position_noise": np.full(runs, 0.003)}, key=jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), runs)
    ends = jax.jit(jax.vmap(final_state, (0, None, 0)))(noisy, controller, keys)
    return float(upright(ends).mean())


def judged(robot: str, folder: Path) -> dict:
    """``robustness`` of the policy of a run, which stays in the folder of the run.

    With the share that stands under noise of the angles, guarded and alone.
    """
    kept = folder / "robustness.json"
    if not kept.exists():
        found, guarded = (
            robustness(robot, folder / "policy.npz"),
            load_policy(folder / "policy.npz"),
        )
        found["angle_noise"] = with_angle_noise(robot, guarded)
        found["angle_noise_network"] = with_angle_noise(robot, network_in(guarded))
        write_atomically(kept, json.dumps(found) + "\n")
    return json.loads(kept.read_text())


def without(recipe: str, robot: str, seed: int, runs: Path) -> dict:
    """A row for the policy of a demonstrated run with a part of its guard taken away."""
    folder = folder_of("demonstrated", robot, seed, runs)
    path = folder / f"{recipe}.npz".replace(" ", "-")
    save_policy(path, load_policy(folder / "policy.npz").replace(**TAKEN[recipe]))
    found = official(load_policy(path), robot)
    row = {"recipe": recipe, "robot": robot, "seed": seed, "imitation": None}
    row["snes"] = {"score": found["score"], "success": found["success"], "seconds": 0}
    return row | {"criteria": found["criteria"], "robustness": robustness(robot, path)}


def table(rows: list[dict], jobs: int) -> str:
    """A Markdown table, a row each, and the median and range of each group."""
    shown = {n: title for n, title in STAGES.items() if any(n in r for r in rows)}
    heads = ["recipe", "robot", "seed", "imitation", *(f"then {t}" for t in shown.values())]
    heads += ["robustness", "unguarded", *shown.values()]
    lines = [
        f"Machine: {platform.machine()}, {os.cpu_count()} cores; single-threaded runs, {jobs} at "
        "once; robustness: median (range) over 5 benchmark keys, and that of the network without "
        "its guard.",
        "",
        "| " + " | ".join(heads) + " |",
        "|" + "---|" * len(heads),
    ]
    for r in rows:
        overall = r["robustness"]
        cells = [r["recipe"], r["robot"], r["seed"]]
        cells += ["" if r["imitation"] is None else f"{r['imitation']:.4f}"]
        cells += [f"{r[n]['score']:.4f}" if n in r else "" for n in shown]
        cells += ["{median:.3f} ({lowest:.3f} to {highest:.3f})".format(**overall)]
        cells += [f"{overall['network']:.3f}" if "network" in overall else ""]
        cells += [f"{r[n]['seconds']:.0f} s" if n in r else "" for n in shown]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines += [
        "",
        "| recipe | robot | seeds | median score | lowest | highest |",
        "|---|---|---|---|---|---|",
    ]
    for recipe, robot in sorted({(r["recipe"], r["robot"]) for r in rows}):
        group = [r for r in rows if (r["recipe"], r["robot"]) == (recipe, robot)]
        scores = [r["snes"]["score"] for r in group]
        cells = (np.median(scores), min(scores), max(scores))
        numbers = " | ".join(f"{cell:.4f}" for cell in cells)
        lines.append(f"| {recipe} | {robot} | {len(scores)} | {numbers} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is missing and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recipes", nargs="+", default=["learned"], choices=[*RECIPES, *TAKEN])
    parser.add_argument("--seeds", nargs="+", type=int, default=[*range(5)])
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=ROBOTS)
    parser.add_argument("--runs", type=Path, default=Path("runs/seeds"))
    parser.add_argument("--out", default="seeds", help="name of the .json and .md beside this file")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    jobs = [(c, r, s, args.runs) for c in args.recipes for r in args.robots for s in args.seeds]
    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
        rows = list(pool.map(lambda job: (without if job[0] in TAKEN else train)(*job), jobs))
    (HERE / f"{args.out}.json").write_text(json.dumps(rows, indent=1) + "\n")
    (HERE / f"{args.out}.md").write_text(table(rows, args.jobs))
    print(table(rows, args.jobs))


if __name__ == "__main__":
    main()
