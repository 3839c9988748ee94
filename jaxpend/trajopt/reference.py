"""An optimised swing-up to follow, and its file: plain arrays and a JSON header."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..arrays import read_arrays, write_arrays
from ..errors import JaxpendError, choose
from ..plant import joint_torque
from ..pytree import Pytree, pytree, static
from ..robots import ROBOTS, active_joint, shipped
from ..scenario import DT

__all__ = ["Reference", "check_target", "load_reference", "save_reference"]

FORMAT = 1


@pytree
class Reference(Pytree):
    """A swing-up of N steps from hanging to upright, with the feedback that iLQR found for it."""

    x: jax.Array  # (N + 1, 4) states
    u: jax.Array  # (N,) N m, torque of the driven joint over step k
    gain: jax.Array  # (N, 5) of (state, last torque): u + gain . (deviation, last - u_{k-1})
    robot: str = static(default="pendubot")
    dt: float = static(default=DT)  # s

    @property
    def steps(self) -> int:
        """N."""
        return self.u.shape[0]

    @property
    def goal(self) -> jax.Array:
        """Upright, (4,), on the turn of theta1 and theta2 where the swing-up ends."""
        turn, upright = 2 * jnp.pi, jnp.array([jnp.pi, 0.0], self.x.dtype)
        angles = upright + turn * jnp.round((self.x[-1, :2] - upright) / turn)
        return jnp.concatenate([angles, jnp.zeros(2, self.x.dtype)])

    def at(self, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The step nearest to time ``t`` (s), one of the N, and whether ``t`` is before the end."""
        index = jnp.round(t / self.dt).astype(int)
        return jnp.clip(index, 0, self.steps - 1), index < self.steps

    def both(self, torque: jax.Array) -> jax.Array:
        """Torques of the driven joint (...) as torques of both joints (..., 2)."""
        return joint_torque(torque, active_joint(self.robot))


def save_reference(path: str | Path, reference: Reference, provenance: dict[str, Any]) -> None:
    """Write a trajectory file (.npz without pickle), atomically: float32, the torques float64."""
    header = {"format": FORMAT, "kind": "swing-up", "robot": reference.robot, "dt": reference.dt}
    header["provenance"] = provenance
    arrays = {"x": np.asarray(reference.x, "f4"), "gain": np.asarray(reference.gain, "f4")}
    write_arrays(path, header, arrays | {"u": np.asarray(reference.u, "f8")})


def check_target(path: Path) -> None:
    """Raise ``JaxpendError`` for a file that is there and is no trajectory file."""
    if path.is_file() and path.stat().st_size:
        try:
            load_reference(path.absolute())  # not what ships by that name
        except JaxpendError:
            text = f"cannot write {path}: it is there and is no trajectory file"
            raise JaxpendError(f"{text}; choose another name") from None


def load_reference(robot_or_path: str | Path, *, robot: str | None = None) -> Reference:
    """Load a trajectory file, or by "acrobot" / "pendubot" the one that ships with the package.

    The arrays have jax's default float type at the time of the call.

    Raises:
        JaxpendError: no such file, not a trajectory file, or one for the other robot.
    """
    path = shipped(robot_or_path, "trajectories")
    header, arrays = read_arrays(path, "trajectory")
    if header.get("kind") != "swing-up" or header.get("format") != FORMAT:
        raise JaxpendError(f"{path} is not a swing-up trajectory of format {FORMAT}")
    try:
        steps = arrays["u"].shape[0]
        shapes = {name: arrays[name].shape for name in ("x", "u", "gain")}
        name, dt = choose("robot", header["robot"], ROBOTS), float(header["dt"])
    except (KeyError, IndexError, TypeError) as error:
        raise JaxpendError(f"{path} lacks a part of a trajectory: {error}") from None
    if shapes != {"x": (steps + 1, 4), "u": (steps,), "gain": (steps, 5)} or steps < 1:
        raise JaxpendError(f"{path}: the arrays do not have the shapes of a trajectory: {shapes}")
    if not (all(np.isfinite(arrays[n]).all() for n in shapes) and dt > 0):
        raise JaxpendError(f"{path}: the trajectory holds values that are not finite")
    if robot is not None and name != choose("robot", robot, ROBOTS):
        raise JaxpendError(f"{path} is a trajectory for the {name}, not for the {robot}")
    dtype = jnp.result_type(float)
    x, u, gain = (jnp.asarray(arrays[n], dtype) for n in ("x", "u", "gain"))
    return Reference(x, u, gain, robot=name, dt=dt)
