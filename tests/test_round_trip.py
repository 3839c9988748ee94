"""A model of Stable-Baselines3 becomes a policy file, and leaves again through every door."""

import ctypes
import itertools
import subprocess
import sys

import jax
import numpy as np
import pytest
import sb3_files

from jaxpend import load_policy
from jaxpend.boards import HEADINGS
from jaxpend.cli.commands import import_
from jaxpend.interop import c as to_c
from jaxpend.interop import numpy as to_numpy
from jaxpend.interop import onnx as to_onnx
from jaxpend.interop.realaigym import check_target, submission

STATES = np.random.default_rng(2).normal(size=(40, 4)) * [3, 3, 20, 20]
JUDGED = {"success": False, "score": 0.0, "criteria": dict.fromkeys(HEADINGS, 0.0)}


@pytest.fixture(scope="module")
def layers():
    """Kernels and biases of a small network."""
    rng = np.random.default_rng(0)
    return [
        (rng.normal(size=(a, b)).astype("f4") / 2, rng.normal(size=b).astype("f4") / 2)
        for a, b in itertools.pairwise((4, 16, 16, 1))
    ]


@pytest.fixture(scope="module")
def wanted(layers):
    """Torques (40,) of joint 1 by the formulas of the authors of Evolutionary SAC, in numpy."""
    angles = (STATES[:, :2] % (2 * np.pi) - np.pi) / np.pi
    h = np.concatenate([angles, np.clip(STATES[:, 2:], -50, 50) / 50], axis=1)
    for kernel, bias in layers[:-1]:
        h = np.maximum(h @ kernel + bias, 0)
    torque = 3 * np.tanh(h @ layers[-1][0] + layers[-1][1])[:, 0]
    assert np.ptp(torque) > 1
    return torque


@pytest.fixture(scope="module")
def policy(layers, tmp_path_factory):
    """What the command makes of the model, in float64."""
    folder = tmp_path_factory.mktemp("model")
    model = sb3_files.model(folder / "model.zip", sb3_files.network(layers, "SAC"))
    import_(model, "pendubot", folder / "policy.npz", "a test", preset="evolsac")
    with jax.enable_x64(True):
        return load_policy(folder / "policy.npz")


def exported(source):
    """An object of the class in a Python source that needs numpy alone."""
    names: dict = {}
    exec(source, names)
    return names["Controller"]()


def test_numpy(policy, wanted):
    controller = exported(to_numpy.source(policy))
    found = np.array([controller.torque(0.0, x) for x in STATES])
    np.testing.assert_allclose(found, np.stack([wanted, 0 * wanted], axis=1), atol=1e-9)


def test_onnx(policy, wanted):
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(
        to_onnx.model(policy, precision="float32").SerializeToString()
    )
    named = {i.name: i for i in session.get_inputs()}
    assert set(named) == {"t", "x"}
    for x, torque in zip(STATES.astype("f4"), wanted, strict=True):
        [found] = session.run(["torque"], {"t": np.zeros((), "f4"), "x": x})
        np.testing.assert_allclose(found, [torque, 0], atol=1e-5)


def test_c(policy, wanted, tmp_path):
    (tmp_path / "policy.h").write_text(to_c.source(policy, prefix="policy"))
    (tmp_path / "main.c").write_text(
        '#include "policy.h"\n'
        "void torque(const float *x, float *u)\n"
        "{ policy_state s; policy_init(&s); policy_step(&s, 0.0f, x, u); }\n"
    )
    flags = "-std=c99 -Wall -Werror -O2 -shared -fPIC main.c -o main.so -lm"
    subprocess.run(["gcc", *flags.split()], cwd=tmp_path, check=True)
    library, floats = ctypes.CDLL(str(tmp_path / "main.so")), ctypes.c_float * 4
    for x, torque in zip(STATES, wanted, strict=True):
        found = floats()
        library.torque(floats(*x), found)
        np.testing.assert_allclose(found[:2], [torque, 0], atol=1e-5)


def test_realaigym(policy, wanted, tmp_path, monkeypatch):
    with jax.enable_x64(True):
        files = submission(policy, "pendubot", check_target(tmp_path / "theirs"), JUDGED, 0.002)
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path / "src/python"))
    monkeypatch.chdir(tmp_path / "leaderboard/pendubot/simulation_v2")
    monkeypatch.syspath_prepend(".")
    code = "import sys, numpy as np; from con_theirs import controller as c; "
    code += "print([float(c.get_control_output_(x, 0.0)[0]) for x in np.load('states.npy')])"
    np.save("states.npy", STATES)
    path = {"PYTHONPATH": f".:{tmp_path / 'src/python'}"}
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, env=path, capture_output=True, text=True
    )
    np.testing.assert_allclose(np.fromstring(done.stdout.strip("[]\n"), sep=","), wanted, atol=1e-9)
