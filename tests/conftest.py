"""What all tests share: precision, tolerances, and the excerpts of the reference's numbers.

Import from here: ``from conftest import assert_close``.
"""

import contextlib
import json
import os
import resource
from functools import cache
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest

from jaxpend import JaxpendError
from jaxpend.boards import v2
from jaxpend.plant import Plant
from jaxpend.task import Task

hypothesis.settings.register_profile("jaxpend", deadline=None, max_examples=40, derandomize=True)
hypothesis.settings.load_profile("jaxpend")

# The one tolerance table: relative, and absolute in SI units, by the type of the result.
TOLERANCE = {"float32": 2e-5, "float64": 1e-9}

# For a test in both precisions; inside, jax's default float type is ``dtype``.
both_precisions = pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.x64)]
)
both_robots = pytest.mark.parametrize("robot", ["acrobot", "pendubot"])


# Most of the suite's time is compilation. XLA's older emitters without LLVM's optimisations take a
# third of it, and what they compile runs half as fast. All cores are busy, so that splitting a
# program for several threads would only cost.
XLA = (
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 "
    "--xla_cpu_parallel_codegen_split_count=1"
)
# These files take longest, and a file is one worker's: begun first, none of them is waited for.
LONG = (
    "test_train", "test_report", "test_gradient", "test_sac", "test_guard", "test_snes",
    "test_controller", "test_controllers", "test_demonstrations", "test_resume", "test_robustness",
    "test_tutorial", "test_env", "test_cli", "test_export", "test_ilqr", "test_stages",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    order = {name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.stem, len(LONG)))


def pytest_configure(config):
    os.environ["JAXPEND_CACHE"] = "off"  # every test compiles what it tests
    # Dozens of processes begin here, and without it each of them takes 2 s more to import.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["XLA_FLAGS"] = f"{XLA} {os.environ.get('XLA_FLAGS', '')}"
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


@contextlib.contextmanager
def refused(words: str, start: str = ""):
    """Inside, something raises a ``JaxpendError``: one sentence with these words."""
    with pytest.raises(JaxpendError) as error:
        yield
    said = str(error.value)
    assert words in said
    assert said.startswith(start)
    assert "\n" not in said


def rewrite(path: Path, change):
    """Let ``change`` have its way with the arrays and the header of a file of a controller."""
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    change(arrays, header)
    np.savez(path, **arrays | {"header": np.array(json.dumps(header))})


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


def task_of(robot: str) -> Task:
    """The task of the v2 board."""
    return v2(robot).task


def shipped_network(bias: float = 0.0):
    """The pendubot's demonstrated network, which sees one state, with more in its last bias."""
    from jaxpend import load_policy
    from jaxpend.controllers.policy import network_in

    policy = network_in(load_policy("demonstrated_pendubot"))
    *hidden, (kernel, last) = policy.layers
    return policy.replace(layers=(*hidden, (kernel, last + bias)))


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
