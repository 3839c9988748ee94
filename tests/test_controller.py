"""The controller protocol: what is no controller is refused in one sentence, at every door."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused, task_of

from jaxpend import Scenario, designs, final_state, gradient, rollout, snes
from jaxpend.config import GradientConfig, SNESConfig
from jaxpend.controller import Feedback, Memoryless, OpenLoop, Zero, check_controller, robot_of
from jaxpend.controllers import guard, load_policy, save_controller
from jaxpend.controllers.callback import PythonLaw
from jaxpend.controllers.catalogue import CATALOGUE, build
from jaxpend.controllers.hybrid import with_lqr
from jaxpend.pytree import pytree, static
from jaxpend.robustness import Strip, benchmark
from jaxpend.score import official
from jaxpend.sweep import mildest_failure, survey, sweep
from jaxpend.variations import vary

KEY = jax.random.key(0)
TASK = task_of("pendubot")
PLANT = designs.competition("pendubot")
BRIEF = {"duration": 0.02}


DOORS = {
    "rollout": lambda c, path: rollout(PLANT, c, KEY, **BRIEF),
    "final state": lambda c, path: final_state(PLANT, c, KEY, **BRIEF),
    "sweep": lambda c, path: sweep(vary(Scenario(PLANT), {"m2": [0.6]}, key=KEY), c, KEY, **BRIEF),
    "survey": lambda c, path: survey(PLANT, c, {"m2": [0.6]}, KEY, **BRIEF),
    "worst": lambda c, path: mildest_failure(PLANT, c, {"m2": (0.6, 1)}, KEY, samples=2, **BRIEF),
    "benchmark": lambda c, path: benchmark(
        c, PLANT, KEY, grids=[Strip("model", "m2", np.array([0.6]))], **BRIEF
    ),
    "file": lambda c, path: save_controller(path / "file.npz", c, "pendubot"),
    "guard": lambda c, path: guard(c, "pendubot"),
    "hybrid": lambda c, path: with_lqr(c, PLANT, "pendubot"),
}
REFUSING = DOORS | {
    "official": lambda c, path: official(c, "pendubot"),
    "snes": lambda c, path: snes.init(SNESConfig(searched="gain"), c, KEY),
    "gradient": lambda c, path: gradient.init(GradientConfig(searched="gain"), c, KEY),
}


@pytest.mark.parametrize("name", [name for name in CATALOGUE if not name.startswith("mpc")])
def test_every_controller_of_the_catalogue_passes_every_door(name, tmp_path):
    controller = build(name, PLANT, "pendubot")
    for door in DOORS.values():
        door(controller, tmp_path)


class NoPytree:
    """It has all that a controller has, but jax cannot see into it."""

    gain = jnp.ones(2)

    def reset(self, key):
        return None

    def __call__(self, carry, t, x):
        return carry, self.gain


@pytree
class Strange(Memoryless):
    """What it returns is up to whoever makes it."""

    gain: jax.Array
    returns: object = static(default=lambda self, carry, x: (carry, self.gain))

    def __call__(self, carry, t, x):
        return self.returns(self, carry, x)


ONES = jnp.ones(2)


def failing(self, carry, x):
    raise KeyError("elbow")


BAD = {
    "not a pytree": (NoPytree(), "NoPytree is not a pytree"),
    "a class": (Strange, "Strange is a class, not an instance of it"),
    "a function": (lambda t, x: ONES, "function is no controller; a controller is a"),
    "nothing": (None, "NoneType is no controller"),
    "torque of three": (Strange(jnp.ones(3)), "returns a torque of shape (3,); it must be (2,)"),
    "a number": (Strange(jnp.ones(())), "returns a torque of shape (); it must be (2,)"),
}
# ``rollout`` is called in traces of all kinds, and looks at the form alone.
BAD_ELSEWHERE = {
    "nan": (Strange(ONES * jnp.nan), "Strange holds a number that is NaN"),
    "only a torque": (Strange(ONES, lambda self, c, x: self.gain), "not (carry, torque)"),
    "another memory": (Strange(ONES, lambda s, c, x: (x, s.gain)), "a memory of another form"),
    "raises": (Strange(ONES, failing), "Strange cannot be called: KeyError: 'elbow' at"),
    "unhashable": (
        Strange(ONES, [failing]),
        "a list in its static field returns; what is static is hashable",
    ),
}


@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("door", REFUSING)
def test_what_is_no_controller_is_refused_at_every_door(door, kind, tmp_path):
    controller, words = BAD[kind]
    with refused(words):
        REFUSING[door](controller, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", BAD_ELSEWHERE)
@pytest.mark.parametrize(
    "door", [name for name in REFUSING if name not in DOORS or name == "sweep"]
)
def test_what_does_not_work_is_refused_where_it_is_judged_and_trained(door, kind, tmp_path):
    controller, words = BAD_ELSEWHERE[kind]
    with refused(words):
        REFUSING[door](controller, tmp_path)


def test_an_error_of_their_own_code_is_said_with_its_place():
    with refused(f"at {__file__}:{failing.__code__.co_firstlineno + 1}"):
        check_controller(Strange(ONES, failing))


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (lambda t, x: [1.0], "returns a torque of shape (1,); it must be (2,)"),
        (lambda t, x: [np.nan, 0.0], "a torque that is not finite"),
        (lambda t: [0.0, 0.0], "cannot be called: TypeError"),
        (lambda t, x: {}[t], "cannot be called: KeyError: 0.0 at"),
        (3, "3 is no function of (t, x)"),
    ],
)
def test_a_python_law_is_tried_before_it_is_judged(law, words):
    with refused(words):
        official(PythonLaw(law), "pendubot")


def test_controllers_know_their_robot_or_say_nothing():
    assert robot_of(load_policy("acrobot")) == "acrobot"
    assert robot_of(build("tvlqr", PLANT, "pendubot")) == "pendubot"
    assert robot_of(build("lqr", PLANT, "pendubot")) is None
    other = load_policy("acrobot")
    for door in (
        lambda: official(other, "pendubot"),
        lambda: benchmark(other, "pendubot", KEY),
        lambda: guard(other, "pendubot"),
    ):
        with refused("this controller is for the acrobot, not for the pendubot"):
            door()


def test_trivial_controllers():
    t, u = jnp.array([0.0, 0.01]), jnp.array([[1.0, 0.0], [2.0, 0.0]])
    run = rollout(PLANT, OpenLoop(t, u), KEY, duration=0.03)
    np.testing.assert_array_equal(run.u_command[:5, 0], 1.0)
    np.testing.assert_array_equal(run.u_command[6:, 0], 2.0)
    check_controller(OpenLoop(t, u))
    with refused("the time stamps of these torques go back; they must rise"):
        check_controller(OpenLoop(t[::-1], u))
    with refused("t and u have shapes (2,) and (1, 2); not (N,), (N, 2)"):
        check_controller(OpenLoop(t, u[:1]))
    for controller in (Zero(), Feedback(lambda t, x: x[:2] * 0)):
        assert not np.any(rollout(PLANT, controller, KEY, duration=0.03).u)
    assert dataclasses.is_dataclass(Zero)


@pytree
class Widening(Strange):
    """Its memory is of 16 bits at first."""

    def reset(self, key):
        return jnp.zeros(2, jnp.float16)


def test_a_memory_of_another_type_is_refused():
    with refused("a memory of another form"):
        check_controller(Widening(ONES, lambda self, carry, x: (carry + x[:2], self.gain)))
