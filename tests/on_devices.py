"""What 1, 3 and 8 devices compute of the same rows: JSON. ``test_devices`` runs it in a process."""

import dataclasses
import json
import sys
from functools import partial
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from conftest import shipped_network, task_of

from jaxpend import devices, gradient, load_policy, shac, snes
from jaxpend.boards import BOARDS
from jaxpend.config import GradientConfig, Objective, SACConfig, SHACConfig, SNESConfig
from jaxpend.controller import Memoryless
from jaxpend.controllers.callback import realaigym
from jaxpend.controllers.search_space import FACTOR
from jaxpend.fleet import judge_fleet
from jaxpend.pytree import pytree
from jaxpend.runs.checkpoints import Checkpoints
from jaxpend.sac import algorithm
from jaxpend.sac.stage import SAC
from jaxpend.scenario import Scenario
from jaxpend.score import official
from jaxpend.sweep import compile_sweep, sweep
from jaxpend.variations import vary

KEY, TASK = jax.random.key(0), task_of("pendubot")
SMALL = SACConfig(
    num_envs=16, warmup_steps=64, batch_size=32, replay_capacity=512, steps=4096, eval_every=320,
    actor_hidden=(8,), critic_hidden=(8,),
)  # fmt: skip


class Counting:
    """A controller of RealAIGym with a memory: how often it was called."""

    def reset_(self):
        self.calls = 0

    def init_(self):
        pass

    def get_control_output_(self, x, t=None):
        self.calls += 1
        return [0.001 * self.calls, 0.0]


def swept(controller):
    """Final states of 11 plants, which 3 and 8 do not divide."""
    scenarios = vary(Scenario(TASK.plant), {"m2": np.linspace(0.6, 0.64, 11)}, key=KEY)
    compile_sweep(scenarios, controller, KEY, duration=1.0)
    return sweep(scenarios, controller, KEY, duration=1.0).x


@pytree
class Copying(Memoryless):
    """A controller that makes arrays like its own, and looks into them, as jax does."""

    SEARCHED: ClassVar = {"gain": FACTOR}
    gain: jax.Array  # (4,)

    def reset(self, key):
        return jnp.zeros_like(self.gain)

    def __call__(self, carry, t, x):
        error = jnp.full_like(self.gain, jnp.pi).at[1:].set(0.0) - x
        row = jnp.eye(2)[jnp.argmin(self.gain) // 4]
        return carry, (self.gain[jnp.argsort(self.gain)] @ error + carry.sum()) * row


def doors():
    """What a controller that copies its arrays is worth, wherever rows are split."""
    controller = Copying(jnp.array([3.0, 4.0, 5.0, 6.0]))
    board = BOARDS["hardware"]["pendubot"]
    still = dataclasses.replace(board.task.spread, pushes=0)
    board = dataclasses.replace(
        board, draws=3, task=dataclasses.replace(board.task, duration=3.0, spread=still)
    )
    random = {"scenarios": 3, "objective": Objective(weight=0.5)}
    search = SNESConfig(population=3, **random)
    state = snes.init(search, controller, KEY)
    evolve = partial(snes.evolve, search, generations=1, task=TASK)
    evolved, _ = devices.compute(evolve, controller, state)
    ascent = GradientConfig(duration=0.2, scenario_duration=0.2, **random)
    state = gradient.init(ascent, controller, KEY)
    climb = partial(gradient.improve, ascent, steps=2, task=TASK)
    climbed, _ = devices.compute(climb, controller, state)
    return [
        *swept(controller).ravel().tolist(), official(controller, board)["criteria"]["energy"],
        *judge_fleet(controller, board.task, KEY, robots=3).down.ravel().tolist(),
        *evolved.strategy.mean.tolist(), *climbed.parameters.tolist(),
    ]  # fmt: skip


def windows():
    """Two steps of the short-horizon actor-critic, with five arms, which 3 and 8 do not divide."""
    config = SHACConfig(
        steps=3, critic_steps=1, num_arms=5, window=0.05, critic_hidden=(8,), critic_updates=1
    )
    policy, task = load_policy("global_pendubot"), BOARDS["v3"]["pendubot"].task
    state = shac.init(config, policy, KEY, task)
    state, _ = devices.compute(partial(shac.improve, config, steps=2, task=task), policy, state)
    return [*state.parameters[:99].tolist(), *state.x.ravel().tolist()]


def split():
    """Sums over rows of a function that is split, within a vmap, a gradient and another split."""
    rows, weights = jnp.arange(11.0).reshape(11, 1), jnp.array([1.0, 2.0])

    def of_rows(weight, rows):
        def row(weight, x):
            inner = devices.split(jax.vmap(lambda y: jnp.sin(weight * y)))
            return {"sine": inner(x + jnp.arange(3.0)), "row": x[0]}

        return devices.split(jax.vmap(row, in_axes=(None, 0)), weight)(rows)

    def total(weight):
        return of_rows(weight, rows)["sine"].sum()

    order = devices.compute(jax.jit(of_rows), weights[0], rows)["row"]
    slopes = devices.compute(jax.jit(jax.vmap(jax.value_and_grad(total))), weights)
    return [*order.tolist(), *jnp.stack(slopes).ravel().tolist()]


def learned(folder):
    """SAC for a chunk, and from its checkpoint for another one on a single device."""
    stage, checkpoints = SAC(SMALL, TASK), Checkpoints(folder, 1)
    ((state, first),) = stage.advance([stage.start(0, None)])
    assert all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves((state, first)))
    checkpoints.save({"state": state}, {})
    state, _ = checkpoints.newest(lambda _: {"state": stage.like()})
    devices.use(1)
    ((_, second),) = stage.advance([state["state"]])
    return [float(row[name]) for row in (first, second) for name in ("reward", "critic_loss")]


def exchanged():
    """Whether the program of a chunk of SAC has devices send something to each other."""
    stage = SAC(SMALL, TASK)
    with devices.together():
        state = devices.everywhere(stage.start(0, None))
        return (
            "all-reduce" in algorithm.train_chunk.lower(stage.agent, state, 2).compile().as_text()
        )


def main(folder: Path) -> None:
    """Print what each number of devices gives."""
    found = {}
    for count in (1, 3, 8):
        devices.use(count)
        found[count] = {"split": split(), "sweep": swept(shipped_network()).tolist()}
        if count == 3:
            continue
        found[count] |= {
            "python": swept(realaigym(Counting())).tolist(),
            "doors": doors(),
            "windows": windows(),
            "exchanged": exchanged(),
            "sac": learned(folder / str(count)),
        }
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
