"""What devices send to each other in a generation of SNES and a step of SAC, from the programs.

    python experiments/bench/exchange.py

The programs are compiled for eight simulated devices and not run; the operations that exchange
something are in their text. What is inside a loop counts once a turn.
"""

import math
import os
import re

os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
)

import jax
import measure

from jaxpend import devices, sac, snes
from jaxpend.boards import v2
from jaxpend.config import SNESConfig

TASK, KEY = v2("pendubot").task, jax.random.key(0)
SIZES = {"pred": 1, "s32": 4, "u32": 4, "f32": 4, "s64": 8, "f64": 8}
EXCHANGE = re.compile(r"= (.*?) (all-reduce|all-gather|all-to-all|collective-permute)(?:-start)?\(")


def exchanged(text: str) -> dict[str, tuple[int, int]]:
    """Of a compiled program: how many operations of each kind there are, and their bytes."""
    found: dict[str, tuple[int, int]] = {}
    for shapes, kind in EXCHANGE.findall(text):
        size = sum(
            SIZES[dtype] * math.prod(int(n) for n in dims.split(",") if n)
            for dtype, dims in re.findall(r"(\w+)\[([\d,]*)\]", shapes)
        )
        count, before = found.get(kind, (0, 0))
        found[kind] = count + 1, before + size
    return found


def main() -> None:
    """Print a line for each program and kind of exchange."""
    policy = measure.network(64)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(policy.layers))
    with devices.together():
        for population in (40, 4096):
            config = SNESConfig(population=population, action_noise=0.0)
            state = devices.everywhere(snes.init(config, policy, KEY))
            program = snes.evolve.lower(config, policy, state, 1, TASK).compile()
            print(f"SNES, {population} of {parameters} parameters:", exchanged(program.as_text()))
        config = sac.SACConfig(num_envs=128, warmup_steps=0, replay_capacity=4096)
        agent = sac.Agent(config, TASK)
        state = devices.everywhere(sac.init(agent, KEY))
        weights = sum(leaf.size for leaf in jax.tree.leaves((state.actor, state.critic)))
        program = sac.train_chunk.lower(agent, state, 1).compile()
        print(f"SAC, {weights} parameters, 128 environments:", exchanged(program.as_text()))


if __name__ == "__main__":
    main()
