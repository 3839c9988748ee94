"""Train SAC of Stable-Baselines3 on the Gymnasium environment; the policy file is one of ours.

    pip install 'jaxpend[sb3]'
    python experiments/sb3.py --robot pendubot
    jaxpend score --robot pendubot --policy runs/sb3/pendubot-seed0.npz

Environment and hyperparameters are those of the recipe `plain`. It writes experiments/sb3.json,
and in runs/sb3 the zip of the library and the policy of the best score so far as a policy file.
"""

import argparse
import importlib.metadata
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxpend import save_policy
from jaxpend.config import TrainRun
from jaxpend.config_files import load_config, to_mapping
from jaxpend.designs import ROBOTS
from jaxpend.files import write_atomically
from jaxpend.interop import stable_baselines3 as models
from jaxpend.score import official

try:
    import gymnasium
    import torch
    from stable_baselines3 import SAC
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    sys.exit("this needs the package stable-baselines3: pip install 'jaxpend[sb3]'")

from jaxpend.interop.gymnasium import NAMES

HERE = Path(__file__).parent
NAMED = ("stable-baselines3", "gymnasium", "torch", "jax")


class Environments(VecEnv):
    """The vector environment as Stable-Baselines3 wants it: all of them step in one call."""

    def __init__(self, envs: gymnasium.vector.VectorEnv, reward_scale: float):
        self.envs, self.scale = envs, reward_scale
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self):
        """Observations (num_envs, obs_size)."""
        return self.envs.reset(seed=self._seeds[0])[0]

    def step_async(self, actions):
        """Keep the actions for ``step_wait``, which takes the step."""
        self.actions = actions

    def step_wait(self):
        """Observations, rewards, whether episodes are over, and an info each."""
        obs, reward, _, over, infos = self.envs.step(self.actions)
        each = [{"TimeLimit.truncated": bool(o)} for o in over]
        for i in np.flatnonzero(over):
            each[i]["terminal_observation"] = infos["final_obs"][i]
        return obs, self.scale * reward, over, each

    def close(self):
        """Close them."""
        self.envs.close()

    def get_attr(self, attr_name, indices=None):
        """The attribute of the vector environment, once for every environment."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name, value, indices=None):
        """Set an attribute of the vector environment, which all environments share."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name, *args, indices=None, **kwargs):
        """Environments inside the vector environment have no methods to call."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        """No environment inside the vector environment is wrapped."""
        return [False] * len(list(self._get_indices(indices)))


def learner(robot: str, seed: int, recipe) -> SAC:
    """SAC with the hyperparameters of the recipe, as many updates a step of an environment."""
    each = recipe.num_envs // recipe.updates_per_step  # steps an update
    envs = gymnasium.make_vec(NAMES[robot], num_envs=each, **to_mapping(recipe.env))
    network = {"pi": list(recipe.actor_hidden), "qf": list(recipe.critic_hidden)}
    return SAC(
        "MlpPolicy", Environments(envs, recipe.reward_scale), seed=seed, device="cpu",
        learning_rate=recipe.learning_rate, gamma=recipe.discount, tau=recipe.target_rate,
        batch_size=recipe.batch_size, buffer_size=recipe.replay_capacity,
        learning_starts=recipe.warmup_steps, train_freq=1, gradient_steps=1,
        ent_coef=f"auto_{recipe.init_temperature}", target_entropy=recipe.target_entropy,
        policy_kwargs={"net_arch": network},
    )  # fmt: skip


def train(robot: str, seed: int, steps: int, chunk: int, folder: Path) -> Iterator[dict]:
    """One run: its row of the file after every chunk. The best policy of all is kept."""
    recipe = load_config(TrainRun(robot=robot), "plain").sac
    env = recipe.env
    seen = models.Convention(
        observation=env.observation.kind,
        max_velocity=env.observation.max_velocity,
        torque_limit=env.torque_limit,
    )
    model, best, curve, begun = learner(robot, seed, recipe), -1.0, [], time.time()
    path = folder / f"{robot}-seed{seed}.zip"
    folder.mkdir(parents=True, exist_ok=True)
    while model.num_timesteps < steps:
        model.learn(chunk, reset_num_timesteps=False)
        model.save(path)
        policy = models.read_model(path, robot, seen).policy.replace(control_dt=env.dt)
        score = official(policy, robot)["score"]
        curve.append(round(score, 4))
        print(f"{robot}, seed {seed}: {model.num_timesteps:,} steps, score {score:.4f}", flush=True)
        if score > best:
            best, about = score, {"command": "python experiments/sb3.py", "score": score}
            save_policy(path.with_suffix(".npz"), policy, about)
        yield {
            "robot": robot, "seed": seed, "steps": model.num_timesteps, "score": best,
            "curve": curve,
            "seconds": round(time.time() - begun),
            "versions": {name: importlib.metadata.version(name) for name in NAMED},
        }  # fmt: skip


def main() -> None:
    """Train, and write the row among those of other robots and seeds."""
    torch.set_num_threads(1)  # the networks are small
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", default="pendubot", choices=ROBOTS)
    parser.add_argument("--seed", type=int, default=0)
    steps = load_config(TrainRun(), "plain").sac.steps
    parser.add_argument("--steps", type=int, default=steps, help="environment steps")
    parser.add_argument("--chunk", type=int, default=64_000, help="steps between judgements")
    args = parser.parse_args()
    kept = HERE / "sb3.json"
    for row in train(args.robot, args.seed, args.steps, args.chunk, Path("runs/sb3")):
        rows = json.loads(kept.read_text()) if kept.exists() else []
        rows = [r for r in rows if (r["robot"], r["seed"]) != (args.robot, args.seed)] + [row]
        rows.sort(key=lambda r: (r["robot"], r["seed"]))
        write_atomically(kept, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
