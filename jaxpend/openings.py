"""Openings: a policy tries other ways to begin its swing-up, and learns the ones that score best.

A search by small steps stays with the way of swinging up in which it begins, be it SAC or the
gradient. But a policy that swings up from anywhere need not begin as it does: after a constant
torque for the first moments it goes on by itself, and swings up in another way. ``explore`` tries
a grid of such openings in the nominal run, ``chosen`` takes the best of those that differ, and
``learn`` makes one the policy's habit: it imitates itself with the opening, on what it sees when
it tries to (DAgger: Ross, Gordon and Bagnell, "A reduction of imitation learning and structured
prediction to no-regret online learning", 2011), and keeps what it does where it stands
(``retention``).
"""

from functools import partial
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from . import devices
from .config import Objective, OpeningsConfig, Run, TrainRun
from .controller import Controller
from .controllers.policy import Policy
from .criteria import Criteria, ScoreV2
from .designs import active_joint
from .errors import JaxpendError
from .plant import joint_torque
from .pytree import Pytree, pytree
from .retention import change, check_time, retained, seen
from .rollout import rollout
from .scenario import Scenario
from .score import nominal, performance
from .stage import Candidates, Chart, Row, Stage, ranked
from .task import Task

__all__ = ["Opened", "Openings", "OpeningsConfig", "OpeningsState", "chosen", "explore", "learn"]

# Shares of the torque limit that are tried, and for which shares of the longest time.
SHARES = np.concatenate([np.linspace(-1, -0.1, 10), np.linspace(0.1, 1, 10)])
TIMES = np.linspace(0, 1, 25)[1:]
APART = 0.15  # s, by which the times of two swing-ups differ, if they are two ways
WATCHED = 17  # runs a round, the first of them without noise
NOISE = 2.0  # N m, standard deviation of the torque's noise in the last of them
AFTER = 0.6  # s, for which a run is watched after the longest opening
EVERY = 0.006  # s, between what is kept of it
BATCH = 1024
LEARNING_RATE = 1e-3


@pytree
class Opened(Pytree):
    """A policy, without noise, that begins with a constant torque and remembers that it did."""

    policy: Policy
    share: jax.Array  # () of the torque limit, in [-1, 1]
    until: jax.Array  # () s

    def reset(self, key: jax.Array) -> Any:
        """That of the policy."""
        return self.policy.reset(key)

    def look(self, carry: Any, t: jax.Array, x: jax.Array) -> jax.Array:
        """What the policy sees (``observation.size``,)."""
        return self.policy.look(carry, t, x)

    def action(self, t: jax.Array, obs: jax.Array) -> jax.Array:
        """The action () in [-1, 1] at time ``t`` for what is seen."""
        return jnp.where(t < self.until, self.share, self.policy.greedy(obs))

    def __call__(self, carry: Any, t: jax.Array, x: jax.Array) -> tuple[Any, jax.Array]:
        """Torque (2,), N m, zero on the passive joint."""
        key, memory = carry
        action = self.action(t, self.look(carry, t, x))
        if memory is not None:
            memory = memory.after(t, x, action)
        torque = joint_torque(self.policy.torque_limit * action, active_joint(self.policy.robot))
        return (key, memory), torque


def grid(config: OpeningsConfig) -> tuple[np.ndarray, np.ndarray]:
    """The openings that are tried: shares of the torque limit, and s, (n,) each."""
    shares, times = np.meshgrid(SHARES, config.longest * TIMES)
    return shares.ravel(), times.ravel()


@partial(jax.jit, static_argnames=("config", "task"))
def explore(config: OpeningsConfig, policy: Policy, task: Task) -> tuple[Criteria, jax.Array]:
    """Criteria and scores (n,) of the nominal runs of a policy with all openings of ``grid``.

    The scores are with the smoothness of the policy's own run: the sudden end of an opening is
    not what is learned.
    """
    key = jax.random.key(0)

    def run(policy, share, until):
        return performance(Opened(policy, share, until), task.plant, key, task)

    own = performance(policy, task.plant, key, task).tau_smoothness
    every = jax.vmap(run, in_axes=(None, 0, 0))
    c = devices.split(every, policy)(*map(jnp.asarray, grid(config)))
    return c, task.score(c.replace(tau_smoothness=jnp.broadcast_to(own, c.energy.shape)))


