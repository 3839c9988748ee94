"""The library, cell by cell: from a plant to a controller of your own, its score, and training.

    python experiments/tutorial.py [--short]

Run it as a script, or cell by cell (``# %%``) in an editor that knows such cells. It writes its
pictures to build/tutorial. ``--short`` does less of everything, in less than a minute.
"""

# %% What this tutorial needs
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxpend import Scenario, load_policy, rollout, sac, save_policy, snes
from jaxpend.boards import v2
from jaxpend.config import SACConfig, SNESConfig
from jaxpend.controllers import guard, load_reference, lqr
from jaxpend.controllers.catalogue import build
from jaxpend.controllers.search_space import FACTOR
from jaxpend.plant import UPRIGHT, deviation, dynamics, forward_kinematics, total_energy
from jaxpend.pytree import pytree
from jaxpend.robustness import CRITERIA, benchmark
from jaxpend.score import official
from jaxpend.stepping import Stepper
from jaxpend.sweep import survey

SHORT = "--short" in sys.argv
OUT = Path("build/tutorial")

# %% A task is a robot, its plant, a time grid and a score
# The pendubot of the v2 board: the motor is in the shoulder (joint 0) and gives at most 6 N m; a
# run has 10 s at 500 Hz. The state is [theta1, theta2, omega1, omega2] in rad and rad/s.
board = v2("pendubot")
task, plant = board.task, board.task.plant
hanging, upright = jnp.zeros(4), jnp.array(UPRIGHT)
print(f"links of {plant.length[0]:.2f} and {plant.length[1]:.2f} m, motor at joint {task.joint}")
rise = total_energy(plant, upright) - total_energy(plant, hanging)
print(f"upright needs {rise:.2f} J more than hanging; the torque limit is {task.torque_limit} N m")
print("acceleration at 1 N m:", dynamics(plant, hanging, jnp.array([1.0, 0.0]))[2:], "rad/s²")


# %% A controller of your own
# It plays the torques of an optimised swing-up, and then balances by a linear law. ``reset`` gives
# its memory at the start (here the number of the step), a call gives the new memory and a torque.
@pytree
class SwingAndHold:
    """The torques of a swing-up, then a linear law that holds the pendulum upright."""

    SEARCHED: ClassVar = {"gain": FACTOR}  # what SNES may change, by a factor

    torques: jax.Array  # (n, 2) N m, one a step of 2 ms
    gain: jax.Array  # (2, 4) N m per rad and rad/s

    def reset(self, key):
        return jnp.zeros((), int)

    def __call__(self, step, t, x):
        playing = self.torques[jnp.minimum(step, len(self.torques) - 1)]
        holding = -self.gain @ deviation(x, jnp.array(UPRIGHT))
        return step + 1, jnp.where(step < len(self.torques), playing, holding)


reference = load_reference("pendubot")  # the swing-up that ships with the package
torques = jax.vmap(reference.both)(reference.u[:750])  # of its first 1.5 s
mine = SwingAndHold(torques, lqr(plant, "pendubot").gain)

# %% A rollout: a controller, put into a scenario, gives a trajectory
run = jax.jit(rollout)(Scenario(plant), mine, jax.random.key(0))
print("state after 10 s:", np.round(run.x[-1], 3))

# %% From a loop of your own: a state in, a torque out, both numpy
# The loop of a robot knows nothing of jax. ``start`` gives an object that keeps the controller's
# memory and counts the time, 2 ms a call; ``reset`` begins a new run. ``Stepper`` does the same
# for a controller of your own.
stepper, own = load_policy("pendubot").start(), Stepper(mine)
measured = np.array([0.01, 0.0, 0.0, 0.0])
for _ in range(3):
    print("torques:", np.round(stepper.torque(measured), 3), np.round(own.torque(measured), 3))

# %% Its score: swing-up time, energy, torques and velocities in one number
for name, controller in {"the policy that ships": load_policy("pendubot"), "mine": mine}.items():
    result = official(controller, board)
    up = result["criteria"]["swingup_time"]
    print(f"{name}: v2 score {result['score']:.4f}, upright after {up:.2f} s")

# %% Its robustness: the official benchmark, 722 simulations
# What is drawn at random is repeated for every key; what is reported is the median over keys.
# Nothing corrects the swing-up, so that there is little robustness. The guard (an observer, and a
# rescue where the swing-up fails) helps any controller.
# The short form has three of the six criteria.
guarded = guard(mine, "pendubot")
grids = board.trials(plant)  # 15 rows of values; they can be others
if SHORT:
    some = [strip for strip in grids if strip.criterion in ("model", "delay", "perturbation")]
    grids = [replace(strip, values=strip.values[::5]) for strip in some]
