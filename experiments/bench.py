"""Time the parts of the main job on this machine: rollouts, SAC, SNES.

    python experiments/bench.py            # or: make bench

Compile and run times are given apart; every figure is the median of five runs.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxpend import Scenario, designs, sac, snes
from jaxpend.controllers import Policy
from jaxpend.observation import Observation
from jaxpend.score import performance, score_v2


def random_policy(width: int) -> Policy:
    """A 2 x width tanh network with random weights."""
    observation = Observation()
    sizes = (observation.size, width, width, 1)
    keys = jax.random.split(jax.random.key(0), 3)
    layers = tuple(
        (jax.random.normal(k, (m, n)) / jnp.sqrt(m), jnp.zeros(n))
        for k, m, n in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )
    return Policy(layers, jnp.asarray(3.0), observation=observation, activation="tanh")


def timed(f, *args) -> tuple[float, float]:
    """Seconds of the first call beyond a run (compilation), and the median of five runs."""
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        jax.block_until_ready(f(*args))
        seconds.append(time.perf_counter() - start)
    run = float(np.median(seconds[1:]))
    return seconds[0] - run, run


def main() -> None:
    """Print the table."""
    plant = designs.competition("pendubot")
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}, {jax.device_count()} device(s)")
    print(f"{'':44s}{'compile [s]':>12s}{'run [s]':>10s}")

    for width in (64, 256):
        policy = random_policy(width)
        for batch in (1, 64, 1024):
            # Different starts: rollouts that are all the same would be computed once.
            starts = 0.1 * jax.random.normal(jax.random.key(1), (batch, 4))

            def scored(x0, policy=policy):
                return score_v2(performance(policy, Scenario(plant, x0=x0), jax.random.key(0)))

            compile_time, seconds = timed(jax.jit(jax.vmap(scored)), starts)
            print(
                f"{f'{batch} scored rollouts of 10 s, 2x{width}':44s}{compile_time:12.2f}"
                f"{seconds:10.3f}  ({batch * 10 / seconds:,.0f} x real time)"
            )

    config = sac.SACConfig(warmup_steps=0)
    state = sac.init(config, jax.random.key(0))
    vector_steps = 250

    def chunk():
        nonlocal state  # its buffers are donated
        state, metrics = sac.train_chunk(config, state, vector_steps)
        return metrics

    compile_time, seconds = timed(chunk)
    updates = vector_steps * config.updates_per_step / seconds
    steps = vector_steps * config.num_envs / seconds
    name = f"SAC: {vector_steps} vector steps, 2x128"
    speed = f"({updates:,.0f} updates/s, {steps:,.0f} steps/s)"
    print(f"{name:44s}{compile_time:12.2f}{seconds:10.3f}  {speed}")

    for scenarios in (0, 16):
        config = snes.SNESConfig(action_noise=0.0, scenarios=scenarios)
        policy = random_policy(64)
        start = snes.init(config, policy, jax.random.key(0))
        evolve = lambda s, c=config, p=policy: snes.evolve(c, p, s, 2)[1]  # noqa: E731
        compile_time, seconds = timed(evolve, start)
        name = f"SNES: a generation of 40, {scenarios} scenarios, 2x64"
        print(f"{name:44s}{compile_time:12.2f}{seconds / 2:10.3f}")


if __name__ == "__main__":
    main()
