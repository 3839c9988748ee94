"""What can be configured: frozen plain dataclasses that load without jax.

The type of a field says which values it may have (``fields``); all raise ``JaxpendError`` for
values that make no sense.
"""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal, get_args

from .errors import JaxpendError
from .fields import (
    LARGEST,
    BoardName,
    Bounds,
    Checked,
    Count,
    Natural,
    NotNegative,
    Period,
    Positive,
    Preset,
    Robot,
    Seed,
    Share,
)
from .observation import Observation

__all__ = [
    "ACTIVATIONS", "Activation", "CheckpointConfig", "DemonstrationConfig", "EnvConfig",
    "GradientConfig", "GradientRun", "GuardConfig", "Objective", "OpeningsConfig", "Reward", "Run",
    "SACConfig", "SACRun", "SNESConfig", "SNESRun", "Search", "SearchRun", "TrainRun",
]  # fmt: skip

Activation = Literal["relu", "tanh", "silu"]
ACTIVATIONS: tuple[str, ...] = get_args(Activation)
Strategy = Literal["snes", "sep_cma_es", "lm_ma_es", "open_es"]
Duration = Annotated[float, Bounds(least=0.01, most=3600)]  # s
PositiveOrInfinite = Annotated[float, Bounds(above=0, infinite=True)]
Rate = Annotated[float, Bounds(above=0, most=1)]


@dataclasses.dataclass(frozen=True)
class Reward(Checked):
    """Coefficients of the surrogate reward; see jaxpend.env.surrogate_reward."""

    line: float | None = None  # m, height that separates the regimes; None: the paper's
    alpha: NotNegative = 2.0  # J, straight elbow above the line
    beta: NotNegative = 1.0  # kinetic energy above the line
    rho1: NotNegative = 0.1  # action squared, above the line
    rho2: NotNegative = 0.02  # action squared, below
    phi1: NotNegative = 0.15  # change of the action, above the line
    phi2: NotNegative = 0.15  # change of the action, below
    eta: NotNegative = 0.02  # s^2, joint velocities squared, below
    energy: NotNegative = 0.0  # distance of the energy from that of upright at rest, below
    # A step earns at least this; a spinning arm earns -100 and less.
    floor: Annotated[float, Bounds(most=0, infinite=True)] = -math.inf


@dataclasses.dataclass(frozen=True)
class Objective(Checked):
    """How much it counts, beside the score, what becomes of random imperfect scenarios.

    They are drawn by ``Task.sample``, never from the benchmark's grids or keys.
    """

    weight: Share = 0.0  # of the scenarios; 0: the score alone
    outcome: Literal["score", "success"] = "score"  # of which the mean over scenarios is taken
    validation: Count = 256  # scenarios, always the same, on which candidates are compared


@dataclasses.dataclass(frozen=True)
class EnvConfig(Checked):
    """The learning environment."""

    torque_limit: Positive = 3.0  # N m, torque at action 1
    dt: Period = 0.01  # s, control period
    duration: Duration = 10.0  # s, then the episode is truncated
    observation: Observation = dataclasses.field(default_factory=Observation)
    reward: Reward = dataclasses.field(default_factory=Reward)
    max_speed: PositiveOrInfinite = math.inf  # rad/s; an episode is truncated beyond it
    upright_starts: Share = 0.0  # share of episodes that start near upright, not hanging
    upright_spread: Positive = 0.03  # rad, standard deviation of both angles there; 3/s of speeds
    # Share that starts anywhere: uniform angles, velocities with a standard deviation of 5 rad/s.
    random_starts: Share = 0.0
    thrown_starts: Share = 0.0  # share of episodes that start as a reset by hand leaves the arm
    # Share of episodes in a random scenario; of the hardware task, if not 0, all, some pushed.
    randomised: Share = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dt > self.duration:
            raise JaxpendError(f"dt is {self.dt}; it must not be longer than an episode")
        starts = {n: v for n, v in vars(self).items() if n.endswith("_starts") and v}
        if sum(starts.values()) > 1:
            words = zip(*starts.items(), strict=True)
            names, values = (" and ".join(map(str, each)) for each in words)
            raise JaxpendError(f"{names} are {values}; they are shares of one whole")

    @property
    def episode_steps(self) -> int:
        """Control steps in an episode."""
        return round(self.duration / self.dt)


@dataclasses.dataclass(frozen=True)
class DemonstrationConfig(Checked):
    """How demonstrations are made and imitated.

    Each episode scales its noise by its own s^2, s uniform in [0, 1]; pulses are not scaled.
    """

    episodes: Natural = 0  # 0: no demonstrations, learn from the reward alone
    duration: Duration = 4.0  # s an episode
    action_noise: NotNegative = 0.3  # largest standard deviation, of the normalised action
    kicks: NotNegative = 0.1  # rad/s, largest standard deviation of velocity jumps between steps
    pulses: NotNegative = 0.0  # strength of disturbance pulses; 1 is the robustness benchmark's
    start_spread: NotNegative = 0.1  # rad and rad/s, largest standard deviation of the start
    delay: NotNegative = 0.0  # s, of measurements, up to which the shown balance would hold
    updates: Count = 20_000  # imitation updates of the actor before SAC
    batch_size: Count = 1024
    learning_rate: Positive = 2e-3  # cosine decay to a thousandth
    log_std: float = -2.5  # of the actor that SAC starts with, before the tanh


