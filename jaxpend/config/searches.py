"""What searches from a policy: openings, gradient, SHAC, SNES; the guard; the best trajectory."""

import dataclasses
from typing import Annotated, Literal

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
    Seed,
    Share,
)
from .learning import Objective

__all__ = [
    "GradientConfig", "GuardConfig", "OpeningsConfig", "SHACConfig", "SNESConfig", "Search",
    "Strategy",
]  # fmt: skip

Strategy = Literal["snes", "sep_cma_es", "lm_ma_es", "open_es"]


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


def _met(scenarios: int, objective: Objective) -> None:
    """Refuse scenarios that count nothing."""
    if scenarios and not objective.weight:
        text = "with objective.weight 0 they count nothing; give a weight, or no scenarios"
        raise JaxpendError(f"scenarios is {scenarios}; {text}")


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
class SHACConfig(Checked):
    """Hyperparameters of the short-horizon actor-critic; see ``jaxpend.shac``."""

    steps: Natural = 2000  # those of the critic alone among them; 0: no such stage
    critic_steps: Natural = 600  # the first so many, in which the critic learns alone
    num_arms: Count = 128  # that live side by side
    window: Duration = 0.5  # s, by which each of them moves on in a step
    dt: Period = 0.004  # s, control and integration period there
    horizon: Positive = 2.0  # s, in which what is to come loses a factor of e of its weight
    trust: Positive = 0.01  # root mean square of what a step changes in the actions in [-1, 1]
    final_trust: Positive = 0.05  # cosine decay to this fraction of trust
    clip: Positive = 1.0  # norm of the gradient of one window
    line_width: Positive = 0.02  # m, over which the line is blurred
    # rad, and in rad/s ten times as much: largest standard deviation of jumps between windows.
    kicks: NotNegative = 0.03
    thrown: Share = 0.2  # of the arms, after a window, as a reset by hand throws them
    anywhere: Share = 0.02  # of the arms, after a window, put anywhere, a fifth of them hanging
    randomised: Share = 0.0  # of the windows in a random imperfect scenario
    trace: Positive = 0.4  # s, in which targets come to trust the critic, not the window
    critic_hidden: tuple[Count, ...] = (128, 128)
    critic_learning_rate: Positive = 1e-3
    critic_updates: Count = 8  # a step, on all windows of it together
    target_rate: Rate = 0.2  # Polyak averaging of the critic that windows end with
    searched: str = "all"  # as in SNESConfig
    objective: Objective = dataclasses.field(default_factory=Objective)
    chunk: Count = 100  # steps per report

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps and self.steps <= self.critic_steps:
            text = f"steps is {self.steps}; it must be more than the {self.critic_steps} of"
            raise JaxpendError(f"{text} critic_steps, in which the policy does not learn")
        if self.dt > self.window:
            raise JaxpendError(f"dt is {self.dt}; it must not be longer than window")
        if self.thrown + self.anywhere > 1:
            text = f"thrown and anywhere are {self.thrown} and {self.anywhere}"
            raise JaxpendError(f"{text}; they are shares of one whole")


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
