"""Judging a generation of SNES, 40 networks for 10 s at 500 Hz, and other ways to run it.

    python experiments/bench/generation.py

The floor is what the networks' products alone would take at the rate of large matrix products.
"""

import functools

import jax
import measure

from jaxpend import snes
from jaxpend.boards import v2
from jaxpend.config import SNESConfig

POPULATION, STEPS = 40, 5000


def main() -> list[dict]:
    """Networks of three widths."""
    rows, task, key = [], v2("pendubot").task, jax.random.key(0)
    gflops = measure.peak()
    config = SNESConfig(population=POPULATION, action_noise=0.0)
    for width in (64, 128, 256):
        policy = measure.network(width)
        state = snes.init(config, policy, key)
        copies = [snes.mean_controller(config, policy, state) for _ in range(POPULATION)]
        stacked = jax.tree.map(lambda *leaves: jax.numpy.stack(leaves), *copies)
        judge = functools.partial(snes.fitness, config, key=key, task=task)
        one, batch = jax.jit(judge), jax.jit(jax.vmap(judge))
        ways = [
            measure.Way(
                "jaxpend", functools.partial(snes.evolve, config, policy, state, 1, task), 1
            ),
            measure.Way("one vmap", functools.partial(batch, stacked), 1),
            measure.Way(
                "a loop over jitted rollouts", lambda one=one, c=copies: [one(p) for p in c], 1
            ),
        ]
        found = measure.compared(f"a generation, 2x{width}", "generations", ways)
        work = 2 * sum(kernel.size for kernel, _ in policy.layers) * POPULATION * STEPS
        floor = work / gflops / 1e9
        print(f"{'':34s}the floor is {floor:.4f} s", end="")
        print(f", ours {found[0]['processor'] / floor:.1f} times as long")
        rows += [row | {"floor": floor} for row in found]
    return rows


if __name__ == "__main__":
    measure.script(main, __doc__)