@dataclasses.dataclass(frozen=True)
class SACConfig(Checked):
    """Hyperparameters of SAC."""

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    steps: Count = 600_000  # environment steps, all environments together
    num_envs: Count = 32
    updates_per_step: Count = 4  # gradient updates per vector step (num_envs environment steps)
    batch_size: Count = 256
    replay_capacity: Count = 600_000  # transitions
    mirror: bool = False  # half of every batch, by chance: there is no difference left to right
    warmup_steps: Natural = 5_000  # environment steps with uniform actions before learning
    discount: Annotated[float, Bounds(above=0, below=1)] = 0.99
    n_step: Annotated[int, Bounds(least=1, most=100)] = 1  # rewards before a target bootstraps
    target_rate: Rate = 0.005  # Polyak averaging of the target critics
    average_rate: Rate = 1.0  # the same of the actor, whose average is the greedy policy; 1: none
    learning_rate: Positive = 1e-3
    final_learning_rate: Positive = 1.0  # cosine decay to this fraction of learning_rate
    target_entropy: float = -1.0  # nats
    init_temperature: Positive = 0.1
    noise_repeat: Annotated[float, Bounds(least=1, most=100)] = 1.0  # steps exploration noise lasts
    reward_scale: Positive = 0.1
    actor_hidden: tuple[Count, ...] = (128, 128)
    critic_hidden: tuple[Count, ...] = (128, 128)
    activation: Activation = "relu"
    critic_layer_norm: bool = False
    critic_bins: Natural = 0  # of a distribution of the return; 0: critics of its mean alone
    critic_range: tuple[float, float] = (-100.0, 150.0)  # of scaled returns, from first to last bin
    demonstrations: DemonstrationConfig = dataclasses.field(default_factory=DemonstrationConfig)
    imitation: NotNegative = 0.0  # weight of the squared distance to the demonstrated actions
    actor_delay: Natural = 0  # environment steps before the actor learns; the critics start at once
    eval_every: Count = 25_000  # environment steps between judgements by the official score
    objective: Objective = dataclasses.field(default_factory=Objective)  # of which policy is best
    # The best policy of each of so many equal parts goes on; the gradient lets them compete.
    contestants: Annotated[int, Bounds(least=1, most=100)] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.critic_bins == 1:
            raise JaxpendError("critic_bins is 1; it must be 0 or at least 2")
        if self.critic_range[0] >= self.critic_range[1]:
            raise JaxpendError(f"critic_range is {self.critic_range}; the first must be lower")
        if self.replay_capacity < self.num_envs * self.n_step:
            text = f"it must hold n_step = {self.n_step} steps of all {self.num_envs} environments"
            raise JaxpendError(f"replay_capacity is {self.replay_capacity}; {text}")
        if self.n_step > 1 and self.demonstrations.episodes:
            raise JaxpendError(f"n_step is {self.n_step}; with demonstrations it must be 1")
        if self.mirror and not self.env.observation.symmetric:
            text = "mirror is on, but the mean of the observation is not the same left and right"
            raise JaxpendError(f"{text}; turn mirror off")
        shown = self.demonstrations
        if shown.episodes and self.batch_size < 2:
            raise JaxpendError("batch_size is 1; it must be at least 2, half are demonstrations")
        if shown.episodes and shown.duration < self.env.dt:
            text = f"demonstrations.duration is {shown.duration}"
            raise JaxpendError(f"{text}; it must not be shorter than env.dt")


@dataclasses.dataclass(frozen=True)
class GuardConfig(Checked):
    """What a policy is guarded with before SNES; see ``controllers.guard``. Nothing by default."""

    observe: bool = False  # a Kalman filter, so that the policy does not see what is measured
    angle_noise: Positive = 1e-4  # rad, the least that the filter takes for the noise of angles
    # rad/s, the same of velocities; they may be late, so that they are not believed more.
    velocity_noise: Positive = 0.2
    rescue: bool = False  # energy shaping and LQR take over a swing-up that failed
    after: Positive = 2.0  # s, the time that a swing-up may take
    radius: Positive = 0.3  # rad, of either angle around upright; beyond it a swing-up has failed
    excess: Positive = 1.2  # J more than at upright, with which it has failed at any time


def _met(scenarios: int, objective: Objective) -> None:
    """Refuse scenarios that count nothing."""
    if scenarios and not objective.weight:
        text = "with objective.weight 0 they count nothing; give a weight, or no scenarios"
        raise JaxpendError(f"scenarios is {scenarios}; {text}")


