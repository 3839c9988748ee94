"""Remake experiments/leaderboard.md and .json: both robots, every controller, measured here.

python experiments/leaderboard.py                        everything; MPC takes most of the time
python experiments/leaderboard.py --controllers tvlqr    only these rows; the others are kept
"""

import json
from pathlib import Path

from jaxpend import cli, designs, leaderboard
from jaxpend.controllers.known import KNOWN, build
from jaxpend.errors import choose
from jaxpend.files import write_atomically
from jaxpend.terminal import console

HERE = Path(__file__).parent
# Those that need a policy file are judged by the experiments that make one.
CLASSICAL = [name for name in KNOWN if not name.startswith("policy")]


def kept(robot: str, names: list[str], path: Path) -> list[dict]:
    """Rows of an earlier run that are not measured again."""
    if not path.exists():
        return []
    rows = json.loads(path.read_text())[robot]["rows"]
    return [r for r in rows if r["source"] == "measured" and r["name"] not in names]


def main(
    controllers: str = ",".join(CLASSICAL), keys: int = 3, seed: int = 0, robustness: bool = True
) -> None:
    """Judge controllers on both boards.

    Args:
        controllers: names separated by commas.
        keys: repetitions of what the benchmark draws; the table shows the first key.
        seed: of the first key.
        robustness: False measures performance only.
    """
    names = [choose("controller", name, KNOWN) for name in controllers.split(",")]
    path = HERE / "leaderboard.json"
    boards, text = {}, ""
    for robot in designs.ROBOTS:
        chosen = {
            name: (KNOWN[name].title, lambda plant, n=name, r=robot: build(n, plant, r))
            for name in names
        }
        board = leaderboard.leaderboard(
            robot, chosen, say=console.print, keys=keys, seed=seed, robustness=robustness
        )
        rows = board["rows"] + kept(robot, names, path)
        board["rows"] = sorted(rows, key=lambda row: -row["score"])
        boards[robot] = board
        text += f"## {robot}\n\n{leaderboard.markdown(board)}\n"
    cli.emit_json(boards, path)
    intro = "# Leaderboards v2: measured by `python experiments/leaderboard.py`, and published\n\n"
    write_atomically(HERE / "leaderboard.md", intro + text.rstrip() + "\n")


if __name__ == "__main__":
    cli.run(main, "experiments/leaderboard.py")
