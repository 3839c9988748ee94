"""Exported controllers: the torques are those of the controller itself."""

import ctypes
import functools
import itertools
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest
from conftest import refused, task_of

from jaxpend import cli, load_policy, rollout
from jaxpend.config import ACTIVATIONS
from jaxpend.controller import Feedback
from jaxpend.controllers.callback import PythonLaw
from jaxpend.controllers.catalogue import build
from jaxpend.controllers.files import save_policy
from jaxpend.controllers.guard import guard
from jaxpend.controllers.policy import Policy
from jaxpend.interop import c as to_c
from jaxpend.interop import numpy as to_numpy
from jaxpend.interop import onnx as to_onnx
from jaxpend.observation import KINDS, Observation
from jaxpend.pytree import Pytree, pytree
from jaxpend.scenario import Scenario

STARTS = np.array([[0, 0, 0, 0], [2.0, -1.0, 3.0, -4.0]])
NAMES = ("plain", "history", "shipped", "guarded history")


def policy(history, observation=None):
    """A network with random weights, and where it sees the past one of its own memory."""
    observation = observation or Observation(history=history)
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


def test_the_loop_that_an_exported_controller_closes_is_the_same(tmp_path):
    task, name = task_of("pendubot"), "shipped"
    library = in_c(name, tmp_path, "float64")
    exported = in_numpy(name)
    exported.reset()

    def act(t, x):
        if t == 0:
            library.begin()
        torque, x = np.empty(2), np.ascontiguousarray(x)
        library.act(ctypes.c_double(t), floats(x, ctypes.c_double), floats(torque, ctypes.c_double))
        return torque

    _, states, torques = recorded(name, "float64")
    for law in (exported.torque, act):
        with jax.enable_x64(True):
            run = rollout(task.plant, PythonLaw(law), jax.random.key(0))
        np.testing.assert_allclose(run.x_measured, states[0], rtol=0, atol=1e-8)
        np.testing.assert_allclose(run.u_command, torques[0], rtol=0, atol=1e-8)


def in_c(name, folder, precision="float32"):
    """A library whose ``run`` takes a number of steps N, times, states (N, 4), torques (N, 2).

    Its ``act`` is one step after ``begin``.
    """
    arrays = "float32" if precision == "float32" else "float64"
    text = to_c.source(controller(name, arrays), prefix="our", precision=precision)
    (folder / "controller.h").write_text(text)
    real = "double" if precision == "float64" else "float"
    (folder / "loop.c").write_text(LOOP.replace("float", real))
    flags = "-std=c99 -Wall -Wextra -Werror -O2 -shared -fPIC loop.c -o loop.so -lm"
    subprocess.run(["gcc", *flags.split()], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "loop.so"))


LOOP = """
#include "controller.h"
static our_state now;
void begin(void) { our_init(&now); }
void act(float t, const float *x, float *torque) { our_step(&now, t, x, torque); }
void run(int n, const float *t, const float *x, float *torque)
{
    our_state state;
    our_init(&state);
    for (int i = 0; i < n; ++i) our_step(&state, t[i], x + 4 * i, torque + 2 * i);
}
"""


def floats(array, kind=ctypes.c_float):
    return array.ctypes.data_as(ctypes.POINTER(kind))


