"""Everything that fine-tunes a policy, on equal processor time of one core.

    python experiments/search.py

writes search.json and search.md beside this file. What is in the json is not measured again.

1. Step sizes. Every method gets some, from two policies that are not among those of part 2, in
   half the time; the best by the score it ends with is used from then on.
2. The score: every method from policies that imitate, of few and of all updates of that recipe,
   and from policies of SAC alone, which hardly swing up. Three seeds.
3. Robustness: methods that meet random scenarios against one that does not, around guarded
   policies, as in that recipe, and around a network alone. Judged by scenarios that no method met.

All is done by the stages of ``jaxpend train``, in their chunks; judging between chunks is in the
time, compilation is not. A method keeps its best candidate as the commands do: by the official
score, or with scenarios by the weighted mean with that of 256 validation scenarios.
"""

import argparse
import dataclasses
import json
import os
import time
from functools import partial
from pathlib import Path

# One thread, so that processor time is wall clock on a machine of one's own.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import numpy as np

from jaxpend import designs, leaderboard, load_policy
from jaxpend.boards import v2
from jaxpend.cli import emit_json
from jaxpend.config import GradientConfig, Objective, SACRun, SNESConfig
from jaxpend.config_files import load_config
from jaxpend.controllers import guard
from jaxpend.files import write_atomically
from jaxpend.gradient import Gradient
from jaxpend.snes import SNES, STRATEGIES
from jaxpend.sweep import sweep
from jaxpend.terminal import console
from jaxpend.train.loop import train
from jaxpend.variations import sample

HERE = Path(__file__).parent
SEEDS = (0, 1, 2)
# Starts: updates of imitation, or SAC from the reward alone with its default configuration.
SECONDS = {"5000": 8, "40000": 8, "sac": 12}  # of the processor
ROBUST_SECONDS = 30
# The gradient's schedule ends with its steps, which about fill the time on our machine.
STEPS = 440
GENERATIONS = 100  # of the search whose sigma shrinks; it ends with them
METHODS = {name: {} for name in STRATEGIES}
METHODS |= {"snes, shrinking": {"final_sigma": 0.1}, "gradient": {}}
# Sigmas, or learning rates, that are tried.
SIZES = {
    "40000": dict.fromkeys(METHODS, (0.0001, 0.0003, 0.003, 0.01))
    | {"gradient": (3e-5, 1e-4, 3e-4, 1e-3)},
    "sac": dict.fromkeys(STRATEGIES, (0.003, 0.01, 0.03)) | {"gradient": (1e-4, 1e-3)},
}
ROBUST = {  # methods of part 3, and their options
    "before": None,
    "snes, 16 scenarios": {"scenarios": 16, "objective": Objective(0.5), "population": 20},
    "snes": {},
    "gradient, 32 scenarios": {"scenarios": 32, "objective": Objective(0.8)},
}
ROBUST_RATE = 1e-4  # of the gradient; at what is best for the score nothing better was found
ROBUST_STEPS = {"guarded": 60, "network": 150}
HELD_OUT = 512  # scenarios that judge
ROW = ("part", "start", "robot", "seed", "method")  # what names a row


def start_of(kind: str, robot: str, seed: int, runs: Path):
    """A policy to start from; trained once and kept in ``runs``."""
    folder = runs / f"{kind}-{robot}-{seed}"
    if not (folder / "policy.npz").exists():
        config = SACRun(robot=robot, seed=seed, runs=str(runs), run=folder.name)
        if kind != "sac":  # fewer steps than the actor's delay: imitation alone
            config = load_config(config, f"demonstrated_{robot}", also=("snes", "guard"))
            shown = dataclasses.replace(config.sac.demonstrations, updates=int(kind))
            sac = dataclasses.replace(config.sac, demonstrations=shown, steps=32)
            config = dataclasses.replace(config, sac=sac)
        train(config, "python experiments/search.py")
    return load_policy(folder / "policy.npz")


def stage_of(method: str, size: float, share: float, robot: str, policy, **options):
    """The stage of ``jaxpend train`` that a method is, with a step size; ``share`` of schedules."""
    method, options = method.split(",")[0], options | {"searched": "weights"}
    task = v2(robot).task
    if method == "gradient":
        return Gradient(GradientConfig(round(share * STEPS), size, **options), policy, task)
    # Without a schedule, until the time is over.
    generations = round(share * GENERATIONS) if "final_sigma" in options else 10**6
    options |= {"generations": generations, "action_noise": 0.0}
    return SNES(SNESConfig(method, sigma=size, **options), policy, task)


