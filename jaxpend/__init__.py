"""Train and judge controllers for the acrobot and the pendubot, end to end in JAX."""

from .controllers.policy import Policy, load_policy, save_policy
from .errors import JaxpendError
from .plant import Plant
from .rollout import Trajectory, final_state, rollout
from .scenario import Pulses, Scenario

__all__ = [
    "JaxpendError",
    "Plant",
    "Policy",
    "Pulses",
    "Scenario",
    "Trajectory",
    "final_state",
    "load_policy",
    "rollout",
    "save_policy",
]
__version__ = "0.1.0"
