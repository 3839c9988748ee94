"""The run of one seed: where it is in its stages, and what of it is on disk."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from ..boards import Board
from ..config import Run
from ..controller import Controller
from ..pytree import Pytree
from ..runs.checkpoints import Checkpoints
from ..runs.folder import RunFolder
from ..score import official
from ..stage import Candidates, Stage, standing
from ..terminal import console

__all__ = ["SeedRun", "all_finite"]


@dataclasses.dataclass
class SeedRun:
    """The run of one seed: where it is, and what a checkpoint of it holds."""

    config: Run
    folder: RunFolder
    board: Board
    start: Controller | None = None  # what a user has it start from
    stage: str = ""  # name of the stage it is in
    state: Pytree | None = None  # of the stage it is in: its ``State``
    outcome: Any = None  # of the stage before, for the next one: its ``After``
    best: Controller | None = None  # by the official score; None in a stage without policies
    best_score: float = -math.inf
    best_at: int = 0
    rollbacks: int = 0
    stage_began: float = 0.0  # s since the run began
    stood: float = 0.0  # ``stage.standing`` of what the stage began with, where that counts
    result: dict = dataclasses.field(default_factory=dict)
    failed: str = ""  # why it cannot go on
    saved: float = 0.0  # s since the run began, when the last checkpoint was written

    # What of it goes into the JSON part of a checkpoint.
    PLAIN: ClassVar = (
        "stage", "best_score", "best_at", "rollbacks", "stage_began", "stood", "result",
    )  # fmt: skip

    def __post_init__(self) -> None:
        keep = self.config.checkpoint.keep
        self.checkpoints = Checkpoints(self.folder.path / "checkpoints", keep)

    def begin(self, stages: Mapping[str, Stage]) -> None:
        """Go on from the newest good checkpoint, or from the beginning if there is none."""

        def like(about):
            if about["metrics_bytes"] > self.folder.metrics_bytes:
                raise ValueError("metrics.jsonl is shorter than it was")
            stage = stages[about["stage"]]
            return {"state": stage.like(), "best": stage.policy_like()}

        found = self.checkpoints.newest(like)
        if found is None:
            self.folder.rewind()
            self.result = {"robot": self.config.robot, "seed": self.config.seed}
            if self.start is not None:
                self.result["start"] = official(self.start, self.board)
            return
        arrays, about = found
        self.folder.rewind(about["metrics_bytes"], about["seconds"])
        self.state, self.best, self.saved = arrays["state"], arrays["best"], about["seconds"]
        for name in self.PLAIN:
            setattr(self, name, about.get(name, getattr(self, name)))
        stage = stages[self.stage]
        if self.best is not None:
            self._save("best", stage, self.best, self.best_at)  # the file may be of a later time
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
        before = self.start if self.outcome is None else self.outcome
        self.state = stage.start(self.config.seed, before)
        self.outcome = None  # with its replay buffer
        self.stage, self.best, self.best_score, self.best_at = stage.name, None, -math.inf, 0
        row, candidates = stage.judge(self.state, {})
        self._keep_best(stage, candidates)
        if candidates and stage.objective.weight:
            self.stood = standing(candidates[0][0], self.board.task)
        if "score" in row:  # a point to begin the curves with
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
                self._save("last", stage, candidates[0][0], at)
            return row
        text = f"{stage.title} diverged at {at:,} {stage.unit}"
        rollback = self.config.on_divergence == "rollback"
        if rollback and self.rollbacks < self.config.max_rollbacks:
            self.rollbacks += 1
            self.state = stage.rekey(self.state, self.rollbacks)
            console.print(f"{text}; going on {self.where(stage)} with another key", soft_wrap=True)
        else:
            self.checkpoint()
            text += f"; the last good state, {self.where(stage)}, is in {self.checkpoints.folder}"
            text += ", the best policy beside it; a new run with a lower learning rate may help"
            text += "" if rollback else ", or to go on in this one with --on-divergence rollback"
            self.failed = text
        self.folder.log(stage.name, **row, finite=0)  # not in the checkpoint, since it comes again
        return row

    def _keep_best(self, stage: Stage, candidates: Candidates) -> None:
        for policy, score in candidates:
            if score > self.best_score or (stage.ties and score == self.best_score):
                self.best, self.best_score, self.best_at = policy, score, stage.done(self.state)
                self._save("best", stage, policy, self.best_at)

    def _save(self, kept: str, stage: Stage, policy: Controller, at: int) -> None:
        about = {"stage": stage.name, stage.column: at, "seed": self.config.seed}
        self.folder.save(f"{stage.name}_{kept}.npz", policy, **about)

    def leave(self, stage: Stage) -> None:
        """The stage is done: its result, and what the next one starts from."""
        self.checkpoint()
        if self.best is not None:
            now = self.folder.seconds
            seconds = round(now - self.stage_began, 1)
            result = official(self.best, self.board) | {"seconds": seconds}
            if stage.objective.weight:
                after = standing(self.best, self.board.task)
                result["standing"] = {"before": self.stood, "after": after}
            self.result[stage.name], self.result["score"] = result, result["score"]
            self.stage_began = now
        self.outcome = stage.outcome(self.state, self.best)

    def finish(self) -> None:
        """All stages are done: the policy and the result; the checkpoints have done their job."""
        assert self.best is not None
        score = self.result["score"]
        self.folder.save("policy.npz", self.best, seed=self.config.seed, score=score)
        self.folder.write_json("result.json", self.result)
        self.checkpoints.clear()


@jax.jit
def all_finite(tree: Any) -> jax.Array:
    """Whether no floating-point number in a pytree is infinite or NaN."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in leaves]))
