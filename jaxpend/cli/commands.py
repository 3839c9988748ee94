"""The functions behind the subcommands: parameters are options, docstrings the help.

Nothing heavy is imported before a command runs, so that its help does not wait for jax.
"""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Literal

from ..config import GradientRun, SACRun, Search, SNESRun, TrainRun
from ..errors import JaxpendError
from ..files import write_atomically
from ..robots import active_joint
from .app import emit_json

__all__ = [
    "gradient",
    "leaderboard",
    "optimise",
    "report",
    "robustness",
    "runs",
    "sac",
    "score",
    "snes",
    "train",
]


def train(config: TrainRun, command: str) -> None:
    """SAC on the surrogate reward, then the gradient and SNES on the score, in a run folder."""
    from ..train.loop import execute

    execute(config, command)


def sac(config: SACRun, command: str) -> None:
    """SAC on the surrogate reward, in a run folder."""
    from ..train.loop import execute

    execute(config, command)


def gradient(config: GradientRun, command: str) -> None:
    """The gradient of the smooth score, from a policy or any other controller, in a run folder."""
    from ..train.loop import execute

    execute(config, command)


def snes(config: SNESRun, command: str) -> None:
    """SNES on the official score, from a policy or any other controller, in a run folder."""
    from ..train.loop import execute

    execute(config, command)


def runs(folder: Path = Path("runs"), /, json: str | None = None) -> None:
    """List the runs in a folder, with their state and official scores.

    Args:
        folder: folder of run folders.
        json: write the list as JSON to this file, or "-" for standard output.
    """
    from ..runs.reader import listing, runs_table

    entries = listing(folder)
    if json != "-":
        runs_table(entries)
    emit_json(entries, json)


def report(run: Path, /, out: Path | None = None, robustness: bool = True) -> None:
    """One page about a run, report.html, that needs no network, and pictures beside it.

    Args:
        run: a run folder, finished or not, a folder of seeds, a policy or controller file, or
            acrobot or pendubot for the policy that ships with the package.
        out: folder for report.html and report/*.png; by default the run folder, or else
            runs/NAME.
        robustness: run the robustness benchmark too, seconds for every seed.
    """
    from ..runs.reader import find, remarks
    from ..terminal import console

    found = find(run)
    for sentence in remarks(found):
        console.print(sentence, highlight=False, markup=False, soft_wrap=True)
    from ..report.page import write

    folder = out or (run if run.is_dir() else Path("runs") / run.stem)
    page = write(found, folder, title=run.resolve().name, robustness=robustness)
    line = f"the report is {page}; pictures are in {page.with_suffix('')}"
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def score(robot: str = "pendubot", policy: str | None = None, json: str | None = None) -> None:
    """Official v2 score of a policy or any other saved controller, in float64.

    Args:
        robot: acrobot or pendubot.
        policy: a policy or controller file; by default the policy that ships with the package.
        json: write the result as JSON to this file, or "-" for standard output.
    """
    active_joint(robot)
    import jax

    from ..controllers.files import load_controller, read_header
    from ..score import official
    from ..terminal import score_table

    with jax.enable_x64(True):
        loaded = load_controller(policy or robot, robot=robot)
    header = read_header(policy or robot)
    result = official(loaded, robot) | {"policy": policy or robot, "header": header}
    if json != "-":
        score_table({str(policy or f"shipped {robot}"): result}, robot)
    emit_json(result, json)


