"""How fast the robustness benchmark runs here: ``python experiments/robustness_speed.py``.

In one run, so that the figures belong together: seconds for all 722 simulations with a 2x256
and a 2x64 network (random weights: the cost does not depend on them), compilation apart; the
machine's own float32 matrix throughput and the fraction of it that the networks reach; and the
same simulations in plain numpy, one after the other as the reference simulator works, and all
at once. ``--json FILE`` keeps the figures.
"""

import itertools
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxpend import Policy, cli
from jaxpend.designs import competition
from jaxpend.observation import Observation
from jaxpend.robustness import benchmark
from jaxpend.terminal import console

STEPS, RUNS = 5000, 722


def best(repeats: int, call) -> float:
    """Shortest wall clock of several calls, s."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def network(width: int) -> Policy:
    """Two hidden layers of random weights."""
    rng = np.random.default_rng(0)
    sizes = [Observation().size, width, width, 1]
    layers = tuple(
        (jnp.asarray(rng.normal(size=(a, b)) / np.sqrt(a), jnp.float32), jnp.zeros(b, jnp.float32))
        for a, b in itertools.pairwise(sizes)
    )
    return Policy(layers, jnp.asarray(3.0, jnp.float32))


def matrix_throughput() -> dict[str, float]:
    """Float32 matrix products of this machine, GFLOP/s: a big square and the 2x256 layer."""
    product = jax.jit(lambda a, b: a @ b)
    found = {}
    for name, rows, width, times in (("square", 2048, 2048, 1), ("layer", RUNS, 256, 50)):
        a, b = jnp.ones((rows, width)), jnp.ones((width, width))
        product(a, b).block_until_ready()
        seconds = best(10, lambda a=a, b=b, n=times: [product(a, b) for _ in range(n)])
        found[name] = 2 * rows * width * width * times / seconds / 1e9
    return found


def numpy_seconds(policy: Policy, runs: int, steps: int) -> float:
    """Wall clock of plain numpy for so many nominal runs side by side, s."""
    plant = jax.tree.map(np.asarray, competition(policy.robot))
    layers = jax.tree.map(np.asarray, policy.layers)
    m, l, r, inertia, g = plant.mass, plant.length, plant.com, plant.inertia, plant.gravity  # noqa: E741
    m2l1 = m[1] * l[0]

    def slope(x, u):
        t1, t2, w1, w2 = x
        coupling, h = m2l1 * r[1] * np.cos(t2), m2l1 * r[1] * np.sin(t2)
        m11 = inertia[0] + inertia[1] + m2l1 * l[0] + 2 * coupling
        m12, m22 = inertia[1] + coupling, inertia[1]
        g2 = -m[1] * g * r[1] * np.sin(t1 + t2)
        f1 = g2 - (m[0] * r[0] + m2l1) * g * np.sin(t1) + u + h * w2 * (2 * w1 + w2)
        f2 = g2 - h * w1 * w1
        det = m11 * m22 - m12 * m12
        return np.stack([w1, w2, (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det])

    def torque(x):
        scaled = x[2:] / np.float32(policy.observation.max_velocity)
        hidden = np.concatenate([np.cos(x[:2]), np.sin(x[:2]), scaled]).T
        for kernel, bias in layers[:-1]:
            hidden = np.maximum(hidden @ kernel + bias, 0)
        return 3 * np.tanh(hidden @ layers[-1][0] + layers[-1][1])[:, 0]

    x, dt = np.zeros((4, runs), "f4"), np.float32(0.002)
    start = time.perf_counter()
    for _ in range(steps):
        u = np.clip(torque(x), -plant.torque_limit[0], plant.torque_limit[0])
        k1 = slope(x, u)
        k2 = slope(x + dt / 2 * k1, u)
        k3 = slope(x + dt / 2 * k2, u)
        k4 = slope(x + dt * k3, u)
        x = x + dt / 6 * (k1 + 2 * (k2 + k3) + k4)
    return time.perf_counter() - start


def measure(width: int, repeats: int) -> dict[str, float]:
    """The benchmark with one network, and plain numpy doing as many nominal runs."""
    policy, plant = network(width), competition("pendubot")
    reports = [benchmark(policy, plant, jax.random.key(0)) for _ in range(repeats + 1)]
    seconds = min(report.run_seconds for report in reports[1:])
    flop = 2 * sum(kernel.size for kernel, _ in policy.layers) * STEPS * RUNS
    loop = numpy_seconds(policy, 1, 1000) * RUNS * STEPS / 1000
    together = numpy_seconds(policy, RUNS, 50) * STEPS / 50
    return {
        "compile_seconds": reports[0].compile_seconds,
        "run_seconds": seconds,
        "network_gflops": flop / seconds / 1e9,
        "numpy_loop_seconds": loop,
        "numpy_batched_seconds": together,
        "times_faster_than_numpy_loop": loop / seconds,
        "times_faster_than_numpy_batched": together / seconds,
    }


def main(repeats: int = 3, json: str | None = None) -> None:
    """Measure and print.

    Args:
        repeats: of each measurement; the best one counts.
        json: write the figures to this file, or "-" for standard output.
    """
    result = {"device": jax.devices()[0].device_kind, "matrix_gflops": matrix_throughput()}
    peak = max(result["matrix_gflops"].values())
    for width in (256, 64):
        found = measure(width, repeats)
        found["fraction_of_matrix_throughput"] = found["network_gflops"] / peak
        result[f"2x{width}"] = found
    result["peak_memory_gib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    console.print(f"float32 matrix products: {peak:.0f} GFLOP/s on {result['device']}")
    for name in ("2x256", "2x64"):
        console.print(f"[bold]{name}[/bold], 722 runs of 10 s")
        for figure, value in result[name].items():
            console.print(f"  {figure.replace('_', ' '):34s} {value:10.2f}", highlight=False)
    console.print(f"peak memory {result['peak_memory_gib']:.2f} GiB")
    cli.emit_json(result, json)


if __name__ == "__main__":
    cli.run(main, "robustness_speed")
