"""A controller as a submission to the boards of the RealAIGym ``double_pendulum`` package.

The folder has the paths of that package, so that it can be copied into a checkout of it: the
controller in numpy alone, on the package's controller interface; a ``con_NAME.py`` for the
performance and one for the robustness board; and what both show of it, with its scores. The other
way, an object of that interface as a controller here, is ``controllers.callback.realaigym``.
"""

import keyword
import os
import re
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from ..boards import HEADINGS, Board, v2
from ..controller import Controller, check_robot
from ..controllers.files import load_controller, read_header
from ..criteria import V2_OFFICIAL
from ..errors import JaxpendError
from ..files import write_atomically
from ..leaderboard import judge
from ..plant import Plant
from ..robustness import CRITERIA
from ..stepping import called_every
from .numpy import source

__all__ = ["check_target", "export", "submission", "write"]

TITLE = "a submission of jaxpend to RealAIGym"
BOARDS = ("simulation_v2", "robustness_v2")  # folders there, for performance and robustness
NAME = re.compile("[a-z][a-z0-9_]{0,39}")
# What that package has in its folder of controllers, which a submission would be copied over.
TAKEN = {
    "acados_mpc", "ar_eapo", "dqn", "energy", "evolsac", "friction_compensation", "gamepad",
    "gravity_compensation", "history_sac", "ilqr", "inverse_dynamics", "lqr", "mcpilco",
    "partial_feedback_linearization", "pid", "prx", "prx_flow_matching", "random_exploration",
    "sac", "trajectory_following", "tvlqr", "vimppi",
}  # fmt: skip

CLASS = '''

try:
    from double_pendulum.controller.abstract_controller import AbstractController
except ImportError:  # to be called, it needs no more of that package

    class AbstractController:
        """What the interface comes to without filter and compensations."""

        def init(self):
            """Begin a run."""
            self.init_()

        def reset(self):
            """Forget what was measured."""
            self.reset_()


class {class_name}(AbstractController):
    """The controller on the interface of double_pendulum, called every {dt:g} s."""

    def __init__(self):
        super().__init__()
        self.law, self.calls = Law(), 0

    def init_(self):
        """Begin a run."""
        self.reset_()

    def reset_(self):
        """Forget what was measured."""
        self.law.reset()
        self.calls = 0

    def get_control_output_(self, x, t=None):
        """Torques (2,), N m, for angles (rad) and velocities (rad/s) at time t (s)."""
        t = {dt:g} * self.calls if t is None else t
        self.calls += 1
        return self.law.torque(t, x)
'''

CON = """from double_pendulum.controller.{name}.{name}_controller import {class_name}

name = "{name}"
leaderboard_config = {{
    "csv_path": name + "/sim_swingup.csv",
    "name": name,
    "simple_name": "{name}",
    "short_description": "{about}",
    "readme_path": f"readmes/{{name}}.md",
    "username": "unknown",
}}

controller = {class_name}()
controller.init()
"""

README = """# {name}, {title}

Copy the folders beside this file into a checkout of double_pendulum and put your name into
`username` of both files con_{name}.py. There:

    cd leaderboard/{robot}/simulation_v2 && python calculate_leaderboard_score.py con_{name}.py
    cd leaderboard/{robot}/robustness_v2 && python benchmark_controller.py con_{name}.py

Without that package, in leaderboard/{robot}/simulation_v2:

    PYTHONPATH=../../../src/python jaxpend score --robot {robot} --controller con_{name}:controller

"""


def check_target(folder: str | Path) -> str:
    """The name of a submission, which is that of its folder.

    Raises:
        JaxpendError: a name that is none in Python or is taken there, or a folder with something
            else in it.
    """
    folder = Path(folder)
    name = Path(os.path.abspath(folder)).name.lower().replace("-", "_")
    if not NAME.fullmatch(name) or keyword.iskeyword(name):
        raise JaxpendError(
            f"the submission would be called {name!r}, as its folder is; a name has letters, "
            "digits and underscores, a letter first, and 40 at most"
        )
    if name in TAKEN:
        raise JaxpendError(f"double_pendulum has a controller {name} already; choose another name")
    if folder.exists() and not folder.is_dir():
        raise JaxpendError(f"cannot write into {folder}: it is not a folder")
    readme = folder / "README.md"
    if folder.is_dir() and any(folder.iterdir()):
        first = readme.read_bytes()[:200].splitlines()[:1] if readme.is_file() else []
        if first != [f"# {name}, {TITLE}".encode()]:
            raise JaxpendError(
                f"{folder} is not empty and holds no submission of jaxpend; choose another name"
            )
    return name


