"""Controllers, one a file, all on the protocol of ``jaxpend.controller.Controller``."""

from ..controller import Controller, Feedback, OpenLoop, Zero
from ..trajopt.reference import Reference, load_reference, save_reference
from .energy import EnergyShaping, energy_shaping
from .files import load_controller, load_policy, save_controller, save_policy
from .guard import Guarded, guard
from .hybrid import Ellipsoid, Hybrid, Tolerances, ellipsoid, ellipsoid_of_torque
from .lqr import LQR, delay_tolerant, lqr
from .mpc import MPC, free_mpc, tracking_mpc
from .pd import PD, pd
from .policy import Policy
from .riccati import Riccati, riccati
from .tvlqr import TVLQR, tvlqr

__all__ = [
    "LQR", "MPC", "PD", "TVLQR", "Controller", "Ellipsoid", "EnergyShaping", "Feedback", "Guarded",
    "Hybrid", "OpenLoop", "Policy", "Reference", "Riccati", "Tolerances", "Zero", "delay_tolerant",
    "ellipsoid", "ellipsoid_of_torque", "energy_shaping", "free_mpc", "guard", "load_controller",
    "load_policy", "load_reference", "lqr", "pd", "riccati", "save_controller", "save_policy",
    "save_reference", "tracking_mpc", "tvlqr",
]  # fmt: skip
