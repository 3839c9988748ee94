"""The whole job: SAC on the surrogate reward, then SNES on the official score, in a run folder."""

import math
import time

import jax

from . import sac, snes
from .config import Run, SACConfig, SNESConfig, SNESRun
from .controllers.policy import Policy, load_policy
from .errors import JaxpendError
from .interrupt import Stopped, deferred, stop_if_asked
from .runs import RunFolder
from .score import nominal, official, score_v2
from .terminal import LiveProgress, console, score_table

__all__ = ["execute", "train", "train_sac", "train_snes"]


def train_sac(config: SACConfig, seed: int, folder: RunFolder) -> Policy:
    """Train SAC; returns the policy with the best official score, and leaves it and the last one.

    ``sac_best.npz`` is on disk from the start, so that an interrupt loses nothing.

    Raises:
        JaxpendError: training diverged; the best policy so far stays on disk.
    """
    steps = max(config.eval_every // config.num_envs, 1)
    imitates = "imitating demonstrations, " if config.demonstrations.episodes else ""
    with LiveProgress("SAC", config.steps, f"{imitates}compiling ...") as progress:
        state = sac.init(config, jax.random.key(seed))
        best = sac.greedy_policy(config, state)
        best_score = float(score_v2(nominal(best, best.robot)))
        folder.log("sac", env_steps=0, updates=0, score=best_score)
        folder.save("sac_best.npz", best, stage="sac", env_steps=0, seed=seed)
        while int(state.env_steps) < config.steps:
            stop_if_asked()
            state, metrics = sac.train_chunk(config, state, steps)
            policy = sac.greedy_policy(config, state)
            c = nominal(policy, policy.robot)
            env_steps, score = int(state.env_steps), float(score_v2(c))
            counts = {"env_steps": env_steps, "updates": int(state.updates)}
            folder.log("sac", **counts, score=score, uptime=c.uptime, **metrics)
            if not all(math.isfinite(float(v)) for v in metrics.values()):
                raise JaxpendError(
                    f"SAC diverged after {env_steps:,} steps; the best policy before that is "
                    f"{folder.path}/sac_best.npz; a lower sac.learning-rate may help"
                )
            # Ties happen before the first success: the later policy has learned more.
            if score >= best_score:
                best, best_score = policy, score
                folder.save("sac_best.npz", policy, stage="sac", env_steps=env_steps, seed=seed)
            folder.save("sac_last.npz", policy, stage="sac", env_steps=env_steps, seed=seed)
            note = f"reward {float(metrics['reward']):.2f}  score {score:.3f}"
            progress.report(min(env_steps, config.steps), f"{note}  best {best_score:.3f}")
    return best


def train_snes(config: SNESConfig, start: Policy, seed: int, folder: RunFolder) -> Policy:
    """Fine-tune a policy by SNES; returns the best seen by the official score, the start included.

    Candidates are, at every report, the mean policy and the best individual so far, both scored
    without noise and, for ``metrics.jsonl``, on fresh noise. ``snes_best.npz`` is on disk from
    the start.
    """
    key_init, key_fresh = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1))
    state = snes.init(config, start, key_init)
    fresh_fitness = jax.jit(lambda policy, key: snes.fitness(config, policy, key)[0])
    best, best_score, done = start, float(score_v2(nominal(start, start.robot))), 0
    folder.save("snes_best.npz", best, stage="snes", generation=0, seed=seed)
    with LiveProgress("SNES", config.generations) as progress:
        while done < config.generations:
            stop_if_asked()
            count = min(config.chunk, config.generations - done)
            state, metrics = snes.evolve(config, start, state, count)
            done += count
            key_fresh, key_now = jax.random.split(key_fresh)
            row = {name: values[-1] for name, values in metrics.items()}
            candidates = {
                "mean": snes.mean_controller(config, start, state),
                "individual": snes.best_controller(config, start, state),
            }
            for name, policy in candidates.items():
                score = float(score_v2(nominal(policy, policy.robot)))
                row[f"{name}_score"] = score
                row[f"{name}_fresh_fitness"] = fresh_fitness(policy, key_now)
                if score > best_score:
                    best, best_score = policy, score
                    folder.save("snes_best.npz", policy, stage="snes", generation=done, seed=seed)
            folder.save(
                "snes_last.npz", candidates["mean"], stage="snes", generation=done, seed=seed
            )
            folder.log("snes", generation=done, diverged=int(state.diverged), **row)
            note = f"fitness {float(row['mean_fitness']):.3f}  mean {row['mean_score']:.4f}"
            progress.report(done, f"{note}  best {best_score:.4f}")
    return best


def train(config: Run, command: str = "jaxpend.train.train") -> dict:
    """The stages that the configuration has; returns what ``result.json`` in its folder says.

    ``command`` goes into the policy files, to say what made them. The score of each stage is the
    official one, computed in float64.
    """
    policy = None
    if isinstance(config, SNESRun):  # before the folder is made: a wrong file leaves nothing behind
        policy = load_policy(config.policy or config.robot, robot=config.robot)
    folder = RunFolder(config.folder, config, command)
    result = {"robot": config.robot, "seed": config.seed}
    if policy is not None:
        result["start"] = official(policy, config.robot)
    try:
        with deferred():
            for name, stage in {"sac": train_sac, "snes": train_snes}.items():
                if not hasattr(config, name):
                    continue
                started = time.perf_counter()
                before = () if name == "sac" else (policy,)
                policy = stage(getattr(config, name), *before, config.seed, folder)
                seconds = round(time.perf_counter() - started, 1)
                result[name] = official(policy, config.robot) | {"seconds": seconds}
                result["score"] = result[name]["score"]
    except Stopped as stop:
        text = f"stopped; the best policies so far are in {folder.path}"
        raise Stopped(stop.signum, text) from None
    folder.save("policy.npz", policy, seed=config.seed, score=result["score"])
    folder.write_json("result.json", result)
    return result


def execute(config: Run, command: str) -> None:
    """``train``, the score table, and where the results are."""
    result = train(config, command)
    stages = {"start": "start", "sac": "after SAC", "snes": "after SNES"}
    score_table({stages[k]: result[k] for k in stages if k in result}, config.robot)
    console.print(f"policy.npz, metrics and result are in [bold]{config.folder}[/bold]")


if __name__ == "__main__":
    from .cli import main

    main("train")
