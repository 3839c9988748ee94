"""A training run: its task, seeds, devices and folder, and the stages that it has."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from ..errors import JaxpendError
from ..fields import LARGEST, BoardName, Bounds, Checked, Count, Natural, Preset, Robot, Seed
from .learning import SACConfig
from .searches import GradientConfig, GuardConfig, OpeningsConfig, SHACConfig, SNESConfig

__all__ = [
    "CheckpointConfig", "GradientRun", "Run", "SACRun", "SHACRun", "SNESRun", "SearchRun",
    "TrainRun",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class CheckpointConfig(Checked):
    """When training is put on disk, besides at the end of a stage and where it is stopped."""

    every: Annotated[float, Bounds(least=0, infinite=True)] = 60.0  # s
    keep: Count = 2  # the newest so many


@dataclasses.dataclass(frozen=True)
class Run(Checked):
    """What every training run has."""

    robot: Robot = "pendubot"
    board: BoardName = "v2"  # whose task it is; v3: of global policies; hardware: of real robots
    preset: Preset = "identified"  # how robots of the hardware board differ: jaxpend.hardware
    plant: str = ""  # file of the parameters of another plant; empty: that of the boards
    design: str = ""  # or an identified one by name, such as C.1/1.0
    seed: Seed = 0
    # How many runs, of the seeds from ``seed`` on, each in RUN/seedN.
    seeds: Annotated[int, Bounds(above=0, most=1000)] = 1
    vmap: Literal["auto", "yes", "no"] = "auto"  # seeds in one computation; auto: on a GPU or TPU
    # How many GPUs, or cores of a processor, share rollouts; 0: all. The cores share the steps of
    # SAC too where the number is given.
    devices: Natural = 0
    # Processes that compute the run together, of which this is number ``host``, and HOST:PORT of
    # number 0; hosts 0: those that the cluster's environment names.
    hosts: Natural = 1
    host: Natural = 0
    coordinator: str = ""
    # Name of the run folder; empty: ROBOT-seedSEED, of one stage alone ROBOT-STAGE-seedSEED, of
    # another board than v2 ROBOT-BOARD-...
    run: str = ""
    runs: str = "runs"  # folder of the run folders
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    on_divergence: Literal["stop", "rollback"] = "stop"  # or go on from before, another key
    max_rollbacks: Natural = 3  # in a run, before it stops after all
    tensorboard: bool = False  # the metrics as TensorBoard events too, in RUN/tensorboard

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seed + self.seeds > LARGEST:
            there = f"from seed {self.seed} on there are not so many"
            raise JaxpendError(f"seeds is {self.seeds}; {there}")
        if self.plant and self.design:
            raise JaxpendError("plant and design are both given; a run has one of them")

    @property
    def folder(self) -> Path:
        """Path of the run folder."""
        # A stage alone must not land in the folder of the whole run that it may start from.
        stages = {SACRun: "-sac", GradientRun: "-gradient", SHACRun: "-shac", SNESRun: "-snes"}
        stage = stages.get(type(self), "")
        seeds = f"s{self.seed}-{self.seed + self.seeds - 1}" if self.seeds > 1 else str(self.seed)
        task = "" if self.board == "v2" else f"-{self.board}"
        task += "" if self.preset == "identified" else f"-{self.preset}"
        return Path(self.runs) / (self.run or f"{self.robot}{task}{stage}-seed{seeds}")

    def of_seeds(self) -> list["Run"]:
        """A configuration for each seed; of several, each has a folder in ``folder``."""
        if self.seeds == 1:
            return [self]
        numbers, name = range(self.seed, self.seed + self.seeds), self.folder.name
        return [dataclasses.replace(self, seeds=1, seed=n, run=f"{name}/seed{n}") for n in numbers]


@dataclasses.dataclass(frozen=True)
class SACRun(Run):
    """SAC alone."""

    sac: SACConfig = dataclasses.field(default_factory=SACConfig)


@dataclasses.dataclass(frozen=True)
class SearchRun(Run):
    """A search alone, from a policy or any other controller."""

    policy: str = ""  # file to start from; empty: the policy that ships with the package
    controller: str = ""  # start instead from a known one, around that policy, or module:name


@dataclasses.dataclass(frozen=True)
class GradientRun(SearchRun):
    """The gradient alone."""

    gradient: GradientConfig = dataclasses.field(default_factory=GradientConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.gradient.steps:
            raise JaxpendError("gradient.steps is 0; a run of the gradient alone needs some")


@dataclasses.dataclass(frozen=True)
class SHACRun(SearchRun):
    """The short-horizon actor-critic alone."""

    shac: SHACConfig = dataclasses.field(default_factory=SHACConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.shac.steps:
            raise JaxpendError("shac.steps is 0; a run of it alone needs some")


@dataclasses.dataclass(frozen=True)
class SNESRun(SearchRun):
    """SNES alone."""

    snes: SNESConfig = dataclasses.field(default_factory=SNESConfig)


@dataclasses.dataclass(frozen=True)
class TrainRun(SACRun):
    """SAC; from its best policies openings, the gradient, SHAC, and SNES, guarded, if on."""

    openings: OpeningsConfig = dataclasses.field(default_factory=OpeningsConfig)
    gradient: GradientConfig = dataclasses.field(default_factory=lambda: GradientConfig(steps=0))
    shac: SHACConfig = dataclasses.field(default_factory=lambda: SHACConfig(steps=0))
    guard: GuardConfig = dataclasses.field(default_factory=GuardConfig)
    snes: SNESConfig = dataclasses.field(default_factory=SNESConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.snes.generations and (self.guard.observe or self.guard.rescue):
            text = "a guard needs some, since SNES begins with it"
            raise JaxpendError(f"snes.generations is 0; {text}")
