"""Parameter sets: what is shipped, and what a user's own may contain."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import both_precisions, both_robots, excerpt, refused

from jaxpend import JaxpendError, designs

OWN = {"m1": 0.5, "m2": 0.6, "l1": 0.2, "l2": 0.3, "r1": 0.2, "r2": 0.25, "I1": 0.03, "I2": 0.05}


@both_robots
@both_precisions
def test_competition_plant_is_that_of_the_reference(robot, dtype):
    plant = designs.competition(robot)
    g = excerpt(f"imperfections_{robot}")
    values = {
        "mass": [0, 1], "length": [2, 3], "com": [4, 5], "inertia": [6, 7], "damping": [8, 9],
        "coulomb_friction": [10, 11], "gravity": 12, "motor_inertia": 13, "gear_ratio": 14,
    }  # fmt: skip
    for field, columns in values.items():
        value = np.asarray(getattr(plant, field))
        np.testing.assert_array_equal(value, g["params"][columns].astype(dtype), err_msg=field)
        assert value.dtype == dtype
    np.testing.assert_array_equal(plant.torque_limit, g["torque_limit"][0])
    np.testing.assert_array_equal(plant.actuation, np.diag(g["B"][0]))


@both_robots
def test_full_model_has_friction_and_motor_inertia(robot):
    g = excerpt(f"trajectories_{robot}")
    row = g["loop_params"][list(g["loop_names"]).index("pd_friction")].astype("f4")
    plant = designs.load("C.1", "1.0", robot=robot)
    np.testing.assert_array_equal(plant.damping, row[8:10])
    np.testing.assert_array_equal(plant.coulomb_friction, row[10:12])
    assert plant.motor_inertia == row[13]


def test_every_named_set_loads_and_names_are_forgiving():
    assert {"A.0/2.0", "C.0/3.0", "C.1/1.0", "C.1/1.1"} <= set(designs.available())
    for name in designs.available():
        plant = designs.load(*name.split("/"))
        assert np.all(np.asarray(plant.inertia) > 0)
        assert np.all(np.asarray(plant.actuation) == 1)
    long_name = designs.load("design_C.1", "model_1.0")
    np.testing.assert_array_equal(long_name.mass, designs.load("C.1", "1.0").mass)


@both_robots
def test_a_robot_masks_its_passive_joint(robot):
    driven = designs.active_joint(robot)
    plant = designs.from_dict(OWN | {"tl1": 4.0, "tl2": 5.0}, robot=robot)
    assert plant.actuation[driven] == 1
    assert plant.torque_limit[driven] == (4.0, 5.0)[driven]
    assert plant.actuation[1 - driven] == 0
    assert plant.torque_limit[1 - driven] == 0
    assert designs.competition(robot, 3.0).torque_limit[driven] == 3.0


def test_defaults_of_a_users_own_set():
    plant = designs.from_dict(OWN)
    assert np.all(np.isinf(plant.torque_limit))
    assert plant.gravity == np.float32(9.81)
    assert plant.gear_ratio == 6
    assert not np.any(plant.damping)
    assert jnp.all(plant.actuation == 1)


def test_yaml_file(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("\n".join(f"{k}: {v}" for k, v in OWN.items()) + "\nb2: 0.01\n")
    plant = designs.from_file(path, robot="acrobot", torque_limit=2.0)
    np.testing.assert_allclose(plant.damping, [0, 0.01])
    np.testing.assert_allclose(plant.torque_limit, [0, 2.0])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: designs.load("Z.9", "1.0"), "design 'Z.9'; known: A.0, C.0, C.1"),
        (lambda: designs.load("C.1", "9"), "known: 1.0, 1.1"),
        (lambda: designs.competition("cartpole"), "robot 'cartpole'; known: acrobot, pendubot"),
        (lambda: designs.competition("acrobot", 0.0), "torque limit is 0.0 N m"),
        (lambda: designs.competition("acrobot", float("nan")), "torque limit is nan"),
        (lambda: designs.competition("acrobot", "6"), "torque limit is '6' N m; it must be"),
        (lambda: designs.from_dict({"m1": 1.0}), "lack m2, l1"),
        (lambda: designs.from_dict(OWN | {"mass": 1}), "plant parameter 'mass'"),
        (lambda: designs.from_dict(OWN | {"m1": "heavy"}), "m1 is 'heavy'; it must be a number"),
        (lambda: designs.from_dict(OWN | {"m1": float("nan")}), "m1 is nan; it must be positive"),
        (lambda: designs.from_dict(OWN | {"g": float("inf")}), "g is inf; it must be finite"),
        (lambda: designs.from_dict(OWN | {"I2": 0.0}), "I2 is 0.0; it must be positive"),
        (lambda: designs.from_dict(OWN | {"tl1": -1}), "tl1 is -1.0; it must not be negative"),
        (lambda: designs.from_dict([1.0]), "must be a mapping"),
        (
            lambda: designs.from_dict(designs.parameters("C.1/1.0") | {"I2": 0.01}),
            "the mass matrix of these plant parameters is not positive definite; I1 and I2",
        ),
        (lambda: designs.from_file("missing.yaml"), "missing.yaml: No such file"),
    ],
)
def test_bad_input_is_one_sentence(call, words):
    with refused(words):
        call()


def test_broken_yaml_is_one_sentence(tmp_path):
    path = tmp_path / "broken.yaml"
    path.write_text("m1: [0.5")
    with pytest.raises(JaxpendError, match="not valid YAML"):
        designs.from_file(path)
