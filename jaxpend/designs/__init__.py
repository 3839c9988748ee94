"""Identified parameter sets of the RealAIGym double pendulums, and a user's own.

The numbers in ``models.json`` are the identified parameters published with the RealAIGym
``double_pendulum`` project (designs A.0, C.0 and C.1; BSD 3-Clause), carried over as facts.
"""

import json
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np

from ..config_files import read_yaml
from ..errors import JaxpendError, choose
from ..fields import Bounds, NotNegative, Positive, checked
from ..plant import Plant, mass_terms
from ..robots import ROBOTS, active_joint

__all__ = [
    "COMPETITION", "PAIRS", "ROBOTS", "active_joint", "available", "competition", "from_dict",
    "from_file", "load", "parameters", "read",
]  # fmt: skip

_REQUIRED = ("m1", "m2", "l1", "l2", "r1", "r2", "I1", "I2")
_OPTIONAL = {
    "b1": 0.0, "b2": 0.0, "cf1": 0.0, "cf2": 0.0, "tl1": math.inf, "tl2": math.inf,
    "g": 9.81, "Ir": 0.0, "gr": 6.0,
}  # fmt: skip
# Field of a ``Plant`` -> parameter, of which there are two, such as m1 and m2.
PAIRS = {
    "mass": "m", "length": "l", "com": "r", "inertia": "I", "damping": "b",
    "coulomb_friction": "cf",
}  # fmt: skip
# What a parameter may be; the others must be positive.
_KINDS: dict[str, Any] = {
    **dict.fromkeys(("b1", "b2", "cf1", "cf2", "Ir"), NotNegative),
    **dict.fromkeys(("tl1", "tl2"), Annotated[float, Bounds(least=0, infinite=True)]),
    "g": float,
}


def _table() -> dict[str, dict[str, dict[str, float]]]:
    return json.loads(resources.files(__package__).joinpath("models.json").read_text())


# The plant of the v2 boards: design C.1 model 1.0 without friction and motor inertia.
COMPETITION: tuple[tuple[str, float], ...] = tuple(
    (_table()["C.1"]["1.0"] | dict.fromkeys(("b1", "b2", "cf1", "cf2", "Ir"), 0.0)).items()
)


def available() -> list[str]:
    """The known parameter sets, as ``"C.1/1.0"``."""
    return [f"{design}/{model}" for design, models in _table().items() for model in models]


def from_dict(
    parameters: Mapping[str, float], *, robot: str | None = None, torque_limit: float | None = None
) -> Plant:
    """Build a plant from the field names that RealAIGym uses.

    Args:
        parameters: ``m1 m2 l1 l2 r1 r2 I1 I2`` (kg, m, kg m^2 about the joint; required) and
            ``b1 b2 cf1 cf2 tl1 tl2 g Ir gr`` (N m s/rad, N m, N m, m/s^2, kg m^2, -).
        robot: "acrobot" or "pendubot" masks the passive joint in ``actuation`` and zeroes its
            torque limit; None leaves both joints driven.
        torque_limit: limit of the driven joint in N m, in place of ``tl1``/``tl2``.

    Raises:
        JaxpendError: missing or unknown parameters, or values that no plant has.
    """
    if not isinstance(parameters, Mapping):
        raise JaxpendError("plant parameters must be a mapping such as {m1: 0.5, l1: 0.2, ...}")
    if missing := [k for k in _REQUIRED if k not in parameters]:
        raise JaxpendError(f"plant parameters lack {', '.join(missing)}")
    for key in parameters:
        choose("plant parameter", key, (*_REQUIRED, *_OPTIONAL))
    p = {
        k: checked(_KINDS.get(k, Positive), v, f"plant parameter {k}", text=True)
        for k, v in {**_OPTIONAL, **parameters}.items()
    }
    limit, actuation = np.array([p["tl1"], p["tl2"]]), np.ones(2)
    if robot is not None:
        actuation = np.arange(2) == active_joint(robot)
        limit = np.where(actuation, limit, 0.0)
    if torque_limit is not None:
        if isinstance(torque_limit, str) or not torque_limit > 0:
            raise JaxpendError(
                f"torque limit is {torque_limit!r} N m; it must be a positive number"
            )
        limit = np.where(actuation, torque_limit, 0.0)
    values: dict[str, Any] = {k: [p[f"{v}1"], p[f"{v}2"]] for k, v in PAIRS.items()}
    values |= {"torque_limit": limit, "actuation": actuation, "gravity": p["g"]}
    values |= {"motor_inertia": p["Ir"], "gear_ratio": p["gr"]}
    # numpy, not jax, arrays: made inside a jitted function, they are still known constants.
    arrays: Any = {k: np.asarray(v, jnp.result_type(float)) for k, v in values.items()}
    plant = Plant(**arrays)
    # The determinant is concave in cos(theta2), so that its ends are its least.
    ends: Any = np.array([-1.0, 1.0])
    m11, m12, m22 = mass_terms(plant, ends)
    if not (m11 * m22 > m12**2).all():
        text = "the mass matrix of these plant parameters is not positive definite"
        raise JaxpendError(f"{text}; I1 and I2 are about the joints, I2 at least m2 r2^2")
    return plant


def read(path: str | Path) -> dict[str, float]:
    """Parameters as ``from_dict`` takes them, of a YAML (or JSON) file.

    Raises ``JaxpendError`` if it cannot be read, or holds something else.
    """
    parameters = read_yaml(Path(path))
    try:
        from_dict(parameters)
    except JaxpendError as error:
        raise JaxpendError(f"{path}: {error}") from None
    return {name: float(value) for name, value in parameters.items()}


def from_file(path: str | Path, **kwargs: Any) -> Plant:
    """``from_dict`` on a YAML (or JSON) file. Raises ``JaxpendError`` if it cannot be read."""
    return from_dict(read(path), **kwargs)


def parameters(name: str) -> dict[str, float]:
    """Parameters as ``from_dict`` takes them, of an identified set by name, such as "C.1/1.0".

    Raises ``JaxpendError`` for an unknown name; the message lists the known ones.
    """
    design, model = choose("design", name, available()).split("/")
    return _table()[design][model]


def load(design: str, model: str, **kwargs: Any) -> Plant:
    """``from_dict`` on an identified parameter set by name, such as ``load("C.1", "1.0")``.

    The arrays have jax's default float type at the time of the call: float64 under
    ``jax.enable_x64``, else float32. Raises ``JaxpendError`` for an unknown design or model; the
    message lists the known ones.
    """
    table = _table()
    models = table[choose("design", str(design).removeprefix("design_"), table)]
    model = choose(f"model of design {design}", str(model).removeprefix("model_"), models)
    return from_dict(models[model], **kwargs)


def competition(robot: str, torque_limit: float = 6.0) -> Plant:
    """The plant of the v2 boards: design C.1 model 1.0 without friction and motor inertia.

    The passive joint is masked and the driven one limited to ``torque_limit`` N m. The boards
    run it at dt = 0.002 s for 10 s from (0, 0, 0, 0), the defaults of ``rollout``.
    """
    return from_dict(dict(COMPETITION), robot=robot, torque_limit=torque_limit)
