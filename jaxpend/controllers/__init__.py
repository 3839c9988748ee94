"""Controllers, one a file, all on the protocol of ``base.Controller``."""

from .base import Controller, Feedback, OpenLoop, Zero
from .policy import Policy, load_policy, save_policy

__all__ = [
    "Controller",
    "Feedback",
    "OpenLoop",
    "Policy",
    "Zero",
    "load_policy",
    "save_policy",
]
