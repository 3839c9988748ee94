"""The learning environment: a Brax ``Env`` with the surrogate reward of Evolutionary SAC.

Source of the reward: Calì et al., "Evolutionary SAC for the AI Olympics with RealAIGym", 2024
(arXiv 2409.08938). An observation begins with what the policy sees (``seen_size`` entries); what
follows is for the critics alone: the true state, where the policy's is measured in a random
scenario, and the previous action, because the reward charges the change of the action, so that
without it the value is not a function of state and action. See ``networks.Actor`` for why the
policy does not see it.
"""

import contextlib
import io
from dataclasses import replace

import jax
import jax.numpy as jnp

from . import designs
from .config import EnvConfig, Reward
from .plant import forward_kinematics, kinetic_energy, potential_energy, rk4_step
from .pytree import pytree
from .rollout import actuate, draws, measure
from .scenario import Scenario
from .variations import LONGEST_DELAY, sample

# MuJoCo, which Brax loads, prints what it lacks to standard output.
with contextlib.redirect_stdout(io.StringIO()):
    from brax.envs.base import Env, State

__all__ = ["DoublePendulum", "EnvConfig", "Reward", "surrogate_reward"]

SCENARIO_DT = 0.002  # s, the steps in which delays, noise and responses of scenarios are meant


def surrogate_reward(plant, reward: Reward, x, action, previous_action) -> jax.Array:
    """Reward of arriving in state ``x`` (4,) by ``action`` (), after ``previous_action`` ().

    With end-effector height y, potential and kinetic energy V and T, and action change da:
    ``V + alpha (1 + cos theta2)^2 - beta T - rho1 a^2 - phi1 |da|`` where y is above the line,
    ``V - rho2 a^2 - phi2 |da| - eta (omega1^2 + omega2^2)`` below it, at least ``floor``.
    """
    height = forward_kinematics(plant, x)[1, 1]
    potential, kinetic = potential_energy(plant, x), kinetic_energy(plant, x)
    effort, change = action**2, jnp.abs(action - previous_action)
    straight = (1 + jnp.cos(x[1])) ** 2
    above = reward.alpha * straight - reward.beta * kinetic
    above = above - reward.rho1 * effort - reward.phi1 * change
    below = -reward.rho2 * effort - reward.phi2 * change - reward.eta * (x[2] ** 2 + x[3] ** 2)
    total = potential + jnp.where(height > reward.line, above, below)
    return jnp.maximum(total, reward.floor)


@pytree
class World:
    """The random scenario of an episode, and what a rollout in it carries from step to step."""

    scenario: Scenario
    states: jax.Array  # (LONGEST_DELAY + 1, 4) true states, a ring buffer
    measured: jax.Array  # (4,)
    applied: jax.Array  # (2,) N m
    k: jax.Array  # () int, steps of ``SCENARIO_DT``
    key: jax.Array


