"""Both kinds of MPC: rollouts of 10 s at 500 Hz, beside real time.

python experiments/bench/mpc.py
"""

import functools

import jax
import measure

from jaxpend import Scenario, final_state
from jaxpend.boards import v2
from jaxpend.controllers.catalogue import build

RUNS = 64


def main() -> list[dict]:
    """One rollout, and 64 of them in a vmap: seconds of a run for each of the processor's."""
    rows = []
    for robot in ("acrobot", "pendubot"):
        plant, ways = v2(robot).task.plant, []
        starts = 0.01 * jax.random.normal(jax.random.key(1), (RUNS, 4))
        for name in ("mpc", "mpc_free"):
            controller = build(name, plant, robot)

            def one(x0, controller=controller, plant=plant):
                return final_state(Scenario(plant, x0), controller, jax.random.key(0))

            alone, batch = jax.jit(one), jax.jit(jax.vmap(one))
            ways.append(measure.Way(name, functools.partial(alone, starts[0]), 10))
            ways.append(
                measure.Way(f"{name}, {RUNS} at once", functools.partial(batch, starts), 10 * RUNS)
            )
        rows += measure.compared(f"MPC, {robot}", "seconds simulated", ways, 1)
    return rows


if __name__ == "__main__":
    measure.script(main, __doc__)
