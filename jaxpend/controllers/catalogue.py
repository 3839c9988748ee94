"""The catalogue: the controllers that this package has by name, ready to be judged."""

import dataclasses
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp

from ..controller import Controller, OpenLoop, check_controller, check_robot
from ..errors import THEIRS, JaxpendError, blame, choose
from ..plant import Plant
from ..task import Task
from ..trajopt.reference import Reference, load_reference
from .callback import PythonLaw, is_realaigym, realaigym
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


# (plant, robot, name or file of the policy it is built around) -> controller
Make = Callable[[Plant, str, str], Controller]


@dataclasses.dataclass(frozen=True)
class Entry:
    """A way to make a controller for a plant and a robot, around a policy where it takes one."""

    title: str
    make: Make


def _network(plant: Plant, robot: str, policy: str) -> Controller:
    return network_in(load_policy(policy))


def _open_loop(plant: Plant, robot: str, policy: str) -> Controller:
    reference = load_reference(robot)
    torques = reference.both(reference.u)
    # Half a step early, so that rounding in the sum of time steps does not matter.
    return OpenLoop(reference.dt * (jnp.arange(reference.steps) - 0.5), torques)


def _alone(make: Callable[[Plant, str], Controller]) -> Make:
    return lambda plant, robot, policy: make(plant, robot)


def _along(make: Callable[[Plant, Reference], Controller]) -> Make:
    """Along the swing-up that ships with the package."""
    return lambda plant, robot, policy: make(plant, load_reference(robot))


def _then_lqr(make: Make, fraction: float = 1.0) -> Make:
    return lambda plant, robot, policy: with_lqr(
        make(plant, robot, policy), plant, robot, fraction=fraction
    )


def _guarded(make: Make) -> Make:
    return lambda plant, robot, policy: guard(make(plant, robot, policy), robot, plant)


CATALOGUE: dict[str, Entry] = {
    "policy": Entry("Policy", lambda plant, robot, policy: load_policy(policy)),
    "policy_network": Entry("Policy, network alone", _network),
    "policy_lqr": Entry("Policy, network + LQR", _then_lqr(_network)),
    "tvlqr": Entry("TVLQR", _along(tvlqr)),
    "tvlqr_guarded": Entry("TVLQR, guarded", _guarded(_along(tvlqr))),
    "mpc": Entry("iLQR MPC", _along(tracking_mpc)),
    "mpc_free": Entry("iLQR MPC, free", _alone(free_mpc)),
    "riccati": Entry("iLQR Riccati gains", _along(riccati)),
    "open_loop_lqr": Entry("Open loop + LQR", _then_lqr(_open_loop)),
    "energy_lqr": Entry("Energy shaping + LQR", _then_lqr(_alone(energy_shaping), fraction=2.0)),
    "open_loop": Entry("Open loop", _open_loop),
    "pd": Entry("PD", _alone(pd)),
    "lqr": Entry("LQR", _alone(lqr)),
}


def build(name: str, plant: Plant, robot: str, policy: str | None = None) -> Controller:
    """The controller of that name, in the dtype of ``plant`` and of jax's default.

    ``policy`` is the one that controllers are built around, by default that of the v2 boards.
    Raises ``JaxpendError`` for an unknown name; the message lists the known ones.
    """
    return CATALOGUE[choose("controller", name, CATALOGUE)].make(plant, robot, policy or robot)


def find_controller(policy: str | Path | None, controller: str | None, task: Task) -> Controller:
    """What ``--policy`` and ``--controller`` of a command name.

    Args:
        policy: a policy or controller file; None: the policy that ships with the package.
        controller: a name in the catalogue; or ``module:name``, a controller, one of RealAIGym
            or a Python function, looked for in the working directory too. If ``policy`` is given
            too, the controller of the catalogue is built around it, or the file that it names is
            loaded with the classes of ``module:name``.
        task: gives the robot, and the nominal plant that a controller of the catalogue is for.

    Raises:
        JaxpendError: a file, a name or a module that cannot be used.
    """
    robot = task.robot
    if not controller:
        return load_controller(policy or task.shipped, robot=robot)
    if ":" in controller:
        own = _imported(controller)
        check_robot(own, robot)
        return load_controller(policy, robot=robot, classes=classes_of(own)) if policy else own
    if not policy:
        return build(controller, task.plant, robot, task.shipped)
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
        if is_realaigym(found):
            found = realaigym(found)
        elif not isinstance(found, type) and not hasattr(found, "reset") and callable(found):
            found = PythonLaw(found)
    except THEIRS as error:
        raise JaxpendError(f"cannot load {name} as module:name: {blame(error)}") from None
    check_controller(found)
    return found
