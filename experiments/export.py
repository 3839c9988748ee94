"""Exported controllers beside the controller itself: how close, and how long a step takes.

    python experiments/export.py

Each is given the measurements of a closed loop of 10 s from hanging, 5000 of them. Written with
gcc -O2 for C, ONNX Runtime with one thread, and jax compiled on the CPU in a loop of its own.
"""

import ctypes
import itertools
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime

from jaxpend import load_policy, rollout
from jaxpend.boards import v2
from jaxpend.controllers.catalogue import build
from jaxpend.controllers.guard import guard
from jaxpend.controllers.policy import Policy, network_in
from jaxpend.interop import c, numpy, onnx
from jaxpend.observation import Observation

MAIN = """
#include "controller.h"
void run(int n, const float *t, const float *x, float *torque)
{
    controller_state state;
    controller_init(&state);
    for (int i = 0; i < n; ++i) controller_step(&state, t[i], x + 4 * i, torque + 2 * i);
}
"""
REPEAT = 20


def with_history() -> Policy:
    """Weights that are drawn, of a network as large as those that ship."""
    draw, observation = np.random.default_rng(0), Observation(history=4)
    sizes = (observation.size, 64, 64, 1)
    layers = tuple(
        (jnp.asarray(draw.normal(size=(a, b)) / a**0.5), jnp.asarray(draw.normal(size=b)))
        for a, b in itertools.pairwise(sizes)
    )
    return Policy(layers, jnp.asarray(3.0), observation=observation)


CONTROLLERS = {
    "policy alone": lambda: network_in(load_policy("pendubot")),
    "policy with a history of 4": with_history,
    "pendubot, as it ships (guarded)": lambda: load_policy("pendubot"),
    "acrobot, as it ships (guarded)": lambda: load_policy("acrobot"),
    "guard around the history": lambda: guard(with_history(), "pendubot"),
    "TVLQR, guarded": lambda: build("tvlqr_guarded", v2("pendubot").task.plant, "pendubot"),
}


def again(controller, times, states):
    """Torques (N, 2) of the controller itself, compiled once more with its arrays as constants."""

    def run(now):
        start = controller.reset(jax.random.key(0))
        return jax.lax.scan(lambda carry, now: controller(carry, *now), start, now)[1]

    return jax.jit(run)((times, states))


def in_c(controller, times, states, precision="float32"):
    """Torques (N, 2), and ns a step."""
    pointer = ctypes.POINTER(ctypes.c_float)
    arrays = [np.ascontiguousarray(a, "f4") for a in (times, states, np.zeros((len(times), 2)))]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "controller.h").write_text(c.source(controller, precision=precision))
        (Path(folder) / "main.c").write_text(MAIN)
        flags = "-std=c99 -Wall -Werror -O2 -shared -fPIC main.c -o main.so -lm"
        subprocess.run(["gcc", *flags.split()], cwd=folder, check=True)
        run = ctypes.CDLL(str(Path(folder) / "main.so")).run
    taken = []
    for _ in range(REPEAT):
        start = time.perf_counter()
        run(len(times), *(a.ctypes.data_as(pointer) for a in arrays))
        taken.append((time.perf_counter() - start) / len(times))
    return arrays[2], 1e9 * min(taken)


def one_by_one(step, times, states):
    """Torques (N, 2), and us a step, of a function that is called from Python."""
    taken, torques = [], []
    for t, x in zip(times, states, strict=True):
        start = time.perf_counter()
        torques.append(step(t, x))
        taken.append(time.perf_counter() - start)
    return np.array(torques), 1e6 * np.median(taken)


def session_of(controller, precision):
    """A step of the ONNX model."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, 1
    content = onnx.model(controller, precision=precision).SerializeToString()
    session, state = onnxruntime.InferenceSession(content, options), {}

    def step(t, x):
        inputs = {"t": np.asarray(t, precision), "x": x.astype(precision), **state}
        torque, *after = session.run(None, inputs)
        state.update({f"s{i}": value for i, value in enumerate(after)})
        return torque

    return step


def main() -> None:
    """Print a table in Markdown."""
    print("| | numpy, float64 | ONNX, float64 | C, mixed | C, float32 | jax again, float32 |")
    print("|---|---|---|---|---|---|")
    for name, make in CONTROLLERS.items():
        robot = "acrobot" if "acrobot" in name else "pendubot"
        with jax.enable_x64(True):
            wide = make()
            run = jax.jit(rollout)(v2(robot).task.plant, wide, jax.random.key(0))
            t, x, u = (np.asarray(a) for a in (run.t[:-1], run.x_measured, run.u_command))
            names: dict = {}
            exec(numpy.source(wide), names)
            plain, plain_us = one_by_one(names["Controller"]().torque, t, x)
            model, model_us = one_by_one(session_of(wide, "float64"), t, x)
            rounded = t.astype("f4").astype(float), x.astype("f4").astype(float)
            exact, _ = one_by_one(names["Controller"]().torque, *rounded)
            mixed, mixed_ns = in_c(wide, t, x, "mixed")
        narrow = jax.jit(rollout)(v2(robot).task.plant, make(), jax.random.key(0))
        t, x = np.asarray(narrow.t[:-1]), np.asarray(narrow.x_measured)
        short, short_ns = in_c(make(), t, x)
        ours = again(make(), t, x)
        far = [np.abs(a - b).max() for a, b in ((plain, u), (model, u), (mixed, exact))]
        far += [np.abs(np.asarray(a) - narrow.u_command).max() for a in (short, ours)]
        print(
            f"| {name} | {far[0]:.1e} N m, {plain_us:.0f} us | {far[1]:.1e} N m, {model_us:.0f} us "
            f"| {far[2]:.1e} N m, {mixed_ns:.0f} ns | {far[3]:.1e} N m, {short_ns:.0f} ns "
            f"| {far[4]:.1e} N m |",
            flush=True,
        )


if __name__ == "__main__":
    main()
