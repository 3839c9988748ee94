"""The catalogue: the controllers that this package has by name, ready to be judged."""

import dataclasses
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp

from ..boards import Task
from ..controller import Controller, OpenLoop, check_controller, check_robot
from ..errors import THEIRS, JaxpendError, blame, choose
from ..plant import Plant
from ..trajopt.reference import load_reference
from .callback import PythonLaw
from .energy import energy_shaping
from .files import classes_of, load_controller, load_policy
from .guard import guard
from .hybrid import with_lqr
from .lqr import lqr
from .mpc import free_mpc, tracking_mpc
from .pd import pd
from .policy import change_policies, network_in
from .riccati import riccati
from .tvlqr import tvlqr

__all__ = ["CATALOGUE", "Entry", "build", "find_controller"]


@dataclasses.dataclass(frozen=True)
class Entry:
    """A way to make a controller for a plant and a robot."""

    title: str
    make: Callable[[Plant, str], Controller]


def _open_loop(plant: Plant, robot: str) -> Controller:
    reference = load_reference(robot)
    torques = reference.both(reference.u[:, None])
    # Half a step early, so that the sum of time steps need not hit a stamp exactly.
    return OpenLoop(reference.dt * (jnp.arange(reference.steps) - 0.5), torques)


CATALOGUE: dict[str, Entry] = {
    "policy": Entry("Policy", lambda plant, robot: load_policy(robot)),
    "policy_network": Entry(
        "Policy, network alone", lambda plant, robot: network_in(load_policy(robot))
    ),
    "policy_lqr": Entry(
        "Policy, network + LQR",
        lambda plant, robot: with_lqr(network_in(load_policy(robot)), plant, robot),
    ),
    "tvlqr": Entry("TVLQR", lambda plant, robot: tvlqr(plant, load_reference(robot))),
    "tvlqr_guarded": Entry(
        "TVLQR, guarded",
        lambda plant, robot: guard(tvlqr(plant, load_reference(robot)), robot, plant),
    ),
    "mpc": Entry("iLQR MPC", lambda plant, robot: tracking_mpc(plant, load_reference(robot))),
    "mpc_free": Entry("iLQR MPC, free", free_mpc),
    "riccati": Entry(
        "iLQR Riccati gains", lambda plant, robot: riccati(plant, load_reference(robot))
    ),
    "open_loop_lqr": Entry(
        "Open loop + LQR", lambda plant, robot: with_lqr(_open_loop(plant, robot), plant, robot)
    ),
    "energy_lqr": Entry(
        "Energy shaping + LQR",
        lambda plant, robot: with_lqr(energy_shaping(plant, robot), plant, robot, fraction=2.0),
    ),
    "open_loop": Entry("Open loop", _open_loop),
    "pd": Entry("PD", pd),
    "lqr": Entry("LQR", lqr),
}


def build(name: str, plant: Plant, robot: str) -> Controller:
    """The controller of that name, in the dtype of ``plant`` and of jax's default.

    Raises:
        JaxpendError: an unknown name; the message lists the known ones.
    """
    return CATALOGUE[choose("controller", name, CATALOGUE)].make(plant, robot)


def find_controller(policy: str | Path | None, controller: str | None, task: Task) -> Controller:
    """What ``--policy`` and ``--controller`` of a command name.

    Args:
        policy: a policy or controller file; None: the policy that ships with the package.
        controller: a name in the catalogue; or ``module:name``, a controller or a Python
            function, looked for in the working directory too. With ``policy`` as well: that of
            the catalogue around that policy, or a file of the classes of ``module:name``.
        task: gives the robot, and the nominal plant that a controller of the catalogue is for.

    Raises:
        JaxpendError: a file, a name or a module that cannot be used.
    """
    robot = task.robot
    if not controller:
        return load_controller(policy or robot, robot=robot)
    if ":" in controller:
        own = _imported(controller)
        check_robot(own, robot)
        return load_controller(policy, robot=robot, classes=classes_of(own)) if policy else own
    if not policy:
        return build(controller, task.plant, robot)
    # What may be wrong comes first: some controllers take a while to build.
    given = network_in(load_policy(policy, robot=robot), policy)
    if not choose("controller", controller, CATALOGUE).startswith("policy"):
        raise JaxpendError(f"{controller} is not built around a policy; leave out {policy}")
    return change_policies(build(controller, task.plant, robot), lambda shipped: given)[0]


def _imported(name: str) -> Controller:
    module, _, attribute = name.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(module), attribute)
        if not isinstance(found, type) and not hasattr(found, "reset") and callable(found):
            found = PythonLaw(found)
    except THEIRS as error:
        raise JaxpendError(f"cannot load {name} as module:name: {blame(error)}") from None
    check_controller(found)
    return found
