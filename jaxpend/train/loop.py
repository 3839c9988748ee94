"""The whole job: SAC on the surrogate reward, then the gradient and SNES on the official score."""

import contextlib
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..boards import v2
from ..config import GradientRun, Run, SACRun, SNESRun, TrainRun
from ..controller import Controller
from ..controllers.catalogue import find_controller
from ..errors import JaxpendError
from ..files import to_json, write_atomically
from ..runs.checkpoints import Checkpoints
from ..runs.folder import RunFolder
from ..runs.reader import RESULTS
from ..runs.seeds import seeds_table, summary
from ..score import official
from ..terminal import LiveProgress, console, score_table
from .interrupt import Stopped, deferred, stop_if_asked
from .stages import SAC, SNES, Gradient, Imitation, Stage

__all__ = ["execute", "train"]


@dataclasses.dataclass
class SeedRun:
    """The run of one seed: where it is, and what a checkpoint of it holds."""

    config: Run
    folder: RunFolder
    checkpoints: Checkpoints
    stage: str = ""  # name of the stage it is in
    state: Any = None  # of the stage
    best: Controller | None = None  # by the official score; None in a stage without policies
    best_score: float = -math.inf
    best_at: int = 0
    rollbacks: int = 0
    stage_began: float = 0.0  # s since the run began
    result: dict = dataclasses.field(default_factory=dict)
    failed: str = ""  # why it cannot go on
    saved: float = 0.0  # s since the run began, when the last checkpoint was written

    # What of it goes into the JSON part of a checkpoint.
    PLAIN: ClassVar = ("stage", "best_score", "best_at", "rollbacks", "stage_began", "result")

    def begin(self, stages: Mapping[str, Stage], start: Controller | None) -> None:
        """Go on from the newest good checkpoint, or from the beginning if there is none."""

        def like(about):
            if about["metrics_bytes"] > self.folder.metrics_bytes:
                raise ValueError("metrics.jsonl is shorter than it was")
            stage = stages[about["stage"]]
            return {"state": stage.like(), "best": stage.policy_like()}

        found = self.checkpoints.newest(like)
        if found is None:
            self.folder.rewind()
            self.state, self.result = start, {"robot": self.config.robot, "seed": self.config.seed}
            if start is not None:
                self.result["start"] = official(start, self.config.robot)
            return
        arrays, about = found
        self.folder.rewind(about["metrics_bytes"], about["seconds"])
        self.state, self.best, self.saved = arrays["state"], arrays["best"], about["seconds"]
        for name in self.PLAIN:
            setattr(self, name, about[name])
        stage = stages[self.stage]
        if self.best is not None:
            self._save_best(stage)  # the file may be of a later time
        console.print(f"resuming {self.folder.path} {self.where(stage)}", soft_wrap=True)

    def where(self, stage: Stage) -> str:
        """Where it is, for people."""
        done = min(stage.done(self.state), stage.total)
        return f"in {stage.title} at {done:,} of {stage.total:,} {stage.unit}"

    def checkpoint(self) -> None:
        """Put everything on disk."""
        about = {name: getattr(self, name) for name in self.PLAIN}
        about |= {"metrics_bytes": self.folder.metrics_bytes, "seconds": self.folder.seconds}
        self.checkpoints.save({"state": self.state, "best": self.best}, about)
        self.saved = self.folder.seconds

    def enter(self, stage: Stage) -> None:
        """Begin a stage with what the one before it came to."""
        self.state = stage.start(self.config.seed, self.state)
        self.stage, self.best, self.best_score, self.best_at = stage.name, None, -math.inf, 0
        row, candidates = stage.judge(self.state, {})
        self._keep_best(stage, candidates)
        if "score" in row:
            self.folder.log(stage.name, **{stage.column: stage.done(self.state)}, **row)

    def take(self, stage: Stage, state: Any, metrics: dict) -> dict:
        """A chunk is done: judge it and log it; if it diverged, go back or give up."""
        row, candidates = stage.judge(state, metrics)
        at = stage.done(state)
        row = {stage.column: at, **row, "rollbacks": self.rollbacks}
        if all_finite((stage.watched(state), metrics)):
            self.state = state
            self.folder.log(stage.name, **row)
            self._keep_best(stage, candidates)
            if candidates:
                self._save(f"{stage.name}_last.npz", candidates[0][0], stage, at)
            return row
        text = f"{stage.title} diverged at {at:,} {stage.unit}"
        goes_on = self.config.on_divergence == "rollback"
        goes_on &= self.rollbacks < self.config.max_rollbacks
        if goes_on:
            self.rollbacks += 1
            self.state = stage.rekey(self.state, self.rollbacks)
            console.print(f"{text}; going on {self.where(stage)} with another key", soft_wrap=True)
        else:
            self.checkpoint()
            self.failed = f"{text}; {self._advice(stage)}"
        self.folder.log(stage.name, **row, finite=0)  # not in the checkpoint, since it comes again
        return row

    def _advice(self, stage: Stage) -> str:
        text = f"the last good state, {self.where(stage)}, is in {self.checkpoints.folder}"
        text += ", the best policy beside it; a new run with a lower learning rate may help"
        if self.config.on_divergence == "stop":
            text += ", or to go on in this one with --on-divergence rollback"
        return text

    def _keep_best(self, stage: Stage, candidates: Sequence[tuple[Controller, float]]) -> None:
        for policy, score in candidates:
            if score > self.best_score or (stage.ties and score == self.best_score):
                self.best, self.best_score, self.best_at = policy, score, stage.done(self.state)
                self._save_best(stage)

    def _save_best(self, stage: Stage) -> None:
        self._save(f"{stage.name}_best.npz", self.best, stage, self.best_at)

    def _save(self, name: str, policy: Controller, stage: Stage, at: int) -> None:
        about = {"stage": stage.name, stage.column: at, "seed": self.config.seed}
        self.folder.save(name, policy, **about)

    def leave(self, stage: Stage) -> None:
        """The stage is done: its result, and in ``state`` what the next one starts from."""
        self.checkpoint()
        if self.best is not None:
            now = self.folder.seconds
            seconds = round(now - self.stage_began, 1)
            self.result[stage.name] = official(self.best, self.config.robot) | {"seconds": seconds}
            self.result["score"] = self.result[stage.name]["score"]
            self.stage_began = now
        self.state = stage.outcome(self.state, self.best)

    def finish(self) -> None:
        """All stages are done: the policy and the result; the checkpoints have done their job."""
        score = self.result["score"]
        self.folder.save("policy.npz", self.best, seed=self.config.seed, score=score)
        self.folder.write_json("result.json", self.result)
        self.checkpoints.clear()


