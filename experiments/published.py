"""Remake experiments/published.md and .json: the authors' own policies on our plant, judged here.

git clone https://github.com/dfki-ric-underactuated-lab/double_pendulum
python experiments/published.py double_pendulum/data/policies/design_C.1
python experiments/published.py double_pendulum/data/policies/design_C.1 --rounding 8

The last line prints how far the criterion of delay, in which nothing is drawn, depends on rounding.
Nothing of that repository is copied; the script reads the models where they lie.
"""

import dataclasses
import itertools
from pathlib import Path

import jax
import numpy as np

from jaxpend import Policy, cli, leaderboard
from jaxpend.boards import strips, v2
from jaxpend.fields import Count, Natural, Seed
from jaxpend.files import write_atomically
from jaxpend.interop.stable_baselines3 import declared, read_model
from jaxpend.robots import ROBOTS
from jaxpend.sweep import survey
from jaxpend.task import Task
from jaxpend.terminal import console

HERE = Path(__file__).parent
# Title on the boards, preset, where the model lies, and torque limits of the plant, N m. That of
# the boards is 6, but con_evolsac.py sets the one parameter object, which the benchmark simulates
# too, to 3, so that noise and pulses cannot push it beyond.
MODELS = (
    ("Evolutionary SAC", "evolsac", "model_1.0/{robot}/evolsac/model.zip", (3.0, 6.0)),
    ("AR-EAPO", "ar_eapo", "model_1.1/{robot}/AR_EAPO/model.zip", (6.0,)),
)
INTRO = """# The published policies of the v2 boards, judged here

Imported with `jaxpend import` from the authors' files (`python experiments/published.py FOLDER`).
Performance in float64; robustness in float32, the median of {keys} keys and their range. The
boards' robustness is one draw of noise and pulses; that of Evolutionary SAC was measured on a
plant that is limited to 3 N m.

| robot | policy | plant, N m | performance, board | here | robustness, board | here |
|---|---|---:|---:|---:|---:|---:|
"""


def delays(policy: Policy, task: Task, draws: int) -> list[float]:
    """Shares of the grid of delays survived in float64, with weights changed by 1e-9 of each."""
    grid = next(strip.values for strip in strips(task.plant) if strip.criterion == "delay")
    rng, shares = np.random.default_rng(0), []
    for _ in range(draws):
        layers = tuple((w * (1 + 1e-9 * rng.normal(size=w.shape)), b) for w, b in policy.layers)
        changed = policy.replace(layers=layers)
        found = survey(task.plant, changed, {"delay": grid}, jax.random.key(0))
        shares.append(float(np.mean(found.success)))
    return shares


def main(folder: Path, /, keys: Count = 3, seed: Seed = 0, rounding: Natural = 0) -> None:
    """Judge the published policies on both boards.

    Args:
        folder: data/policies/design_C.1 of the reference repository.
        keys: repetitions of what the benchmark draws; the table shows median and range.
        seed: of the first key.
        rounding: do not judge, but print the criterion of delay for so many draws of rounding.
    """
    rows, lines = [], []
    for robot, (title, preset, place, limits) in itertools.product(ROBOTS, MODELS):
        path = folder / place.format(robot=robot)
        policy = read_model(path, robot, declared(path, preset)).policy
        (score, robustness), *_ = [v for name, *v in v2(robot).published if name == title]
        for limit in limits:
            console.print(f"judging {title} of the {robot} at {limit:g} N m ...")
            task = dataclasses.replace(v2(robot).task, torque_limit=limit)
            board = dataclasses.replace(v2(robot), task=task)
            if rounding:
                with jax.enable_x64(True):
                    shares = sorted(delays(policy, task, rounding))
                console.print("delays survived: " + ", ".join(f"{share:.3f}" for share in shares))
                continue
            row = leaderboard.judge(lambda _, it=policy: it, board, keys=keys, seed=seed)
            row |= {"robot": robot, "title": title, "preset": preset, "torque_limit": limit}
            rows.append(row | {"board_score": score, "board_robustness": robustness})
            draws = row["robustness_by_key"]
            cells = [robot, title, f"{limit:g}", f"{score:.3f}", f"{row['score']:.3f}"]
            cells += [f"{robustness:.3f}", f"{row['robustness']:.3f}"]
            cells[-1] += f" ({min(draws):.3f} to {max(draws):.3f})"
            lines.append(f"| {' | '.join(cells)} |\n")
    if rounding:
        return
    cli.emit_json(rows, HERE / "published.json")
    write_atomically(HERE / "published.md", INTRO.format(keys=keys) + "".join(lines))


if __name__ == "__main__":
    cli.run(main, "experiments/published.py")
