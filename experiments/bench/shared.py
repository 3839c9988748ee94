"""What several devices bring: the cores of this machine as devices, or GPUs.

    python experiments/bench/shared.py

Wall clock, all cores: 722 runs of a guarded policy, a generation of SNES, and a step of the
gradient with scenarios, on one device and on all of them.
"""

import os

os.environ["JAXPEND_BENCH_CORES"] = "all"

import jax
import measure

from jaxpend import devices, gradient, load_policy, snes
from jaxpend.boards import v2
from jaxpend.cli.cache import share_processor
from jaxpend.config import GradientConfig, Objective, SNESConfig
from jaxpend.controllers.policy import network_in
from jaxpend.robustness import benchmark


def main() -> list[dict]:
    """Three kinds of work on one and on all devices."""
    task, policy, rows = v2("pendubot").task, load_policy("demonstrated_pendubot"), []
    network = network_in(policy)
    search = snes.SNES(SNESConfig(generations=1, chunk=1), network, task)
    config = GradientConfig(steps=5, chunk=5, scenarios=16, objective=Objective(0.5))
    ascent = gradient.Gradient(config, network, task)
    begun = search.start(0, network), ascent.start(0, network)
    work = {
        "722 runs": lambda: benchmark(policy, task.plant, jax.random.key(0), keys=1).overall,
        "a generation of SNES": lambda: search.advance([begun[0]])[0][1],
        "5 steps of the gradient": lambda: ascent.advance([begun[1]])[0][1],
    }
    there = jax.device_count()
    for part, run in work.items():

        def on(count, run=run):
            devices.use(count)
            return run()

        ways = [measure.Way(f"{n} device(s)", lambda n=n, on=on: on(n), 1) for n in (1, there)]
        found = measure.compared(part, "calls", ways)
        print(f"{'':34s}wall clock: {found[0]['wall']:.3f} s and {found[1]['wall']:.3f} s")
        rows += found
    return rows


if __name__ == "__main__":
    share_processor()
    measure.script(main, __doc__)
