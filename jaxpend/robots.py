"""The two robots."""

import os
from importlib import resources
from pathlib import Path

from .errors import JaxpendError, choose

__all__ = ["ROBOTS", "SHIPPED", "active_joint", "shipped"]

# Driven joint of each robot.
ROBOTS = {"acrobot": 1, "pendubot": 0}
# Policies that ship: what ``make train`` learns by the robot's name, and what other recipes do.
OTHERS = ("demonstrated", "global", "hardware")
SHIPPED = (*ROBOTS, *(f"{recipe}_{robot}" for recipe in OTHERS for robot in ROBOTS))


def active_joint(robot: str) -> int:
    """Index of the driven joint: 1 for the acrobot, 0 for the pendubot.

    Raises ``JaxpendError`` for an unknown robot.
    """
    return ROBOTS[choose("robot", robot, ROBOTS)]


def shipped(robot_or_path: str | Path, folder: str) -> Path:
    """The file in ``folder`` that ships, by its name in ``SHIPPED``; else the path itself."""
    if not isinstance(robot_or_path, str | os.PathLike):
        raise JaxpendError(f"{robot_or_path!r:.40} is no path, and no name of what ships")
    if str(robot_or_path) not in SHIPPED:
        return Path(robot_or_path)
    return Path(str(resources.files(__package__).joinpath(f"{folder}/{robot_or_path}.npz")))
