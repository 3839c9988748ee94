"""How much better than a policy the v3 board can be played: its ceiling, from below.

    python experiments/ceiling.py

After each reset of runs of the policy that ships, torques are added to the policy's own and
optimised by the gradient through the simulator for the time that the tip spends above the line in
the next ``HORIZON`` s, from several starts, the best of which counts. The policy stays in the
loop, so that the arm is caught. What that gains after a reset on the average, and from hanging at
the start, is what the score could be higher. Optima are local ones, so that the true ceiling may
be higher still. Prints a table in Markdown.
"""

import argparse
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxpend import load_policy, rollout
from jaxpend.boards import V3
from jaxpend.plant import rk4_step, tip_height
from jaxpend.score import official

DRAWS = 5  # runs of a minute, with 15 resets each
HORIZON = 2.5  # s
KNOT = 10  # steps of 2 ms in which an added torque is the same
STARTS, STEPS = 6, 250
SPREAD = 2.0  # N m, of the starts
RATE = 0.15  # N m, of Adam
CHUNK = 32  # states at a time


def after_resets(board, policy):
    """States (n, 4) in which resets leave the arm in runs of a policy."""
    states, run = [], jax.jit(partial(rollout, dt=board.task.dt, duration=board.task.duration))
    for seed in range(DRAWS):
        scenario = board.drawn(seed)
        ends = np.asarray(scenario.resets.first + scenario.resets.steps)
        states.append(np.asarray(run(scenario, policy, jax.random.key(0)).x)[ends])
    return np.concatenate(states)


def played(task, policy, x0, added):
    """Heights (n,), m, of a run from a state in which torques (knots,) are added."""
    plant = task.plant
    memory = policy.reset(jax.random.key(0))

    def step(carry, u):
        x, memory = carry
        memory, torque = policy(memory, jnp.zeros(()), x)
        torque = torque.at[task.joint].add(u)
        x = rk4_step(plant, x, jnp.clip(torque, -plant.torque_limit, plant.torque_limit), task.dt)
        return (x, memory), x

    _, x = jax.lax.scan(step, (x0, memory), jnp.repeat(added, KNOT))
    return tip_height(plant.length, x)


@partial(jax.jit, static_argnames="task")
def gained(task, policy, x0, key):
    """Time up (), s, of the policy alone, and with the best torques that were found."""
    line = task.height * jnp.sum(task.plant.length)
    knots = round(HORIZON / task.dt) // KNOT

    def soft(added, width):
        return jax.nn.sigmoid((played(task, policy, x0, added) - line) / width).mean()

    def up(added):
        return task.dt * jnp.sum(played(task, policy, x0, added) > line)

    optimizer = optax.adam(optax.cosine_decay_schedule(RATE, STEPS, 0.02))

    def climb(added):
        def step(carry, i):
            added, memory, best = carry
            width = 0.15 * (0.005 / 0.15) ** (i / STEPS)
            slope = jax.grad(soft)(added, width)
            slope = slope / (jnp.linalg.norm(slope) + 1e-8)
            move, memory = optimizer.update(-jnp.where(jnp.isfinite(slope), slope, 0.0), memory)
            return (added + move, memory, jnp.maximum(best, up(added))), None

        start = (added, optimizer.init(added), up(added))
        return jax.lax.scan(step, start, jnp.arange(STEPS))[0][-1]

    noise = SPREAD * jax.random.normal(key, (STARTS, knots // 5))
    starts = jnp.repeat(noise, 5, axis=1).at[0].set(0.0)
    starts = jnp.pad(starts, ((0, 0), (0, knots - starts.shape[1])))
    return up(jnp.zeros(knots)), jax.vmap(climb)(starts).max()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="+", choices=list(V3), default=list(V3))
    parser.add_argument("--policy", help="of one robot; by default the one that ships")
    args = parser.parse_args()
    print("| | score | lost after a reset | with the best torques | from hanging | ceiling |")
    print("|---|---|---|---|---|---|")
    for robot in args.robots:
        board = V3[robot]
        policy = load_policy(args.policy or f"global_{robot}")
        states = np.concatenate([np.zeros((1, 4), "f4"), after_resets(board, policy)])
        each = jax.jit(jax.vmap(partial(gained, board.task, policy)))
        found = []
        for first in range(0, len(states), CHUNK):
            rows = np.minimum(np.arange(first, first + CHUNK), len(states) - 1)
            keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(1)))(rows)
            found.append(np.stack(each(states[rows], keys), axis=1))
        before, after = (HORIZON - np.concatenate(found)[: len(states)]).T
        score = official(policy, board)["score"]
        ceiling = score + (15 * (before - after)[1:].mean() + (before - after)[0]) / 60
        error = 1.96 * (before - after)[1:].std() / (len(states) - 1) ** 0.5 * 15 / 60
        print(
            f"| {robot} | {score:.3f} | {before[1:].mean():.3f} s | {after[1:].mean():.3f} s "
            f"| {before[0]:.3f}, {after[0]:.3f} s | {ceiling:.3f} ± {error:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