class DoublePendulum(Env):
    """Acrobot or pendubot; ``pipeline_state`` has the true state "x" (4,) and the "action" ().

    With a history it has the "past" (history, 5) too, and the "world" of a randomised episode.
    Episodes never terminate (``done`` is always 0): wrap it in Brax's ``EpisodeWrapper`` or
    count steps; time limits truncate.
    """

    def __init__(self, config: EnvConfig | None = None):
        self.config = config = config or EnvConfig()
        self.plant = designs.competition(config.robot, config.torque_limit)
        self.driven = jnp.arange(2) == designs.active_joint(config.robot)

    def observe(self, now: dict) -> jax.Array:
        """Observation (observation_size,) of a ``pipeline_state``."""
        x, view = now["x"], self.config.observation
        if not self.config.randomised:
            return jnp.append(view(x, now.get("past")), now["action"])
        seen = view(now["world"].measured, now.get("past"))
        return jnp.concatenate([seen, view.of_state(x), now["action"][None]])

    def reset(self, rng: jax.Array) -> State:
        """A new episode, hanging at rest or near upright; ``rng`` draws which, and the scenario."""
        x, zero = self._start(rng), jnp.zeros(())
        now = {"x": x, "action": zero}
        if self.config.observation.history:
            now["past"] = jnp.tile(jnp.append(x, zero), (self.config.observation.history, 1))
        if self.config.randomised:
            key_scenario, key_start, key = jax.random.split(rng, 3)
            scenario = sample(self.plant, key_scenario, self.config.randomised)
            states, k = jnp.zeros((LONGEST_DELAY + 1, 4)), jnp.zeros((), jnp.int32)
            z = jax.tree.map(lambda z: z[0], draws(scenario, key_start, None, 1, x.dtype))
            states, measured = measure(scenario, states, k, x, z)
            now["world"] = World(scenario, states, measured, jnp.zeros(2), k, key)
        return State(now, self.observe(now), zero, zero, {}, {})

    def _start(self, rng: jax.Array) -> jax.Array:
        share, spread = self.config.upright_starts, self.config.upright_spread
        if not share:
            return jnp.zeros(4)
        # Apart from the keys of the scenario.
        key_where, key_x = jax.random.split(jax.random.fold_in(rng, 1))
        off = spread * jnp.array([1.0, 1.0, 3.0, 3.0]) * jax.random.normal(key_x, (4,))
        return jnp.where(jax.random.bernoulli(key_where, share), off.at[0].add(jnp.pi), 0.0)

    def advance(self, x: jax.Array, previous_action: jax.Array, action: jax.Array):
        """Next state (4,) and reward () of holding ``action`` () in [-1, 1] for one period."""
        x_next = rk4_step(self.plant, x, self._torque(action), self.config.dt)
        return x_next, self._reward(x_next, action, previous_action)

    def step(self, state: State, action: jax.Array) -> State:
        """One control period; ``action`` (1,) is clipped to [-1, 1] and held."""
        a = jnp.clip(action[0], -1.0, 1.0)
        now = dict(state.pipeline_state)
        x, previous = now["x"], now["action"]
        if "past" in now:
            seen = now["world"].measured if "world" in now else x
            now["past"] = jnp.concatenate([jnp.append(seen, a)[None], now["past"][:-1]])
        if "world" in now:
            x, now["world"] = self._through(now["world"], x, a)
            reward = self._reward(x, a, previous)
        else:
            x, reward = self.advance(x, previous, a)
        now |= {"x": x, "action": a}
        return state.replace(pipeline_state=now, obs=self.observe(now), reward=reward)

    def kicked(self, state: State, change: jax.Array) -> State:
        """The same with ``change`` (4,) added to the true state; in a scenario measured later."""
        now = dict(state.pipeline_state)
        now["x"] = now["x"] + change
        return state.replace(pipeline_state=now, obs=self.observe(now))

    def _torque(self, action):
        return jnp.where(self.driven, self.config.torque_limit * action, 0.0)

    def _reward(self, x, action, previous_action):
        return surrogate_reward(self.plant, self.config.reward, x, action, previous_action)

    def _through(self, world: World, x: jax.Array, action: jax.Array) -> tuple[jax.Array, World]:
        """One control period in a scenario, by the parts of a step of ``rollout``."""
        scenario, command = world.scenario, self._torque(action)
        steps = max(round(self.config.dt / SCENARIO_DT), 1)
        dt = self.config.dt / steps
        key, key_noise = jax.random.split(world.key)

        def step(carry, z):
            x, applied, states, k, _ = carry
            applied = actuate(scenario, command, applied, k * dt, z)
            x = rk4_step(scenario.plant, x, applied, dt)
            states, measured = measure(scenario, states, k + 1, x, z)
            return (x, applied, states, k + 1, measured), None

        start = (x, world.applied, world.states, world.k, world.measured)
        noise = draws(scenario, key_noise, None, steps, x.dtype)
        (x, applied, states, k, measured), _ = jax.lax.scan(step, start, noise)
        return x, World(scenario, states, measured, applied, k, key)

    @property
    def seen_size(self) -> int:
        """How much of the observation, from the front, the policy sees."""
        return self.config.observation.size

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        true = self.config.observation.state_size if self.config.randomised else 0
        return self.seen_size + true + 1

    @property
    def mirrored(self) -> tuple[int, ...]:
        """The factors (observation_size,), 1 or -1, that mirror an observation."""
        view = self.config.observation
        true = replace(view, history=0).mirrored if self.config.randomised else ()
        return (*view.mirrored, *true, -1)

    @property
    def action_size(self) -> int:
        """One: the driven joint."""
        return 1

    @property
    def backend(self) -> str:
        """There is no Brax physics pipeline behind it."""
        return "jaxpend"
