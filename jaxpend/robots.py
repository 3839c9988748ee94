"""The two robots."""

from .errors import choose

__all__ = ["ROBOTS", "active_joint"]

# Driven joint of each robot.
ROBOTS = {"acrobot": 1, "pendubot": 0}


def active_joint(robot: str) -> int:
    """Index of the driven joint: 1 for the acrobot, 0 for the pendubot.

    Raises ``JaxpendError`` for an unknown robot.
    """
    return ROBOTS[choose("robot", robot, ROBOTS)]
