"""What can be configured: frozen plain dataclasses that load without jax.

All raise ``JaxpendError`` for values that make no sense.
"""

import dataclasses
import math
from pathlib import Path

from .errors import JaxpendError, choose
from .observation import Observation
from .robots import active_joint

__all__ = [
    "LINES",
    "CheckpointConfig",
    "DemonstrationConfig",
    "EnvConfig",
    "GradientConfig",
    "GradientRun",
    "GuardConfig",
    "Reward",
    "Run",
    "SACConfig",
    "SACRun",
    "SNESConfig",
    "SNESRun",
    "Search",
    "TrainRun",
]

ACTIVATIONS = ("relu", "tanh", "silu")
STRATEGIES = {  # and what evosax calls them
    "snes": "SNES",
    "sep_cma_es": "Sep_CMA_ES",
    "lm_ma_es": "LM_MA_ES",
    "open_es": "Open_ES",
}


# The paper's heights of the end effector above which the reward asks for balance, m.
LINES = {"acrobot": 0.375, "pendubot": 0.35}


@dataclasses.dataclass(frozen=True)
class Reward:
    """Coefficients of the surrogate reward; see jaxpend.env.surrogate_reward."""

    line: float | None = None  # m, height that separates the regimes; None: see ``LINES``
    alpha: float = 2.0  # J, straight elbow above the line
    beta: float = 1.0  # kinetic energy above the line
    rho1: float = 0.1  # action squared, above the line
    rho2: float = 0.02  # action squared, below
    phi1: float = 0.15  # change of the action, above the line
    phi2: float = 0.15  # change of the action, below
    eta: float = 0.02  # s^2, joint velocities squared, below
    floor: float = -math.inf  # a step earns at least this; a spinning arm earns -100 and less


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """The learning environment."""

    robot: str = "pendubot"
    torque_limit: float = 3.0  # N m, torque at action 1
    dt: float = 0.01  # s, control period
    duration: float = 10.0  # s, then the episode is truncated
    observation: Observation = dataclasses.field(default_factory=Observation)
    reward: Reward = dataclasses.field(default_factory=Reward)
    max_speed: float = math.inf  # rad/s; SAC truncates an episode beyond it
    upright_starts: float = 0.0  # share of episodes that start near upright, not hanging
    upright_spread: float = 0.03  # rad, standard deviation of both angles there; 3/s of velocities
    randomised: float = 0.0  # share of episodes in a random scenario, see ``randomisation``

    def __post_init__(self):
        active_joint(self.robot)
        if self.reward.line is None:
            reward = dataclasses.replace(self.reward, line=LINES[self.robot])
            object.__setattr__(self, "reward", reward)
        for name in ("torque_limit", "dt", "duration", "max_speed", "upright_spread"):
            if not getattr(self, name) > 0:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")
        for name in ("upright_starts", "randomised"):
            if not 0 <= getattr(self, name) <= 1:
                share = getattr(self, name)
                raise JaxpendError(f"{name} is {share}; it is a share, from 0 to 1")

    @property
    def episode_steps(self) -> int:
        """Control steps in an episode."""
        return round(self.duration / self.dt)


@dataclasses.dataclass(frozen=True)
class DemonstrationConfig:
    """How demonstrations are made and imitated.

    Each episode scales its noise by its own s^2, s uniform in [0, 1]; pulses are not scaled.
    """

    episodes: int = 0  # 0: no demonstrations, learn from the reward alone
    duration: float = 4.0  # s an episode
    action_noise: float = 0.3  # largest standard deviation, of the normalised action
    kicks: float = 0.1  # rad/s, largest standard deviation of velocity jumps between steps
    pulses: float = 0.0  # strength of disturbance pulses; 1 is the robustness benchmark's
    start_spread: float = 0.1  # rad and rad/s, largest standard deviation of the initial state
    delay: float = 0.0  # s, of measurements, up to which the shown balance would hold
    updates: int = 20_000  # imitation updates of the actor before SAC
    batch_size: int = 1024
    learning_rate: float = 2e-3  # cosine decay to a thousandth
    log_std: float = -2.5  # of the actor that SAC starts with, before the tanh

    def __post_init__(self):
        for name in ("episodes", "delay"):
            if not getattr(self, name) >= 0:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must not be negative")
        for name in ("duration", "updates", "batch_size", "learning_rate"):
            if not getattr(self, name) > 0:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")


