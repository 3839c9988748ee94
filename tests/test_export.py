"""Exported controllers: the torques are those of the controller itself."""

import ctypes
import functools
import itertools
import re
import subprocess
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest
from conftest import refused, task_of

from jaxpend import cli, load_policy, rollout
from jaxpend.boards import HARDWARE
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
from jaxpend.pytree import Pytree, pytree, static
from jaxpend.scenario import Scenario

STARTS = np.array([[0, 0, 0, 0], [2.0, -1.0, 3.0, -4.0]])
NAMES = ("plain", "angles", "shipped", "guarded history")


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
        if name == "angles":
            return policy(3, Observation("angles", history=3))
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


def in_c(name, folder, precision):
    """As ``compiled``, of one of ``NAMES``."""
    arrays = "float32" if precision == "single" else "float64"
    return compiled(controller(name, arrays), folder, precision)


def compiled(law, folder, precision, more=""):
    """A library whose ``run`` takes a number of steps N, times, states (N, 4), torques (N, 2).

    Its ``act`` is one step after ``begin``; ``more`` are options of the compiler.
    """
    folder.mkdir(exist_ok=True)
    (folder / "controller.h").write_text(to_c.source(law, prefix="our", precision=precision))
    (folder / "loop.c").write_text(LOOP.replace("float", OF_C[precision][0]))
    flags = f"-std=c99 -Wall -Wextra -Werror -O2 {more} -shared -fPIC loop.c -o loop.so -lm"
    subprocess.run(["gcc", *flags.split()], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "loop.so"))


def run_in_c(library, precision, times, states):
    """Torques (..., N, 2) for times (N,) and measurements (..., N, 4), each run from the start."""
    _, dtype, kind = OF_C[precision]
    times, states = np.ascontiguousarray(times, dtype), np.ascontiguousarray(states, dtype)
    torques = np.empty((*states.shape[:-1], 2), dtype)
    for place in np.ndindex(states.shape[:-2]):
        arrays = (times, states[place], torques[place])
        library.run(len(times), *(floats(array, kind) for array in arrays))
    return torques


