"""The command ``jaxpend import``."""

from pathlib import Path
from typing import Literal

from ..config import Activation
from ..errors import JaxpendError
from ..fields import Period, Robot, Scale
from ..observation import History, Seen
from .output import check_file

__all__ = ["import_"]


def import_(
    model: Path,
    /,
    robot: Robot,
    out: Path,
    command: str,
    preset: Literal["evolsac", "ar_eapo", "gymnasium"] | None = None,
    observation: Seen | None = None,
    max_velocity: Scale | None = None,
    torque_limit: Scale | None = None,
    statistics: Path | None = None,
    squash: Literal["tanh", "clip"] | None = None,
    activation: Activation | None = None,
    history: History | None = None,
    control_dt: Period | None = None,
    max_turn: Scale | None = None,
) -> None:
    """A policy file of a Stable-Baselines3 model, SAC or PPO, which every command takes.

    Args:
        model: the zip that model.save wrote; no pickle in it is unpickled.
        robot: which joint is driven: the second of the acrobot, the first of the pendubot.
        out: policy file to write.
        preset: declares all that a model does not say: evolsac, Evolutionary SAC; ar_eapo,
            AR-EAPO, with the statistics in vec_normalize_env.pkl beside it; gymnasium, our own
            environments as they are by default. Options override it.
        observation: what it saw. wrapped: angles mod 2 pi, scaled to [-1, 1], and clipped
            velocities; sincos: both cosines, both sines, velocities; sincos_clipped: the same
            with clipped velocities; sincos_by_joint: that with cosine and sine of the first joint
            first; state: angles in rad, velocities; angles: cosines and sines alone.
        max_velocity: rad/s, by which velocities were divided; 1 if they were not.
        torque_limit: N m, the torque at the largest action.
        statistics: what VecNormalize.save wrote, or a .npz of mean and var.
        squash: how the mean becomes an action; by default tanh in SAC, clip in PPO.
        activation: by default what the model says.
        history: past states and actions that it saw too, as our own environments show them.
        control_dt: s, how far apart they are.
        max_turn: rad, by which our own environments divided how far a joint turned in a period,
            with angles.
    """
    _check_out(out)
    from ..controllers.files import save_policy
    from ..interop.stable_baselines3 import declared, read_model
    from ..terminal import console

    convention = declared(
        model, preset, observation=observation, max_velocity=max_velocity, squash=squash,
        torque_limit=torque_limit, activation=activation, history=history, control_dt=control_dt,
        max_turn=max_turn,
        statistics=None if statistics is None else str(statistics),
    )  # fmt: skip
    found = read_model(model, robot, convention)
    about = {"command": command, "algorithm": found.algorithm, "library": found.library}
    save_policy(out, found.policy, about)
    text = f"{out} is the policy of {found.algorithm} in {model}; jaxpend score --robot {robot}"
    console.print(f"{text} --policy {out} judges it", soft_wrap=True)


def _check_out(out: Path) -> None:
    """Refuse a file that could not be written, or that is there and is no policy file."""
    if str(out) == "-":
        raise JaxpendError("--out is -; a policy file cannot go to standard output")
    check_file(out)
    if out.is_file():
        from ..controllers.files import read_header

        try:
            read_header(out.absolute())  # not what ships by that name
        except JaxpendError:
            text = f"cannot write {out}: it is there and is no policy file; choose another name"
            raise JaxpendError(text) from None
