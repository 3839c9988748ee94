"""The controllers that this package knows by name, ready to be judged."""

import dataclasses
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp

from ..errors import JaxpendError, choose
from ..plant import Plant
from .base import Controller, OpenLoop
from .energy import energy_shaping
from .guard import guard
from .hybrid import with_lqr
from .lqr import lqr
from .mpc import free_mpc, tracking_mpc
from .nominal import load_nominal
from .pd import pd
from .policy import change_policies, load_policy, network_in
from .python import PythonLaw
from .riccati import riccati
from .saved import classes_of, load_controller
from .tvlqr import tvlqr

__all__ = ["KNOWN", "Known", "build", "find_controller"]


@dataclasses.dataclass(frozen=True)
class Known:
    """A way to make a controller for a plant and a robot."""

    title: str
    make: Callable[[Plant, str], Controller]


def _open_loop(plant: Plant, robot: str) -> Controller:
    nominal = load_nominal(robot)
    torques = nominal.both(nominal.u[:, None])
    # Half a step early, so that the sum of time steps need not hit a stamp exactly.
    return OpenLoop(nominal.dt * (jnp.arange(nominal.steps) - 0.5), torques)


KNOWN: dict[str, Known] = {
    "policy": Known("Policy", lambda plant, robot: load_policy(robot)),
    "policy_network": Known(
        "Policy, network alone", lambda plant, robot: network_in(load_policy(robot))
    ),
    "policy_lqr": Known(
        "Policy, network + LQR",
        lambda plant, robot: with_lqr(network_in(load_policy(robot)), plant, robot),
    ),
    "tvlqr": Known("TVLQR", lambda plant, robot: tvlqr(plant, load_nominal(robot))),
    "tvlqr_guarded": Known(
        "TVLQR, guarded",
        lambda plant, robot: guard(tvlqr(plant, load_nominal(robot)), robot, plant),
    ),
    "mpc": Known("iLQR MPC", lambda plant, robot: tracking_mpc(plant, load_nominal(robot))),
    "mpc_free": Known("iLQR MPC, free", free_mpc),
    "riccati": Known(
        "iLQR Riccati gains", lambda plant, robot: riccati(plant, load_nominal(robot))
    ),
    "open_loop_lqr": Known(
        "Open loop + LQR", lambda plant, robot: with_lqr(_open_loop(plant, robot), plant, robot)
    ),
    "energy_lqr": Known(
        "Energy shaping + LQR",
        lambda plant, robot: with_lqr(energy_shaping(plant, robot), plant, robot, fraction=2.0),
    ),
    "open_loop": Known("Open loop", _open_loop),
    "pd": Known("PD", pd),
    "lqr": Known("LQR", lqr),
}


def build(name: str, plant: Plant, robot: str) -> Controller:
    """The controller of that name, in the dtype of ``plant`` and of jax's default.

    Raises:
        JaxpendError: an unknown name; the message lists the known ones.
    """
    return KNOWN[choose("controller", name, KNOWN)].make(plant, robot)


def find_controller(
    policy: str | Path | None, controller: str | None, plant: Plant, robot: str
) -> Controller:
    """What ``--policy`` and ``--controller`` of a command name.

    Args:
        policy: a policy or controller file; None: the policy that ships with the package.
        controller: a known name; or ``module:name``, a controller or a Python function, looked
            for in the working directory too. With ``policy`` as well: the known controller
            around that policy, or a file of the classes that ``module:name`` is made of.
        plant: what a known controller is made for; its type is the precision.
        robot: "acrobot" or "pendubot".

    Raises:
        JaxpendError: a file, a name or a module that cannot be used.
    """
    if not controller:
        return load_controller(policy or robot, robot=robot)
    if ":" in controller:
        own = _imported(controller)
        return load_controller(policy, robot=robot, classes=classes_of(own)) if policy else own
    found = build(controller, plant, robot)
    if not policy:
        return found
    given = network_in(load_policy(policy, robot=robot), policy)
    found, policies = change_policies(found, lambda shipped: given)
    if not policies:
        raise JaxpendError(f"{controller} is not built around a policy; leave out {policy}")
    return found


def _imported(name: str) -> Controller:
    module, _, attribute = name.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise JaxpendError(f"cannot load {name} as module:name: {error}") from None
    return found if hasattr(found, "reset") else PythonLaw(found)
