"""What the scripts beside this one share: one core, interleaved repetitions, a table, a file.

It confines the process to one core, where the system can, before jax begins to compute: there
ratios of processor seconds mean most. ``JAXPEND_BENCH_CORES=all`` leaves them all.
"""

import argparse
import dataclasses
import datetime
import importlib.metadata
import itertools
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpend.controllers import Policy
from jaxpend.designs import competition
from jaxpend.observation import Observation

if os.environ.get("JAXPEND_BENCH_CORES") != "all" and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

PEERS = ("gymnax", "sbx-rl", "stable-baselines3", "torch", "flax")


@dataclasses.dataclass(frozen=True)
class Way:
    """A way to do the work: ``call`` does it and waits for what comes out."""

    name: str
    call: Callable[[], Any]
    work: float  # units done by a call


def compared(part: str, unit: str, ways: Sequence[Way], repeats: int = 5) -> list[dict[str, Any]]:
    """Time all ways in turn, again and again, and print a line for each.

    A row has the seconds of the first call beyond a run (compilation), and of a run the median,
    the lowest and the highest processor seconds, the median of the wall clock, and units a
    processor second.
    """
    first, taken = [], np.empty((repeats, len(ways), 2))
    for way in ways:
        start = time.perf_counter()
        jax.block_until_ready(way.call())
        first.append(time.perf_counter() - start)
    for number in range(repeats):
        for place, way in enumerate(ways):
            wall, processor = time.perf_counter(), time.process_time()
            jax.block_until_ready(way.call())
            now = time.perf_counter() - wall, time.process_time() - processor
            taken[number, place] = now
    rows = []
    for way, begun, seconds in zip(ways, first, taken.swapaxes(0, 1), strict=True):
        wall, processor = np.median(seconds, axis=0)
        low, high = seconds[:, 1].min(), seconds[:, 1].max()
        row = {"part": part, "way": way.name, "unit": unit, "speed": way.work / processor}
        row |= {"compile": begun - wall, "wall": wall, "processor": processor}
        rows.append(row | {"low": low, "high": high, "repeats": repeats})
        speed = f"{row['speed']:12.4g} {unit}/s"
        print(f"{part:34s}{way.name:34s}{speed:34s}", end="")
        print(f"{processor:9.4f} s ({low:.4f} to {high:.4f}), compiled in {row['compile']:.2f} s")
    return rows


def network(width: int) -> Policy:
    """Two hidden layers of random weights: what a run costs does not depend on them."""
    observation, rng = Observation(), np.random.default_rng(0)
    sizes = (observation.size, width, width, 1)
    layers = tuple(
        (jnp.asarray(rng.normal(size=(m, n)) / np.sqrt(m), jnp.float32), jnp.zeros(n, jnp.float32))
        for m, n in itertools.pairwise(sizes)
    )
    return Policy(layers, jnp.asarray(3.0, jnp.float32), observation=observation)


def numpy_rk4() -> Callable[..., np.ndarray]:
    """A step of the pendubot in plain numpy: states (4, n), torques (n,), dt -> states (4, n)."""
    plant = jax.tree.map(np.asarray, competition("pendubot"))
    m, l, r, inertia, g = plant.mass, plant.length, plant.com, plant.inertia, plant.gravity  # noqa: E741
    m2l1, both = m[1] * l[0], m[0] * r[0] + m[1] * l[0]

    def slope(x, u):
        t1, t2, w1, w2 = x
        coupling, h = m2l1 * r[1] * np.cos(t2), m2l1 * r[1] * np.sin(t2)
        m11, m12, m22 = sum(inertia) + m2l1 * l[0] + 2 * coupling, inertia[1] + coupling, inertia[1]
        g2 = -m[1] * g * r[1] * np.sin(t1 + t2)
        f1 = g2 - both * g * np.sin(t1) + u + h * w2 * (2 * w1 + w2)
        f2 = g2 - h * w1 * w1
        det = m11 * m22 - m12 * m12
        return np.stack([w1, w2, (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det])

    def step(x, u, dt):
        half, sixth = x.dtype.type(dt / 2), x.dtype.type(dt / 6)
        k1 = slope(x, u)
        k2 = slope(x + half * k1, u)
        k3 = slope(x + half * k2, u)
        k4 = slope(x + x.dtype.type(dt) * k3, u)
        return x + sixth * (k1 + 2 * (k2 + k3) + k4)

    return step


def peak() -> float:
    """Float32 matrix products of this machine, GFLOP/s: the best of ten of size 2048."""
    product, a = jax.jit(lambda a: a @ a), jnp.ones((2048, 2048))
    product(a).block_until_ready()
    seconds = []
    for _ in range(10):
        start = time.perf_counter()
        product(a).block_until_ready()
        seconds.append(time.perf_counter() - start)
    return 2 * 2048**3 / min(seconds) / 1e9


def machine() -> dict[str, Any]:
    """What the figures hang on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    named = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    there = {}
    for name in ("jax", "numpy", *PEERS):
        try:
            there[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    known = hasattr(os, "sched_getaffinity")
    return {
        "processor": named[0] if named else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if known else os.cpu_count(),
        "device": f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        "matrix_gflops": peak(),
        "versions": there,
        "date": datetime.date.today().isoformat(),
    }


def script(make: Callable[[], list[dict[str, Any]]], doc: str | None) -> None:
    """Run a part from the command line: its rows, and in a file with ``--json FILE``."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--json", help="write rows and machine to this file")
    options, about = parser.parse_args(), machine()
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    print(f"{about['processor']}, {about['cores']} core(s), {about['matrix_gflops']:.0f} GFLOP/s")
    print(versions, flush=True)
    rows = make()
    if options.json:
        Path(options.json).write_text(json.dumps({"machine": about, "rows": rows}, indent=1))
