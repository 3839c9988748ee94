"""The functions behind the subcommands: parameters are options, docstrings the help.

Nothing heavy is imported before a command runs, so that its help does not wait for jax, and names
for results are checked before it computes.
"""

import dataclasses
import sys
import time
from pathlib import Path

from ..config import GradientRun, Run, SACRun, Search, SHACRun, SNESRun, TrainRun
from ..errors import JaxpendError
from ..fields import BoardName, Count, Natural, Robot, Seed
from .benchmarking import robustness as robustness
from .exporting import export as export
from .fleets import hardware as hardware
from .identifying import identify as identify
from .importing import import_ as import_
from .judging import Subject, board_of, of_draws
from .output import MARKDOWN, check_apart, check_file, check_json, check_results, emit, emit_json


def train(config: TrainRun, command: str) -> None:
    """The stages of training that a recipe has; ends with the official score.

    They are imitation, where it has demonstrations; SAC; other ways to begin, where it has a count
    of openings; the gradient and SHAC, where they have steps; SNES, where it has generations.
    """
    execute(config, command)


def sac(config: SACRun, command: str) -> None:
    """SAC on the surrogate reward, in a run folder."""
    execute(config, command)


def gradient(config: GradientRun, command: str) -> None:
    """The gradient of the smooth score, from a policy or any other controller, in a run folder."""
    execute(config, command)


def shac(config: SHACRun, command: str) -> None:
    """The short-horizon actor-critic, from a policy of the v3 board, in a run folder."""
    execute(config, command)


def snes(config: SNESRun, command: str) -> None:
    """SNES on the official score, from a policy or any other controller, in a run folder."""
    execute(config, command)


def execute(config: Run, command: str) -> None:
    """``train.train``, then the score table, and where the results are."""
    board = board_of(config.robot, config.plant, config.design, config.board)
    from ..hosts import first
    from ..runs.reader import read_run
    from ..terminal import console
    from ..train import train
    from .tables import score_table, seeds_table

    result = train(config, command)
    if not first():  # the first host says it
        return
    if config.seeds > 1:
        seeds_table(result)
    else:
        score_table(read_run(config.folder).results, board)
    console.print(f"policy.npz, metrics and result are in {config.folder}", soft_wrap=True)


def runs(folder: Path = Path("runs"), /, json: str | None = None) -> None:
    """List the runs in a folder, with their state and official scores.

    Args:
        folder: folder of run folders.
        json: write the list as JSON to this file, or "-" for standard output.
    """
    check_json(json, "state")
    from ..runs.reader import listing
    from .tables import runs_table

    entries = listing(folder)
    if json != "-":
        runs_table(entries)
    emit_json(entries, json)


def report(
    run: Path, /, controller: str | None = None, out: Path | None = None, robustness: bool = True
) -> None:
    """One page about a run, report.html, that needs no network, and pictures beside it.

    Args:
        run: a run folder, finished or not, a folder of seeds, a policy or controller file, or
            the name of a policy that ships with the package, such as acrobot.
        controller: as in jaxpend score: a known one, which is judged around the policy of RUN, or
            module:name with the classes that its file needs. Where RUN is a robot, any one.
        out: folder for report.html and report/*.png; by default the run folder, or else
            runs/NAME.
        robustness: run the robustness benchmark too, seconds for every seed.
    """
    folder = out or (run if run.is_dir() else Path("runs") / run.stem)
    drawn = [(f"report/{name}.png", b"Software\0jaxpend") for name in ("learning", "swingup")]
    mark = ("report.html", b"jaxpend</title>")
    check_results(folder, ["report.html"], mark)
    check_results(folder, ["report"], mark, *drawn)  # there first, where one was stopped
    from ..runs.reader import find, remarks
    from ..terminal import console

    found = find(run)
    for sentence in remarks(found):
        console.print(sentence, soft_wrap=True)
    from ..report.page import write

    title = ", ".join(filter(None, (run.resolve().name, controller)))
    page = write(found, folder, title=title, robustness=robustness, controller=controller)
    pictures = page.with_suffix("")
    console.print(f"the report is {page}; pictures are in {pictures}", soft_wrap=True)


