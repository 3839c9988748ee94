"""What is searched of a controller: which leaves, and in which coordinates."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, refused

from jaxpend import Policy, designs
from jaxpend.controllers import TVLQR, Reference, energy_shaping, lqr, pd, riccati
from jaxpend.controllers.hybrid import with_lqr
from jaxpend.controllers.search_space import FACTOR, KNOTS, OVER_TIME, WEIGHT, coordinates, kinds
from jaxpend.pytree import pytree, static

PLANT = designs.competition("acrobot")
POLICY = Policy(
    layers=((jnp.ones((6, 3)), jnp.zeros(3)), (jnp.ones((3, 1)), jnp.zeros(1))),
    torque_limit=jnp.asarray(3.0),
    robot="acrobot",
)
STEPS = 61
SWINGUP = Reference(
    jnp.ones((STEPS + 1, 4)), jnp.ones(STEPS), jnp.ones((STEPS, 5)), robot="acrobot"
)

HYBRID = with_lqr(POLICY, PLANT, "acrobot")


@pytree
class Own:
    """A user's own controller."""

    stiffness: jax.Array
    centre: jax.Array
    wheels: int = static(default=4)


def paths(prefix, *layers):
    """Key paths of a policy's layers."""
    return {f"{prefix}layers.{i}.{j}": WEIGHT for i in layers for j in (0, 1)}


SWITCHED = {"top.gain": FACTOR, "region.inner": FACTOR, "region.outer": FACTOR}
TRACKING = TVLQR(SWINGUP, jnp.ones((STEPS, 4)), lqr(PLANT, "acrobot"))


@pytest.mark.parametrize(
    ("controller", "searched", "expected"),
    [
        (POLICY, "all", paths("", 0, 1)),
        (POLICY, "hidden", paths("", 0)),
        (HYBRID, "all", paths("swingup.", 0, 1) | SWITCHED),
        (HYBRID, "weights", paths("swingup.", 0, 1)),
        (HYBRID, "hidden", paths("swingup.", 0) | SWITCHED),
        (HYBRID, "swingup, region.inner", paths("swingup.", 0, 1) | {"region.inner": FACTOR}),
        (HYBRID, "region.goal", {"region.goal": FACTOR}),
        (lqr(PLANT, "acrobot"), "all", {"gain": FACTOR}),
        (TRACKING, "all", {"gain": OVER_TIME, "top.gain": FACTOR}),
        (TRACKING, "top", {"top.gain": FACTOR}),
        (riccati(PLANT, SWINGUP), "all", {"reference.gain": OVER_TIME, "top.gain": FACTOR}),
        (
            energy_shaping(PLANT, "acrobot"),
            "all",
            dict.fromkeys(("kp", "kd", "ke", "cap", "kick"), FACTOR),
        ),
        (pd(PLANT, "acrobot"), "all", {"proportional": FACTOR, "derivative": FACTOR}),
        (Own(jnp.ones(2), jnp.ones(2)), "stiffness", {"stiffness": FACTOR}),
    ],
)
def test_what_is_searched(controller, searched, expected):
    found = kinds(controller, searched)
    assert found == expected
    leaves, _ = jax.tree_util.tree_flatten_with_path(controller)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    assert list(found) == [name for name in names if name in expected]
    vector, weights, rebuild = coordinates(controller, searched)
    assert vector.shape == weights.shape
    jax.tree.map(np.testing.assert_array_equal, rebuild(vector), controller)
    # And every coordinate of what is not zero does something.
    moved = rebuild(vector + 0.1)
    leaves = zip(names, jax.tree.leaves(moved), jax.tree.leaves(controller), strict=True)
    changed = {name for name, a, b in leaves if np.any(a != b)}
    assert changed == set(expected)


def test_weights_are_themselves_and_gains_are_factors():
    vector, weights, rebuild = coordinates(HYBRID)
    assert (weights.sum(), (~weights).sum()) == (25, 10)
    z = jax.random.normal(jax.random.key(0), vector.shape)
    found = rebuild(z)
    assert_close(found.swingup.layers[0][0], z[:18].reshape(6, 3))
    assert_close(found.top.gain, HYBRID.top.gain * np.exp(z[25:33].reshape(2, 4)))
    np.testing.assert_array_equal(found.top.gain[0], 0.0)  # the passive joint's
    assert_close(found.region.outer, HYBRID.region.outer * np.exp(z[34]))
    jitted = jax.jit(lambda start, z: coordinates(start)[-1](z))(HYBRID, z)
    jax.tree.map(lambda a, b: assert_close(a, b), jitted, found)


def test_gains_over_time_have_a_factor_at_each_knot_and_lines_between():
    vector, _, rebuild = coordinates(TRACKING, "gain")
    assert vector.shape == (4 * KNOTS,)
    z = jax.random.normal(jax.random.key(0), (KNOTS, 4))
    factor = np.log(rebuild(z.ravel()).gain)
    # 61 steps and 16 knots: a knot every fourth step.
    assert_close(factor[::4], z, times=10)
    assert_close(factor[1::4], 0.75 * z[:-1] + 0.25 * z[1:], times=10)


def test_a_class_says_what_is_searched_of_it_and_its_parts():
    @pytree
    class Pair:
        SEARCHED: ClassVar = {"second.stiffness": FACTOR}
        first: Own
        second: Own

    own = Own(jnp.ones(2), jnp.ones(2))
    assert kinds(Pair(own, own)) == {"second.stiffness": FACTOR}


@pytest.mark.parametrize(
    ("controller", "searched", "words"),
    [
        (HYBRID, "gain", "the controller has no parameter 'gain'; known: swingup.layers.0.0, "),
        (HYBRID, "top,,region", "the controller has no parameter ''; known: "),
        (Own(jnp.ones(2), jnp.ones(2)), "wheels", "'wheels'; known: stiffness, centre"),
        (
            Own(jnp.ones(2), jnp.ones(2)),
            "all",
            "Own declares no searched parameters; name some of: stiffness, centre",
        ),
        (Own(jnp.ones(2), jnp.arange(2)), "centre", "no parameter 'centre'; known: stiffness"),
    ],
)
def test_what_cannot_be_searched_is_one_sentence(controller, searched, words):
    with refused(words):
        kinds(controller, searched)
