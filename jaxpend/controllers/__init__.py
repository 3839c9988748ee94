"""Controllers, one a file, all on the protocol of ``base.Controller``."""

from .base import Controller, Feedback, OpenLoop, Zero
from .lqr import LQR, lqr
from .nominal import Nominal, load_nominal, save_nominal
from .policy import Policy, load_policy, save_policy
from .tvlqr import TVLQR, tvlqr

__all__ = [
    "LQR",
    "TVLQR",
    "Controller",
    "Feedback",
    "Nominal",
    "OpenLoop",
    "Policy",
    "Zero",
    "load_nominal",
    "load_policy",
    "lqr",
    "save_nominal",
    "save_policy",
    "tvlqr",
]
