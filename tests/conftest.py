"""What all tests share: precision, tolerances, and the excerpts of the reference's numbers.

Import from here: ``from conftest import assert_close``.
"""

import contextlib
import os
import resource
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import jax
import numpy as np
import pytest

from jaxpend.plant import Plant

hypothesis.settings.register_profile("jaxpend", deadline=None, max_examples=40, derandomize=True)
hypothesis.settings.load_profile("jaxpend")

# The one tolerance table: relative, and absolute in SI units, by the type of the result.
TOLERANCE = {"float32": 2e-5, "float64": 1e-9}

# For a test in both precisions; inside, jax's default float type is ``dtype``.
both_precisions = pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.x64)]
)
both_robots = pytest.mark.parametrize("robot", ["acrobot", "pendubot"])


def pytest_configure(config):
    os.environ["JAXPEND_CACHE"] = "off"  # every test compiles what it tests
    config.addinivalue_line("markers", "x64: run with 64-bit types enabled in jax")


@pytest.fixture(autouse=True)
def _x64(request):
    if request.node.get_closest_marker("x64") is None:
        yield
    else:
        with jax.enable_x64(True):
            yield


def assert_close(actual, expected, *, times: float = 1.0, what: str = ""):
    """Equal to within ``times`` the tolerance of the computed type, which must be as expected."""
    actual = np.asarray(actual)
    tolerance = times * TOLERANCE[str(actual.dtype)]
    np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance, err_msg=what)


@cache
def excerpt(name: str) -> dict[str, np.ndarray]:
    """An excerpt of the reference simulator's numbers (``data/make_excerpts.py`` cut it)."""
    with np.load(Path(__file__).parent / "data" / f"{name}.npz") as arrays:
        return dict(arrays)


@contextlib.contextmanager
def limited_file_size(size: int):
    """Inside, no file can grow beyond so many bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory):
    """The folder of a training run that was never interrupted, and what it said on its errors."""
    from training_runs import training

    with training(tmp_path_factory.mktemp("training") / "whole") as process:
        out, err = process.communicate()
    assert (process.returncode, out) == (0, ""), err
    return Path(process.args[process.args.index("--runs") + 1]) / "run", err


@pytest.fixture(scope="session")
def imitation():
    """A policy that imitates the pendubot's swing-up, and the imitation that made it."""
    from jaxpend.demonstrations import DemonstrationConfig, imitate, imitation, swingups
    from jaxpend.env import DoublePendulum, EnvConfig
    from jaxpend.networks import Actor, to_policy

    config = DemonstrationConfig(episodes=150, updates=8000, batch_size=512)
    env = DoublePendulum(EnvConfig("pendubot"))
    actor = Actor((64, 64), "tanh", env.seen_size)
    keys = jax.random.split(jax.random.key(0), 3)
    rows, wanted = swingups(config, env, keys[0], reward_scale=0.1)
    untrained = actor.init(keys[1], jax.numpy.zeros(env.observation_size))
    state = imitation(config, untrained, keys[2])
    obs = rows[:, : env.observation_size]
    for _ in range(4):
        state, loss = imitate(config, actor, state, obs, wanted, 2000)
    params, error = state.params, loss[-100:].mean()
    return SimpleNamespace(
        env=env, actor=actor, obs=obs, wanted=wanted, untrained=untrained, params=params,
        error=error, policy=to_policy(params, actor, env.config),
    )  # fmt: skip


def plant_from(parameters, torque_limit, actuation) -> Plant:
    """A plant from vectors in the excerpts' order; leading axes are a batch.

    ``m1 m2 l1 l2 r1 r2 I1 I2 b1 b2 cf1 cf2 g Ir gr`` (..., 15 or more), N m (..., 2), and the
    input matrix (..., 2, 2).
    """
    p = np.asarray(parameters)
    pairs = ("mass", "length", "com", "inertia", "damping", "coulomb_friction")
    values = {name: p[..., 2 * i : 2 * i + 2] for i, name in enumerate(pairs)}
    values |= {"gravity": p[..., 12], "motor_inertia": p[..., 13], "gear_ratio": p[..., 14]}
    values["torque_limit"] = torque_limit
    values["actuation"] = np.diagonal(np.asarray(actuation, float), axis1=-2, axis2=-1)
    dtype = jax.numpy.result_type(float)
    return Plant(**{name: jax.numpy.asarray(value, dtype) for name, value in values.items()})
