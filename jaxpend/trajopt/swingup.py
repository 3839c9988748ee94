"""The swing-up as an optimisation problem: a smooth form of a task's v2 score, for ``ilqr``.

    z = (theta1, theta2, omega1, omega2, last torque),  u = torque of the driven joint

Sums over the horizon stand for the criteria of ``jaxpend.score``:

    swing-up time     sum dt sigmoid((line - y) / s_y), the time below the line
    energy            sum dt (sqrt((u omega)^2 + s_p^2) - s_p), |power| with its kink rounded
    torque cost       sum dt u^2
    torque smoothness sqrt(sum du^2 / samples), du the change per task.dt; the first torque is free
    velocity cost     sum dt |omega|^2

and the objective is the mean of ``tanh(pi c_i / n_i)`` plus a final cost that lands upright.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from ..criteria import ScoreV2
from ..errors import JaxpendError
from ..plant import Plant, forward_kinematics, joint_torque, rk4_step
from ..pytree import Pytree, pytree, static
from ..task import Task
from .ilqr import Problem

__all__ = ["SwingUp", "problem", "smooth_score", "step", "totals"]

CRITERIA = ("swingup_time", "energy", "tau_cost", "tau_smoothness", "velocity_cost")


@pytree
class SwingUp(Pytree):
    """Parameters of the problem; all arrays may carry a batch axis under ``jax.vmap``."""

    plant: Plant
    goal: Any  # (5,) final state and torque; theta2 may be any multiple of a turn
    final_weight: Any  # (5, 5) of the final cost; like the goal, not for totals
    line_width: Any  # () m, s_y
    power_width: Any  # () W, s_p
    task: Task = static()
    dt: float = static()

    @property
    def joint(self) -> int:
        """Index of the driven joint."""
        return self.task.joint


def step(p, z: jax.Array, u: jax.Array) -> jax.Array:
    """``z`` (5,) after one step of ``p.dt`` of ``p.plant`` under torque ``u`` of ``p.joint``."""
    torque = joint_torque(u, p.joint)
    return jnp.concatenate([rk4_step(p.plant, z[:4], torque, p.dt), u[None]])


def _features(p: SwingUp, k: jax.Array, z: jax.Array, u: jax.Array) -> jax.Array:
    line = p.task.height * jnp.sum(p.plant.length)
    below = jax.nn.sigmoid((line - forward_kinematics(p.plant, z[:4])[1, 1]) / p.line_width)
    power = jnp.sqrt((u * z[2 + p.joint]) ** 2 + p.power_width**2) - p.power_width
    change = jnp.where(k == 0, 0.0, u - z[4]) * (p.task.dt / p.dt)
    # A coarse step holds its torque for several official ones: each gets its share of the change.
    change_sum = change**2 * (p.dt / p.task.dt)
    speed = z[2] ** 2 + z[3] ** 2
    return jnp.stack([p.dt * below, p.dt * power, p.dt * u**2, change_sum, p.dt * speed])


def totals(p: SwingUp, x: jax.Array, u: jax.Array) -> jax.Array:
    """The sums of a run in steps of ``p.dt``, (5,), in the order of ``CRITERIA``.

    Args:
        p: only plant, widths, task and dt are looked at.
        x: (N + 1, 4) or (N, 4) states; one after the last torque is dropped.
        u: (N,) N m, torques of the driven joint.
    """
    z = jnp.concatenate([x[: len(u)], jnp.pad(u, (1, 0))[:-1, None]], axis=1)
    return jax.vmap(partial(_features, p))(jnp.arange(len(u)), z, u).sum(axis=0)


def smooth_score(p: SwingUp, totals: jax.Array) -> jax.Array:
    """Smooth form of the task's v2 score, of ``totals`` (5,); success is not asked for."""
    return 1 - _outer(p, totals)


def _outer(p: SwingUp, totals: jax.Array) -> jax.Array:
    smoothness = jnp.sqrt(totals[3] / p.task.steps + 1e-12)
    if not isinstance(p.task.scoring, ScoreV2):
        raise JaxpendError("only a task with a v2 score has a smooth form of it")
    official = dict(p.task.scoring.norms)
    norms = jnp.array([official[name] for name in CRITERIA], totals.dtype)
    return jnp.mean(jnp.tanh(jnp.pi * totals.at[3].set(smoothness) / norms))


def _final(p: SwingUp, z: jax.Array) -> jax.Array:
    error = z - p.goal
    return error @ p.final_weight @ error


def problem() -> Problem:
    """The swing-up as an ``ilqr.Problem`` whose ``params`` are a ``SwingUp``."""
    return Problem(step=step, features=_features, final=_final, outer=_outer)
