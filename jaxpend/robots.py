"""The two robots."""

from importlib import resources
from pathlib import Path

from .errors import choose

__all__ = ["ROBOTS", "active_joint", "shipped"]

# Driven joint of each robot.
ROBOTS = {"acrobot": 1, "pendubot": 0}


def active_joint(robot: str) -> int:
    """Index of the driven joint: 1 for the acrobot, 0 for the pendubot.

    Raises ``JaxpendError`` for an unknown robot.
    """
    return ROBOTS[choose("robot", robot, ROBOTS)]


def shipped(robot_or_path: str | Path, folder: str) -> Path:
    """The file in ``folder`` that ships for a robot, by its name; else the path itself."""
    if str(robot_or_path) not in ROBOTS:
        return Path(robot_or_path)
    return Path(str(resources.files(__package__).joinpath(f"{folder}/{robot_or_path}.npz")))
