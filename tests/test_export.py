"""Exported controllers: the torques are those of the controller itself."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import task_of

from jaxpend import load_policy, rollout
from jaxpend.controllers.guard import guard
from jaxpend.controllers.policy import Policy
from jaxpend.interop import numpy as to_numpy
from jaxpend.observation import Observation
from jaxpend.scenario import Scenario

STARTS = np.array([[0, 0, 0, 0], [2.0, -1.0, 3.0, -4.0], [-1.0, 2.5, -2.0, 5.0]])
NAMES = ("plain", "history", "shipped", "guarded history")


def policy(history):
    """A network with random weights, and where it sees the past one of its own memory."""
    observation = Observation(history=history)
    draw = np.random.default_rng(history)
    sizes = (observation.size, 24, 1)
    normal = [(draw.normal(size=n), draw.normal(size=n[1])) for n in itertools.pairwise(sizes)]
    layers = tuple((jnp.asarray(w / len(w) ** 0.5), jnp.asarray(b)) for w, b in normal)
    return Policy(layers, jnp.asarray(3.0), observation=observation)


@functools.cache
def controller(name, precision):
    """One of ``NAMES``, with arrays of that precision."""
    with jax.enable_x64(precision == "float64"):
        if name == "shipped":
            return load_policy("pendubot")
        found = policy(3 if "history" in name else 0)
        return guard(found, "pendubot") if "guarded" in name else found


@functools.cache
def recorded(name, precision):
    """Closed loops of 10 s from ``STARTS``: times (N,), measured states and torques."""
    with jax.enable_x64(precision == "float64"):
        scenarios = [Scenario(task_of("pendubot").plant, x0=jnp.asarray(x)) for x in STARTS]
        batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenarios)
        run = jax.jit(jax.vmap(rollout, (0, None, None)))(
            batch, controller(name, precision), jax.random.key(0)
        )
        return np.asarray(run.t[0, :-1]), np.asarray(run.x_measured), np.asarray(run.u_command)


@functools.cache
def in_numpy(name):
    """An object of the exported class."""
    names: dict = {}
    exec(to_numpy.source(controller(name, "float64")), names)
    return names["Controller"]()


def replayed(exported, times, states):
    """Torques of an exported controller for the measurements of one run."""
    exported.reset()
    return np.array([exported.torque(t, x) for t, x in zip(times, states, strict=True)])


@pytest.mark.parametrize("name", NAMES)
def test_numpy_gives_the_same_torques_on_the_same_measurements(name):
    times, states, torques = recorded(name, "float64")
    assert states.shape[0] * states.shape[1] >= 10_000
    for x, u in zip(states, torques, strict=True):
        assert np.ptp(u[:, 0]) > 0.5
        np.testing.assert_allclose(replayed(in_numpy(name), times, x), u, rtol=0, atol=1e-10)
