"""The learning environment: pure functions on an ``EnvState``, with the surrogate reward.

Source of the reward: Calì et al., "Evolutionary SAC for the AI Olympics with RealAIGym", 2024
(arXiv 2409.08938). The critics see what the policy sees and ``privileged`` besides: the true
state, where the policy's is measured in a random scenario, and the previous action, because the
reward charges the change of the action, so that without it the value is not a function of state
and action. See ``sac.networks.Actor`` for why the policy does not see it.
"""

import dataclasses
import functools
from typing import TypeVar

import chex
import jax
import jax.numpy as jnp
import numpy as np

from .config import EnvConfig, Reward
from .errors import JaxpendError
from .observation import Observation
from .plant import (
    UPRIGHT,
    Plant,
    forward_kinematics,
    joint_torque,
    kinetic_energy,
    potential_energy,
    rk4_step,
)
from .pytree import Pytree, pytree
from .resets import thrown
from .rollout import SLOTS, Sensors, actuate, draws, measure, sensors
from .scenario import DT, Scenario
from .task import Task
from .trigonometry import sincos

__all__ = [
    "LINES", "Env", "EnvConfig", "EnvState", "Reward", "World", "anywhere", "restarted",
    "surrogate_reward", "thrown_states", "truncated",
]  # fmt: skip

T = TypeVar("T")

# The paper's heights of the end effector above which the reward asks for balance, m.
LINES = {"acrobot": 0.375, "pendubot": 0.35}

THROWN = 8192  # states of which an episode that starts after a reset draws one
START_SPEED = 5.0  # rad/s, standard deviation of velocities of an episode that starts anywhere


def surrogate_reward(plant: Plant, reward: Reward, line: float, x, action, before) -> jax.Array:
    """Reward of arriving in state ``x`` (4,) by ``action`` (), after the action ``before`` ().

    With end-effector height y, potential and kinetic energy V and T, and action change da:
    ``V + alpha (1 + cos theta2)^2 - beta T - rho1 a^2 - phi1 |da|`` where y is above the line,
    ``V - rho2 a^2 - phi2 |da| - eta (omega1^2 + omega2^2) - energy |V + T - V*|`` below it, at
    least ``floor``; V* is V upright, and the last term is ours, for torque limits within which it
    takes several swings to get there. The ``line`` is a height in m; that of the coefficients may
    be None.
    """
    height = forward_kinematics(plant, x)[1, 1]
    potential, kinetic = potential_energy(plant, x), kinetic_energy(plant, x)
    effort, change = action**2, jnp.abs(action - before)
    straight = (1 + sincos(x[1])[1]) ** 2
    above = reward.alpha * straight - reward.beta * kinetic
    above = above - reward.rho1 * effort - reward.phi1 * change
    below = -reward.rho2 * effort - reward.phi2 * change - reward.eta * (x[2] ** 2 + x[3] ** 2)
    if reward.energy:
        upright = potential_energy(plant, jnp.asarray(UPRIGHT, x.dtype))
        below = below - reward.energy * jnp.abs(potential + kinetic - upright)
    total = potential + jnp.where(height > line, above, below)
    return jnp.maximum(total, reward.floor)


@pytree
class World(Pytree):
    """The random scenario of an episode, and what a rollout in it carries from step to step."""

    scenario: Scenario
    sensors: Sensors
    measured: jax.Array  # (4,)
    applied: jax.Array  # (2,) N m
    k: jax.Array  # () int, steps of ``scenario.DT``
    key: jax.Array


@pytree
class EnvState(Pytree):
    """An episode at one time."""

    x: jax.Array  # (4,) the true state
    action: jax.Array  # () in [-1, 1], the one that led here
    past: jax.Array | None  # (history, 5) measured states and actions in them, newest first
    world: World | None  # None: the nominal plant, measured as it is
    obs: jax.Array  # (obs_size,) what the policy sees
    privileged: jax.Array  # (privileged_size,) what the critics see besides
    reward: jax.Array  # () of arriving here


