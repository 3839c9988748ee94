"""Exported controllers beside the controller itself: how close, and how long a step takes.

    python experiments/export.py

Each is given the measurements of a closed loop of 10 s from hanging, 5000 of them, and 10 000
random states: a hundred runs of a hundred, that have nothing to do with a motion. Written with
gcc -O2 for C, ONNX Runtime with one thread, and jax compiled on the CPU in a loop of its own.
"""

import ctypes
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime

from jaxpend import load_policy, rollout
from jaxpend.boards import named_board, v2
from jaxpend.controllers.catalogue import build
from jaxpend.controllers.policy import network_in
from jaxpend.interop import c, numpy, onnx

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


CONTROLLERS = {
    "demonstrated_pendubot, policy alone": lambda: network_in(load_policy("demonstrated_pendubot")),
    "pendubot, policy alone (history of 4)": lambda: network_in(load_policy("pendubot")),
    "pendubot, as it ships (guarded)": lambda: load_policy("pendubot"),
    "acrobot, as it ships (guarded)": lambda: load_policy("acrobot"),
    "acrobot, for real robots": lambda: load_policy("hardware_acrobot"),
    "TVLQR, guarded": lambda: build("tvlqr_guarded", v2("pendubot").task.plant, "pendubot"),
}


def again(controller, times, states):
    """Torques (..., N, 2) of the controller itself, compiled once more, its arrays constants."""

    def run(states):
        start = controller.reset(jax.random.key(0))
        return jax.lax.scan(lambda carry, now: controller(carry, *now), start, (times, states))[1]

    runs = states.reshape(-1, *states.shape[-2:])
    return np.asarray(jax.jit(jax.vmap(run))(runs)).reshape(*states.shape[:-1], 2)


def in_c(controller, precision, given):
    """For each (times, states) of ``given`` torques (..., N, 2), and ns of a step of the first."""
    real, dtype = ("double", "f8") if precision == "float64" else ("float", "f4")
    pointer = ctypes.POINTER(ctypes.c_double if precision == "float64" else ctypes.c_float)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "controller.h").write_text(c.source(controller, precision=precision))
        (Path(folder) / "main.c").write_text(MAIN.replace("float", real))
        flags = "-std=c99 -Wall -Werror -O2 -shared -fPIC main.c -o main.so -lm"
        subprocess.run(["gcc", *flags.split()], cwd=folder, check=True)
        run = ctypes.CDLL(str(Path(folder) / "main.so")).run
    found, taken = [], []
    for times, states in given:
        times, states = np.ascontiguousarray(times, dtype), np.ascontiguousarray(states, dtype)
        torques = np.zeros((*states.shape[:-1], 2), dtype)
        for place in np.ndindex(states.shape[:-2]):
            arrays = [a.ctypes.data_as(pointer) for a in (times, states[place], torques[place])]
            for _ in range(REPEAT if not found else 1):
                start = time.perf_counter()
                run(len(times), *arrays)
                taken.append((time.perf_counter() - start) / len(times))
        found.append(torques)
    return found, 1e9 * min(taken[:REPEAT])


def one_by_one(start, given):
    """The same of a function that is called from Python, and us; ``start()`` gives a new one."""
    found, taken = [], []
    for times, states in given:
        torques = np.zeros((*states.shape[:-1], 2))
        for place in np.ndindex(states.shape[:-2]):
            step = start()
            for i, now in enumerate(zip(times, states[place], strict=True)):
                began = time.perf_counter()
                torques[(*place, i)] = step(*now)
                taken.append(time.perf_counter() - began)
        found.append(torques)
    return found, 1e6 * np.median(taken[: len(given[0][0])])


def session_of(controller):
    """Makes steps of the ONNX model, in double."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, 1
    session = onnxruntime.InferenceSession(onnx.model(controller).SerializeToString(), options)

    def start():
        state = {}

        def step(t, x):
            torque, *after = session.run(None, {"t": np.asarray(t), "x": x, **state})
            state.update({f"s{i}": value for i, value in enumerate(after)})
            return torque

        return step

    return start


def apart(found, wanted):
    """The largest difference of a torque, in a loop and on random states."""
    return " and ".join(f"{np.abs(a - b).max():.0e}" for a, b in zip(found, wanted, strict=True))


def main() -> None:
    """Print a table in Markdown."""
    print("| | numpy | ONNX | C, float64 | C, float32 | C, single | jax again, float32 |")
    print("|---|---|---|---|---|---|---|")
    draw = np.random.default_rng(0)
    random = (0.1 * np.arange(100), draw.normal(size=(100, 100, 4)) * [2, 2, 8, 8])
    random = tuple(a.astype("f4").astype(float) for a in random)
    for name, make in CONTROLLERS.items():
        robot = "acrobot" if "acrobot" in name else "pendubot"
        board = named_board(robot, "hardware" if "real" in name else "v2")
        with jax.enable_x64(True):
            law = make()
            run = jax.jit(rollout)(board.task.plant, law, jax.random.key(0))
            loop = (run.t[:-1], run.x_measured)
            given = [tuple(np.asarray(a, "f4").astype(float) for a in loop), random]
            ours = [again(law, *now) for now in given]
            names: dict = {}
            exec(numpy.source(law), names)
            cells = [
                (*one_by_one(lambda made=names["Controller"]: made().torque, given), "us"),
                (*one_by_one(session_of(law), given), "us"),
                *((*in_c(law, p, given), "ns") for p in ("float64", "float32", "single")),
            ]
        short = [tuple(jnp.asarray(a, "f4") for a in now) for now in given]
        cells = [f"{apart(found, ours)} N m, {t:.0f} {unit}" for found, t, unit in cells]
        cells += [f"{apart([again(make(), *now) for now in short], ours)} N m"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
