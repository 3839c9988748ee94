"""Updates of SAC, beside Stable-Baselines3 and SBX where they are installed.

    python experiments/bench/updates.py

Batches of 256, two hidden layers of 128, two critics. Ours collects as well, a step of 128
environments for four updates; the others update from a buffer that is full already.
"""

import jax
import measure

from jaxpend import sac
from jaxpend.boards import v2

UPDATES, BATCH, WIDTH = 1000, 256, 128


def ours() -> measure.Way:
    """A chunk of training."""
    config = sac.SACConfig(
        num_envs=128, updates_per_step=4, batch_size=BATCH, warmup_steps=0,
        actor_hidden=(WIDTH, WIDTH), critic_hidden=(WIDTH, WIDTH),
    )  # fmt: skip
    agent = sac.Agent(config, v2("pendubot").task)
    state = sac.init(agent, jax.random.key(0))
    return measure.Way(
        "jaxpend, with its steps", lambda: sac.train_chunk(agent, state, UPDATES // 4), UPDATES
    )


def theirs(name: str, package: str) -> list[measure.Way]:
    """The model of another library on our Gymnasium environment."""
    try:
        library = __import__(package)
        import gymnasium
    except ImportError:
        print(f"without {package}: pip install 'jaxpend[bench]'")
        return []
    import jaxpend.interop.gymnasium  # noqa: F401  registers the environments

    env = gymnasium.make("jaxpend/Pendubot-v0")
    shape = {"pi": [WIDTH, WIDTH], "qf": [WIDTH, WIDTH]}
    model = library.SAC(
        "MlpPolicy", env, batch_size=BATCH, learning_starts=100, seed=0,
        policy_kwargs={"net_arch": shape},
    )  # fmt: skip
    model.learn(1000)  # a buffer to draw from
    return [measure.Way(name, lambda: model.train(UPDATES // 5, BATCH), UPDATES // 5)]


def main() -> list[dict]:
    """All that there are."""
    ways = [ours()]
    ways += theirs("SBX, updates alone", "sbx")
    ways += theirs("Stable-Baselines3, updates alone", "stable_baselines3")
    return measure.compared("SAC, batches of 256, 2x128", "updates", ways)


if __name__ == "__main__":
    measure.script(main, __doc__)
