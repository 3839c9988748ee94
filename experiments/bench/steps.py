"""Steps of the learning environment, beside the same physics in numpy and gymnax's acrobot.

    python experiments/bench/steps.py

Ours has observation, reward and state of an episode in it, numpy's the physics alone. Gymnax has
another acrobot, whose step is as long.
"""

import jax
import jax.numpy as jnp
import measure
import numpy as np

from jaxpend.boards import v2
from jaxpend.config import EnvConfig
from jaxpend.env import Env


def ours(n: int, steps: int) -> measure.Way:
    """A scan over vmapped steps."""
    env = Env(EnvConfig(), v2("pendubot").task)
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), n))
    actions = jax.random.uniform(jax.random.key(1), (n,), minval=-1.0)

    @jax.jit
    def run(state):
        def step(state, _):
            after = jax.vmap(env.step)(state, actions)
            return after, after.reward.mean()

        return jax.lax.scan(step, state, length=steps)

    return measure.Way("jaxpend", lambda: run(start), n * steps)


def in_numpy(n: int, steps: int) -> measure.Way:
    """A loop over steps of a batch."""
    step, rng = measure.numpy_rk4(), np.random.default_rng(0)
    u = rng.uniform(-3, 3, n).astype("f4")

    def run():
        x = np.zeros((4, n), "f4")
        for _ in range(steps):
            x = step(x, u, 0.01)
        return x

    return measure.Way("numpy, physics alone", run, n * steps)


def in_gymnax(n: int, steps: int) -> list[measure.Way]:
    """Gymnax's acrobot in a scan, where it is installed."""
    try:
        import gymnax
    except ImportError:
        print("without gymnax: pip install 'jaxpend[bench]'")
        return []
    env, params = gymnax.make("Acrobot-v1")
    _, start = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(0), n), params)
    keys, actions = jax.random.split(jax.random.key(1), n), jnp.ones(n, jnp.int32)

    @jax.jit
    def run(state):
        def step(state, _):
            found = jax.vmap(env.step, (0, 0, 0, None))(keys, state, actions, params)
            return found[1], found[2].mean()

        return jax.lax.scan(step, state, length=steps)

    return [measure.Way("gymnax, its own acrobot", lambda: run(start), n * steps)]


def main() -> list[dict]:
    """128 and 16 384 environments."""
    rows = []
    for n, steps in ((128, 20_000), (16_384, 200)):
        fewer = max(steps // 10, 20)
        ways = [ours(n, steps), in_numpy(n, fewer), *in_gymnax(n, fewer)]
        rows += measure.compared(f"{n} environments", "steps", ways)
    return rows


if __name__ == "__main__":
    measure.script(main, __doc__)
