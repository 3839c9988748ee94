"""The robustness benchmark: 722 runs of 10 s at 500 Hz, beside plain numpy.

    python experiments/bench/robustness.py

The numpy runs are nominal, with the same network, and extrapolated from fewer steps: one run after
the other, as the reference simulator works, and all at once.
"""

import functools

import jax
import measure
import numpy as np

from jaxpend import Policy, load_policy
from jaxpend.robustness import benchmark

STEPS, RUNS = 5000, 722


def in_numpy(policy: Policy, runs: int, steps: int) -> None:
    """So many nominal runs side by side, for so many steps."""
    step, layers = measure.numpy_rk4(), jax.tree.map(np.asarray, policy.layers)
    x, most = np.zeros((4, runs), "f4"), np.float32(policy.observation.max_velocity)
    for _ in range(steps):
        hidden = np.concatenate([np.cos(x[:2]), np.sin(x[:2]), x[2:] / most]).T
        for kernel, bias in layers[:-1]:
            hidden = np.maximum(hidden @ kernel + bias, 0)
        torque = 3 * np.tanh(hidden @ layers[-1][0] + layers[-1][1])[:, 0]
        x = step(x, torque, 0.002)


def main() -> list[dict]:
    """A guarded policy that imitates, and two networks."""
    rows, key = [], jax.random.key(0)
    policies = {"imitated, guarded": load_policy("demonstrated_pendubot")}
    policies |= {f"2x{width}": measure.network(width) for width in (64, 256)}
    for name, policy in policies.items():
        ours = functools.partial(benchmark, policy, "pendubot", key, keys=1)
        # What it returns is numpy.
        ways = [measure.Way("jaxpend", lambda run=ours: run().overall, RUNS)]
        if isinstance(policy, Policy):
            loop, batch = (
                functools.partial(in_numpy, policy, runs, steps)
                for runs, steps in ((1, 500), (RUNS, 50))
            )
            ways.append(measure.Way("numpy, one after the other", loop, 500 / STEPS))
            ways.append(measure.Way("numpy, all at once", batch, RUNS * 50 / STEPS))
        rows += measure.compared(f"722 runs, {name}", "runs", ways)
    return rows


if __name__ == "__main__":
    measure.script(main, __doc__)
