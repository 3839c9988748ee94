"""Remake experiments/leaderboard.md and .json: both robots, every controller, measured here.

python experiments/leaderboard.py                        everything; MPC takes most of the time
python experiments/leaderboard.py --controllers tvlqr    only these rows; the others are kept
"""

import json
from functools import partial
from pathlib import Path

from jaxpend import cli, designs, leaderboard
from jaxpend.boards import v2
from jaxpend.controllers.catalogue import CATALOGUE, build
from jaxpend.errors import choose
from jaxpend.files import write_atomically
from jaxpend.terminal import console

HERE = Path(__file__).parent


def merged(path: Path, robot: str, row: dict) -> dict:
    """All boards of the file, with this row in place of an earlier measurement of it."""
    boards = json.loads(path.read_text()) if path.exists() else {}
    rows = boards.get(robot, {}).get("rows", [])
    rows = [r for r in rows if r["source"] == "measured" and r["name"] != row["name"]]
    rows = sorted([*rows, row, *leaderboard.published(v2(robot))], key=lambda r: -r["score"])
    boards[robot] = {"robot": robot, "rows": rows}
    return boards


def main(
    controllers: str = ",".join(CATALOGUE),
    robots: str = ",".join(designs.ROBOTS),
    keys: int = 3,
    seed: int = 0,
    robustness: bool = True,
) -> None:
    """Judge controllers on both boards; every row is on disk as soon as it is measured.

    Args:
        controllers: names separated by commas.
        robots: likewise.
        keys: repetitions of what the benchmark draws; the table shows median and range.
        seed: of the first key.
        robustness: False measures performance only.
    """
    names = [choose("controller", name, CATALOGUE) for name in controllers.split(",")]
    path = HERE / "leaderboard.json"
    intro = "# Leaderboards v2: measured by `python experiments/leaderboard.py`, and published\n\n"
    for name in names:
        for robot in (choose("robot", r, designs.ROBOTS) for r in robots.split(",")):
            title = CATALOGUE[name].title
            console.print(f"judging {title} of the {robot} ...")
            row = {"name": name, "title": title, "source": "measured"}
            make = partial(build, name, robot=robot)
            options = {"keys": keys, "seed": seed, "robustness": robustness}
            row |= leaderboard.judge(make, v2(robot), **options)
            boards = merged(path, robot, row)
            cli.emit_json(boards, path)
            tables = [
                (r, leaderboard.markdown(boards[r] | {"columns": v2(r).columns}))
                for r in designs.ROBOTS
                if r in boards
            ]
            text = "\n".join(f"## {r}\n\n{table}" for r, table in tables)
            write_atomically(path.with_suffix(".md"), intro + text)


if __name__ == "__main__":
    cli.run(main, "experiments/leaderboard.py")