@pytest.mark.parametrize("name", NAMES)
def test_c_in_double_gives_the_same_torques_on_the_same_measurements(name, tmp_path):
    times, states, torques = recorded(name, "float64")
    library, states = in_c(name, tmp_path, "float64"), np.ascontiguousarray(states)
    found = np.empty(torques.shape)
    for x, u in zip(states, found, strict=True):
        library.run(len(times), *(floats(a, ctypes.c_double) for a in (times, x, u)))
    np.testing.assert_allclose(found, torques, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_c_in_mixed_precision_gives_the_same_torques_on_the_same_floats(name, tmp_path):
    times, states, _ = recorded(name, "float64")
    times, states = times.astype("f4"), np.ascontiguousarray(states, "f4")
    library, found = in_c(name, tmp_path, "mixed"), np.empty((*states.shape[:2], 2), "f4")
    for x, u in zip(states, found, strict=True):
        library.run(len(times), floats(times), floats(x), floats(u))
    ours = [replayed(in_numpy(name), times.astype(float), x.astype(float)) for x in states]
    np.testing.assert_allclose(found, ours, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_c_is_as_close_as_float32_is(name, tmp_path):
    """An observer takes the difference of angles, and multiplies their rounding."""
    times, states, exact = recorded(name, "float64")
    times, states = times.astype("f4"), np.ascontiguousarray(states, "f4")
    library = in_c(name, tmp_path)
    torques = np.empty(exact.shape, "f4")
    for x, u in zip(states, torques, strict=True):
        library.run(len(times), floats(times), floats(x), floats(u))
    if name in ("plain", "history"):
        ours = np.asarray(again(controller(name, "float32"), times, states))
        np.testing.assert_allclose(torques, ours, rtol=0, atol=1e-5)
        assert np.abs(torques - exact).mean() < 1.5 * np.abs(ours - exact).mean()
    else:  # to compile these once more takes long
        # The rescue may begin a step earlier or later: at 2 s sharp.
        off = np.abs(torques - exact)[:, np.abs(times - 2) > 0.01]
        assert off.max() < 1e-2
        assert off.mean() < 2e-4


@jax.jit
def again(controller, times, states):
    """Torques for measurements (runs, N, 4)."""

    def run(states):
        def step(carry, now):
            return controller(carry, *now)

        return jax.lax.scan(step, controller.reset(jax.random.key(0)), (times, states))[1]

    return jax.vmap(run)(states)


def test_the_header_needs_no_more_than_it_says(tmp_path):
    made = controller("guarded history", "float32")
    text = to_c.source(made, prefix="our", precision="float32")
    called = set(re.findall(r"\b(\w+f)\(", text)) | set(re.findall(r"\b(\w*alloc\w*)\(", text))
    assert called == {"tanhf"}
    assert "double" not in text
    operations = int(re.search(r"at most (\d+) operations", text)[1])
    assert 500 < operations < 3000
    main = 'int main(void) { printf("%d", (int)sizeof(our_state)); }'
    (tmp_path / "size.c").write_text(f'#include "our.h"\n#include <stdio.h>\n{main}')
    (tmp_path / "our.h").write_text(text)
    subprocess.run(["gcc", "size.c", "-o", "size"], cwd=tmp_path, check=True)
    size = subprocess.run([tmp_path / "size"], capture_output=True, text=True, check=True).stdout
    assert f"The state has {size} bytes" in text


@pytest.mark.parametrize("name", NAMES)
def test_onnx_gives_the_same_torques_on_the_same_measurements(name):
    runtime = pytest.importorskip("onnxruntime")
    times, states, torques = recorded(name, "float64")
    model = to_onnx.model(controller(name, "float64"), precision="float64")
    options = runtime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, 1
    session = runtime.InferenceSession(model.SerializeToString(), options)
    state: dict = {}
    for t, x, u in zip(times[:1500], states[1], torques[1], strict=False):
        torque, *after = session.run(None, {"t": np.asarray(t), "x": x, **state})
        state = {f"s{i}": value for i, value in enumerate(after)}
        np.testing.assert_allclose(torque, u, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["riccati", "open_loop", "pd"])
def test_what_looks_up_tables_or_uses_time_is_exported_too(name):
    with jax.enable_x64(True):
        found = build(name, task_of("acrobot").plant, "acrobot")
        draw = np.random.default_rng(0)
        times = np.sort(draw.uniform(0, 5, 100))
        states = draw.normal(size=(100, 4)) * 4
        expected = np.asarray(again(found, times, states[None])[0])
    names: dict = {}
    exec(to_numpy.source(found), names)
    torques = replayed(names["Controller"](), times, states)
    np.testing.assert_allclose(torques, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_what_policies_may_see_and_have_is_exported(kind):
    """Every kind of observation, with another activation each."""
    activation = ACTIVATIONS[list(KINDS).index(kind) % len(ACTIVATIONS)]
    draw = np.random.default_rng(2)
    states = draw.normal(size=(60, 4)) * np.array([5, 5, 40, 40])
    with jax.enable_x64(True):
        found = policy(0, Observation(kind=kind)).replace(activation=activation)
        expected = np.asarray(again(found, np.arange(60.0), states[None])[0])
        names: dict = {}
        exec(to_numpy.source(found), names)
    torques = replayed(names["Controller"](), np.arange(60.0), states)
    np.testing.assert_allclose(torques, expected, rtol=0, atol=1e-12)


def everything(t, x):
    """Torques that use most of what can be printed, on scalars and on vectors."""
    wide = jnp.outer(jnp.arange(1.0, 9.0), x)  # (8, 4)
    square = jnp.outer(x, x) + jnp.eye(4)
    sums = [
        jnp.sum(jnp.cumsum(x)[::-1] * jnp.array([1.0, -1.0, 2.0, 0.5])),
        jnp.max(jnp.sin(wide), axis=1)[2] + jnp.min(wide) + jnp.sum(jnp.abs(wide).T, axis=0)[1],
        jnp.sum((square @ square.T)[1] * jax.nn.sigmoid(x)) + jnp.sum(wide @ square),
        wide[jnp.argmax(x), jnp.argmin(x)] + wide.ravel()[jnp.round(3 * t).astype(int) % 32],
        jnp.sqrt(jnp.abs(x[0])) + jnp.floor(x[1]) + jnp.ceil(x[2]) + jnp.sign(x[3]) + jnp.exp(-t),
        jnp.sum(jnp.mod(wide, 3.0)) + jnp.sum(jnp.where(wide > 0, wide, jnp.tanh(wide))),
        jax.lax.cond(x[0] > 0, lambda: x[1] ** 3, lambda: x[2] ** -2),
        jax.lax.fori_loop(0, 3, lambda i, v: v * 0.5 + x[i], 1.0),
        jnp.sum(jnp.pad(x, 2)[1:5] * jnp.roll(x, 1)) + jnp.sum(jnp.rint(2 * wide)),
        jnp.where(jnp.isfinite(x[0] / (x[1] - x[1])), 1.0, -1.0),
    ]
    total = jnp.array(sums)
    return jnp.array([total.sum(), jnp.dot(total, jnp.arange(10.0))])


def test_every_printer_prints_every_operation(tmp_path):
    law, draw = Feedback(everything), np.random.default_rng(1)
    times, states = draw.uniform(0, 9, 50), draw.normal(size=(50, 4)) * 3
    with jax.enable_x64(True):
        expected = np.asarray(again(law, times, states[None])[0])
        session = pytest.importorskip("onnxruntime").InferenceSession(
            to_onnx.model(law, precision="float64").SerializeToString()
        )
    names: dict = {}
    exec(to_numpy.source(law, class_name="Own"), names)
    np.testing.assert_allclose(replayed(names["Own"](), times, states), expected, rtol=1e-9)
    for t, x, u in zip(times, states, expected, strict=True):
        np.testing.assert_allclose(
            session.run(["torque"], {"t": np.asarray(t), "x": x})[0], u, rtol=1e-9
        )
    (tmp_path / "controller.h").write_text(to_c.source(law, prefix="our", precision="float32"))
    (tmp_path / "loop.c").write_text(LOOP)
    flags = "-std=c99 -Wall -Werror -O2 -shared -fPIC loop.c -o loop.so -lm"
    subprocess.run(["gcc", *flags.split()], cwd=tmp_path, check=True)
    t, x, u = times.astype("f4"), states.astype("f4"), np.empty((50, 2), "f4")
    ctypes.CDLL(str(tmp_path / "loop.so")).run(50, floats(t), floats(x), floats(u))
    np.testing.assert_allclose(u, expected, rtol=2e-3, atol=2e-3)


def test_what_is_not_finite_passes_through():
    exported = in_numpy("shipped")
    exported.reset()
    for bad in (np.nan, np.inf, -np.inf, 1e300):
        assert exported.torque(0.0, [bad, 0.0, bad, 0.0]).shape == (2,)
    exported.reset()
    assert np.isfinite(exported.torque(0.0, np.zeros(4))).all()


@pytree
class Dice(Pytree):
    """Random torques."""

    def reset(self, key):
        return key

    def __call__(self, carry, t, x):
        first, second = jax.random.split(carry)
        return first, jax.random.normal(second, (2,))


def test_what_cannot_be_printed_is_refused_in_one_sentence():
    with refused("Feedback cannot be exported: a step of it loops 100 times"):
        to_c.source(Feedback(lambda t, x: jax.lax.fori_loop(0, 100, lambda i, u: u + 1, x[:2])))
    with refused("Feedback cannot be exported: a step of it loops for a number of times that is"):
        to_c.source(Feedback(lambda t, x: jax.lax.while_loop(lambda u: u[0] < 1, jnp.exp, x[:2])))
    with refused("Dice cannot be exported: it draws random numbers"):
        to_numpy.source(Dice())
    with refused("PythonLaw cannot be exported: it calls Python"):
        to_numpy.source(PythonLaw(lambda t, x: np.zeros(2)))
    with refused("Feedback cannot be exported: it uses the operation sort"):
        to_numpy.source(Feedback(lambda t, x: jnp.sort(x)[:2]))
    with refused("the class name 'a b' is no name in Python"):
        to_numpy.source(policy(0), class_name="a b")
    with refused("the prefix '1x' is no name in C"):
        to_c.source(Dice(), prefix="1x")


def test_noise_of_training_is_left_out():
    noisy = policy(0).replace(action_noise=jnp.asarray(0.5))
    assert to_c.source(noisy) == to_c.source(policy(0))


MINE = "# The controller of my thesis.\nfrom jaxpend.interop import c, numpy, onnx\n"


@pytest.mark.parametrize(("to", "name"), [("numpy", "a.py"), ("c", "a-b.h"), ("onnx", "a.onnx")])
def test_the_command_writes_a_file_that_it_may_write_again(monkeypatch, capsys, tmp_path, to, name):
    save_policy(tmp_path / "policy.npz", policy(0))
    line = ["export", str(tmp_path / "policy.npz"), "--to", to, "--out", str(tmp_path / name)]
    for _ in range(2):
        code, _, said = run(monkeypatch, capsys, line)
        assert code == 0
        assert f"wrote {tmp_path / name}" in said
    assert (tmp_path / name).stat().st_size > 500
    (tmp_path / name).write_text(MINE)
    code, out, said = run(monkeypatch, capsys, line)
    assert (code, out) == (2, "")
    assert said == (
        f"jaxpend export: cannot write {tmp_path / name}: it is there and was not exported; choose "
        "another name\n"
    )
    assert (tmp_path / name).read_text() == MINE


def test_the_command_exports_in_either_precision(monkeypatch, capsys, tmp_path):
    save_policy(tmp_path / "policy.npz", policy(0))
    line = ["export", str(tmp_path / "policy.npz"), "--precision"]
    for precision, kind, number in (("float32", "float", 1), ("float64", "double", 11)):
        for to in ("c", "onnx"):
            out = ["--to", to, "--out", str(tmp_path / f"{precision}.{to}")]
            assert run(monkeypatch, capsys, [*line, precision, *out])[0] == 0
        said = (tmp_path / f"{precision}.c").read_text()
        assert f"_step({precision}_state *s, {kind} t, const {kind} x[4]" in said
        graph = onnx.load_model(tmp_path / f"{precision}.onnx").graph
        assert {i.type.tensor_type.elem_type for i in graph.input} == {number}
    for to in ("numpy", "realaigym"):
        out = ["--to", to, "--out", str(tmp_path / to)]
        code, _, said = run(monkeypatch, capsys, [*line, "float32", *out])
        assert code == 2
        assert f"--precision is float32; {to} computes in float64" in said
    code, _, said = run(monkeypatch, capsys, [*line, "mixed", "--to", "onnx", "--out", "x.onnx"])
    assert (code, "onnx computes in float32 or float64" in said) == (2, True)
    mixed = [*line, "mixed", "--to", "c", "--out", str(tmp_path / "mixed.h")]
    assert run(monkeypatch, capsys, mixed)[0] == 0
    assert "mixed_step(mixed_state *s, float t, const" in (tmp_path / "mixed.h").read_text()


def run(monkeypatch, capsys, arguments):
    """Exit code, output and errors of the command line."""
    monkeypatch.setattr("sys.argv", ["jaxpend", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return end.value.code, *capsys.readouterr()


def test_onnx_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with refused("pip install 'jaxpend[onnx]'"):
        to_onnx.model(policy(0))
