"""Files of controllers, policies among them: arrays by key path, and a header of how they fit.

The header names classes and fields; only the package's own classes, and those that the caller
gives, are made from it, so that a file cannot run code.
"""

import contextlib
import dataclasses
import shlex
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from ..arrays import read_arrays, write_arrays
from ..controller import Controller, OpenLoop, Zero, check_controller, robot_of
from ..errors import JaxpendError, choose
from ..fields import SLOWEST
from ..observation import Observation
from ..plant import Plant
from ..robots import ROBOTS, shipped
from ..stepping import Startable
from ..trajopt.ilqr import Solution
from ..trajopt.reference import Reference
from .energy import EnergyShaping
from .guard import Guarded, KalmanFilter, Observer, Rescue
from .hybrid import Ellipsoid, Hybrid, Tolerances
from .lqr import LQR
from .mpc import MPC
from .pd import PD
from .policy import ACTIVATIONS, SQUASHES, Policy, network_in, policies_in
from .riccati import Riccati
from .tvlqr import TVLQR

__all__ = [
    "classes_of", "load_controller", "load_policy", "read_header", "save_controller", "save_policy",
]  # fmt: skip

FORMAT = 1
# What files of earlier versions call classes and fields.
FORMER = {"Nominal": "Reference", "nominal": "reference"}
CLASSES = (
    EnergyShaping, Ellipsoid, Guarded, Hybrid, KalmanFilter, LQR, MPC, Observation, Observer,
    OpenLoop, PD, Plant, Policy, Reference, Rescue, Riccati, Solution, TVLQR, Tolerances, Zero,
)  # fmt: skip


def classes_of(value: Any) -> set[type]:
    """The dataclasses that a controller is made of: ``classes`` to load its file with."""
    if isinstance(value, tuple | list):
        return set().union(*map(classes_of, value))
    if not dataclasses.is_dataclass(value):
        return set()
    parts = (getattr(value, f.name) for f in dataclasses.fields(value))
    return {type(value)}.union(*map(classes_of, parts))