def chosen(times: np.ndarray, scores: np.ndarray, own: float, count: int) -> list[int]:
    """The numbers of the openings that are learned, the best first, at most so many.

    ``times`` (n,), s, and ``scores`` (n,) are those of their swing-ups, ``own`` the time of the
    policy's. Those without a score are left out, and those that swing up at the time of the
    policy or of a better one.
    """
    taken, found = [own], list[int]()
    for i in ranked(scores):
        if len(found) == count or not scores[i] > 0:
            break
        if all(abs(times[i] - other) >= APART for other in taken):
            taken.append(float(times[i]))
            found.append(i)
    return found


@partial(jax.jit, static_argnames=("config", "task"))
def learn(config: OpeningsConfig, opened: Opened, task: Task, key: jax.Array) -> Policy:
    """A policy that does by itself what ``opened`` does; ``key`` is consumed."""
    start, every = opened.policy, max(round(EVERY / task.dt), 1)
    kept = retained(start, config.retained_after, task)
    driven = np.eye(2)[task.joint]
    duration = config.longest + AFTER

    def watched(controller, key):
        """What is seen in runs under noise, and the actions that it ought to be answered with."""

        def one(noise, key):
            scenario = Scenario(task.plant, torque_noise=noise * driven)
            run = rollout(scenario, controller, key, dt=task.dt, duration=duration)
            obs = seen(controller, run, key)[::every]
            return obs, jax.vmap(opened.action)(run.t[:-1:every], obs)

        levels = jnp.linspace(0.0, NOISE, WATCHED)
        return jax.vmap(one)(levels, jax.random.split(key, WATCHED))

    def loss(layers, rows, key):
        policy, (obs, wanted) = start.replace(layers=layers), rows
        off = jax.vmap(policy.greedy)(obs) - wanted
        return jnp.mean(off**2) + config.retention * change(policy, kept, key)

    adam = optax.adam(LEARNING_RATE)

    def imitate(carry, turn):
        number, key = turn
        layers, memory, shown = carry
        rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[3:]), shown)

        def update(carry, key):
            layers, memory = carry
            key_rows, key_kept = jax.random.split(key)
            some = jax.random.randint(key_rows, (BATCH,), 0, len(rows[1]))
            slope = jax.grad(loss)(layers, jax.tree.map(lambda leaf: leaf[some], rows), key_kept)
            move, memory = adam.update(slope, memory)
            return (optax.apply_updates(layers, move), memory), None

        key_updates, key_runs = jax.random.split(key)
        keys = jax.random.split(key_updates, config.updates)
        (layers, memory), _ = jax.lax.scan(update, (layers, memory), keys)
        latest = watched(start.replace(layers=layers), key_runs)
        shown = jax.tree.map(lambda old, new: old.at[number].set(new), shown, latest)
        return (layers, memory, shown), None

    key_first, key = jax.random.split(key)
    shown = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (config.rounds, *leaf.shape)),
        watched(opened, key_first),
    )
    rounds = jnp.arange(1, config.rounds + 1) % config.rounds, jax.random.split(key, config.rounds)
    (layers, *_), _ = jax.lax.scan(imitate, (start.layers, adam.init(start.layers), shown), rounds)
    return start.replace(layers=layers)


@pytree
class OpeningsState(Pytree):
    """Policies and what they have learned; where that is nothing yet, one that does nothing."""

    policies: tuple[Policy, ...]  # with what each has learned behind it
    worths: jax.Array  # (policies,) what they are compared by; -inf before they are judged
    done: jax.Array  # () int, how many have tried
    key: jax.Array


