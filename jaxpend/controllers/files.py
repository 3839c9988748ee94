"""Files of whole controllers: their arrays by key path, and a header that says how they fit.

The header names classes and fields; only the package's own classes, and those that the caller
gives, are made from it, so that a file cannot run code. A ``Policy`` keeps its own format.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..arrays import read_arrays, write_arrays
from ..controller import Controller, OpenLoop, Zero
from ..errors import JaxpendError, choose
from ..observation import Observation
from ..plant import Plant
from ..robots import ROBOTS
from ..trajopt.ilqr import Solution
from ..trajopt.reference import Reference
from .energy import EnergyShaping
from .guard import Guarded, Observer, Rescue
from .hybrid import Ellipsoid, Hybrid, Tolerances
from .lqr import LQR
from .mpc import MPC
from .pd import PD
from .policy import Policy, load_policy, save_policy
from .riccati import Riccati
from .tvlqr import TVLQR

__all__ = ["classes_of", "load_controller", "save_controller"]

FORMAT = 1
# What files of earlier versions call classes and fields.
FORMER = {"Nominal": "Reference", "nominal": "reference"}
CLASSES = (
    EnergyShaping, Ellipsoid, Guarded, Hybrid, LQR, MPC, Reference, Observation, Observer, OpenLoop,
    PD, Plant, Policy, Rescue, Riccati, Solution, TVLQR, Tolerances, Zero,
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
    if not hasattr(value, "dtype"):
        raise JaxpendError(f"{path} is {value!r}; a file can hold arrays, numbers and text only")
    arrays[path] = np.asarray(value)
    return {"array": path}


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


def save_controller(
    path: str | Path, controller: Controller, robot: str, provenance: dict[str, Any] | None = None
) -> None:
    """Write a controller file, atomically: .npz without pickle, as ``save_policy`` for a policy.

    Raises:
        JaxpendError: it holds what is neither array, number, text nor dataclass of those.
    """
    if isinstance(controller, Policy):
        return save_policy(path, controller, provenance)
    arrays: dict[str, np.ndarray] = {}
    header = {"format": FORMAT, "kind": "controller", "robot": robot}
    header |= {"controller": _described(controller, "", arrays), "provenance": provenance or {}}
    return write_arrays(path, header, arrays)


def load_controller(
    robot_or_path: str | Path, *, robot: str | None = None, classes: Iterable[type] = ()
) -> Controller:
    """Load a policy or controller file, or by a robot's name the policy that ships.

    The arrays of a controller have jax's default float type at the time of the call; a policy's
    are float32.

    Args:
        robot_or_path: a path, or the name of a robot.
        robot: the robot that it must be for; None accepts either.
        classes: a user's own, beside the package's.

    Raises:
        JaxpendError: no such file, not a controller file, one for the other robot, or a class
            that is not known.
    """
    path = Path(robot_or_path)
    if str(robot_or_path) in ROBOTS:
        return load_policy(robot_or_path, robot=robot)
    header, arrays = read_arrays(path, "policy")
    if header.get("kind") != "controller":
        return load_policy(path, robot=robot)
    if header.get("format") != FORMAT:
        raise JaxpendError(
            f"{path} has controller format {header.get('format')}; this reads {FORMAT}"
        )
    known = {kind.__name__: kind for kind in (*CLASSES, *classes)}
    try:
        controller = _made(header["controller"], arrays, known)
        its_robot = choose("robot", header["robot"], ROBOTS)
        act = lambda c: c(c.reset(jax.random.key(0)), jnp.zeros(()), jnp.zeros(4))[1]  # noqa: E731
        shape = jax.eval_shape(act, controller).shape
    except JaxpendError:
        raise
    except Exception as error:  # whatever a controller raises for arrays that do not fit
        raise JaxpendError(f"{path} does not hold a whole controller: {error!r}") from None
    if shape != (2,) or any(np.isnan(a).any() for a in arrays.values() if a.dtype.kind == "f"):
        raise JaxpendError(f"{path}: the controller gives no torques (2,), or holds nan")
    if robot is not None and its_robot != choose("robot", robot, ROBOTS):
        raise JaxpendError(f"{path} is a controller for the {its_robot}, not for the {robot}")
    return controller