def robustness(
    robot: str = "pendubot",
    policy: str | None = None,
    controller: str | None = None,
    torque_limit: float = 6.0,
    seed: int = 0,
    keys: int = 3,
    precision: Literal["float32", "float64"] = "float32",
    scored: bool = False,
    map: tuple[str, str] | None = None,
    worst: int = 0,
    chunk: int | None = None,
    out: Path | None = Path("runs/robustness"),
    json: str | None = None,
) -> None:
    """The official six-criterion robustness benchmark of a controller.

    Args:
        robot: acrobot or pendubot.
        policy: a policy or controller file; by default the policy that ships with the package.
        controller: judge this instead: a known one such as tvlqr, or module:name of a
            controller, or of a Python function (t, x) -> torque, which takes minutes (see
            jaxpend.controllers.python). With a policy too: the known one around that policy, or
            the file of a controller of your own classes.
        torque_limit: of the driven joint, N m; 6 on the boards.
        seed: of the first key.
        keys: repeat the criteria that draw something this often, for the spread.
        precision: float32, or float64 as the reference computes.
        scored: the mean v2 performance score at every grid value as well.
        map: success over two imperfections, such as "m2 delay", 21 x 21 runs.
        worst: look for the mildest combination of imperfections that fails, in so many tries.
        chunk: runs at a time; less needs less memory.
        out: folder for picture, CSV and JSON, with both robots side by side once both are
            there; None writes nothing.
        json: write the result as JSON to this file, or "-" for standard output.
    """
    active_joint(robot)
    if worst < 0:
        raise JaxpendError(f"worst is {worst}; it must not be negative")
    import jax

    from .. import boards
    from ..controllers.catalogue import find_controller
    from ..robustness import benchmark, nominal_and_worst, success_map
    from ..sweep import mildest_failure
    from ..terminal import robustness_table

    with jax.enable_x64(precision == "float64"):
        task = dataclasses.replace(boards.v2(robot).task, torque_limit=torque_limit)
        plant = task.plant
        judged = find_controller(policy, controller, task)
        key = jax.random.key(seed)
        result = {"robot": robot, "controller": controller or policy or robot, "seed": seed}
        result |= {"precision": precision, "torque_limit": torque_limit}
        options = {"scored": scored, "chunk": chunk}
        result |= benchmark(judged, plant, key, keys=keys, **options).as_dict()
        if map is not None:
            result["map"] = success_map(judged, plant, map, key, options)
        if worst:
            bounds = nominal_and_worst(plant)
            result["worst"] = mildest_failure(plant, judged, bounds, key, samples=worst)
    robustness_table(result, robot)
    if out is not None:
        from ..report.figures import write_robustness

        write_robustness(result, out)
    emit_json(result, json)


def leaderboard(
    robot: str = "pendubot",
    controllers: str | None = None,
    policy: Path | None = None,
    robustness: bool = True,
    keys: int = 1,
    seed: int = 0,
    json: str | None = None,
    out: Path | None = None,
) -> None:
    """Judge controllers on performance and robustness, next to the published ones.

    Args:
        robot: acrobot or pendubot.
        controllers: names separated by commas; by default all that are known.
        policy: a policy or controller file to judge as well.
        robustness: run the robustness benchmark too (minutes for MPC).
        keys: repetitions of what the benchmark draws at random.
        seed: of the benchmark's first key.
        json: write the result as JSON to this file, or "-" for standard output.
        out: write the table as Markdown to this file.
    """
    active_joint(robot)
    from .. import leaderboard as boards
    from ..boards import v2
    from ..terminal import console

    chosen = boards.chosen(controllers, policy, robot)
    say = lambda line: console.print(line, style="dim")  # noqa: E731
    options = {"robustness": robustness, "keys": keys, "seed": seed}
    board = boards.leaderboard(v2(robot), chosen, say=say, **options)
    boards.show(board)
    emit_json(board, json)
    if out is not None:
        write_atomically(out, boards.markdown(board))


def optimise(
    robot: Literal["acrobot", "pendubot"],
    out: Path | None = None,
    json: str | None = None,
    search: Search = Search(),
) -> None:
    """Find the best swing-up and write its trajectory file.

    Args:
        robot: which joint is driven.
        out: trajectory file to write.
        json: report of all optima to write; "-" for standard output.
        search: how widely to look.
    """
    import jax

    from ..boards import v2
    from ..trajopt.reference import save_reference
    from ..trajopt.search import find

    start = time.perf_counter()
    say = lambda line: print(  # noqa: E731
        f"[{time.perf_counter() - start:5.0f} s] {line}", file=sys.stderr, flush=True
    )
    with jax.enable_x64(True):
        found = find(v2(robot).task, search, say=say)
    for _, report in found:
        seconds, turns = report["criteria"]["swingup_time"], report["turns_of_theta2"]
        say(f"score {report['score']:.4f}, up after {seconds:.2f} s, turns of theta2 {turns:+d}")
    reference, report = found[0]
    command = f"jaxpend optimise --robot {robot} --search.seed {search.seed}"
    if out is not None:
        save_reference(out, reference, {"command": command, **report})
        say(f"wrote {out}")
    emit_json(
        {"robot": robot, "search": dataclasses.asdict(search), "optima": [r for _, r in found]},
        json,
    )
