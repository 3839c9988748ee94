"""Controller files: whatever the controller, it comes back whole, and a file cannot run code."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused, rewrite, task_of

from jaxpend import JaxpendError, Policy, designs, leaderboard, load_policy, save_policy
from jaxpend.boards import v2
from jaxpend.cli import commands
from jaxpend.controller import Memoryless
from jaxpend.controllers import Feedback, Reference, load_controller, lqr, save_controller
from jaxpend.controllers.catalogue import CATALOGUE, build, find_controller
from jaxpend.controllers.files import classes_of
from jaxpend.controllers.hybrid import with_lqr
from jaxpend.controllers.policy import network_in
from jaxpend.pytree import pytree, static
from jaxpend.report.judged import judge
from jaxpend.runs.reader import find
from jaxpend.score import official

PLANT, TASK = designs.competition("pendubot"), task_of("pendubot")


@pytree
class Own(Memoryless):
    """A user's own controller, with parts of the package's."""

    parts: tuple
    wheels: int = static(default=4)

    def __call__(self, carry, t, x):
        return carry, self.parts[0](None, t, x)[1] / self.wheels


OWN = Own((lqr(PLANT, "pendubot"), None))


def same(a, b):
    """The same controller, to the bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("name", [n for n in CATALOGUE if not n.startswith("mpc")])
def test_every_known_controller_comes_back_whole(tmp_path, name):
    made, path = build(name, PLANT, "pendubot"), tmp_path / "file.npz"
    save_controller(path, made, "pendubot", {"seed": 7})
    same(load_controller(path, robot="pendubot"), made)
    with np.load(path, allow_pickle=False) as arrays:
        assert json.loads(str(arrays["header"]))["provenance"] == {"seed": 7}
    # In the precision of the one who loads it.
    with jax.enable_x64(True):
        leaves = jax.tree.leaves(load_controller(path))
        assert {str(leaf.dtype) for leaf in leaves} == {"float64"}


def test_policies_are_policy_files(tmp_path):
    path, policy = tmp_path / "policy.npz", load_policy("acrobot")
    save_controller(path, policy, "acrobot")
    same(load_policy(path), policy)
    same(load_controller("acrobot"), policy)
    plant = designs.competition("acrobot")
    hybrid = with_lqr(network_in(policy), plant, "acrobot")
    for save in (
        lambda: save_controller(path, hybrid, "acrobot"),
        lambda: save_policy(path, hybrid),
    ):
        path.unlink()
        save()
        same(load_policy(path, robot="acrobot"), hybrid)
    same(network_in(load_policy(path)), network_in(policy))
    with pytest.raises(JaxpendError, match="holds 0 neural networks; one is needed"):
        network_in(lqr(plant, "acrobot"), path)
    with refused("no LQR: joint 2 of this plant has no motor, as the acrobot has"):
        lqr(PLANT, "acrobot")


def test_a_users_own_class_must_be_given(tmp_path):
    path = tmp_path / "own.npz"
    save_controller(path, OWN, "pendubot")
    with pytest.raises(JaxpendError, match=r"unknown class of a controller 'Own'; known: .*TVLQR"):
        load_controller(path)
    assert Own in classes_of(OWN)
    same(load_controller(path, classes=classes_of(OWN)), OWN)


def test_what_a_file_cannot_hold_is_said(tmp_path):
    with pytest.raises(JaxpendError, match=r"law is <.*; a file can hold arrays, numbers and text"):
        save_controller(tmp_path / "file.npz", Feedback(lambda t, x: x[:2]), "pendubot")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a, h: h.update(format=99), "has policy format 99"),
        (lambda a, h: h.update(robot="cartpole"), "unknown robot 'cartpole'"),
        (lambda a, h: h.update(robot="acrobot"), "for the acrobot, not for the pendubot"),
        (lambda a, h: h["controller"].update({"class": "Popen"}), "unknown class"),
        (lambda a, h: h["controller"].update({"class": "Plant"}), "not hold a whole controller"),
        (lambda a, h: h["controller"]["fields"].pop("goal"), "not hold a whole controller"),
        (lambda a, h: h.update(controller=3), "int is no controller; a controller is a"),
        (lambda a, h: a.pop("gain"), "does not hold a whole controller: 'gain'"),
        (lambda a, h: a.update(gain=a["gain"][:, :3]), "LQR cannot be called: TypeError"),
        (lambda a, h: a.update(gain=a["gain"] * np.nan), "holds a number that is NaN"),
        (lambda a, h: a.update(gain=a["gain"][:1], torque_limit=a["torque_limit"][:1]), "(2,)"),
    ],
)
def test_damaged_contents_are_one_sentence(tmp_path, change, words):
    path = tmp_path / "file.npz"
    save_controller(path, lqr(PLANT, "pendubot"), "pendubot")
    rewrite(path, change)
    with refused(words):
        load_controller(path, robot="pendubot")