def score(
    robot: Robot = "pendubot",
    policy: str | None = None,
    controller: str | None = None,
    plant: str | None = None,
    design: str | None = None,
    csv: str | None = None,
    hardware: bool = False,
    save: str | None = None,
    json: str | None = None,
    board: BoardName = "v2",
    seed: Seed | None = None,
    draws: Count | None = None,
) -> None:
    """Official score of a controller or of a recorded run, in float64 (means over draws: float32).

    Args:
        robot: which joint is driven: the second of the acrobot, the first of the pendubot.
        board: v2; v3, the one of global policies; or hardware, real robots that differ, with
            their normalisation (how many of them stand: jaxpend hardware).
        policy: a policy or controller file; by default the policy that ships with the package.
        controller: judge this instead: a known one such as tvlqr, or module:name of a
            controller, of one written for RealAIGym, or of a Python function (t, x) -> torque.
            With a policy too: the known one around it, or the file of your own classes.
        plant: YAML file of the parameters of another plant than that of the boards.
        design: or an identified plant by name, such as C.1/1.0.
        seed: on a board on which chance plays, judge this draw alone, in float64.
        draws: or the first so many; by default all: 1000 of v3, 200 robots of hardware.
        csv: judge this recorded trajectory instead, a file in the layout of RealAIGym.
        hardware: with the normalisation for real robots; a recording may then have a clock
            that is not exact.
        save: write the run that is judged to this CSV file, which --csv and RealAIGym read.
        json: write the result as JSON to this file, or "-" for standard output.
    """
    check_json(json, "criteria")
    check_file(save)
    check_apart(json=json, save=save)
    from .. import boards
    from .tables import score_table

    subject = Subject(robot, policy, controller, plant, design, on=board)
    judged_on = boards.hardware(subject.board) if hardware else subject.board
    _check_draws(judged_on, seed, draws, save, csv)
    judged_on = of_draws(judged_on, draws)
    if save is not None:
        from ..interop.csv import check_target

        check_target(save)
    if csv is None:
        about, name = subject.about, subject.name
        result = _scored(subject, judged_on, seed, save) | about
    else:
        result, name = _recorded(csv, subject, judged_on, hardware, save), csv
    result["board"] = judged_on.name
    if json != "-":
        shown = 1 if seed is not None or csv is not None else judged_on.draws
        score_table({name: result}, dataclasses.replace(judged_on, draws=shown))
    emit_json(result, json)


def _check_draws(board, seed, draws, save, csv):
    """Refuse options that name draws where there are none, two of them, and a file for several."""
    given = [f"--{n}" for n, v in {"seed": seed, "draws": draws}.items() if v is not None]
    if given and csv is not None:
        raise JaxpendError(f"--csv is a run that is there already; leave out {given[0]}")
    if len(given) == 2:
        raise JaxpendError("--seed is one draw and --draws are the first of them; give one of them")
    if seed is not None and not board.task.chance:
        raise JaxpendError(f"--seed names a draw, of which the {board.name} board has none")
    if save is not None and csv is None and seed is None and board.task.chance:
        raise JaxpendError("--save writes one run; name its draw, such as --seed 0")


def _scored(subject, board, seed, save):
    """What ``official`` says of a controller, and its run in a file."""
    import jax

    from ..score import official, official_run

    with jax.enable_x64(True):
        judged = subject.find(board)
    if save is None and seed is None:
        return official(judged, board)
    run, result = official_run(judged, board, seed or 0)
    result |= {"seed": seed} if board.task.chance else {}
    if save is not None:
        from ..interop.csv import save_csv

        save_csv(save, run)
    return result