def _among(share: float, others: float) -> float:
    """A share of all episodes as one of those that are not among the ``others``."""
    return min(share / (1 - others), 1.0) if others < 1 else 0.0


def anywhere(key_angles: jax.Array, key_speeds: jax.Array) -> jax.Array:
    """A state (4,) with uniform angles and normal velocities; both keys are consumed."""
    angles = jax.random.uniform(key_angles, (2,), minval=-jnp.pi, maxval=jnp.pi)
    return jnp.concatenate([angles, START_SPEED * jax.random.normal(key_speeds, (2,))])


@functools.cache
def thrown_states(task: Task) -> np.ndarray:
    """States (THROWN, 4) in which resets by hand leave the arm: a table, since one takes long."""
    with jax.ensure_compile_time_eval():
        plant = task.with_resets(Scenario(task.plant), None).plant
        keys = jax.random.split(jax.random.key(0), THROWN)
        return np.asarray(jax.jit(jax.vmap(lambda key: thrown(plant, key, task.dt)))(keys))


@dataclasses.dataclass(frozen=True)
class Env:
    """Acrobot or pendubot as a task for a learner; hashable, so static in jit.

    ``reset`` and ``step`` are pure and of one environment; ``jax.vmap`` them. Episodes never
    terminate: count steps, and ask ``truncated``.

    Raises ``JaxpendError`` for a policy that is to see angles alone on a task in which the arm is
    thrown by hand: how they change then says nothing of the velocities.
    """

    config: EnvConfig
    task: Task

    def __post_init__(self) -> None:
        if self.task.resets and self.config.observation.kind == "angles":
            text = "where the arm is thrown by hand a policy must see velocities: sincos, for one"
            raise JaxpendError(f"observation.kind is angles; {text}")

    @property
    def plant(self) -> Plant:
        """The nominal plant, with the torque limit of the configuration."""
        return self.task.limited(self.config.torque_limit)

    @property
    def line(self) -> float:
        """The height, m, above which the reward asks for balance: that of the task's robot."""
        line = self.config.reward.line
        return LINES[self.task.robot] if line is None else line

    def observe(self, x, action, past, world, reward) -> EnvState:
        """A state with what is seen in it; the arguments are as in ``EnvState``."""
        view, privileged = self.config.observation, action[None]
        if self.shows_true_state:
            privileged = jnp.concatenate([self.true_view(x), privileged])
        obs = view(x if world is None else world.measured, past)
        return EnvState(x, action, past, world, obs, privileged, reward)

    def reset(self, key: jax.Array) -> EnvState:
        """A new episode, hanging at rest, near upright or anywhere.

        ``key`` draws which, and the scenario. It is consumed, and may be a typed one or of the
        old style.
        """
        x, zero, past, world = self._start(key), jnp.zeros(()), None, None
        if self.config.observation.history:
            past = jnp.tile(jnp.append(x, zero), (self.config.observation.history, 1))
        if self.config.randomised:
            key_scenario, key_start, key = jax.random.split(key, 3)
            scenario = self.task.imperfect(self.plant, key_scenario, self.config.randomised)
            before, k = sensors(scenario, x, SLOTS), jnp.zeros((), jnp.int32)
            z = jax.tree.map(lambda z: z[0], draws(scenario, key_start, None, 1, x.dtype))
            after, measured = measure(scenario, before, k, x, z, DT)
            world = World(scenario, after, measured, jnp.zeros(2), k, key)
        return self.observe(x, zero, past, world, zero)

    def _start(self, key: jax.Array) -> jax.Array:
        config, x = self.config, jnp.zeros(4)
        # Apart from the keys of the scenario.
        if share := config.upright_starts:
            key_where, key_x = jax.random.split(jax.random.fold_in(key, 1))
            spread = config.upright_spread * jnp.array([1.0, 1.0, 3.0, 3.0])
            near = (spread * jax.random.normal(key_x, (4,))).at[0].add(jnp.pi)
            x = jnp.where(jax.random.bernoulli(key_where, share), near, x)
        if share := config.random_starts:
            # Among the episodes that do not start near upright, so that both shares are right.
            share = _among(share, config.upright_starts)
            key_where, key_angles, key_speeds = jax.random.split(jax.random.fold_in(key, 2), 3)
            chosen = jax.random.bernoulli(key_where, share) & ~jnp.any(x)
            x = jnp.where(chosen, anywhere(key_angles, key_speeds), x)
        if share := config.thrown_starts:
            share = _among(share, config.upright_starts + config.random_starts)
            key_where, key_which = jax.random.split(jax.random.fold_in(key, 3))
            states = jnp.asarray(thrown_states(self.task), x.dtype)
            state = states[jax.random.randint(key_which, (), 0, THROWN)]
            x = jnp.where(jax.random.bernoulli(key_where, share) & ~jnp.any(x), state, x)
        return x

    def step(self, state: EnvState, action: jax.Array) -> EnvState:
        """One control period; ``action`` () is clipped to [-1, 1] and held."""
        chex.assert_shape((state.x, action), ((4,), ()))
        a, x = jnp.clip(action, -1.0, 1.0), state.x
        past, world = state.past, state.world
        if past is not None:
            seen = x if world is None else world.measured
            past = jnp.concatenate([jnp.append(seen, a)[None], past[:-1]])
        torque = joint_torque(self.config.torque_limit * a, self.task.joint)
        if world is None:
            x = rk4_step(self.plant, x, torque, self.config.dt)
        else:
            x, world = self._through(world, x, torque)
        reward = surrogate_reward(self.plant, self.config.reward, self.line, x, a, state.action)
        return self.observe(x, a, past, world, reward)

    def kicked(self, state: EnvState, change: jax.Array) -> EnvState:
        """The same with ``change`` (4,) added to the true state; in a scenario measured later."""
        return self.observe(state.x + change, state.action, state.past, state.world, state.reward)

    def _through(self, world: World, x: jax.Array, torque: jax.Array) -> tuple[jax.Array, World]:
        """One control period in a scenario, by the parts of a step of ``rollout``."""
        scenario, steps = world.scenario, max(round(self.config.dt / DT), 1)
        dt = self.config.dt / steps
        key, key_noise = jax.random.split(world.key)

        def step(carry, z):
            x, now = carry
            applied = actuate(scenario, torque, now.applied, now.k * dt, z, now.measured)
            k = now.k + 1
            x = rk4_step(scenario.plant, x, applied, dt)
            after, measured = measure(scenario, now.sensors, k, x, z, dt)
            return (x, World(scenario, after, measured, applied, k, key)), None

        noise = draws(scenario, key_noise, None, steps, x.dtype)
        return jax.lax.scan(step, (x, world.replace(key=key)), noise)[0]

    @property
    def mirrored(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The factors, 1 or -1, that mirror ``obs`` (obs_size,) and ``privileged``."""
        true = self.true_view.mirrored if self.shows_true_state else ()
        return self.config.observation.mirrored, (*true, -1)

    @property
    def shows_true_state(self) -> bool:
        """Whether the critics see the true state: where the policy does not."""
        return bool(self.config.randomised) or self.config.observation.kind == "angles"

    @property
    def true_view(self) -> Observation:
        """How the critics see the true state: as the policy does, and always with velocities."""
        view = self.config.observation
        if view.kind == "angles":
            return Observation(max_velocity=view.max_velocity)
        return dataclasses.replace(view, history=0)


def truncated(config: EnvConfig, state: EnvState, steps: jax.Array) -> jax.Array:
    """Whether an episode is cut off in this state, after so many steps (...): bool (...).

    It is at the time limit and beyond ``max_speed``.
    """
    speed = jnp.abs(state.x[..., 2:]).max(axis=-1)
    return (steps >= config.episode_steps) | (speed > config.max_speed)


def restarted(over: jax.Array, fresh: T, now: T) -> T:
    """The pytree ``fresh`` where an episode is over (n,), elsewhere ``now``; leaves (n, ...)."""

    def restart(new, old):
        return jnp.where(over.reshape((-1,) + (1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(restart, fresh, now)