def climb(stage, start, seed: int, seconds: float):
    """The best policy after some processor time, and how many rounds and seconds that took.

    The first chunk is done twice: the first time it compiles.
    """
    state = stage.start(seed, start)
    clock = time.process_time

    def chunk(state):
        began = clock()
        ((state, metrics),) = stage.advance([state])
        _, found = stage.judge(state, jax.block_until_ready(metrics))
        return state, found, clock() - began

    _, (*_, (best, worth)) = stage.judge(state, {})
    cold, warm, spent = chunk(state)[2], None, 0.0
    while spent < seconds and stage.done(state) < stage.total:
        state, found, took = chunk(state)
        warm, spent = took if warm is None else warm, spent + took
        for policy, its_worth in found:
            if its_worth > worth:
                best, worth = policy, its_worth
    row = {"rounds": stage.done(state), "seconds": spent, "compile": max(cold - warm, 0.0)}
    return best, row


def in_scenarios(policy, robot: str) -> dict:
    """What becomes of scenarios that no method met: mean score, and how many end upright."""
    key, plant = jax.random.key(20_260_731), designs.competition(robot)
    keys = jax.random.split(key, HELD_OUT)
    scenarios = jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda k: sample(plant, k)))(keys))
    seen = sweep(scenarios, policy, jax.random.fold_in(key, 1), scored=True)
    return {"held_out": float(seen.score.mean()), "survived": float(seen.success.mean())}


def chosen(rows: dict, start: str) -> dict[str, float]:
    """The step size of every method: the best from the policy of part 1 that is of this kind."""
    kind = start if start in SIZES else "40000"
    tried = [r for r in rows.values() if r["part"] == "size" and r["start"] == kind]
    of = {m: [r for r in tried if r["method"].rsplit(" ", 1)[0] == m] for m in SIZES[kind]}
    return {m: max(found, key=lambda r: r["score"])["size"] for m, found in of.items()}


def plan(rows: dict):
    """Names of rows, and what ``measure`` takes; what comes later looks at ``rows``."""

    def sized(start, robot, seed):
        for method, sizes in SIZES[start].items():
            for size in sizes:
                about = size, 0.5, SECONDS[start] / 2, METHODS[method]
                yield ("size", start, robot, seed, f"{method} {size}"), about

    def scored(start, robot):
        for method, size in chosen(rows, start).items():
            for seed in SEEDS:
                about = size, 1.0, SECONDS[start], METHODS[method]
                yield ("score", start, robot, seed, method), about

    def hardened(part, robot):
        for method, options in ROBUST.items():
            kind = method.split(",")[0]
            size = ROBUST_RATE if kind == "gradient" else chosen(rows, "40000").get(kind)
            share = ROBUST_STEPS[part] / STEPS
            about = None if options is None else (size, share, ROBUST_SECONDS, options)
            for seed in SEEDS:
                yield (part, "40000", robot, seed, method), about

    yield from sized("40000", "pendubot", 0)
    yield from scored("40000", "acrobot")
    yield from hardened("guarded", "acrobot")
    yield from sized("sac", "pendubot", 0)
    yield from scored("sac", "acrobot")
    for seed in SEEDS:  # is it the strategy, or its sigma?
        about = chosen(rows, "sac")["lm_ma_es"], 1.0, SECONDS["sac"], {}
        yield ("score", "sac", "acrobot", seed, "snes, sigma of lm_ma_es"), about
    for part, robot in (("network", "acrobot"), ("guarded", "pendubot")):
        yield from hardened(part, robot)
    yield from scored("5000", "pendubot")


def measure(name: tuple, about: tuple | None, runs: Path) -> dict:
    """A row of ``plan``."""
    part, kind, robot, seed, method = name
    start = start_of(kind, robot, seed, runs)
    start = guard(start, robot) if part == "guarded" else start
    benchmarked = part in ROBUST_STEPS
    row, best = dict(zip(ROW, name, strict=True)), start
    if about is not None:
        size, share, seconds, options = about
        row["size"] = size
        if part == "size":
            method = method.rsplit(" ", 1)[0]
        stage = stage_of(method, size, share, robot, start, **options)
        best, effort = climb(stage, start, seed, seconds)
        row |= effort
    judge = partial(leaderboard.judge, board=v2(robot), robustness=benchmarked, keys=3)
    found = judge(lambda plant: best)
    row["score"] = found["score"]
    if not benchmarked:
        return row | {"before": judge(lambda plant: start)["score"]}
    row |= {name: found[name] for name in ("robustness", "robustness_by_key")}
    return row | in_scenarios(best, robot)


