"""Time the parts of the main job on this machine: rollouts, MPC, SAC, SNES.

    python experiments/bench.py            # or: make bench
    python experiments/bench.py --parts mpc
    python experiments/bench.py --parts seeds

Compile and run times are given apart; every figure is the median of five runs, of MPC one run.
The processor's seconds, of all cores together, are what a busy machine does not change.
"""

import argparse
import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxpend import Scenario, designs, sac, snes
from jaxpend.boards import v2
from jaxpend.config import Objective, TrainRun
from jaxpend.config_files import load_config
from jaxpend.controllers import Policy
from jaxpend.controllers.catalogue import build
from jaxpend.observation import Observation
from jaxpend.sac.stage import SAC
from jaxpend.score import performance
from jaxpend.snes import SNES


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


def timed(f, *args, runs: int = 5) -> tuple[float, float, float]:
    """Seconds of the first call beyond a run (compilation); medians of a run and its processor."""
    seconds = []
    for _ in range(1 + runs):
        start = time.perf_counter(), time.process_time()
        jax.block_until_ready(f(*args))
        seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    run, processor = np.median(seconds[1:], axis=0)
    return seconds[0][0] - run, run, processor


def show(name: str, times: tuple[float, float, float], speed: str = "") -> None:
    """A line of the table."""
    numbers = "{:12.2f}{:10.3f}{:15.3f}".format(*times)
    print(f"{name:44s}{numbers}  {speed}".rstrip(), flush=True)


def bench_seeds(count: int = 4) -> None:
    """What a vmap over seeds brings, in the recipe of the pendubot."""
    recipe = load_config(TrainRun(), "pendubot")
    # Imitation is not timed: a few demonstrations will do.
    shown = dataclasses.replace(recipe.sac.demonstrations, episodes=20, updates=1)
    config = dataclasses.replace(recipe.sac, demonstrations=shown, eval_every=3200)
    task = v2(recipe.robot).task
    search = SNES(dataclasses.replace(recipe.snes, chunk=2), random_policy(64), task)
    agent, training = sac.Agent(config, task), SAC(config, task)
    keys = [jax.random.key(seed) for seed in range(count)]
    parts = {
        "SAC": (training, [sac.init(agent, key) for key in keys]),
        "SNES": (search, [search.start(seed, random_policy(64)) for seed in range(count)]),
    }

    def one_after_another(stage, states):
        return [stage.advance([state]) for state in states]

    for name, (stage, states) in parts.items():
        alone = timed(one_after_another, stage, states)
        together = timed(stage.advance, states)
        show(f"{name}: a chunk of {count} seeds, one after another", alone)
        speed = f"({alone[1] / together[1]:.2f} x as fast)"
        show(f"{name}: a chunk of {count} seeds, vmap", together, speed)


def rollouts(controller, robot: str, name: str, batches, runs: int = 5) -> None:
    """Scored rollouts of 10 s in batches."""
    task = v2(robot).task
    for batch in batches:
        # Different starts: rollouts that are all the same would be computed once.
        starts = 0.01 * jax.random.normal(jax.random.key(1), (batch, 4))

        def scored(x0):
            scenario = Scenario(task.plant, x0=x0)
            return task.score(performance(controller, scenario, jax.random.key(0), task))

        times = timed(jax.jit(jax.vmap(scored)), starts, runs=runs)
        speed = f"({batch * 10 / times[1]:,.1f} x real time)"
        show(f"{batch} scored rollouts of 10 s, {name}", times, speed)


def bench_rollouts() -> None:
    """Networks of two widths."""
    for width in (64, 256):
        rollouts(random_policy(width), "pendubot", f"2x{width}", (1, 64, 1024))


def bench_mpc() -> None:
    """Both kinds of MPC on both robots: 5000 steps at 500 Hz."""
    for robot in designs.ROBOTS:
        for name in ("mpc", "mpc_free"):
            controller = build(name, designs.competition(robot), robot)
            rollouts(controller, robot, f"{name}, {robot}", (1, 64), runs=1)


def bench_sac() -> None:
    """Updates and steps of SAC."""
    config = sac.SACConfig(warmup_steps=0)
    agent = sac.Agent(config, v2("pendubot").task)
    state = sac.init(agent, jax.random.key(0))
    vector_steps = 250

    def chunk():
        nonlocal state
        state, metrics = sac.train_chunk(agent, state, vector_steps)
        return metrics

    times = timed(chunk)
    updates = vector_steps * config.updates_per_step / times[1]
    steps = vector_steps * config.num_envs / times[1]
    speed = f"({updates:,.0f} updates/s, {steps:,.0f} steps/s)"
    show(f"SAC: {vector_steps} vector steps, 2x128", times, speed)


def bench_snes() -> None:
    """A generation without and with imperfect scenarios."""
    for scenarios in (0, 16):
        objective = Objective(0.5 if scenarios else 0.0)
        config = snes.SNESConfig(action_noise=0.0, scenarios=scenarios, objective=objective)
        policy = random_policy(64)
        start = snes.init(config, policy, jax.random.key(0))
        compile_time, run, processor = timed(snes.evolve, config, policy, start, 2)
        times = compile_time, run / 2, processor / 2
        show(f"SNES: a generation of 40, {scenarios} scenarios, 2x64", times)


PARTS = {
    "rollouts": bench_rollouts, "mpc": bench_mpc, "sac": bench_sac, "snes": bench_snes,
    "seeds": bench_seeds,
}  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    quick = [name for name in PARTS if name not in ("mpc", "seeds")]
    parser.add_argument("--parts", nargs="+", default=quick, choices=PARTS)
    parts = parser.parse_args().parts
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}, {jax.device_count()} device(s)")
    print(f"{'':44s}{'compile [s]':>12s}{'run [s]':>10s}{'processor [s]':>15s}")
    for name in parts:
        PARTS[name]()


if __name__ == "__main__":
    main()