class Openings(Stage[Any, OpeningsState, tuple[Controller, ...]]):
    """Every policy that goes on tries openings and learns some; they go on beside it."""

    name, title, unit, column = "openings", "Openings", "policies", "policies"
    heading, scores = "after openings", ("score",)
    charts = (Chart("Official score", {"best so far": "best", "learned": "score"}, "score"),)

    def __init__(
        self, config: OpeningsConfig, objective: Objective, policy: Any, task: Task, total: int
    ):
        """``policy`` is of the structure of the ``total`` ones that try.

        Raises ``JaxpendError`` for a task without a v2 score of the nominal plant, or whose runs
        are over before an opening is, or before anything is retained.
        """
        if task.chance or not isinstance(task.scoring, ScoreV2):
            text = "openings are compared by the v2 score of the nominal plant, and this task has"
            raise JaxpendError(f"{text} another; set openings.count to 0")
        if (most := task.duration - AFTER) < config.longest:
            text = f"openings.longest is {config.longest} s; it must be at most {most:g} s"
            raise JaxpendError(f"{text}, {AFTER} s less than a run")
        check_time(config.retained_after, task, "openings")
        self.config, self.objective, self.policy, self.task = config, objective, policy, task
        self.total = total

    @classmethod
    def of(cls, run: Run, start: Controller | None, task: Task) -> Self | None:
        if not (isinstance(run, TrainRun) and run.openings.count):
            return None
        return cls(run.openings, run.sac.objective, start, task, run.sac.contestants)

    def start(self, seed: int, before: Any) -> OpeningsState:
        before = before if isinstance(before, tuple) else (before,)
        nothing = before[0].replace(layers=jax.tree.map(jnp.zeros_like, before[0].layers))
        each = tuple(p for policy in before for p in (policy, *[nothing] * self.config.count))
        key = jax.random.fold_in(jax.random.key(seed), 4)
        return OpeningsState(each, jnp.full(len(each), -jnp.inf), jnp.asarray(0), key)

    def like(self) -> OpeningsState:
        return jax.eval_shape(partial(self.start, 0), (self.policy,) * self.total)

    def policy_like(self) -> Controller:
        return self.policy

    def done(self, state: OpeningsState) -> int:
        return int(state.done)

    def advance(self, states: list[OpeningsState]) -> list[tuple[OpeningsState, Row]]:
        return [self._tried(state) for state in states]

    def _tried(self, state: OpeningsState) -> tuple[OpeningsState, Row]:
        """One policy more has tried and learned."""
        first = self.done(state) * (1 + self.config.count)
        policies, worths = list(state.policies), np.array(state.worths)
        policy, key = policies[first], jax.random.fold_in(state.key, 0)
        score, worths[first] = self.compared(policy)
        c, scores = devices.compute(partial(explore, self.config, task=self.task), policy)
        own, times = float(nominal(policy, self.task).swingup_time), np.asarray(c.swingup_time)
        found = chosen(times, np.asarray(scores), own, self.config.count)
        row: Row = {"before": score, "learned": 0}
        for place, i in enumerate(found, first + 1):
            share, until = (values[i] for values in grid(self.config))
            opened = Opened(policy, jnp.asarray(share), jnp.asarray(until))
            learned = self.learned(opened, jax.random.fold_in(key, place))
            if not np.isfinite(ravel_pytree(learned.layers)[0]).all():
                continue  # it diverged
            policies[place], row["learned"] = learned, row["learned"] + 1
            after, worths[place] = self.compared(learned)
            if after > row.get("score", -1.0):
                row |= {"score": after, "found": float(scores[i])}
                row |= {"share": float(share), "until": float(until)}
        return state.replace(
            policies=tuple(policies), worths=jnp.asarray(worths), done=state.done + 1
        ), row

    def learned(self, opened: Opened, key: jax.Array) -> Policy:
        """``learn``, the same on all hosts."""
        return devices.compute(lambda o, k: learn(self.config, o, self.task, k), opened, key)

    def judge(self, state: OpeningsState, metrics: Row) -> tuple[Row, Candidates]:
        if not metrics:
            score, worth = self.compared(state.policies[0])
            return {"score": score}, [(state.policies[0], worth)]
        worths = [float(worth) for worth in state.worths]
        judged = [i for i in ranked(worths) if np.isfinite(worths[i])]
        return metrics, [(state.policies[i], worths[i]) for i in judged]

    def note(self, row: Row) -> str:
        if not row["learned"]:
            return f"score {row['before']:.3f}, no other way found"
        return (
            f"score {row['before']:.3f}, another way {row['found']:.3f}, learned {row['score']:.3f}"
        )

    def watched(self, state: OpeningsState) -> Any:
        return state.policies

    def rekey(self, state: OpeningsState, number: int) -> OpeningsState:
        return state.replace(key=jax.random.fold_in(jax.random.fold_in(state.key, 1), number))

    def outcome(self, state: OpeningsState, best: Controller) -> tuple[Controller, ...]:
        """All of them, the best first."""
        return tuple(state.policies[i] for i in ranked(state.worths))
