"""How SAC learns, and in which environment."""

import dataclasses
import math
from typing import Annotated, Literal, get_args

from ..errors import JaxpendError
from ..fields import (
    Bounds,
    Checked,
    Count,
    Duration,
    Natural,
    NotNegative,
    Period,
    Positive,
    PositiveOrInfinite,
    Rate,
    Share,
)
from ..observation import Observation

__all__ = [
    "ACTIVATIONS", "Activation", "DemonstrationConfig", "EnvConfig", "Objective", "Reward",
    "SACConfig",
]  # fmt: skip

Activation = Literal["relu", "tanh", "silu"]
ACTIVATIONS: tuple[str, ...] = get_args(Activation)


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
