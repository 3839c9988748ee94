"""The whole job: SAC on a surrogate reward, then the searches on the official score."""

import contextlib
import dataclasses
import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .. import devices, hosts
from ..boards import named_board, task_of
from ..config import Run, SearchRun
from ..controller import Controller
from ..controllers.catalogue import find_controller
from ..errors import JaxpendError
from ..files import to_json, write_atomically
from ..gradient import Gradient
from ..openings import Openings
from ..runs.folder import RunFolder, refuse_no_group, refuse_other
from ..runs.statistics import summary
from ..sac.stage import SAC, Imitation
from ..shac import SHAC
from ..snes import SNES
from ..stage import Stage
from ..task import Task
from ..terminal import LiveProgress, console
from .interrupt import Stopped, deferred, stop_if_asked
from .seed_run import SeedRun

__all__ = ["STAGES", "stages_of", "train"]

# The stages that there are, in their order. A configuration has those for which ``Stage.of`` says
# so; nothing else in the program knows them by name.
STAGES: tuple[type[Stage], ...] = (Imitation, SAC, Openings, Gradient, SHAC, SNES)


def train_stage(stage: Stage, runs: Sequence[SeedRun]) -> None:
    """Take runs through a stage, or the rest of it; those at the same step move on together.

    Raises:
        Stopped: a signal asked for it, and the runs are on disk.
        hosts.Gone: another host is, and the runs are on disk.
    """

    def running():
        return [r for r in runs if not r.failed and stage.done(r.state) < stage.total]

    with LiveProgress(stage.title, stage.total) as progress:
        for run in runs:
            if run.stage != stage.name:
                run.enter(stage)
        try:
            while behind := running():
                stop_if_asked(hosts.agreed)
                least = min(stage.done(run.state) for run in behind)
                group = [run for run in behind if stage.done(run.state) == least]
                before = runs[0].best_score
                after = stage.advance([run.state for run in group])
                rows = [run.take(stage, *done) for run, done in zip(group, after, strict=True)]
                if any(r.folder.seconds - r.saved >= r.config.checkpoint.every for r in group):
                    for run in running():
                        run.checkpoint()
                note = stage.note(rows[0]) if len(runs) == 1 else f"{len(group)} seeds"
                note += best_so_far(stage, runs, before)
                progress.report(min(stage.done(group[0].state), stage.total), note)
        except (Stopped, hosts.Gone) as end:
            for run in running():
                run.checkpoint()
            if isinstance(end, Stopped):
                where = running()[0].where(stage)
                raise Stopped(end.signum, f"stopped {where}") from None
            raise
    for run in runs:
        if not run.failed:
            run.leave(stage)


def best_so_far(stage: Stage, runs: Sequence[SeedRun], before: float) -> str:
    """The best score, for people; of one run, what the last chunk has made of ``before``."""
    best = float(np.median([run.best_score for run in runs]))
    if not math.isfinite(best):
        return ""
    if len(runs) > 1:
        return f"  median best {best:.4f}"
    at = runs[0].best_at
    equalled = "equalled" if at == stage.done(runs[0].state) else f"kept since {at:,}"
    return f"  best {best:.4f}, {'improved' if best > before else equalled}"


def stages_of(
    config: Run, start: Controller | None, task: Task, kinds: Sequence[type[Stage]] = STAGES
) -> dict[str, Stage]:
    """The stages of a configuration, by name; ``start`` is what a stage alone starts from."""
    stages: dict[str, Stage] = {}
    for kind in kinds:
        stage = kind.of(config, start, task)
        if stage is not None:
            stages[stage.name] = stage
            start = stage.policy_like() or start
    return stages


def train(
    config: Run, command: str = "jaxpend.train.train", kinds: Sequence[type[Stage]] = STAGES
) -> dict[str, Any]:
    """The stages that the configuration has, in its run folder: begun, or taken up again.

    ``command`` goes into the policy files, to say what made them, and is what a person is told to
    go on with. ``kinds`` are the stages that there are, in order. The score of each stage is the
    official one, computed in float64.

    Returns what ``result.json`` says; of several seeds, ``statistics.summary``, which is in
    ``seeds.json``. A run that is finished is not trained again.

    Of several hosts the first writes the folder, and all return the same.

    Raises:
        JaxpendError: the folder cannot be used or written, training diverged, or another host is
            gone, and everything is on disk.
        Stopped: a signal asked for it, and everything is on disk.
    """
    hosts.join(config.hosts, config.host, config.coordinator)
    devices.use(config.devices)
    with tempfile.TemporaryDirectory(prefix="jaxpend-") as scratch:
        there = hosts.working_copy(config.folder, Path(scratch) / config.folder.name)
        if there != config.folder:
            config = dataclasses.replace(config, runs=str(there.parent), run=there.name)
            console.quiet = True
        try:
            return _train(config, command, kinds)
        except Stopped as stop:
            text = f"{stop}; everything is in {there}; to go on: {command}"
            raise Stopped(stop.signum, text) from None
        except hosts.Gone as gone:
            text = f"{gone}; everything is in {there}; to go on: {command}"
            raise JaxpendError(text) from None


def _train(config: Run, command: str, kinds: Sequence[type[Stage]]) -> dict[str, Any]:
    """What ``train`` does on one host, on all alike."""
    names = (config.robot, config.plant, config.design, config.board, config.preset)
    task, start = task_of(*names), None
    if isinstance(config, SearchRun):
        # Before the folder is made: a wrong file leaves nothing behind.
        start = find_controller(config.policy, config.controller, task)
    board = dataclasses.replace(named_board(config.robot, config.board), task=task)
    stages = stages_of(config, start, task, kinds)
    about = {"plant": dict(task.parameters), "stages": [s.about() for s in stages.values()]}
    vmap = config.vmap == "yes" or (config.vmap == "auto" and jax.default_backend() != "cpu")
    seeds, runs, waiting = config.of_seeds(), [], []
    if config.seeds > 1:
        refuse_no_group(config.folder)
    for one in seeds:  # before the first folder is made
        refuse_other(one.folder, one, about)
    with contextlib.ExitStack() as opened:
        for one in seeds:
            folder = opened.enter_context(RunFolder(one.folder, one, command, about))
            runs.append(SeedRun(one, folder, board, start))
        for run in runs:
            if (result := run.folder.result) is None:
                waiting.append(run)
            else:
                text = f"{run.folder.path} is finished: score {result['score']:.4f}"
                console.print(text, soft_wrap=True)
        with deferred():
            for group in [waiting] if vmap else [[run] for run in waiting]:
                train_group(group, stages)
    failed = [run for run in runs if run.failed]
    results = [result for run in runs if (result := run.folder.result) is not None]
    if config.seeds == 1 and results:
        return results[0]
    said: dict[str, Any] = {}
    if results:
        headings = {"start": "start"} | {stage.name: stage.heading for stage in stages.values()}
        said = summary(results, headings)
        write_atomically(config.folder / "seeds.json", to_json(said, indent=2) + "\n")
    if failed:
        seed = f"seed {failed[0].config.seed}: " if config.seeds > 1 else ""
        raise JaxpendError(seed + failed[0].failed)
    return said


def train_group(runs: Sequence[SeedRun], stages: Mapping[str, Stage]) -> None:
    """Take runs through the stages that they have not been through, together; then finish them."""
    for run in runs:
        run.begin(stages)
    names = list(stages)
    for number, stage in enumerate(stages.values()):
        going = [run for run in runs if not run.failed]
        there = [run for run in going if not run.stage or names.index(run.stage) <= number]
        if there:
            train_stage(stage, there)
    for run in runs:
        if not run.failed:
            run.finish()
