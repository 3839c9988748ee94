"""Controllers step by step from Python: the torques are those of a rollout."""

from inspect import signature

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused, shipped_network, task_of

from jaxpend import Policy, load_policy, rollout
from jaxpend.controllers.callback import PythonLaw
from jaxpend.controllers.catalogue import build
from jaxpend.controllers.files import CLASSES
from jaxpend.observation import Observation
from jaxpend.pytree import pytree
from jaxpend.stepping import Startable, Stepper

DT = 0.002


def test_the_steps_are_those_of_a_rollout():
    policy, plant = load_policy("pendubot"), task_of("pendubot").plant
    run = jax.jit(lambda policy, key: rollout(plant, policy, key, duration=0.2))(
        policy, jax.random.key(0)
    )
    stepper = policy.start()
    torques = [stepper.torque(x) for x in np.asarray(run.x_measured)]
    np.testing.assert_allclose(torques, run.u_command, rtol=1e-3, atol=1e-3)
    stepper.reset()
    told = [stepper(t, x) for t, x in zip(run.t, run.x_measured, strict=False)]
    np.testing.assert_allclose(told, torques, rtol=1e-4, atol=1e-4)
    # The memory makes a difference: without it the observer believes what is measured.
    off = run.x_measured[50] + np.array([0, 0, 1, 0])
    assert abs(policy.torque(off) - torques[50]).max() > 0.05


def test_every_controller_of_the_package_can_be_started():
    takes_a_key = [
        kind for kind in CLASSES if "key" in signature(getattr(kind, "reset", len)).parameters
    ]
    assert {"Policy", "Guarded", "MPC", "Hybrid", "Riccati"} < {
        kind.__name__ for kind in takes_a_key
    }
    assert all(issubclass(kind, Startable) for kind in takes_a_key)


@pytest.mark.parametrize("name", ["policy_network", "pd", "open_loop"])
def test_first_torques(name):
    controller, x = build(name, task_of("pendubot").plant, "pendubot"), [0.1, -0.2, 0.3, 0.4]
    expected = controller(controller.reset(jax.random.key(0)), jnp.zeros(()), jnp.array(x))[1]
    stepper = controller.start()
    first = stepper.torque(x)
    assert (type(first), first.shape) == (np.ndarray, (2,))
    np.testing.assert_allclose(first, expected, atol=1e-4)
    np.testing.assert_allclose(controller.torque(x), expected, atol=1e-4)
    first += 1.0  # an array of its own, that can be written to
    assert stepper.t == DT


@pytest.mark.x64
def test_nothing_is_compiled_twice(monkeypatch):
    observation = Observation(history=2)
    network = shipped_network()
    kernel, bias = network.layers[0]
    kernel = jnp.zeros((observation.size, kernel.shape[1]), kernel.dtype)
    policy = network.replace(layers=((kernel, bias), *network.layers[1:]), observation=observation)
    policy = policy.replace(action_noise=jnp.array(0.1))
    controller = load_policy("pendubot").replace(main=policy)
    traced, look = [], Policy.pre_action
    monkeypatch.setattr(Policy, "pre_action", lambda *args: traced.append(1) or look(*args))
    stepper = controller.start()
    x = np.full(4, 0.1)
    for number in (x, x.astype("f4"), [0, 0, 0, 1], tuple(x), jnp.asarray(x)):
        assert stepper.torque(number).dtype == "float64"
    for time in (1, 0.5, np.float64(2), np.float32(2), jnp.array(3.0)):
        stepper(time, x)
    # Of another seed and other weights, and with the other precision around the call.
    again = controller.replace(main=policy.replace(torque_limit=jnp.array(3.0))).start(seed=1)
    with jax.enable_x64(False):
        assert again.torque(x).dtype == "float64"
    assert len(traced) == 1


def test_a_seed_says_what_is_drawn():
    noisy = shipped_network().replace(action_noise=jnp.array(0.5))
    x = [0.3, 0, 0, 0]
    same = [noisy.start(seed=seed).torque(x)[0] for seed in (1, 1, 2)]
    assert same[0] == same[1] != same[2]


@pytree
class Own:
    """Counts the calls; derives from nothing."""

    scale: float = 2.0

    def reset(self, key):
        return 0

    def __call__(self, calls, t, x):
        return calls + 1, jnp.array([self.scale, 0.0]) * calls


def test_controllers_of_others_can_be_stepped():
    stepper = Stepper(Own(), dt=0.5)
    assert [float(stepper.torque(np.zeros(4))[0]) for _ in range(3)] == [0, 2, 4]
    assert stepper.t == 1.5
    stepper.reset()
    assert stepper.torque(np.zeros(4))[0] == stepper.t - 0.5 == 0
    law = PythonLaw(lambda t, x: [t, x[1]])
    np.testing.assert_allclose(law.torque([0, 1, 2, 3], 4), [4, 1])


@pytest.mark.parametrize(
    ("x", "words"),
    [
        ([0, 0, 0], "x has shape (3,); it must be (4,)"),
        (np.zeros((5, 4)), "x has shape (5, 4); it must be (4,)"),
        ([[0], [0, 1]], "x is a list; it must be numbers of shape (4,)"),
        ("upright", "x is a str; it must be numbers of shape (4,)"),
        (None, "x has shape (); it must be (4,)"),
        ([0, 0, 0, np.nan], "x is [ 0.  0.  0. nan]; its numbers must be finite"),
    ],
)
def test_what_is_no_state_is_refused(x, words):
    law = PythonLaw(lambda t, x: [0, 0])
    with refused(words):
        law.torque(x)
    with refused(words):
        law.start()(0, x)


def test_what_is_no_time_is_refused():
    law = PythonLaw(lambda t, x: [0, 0])
    with refused("t has shape (1,); it must be ()"):
        law.start()([0], np.zeros(4))
    with refused("t is nan; its numbers must be finite"):
        law.torque(np.zeros(4), np.nan)
    for dt in (0, -1, np.inf, np.nan):
        with refused(f"dt is {float(dt)}; it must be "):
            law.start(dt=dt)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (lambda: Stepper(3), "3 is no controller; a controller has reset(key)"),
        (lambda: Stepper(Policy), "is no controller"),
        (lambda: shipped_network().start(dt="a"), "dt is 'a'; it must be a number"),
        (lambda: shipped_network().start(dt=1j), "dt is 1j; it must be a number"),
        (lambda: shipped_network().start(seed=1.5), "seed is 1.5; it must be an integer"),
        (
            lambda: shipped_network().start(seed=2**70),
            "seed is 1180591620717411303424; it must be ",
        ),
        (
            lambda: shipped_network().torque(np.full(4, 1j)),
            "x is a ndarray; it must be numbers of shape (4,)",
        ),
        (lambda: shipped_network().torque(np.full(4, 1e300)), "its numbers must be finite"),
    ],
)
def test_what_cannot_be_started_or_called_is_refused(start, words):
    with refused(words):
        start()
