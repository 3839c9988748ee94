"""Resets by hand: the arm is taken again and again and pushed towards random angles.

This is the disturbance of the third AI Olympics (the v3 boards; https://ai-olympics.dfki-bremen.de).
In a reset a PID law with gravity compensation drives both joints for 0.2 s, and the controller is
not called. The state is never set: the arm is thrown, and seldom gets where it was meant to. All
constants are those of the board's reference implementation, its integral included, which uses
half the step and is never cleared.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .plant import Plant, gravity_vector, rk4_step
from .pytree import Pytree, pytree

__all__ = [
    "HOLD", "JITTER", "Hand", "Resets", "begun", "held", "official_resets", "push",
    "random_resets", "stamps", "thrown",
]  # fmt: skip

HOLD = 0.2  # s, that a reset lasts, and up to one step more
JITTER = 1.0  # s, to either side, of the times that resets begin at
PROPORTIONAL, INTEGRAL, DERIVATIVE = 10.0, 0.1, 1.0  # N m/rad, N m/(rad s), N m s/rad
STEP = 0.001  # s
LIMIT = 6.0  # N m, of the PID law; gravity compensation comes on top
# How often each joint is 0, 1 and 2 turns off in ``thrown``.
TURNS = ((0.95, 0.05, 0.0), (0.6, 0.35, 0.05))
_ROWS = 151  # of the states that the board draws, of which it uses one a reset


@pytree
class Resets(Pytree):
    """When somebody takes the arm, and towards which angles it is pushed; n times in a run."""

    first: jax.Array  # (n,) int, the step that each begins with, increasing
    steps: jax.Array  # (n,) int, how many it lasts
    target: jax.Array  # (n, 2) rad, not wrapped


@pytree
class Hand(Pytree):
    """What the PID law remembers, from one reset to the next."""

    sum: jax.Array  # (2,) rad, of the errors of all steps so far
    error: jax.Array  # (2,) rad, of the last step
    steps: jax.Array  # () int, so far


def begun(dtype: Any) -> Hand:
    """What it remembers at the start of a run."""
    return Hand(jnp.zeros(2, dtype), jnp.zeros(2, dtype), jnp.zeros((), jnp.int32))


def held(resets: Resets, k: Any) -> jax.Array:
    """Which reset, (n,) bool, step ``k`` (...) is in; the shape is that of ``k`` and (n,)."""
    k = jnp.asarray(k)[..., None]
    return (k >= resets.first) & (k < resets.first + resets.steps)


def push(resets: Resets, hand: Hand, plant: Plant, k: jax.Array, x: jax.Array):
    """The hand at step ``k`` (), state (4,): whether it holds the arm, itself, its torque (2,).

    The derivative is left out in the first two steps of a run, as the board does.
    """
    which = held(resets, k)
    holds = which.any()
    target = jnp.sum(jnp.where(which[:, None], resets.target, 0.0), axis=0).astype(x.dtype)
    error = target - x[:2]
    total = hand.sum + error
    slope = jnp.where(hand.steps < 2, 0.0, (error - hand.error) / STEP)
    torque = PROPORTIONAL * error + INTEGRAL * STEP * total + DERIVATIVE * slope
    torque = jnp.clip(torque, -LIMIT, LIMIT) - gravity_vector(plant, x)
    moved = Hand(total, error, hand.steps + 1)
    hand = jax.tree.map(lambda new, old: jnp.where(holds, new, old), moved, hand)
    return holds, hand, torque


def thrown(plant: Plant, key: jax.Array, dt: float, x: jax.Array | None = None) -> jax.Array:
    """The state (4,) in which a reset leaves an arm in state ``x`` (4,); ``key`` is consumed.

    ``plant`` has both joints driven. Without a state it is an arm that stood; its joints may then
    be whole turns off (``TURNS``), as swing-ups leave them, so that the hand, which does not wrap
    angles, turns them back and throws harder.
    """
    key_side, key_turns, key_error, key_target = jax.random.split(key, 4)
    if x is None:
        side = jnp.where(jax.random.bernoulli(key_side), 1.0, -1.0)
        turns = jax.random.categorical(key_turns, jnp.log(jnp.asarray(TURNS)))
        turns = turns * side * jnp.array([1.0, -1.0])
        angles = jnp.pi * (turns * 2 + side * jnp.array([1.0, 0.0]))
        x = jnp.concatenate([angles, jnp.zeros(2)])
    target = jax.random.uniform(key_target, (1, 2), minval=-jnp.pi, maxval=jnp.pi)
    error = jax.random.uniform(key_error, (2,), minval=-2 * jnp.pi, maxval=2 * jnp.pi)
    steps = round(HOLD / dt)
    resets = Resets(jnp.zeros(1, int), jnp.full(1, steps), target)
    hand = Hand(jnp.zeros(2), error, jnp.asarray(2))  # as if it had held the arm before

    def step(carry: tuple[jax.Array, Hand], k: jax.Array) -> tuple[tuple[jax.Array, Hand], None]:
        x, hand = carry
        _, hand, torque = push(resets, hand, plant, k, x)
        torque = jnp.clip(torque, -plant.torque_limit, plant.torque_limit)
        return (rk4_step(plant, x, torque, dt), hand), None

    return jax.lax.scan(step, (x, hand), jnp.arange(steps))[0][0]


@functools.lru_cache
def stamps(dt: float, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """The time stamps (N,) of steps, s, and how many steps a reset lasts that begins at each (N,).

    Both come from running float64 sums of ``dt``, as in the reference: 100 or 101 at 0.002 s.
    """
    t = np.concatenate([[0.0], np.cumsum(np.full(int(duration / dt) + 2, dt))])
    taken = np.diff(t, prepend=0.0)
    longest = int(HOLD / dt) + 3
    taken = np.concatenate([taken, np.full(longest, dt)])
    timer, steps = np.zeros(len(t)), np.full(len(t), longest)
    for step in range(longest):
        steps = np.where((timer > HOLD) & (steps == longest), step, steps)
        timer = timer + taken[step : step + len(t)]
    return t, steps


def _resets(when: Any, target: Any, dt: float, duration: float, xp: Any) -> Resets:
    """Resets that begin at the first step that is not before each of the times (n,), s."""
    t, steps = stamps(dt, duration)
    first = xp.searchsorted(xp.asarray(t, when.dtype), when).astype(np.int32)
    return Resets(first, xp.asarray(steps, np.int32)[first], target)


def _times(count: int, duration: float, uniform: Any) -> Any:
    """The times that resets are due at (count,), s, of numbers on [0, 1) (count,)."""
    apart = duration / (count + 1)
    even = np.linspace(apart, duration - apart, count)
    return even.astype(uniform.dtype) + 2 * JITTER * (uniform - 0.5)


def random_resets(key: jax.Array, count: int, *, dt: float, duration: float) -> Resets:
    """Resets as the board draws them; ``key`` is consumed. ``dt`` and ``duration`` are in s."""
    key_times, key_target = jax.random.split(key)
    target = jax.random.uniform(key_target, (count, 2), minval=-jnp.pi, maxval=jnp.pi)
    when = _times(count, duration, jax.random.uniform(key_times, (count,)))
    return _resets(when, target, dt, duration, jnp)


def official_resets(seed: int, count: int, *, dt: float, duration: float) -> Resets:
    """Those that the board draws after ``numpy.random.seed(seed)``, number for number, in numpy.

    The board's scripts leave the seed out, so that a published score is that of one draw.
    """
    draws = np.random.RandomState(seed).random_sample(4 * _ROWS + count)
    target = (2 * np.pi * draws[: 4 * _ROWS] - np.pi).reshape(_ROWS, 4)[:count, :2]
    return _resets(_times(count, duration, draws[4 * _ROWS :]), target, dt, duration, np)
