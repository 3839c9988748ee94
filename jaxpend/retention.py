"""What a policy does where it stands already, so that it still does it when it learns other things.

A squared distance to its own actions of before (Li and Hoiem, "Learning without forgetting",
2016), in random scenarios in which it ended upright, from some time on: the swing-up before is
free to change.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .controllers.policy import Policy
from .errors import JaxpendError
from .pytree import Pytree, pytree
from .rollout import Trajectory, rollout
from .task import Task

__all__ = ["Retained", "change", "check_time", "retained", "seen"]

SHOWN = 128  # scenarios in which the start is watched, for what is retained
EVERY = 0.04  # s, between the times that are kept
DRAWN = 1024  # of them that a step looks at
# Of those scenarios: no seed of a run, of a validation or of the benchmark.
SHOWN_SEED = 2**31 - 3


@pytree
class Retained(Pytree):
    """What a policy did in random scenarios, at n times."""

    obs: jax.Array  # (n, obs_size) what it saw
    action: jax.Array  # (n,) in [-1, 1]
    counts: jax.Array  # (n,) 1 where it ended upright, else 0


def check_time(after: float, task: Task, section: str) -> None:
    """Refuse a time, s, of a section of the configuration, after which nothing can be retained."""
    if after >= task.duration:
        text = f"{section}.retained_after is {after} s; it must be less than"
        raise JaxpendError(f"{text} the {task.duration:g} s of a run")


def seen(policy: Any, run: Trajectory, key: jax.Array) -> jax.Array:
    """What a policy saw at all steps of its run, (N, obs_size); ``key`` is that of ``rollout``.

    Of any other controller that can ``look``, too.
    """

    def step(carry, now):
        return policy(carry, *now)[0], policy.look(carry, *now)

    carry, times = policy.reset(jax.random.split(key)[1]), run.t[:-1]
    return jax.lax.scan(step, carry, (times, run.x_measured))[1]


@partial(jax.jit, static_argnames=("after", "task"))
def retained(policy: Policy, after: float, task: Task) -> Retained:
    """What a policy does in scenarios of a task after so many seconds."""
    key_scenarios, key_runs = jax.random.split(jax.random.key(SHOWN_SEED))
    scenarios = jax.vmap(task.sample)(jax.random.split(key_scenarios, SHOWN))
    first = round(after / task.dt)
    times = np.arange(first, task.steps, max(round(EVERY / task.dt), 1))

    def one(scenario, key):
        run = rollout(scenario, policy, key, dt=task.dt, duration=task.duration)
        counts = jnp.broadcast_to(task.stands(run.x, scenario.plant.length), times.shape)
        return seen(policy, run, key)[times], counts

    obs, counts = jax.vmap(one)(scenarios, jax.random.split(key_runs, SHOWN))
    obs = obs.reshape(-1, obs.shape[-1])
    return Retained(obs, jax.vmap(policy.greedy)(obs), counts.ravel().astype("f4"))


def change(policy: Policy, kept: Retained, key: jax.Array) -> jax.Array:
    """Mean squared distance () of a policy's actions to some of those that are retained."""
    some = jax.random.randint(key, (DRAWN,), 0, len(kept.action))
    kept = jax.tree.map(lambda leaf: leaf[some], kept)
    off = jax.vmap(policy.greedy)(kept.obs) - kept.action
    return jnp.sum(kept.counts * off**2) / jnp.maximum(kept.counts.sum(), 1)