def _recorded(csv, subject, board, hardware, save):
    """What ``recorded`` says of a file."""
    if subject.policy or subject.controller or save:
        given = [f"--{n}" for n in ("policy", "controller") if getattr(subject, n)]
        text = f"--csv is a run that is there already; leave out {(given or ['--save'])[0]}"
        raise JaxpendError(text)
    from ..interop.csv import load_csv
    from ..score import recorded

    run = load_csv(csv)
    try:
        result = recorded(run, board, regular=not (hardware or board.task.spread))
    except JaxpendError as error:
        raise JaxpendError(f"{csv}: {error}") from None
    return result | {"csv": csv, "plant": subject.plant, "design": subject.design}


def leaderboard(
    robot: Robot = "pendubot",
    controllers: str | None = None,
    policy: str | None = None,
    controller: str | None = None,
    plant: str | None = None,
    design: str | None = None,
    robustness: bool = True,
    keys: Count = 3,
    seed: Seed = 0,
    json: str | None = None,
    out: Path | None = None,
    board: BoardName = "v2",
    draws: Count | None = None,
    devices: Natural = 0,
) -> None:
    """Judge controllers on performance and robustness, next to the published ones.

    Args:
        robot: which joint is driven: the second of the acrobot, the first of the pendubot.
        board: v2; or v3, of global policies, or hardware, which have no robustness benchmark.
        draws: of v3 or hardware, to take the mean of; by default 1000 and 200.
        controllers: names separated by commas; by default all that are known.
        policy: a policy or controller file to judge as well.
        controller: or another one to judge as well, as in jaxpend score.
        plant: YAML file of the parameters of another plant than that of the boards.
        design: or an identified plant by name, such as C.1/1.0.
        robustness: run the robustness benchmark too (minutes for MPC).
        keys: repetitions of what the benchmark draws at random; the median counts.
        seed: of the benchmark's first key.
        devices: how many GPUs, or cores of a processor, share the runs; 0: all.
        json: write the result as JSON to this file, or "-" for standard output.
        out: write the table as Markdown to this file, or "-" for standard output.
    """
    check_json(json, "columns")
    check_file(out, MARKDOWN)
    check_apart(json=json, out=out)
    from .. import leaderboard as boards
    from ..devices import use
    from ..terminal import console
    from .tables import leaderboard_table

    use(devices)

    def say(line: str) -> None:
        console.print(line, style="dim")

    judged_on = of_draws(board_of(robot, plant, design, board), draws)
    chosen = boards.chosen(controllers, policy, controller, judged_on.task)
    options = {"robustness": robustness, "keys": keys, "seed": seed}
    result = boards.leaderboard(judged_on, chosen, say=say, **options)
    result |= {"board": judged_on.name, "draws": judged_on.draws, "plant": plant, "design": design}
    leaderboard_table(result, judged_on)
    emit_json(result, json)
    emit(boards.markdown(result), out)


def optimise(
    robot: Robot,
    command: str,
    out: Path | None = None,
    json: str | None = None,
    search: Search = Search(),
) -> None:
    """Find the best swing-up and write its trajectory file.

    Args:
        robot: which joint is driven: the second of the acrobot, the first of the pendubot.
        out: trajectory file to write.
        json: report of all optima to write; "-" for standard output.
        search: how widely to look.
    """
    check_file(out)
    check_json(json, "optima")
    check_apart(json=json, out=out)
    import jax

    from ..boards import v2
    from ..trajopt.reference import check_target, save_reference
    from ..trajopt.search import find

    if out is not None:
        check_target(out)
    start = time.perf_counter()

    def say(line: str) -> None:
        if sys.stderr is not None:  # else Python would print it among the results
            print(f"[{time.perf_counter() - start:5.0f} s] {line}", file=sys.stderr, flush=True)

    with jax.enable_x64(True):
        found = find(v2(robot).task, search, say=say)
    for _, report in found:
        seconds, turns = report["criteria"]["swingup_time"], report["turns_of_theta2"]
        say(f"score {report['score']:.4f}, up after {seconds:.2f} s, turns of theta2 {turns:+d}")
    reference, report = found[0]
    if out is not None:
        save_reference(out, reference, {"command": command, **report})
        say(f"wrote {out}")
    optima = [report for _, report in found]
    emit_json({"robot": robot, "search": dataclasses.asdict(search), "optima": optima}, json)
