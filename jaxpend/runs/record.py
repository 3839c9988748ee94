"""``python -m jaxpend.report RUN``: one page about a run that needs nothing else, and pictures."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import JaxpendError
from .reader import STAGES, seed_folders

__all__ = ["CURVES", "Found", "find", "remarks"]

# Policies of a run, the final one first.
POLICIES = ("policy.npz", "snes_best.npz", "gradient_best.npz", "sac_best.npz")
# Stage -> its title, the column on x, what that is, and the charts: title, label -> column,
# label on y, logarithmic.
CURVES = {
    "imitation": ("Imitation", "updates", "updates", (
        ("Squared error", {"loss": "loss"}, "of the action", True),
    )),
    "sac": ("SAC", "env_steps", "environment steps", (
        ("Official score", {"best so far": "best", "now": "score"}, "v2 score", False),
        ("Reward", {"reward": "reward"}, "mean of a step", False),
        ("Temperature", {"temperature": "temperature"}, "", True),
        ("Entropy of the policy", {"entropy": "entropy"}, "nats", False),
        ("Loss of the critics", {"loss": "critic_loss"}, "", True),
        ("Loss of the actor", {"loss": "actor_loss"}, "", False),
    )),
    "gradient": ("Gradient", "step", "steps", (
        ("Official score", {"best so far": "best", "now": "score"}, "v2 score", False),
        ("Smooth score", {"smooth score": "smooth_score"}, "of the nominal run", False),
        ("Norm of the gradient", {"norm": "slope"}, "", True),
    )),
    "snes": ("SNES", "generation", "generations", (
        ("Fitness", {"mean": "mean_fitness", "best": "max_fitness"}, "noisy v2 score", False),
        ("Official score", {"best so far": "best", "mean": "mean_score"}, "v2 score", False),
        ("Standard deviation", {"sigma": "sigma"}, "of the parameters", False),
    )),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Found:
    """What one run has left on disk so far."""

    name: str
    robot: str
    config: dict  # empty for a policy without a run
    rows: list[dict]  # of metrics.jsonl, in order
    result: dict | None  # None: not finished
    policy: str | None  # path, or robot for what ships with the package; None: none yet
    made_by: dict = dataclasses.field(default_factory=dict)  # command and version

    @property
    def stages(self) -> dict[str, tuple[int, int]]:
        """Stage -> how far it is, and how far it is to go. The last chunk may go beyond."""
        goals = {s: self.config[s][total] for s, (_, total) in STAGES.items() if s in self.config}
        goals = {stage: goal for stage, goal in goals.items() if goal}
        demonstrations = self.config.get("sac", {}).get("demonstrations", {})
        if demonstrations.get("episodes"):
            goals = {"imitation": demonstrations["updates"], **goals}
        done = {}
        for stage, goal in goals.items():
            steps = [row[CURVES[stage][1]] for row in self.rows if row["stage"] == stage]
            done[stage] = (min(max(steps, default=0), goal), goal)
        return done


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError:
        raise JaxpendError(f"{path} is not valid JSON; the run cannot be read") from None


def _rows(path: Path) -> list[dict]:
    """Rows of metrics; what a crash cut off is left out, and what came twice counts once."""
    rows = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
            rows[row["stage"], row[CURVES[row["stage"]][1]]] = row
        except (ValueError, KeyError, TypeError):
            continue
    return [rows[key] for key in sorted(rows, key=lambda key: (key[0], key[1]))]


def _run(folder: Path) -> Found:
    config = _json(folder / "config.json")
    if not isinstance(config, dict) or "robot" not in config:
        raise JaxpendError(f"{folder}/config.json is not the configuration of a run")
    result = folder / "result.json"
    return Found(
        name=folder.name,
        robot=config["robot"],
        config=config,
        rows=_rows(folder / "metrics.jsonl"),
        result=_json(result) if result.exists() else None,
        policy=next((str(folder / n) for n in POLICIES if (folder / n).exists()), None),
        made_by=_json(folder / "run.json") if (folder / "run.json").exists() else {},
    )


def find(run: Path) -> list[Found]:
    """The runs that a path means: a run folder, a folder of seeds, a policy file, or a robot's
    name for the policy that ships with the package.

    Raises:
        JaxpendError: it is none of these, or cannot be read.
    """
    from ..controllers.files import read_header
    from ..robots import ROBOTS

    if seeds := seed_folders(run):
        return [_run(seed) for seed in seeds]
    if (run / "config.json").exists():
        return [_run(run)]
    if run.is_file() or (str(run) in ROBOTS and not run.exists()):
        return [Found(run.stem, read_header(run)["robot"], {}, [], None, str(run))]
    raise JaxpendError(
        f"{run} is not a run: give a folder that training has left (with config.json), a folder "
        f"of seeds, a policy file, or {' or '.join(ROBOTS)} for the policy that ships"
    )


def remarks(runs: Sequence[Found]) -> list[str]:
    """What is not finished, or went wrong on the way, a sentence each."""
    sentences = []
    for run in runs:
        if run.config and run.result is None:
            where = ", ".join(
                f"{CURVES[stage][0]} is at {done:,} of {total:,} {CURVES[stage][2]}"
                for stage, (done, total) in run.stages.items()
            )
            diverged = any(row.get("finite") == 0 for row in run.rows)
            sentences.append(f"{run.name} is not finished{' and diverged' * diverged}: {where}.")
        if back := max((row.get("rollbacks", 0) for row in run.rows), default=0):
            times = f"{back} time{'s' * (back > 1)}"
            sentences.append(f"{run.name} diverged and went back to its last good state {times}.")
    return sentences


if __name__ == "__main__":
    from ..cli.app import main

    main("report")
