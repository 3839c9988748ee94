"""Controller objects written for RealAIGym are judged like our own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import refused, task_of

from jaxpend import rollout
from jaxpend.controller import check_controller
from jaxpend.controllers.callback import PythonLaw, is_realaigym, realaigym
from jaxpend.controllers.catalogue import find_controller
from jaxpend.errors import JaxpendError
from jaxpend.pytree import pytree
from jaxpend.scenario import Scenario
from jaxpend.sweep import sweep
from jaxpend.variations import vary

TASK = task_of("pendubot")


class Counting:
    """Pushes the more, the more often it was called in this run."""

    def __init__(self):
        self.calls, self.begun = 99, []

    def reset_(self):
        self.begun.append("reset")

    def init_(self):
        self.begun.append("init")
        self.calls = 0

    def get_control_output_(self, x, t=None):
        assert self.begun == ["reset", "init"]
        assert isinstance(t, float)
        assert x.dtype == float
        self.calls += 1
        return [0.01 * self.calls - 0.5 * x[0], 0.0]


class Filtered(Counting):
    """With what the reference's base class puts around the law."""

    def reset(self):
        self.reset_()

    def init(self):
        self.init_()

    def get_control_output(self, x, t=None):
        return 0.5 * np.asarray(self.get_control_output_(x, t))


@pytree
class Ours:
    """The same in jax."""

    share: float = 1.0

    def reset(self, key):
        return 0

    def __call__(self, calls, t, x):
        torque = jnp.array([0.01 * (calls + 1.0) - 0.5 * x[0], 0.0])
        return calls + 1, self.share * torque


ONE = Counting()


@pytest.mark.x64
@pytest.mark.parametrize(("theirs", "share"), [(ONE, 1.0), (Filtered(), 0.5)])
def test_every_run_has_a_memory_of_its_own(theirs, share):
    law, ours = realaigym(theirs), Ours(share)
    check_controller(law)
    masses = {"m2": np.array([0.5, 0.6, 0.7])}
    batch = vary(Scenario(TASK.plant), masses, key=jax.random.key(0))
    # Of five rollouts, and of one after it: a run begins anew.
    ends = [sweep(batch, c, jax.random.key(0), duration=0.1, chunk=2).x for c in (law, ours)]
    np.testing.assert_allclose(*ends, rtol=1e-9, atol=1e-12)
    runs = [rollout(TASK.plant, c, jax.random.key(0), duration=0.1) for c in (law, law, ours)]
    np.testing.assert_allclose(runs[0].u, runs[2].u, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(runs[0].u, runs[1].u)
    assert (theirs.calls, theirs.begun) == (99, [])  # it is not touched itself


def test_what_is_one_of_theirs():
    assert is_realaigym(ONE)
    assert not is_realaigym(Counting)
    assert not is_realaigym(Ours())
    assert find_controller(None, f"{__name__}:ONE", TASK).batched


class Wrong:
    def get_control_output_(self, x, t=None):
        return self.give(x)


def wrong(give):
    one = Wrong()
    one.give = give
    return one


@pytest.mark.parametrize(
    ("give", "words"),
    [
        (lambda x: [0.0], "Wrong returns a torque of shape (1,); it must be (2,)"),
        (lambda x: ["a", 0], "Wrong cannot be called: ValueError: could not convert string to fl"),
        (lambda x: [np.nan, 0], "Wrong gives a torque that is not finite, hanging at rest"),
        (lambda x: 1 / 0, "Wrong cannot be called: ZeroDivisionError: division by zero at "),
        (None, "Wrong cannot be called: TypeError: 'NoneType' object is not callable"),
    ],
)
def test_objects_that_do_not_work_are_refused(give, words):
    with refused(words):
        check_controller(realaigym(wrong(give)))


class Uncopied(Wrong):
    def __deepcopy__(self, memo):
        raise TypeError("cannot pickle 'socket' object")


def test_an_object_that_cannot_be_copied_is_refused():
    with refused("Uncopied cannot be copied, and every run needs its own: TypeError: cannot pi"):
        check_controller(realaigym(Uncopied()))


@pytest.mark.parametrize("batched", [False, True])
def test_a_torque_that_is_complex_or_too_large_is_refused_without_a_warning(batched):
    shape = (1, 2) if batched else 2
    with pytest.raises(JaxpendError, match="complex; it must be real"):
        PythonLaw(lambda t, x: np.full(shape, 1j), batched=batched).check()
    with pytest.raises(JaxpendError, match="not finite"):
        PythonLaw(lambda t, x: np.full(shape, 1e300), batched=batched).check()
