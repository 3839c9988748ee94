"""Tasks on other plants."""

import numpy as np
import pytest
from conftest import refused

from jaxpend import designs
from jaxpend.boards import board, task_of, v2

OWN = {"m1": 0.5, "m2": 0.6, "l1": 0.2, "l2": 0.3, "r1": 0.2, "r2": 0.3, "I1": 0.03, "I2": 0.05}


@pytest.mark.parametrize(("robot", "limit"), [("acrobot", [0, 6]), ("pendubot", [6, 0])])
def test_a_task_on_another_plant_keeps_all_else(tmp_path, robot, limit):
    assert task_of(robot) == v2(robot).task
    path = tmp_path / "own.yaml"
    path.write_text("".join(f"{name}: {value}\n" for name, value in OWN.items()) + "tl1: 1\n")
    for task, mass in (
        (task_of(robot, plant=str(path)), [0.5, 0.6]),
        (task_of(robot, design="C.1/1.0"), np.asarray(designs.load("C.1", "1.0").mass)),
    ):
        assert hash(task) != hash(v2(robot).task)
        np.testing.assert_array_equal(task.plant.torque_limit, limit)
        np.testing.assert_array_equal(task.plant.actuation, np.sign(limit))
        np.testing.assert_allclose(task.plant.mass, mass)
        assert (task.robot, task.dt, task.duration) == (robot, 0.002, 10.0)
    assert float(task.plant.damping[0]) > 0  # design C.1 has friction, the boards leave it out


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("m1: 1", "plant parameters lack m2, l1"),
        ("- 1", "plant parameters must be a mapping"),
        ("a: [", "is not valid YAML, line 1"),
        ("m1: &a [*a]", "plant parameters lack"),
        ("[" * 5000, "is nested too deeply"),
    ],
)
def test_a_file_that_is_no_plant_is_one_sentence(tmp_path, text, words):
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with refused(words, start=str(path)):
        task_of("acrobot", plant=str(path))


def test_what_names_no_plant_is_one_sentence(tmp_path):
    with refused("No such file or directory", start="cannot read "):
        task_of("acrobot", plant=str(tmp_path / "none.yaml"))
    with refused("unknown design 'C.1'; known: A.0/", start=""):
        task_of("acrobot", design="C.1")
    with refused("are both given"):
        task_of("acrobot", "a", "C.1/1.0")
    with refused("unknown robot"):
        task_of("cartpole")


def test_a_task_is_no_board():
    with refused("a task is no board; give a board, such as v2(robot)"):
        board(v2("acrobot").task)
