"""A submission to RealAIGym does what the policy does, without jax and without that package."""

import importlib
import subprocess
import sys

import jax
import numpy as np
import pytest
from conftest import refused, task_of

from jaxpend import cli, load_policy, rollout
from jaxpend.boards import v2
from jaxpend.controllers import pd
from jaxpend.controllers.catalogue import find_controller
from jaxpend.interop.realaigym import check_target, export, submission, write
from jaxpend.leaderboard import judge

ROBOT = "pendubot"
JUDGED = {
    "success": True, "score": 0.69951, "robustness": 0.975, "robustness_by_key": [0.97, 0.975, 1],
    "criteria": {"swingup_time": 1.25, "energy": 7.671, "tau_cost": 2.61, "tau_smoothness": 0.00538,
                 "velocity_cost": 49.52},
    "robustness_criteria": {"model": 0.85, "velocity_noise": 1.0, "torque_noise": 1.0,
                            "responsiveness": 1.0, "delay": 0.952, "perturbation": 1.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The submission of the shipped policy, which is guarded: observer, rescue and memory."""
    path = tmp_path_factory.mktemp("out") / "My-policy"
    with jax.enable_x64(True):
        files = submission(load_policy(ROBOT), ROBOT, check_target(path), JUDGED, 0.002)
    for name, text in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text(text)
    return path


@pytest.fixture
def place(folder, monkeypatch):
    """The folder of the performance board, from which its scripts run."""
    monkeypatch.chdir(folder / f"leaderboard/{ROBOT}/simulation_v2")
    monkeypatch.setattr(sys, "path", [".", str(folder / "src/python"), *sys.path])
    for name in [name for name in sys.modules if name.startswith(("double_pendulum", "con_my_"))]:
        monkeypatch.delitem(sys.modules, name)
    yield
    for name in [name for name in sys.modules if name.startswith(("double_pendulum", "con_my_"))]:
        del sys.modules[name]


@pytest.mark.x64
def test_it_can_be_judged_here_and_does_what_the_policy_does(place):
    task, policy = task_of(ROBOT), load_policy(ROBOT)
    law = find_controller(None, "con_my_policy:controller", task)
    theirs = importlib.import_module("con_my_policy").controller
    run = jax.jit(lambda policy: rollout(task.plant, policy, jax.random.key(0), duration=1.0))(
        policy
    )
    t, x = np.asarray(run.t), np.asarray(run.x_measured)
    again = [theirs.get_control_output_(x, t) for t, x in zip(t, x, strict=False)]
    np.testing.assert_allclose(again, run.u_command, atol=1e-9)
    assert abs(run.u[:, 0]).max() > 2
    # Off the track the rescue takes over, and keeps control: what the memory is for.
    steppers = [law.start(), policy.start()]
    for t, angle in ((0.0, 0.0), (2.1, 0.5), (2.102, 3.1), (2.104, 3.1)):
        torques = [one(t, [angle, 0.1, 0.2, 0]) for one in steppers]
        np.testing.assert_allclose(*torques, atol=1e-9)


def test_it_needs_numpy_alone(folder):
    code = "import sys; from con_my_policy import controller as c, leaderboard_config as about; "
    code += "c.reset_(); c.init_(); u = c.get_control_output_([0.1, 0, 0, 0]); "
    code += "assert u.shape == (2,) and u[1] == 0 != u[0] and c.calls == 1; "
    code += "assert about['csv_path'] == 'my_policy/sim_swingup.csv'; "
    code += "assert not {'jax', 'jaxpend', 'scipy'} & set(sys.modules)"
    where = folder / f"leaderboard/{ROBOT}/robustness_v2"
    environment = {"PYTHONPATH": str(folder / "src/python")}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=where, env=environment)


BASE = """
class AbstractController:
    def __init__(self):
        self.made = True

    def init(self):
        self.init_()

    def get_control_output(self, x, t=None):
        u = self.get_control_output_(x, t)
        u += 1.0
        return u
"""


def test_it_is_one_of_the_package_where_there_is_the_package(folder, place):
    file = folder / "src/python/double_pendulum/controller/abstract_controller.py"
    file.write_text(BASE)
    importlib.invalidate_caches()
    try:
        controller = importlib.import_module("con_my_policy").controller
        base = importlib.import_module("double_pendulum.controller.abstract_controller")
    finally:
        file.unlink()
    assert isinstance(controller, base.AbstractController)
    assert controller.made
    x = np.array([0.1, 0.0, 0.0, 0.0])
    without = controller.get_control_output_(x, 0.0)
    controller.init()
    np.testing.assert_allclose(controller.get_control_output(x, 0.0), without + 1.0)


def test_the_readmes_show_the_columns_of_the_boards(folder):
    boards = [f"leaderboard/{ROBOT}/{board}" for board in ("simulation_v2", "robustness_v2")]
    for name in ("README.md", *(f"{board}/readmes/my_policy.md" for board in boards)):
        text = " ".join((folder / name).read_text().split())
        assert text.startswith("# my_policy")
        assert "| yes | 1.25 | 7.67 | 2.61 | 0.0054 | 49.5 | 0.700 |" in text
        assert "| 85.0 | 100.0 | 100.0 | 100.0 | 95.2 | 100.0 | 0.975 |" in text
        assert "robustness the median over 3 keys." in text


def test_a_folder_is_judged_and_written(tmp_path):
    made = []

    def make(plant):
        made.append(plant.mass.dtype)
        return pd(plant, ROBOT)

    folder = tmp_path / "pd"
    found = write(make, v2(ROBOT), folder, robustness=False)
    assert found["score"] == judge(make, v2(ROBOT), robustness=False)["score"]
    assert {str(dtype) for dtype in made} == {"float64"}
    before = sorted(folder.rglob("*"))
    write(make, v2(ROBOT), folder, robustness=False)  # its own it may replace
    assert sorted(folder.rglob("*")) == before
    assert len([path for path in before if path.is_file()]) == 7


def test_a_file_says_its_robot(tmp_path, monkeypatch):
    judged = []

    def judge(make, board, **options):
        judged.append((make(board.task.plant).main.robot, board.robot, options))
        return JUDGED

    monkeypatch.setattr("jaxpend.interop.realaigym.judge", judge)
    assert export("acrobot", tmp_path / "theirs", keys=5) is JUDGED
    assert judged == [("acrobot", "acrobot", {"keys": 5})]
    law = tmp_path / "theirs/src/python/double_pendulum/controller/theirs/theirs_controller.py"
    names = {}
    exec(law.read_text(), names)
    one = names["TheirsController"]()
    torque = one.get_control_output_([0.0, 0.2, 0.0, 0.0], 0.0)
    assert torque[0] == 0 != torque[1]
    assert (tmp_path / "theirs/leaderboard/acrobot/robustness_v2/con_theirs.py").is_file()


def test_the_command_says_where_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("jaxpend.interop.realaigym.judge", lambda *_, **__: JUDGED)
    monkeypatch.setattr("jaxpend.terminal.console._file", None)
    monkeypatch.chdir(tmp_path)
    for out, words in (
        (
            "mine",
            "wrote mine, a submission of acrobot to RealAIGym: score 0.6995, robustness 0.975",
        ),
        ("1st", "jaxpend export: the submission would be called '1st', as its folder is; a name"),
        (
            "mine/README.md",
            "jaxpend export: cannot write into mine/README.md: mine/README.md is no",
        ),
    ):
        line = ["jaxpend", "export", "acrobot", "--to", "realaigym", "--out", out]
        monkeypatch.setattr("sys.argv", line)
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == (0 if words.startswith("wrote") else 2)
        out, err = capsys.readouterr()
        assert err.startswith(words)
        assert (out, err.count("\n")) == ("", 1)
    assert (tmp_path / "mine" / "README.md").is_file()


@pytest.mark.parametrize(
    ("name", "there", "words"),
    [
        ("1st", None, "the submission would be called '1st', as its folder is; a name has letter"),
        ("a b", None, "the submission would be called 'a b'"),
        ("class", None, "the submission would be called 'class'"),
        ("tvlqr", None, "double_pendulum has a controller tvlqr already; choose another name"),
        ("AR-EAPO", None, "double_pendulum has a controller ar_eapo already"),
        ("x" * 41, None, "the submission would be called 'xxx"),
        ("mine", "thesis.tex", "is not empty and holds no submission of jaxpend; choose another"),
        ("mine", "README.md", "is not empty and holds no submission of jaxpend; choose another"),
        ("mine", "", "is not a folder"),
    ],
)
def test_folders_that_are_refused(tmp_path, name, there, words):
    folder = tmp_path / name
    if there:
        folder.mkdir()
        (folder / there).write_text("# my thesis\n")
    elif there is not None:
        folder.touch()
    with refused(words):
        check_target(folder)
    with refused(words):
        write(lambda plant: 1 / 0, v2(ROBOT), folder)


def test_a_controller_of_the_other_robot_is_refused(tmp_path):
    with refused("this controller is for the acrobot, not for the pendubot"):
        write(lambda plant: load_policy("acrobot"), v2(ROBOT), tmp_path / "new")
    assert not (tmp_path / "new").exists()
