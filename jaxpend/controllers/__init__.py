"""Controllers, one a file, all on the protocol of ``base.Controller``."""

from .base import Controller, Feedback, OpenLoop, Zero
from .energy import EnergyShaping, energy_shaping
from .guard import Guarded, guard
from .hybrid import Ellipsoid, Hybrid, Tolerances, ellipsoid, ellipsoid_of_torque
from .lqr import LQR, delay_tolerant, lqr
from .mpc import MPC, free_mpc, tracking_mpc
from .nominal import Nominal, load_nominal, save_nominal
from .pd import PD, pd
from .policy import Policy, load_policy, save_policy
from .riccati import Riccati, riccati
from .saved import load_controller, save_controller
from .tvlqr import TVLQR, tvlqr

__all__ = [
    "LQR",
    "MPC",
    "PD",
    "TVLQR",
    "Controller",
    "Ellipsoid",
    "EnergyShaping",
    "Feedback",
    "Guarded",
    "Hybrid",
    "Nominal",
    "OpenLoop",
    "Policy",
    "Riccati",
    "Tolerances",
    "Zero",
    "delay_tolerant",
    "ellipsoid",
    "ellipsoid_of_torque",
    "energy_shaping",
    "free_mpc",
    "guard",
    "load_controller",
    "load_nominal",
    "load_policy",
    "lqr",
    "pd",
    "riccati",
    "save_controller",
    "save_nominal",
    "save_policy",
    "tracking_mpc",
    "tvlqr",
]
