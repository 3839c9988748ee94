"""Remake experiments/published.md and .json: the authors' own policies on our plant, judged here.

git clone https://github.com/dfki-ric-underactuated-lab/double_pendulum
python experiments/published.py double_pendulum/data/policies/design_C.1

Nothing of that repository is copied; the script reads the models where they lie.
"""

from pathlib import Path

from jaxpend import cli, leaderboard
from jaxpend.boards import v2
from jaxpend.fields import Count, Seed
from jaxpend.files import write_atomically
from jaxpend.interop.stable_baselines3 import declared, read_model
from jaxpend.robots import ROBOTS
from jaxpend.terminal import console

HERE = Path(__file__).parent
# Title on the boards, preset, and where the model lies.
MODELS = (
    ("Evolutionary SAC", "evolsac", "model_1.0/{robot}/evolsac/model.zip"),
    ("AR-EAPO", "ar_eapo", "model_1.1/{robot}/AR_EAPO/model.zip"),
)
INTRO = """# The published policies of the v2 boards, judged here

Imported with `jaxpend import` from the authors' files (`python experiments/published.py FOLDER`).
Performance in float64; robustness in float32, the median of {keys} keys and their range. The
boards' robustness is one draw of noise and pulses.

| robot | policy | performance, board | here | robustness, board | here |
|---|---|---:|---:|---:|---:|
"""


def main(folder: Path, /, keys: Count = 3, seed: Seed = 0) -> None:
    """Judge the published policies on both boards.

    Args:
        folder: data/policies/design_C.1 of the reference repository.
        keys: repetitions of what the benchmark draws; the table shows median and range.
        seed: of the first key.
    """
    rows, lines = [], []
    for robot in ROBOTS:
        board = v2(robot)
        boards = {title: values for title, *values in board.published}
        for title, preset, place in MODELS:
            console.print(f"judging {title} of the {robot} ...")
            path = folder / place.format(robot=robot)
            policy = read_model(path, robot, declared(path, preset)).policy
            judged = leaderboard.judge(lambda _, it=policy: it, board, keys=keys, seed=seed)
            score, robustness = boards[title]
            row = {"robot": robot, "title": title, "preset": preset, "board_score": score}
            rows.append(row | {"board_robustness": robustness} | judged)
            draws = judged["robustness_by_key"]
            cells = [robot, title, f"{score:.3f}", f"{judged['score']:.3f}", f"{robustness:.3f}"]
            cells.append(f"{judged['robustness']:.3f} ({min(draws):.3f} to {max(draws):.3f})")
            lines.append(f"| {' | '.join(cells)} |\n")
    cli.emit_json(rows, HERE / "published.json")
    write_atomically(HERE / "published.md", INTRO.format(keys=keys) + "".join(lines))


if __name__ == "__main__":
    cli.run(main, "experiments/published.py")