@dataclasses.dataclass(frozen=True)
class SNESConfig(Checked):
    """Hyperparameters of the evolution strategy."""

    strategy: Strategy = "snes"
    generations: Natural = 400  # 0: ``train`` leaves the stage out
    population: Annotated[int, Bounds(least=2)] = 40
    sigma: Positive = 0.01  # initial standard deviation of a network's weights
    gain_sigma: Positive = 0.05  # of the logarithm of all else: a fraction
    final_sigma: Positive = 1.0  # sigma decays geometrically to this fraction of itself
    searched: str = "all"  # or "weights" of networks, "hidden" layers, "top,region.inner"
    rollouts: Count = 1  # noisy rollouts per individual
    action_noise: NotNegative = 0.1  # of policies, standard deviation before the tanh; 0 for none
    scenarios: Natural = 0  # random imperfect scenarios a generation, the same for all individuals
    objective: Objective = dataclasses.field(default_factory=Objective)
    chunk: Count = 10  # generations per report

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.strategy == "open_es" and self.population % 2:
            raise JaxpendError(f"population is {self.population}; open_es needs pairs")
        _met(self.scenarios, self.objective)


@dataclasses.dataclass(frozen=True)
class CheckpointConfig(Checked):
    """When training is put on disk, besides at the end of a stage and where it is stopped."""

    every: Annotated[float, Bounds(least=0, infinite=True)] = 60.0  # s
    keep: Count = 2  # the newest so many


@dataclasses.dataclass(frozen=True)
class OpeningsConfig(Checked):
    """How other ways to begin are tried and learned; see ``jaxpend.openings``."""

    # How many openings each policy learns; 0: ``train`` leaves the stage out.
    count: Annotated[int, Bounds(least=0, most=100)] = 0
    longest: Duration = 1.2  # s, of an opening
    rounds: Count = 12  # of imitating, each on new runs of the policy
    updates: Count = 300  # of Adam a round
    retention: NotNegative = 0.3  # weight of the distance to what it did where it stands
    retained_after: NotNegative = 2.5  # s into a run, from when on that counts


@dataclasses.dataclass(frozen=True)
class GradientConfig(Checked):
    """Hyperparameters of the ascent by the gradient through the simulator."""

    steps: Natural = 600  # of Adam; 0: ``train`` leaves the stage out
    learning_rate: Positive = 1e-4  # of a network's weights
    gain_learning_rate: Positive = 1e-3  # of the logarithm of all else: a fraction
    final_learning_rate: Positive = 0.01  # cosine decay to this fraction of learning_rate
    duration: Duration = 3.0  # s of the nominal run; afterwards a good policy stands still
    clip: Positive = 0.1  # norm of the gradient of one run
    searched: str = "all"  # as in SNESConfig
    line_width: Positive = 0.005  # m, over which the line is blurred
    power_width: Positive = 0.01  # W, over which the kink of |power| is rounded
    scenarios: Natural = 0  # random imperfect scenarios a step
    scenario_duration: Duration = 4.0  # s
    objective: Objective = dataclasses.field(default_factory=Objective)
    memory: PositiveOrInfinite = 1.0  # s, with which their gradient fades back; inf: it does not
    retention: NotNegative = 0.0  # weight of the squared distance to the start's where it stands
    retained_after: NotNegative = 2.0  # s, into a run; the swing-up before is free to change
    tolerance: PositiveOrInfinite = 0.02  # less worth than the best: the ascent goes back there
    chunk: Count = 20  # steps per report

    def __post_init__(self) -> None:
        super().__post_init__()
        _met(self.scenarios, self.objective)


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
        stage = {SACRun: "-sac", GradientRun: "-gradient", SNESRun: "-snes"}.get(type(self), "")
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
class SNESRun(SearchRun):
    """SNES alone."""

    snes: SNESConfig = dataclasses.field(default_factory=SNESConfig)


@dataclasses.dataclass(frozen=True)
class TrainRun(SACRun):
    """SAC; from its best policies openings, the gradient, and SNES, guarded, where they are on."""

    openings: OpeningsConfig = dataclasses.field(default_factory=OpeningsConfig)
    gradient: GradientConfig = dataclasses.field(default_factory=lambda: GradientConfig(steps=0))
    guard: GuardConfig = dataclasses.field(default_factory=GuardConfig)
    snes: SNESConfig = dataclasses.field(default_factory=SNESConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.snes.generations and (self.guard.observe or self.guard.rescue):
            text = "a guard needs some, since SNES begins with it"
            raise JaxpendError(f"snes.generations is 0; {text}")


@dataclasses.dataclass(frozen=True)
class Search(Checked):
    """How widely to look, and with how much torque."""

    torque_limit: Positive = 6.0  # N m
    starts: Count = 24  # random starts for each horizon
    horizons: tuple[Duration, ...] = (1.2, 1.4, 1.6, 1.8, 2.1)  # s, of the first stage
    horizon: Duration = 2.6  # s, of the other stages
    hold: NotNegative = 1.0  # s of LQR appended, so that it ends at rest
    keep: Count = 6  # optima refined at 500 Hz
    seed: Seed = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if max(self.horizons) > self.horizon:
            text = f"horizon is {self.horizon}; it must not be shorter than the longest of horizons"
            raise JaxpendError(text)