@dataclasses.dataclass(frozen=True)
class SACConfig:
    """Hyperparameters of SAC."""

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    steps: int = 600_000  # environment steps, all environments together
    num_envs: int = 32
    updates_per_step: int = 4  # gradient updates per vector step (num_envs environment steps)
    batch_size: int = 256
    replay_capacity: int = 600_000  # transitions
    mirror: bool = False  # half of every batch, by chance: there is no difference left to right
    warmup_steps: int = 5_000  # environment steps with uniform actions before learning
    discount: float = 0.99
    target_rate: float = 0.005  # Polyak averaging of the target critics
    learning_rate: float = 1e-3
    final_learning_rate: float = 1.0  # cosine decay to this fraction of learning_rate
    target_entropy: float = -1.0  # nats
    init_temperature: float = 0.1
    reward_scale: float = 0.1
    actor_hidden: tuple[int, ...] = (128, 128)
    critic_hidden: tuple[int, ...] = (128, 128)
    activation: str = "relu"
    critic_layer_norm: bool = False
    demonstrations: DemonstrationConfig = dataclasses.field(default_factory=DemonstrationConfig)
    imitation: float = 0.0  # weight of the squared distance to the demonstrated actions
    actor_delay: int = 0  # environment steps before the actor learns; the critics start at once
    eval_every: int = 25_000  # environment steps between judgements by the official score

    def __post_init__(self):
        positive = (
            "steps", "num_envs", "updates_per_step", "batch_size", "replay_capacity", "discount",
            "target_rate", "learning_rate", "final_learning_rate", "init_temperature",
            "reward_scale", "eval_every",
        )  # fmt: skip
        for name in positive:
            if not getattr(self, name) > 0:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")
        if self.discount >= 1:
            raise JaxpendError(f"discount is {self.discount}; it must be below 1")
        if self.replay_capacity < self.num_envs:
            raise JaxpendError("replay_capacity must hold at least one step of all environments")
        choose("activation", self.activation, ACTIVATIONS)

    def for_robot(self, robot: str) -> "SACConfig":
        """The same for another robot; the reward's line becomes that robot's, if not chosen."""
        if robot == self.env.robot:
            return self
        reward = self.env.reward
        if reward.line == LINES[self.env.robot]:
            reward = dataclasses.replace(reward, line=None)
        env = dataclasses.replace(self.env, robot=robot, reward=reward)
        return dataclasses.replace(self, env=env)


@dataclasses.dataclass(frozen=True)
class GuardConfig:
    """What a policy is guarded with before SNES; see ``controllers.guard``. Nothing by default."""

    bandwidth: float = 0.0  # rad/s, of the observer of the state from angles; 0: none
    rescue: bool = False  # energy shaping and LQR take over a swing-up that failed
    after: float = 2.0  # s, the time that a swing-up may take
    radius: float = 0.3  # rad, of either angle around upright; beyond it a swing-up has failed
    excess: float = 1.2  # J more than at upright, with which it has failed at any time

    def __post_init__(self):
        if self.bandwidth < 0:
            raise JaxpendError(f"bandwidth is {self.bandwidth} rad/s; it must not be negative")
        for name in ("after", "radius", "excess"):
            if not getattr(self, name) > 0:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")


@dataclasses.dataclass(frozen=True)
class SNESConfig:
    """Hyperparameters of the evolution strategy."""

    strategy: str = "snes"  # or sep_cma_es, lm_ma_es, open_es
    generations: int = 400
    population: int = 40
    sigma: float = 0.01  # initial standard deviation of a network's weights
    gain_sigma: float = 0.05  # of the logarithm of all else: a fraction
    final_sigma: float = 1.0  # sigma decays geometrically to this fraction of itself
    searched: str = "all"  # or "weights" of networks, "hidden" layers, "top,region.inner"
    rollouts: int = 1  # noisy rollouts per individual
    action_noise: float = 0.1  # of policies, standard deviation before the tanh; 0 for none
    scenarios: int = 0  # random imperfect scenarios a generation, the same for all individuals
    scenario_weight: float = 0.5  # of their mean score in the fitness, where there are any
    validation: int = 256  # scenarios, always the same, on which candidates are compared
    chunk: int = 10  # generations per report

    def __post_init__(self):
        positive = ("generations", "population", "sigma", "gain_sigma", "final_sigma", "rollouts")
        for name in (*positive, "validation", "chunk"):
            if not getattr(self, name) > 0:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")
        if not self.action_noise >= 0:
            raise JaxpendError(f"action_noise is {self.action_noise}; it must not be negative")
        if self.scenarios < 0 or not 0 <= self.scenario_weight <= 1:
            raise JaxpendError("scenarios must not be negative, scenario_weight lies in 0 to 1")
        choose("strategy", self.strategy, STRATEGIES)
        if self.population < 2:
            raise JaxpendError("population is 1; SNES compares at least two individuals")
        if self.strategy == "open_es" and self.population % 2:
            raise JaxpendError(f"population is {self.population}; open_es needs pairs")


@dataclasses.dataclass(frozen=True)
class CheckpointConfig:
    """When training is put on disk, besides at the end of a stage and where it is stopped."""

    every: float = 60.0  # s
    keep: int = 2  # the newest so many

    def __post_init__(self):
        if not (self.every >= 0 and self.keep >= 1):
            raise JaxpendError("checkpoint: every must not be negative, keep must be positive")


