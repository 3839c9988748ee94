"""What commands that judge share: the board, and the controller that the options name."""

import dataclasses
from typing import TYPE_CHECKING, Any

from ..errors import JaxpendError

if TYPE_CHECKING:
    from ..boards import Board
    from ..controller import Controller

__all__ = ["Subject", "board_of", "of_draws"]


def board_of(robot: str, plant: str | None, design: str | None, name: str = "v2") -> "Board":
    """A board of a robot; on another plant its scores are not comparable to published ones."""
    from ..boards import named_board, task_of

    official, task = named_board(robot, name), task_of(robot, plant, design, name)
    if not (plant or design):
        return official
    name = f"{official.name} on {plant or design}"
    return dataclasses.replace(official, name=name, task=task, published=())


def of_draws(board: "Board", draws: int | None) -> "Board":
    """The board with so many official draws; None: all of them.

    Raises ``JaxpendError`` where there are not so many.
    """
    if draws is None:
        return board
    if draws > board.draws:
        raise JaxpendError(f"--draws is {draws}; the {board.name} board has {board.draws}")
    return dataclasses.replace(board, draws=draws)


@dataclasses.dataclass(frozen=True)
class Subject:
    """What ``--robot --policy --controller --plant --design`` of a command say."""

    robot: str
    policy: str | None = None
    controller: str | None = None
    plant: str | None = None
    design: str | None = None
    torque_limit: float | None = None  # N m, of the driven joint; None: that of the board
    on: str = "v2"  # name of the board

    @property
    def board(self) -> "Board":
        """The board to judge on."""
        board = board_of(self.robot, self.plant, self.design, self.on)
        if self.torque_limit is None:
            return board
        task = dataclasses.replace(board.task, torque_limit=self.torque_limit)
        return dataclasses.replace(board, task=task)

    @property
    def name(self) -> str:
        """What it is called in a table."""
        return self.controller or self.policy or f"shipped {self.board.task.shipped}"

    @property
    def about(self) -> dict[str, Any]:
        """What is written down of it, with the header of the file of the policy, if there is one.

        Raises ``JaxpendError`` for a file that cannot be used.
        """
        from ..controllers.files import read_header

        file = self.policy or (None if self.controller else self.board.task.shipped)
        said = {"policy": file, "controller": self.controller, "plant": self.plant}
        return said | {"design": self.design, "header": read_header(file) if file else None}

    def find(self, board: "Board") -> "Controller":
        """The controller, in jax's default float type at the time of the call."""
        from ..controllers.catalogue import find_controller

        return find_controller(self.policy, self.controller, board.task)
