"""Processor time until SAC of the pendubot scores 0.50, beside SBX where it is installed.

    python experiments/bench/learning.py

Ours is the SAC of ``make train``. SBX has the same environments, memory and random scenarios
included, and every setting of the recipe that it knows; it knows no distribution of the value, no
mirrored batches, no noise that lasts, no averaged actor, and its critics see what the policy sees.
Compiling counts, judgements do not. A row is of three seeds; one that does not get there within the
steps of the recipe counts with all of its time.
"""

import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import measure
import numpy as np
import optax

from jaxpend import sac
from jaxpend.boards import v2
from jaxpend.config import TrainRun
from jaxpend.config_files import load_config, to_mapping
from jaxpend.controllers import Policy
from jaxpend.score import official

ROBOT, GOAL, SEEDS = "pendubot", 0.50, 3
RECIPE = load_config(TrainRun(robot=ROBOT), ROBOT).sac


def now() -> np.ndarray:
    """Processor time and wall clock, s."""
    return np.array([time.process_time(), time.perf_counter()])


class Judge:
    """Adds up the time between judgements, and says when the goal is reached."""

    def __init__(self, name: str, seed: int):
        self.name, self.begun, self.seconds = f"{name}, seed {seed}", now(), np.zeros(2)

    def __call__(self, policy: Policy, steps: int) -> bool:
        """Whether a policy is good enough."""
        self.seconds += now() - self.begun
        score = official(policy, ROBOT)["score"]
        print(f"{self.name}: {steps:,} steps, {self.seconds[0]:.0f} s, {score:.3f}", flush=True)
        self.begun = now()
        return score >= GOAL


def ours(seed: int) -> np.ndarray:
    """Seconds of the recipe, (2,)."""
    agent, judge = sac.Agent(RECIPE, v2(ROBOT).task), Judge("jaxpend", seed)
    state = sac.init(agent, jax.random.key(seed))
    for steps in range(RECIPE.eval_every, RECIPE.steps + 1, RECIPE.eval_every):
        state, _ = sac.train_chunk(agent, state, RECIPE.eval_every // RECIPE.num_envs)
        jax.block_until_ready(state)
        if judge(sac.greedy_policy(agent, state), steps):
            break
    return judge.seconds


def theirs(seed: int) -> np.ndarray:
    """Seconds of SBX, (2,)."""
    import gymnasium
    import sbx
    from stable_baselines3.common.callbacks import BaseCallback

    sys.path.append(str(Path(__file__).parents[1]))
    from sb3 import Environments

    from jaxpend.interop.gymnasium import NAMES

    envs = gymnasium.make_vec(NAMES[ROBOT], num_envs=RECIPE.num_envs, **to_mapping(RECIPE.env))
    rate = optax.cosine_decay_schedule(RECIPE.learning_rate, 1, RECIPE.final_learning_rate)
    judge = Judge("SBX", seed)

    class Until(BaseCallback):
        def _on_step(self) -> bool:
            steps, model = self.num_timesteps, self.model
            if steps % RECIPE.eval_every:
                return True
            return not judge(policy_of(model.policy.actor_state.params["params"]), steps)

    model = sbx.SAC(
        "MlpPolicy", Environments(envs, RECIPE.reward_scale), seed=seed,
        learning_rate=lambda left: float(rate(1 - left)), gamma=RECIPE.discount,
        tau=RECIPE.target_rate, batch_size=RECIPE.batch_size, n_steps=RECIPE.n_step,
        buffer_size=RECIPE.replay_capacity, learning_starts=RECIPE.warmup_steps, train_freq=1,
        gradient_steps=RECIPE.updates_per_step, ent_coef=f"auto_{RECIPE.init_temperature}",
        target_entropy=RECIPE.target_entropy,
        policy_kwargs={
            "net_arch": {"pi": list(RECIPE.actor_hidden), "qf": list(RECIPE.critic_hidden)},
            "layer_norm": RECIPE.critic_layer_norm,
        },
    )  # fmt: skip
    model.learn(RECIPE.steps, callback=Until())
    return judge.seconds


def policy_of(params: Any) -> Policy:
    """The greedy policy of an actor of SBX: its layers, but for the last, which is its spread."""
    layers = [params[f"Dense_{number}"] for number in range(len(RECIPE.actor_hidden) + 1)]
    return Policy(
        tuple((jnp.asarray(d["kernel"]), jnp.asarray(d["bias"])) for d in layers),
        jnp.asarray(RECIPE.env.torque_limit, jnp.float32),
        robot=ROBOT, observation=RECIPE.env.observation, control_dt=RECIPE.env.dt,
    )  # fmt: skip


def main() -> list[dict]:
    """One row a library."""
    rows, ways = [], {"jaxpend": ours}
    try:
        import sbx  # noqa: F401

        ways["SBX"] = theirs
    except ImportError:
        print("without sbx: pip install 'jaxpend[bench]'")
    for way, seconds in ways.items():
        found = np.array([seconds(seed) for seed in range(SEEDS)])
        processor, wall = np.median(found, axis=0)
        row = {"part": f"SAC to {GOAL:.2f}, {SEEDS} seeds", "way": way, "unit": "runs"}
        row |= {"speed": 1 / processor, "compile": None, "wall": wall, "processor": processor}
        low, high = found[:, 0].min(), found[:, 0].max()
        rows.append(row | {"low": low, "high": high, "repeats": SEEDS})
    return rows


if __name__ == "__main__":
    measure.script(main, __doc__)