# Of a precision: the type of what goes in and out, in C, numpy and ctypes.
OF_C = {
    "float32": ("float", "f4", ctypes.c_float),
    "float64": ("double", "f8", ctypes.c_double),
    "single": ("float", "f4", ctypes.c_float),
}

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
    found = run_in_c(in_c(name, tmp_path, "float64"), "float64", times, states)
    np.testing.assert_allclose(found, torques, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_c_in_float_gives_the_same_torques_on_the_same_floats(name, tmp_path):
    """Pairs of floats, so that an observer does not multiply their rounding."""
    times, states, _ = recorded(name, "float64")
    times, states = times.astype("f4").astype(float), states.astype("f4").astype(float)
    found = run_in_c(in_c(name, tmp_path, "float32"), "float32", times, states)
    ours = [replayed(in_numpy(name), times, x) for x in states]
    np.testing.assert_allclose(found, ours, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_random_states_give_the_same_torques(name, tmp_path):
    """A hundred measurements in a hundred runs of 10 s, that have nothing to do with a motion."""
    draw = np.random.default_rng(5)
    states = (draw.normal(size=(100, 100, 4)) * [2, 2, 8, 8]).astype("f4").astype(float)
    times = (0.1 * np.arange(100)).astype("f4").astype(float)
    with jax.enable_x64(True):
        ours = np.asarray(again(controller(name, "float64"), times, states))
    assert np.ptp(ours[..., 0]) > 1
    exported = in_numpy(name)
    found = np.array([replayed(exported, times, x) for x in states])
    np.testing.assert_allclose(found, ours, rtol=0, atol=1e-9)
    for precision, tolerance in (("float32", 1e-6), ("float64", 1e-9)):
        found = run_in_c(in_c(name, tmp_path / precision, precision), precision, times, states)
        np.testing.assert_allclose(found, ours, rtol=0, atol=tolerance)
    session = in_onnx(controller(name, "float64"))
    for x, wanted in zip(states[:10], ours[:10], strict=True):
        found = run_in_onnx(session, times, x)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_c_with_one_float_a_number_is_as_close_as_float32_is(name, tmp_path):
    """An observer takes the difference of angles, and multiplies their rounding."""
    times, states, exact = recorded(name, "float64")
    times, states = times.astype("f4"), states.astype("f4")
    torques = run_in_c(in_c(name, tmp_path, "single"), "single", times, states)
    if name in ("plain", "angles"):
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


@pytest.mark.parametrize(("precision", "called"), [("single", {"tanhf"}), ("float32", {"fmaf"})])
def test_the_header_needs_no_more_than_it_says(tmp_path, precision, called):
    text = to_c.source(controller("guarded history", "float64"), prefix="our", precision=precision)
    assert set(re.findall(r"\b(\w+f)\(", text)) == called  # fmaf where it is an instruction
    assert "double" not in text
    assert "alloc" not in text
    operations = int(re.search(r"at most (\d+) operations", text)[1])
    assert (2_000 if precision == "single" else 20_000) < operations < 60_000
    main = 'int main(void) { printf("%d", (int)sizeof(our_state)); }'
    (tmp_path / "size.c").write_text(f'#include "our.h"\n#include <stdio.h>\n{main}')
    (tmp_path / "our.h").write_text(text)
    subprocess.run(["gcc", "size.c", "-o", "size", "-lm"], cwd=tmp_path, check=True)
    size = subprocess.run([tmp_path / "size"], capture_output=True, text=True, check=True).stdout
    assert f"The state has {size} bytes" in text
    for flag in ("-ffast-math", "-funsafe-math-optimizations", "-ffinite-math-only"):
        fast = ["gcc", flag, "size.c", "-o", "size", "-lm"]
        done = subprocess.run(fast, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode
        assert "compile this file without -ffast-math" in done.stderr


POINTS = np.array([
    *np.linspace(-9, 9, 181), 1e-9, -1e-9, 1e-20, 0.0, 100.0, -100.0, 1234.5678, 88.5, -85.0,
    1e38, 1e-35,
])  # fmt: skip
FUNCTIONS = {
    "sin": np.sin, "cos": np.cos, "tanh": np.tanh, "exp": np.exp, "log": np.log,
    "sqrt": np.sqrt, "arctan": np.arctan, "floor": np.floor, "ceil": np.ceil, "rint": np.rint,
}  # fmt: skip


# The last one fuses products and sums, as processors with FMA do unless told.
@pytest.mark.parametrize("more", ["", "-O3 -std=gnu99 -march=native -ffp-contract=fast"])
def test_pairs_of_floats_are_far_closer_than_float_is(tmp_path, more):
    """A float has 6e-8 of a number; a loss of that in any function would be seen here."""
    with np.errstate(all="ignore"):
        exact = np.stack([function(POINTS) for function in FUNCTIONS.values()])
        exact = np.concatenate([exact, [np.fmod(POINTS, 2.7654), POINTS / 3, POINTS**2]])
        known = np.isfinite(exact) & (np.abs(exact) < 1e30)
    turning = [0, 1, len(FUNCTIONS)]  # sine, cosine and the remainder, where they are known
    known[turning] &= np.abs(POINTS) < 4e6
    least = np.minimum(np.maximum(np.abs(POINTS) / 30, 1e-3), 40)
    sizes = np.where(known, np.maximum(np.abs(exact), least), 1.0)

    def law(t, x):
        i = jnp.asarray(t, int)
        a = jnp.asarray(POINTS)[i]
        found = [getattr(jnp, name)(a) for name in FUNCTIONS]
        found = jnp.stack([*found, jax.lax.rem(a, 2.7654), a / 3, a * a])
        which = jnp.asarray(known)[:, i]
        off = jnp.where(which, (found - jnp.asarray(exact)[:, i]) / jnp.asarray(sizes)[:, i], 0.0)
        finite = jnp.sum(jnp.where(jnp.isfinite(found), 1.0, 0.0))
        return jnp.stack([1e9 * jnp.max(jnp.abs(off)), finite])

    with jax.enable_x64(True):
        library = compiled(Feedback(law), tmp_path, "float32", more)
    places = np.arange(len(POINTS), dtype=float)
    found = run_in_c(library, "float32", places, np.zeros((len(POINTS), 4)))
    np.testing.assert_array_less(found[:, 0], 1)  # 1e-9 of each
    finite = np.abs(exact) < 3e38
    finite[turning] &= np.abs(POINTS) < 4e6
    np.testing.assert_array_equal(found[:, 1], finite.sum(axis=0))


@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_what_ships_for_real_robots_is_exported(robot, tmp_path):
    """A memory of 40 steps, and an observer of a plant with Coulomb friction."""
    task = HARDWARE[robot].task
    draw = np.random.default_rng(6)
    times = 0.002 * np.arange(300)
    states = (np.cumsum(draw.normal(size=(2, 300, 4)), 1) * [0.02, 0.02, 0.2, 0.2]).astype("f4")
    with jax.enable_x64(True):
        alone = load_policy(task.shipped)
        for law in (alone, guard(alone, robot, task.plant)):
            ours = np.asarray(again(law, times, states.astype(float)))
            assert np.ptp(ours) > 1
            names: dict = {}
            exec(to_numpy.source(law), names)
            exported = names["Controller"]()
            found = [replayed(exported, times, x) for x in states.astype(float)]
            np.testing.assert_allclose(found, ours, rtol=0, atol=1e-9)
            found = run_in_onnx(in_onnx(law), times[:100], states[0, :100].astype(float))
            np.testing.assert_allclose(found, ours[0, :100], rtol=0, atol=1e-9)
            folder = tmp_path / type(law).__name__
            found = run_in_c(compiled(law, folder, "float32"), "float32", times, states)
            np.testing.assert_allclose(found, ours, rtol=0, atol=1e-5)


def in_onnx(law):
    """A session of ONNX Runtime, in double."""
    runtime = pytest.importorskip("onnxruntime")
    options = runtime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, 1
    return runtime.InferenceSession(to_onnx.model(law).SerializeToString(), options)


def run_in_onnx(session, times, states):
    """Torques (N, 2) for times (N,) and measurements (N, 4)."""
    state, torques = {}, []
    for t, x in zip(times, states, strict=True):
        torque, *after = session.run(None, {"t": np.asarray(t), "x": x, **state})
        state = {f"s{i}": value for i, value in enumerate(after)}
        torques.append(torque)
    return np.array(torques)


@pytest.mark.parametrize("name", NAMES)
def test_onnx_gives_the_same_torques_on_the_same_measurements(name):
    times, states, torques = recorded(name, "float64")
    found = run_in_onnx(in_onnx(controller(name, "float64")), times[:1500], states[1, :1500])
    np.testing.assert_allclose(found, torques[1, :1500], rtol=0, atol=1e-9)


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
        view = Observation(kind=kind, history=2 * (kind == "angles"))
        found = policy(0, view).replace(activation=activation)
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
        jnp.where(jnp.isfinite(x[0] / (x[1] - x[1])), 1.0, -1.0) + jnp.arctan(x[2]),
        jnp.sum(jnp.cumsum(wide, axis=0)[3:] * jnp.cumsum(wide.ravel())[::-2][:4]),
        jnp.sum(jax.lax.cumsum(wide, axis=1, reverse=True)[:, 1]),
    ]
    total = jnp.array(sums)
    return jnp.array([total.sum(), jnp.dot(total, jnp.arange(12.0))])


def test_every_printer_prints_every_operation(tmp_path):
    law, draw = Feedback(everything), np.random.default_rng(1)
    times, states = draw.uniform(0, 9, 50), draw.normal(size=(50, 4)) * 3
    times, states = times.astype("f4").astype(float), states.astype("f4").astype(float)
    with jax.enable_x64(True):
        expected = np.asarray(again(law, times, states[None])[0])
    names: dict = {}
    exec(to_numpy.source(law, class_name="Own"), names)
    np.testing.assert_allclose(replayed(names["Own"](), times, states), expected, rtol=1e-9)
    np.testing.assert_allclose(run_in_onnx(in_onnx(law), times, states), expected, rtol=1e-9)
    for precision, tolerance in (("float32", 1e-6), ("float64", 1e-9), ("single", 2e-3)):
        library = compiled(law, tmp_path / precision, precision)
        found = run_in_c(library, precision, times, states)
        np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


@pytree
class Remembering(Pytree):
    """Memory from ``start()``, and a step ``law(memory, t, x)`` to the next one and a torque."""

    start: Callable = static()
    law: Callable = static()

    def reset(self, key):
        return self.start()

    def __call__(self, carry, t, x):
        return self.law(carry, t, x)


def check_everywhere(law, folder, tolerance=1e-9, precisions=tuple(OF_C)):
    """The torques in numpy, ONNX Runtime and C are those of jax, for ten steps."""
    times = np.arange(10.0)
    states = np.random.default_rng(4).normal(size=(10, 4)).astype("f4").astype(float)
    with jax.enable_x64(True):
        expected = np.asarray(again(law, times, states[None])[0])
    names: dict = {}
    exec(to_numpy.source(law), names)
    found = {"numpy": replayed(names["Controller"](), times, states)}
    found["onnx"] = run_in_onnx(in_onnx(law), times, states)
    for precision in precisions:
        library = compiled(law, folder / precision, precision)
        found[precision] = run_in_c(library, precision, times, states)
    for name, torques in found.items():
        least = {"single": 1e-4, "float32": 1e-6}.get(name, tolerance)
        np.testing.assert_allclose(torques, expected, rtol=least, atol=least, err_msg=name)


WEIGHTS = np.sin(np.arange(80.0)).reshape(20, 4)


def shifted(carry, t, x):
    now, before = carry["now */"], carry["before"]
    new = jnp.tanh(WEIGHTS @ x)
    return {"now */": new, "before": now}, (new - before)[:2]


def swapped(carry, t, x):
    first, second = carry["now */"], carry["before"]
    return {"now */": second, "before": first}, first[:2] + x[:2]


@pytest.mark.parametrize(("law", "size"), [(shifted, 20), (swapped, 40)])
def test_memory_that_moves_on_is_read_before_it_is_overwritten(tmp_path, law, size):
    def start():
        return {"now */": jnp.zeros(size), "before": jnp.arange(size) / 8}

    check_everywhere(Remembering(start, law), tmp_path)


@pytest.mark.parametrize("law", [lambda t, x: x[:2], lambda t, x: jnp.array([1.0, -2.0])])
def test_a_step_that_computes_nothing_is_exported(tmp_path, law):
    check_everywhere(Feedback(law), tmp_path)


def few_numbers(t, x):
    """Loops over numbers one by one, and sums of none."""
    none = x[:0]
    after, ends = jax.lax.scan(lambda c, a: (c + a, c * a), 0.0, x)
    same, no_ends = jax.lax.scan(lambda c, a: (c + 1, c * a), t, none)
    sums = jnp.sum(none) + jnp.prod(none) + none @ none + jnp.sum(no_ends)
    wide = jnp.sum(jnp.zeros((6, 0)) @ jnp.zeros((0, 6)) + x[0])
    return jnp.array([jnp.polyval(jnp.array([0.1, -0.2, 0.3]), x[0]) + after + same, sums + wide
                      + jnp.sum(ends)])  # fmt: skip


def test_loops_over_numbers_and_sums_of_none_are_exported(tmp_path):
    check_everywhere(Feedback(few_numbers), tmp_path)
    empty = Remembering(lambda: {"a": jnp.zeros(0)}, lambda carry, t, x: (carry, x[:2]))
    with refused("Remembering cannot be exported: its memory['a'] has no entries; leave it out"):
        to_c.source(empty)


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


def test_the_command_exports_in_every_precision(monkeypatch, capsys, tmp_path):
    save_policy(tmp_path / "policy.npz", policy(0))

    def export(to, *more):
        line = ["export", str(tmp_path / "policy.npz"), "--to", to, "--out", str(tmp_path / "a")]
        found = run(monkeypatch, capsys, [*line, *more])
        text = (tmp_path / "a").read_bytes() if (tmp_path / "a").is_file() else b""
        (tmp_path / "a").unlink(missing_ok=True)
        return found, text

    c = export("c")[1].decode()
    assert "a_step(a_state *s, float t, const float x[4]" in c
    for precision, kind in (("float32", "float"), ("float64", "double"), ("single", "float")):
        (code, _, _), text = export("c", "--precision", precision)
        assert code == 0
        assert f"a_step(a_state *s, {kind} t, const {kind} x[4]" in text.decode()
        assert (text.decode() == c) == (precision == "float32")
    for more, number in (
        ((), 11),
        (("--precision", "float64"), 11),
        (("--precision", "float32"), 1),
    ):
        graph = onnx.load_from_string(export("onnx", *more)[1]).graph
        numbers = {i.type.tensor_type.elem_type for i in graph.input}
        assert numbers == {number}
    for to in ("numpy", "realaigym"):
        (code, _, said), text = export(to, "--precision", "float32")
        assert (code, text) == (2, b"")
        assert f"--precision is float32; {to} computes in float64 alone: leave it out" in said
    (code, _, said), text = export("onnx", "--precision", "single")
    assert (code, text) == (2, b"")
    assert "--precision is single; onnx computes in float64 or float32" in said


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
