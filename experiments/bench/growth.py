"""How the cost of rollouts grows: with their number, the width of the network, and the horizon.

    python experiments/bench/growth.py

Rollouts at 500 Hz of the pendubot with random networks; what is not varied is 512 rollouts, a width
of 64 and 1 s. A further curve is SAC of several seeds in one vmap.
"""

import functools

import jax
import measure
import numpy as np

from jaxpend import final_state, sac
from jaxpend.boards import v2
from jaxpend.scenario import Scenario

TASK = v2("pendubot").task
NUMBERS = (1, 8, 64, 512, 4096, 16_384, 65_536)
WIDTHS = (32, 64, 128, 256, 512)
HORIZONS = (0.5, 1.0, 2.0, 5.0, 10.0)
SEEDS = (1, 2, 4, 8, 16)


def rollouts(name: str, number: int = 512, width: int = 64, horizon: float = 1.0) -> measure.Way:
    """So many rollouts in one vmap, from starts that differ."""
    policy = measure.network(width)
    starts = 0.01 * np.random.default_rng(0).normal(size=(number, 4)).astype("f4")

    @jax.jit
    def run(starts):
        def one(x0):
            scenario = Scenario(TASK.plant, x0)
            return final_state(scenario, policy, jax.random.key(0), duration=horizon)

        return jax.vmap(one)(starts)

    return measure.Way(name, functools.partial(run, starts), number * round(horizon * 500))


def seeds(count: int) -> measure.Way:
    """A short chunk of SAC of so many seeds."""
    config = sac.SACConfig(num_envs=32, warmup_steps=0, replay_capacity=10_000)
    agent = sac.Agent(config, TASK)
    states = [sac.init(agent, jax.random.key(seed)) for seed in range(count)]
    steps, updates = 25, 25 * config.updates_per_step * count
    return measure.Way(
        f"{count}", functools.partial(sac.algorithm.train_chunks, agent, states, steps), updates
    )


def main() -> list[dict]:
    """All curves."""
    rows = measure.compared(
        "number of rollouts", "steps", [rollouts(f"{n}", number=n) for n in NUMBERS], 3
    )
    rows += measure.compared("width", "steps", [rollouts(f"{w}", width=w) for w in WIDTHS])
    rows += measure.compared(
        "horizon, s", "steps", [rollouts(f"{h:g}", horizon=h) for h in HORIZONS]
    )
    return rows + measure.compared("seeds of SAC", "updates", [seeds(n) for n in SEEDS], 3)


if __name__ == "__main__":
    measure.script(main, __doc__)