def test_commands_judge_a_controller_file(tmp_path, capsys):
    path = tmp_path / "hybrid.npz"
    layers = ((jnp.zeros((6, 3)), jnp.zeros(3)), (jnp.zeros((3, 1)), jnp.zeros(1)))
    hybrid = with_lqr(Policy(layers, jnp.asarray(3.0)), PLANT, "pendubot")
    save_controller(path, hybrid, "pendubot", {"seed": 1})
    commands.score("pendubot", str(path), json="-")
    result = json.loads(capsys.readouterr().out)
    assert result["criteria"] == official(hybrid, "pendubot")["criteria"]
    assert result["header"]["provenance"] == {"seed": 1}
    same(find_controller(path, None, TASK), hybrid)
    title, make = leaderboard.chosen("lqr", path, None, task_of("pendubot"))["own"]
    assert title == "hybrid"
    same(make(PLANT), hybrid)


def test_a_name_and_a_file_together(tmp_path):
    """A known controller around the file's policy; or the file of one's own classes."""
    path = tmp_path / "policy.npz"
    layers = ((jnp.ones((6, 3)), jnp.zeros(3)), (jnp.ones((3, 1)), jnp.zeros(1)))
    policy = Policy(layers, jnp.asarray(3.0, jnp.float32))
    save_controller(path, policy, "pendubot")
    same(find_controller(None, None, TASK), load_policy("pendubot"))
    same(find_controller(None, "pd", TASK), build("pd", PLANT, "pendubot"))
    found = find_controller(path, "policy_lqr", TASK)
    same(found, with_lqr(network_in(policy), PLANT, "pendubot"))
    with pytest.raises(JaxpendError, match=r"pd is not built around a policy; leave out .*policy"):
        find_controller(path, "pd", TASK)
    with pytest.raises(JaxpendError, match=r"unknown controller 'foo'; known: policy, .*tvlqr"):
        find_controller(None, "foo", TASK)
    save_controller(path, OWN, "pendubot")
    name = f"{__name__}:OWN"
    same(find_controller(path, name, TASK), OWN)
    assert find_controller(None, name, TASK) is OWN


def test_every_command_that_judges_takes_a_file_of_own_classes(tmp_path, capsys):
    path, name = tmp_path / "own.npz", f"{__name__}:OWN"
    save_controller(path, OWN, "pendubot")
    commands.score("pendubot", str(path), name, json="-")
    result = json.loads(capsys.readouterr().out)
    assert result["criteria"] == official(OWN, "pendubot")["criteria"]
    assert (result["policy"], result["controller"]) == (str(path), name)
    title, make = leaderboard.chosen("lqr", str(path), name, TASK)["own"]
    assert title == f"{name} own"
    same(make(PLANT), OWN)
    (run,) = find(path)
    judged = judge(run, v2("pendubot"), robustness=False, controller=name)
    assert judged.score == pytest.approx(result["score"], abs=1e-9)
    assert judged.criteria == pytest.approx(result["criteria"], rel=1e-6)
    with refused("unknown class of a controller 'Own'", start=str(path)):
        judge(run, v2("pendubot"), robustness=False)


def test_a_module_that_ends_the_program_is_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "module_that_exits.py").write_text("import sys\n\nsys.exit(3)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    with refused("SystemExit: 3 at ", start="cannot load module_that_exits:law as module:name"):
        find_controller(None, "module_that_exits:law", TASK)


def test_a_reference_alone_is_no_controller(tmp_path):
    reference = Reference(jnp.zeros((3, 4)), jnp.zeros(2), jnp.zeros((2, 5)))
    with pytest.raises(JaxpendError, match="Reference is no controller; a controller is a"):
        save_controller(tmp_path / "file.npz", reference, "pendubot")
    assert not list(tmp_path.iterdir())


def test_files_of_earlier_versions_still_load(tmp_path):
    path, made = tmp_path / "file.npz", build("tvlqr", PLANT, "pendubot")
    save_controller(path, made, "pendubot")

    def former(arrays, header):
        text = json.dumps(header).replace('"Reference"', '"Nominal"')
        text = text.replace('"reference"', '"nominal"').replace("reference.", "nominal.")
        header.clear()
        header.update(json.loads(text))
        for name in [name for name in arrays if name.startswith("reference.")]:
            arrays["nominal." + name.partition(".")[2]] = arrays.pop(name)

    rewrite(path, former)
    same(load_controller(path, robot="pendubot"), made)


def test_numbers_of_numpy_in_a_static_field_are_numbers(tmp_path):
    policy = load_policy("demonstrated_pendubot")
    odd = network_in(policy).replace(control_dt=np.float64(0.01))
    save_controller(tmp_path / "odd.npz", odd, "pendubot")
    assert load_policy(tmp_path / "odd.npz").control_dt == 0.01


def test_what_is_no_path_is_one_sentence(tmp_path):
    for value in (None, 5):
        with refused(f"{value} is no path, and no name of what ships"):
            load_policy(value)
    with refused("cannot write policy.npz: what it should say of itself: Object of type set"):
        save_policy("policy.npz", load_policy("pendubot"), {"seed": {1, 2}})
    with pytest.raises(IsADirectoryError) as error:
        save_policy(tmp_path, load_policy("pendubot"))
    assert error.value.filename == str(tmp_path)


def test_a_link_stays_one_and_its_file_is_written(tmp_path):
    (tmp_path / "link.npz").symlink_to("real.npz")
    save_policy(tmp_path / "link.npz", load_policy("pendubot"))
    assert (tmp_path / "link.npz").is_symlink()
    assert (tmp_path / "real.npz").is_file()