reports = {
    name: benchmark(controller, board, jax.random.key(0), grids=grids, keys=1 if SHORT else 3)
    for name, controller in {"mine": mine, "guarded": guarded}.items()
}
print(f"{'robustness [%]':22s}" + "".join(f"{name:>10s}" for name in reports))
for name in reports["mine"].scores:
    cells = (f"{100 * report.scores[name]:10.1f}" for report in reports.values())
    print(f"{CRITERIA[name]:22s}" + "".join(cells))
print(f"{'Overall':22s}" + "".join(f"{100 * r.overall:10.1f}" for r in reports.values()))

# %% A sweep of your own: which masses of link 2, and which delays, does the guarded one bear?
count = 5 if SHORT else 21
values = {
    "m2": float(plant.mass[1]) * np.linspace(0.9, 1.1, count),  # kg
    "delay": np.linspace(0, 0.04, count),  # s, of what is measured
}
found = survey(plant, guarded, values, jax.random.key(1))
print("1: it stands after 10 s. A row for each mass, a column for each delay")
print(found.success.astype(int))

# %% SNES, an evolution strategy: what a controller declares in SEARCHED is improved
# The gain of ``mine`` leaves nothing to gain, so take a controller whose numbers were chosen by
# hand: energy shaping, with LQR at the top. A generation draws controllers around the mean of the
# search, here 5 % away, and moves the mean towards the better ones. With ``scenarios=8`` and
# ``objective=Objective(0.5)`` half of the fitness would be the mean score in random imperfect
# scenarios. The search does not know the controller that it started from, so that controller stays
# if the best one found is no better.
by_hand = build("energy_lqr", plant, "pendubot")
config = SNESConfig(generations=20 if SHORT else 60, population=12 if SHORT else 40)
search = snes.init(config, by_hand, jax.random.key(2))
search, history = snes.evolve(config, by_hand, search, config.generations, task)
print("best fitness so far:", np.round(np.maximum.accumulate(history["max_fitness"])[::5], 3))
best = snes.best_controller(config, by_hand, search)
before, after = (official(controller, board)["score"] for controller in (by_hand, best))
tuned = best if after > before else by_hand
print(f"energy shaping by hand: v2 score {before:.4f}; the best that SNES found: {after:.4f}")

# %% SAC: a policy learns from the reward alone
# This shows how it is called: its budget is far too small for a policy that swings up. All that
# stays the same is in the agent, all that changes in the state. A Python loop over chunks gives
# progress; jaxpend train adds checkpoints, the best policy and a folder for the run.
width = (32, 32) if SHORT else (256, 256)
agent = sac.Agent(
    SACConfig(
        num_envs=8 if SHORT else 16, actor_hidden=width, critic_hidden=width, warmup_steps=500
    ),
    task,
)
state = sac.init(agent, jax.random.key(3))
for _ in range(2 if SHORT else 20):
    state, metrics = sac.train_chunk(agent, state, vector_steps=50)
    print(f"{int(state.env_steps):,} steps, mean reward {float(metrics['reward']):.3f}")
learned = sac.greedy_policy(agent, state)
score = official(learned, board)["score"]
print(f"the score is {score:.4f}: so few steps teach it nothing yet; jaxpend train takes 2,400,000")
save_policy(OUT / "learned.npz", learned)  # load_policy reads it, and every command takes it

# %% Looking at it: charts draw on the axes they are given
from jaxpend.report import charts, figures  # noqa: E402  matplotlib, only where it is needed

t, x, u = (np.asarray(part) for part in (run.t, run.x, run.u))
points = jax.vmap(forward_kinematics, (None, 0))(plant, run.x)  # (n, 2, 2): elbow and tip, x and y
reach = float(plant.length.sum())
draws = [
    partial(charts.draw_angles, t=t, x=x, end=3),
    partial(charts.draw_torque, t=t, u=u, joint=task.joint, limit=task.torque_limit, end=3),
    partial(charts.draw_height, t=t, y=points[:, 1, 1], reach=reach, height=task.height, end=3),
]
figures.save(figures.stack(draws, size=(7, 2.4), title="mine"), OUT / "swingup.png")
print(f"wrote {OUT / 'swingup.png'}")
