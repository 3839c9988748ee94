"""The gradient through the simulator against SNES: same starts, same CPU time, one thread.

    python experiments/gradient.py

writes experiments/gradient.json and .md. Starts are policies after imitation alone, of few and of
all updates of the recipe. Time is that of the process's CPU, compilation apart and judging by the
official score included, so that a busy machine is fair too; both keep the best policy by that
score, except that in the robust part the last policy is judged as well. A row that is
already in the file is kept, so an interrupted run goes on where it was.
"""

import argparse
import dataclasses
import json
import os
import time
from pathlib import Path

# One thread, so that CPU time is wall clock on a machine of one's own.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import numpy as np

from jaxpend import designs, gradient, load_policy, sac, snes
from jaxpend.cli import emit_json
from jaxpend.config import GradientConfig, SNESConfig, TrainRun
from jaxpend.controllers.policy import save_policy
from jaxpend.robustness import benchmark
from jaxpend.runs import load_config
from jaxpend.score import nominal, official, score_v2
from jaxpend.terminal import console

HERE = Path(__file__).parent
SEEDS = (0, 1, 2)
# Robot and updates of imitation; after 5000 the acrobot does not swing up yet (score 0).
STARTS = (("pendubot", 5000), ("pendubot", 40_000), ("acrobot", 40_000))
SIGMAS = (0.003, 0.0003)  # the recipe's, and the best of 0.01, 0.003, 0.001, 0.0003 on one start
LONG = 6  # times the time, for SNES to catch up
MARKS = (0.1, 0.25, 0.5, 1.0)  # of the time, when the best score so far is noted


def start_of(robot: str, updates: int, seed: int, runs: Path):
    """The policy after imitation; trained once and kept in ``runs``."""
    path = runs / f"{robot}-{updates}-{seed}.npz"
    if not path.exists():
        config = load_config(TrainRun(), HERE / f"{robot}.yaml").sac
        shown = dataclasses.replace(config.demonstrations, updates=updates)
        config = dataclasses.replace(config, demonstrations=shown)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_policy(path, sac.greedy_policy(config, sac.init(config, jax.random.key(seed))))
    return load_policy(path)


def climb(method: str, start, config, seconds: float):
    """Best policy by the official score, the last one, and scores at ``MARKS`` of the time."""
    robot, key = start.robot, jax.random.key(11)
    if method == "gradient":
        state = gradient.init(config, start, key)
        chunk = lambda state: gradient.improve(config, start, state, config.chunk, robot)  # noqa: E731
        candidates = lambda state: [gradient.current(config, start, state)]  # noqa: E731
    else:
        state = snes.init(config, start, key)
        chunk = lambda state: snes.evolve(config, start, state, config.chunk)  # noqa: E731
        found = (snes.best_controller, snes.mean_controller)
        candidates = lambda state: [f(config, start, state) for f in found]  # noqa: E731
    jax.block_until_ready(chunk(state))  # compiles
    best, best_score, last = start, float(score_v2(nominal(start, robot))), start
    began, marks, done = time.process_time(), [], 0
    while len(marks) < len(MARKS):
        state, _ = jax.block_until_ready(chunk(state))
        done += config.chunk
        for last in candidates(state):
            score = float(score_v2(nominal(last, robot)))
            if score > best_score:
                best, best_score = last, score
        spent = (time.process_time() - began) / seconds
        marks += [best_score for mark in MARKS[len(marks) :] if spent >= mark]
        if method == "gradient" and done >= config.steps:
            marks += [best_score] * (len(MARKS) - len(marks))
    return best, last, {"marks": marks, "rounds": done, "seconds": spent * seconds}


def overall(policy) -> list[float]:
    """Overall robustness over five benchmark keys, lowest first."""
    plant = designs.competition(policy.robot)
    report = benchmark(policy, plant, jax.random.key(0), keys=5)
    return sorted(report.overall_by_key)


def row_of(robot, updates, seed, method, config, seconds, runs, robust):
    """One row: score, and where asked for, robustness, before and after."""
    start = start_of(robot, updates, seed, runs)
    best, last, row = climb(method, start, config, seconds)
    row |= {"start": official(start, robot)["score"], "score": official(best, robot)["score"]}
    if robust:
        row |= {"start_robustness": overall(start), "robustness": overall(best)}
        row |= {"last_score": official(last, robot)["score"], "last_robustness": overall(last)}
    return row


