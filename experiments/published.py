"""Remake experiments/published.md and .json: the authors' own policies on our plant, judged here.

git clone https://github.com/dfki-ric-underactuated-lab/double_pendulum
python experiments/published.py double_pendulum/data/policies/design_C.1

Nothing of that repository is copied; the script reads the models where they lie.
"""

import dataclasses
import itertools
from pathlib import Path

from jaxpend import cli, leaderboard
from jaxpend.boards import v2
from jaxpend.fields import Count, Seed
from jaxpend.files import write_atomically
from jaxpend.interop.stable_baselines3 import declared, read_model
from jaxpend.robots import ROBOTS
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


def main(folder: Path, /, keys: Count = 3, seed: Seed = 0) -> None:
    """Judge the published policies on both boards.

    Args:
        folder: data/policies/design_C.1 of the reference repository.
        keys: repetitions of what the benchmark draws; the table shows median and range.
        seed: of the first key.
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
            row = leaderboard.judge(lambda _, it=policy: it, board, keys=keys, seed=seed)
            row |= {"robot": robot, "title": title, "preset": preset, "torque_limit": limit}
            rows.append(row | {"board_score": score, "board_robustness": robustness})
            draws = row["robustness_by_key"]
            cells = [robot, title, f"{limit:g}", f"{score:.3f}", f"{row['score']:.3f}"]
            cells += [f"{robustness:.3f}", f"{row['robustness']:.3f}"]
            cells[-1] += f" ({min(draws):.3f} to {max(draws):.3f})"
            lines.append(f"| {' | '.join(cells)} |\n")
    cli.emit_json(rows, HERE / "published.json")
    write_atomically(HERE / "published.md", INTRO.format(keys=keys) + "".join(lines))


if __name__ == "__main__":
    cli.run(main, "experiments/published.py")
