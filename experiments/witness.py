"""A second witness that environment and reward are right: rejax, not ours, learns on them.

    pip install rejax
    python experiments/witness.py --robot pendubot

trains SAC of rejax (pure JAX) with the environment and the hyperparameters of the recipe `plain`,
and writes experiments/witness.json; the policy goes to runs/witness/ROBOT-seedSEED.npz, which
every command takes. rejax has no truncation: to it an episode that is cut off has ended.
"""

import argparse
import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

# One thread, as the runs.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import jax.numpy as jnp

from jaxpend import Policy, save_policy
from jaxpend.boards import v2
from jaxpend.config import TrainRun
from jaxpend.config_files import load_config
from jaxpend.designs import ROBOTS
from jaxpend.env import Env, truncated
from jaxpend.files import write_atomically
from jaxpend.score import official

try:
    from gymnax.environments.spaces import Box
    from rejax import SAC
except ImportError:
    sys.exit("this needs the package rejax: pip install rejax")

HERE = Path(__file__).parent
NAMED = ("rejax", "gymnax", "jax")
SHARE = 0.5  # of the recipe's steps: the last half brings little


class Task:
    """The environment as rejax wants it, in the manner of gymnax; a state is (EnvState, steps)."""

    default_params = None

    def __init__(self, env: Env, scale: float):
        self.env, self.scale = env, scale

    def reset(self, key, _=None):
        """A new episode: what is seen of it, and its state."""
        state = self.env.reset(key)
        return state.obs, (state, jnp.zeros((), jnp.int32))

    def step(self, key, now, action, _=None):
        """One control period, and a new episode where one is over."""
        state, steps = self.env.step(now[0], action[0]), now[1] + 1
        over, reward = truncated(self.env.config, state, steps), self.scale * state.reward
        obs, fresh = self.reset(key)
        obs, now = jax.tree.map(
            lambda a, b: jnp.where(over, a, b), (obs, fresh), (state.obs, (state, steps))
        )
        return obs, now, reward, over, {}

    def action_space(self, _=None):
        """[-1, 1], as everywhere."""
        return Box(-1.0, 1.0, (1,))

    def observation_space(self, _=None):
        """Of what the policy sees."""
        return Box(-jnp.inf, jnp.inf, (self.env.config.observation.size,))


def policy_of(params, env: Env) -> Policy:
    """The mean action of rejax's squashed Gaussian as a policy."""
    net = params["params"]
    dense = [*(net["features"][name] for name in sorted(net["features"])), net["action_mean"]]
    return Policy(
        layers=tuple((d["kernel"], d["bias"]) for d in dense),
        torque_limit=jnp.asarray(env.config.torque_limit),
        robot=env.task.robot,
        observation=env.config.observation,
        control_dt=env.config.dt,
    )


def train(robot: str, seed: int, steps: int, chunk: int, path: Path) -> Iterator[dict]:
    """One run: its row of the file after every chunk. The best policy of all is kept."""
    recipe = load_config(TrainRun(robot=robot), "plain").sac
    env = Env(recipe.env, v2(robot).task)
    algorithm = SAC.create(
        env=Task(env, recipe.reward_scale),
        agent_kwargs={"activation": recipe.activation, "hidden_layer_sizes": recipe.actor_hidden},
        num_envs=recipe.num_envs, num_epochs=recipe.updates_per_step, buffer_size=400_000,
        fill_buffer=recipe.warmup_steps, batch_size=recipe.batch_size, gamma=recipe.discount,
        learning_rate=recipe.learning_rate,
        # Its targets move once a step of all environments, ours once an update.
        polyak=(1 - recipe.target_rate) ** recipe.updates_per_step,
        total_timesteps=chunk, eval_freq=chunk, skip_initial_evaluation=True,
    ).replace(eval_callback=lambda *_: ())  # fmt: skip
    advance = jax.jit(lambda state: algorithm.train(train_state=state)[0])
    state, best, curve, begun = algorithm.init_state(jax.random.key(seed)), -1.0, [], time.time()
    for k in range(1, steps // chunk + 1):
        state = advance(state)
        policy = policy_of(state.actor_ts.params, env)
        score = official(policy, robot)["score"]
        curve.append(round(score, 4))
        print(f"{robot}, seed {seed}: {k * chunk:,} steps, score {score:.4f}", flush=True)
        if score > best:
            best = score
            save_policy(path, policy, {"command": "python experiments/witness.py", "score": score})
        yield {
            "robot": robot, "seed": seed, "steps": k * chunk, "score": best, "curve": curve,
            "seconds": round(time.time() - begun),
            "versions": {name: importlib.metadata.version(name) for name in NAMED},
        }  # fmt: skip


def main() -> None:
    """Train, and write the row among those of other robots and seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", default="pendubot", choices=ROBOTS)
    parser.add_argument("--seed", type=int, default=0)
    steps = round(SHARE * load_config(TrainRun(), "plain").sac.steps)
    parser.add_argument("--steps", type=int, default=steps, help="environment steps")
    parser.add_argument("--chunk", type=int, default=64_000, help="steps between judgements")
    args = parser.parse_args()
    kept = HERE / "witness.json"
    policy = Path("runs/witness") / f"{args.robot}-seed{args.seed}.npz"
    for row in train(args.robot, args.seed, args.steps, args.chunk, policy):
        rows = json.loads(kept.read_text()) if kept.exists() else []
        rows = [r for r in rows if (r["robot"], r["seed"]) != (args.robot, args.seed)] + [row]
        rows.sort(key=lambda r: (r["robot"], r["seed"]))
        write_atomically(kept, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