@dataclasses.dataclass(frozen=True)
class GradientConfig:
    """Hyperparameters of the ascent by the gradient through the simulator."""

    steps: int = 600  # of Adam; 0: ``train`` leaves the stage out
    learning_rate: float = 1e-4  # of a network's weights
    gain_learning_rate: float = 1e-3  # of the logarithm of all else: a fraction
    final_learning_rate: float = 0.01  # cosine decay to this fraction of learning_rate
    duration: float = 3.0  # s of the nominal run; afterwards a good policy stands still
    clip: float = 0.1  # norm of the gradient of one run
    searched: str = "all"  # as in SNESConfig
    line_width: float = 0.005  # m, over which the line is blurred
    power_width: float = 0.01  # W, over which the kink of |power| is rounded
    scenarios: int = 0  # random imperfect scenarios a step
    scenario_duration: float = 4.0  # s
    scenario_weight: float = 0.8  # of them in what is climbed, where there are any
    validation: int = 256  # scenarios, always the same, on which steps are compared
    memory: float = 1.0  # s, with which their gradient fades back in time; inf: it does not
    chunk: int = 20  # steps per report

    def __post_init__(self):
        for name in (
            "learning_rate", "gain_learning_rate", "final_learning_rate", "duration",
            "clip", "memory", "line_width", "power_width", "scenario_duration", "validation",
            "chunk",
        ):  # fmt: skip
            if not getattr(self, name) > 0:
                raise JaxpendError(f"{name} is {getattr(self, name)}; it must be positive")
        if self.steps < 0 or self.scenarios < 0 or not 0 <= self.scenario_weight <= 1:
            raise JaxpendError(
                "steps and scenarios must not be negative, scenario_weight lies in 0 to 1"
            )


@dataclasses.dataclass(frozen=True)
class Run:
    """What every training run has."""

    robot: str = "pendubot"
    seed: int = 0
    seeds: int = 1  # how many runs, of the seeds from ``seed`` on, each in RUN/seedN
    vmap: str = "auto"  # several seeds in one computation: yes, no, or on an accelerator
    run: str = ""  # name of the run folder; empty: ROBOT-seedSEED, or ROBOT-snes-seedSEED
    runs: str = "runs"  # folder of the run folders
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    on_divergence: str = "stop"  # or "rollback": back to the last chunk, on with another key
    max_rollbacks: int = 3  # in a run, before it stops after all
    tensorboard: bool = False  # the metrics as TensorBoard events too, in RUN/tensorboard

    def __post_init__(self):
        active_joint(self.robot)
        choose("choice of vmap", self.vmap, ("auto", "yes", "no"))
        choose("choice of on_divergence", self.on_divergence, ("stop", "rollback"))
        if self.seeds < 1:
            raise JaxpendError(f"seeds is {self.seeds}; it must be positive")
        if hasattr(self, "sac"):
            changed = self.sac.for_robot(self.robot)
            object.__setattr__(self, "sac", changed)

    @property
    def folder(self) -> Path:
        """Path of the run folder."""
        # A stage alone must not land in the folder of the whole run that it may start from.
        stage = {SACRun: "-sac", GradientRun: "-gradient", SNESRun: "-snes"}.get(type(self), "")
        seeds = f"s{self.seed}-{self.seed + self.seeds - 1}" if self.seeds > 1 else str(self.seed)
        return Path(self.runs) / (self.run or f"{self.robot}{stage}-seed{seeds}")

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
class GradientRun(Run):
    """The gradient alone, from a policy or any other controller."""

    policy: str = ""  # file to start from; empty: the policy that ships with the package
    controller: str = ""  # start instead from a known one, around that policy, or module:name
    gradient: GradientConfig = dataclasses.field(default_factory=GradientConfig)

    def __post_init__(self):
        super().__post_init__()
        if not self.gradient.steps:
            raise JaxpendError("gradient.steps is 0; a run of the gradient alone needs some")


@dataclasses.dataclass(frozen=True)
class SNESRun(Run):
    """SNES alone, from a policy or any other controller."""

    policy: str = ""  # file to start from; empty: the policy that ships with the package
    controller: str = ""  # start instead from a known one, around that policy, or module:name
    snes: SNESConfig = dataclasses.field(default_factory=SNESConfig)


@dataclasses.dataclass(frozen=True)
class TrainRun(SACRun):
    """SAC, then from its best policy the gradient, where it has steps, then SNES, guarded."""

    gradient: GradientConfig = dataclasses.field(default_factory=lambda: GradientConfig(steps=0))
    guard: GuardConfig = dataclasses.field(default_factory=GuardConfig)
    snes: SNESConfig = dataclasses.field(default_factory=SNESConfig)


@dataclasses.dataclass(frozen=True)
class Search:
    """How widely to look, and with how much torque."""

    torque_limit: float = 6.0  # N m
    starts: int = 24  # random starts for each horizon
    horizons: tuple[float, ...] = (1.2, 1.4, 1.6, 1.8, 2.1)  # s, of the first stage
    horizon: float = 2.6  # s, of the other stages
    hold: float = 1.0  # s of LQR appended, so that it ends at rest
    keep: int = 6  # optima refined at 500 Hz
    seed: int = 0