def submission(
    controller: Controller, robot: str, name: str, found: Mapping[str, Any], dt: float
) -> dict[str, str]:
    """Path -> text of the files of a submission.

    Args:
        controller: any that can be written in numpy (``interop.numpy``), in float64.
        robot: "acrobot" or "pendubot".
        name: of the submission.
        found: what ``leaderboard.judge`` says of it.
        dt: s, the period at which it is called.
    """
    kind, class_name = type(controller).__name__, name.title().replace("_", "") + "Controller"
    about = f"{kind} made with jaxpend; in numpy alone"
    package = f"src/python/double_pendulum/controller/{name}"
    law = source(controller, class_name="Law").rstrip() + "\n"
    scores = _scores(found)
    files = {
        "README.md": README.format(name=name, title=TITLE, robot=robot) + scores,
        f"{package}/__init__.py": "",
        f"{package}/{name}_controller.py": law + CLASS.format(class_name=class_name, dt=dt),
    }
    for board in BOARDS:
        folder = f"leaderboard/{robot}/{board}"
        files[f"{folder}/con_{name}.py"] = CON.format(name=name, class_name=class_name, about=about)
        files[f"{folder}/readmes/{name}.md"] = f"# {name}\n\n{about}.\n\n{scores}"
    return files


def _scores(found: Mapping[str, Any]) -> str:
    """The columns of both boards, as the readme shows them."""
    shown = {name: HEADINGS[name] for name in V2_OFFICIAL}
    headings = [f"{heading} [{unit}]" for heading, unit, *_ in shown.values()]
    criteria = found["criteria"]
    cells = [f"{criteria[name]:{form}}" for name, (_, _, form, _) in shown.items()]
    success = "yes" if found["success"] else "no"
    lines = _table(["success", *headings, "score"], [success, *cells, f"{found['score']:.3f}"])
    if found.get("robustness") is not None:
        six = [f"{100 * found['robustness_criteria'][name]:.1f}" for name in CRITERIA]
        titles = [f"{title} [%]" for title in CRITERIA.values()]
        overall = f"{found['robustness']:.3f}"
        lines += "\n" + _table([*titles, "robustness"], [*six, overall])
    keys = len(found.get("robustness_by_key", ()))
    median = f", robustness the median over {keys} keys" if keys > 1 else ""
    said = f"As jaxpend judges it: performance in float64 on the nominal plant{median}."
    return textwrap.fill(said, 100) + "\n\n" + lines


def _table(headings: list[str], cells: list[str]) -> str:
    rows = (headings, ["---:"] * len(headings), cells)
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def write(
    make: Callable[[Plant], Controller], board: Board, folder: str | Path, **options: Any
) -> dict[str, Any]:
    """Judge a controller, and write its submission into a folder.

    Args:
        make: called as ``make(plant)`` under either precision; gives the controller.
        board: to judge it on.
        folder: new, or with an earlier submission of that name.
        options: of ``leaderboard.judge``: robustness, keys, seed.

    Returns:
        What ``leaderboard.judge`` says, which is in the readme too.

    Raises:
        JaxpendError: as ``check_target``, or a controller that cannot be written in numpy.
    """
    name, folder = check_target(folder), Path(folder)
    with jax.enable_x64(True):
        controller = called_every(make(board.task.plant), board.task.dt)
        check_robot(controller, board.robot)
        source(controller)  # what cannot be written is known before it is judged
    found = judge(make, board, **options)
    with jax.enable_x64(True):
        files = submission(controller, board.robot, name, found, board.task.dt)
    for path, text in files.items():
        write_atomically(folder / path, text)
    return found


def export(robot_or_path: str | Path, folder: str | Path, **options: Any) -> dict[str, Any]:
    """``write`` for a policy or controller file, or by a robot's name the policy that ships."""
    check_target(folder)
    board = v2(read_header(robot_or_path)["robot"])
    return write(lambda plant: load_controller(robot_or_path), board, folder, **options)
