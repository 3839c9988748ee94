"""The command ``jaxpend import``."""

from pathlib import Path
from typing import Literal

from ..config import Activation
from ..errors import JaxpendError
from ..fields import Positive, Robot
from .output import check_file

__all__ = ["import_"]


def import_(
    model: Path,
    /,
    robot: Robot,
    out: Path,
    command: str,
    preset: Literal["evolsac", "ar_eapo"] | None = None,
    observation: Literal["wrapped", "sincos", "sincos_clipped", "sincos_by_joint", "state"]
    | None = None,
    max_velocity: Positive | None = None,
    torque_limit: Positive | None = None,
    statistics: Path | None = None,
    squash: Literal["tanh", "clip"] | None = None,
    activation: Activation | None = None,
) -> None:
    """A policy file of a Stable-Baselines3 model, SAC or PPO, which every command takes.

    What the model does not say of its environment is declared: by a preset, or by observation,
    max-velocity and torque-limit; what is said as well as a preset overrides it. No pickle in a
    file is ever unpickled.

    Args:
        model: the zip that model.save wrote.
        robot: which joint is driven: the second of the acrobot, the first of the pendubot.
        out: policy file to write.
        preset: evolsac, the published Evolutionary SAC, or ar_eapo, AR-EAPO, whose running
            statistics lie beside the model in vec_normalize_env.pkl.
        observation: what the policy saw. wrapped: both angles modulo 2 pi, scaled to [-1, 1], and
            clipped velocities; sincos: both cosines, both sines, and velocities; sincos_clipped:
            the same with clipped velocities; sincos_by_joint: that with cosine and sine of the
            first joint before those of the second; state: angles in rad, and velocities.
        max_velocity: rad/s, by which velocities were divided; 1 if they were not.
        torque_limit: N m, the torque at the largest action.
        statistics: what VecNormalize.save wrote, or a .npz of mean and var.
        squash: how the mean becomes an action; by default as the library does it, tanh in SAC,
            clip in PPO.
        activation: by default what the model says.
    """
    if str(out) == "-":
        raise JaxpendError("--out is -; a policy file cannot go to standard output")
    check_file(out)
    from ..controllers.files import read_header, save_policy
    from ..interop.stable_baselines3 import declared, read_model
    from ..terminal import console

    if out.is_file():
        try:
            read_header(out)
        except JaxpendError:
            text = f"cannot write {out}: it is there and is no policy file; choose another name"
            raise JaxpendError(text) from None
    convention = declared(
        model, preset, observation=observation, max_velocity=max_velocity,
        torque_limit=torque_limit, statistics=None if statistics is None else str(statistics),
        squash=squash, activation=activation,
    )  # fmt: skip
    found = read_model(model, robot, convention)
    about = {"command": command, "algorithm": found.algorithm}
    save_policy(out, found.policy, about | {"stable_baselines3": found.version})
    widths = ", ".join(str(len(bias)) for _, bias in found.policy.layers[:-1])
    text = (
        f"{out} is the policy of {found.algorithm} in {model}, hidden layers of {widths or 'none'}"
    )
    console.print(f"{text}; next: jaxpend score --robot {robot} --policy {out}", soft_wrap=True)
