"""The learning environment: a Brax ``Env`` with the surrogate reward of Evolutionary SAC.

Source of the reward: Calì et al., "Evolutionary SAC for the AI Olympics with RealAIGym", 2024
(arXiv 2409.08938). Observations are those of the policy, followed by the previous action: the
reward charges the change of the action, so without it the reward, and with it the value, is not
a function of state and action. See ``networks.Actor`` for what the actor does with it.
"""

import contextlib
import io

import jax
import jax.numpy as jnp

from . import designs
from .config import EnvConfig, Reward
from .plant import forward_kinematics, kinetic_energy, potential_energy, rk4_step

# MuJoCo, which Brax loads, prints what it lacks to standard output.
with contextlib.redirect_stdout(io.StringIO()):
    from brax.envs.base import Env, State

__all__ = ["DoublePendulum", "EnvConfig", "Reward", "surrogate_reward"]


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


class DoublePendulum(Env):
    """Acrobot or pendubot; ``pipeline_state`` is ``{"x": (4,), "action": ()}``.

    Episodes never terminate (``done`` is always 0): wrap it in Brax's ``EpisodeWrapper`` or
    count steps; time limits truncate.
    """

    def __init__(self, config: EnvConfig | None = None):
        self.config = config = config or EnvConfig()
        self.plant = designs.competition(config.robot, config.torque_limit)
        self.driven = jnp.arange(2) == designs.active_joint(config.robot)

    def observe(self, x: jax.Array, action: jax.Array) -> jax.Array:
        """Observation of the state, then the previous action: (observation.size + 1,)."""
        return jnp.append(self.config.observation(x), action)

    def reset(self, rng: jax.Array) -> State:
        """A new episode, hanging at rest; ``rng`` has nothing to decide."""
        x, action, zero = jnp.zeros(4), jnp.zeros(()), jnp.zeros(())
        return State({"x": x, "action": action}, self.observe(x, action), zero, zero, {}, {})

    def advance(self, x: jax.Array, previous_action: jax.Array, action: jax.Array):
        """Next state (4,) and reward () of holding ``action`` () in [-1, 1] for one period."""
        u = jnp.where(self.driven, self.config.torque_limit * action, 0.0)
        x_next = rk4_step(self.plant, x, u, self.config.dt)
        reward = surrogate_reward(self.plant, self.config.reward, x_next, action, previous_action)
        return x_next, reward

    def step(self, state: State, action: jax.Array) -> State:
        """One control period; ``action`` (1,) is clipped to [-1, 1] and held."""
        a = jnp.clip(action[0], -1.0, 1.0)
        x, reward = self.advance(state.pipeline_state["x"], state.pipeline_state["action"], a)
        return state.replace(
            pipeline_state={"x": x, "action": a}, obs=self.observe(x, a), reward=reward
        )

    @property
    def observation_size(self) -> int:
        """Length of the observation, the previous action included."""
        return self.config.observation.size + 1

    @property
    def action_size(self) -> int:
        """One: the driven joint."""
        return 1

    @property
    def backend(self) -> str:
        """There is no Brax physics pipeline behind it."""
        return "jaxpend"