def plan(seconds: float, robust_seconds: float):
    """Every row's name, and what makes it; the gradient's steps fill the time on our machine."""
    snes_of = {s: SNESConfig(generations=200, sigma=s, action_noise=0.0) for s in SIGMAS}
    methods = {"gradient": GradientConfig(steps=round(60 * seconds))}
    methods |= {f"SNES {s}": config for s, config in snes_of.items()}
    for robot, updates in STARTS:
        for seed in SEEDS:
            for method, config in methods.items():
                yield (robot, updates, seed, method), config, seconds, False
    patient = SNESConfig(generations=1000, sigma=SIGMAS[1], action_noise=0.0)
    robust = {"gradient of the score": methods["gradient"]}
    robust |= {"gradient": GradientConfig(steps=200, learning_rate=3e-5, scenarios=32)}
    snes_robust = dataclasses.replace(patient, scenarios=16, scenario_weight=0.8)
    robust |= {f"SNES {SIGMAS[1]}": snes_robust}
    for robot, updates in STARTS[1:]:
        for method, config in robust.items():
            budget = robust_seconds if config.scenarios else seconds
            yield (robot, updates, 0, method), config, budget, True
        name = (robot, updates, 0, f"SNES {SIGMAS[1]} for {LONG * seconds:g} s")
        yield name, patient, LONG * seconds, False


def table(rows: list[dict]) -> str:
    """Markdown: each start with every method; then the robust objective."""
    plain = [r for r in rows if not r["robust"]]
    seconds = sorted({round(r["seconds"]) for r in plain})
    lines = [
        f"Official v2 score; about {seconds[-1]} s of one core each; SNES by its initial sigma.",
        "",
        "| robot | updates | seed | method | start | "
        + " | ".join(f"{100 * m:.0f} % of the time" for m in MARKS[:-1])
        + " | end (float64) | steps |",
        "|---|---|---|---|---|" + "---|" * (len(MARKS) + 1),
    ]
    for r in plain:
        cells = [f"{m:.4f}" for m in [r["start"], *r["marks"][:-1], r["score"]]]
        head = [r["robot"], r["updates"], r["seed"], r["method"]]
        lines.append("| " + " | ".join(map(str, [*head, *cells, r["rounds"]])) + " |")
    lines += [
        "",
        "Robust objective: 32 random scenarios a step, or 16 a generation, beside the score. "
        "Robustness: median (range) over 5 benchmark keys.",
        "",
        "| robot | method | s | start | robustness | best score | robustness | last | robustness |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    spread = lambda v: f"{np.median(v):.3f} ({v[0]:.3f} to {v[-1]:.3f})"  # noqa: E731
    for r in (r for r in rows if r["robust"]):
        cells = [r["robot"], r["method"], f"{r['seconds']:.0f}"]
        for part in ("start", "", "last"):
            name = f"{part}_" if part else ""
            score = r["start"] if part == "start" else r[f"{name}score"]
            cells += [f"{score:.4f}", spread(r[f"{name}robustness"])]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is missing and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="of CPU, a row")
    parser.add_argument("--robust-seconds", type=float, default=40.0)
    parser.add_argument("--runs", type=Path, default=Path("runs/gradient"), help="of the starts")
    args = parser.parse_args()
    kept = HERE / "gradient.json"
    rows = json.loads(kept.read_text()) if kept.exists() else []
    names = ("robot", "updates", "seed", "method", "robust")
    done = {tuple(r[n] for n in names) for r in rows}
    for name, config, seconds, robust in plan(args.seconds, args.robust_seconds):
        if (*name, robust) in done:
            continue
        robot, updates, seed, method = name
        kind = method.split()[0]
        row = row_of(robot, updates, seed, kind, config, seconds, args.runs, robust)
        rows.append(dict(zip(names, (*name, robust), strict=True)) | row)
        console.print(f"{name}: {row['start']:.4f} -> {row['score']:.4f}")
        emit_json(rows, kept)
        (HERE / "gradient.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