@jax.jit
def all_finite(tree: Any) -> jax.Array:
    """Whether no floating-point number in a pytree is infinite or NaN."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in leaves]))


def train_stage(stage: Stage, runs: Sequence[SeedRun]) -> None:
    """Take runs through a stage, or the rest of it; those at the same step move on together.

    Raises:
        Stopped: a signal asked for it, and the runs are on disk.
    """

    def running():
        return [r for r in runs if not r.failed and stage.done(r.state) < stage.total]

    with LiveProgress(stage.title, stage.total) as progress:
        for run in runs:
            if run.stage != stage.name:
                run.enter(stage)
        while behind := running():
            try:
                stop_if_asked()
            except Stopped as stop:
                for run in behind:
                    run.checkpoint()
                raise Stopped(stop.signum, f"stopped {behind[0].where(stage)}") from None
            least = min(stage.done(run.state) for run in behind)
            group = [run for run in behind if stage.done(run.state) == least]
            after = stage.advance([run.state for run in group])
            rows = [run.take(stage, *done) for run, done in zip(group, after, strict=True)]
            if any(r.folder.seconds - r.saved >= r.config.checkpoint.every for r in group):
                for run in running():
                    run.checkpoint()
            note = stage.note(rows[0]) if len(runs) == 1 else f"{len(group)} seeds"
            best = float(np.median([run.best_score for run in runs]))
            note += f"  best {best:.4f}" if math.isfinite(best) else ""
            progress.report(min(stage.done(group[0].state), stage.total), note)
    for run in runs:
        if not run.failed:
            run.leave(stage)


def stages_of(config: Run, start: Controller | None) -> dict[str, Stage]:
    """The stages of a configuration, by name; ``start`` is what a stage alone starts from."""
    stages: list[Stage] = []
    if isinstance(config, SACRun):
        if config.sac.demonstrations.episodes:
            stages.append(Imitation(config.sac))
        stages.append(SAC(config.sac))
        start = stages[-1].policy_like()
    if getattr(config, "gradient", None) and config.gradient.steps:
        stages.append(Gradient(config.gradient, start, config.robot))
    if isinstance(config, SNESRun | TrainRun):
        guarding = getattr(config, "guard", None)
        stages.append(SNES(config.snes, start, config.robot, guarding))
    return {stage.name: stage for stage in stages}


def train(config: Run, command: str = "jaxpend.train.train") -> dict:
    """The stages that the configuration has, in its run folder: begun, or taken up again.

    ``command`` goes into the policy files, to say what made them, and is what a person is told to
    go on with. The score of each stage is the official one, computed in float64.

    Returns what ``result.json`` says; of several seeds, ``seeds.summary``, which is in
    ``seeds.json``. A run that is finished is not trained again.

    Raises:
        JaxpendError: the folder cannot be used or written, or training diverged.
        Stopped: a signal asked for it, and everything is on disk.
    """
    start = None
    if isinstance(
        config, GradientRun | SNESRun
    ):  # before the folder is made: a wrong file leaves nothing behind
        task = v2(config.robot).task
        start = find_controller(config.policy, config.controller, task)
    stages = stages_of(config, start)
    vmap = config.vmap == "yes" or (config.vmap == "auto" and jax.default_backend() != "cpu")
    with contextlib.ExitStack() as opened:
        runs = []
        for one in config.of_seeds():
            folder = opened.enter_context(RunFolder(one.folder, one, command))
            checkpoints = Checkpoints(folder.path / "checkpoints", one.checkpoint.keep)
            runs.append(SeedRun(one, folder, checkpoints))
        waiting = [run for run in runs if run.folder.result is None]
        for run in runs:
            if run not in waiting:
                score = run.folder.result["score"]
                console.print(f"{run.folder.path} is finished: score {score:.4f}", soft_wrap=True)
        try:
            with deferred():
                for group in [waiting] if vmap else [[run] for run in waiting]:
                    train_group(group, stages, start)
        except Stopped as stop:
            text = f"{stop}; everything is in {config.folder}; to go on: {command}"
            raise Stopped(stop.signum, text) from None
    failed = [f"seed {run.config.seed}: {run.failed}" for run in runs if run.failed]
    results = [run.folder.result for run in runs if not run.failed]
    if config.seeds > 1 and results:
        write_atomically(config.folder / "seeds.json", to_json(summary(results), indent=2) + "\n")
    if failed:
        raise JaxpendError(failed[0] if config.seeds > 1 else runs[0].failed)
    return results[0] if config.seeds == 1 else summary(results)


def train_group(runs: Sequence[SeedRun], stages: Mapping[str, Stage], start: Any) -> None:
    """Take runs through the stages that they have not been through, together; then finish them."""
    for run in runs:
        run.begin(stages, start)
    names = list(stages)
    for number, stage in enumerate(stages.values()):
        there = [
            r for r in runs if not r.failed and (not r.stage or names.index(r.stage) <= number)
        ]
        if there:
            train_stage(stage, there)
    for run in runs:
        if not run.failed:
            run.finish()


def execute(config: Run, command: str) -> None:
    """``train``, the score table, and where the results are."""
    result = train(config, command)
    if config.seeds > 1:
        seeds_table(result)
    else:
        score_table({RESULTS[k]: result[k] for k in RESULTS if k in result}, config.robot)
    console.print(f"policy.npz, metrics and result are in [bold]{config.folder}[/bold]")