def _described(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """A value as JSON has it; its arrays go into ``arrays`` by key path."""
    if dataclasses.is_dataclass(value):
        fields = {
            f.name: _described(getattr(value, f.name), f"{path}.{f.name}".lstrip("."), arrays)
            for f in dataclasses.fields(value)
        }
        return {"class": type(value).__name__, "fields": fields}
    if isinstance(value, tuple | list):
        return [_described(v, f"{path}.{i}".lstrip("."), arrays) for i, v in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):  # a number of numpy in a static field
        return value.item()
    if not hasattr(value, "dtype"):
        raise JaxpendError(f"{path} is {value!r}; a file can hold arrays, numbers and text only")
    arrays[path] = np.asarray(value)
    return {"array": path}


def save_controller(
    path: str | Path, controller: Controller, robot: str, provenance: dict[str, Any] | None = None
) -> None:
    """Write a controller file, atomically: .npz without pickle.

    Args:
        path: of the file.
        controller: any that is made of dataclasses, arrays, numbers and text.
        robot: "acrobot" or "pendubot".
        provenance: any JSON object: command, seed, scores, ...

    Raises:
        JaxpendError: it is no controller, or holds something else.
    """
    choose("robot", robot, ROBOTS)
    check_controller(controller)
    arrays: dict[str, np.ndarray] = {}
    header = {"format": FORMAT, "kind": "controller", "robot": robot}
    header |= {"controller": _described(controller, "", arrays), "provenance": provenance or {}}
    write_arrays(path, header, arrays)


def save_policy(
    path: str | Path, policy: Controller, provenance: dict[str, Any] | None = None
) -> None:
    """``save_controller`` for a ``Policy``, or a controller with one in it, such as a ``Guarded``.

    Raises ``JaxpendError`` for a controller with no policy in it; use ``save_controller``.
    """
    save_controller(path, policy, network_in(policy).robot, provenance)


def _made(tree: Any, arrays: dict[str, np.ndarray], classes: dict[str, type]) -> Any:
    """What ``_described`` described."""
    if isinstance(tree, list):
        return tuple(_made(part, arrays, classes) for part in tree)
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        array = arrays[tree["array"]]
        floating = np.issubdtype(array.dtype, np.floating)
        return jnp.asarray(array, jnp.result_type(float) if floating else None)
    name = FORMER.get(tree["class"], tree["class"])
    kind = classes[choose("class of a controller", name, classes)]
    fields = {FORMER.get(name, name): part for name, part in tree["fields"].items()}
    return kind(**{name: _made(part, arrays, classes) for name, part in fields.items()})


def _first_format(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Policy:
    """A policy alone, as jaxpend 0.1 wrote it: arrays kernel0, bias0, ..."""
    layer = {name: jnp.asarray(values) for name, values in arrays.items()}
    numbers = range(len(header["layers"]) - 1)
    policy = Policy(
        layers=tuple((layer[f"kernel{i}"], layer[f"bias{i}"]) for i in numbers),
        torque_limit=jnp.asarray(header["torque_limit"], jnp.float32),
        robot=header["robot"],
        observation=Observation(**header["observation"]),
        activation=header["activation"],
        control_dt=float(header["control_dt"]),
    )
    sizes = [policy.layers[0][0].shape[0], *(bias.shape[0] for _, bias in policy.layers)]
    if sizes != header["layers"]:
        raise JaxpendError("the arrays do not have the shapes that its header says")
    return policy


def _check_policy(policy: Policy) -> None:
    """Refuse a policy with values that training cannot produce."""
    choose("robot", policy.robot, ROBOTS)
    choose("activation", policy.activation, ACTIVATIONS)
    choose("squash", policy.squash, SQUASHES)
    if not isinstance(policy.observation, Observation):
        raise JaxpendError("the policy says nothing of its observation")
    period = policy.control_dt
    is_number = isinstance(period, int | float) and not isinstance(period, bool)
    if not (is_number and 0 < period <= SLOWEST):
        raise JaxpendError(f"the control period is {period} s; it must be in 0 to {SLOWEST:g} s")
    sizes = [kernel.shape[:1] + bias.shape for kernel, bias in policy.layers]
    fits = all(k.shape == size for (k, _), size in zip(policy.layers, sizes, strict=True))
    fits &= sizes[0][0] == policy.observation.size and sizes[-1][1:] == (1,)
    if not fits:
        raise JaxpendError("the layers do not fit the observation and one action")
    finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy))
    if not (finite and policy.torque_limit > 0):
        raise JaxpendError("the policy holds values that are not finite or not positive")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file; of a model of Stable-Baselines3, how to make one of it."""
    try:
        return read_arrays(path, "policy")
    except JaxpendError:
        if not path.is_file():
            raise
        with contextlib.suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
            if "policy.pth" in archive.namelist():
                text = f"{path} is a model of Stable-Baselines3; make a policy file of it with"
                line = f"jaxpend import {shlex.quote(str(path))} --robot ROBOT --out policy.npz"
                raise JaxpendError(f"{text} {line}") from None
        raise


def read_header(robot_or_path: str | Path) -> dict[str, Any]:
    """The JSON header of a policy or controller file. Raises as ``arrays.read_arrays``."""
    path = shipped(robot_or_path, "policies")
    header, _ = _read(path)
    known = header.get("robot") in [*ROBOTS] and header.get("kind", "controller") == "controller"
    if not known or not isinstance(header.get("provenance", {}), dict):
        raise JaxpendError(f"{path} is not a policy file: its header does not say what it is of")
    return header


def load_controller(
    robot_or_path: str | Path, *, robot: str | None = None, classes: Iterable[type] = ()
) -> Controller:
    """Load a policy or controller file, or by its name a policy that ships (``robots.SHIPPED``).

    The arrays have jax's default float type at the time of the call.

    Args:
        robot_or_path: a path, or a name in ``robots.SHIPPED``.
        robot: the robot that it must be for; None accepts either.
        classes: a user's own, beside the package's.

    Raises:
        JaxpendError: no such file, not a controller file, one for the other robot, a class that
            is not known, or values that make no sense.
    """
    path = shipped(robot_or_path, "policies")
    header, arrays = _read(path)
    if header.get("format") != FORMAT:
        raise JaxpendError(f"{path} has policy format {header.get('format')}; this reads {FORMAT}")
    known = {kind.__name__: kind for kind in (*CLASSES, *classes)}
    try:
        its_robot = choose("robot", header["robot"], ROBOTS)
        if header.get("kind") == "controller":
            controller = _made(header["controller"], arrays, known)
        else:
            controller = _first_format(header, arrays)
        for policy in policies_in(controller):
            _check_policy(policy)
        check_controller(controller)
    except JaxpendError as error:
        raise JaxpendError(f"{path}: {error}") from None
    except Exception as error:  # whatever a class raises for values that do not fit
        said = (str(error) or type(error).__name__).splitlines()[0]
        raise JaxpendError(f"{path} does not hold a whole controller: {said}") from None
    what = "policy" if isinstance(controller, Policy) else "controller"
    if robot is not None and its_robot != choose("robot", robot, ROBOTS):
        raise JaxpendError(f"{path} is a {what} for the {its_robot}, not for the {robot}")
    if (robot_of(controller) or its_robot) != its_robot:
        raise JaxpendError(f"{path} says that it is for the {its_robot}, but its parts are not")
    return controller


def load_policy(robot_or_path: str | Path, *, robot: str | None = None) -> Startable:
    """``load_controller`` of the package's own classes: a ``Policy``, or a ``Guarded`` around it.

    "acrobot" and "pendubot" are what ``make train`` has learned, "demonstrated_acrobot" what its
    recipe of that name has; ``robots.SHIPPED`` has them all. From a loop of your own they are
    called with ``policy.start().torque(x)``. Raises ``JaxpendError`` as ``load_controller``.
    """
    return cast(Startable, load_controller(robot_or_path, robot=robot))
