"""Controllers on every kind of real robot, and how many of the robots can be held at all.

    python experiments/fleet.py

prints tables in Markdown: the share of robots on which a controller stands, without and with
pushes, for each preset of ``jaxpend.hardware``; and the share that some linear feedback holds.
For that every robot starts near upright, and is tried with LQRs of three prices of torque, for
the nominal plant and for the robot itself, with and without its Coulomb friction in the
linearisation. A robot that none of them holds is one that no controller of this form, though it
knows the plant, holds either.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxpend import load_policy
from jaxpend.boards import HARDWARE
from jaxpend.controllers.catalogue import build
from jaxpend.controllers.lqr import lqr
from jaxpend.fleet import judge_fleet
from jaxpend.hardware import PRESETS
from jaxpend.plant import UPRIGHT
from jaxpend.rollout import rollout

ROBOTS, HELD = 500, 200
PRICES = (1.0, 10.0, 100.0)  # R of LQR, 1/(N m)^2
OFF = np.array([0.02, -0.02, 0.0, 0.0])  # rad, from upright
KEY = jax.random.key(0)


def controllers(robot):
    """Those to judge, by name."""
    plant = HARDWARE[robot].task.plant
    return {
        "policy for real robots": load_policy(f"hardware_{robot}"),
        "policy for v2": load_policy(robot),
        "energy shaping, LQR": build("energy_lqr", plant, robot),
        "TVLQR, guarded": build("tvlqr_guarded", plant, robot),
    }


def holdable(task):
    """Share of robots, without pushes, that one of the linear feedbacks holds near upright."""
    keys = jax.random.split(KEY, HELD)
    robots = jax.jit(jax.vmap(task.robot_of))(keys)
    robots = robots.replace(x0=jnp.broadcast_to(np.float32(UPRIGHT + OFF), (HELD, 4)))

    @jax.jit
    @jax.vmap
    def stands(robot, law, key):
        run = rollout(robot, law, key, dt=task.dt, duration=task.duration)
        return task.stands(run.x, robot.plant.length)

    plants = [jax.tree.map(lambda leaf, i=i: leaf[i], robots.plant) for i in range(HELD)]
    plants = [p.replace(torque_limit=task.plant.torque_limit) for p in plants]
    held = np.zeros(HELD, bool)
    for price in PRICES:
        for friction in (True, False):
            for known in ([task.plant], plants):
                if not friction:
                    known = [p.replace(coulomb_friction=None) for p in known]
                each = list(map(partial(lqr, robot=task.robot, r=price), known))
                each *= HELD // len(each)
                laws = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
                held |= np.asarray(stands(robots, laws, keys))
    return held.mean()


def main() -> None:
    """Print the tables."""
    for robot in HARDWARE:
        print("| | " + " | ".join(f"{p}, without | with pushes" for p in PRESETS) + " |")
        print("|---" * (1 + 2 * len(PRESETS)) + "|")
        tasks = [dataclasses.replace(HARDWARE[robot].task, spread=s) for s in PRESETS.values()]
        for name, controller in controllers(robot).items():
            found = [judge_fleet(controller, task, KEY, robots=ROBOTS).stands for task in tasks]
            shares = [f"{100 * share:.1f} %" for each in found for share in each.mean(axis=1)]
            print(f"| {robot}: {name} | {' | '.join(shares)} |", flush=True)
        shares = " | ".join(f"{100 * holdable(task):.1f} % |" for task in tasks)
        print(f"| {robot}: some LQR holds it near upright | {shares} |\n", flush=True)


if __name__ == "__main__":
    main()
