"""What can be configured: frozen plain dataclasses that load without jax.

The type of a field says which values it may have (``fields``); all raise ``JaxpendError`` for
values that make no sense.
"""

from ..observation import Observation
from .learning import (
    ACTIVATIONS,
    Activation,
    DemonstrationConfig,
    EnvConfig,
    Objective,
    Reward,
    SACConfig,
)
from .runs import CheckpointConfig, GradientRun, Run, SACRun, SearchRun, SHACRun, SNESRun, TrainRun
from .searches import (
    GradientConfig,
    GuardConfig,
    OpeningsConfig,
    Search,
    SHACConfig,
    SNESConfig,
    Strategy,
)

__all__ = [
    "ACTIVATIONS", "Activation", "CheckpointConfig", "DemonstrationConfig", "EnvConfig",
    "GradientConfig", "GradientRun", "GuardConfig", "Objective", "Observation", "OpeningsConfig",
    "Reward", "Run", "SACConfig", "SACRun", "SHACConfig", "SHACRun", "SNESConfig", "SNESRun",
    "Search", "SearchRun", "Strategy", "TrainRun",
]  # fmt: skip