def each(group: list[dict], name: str, digits: int) -> str:
    """A number of every seed."""
    return ", ".join(f"{row[name]:.{digits}f}" for row in group)


def effort(group: list[dict]) -> list[str]:
    """Rounds, lowest to highest, and the most that compilation took."""
    rounds = [row["rounds"] for row in group]
    few, many = min(rounds), max(rounds)
    return [
        f"{few}" if few == many else f"{few} to {many}",
        f"{max(r['compile'] for r in group):.0f} s",
    ]


def lines_of(cells: list[list]) -> list[str]:
    """Rows of a table."""
    return ["| " + " | ".join(map(str, row)) + " |" for row in cells]


def tables(rows: list[dict]) -> str:
    """Markdown: the three parts."""
    groups = {}
    for row in rows:
        kind = row["method"].rsplit(" ", 1)[0] if row["part"] == "size" else row["method"]
        groups.setdefault((row["part"], row["start"], row["robot"], kind), []).append(row)
    tried, compared, hardened = [], [], []
    for part, start, robot, method in sorted(groups, key=lambda g: g[:3]):
        group = groups[part, start, robot, method]
        head = [robot, start, method]
        if part == "size":
            group = sorted(group, key=lambda row: row["size"])
            found = ", ".join(f"{row['size']:g}: {row['score']:.4f}" for row in group)
            tried.append([*head, f"{group[0]['before']:.4f}", found])
        elif part == "score":
            scores = [each(group, "before", 4), each(group, "score", 4)]
            compared.append([*head, f"{group[0]['size']:g}", *scores, *effort(group)])
        else:
            names = (("score", 4), ("held_out", 3), ("survived", 3), ("robustness", 3))
            numbers = [each(group, *name) for name in names]
            about = ["", ""] if method == "before" else effort(group)
            about.insert(0, "" if method == "before" else f"{group[0]['size']:g}")
            hardened.append([robot, part, method, *numbers, *about])
    lines = [
        "# What fine-tunes a policy: `python experiments/search.py`", "",
        "Official v2 scores (float64). One core, processor time without compilation: "
        f"{SECONDS['5000']} s from policies that imitate (5000 or 40 000 updates), "
        f"{SECONDS['sac']} s from SAC without demonstrations (`sac`), {ROBUST_SECONDS} s in "
        "part 3; the machine was shared. Step size: "
        "sigma of the weights (population 40, no action noise), or the gradient's learning rate. "
        "Rounds: generations, or the gradient's steps.", "",
        "## 1. Choice of step sizes, in half the time", "",
        "| robot | start | method | before | step size: after |", "|---|---|---|---|---|",
        *lines_of(tried), "",
        f"## 2. The score: seeds {', '.join(map(str, SEEDS))}", "",
        "| robot | start | method | step size | before | after | rounds | compile |",
        "|---|---|---|---|---|---|---|---|", *lines_of(compared), "",
        "## 3. Robustness", "",
        f"From 40 000 updates; mean score and survivors of {HELD_OUT} random scenarios that no "
        "method met; robustness: median of three benchmark keys. With scenarios: 16 a generation "
        "of 20, or 32 a step.", "",
        "| robot | policy | method | score | mean score in scenarios | survived | robustness "
        "| step size | rounds | compile |",
        "|---|---|---|---|---|---|---|---|---|---|", *lines_of(hardened),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure what is missing, and write the tables after every row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, default=Path("runs/search"), help="of the starts")
    args = parser.parse_args()
    kept = HERE / "search.json"
    rows = json.loads(kept.read_text()) if kept.exists() else []
    rows = {tuple(row[n] for n in ROW): row for row in rows}
    for name, about in plan(rows):
        if name not in rows:
            rows[name] = measure(name, about, args.runs)
            console.print(f"{name}: {rows[name]['score']:.4f}")
            emit_json(list(rows.values()), kept)
            write_atomically(kept.with_suffix(".md"), tables(list(rows.values())))
    print(tables(list(rows.values())))


if __name__ == "__main__":
    main()
