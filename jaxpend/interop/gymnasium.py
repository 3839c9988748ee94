"""The learning environment for Gymnasium, which knows it once this module is imported.

    import gymnasium
    import jaxpend.interop.gymnasium

    env = gymnasium.make("jaxpend/Pendubot-v0", torque_limit=6.0, reward={"floor": -10.0})
    envs = gymnasium.make_vec("jaxpend/Acrobot-v0", num_envs=4096)

or without the import: ``gymnasium.make("jaxpend.interop.gymnasium:jaxpend/Pendubot-v0")``. Fields
of ``EnvConfig`` are keyword arguments, sections of it mappings; so are ``plant`` and ``design``,
as in ``boards.task_of``. Without any it is the task of Calì et al., 2024: 3 N m and their reward.

An action (1,) in [-1, 1] is the share of the torque limit; it is clipped. Observations are what a
policy sees (``jaxpend.observation``), so that a policy that is trained here can become a policy
file. ``info["state"]`` is the true state (4,), rad and rad/s. Nothing terminates: episodes are
truncated, at the time limit and beyond ``max_speed``.
"""

import dataclasses
from collections import deque
from collections.abc import Sequence
from functools import cache
from typing import Any

import jax
import numpy as np

from ..boards import task_of
from ..config import EnvConfig
from ..config_files import from_mapping
from ..env import Env
from ..errors import JaxpendError, choose
from ..fields import Count, checked
from ..observation import Observation
from .episodes import Episode, compiled

try:
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.utils.seeding import np_random
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:  # AutoresetMode came with 1.1
    text = "this needs the package gymnasium, 1.1 or newer: pip install 'jaxpend[gymnasium]'"
    raise JaxpendError(text) from None

__all__ = ["NAMES", "DoublePendulum", "VectorDoublePendulum"]

LARGEST = float(np.finfo(np.float32).max)
FPS = 25  # pictures a second in a window
TRAIL = 0.6  # s, for which a picture shows where the end effector has been
NAMES = {"pendubot": "jaxpend/Pendubot-v0", "acrobot": "jaxpend/Acrobot-v0"}


def _environment(robot: str, plant: str, design: str, fields: dict[str, Any]) -> Env:
    """The environment that keyword arguments describe. Raises ``JaxpendError``."""
    given = {
        name: dataclasses.asdict(v) if dataclasses.is_dataclass(type(v)) else v
        for name, v in fields.items()
    }
    return Env(from_mapping(EnvConfig(), given, ""), task_of(robot, plant, design))


@cache
def _bounds(view: Observation) -> tuple[np.ndarray, np.ndarray]:
    """The least and the most (obs_size,) of what can be seen, float32.

    Every kind sees a state's angles and velocities one by one, so that they are found among states
    with extreme ones; what has no bound gets the largest number.
    """
    turns = np.array([-LARGEST, -1e-9, 0, np.pi / 2, np.pi, 3 * np.pi / 2, LARGEST], np.float32)
    speeds = np.array([-LARGEST, 0, LARGEST], np.float32)
    states = np.array([(a, a, w, w) for a in turns for w in speeds])
    seen = np.array(jax.vmap(view.of_state)(jax.numpy.asarray(states)), np.float64)
    found = []
    for side, most in ((-1, seen.min(axis=0)), (1, seen.max(axis=0))):
        # What is computed otherwise is rounded otherwise; 1 is not computed.
        most = np.where(np.abs(most) == 1, most, most + side * 1e-5 * np.abs(most))
        turned = np.full(2, side * (1 + 1e-5) / view.max_turn)
        past = turned if view.kind == "angles" else most
        rows = [most, *[np.append(past, side)] * view.history]
        found.append(np.clip(np.concatenate(rows), -LARGEST, LARGEST).astype(np.float32))
    return found[0], found[1]


def _observation_space(env: Env) -> Box:
    """Of one environment."""
    return Box(*_bounds(env.config.observation), dtype=np.float32)


def _data(generator: np.random.Generator) -> np.ndarray:
    """The data (2,) of a key, of what ``reset`` was seeded with."""
    return generator.integers(0, 2**32, 2, np.uint32)


def _array(values: Any) -> np.ndarray:
    """A copy, float32: arrays of jax cannot be written to."""
    return np.array(values, np.float32)


def _actions(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Actions as float32. Raises ``JaxpendError`` for another shape, or what is not a number."""
    try:
        if np.iscomplexobj(values):
            raise TypeError
        with np.errstate(over="ignore"):  # what is too large is infinite
            actions = np.asarray(values, np.float32)
    except (TypeError, ValueError, OverflowError):
        raise JaxpendError(f"an action is {values!r}; it must be numbers in [-1, 1]") from None
    if actions.shape != shape:
        raise JaxpendError(f"the action has shape {actions.shape}; it must have {shape}")
    if not np.isfinite(actions).all():
        raise JaxpendError("an action is not finite; it must be in [-1, 1]")
    return actions


def _no_options(options: dict[str, Any] | None) -> None:
    if options:
        names = ", ".join(map(str, options)) if isinstance(options, dict) else repr(options)
        raise JaxpendError(f"options of reset are {names}; there are none, leave them out")


def _begun(episode: Episode | None) -> Episode:
    if episode is None:
        raise JaxpendError("there is no episode yet; call reset first")
    return episode


def _picture(env: Env, points: np.ndarray, trail: Sequence[np.ndarray], steps: int) -> np.ndarray:
    """A picture (height, width, 3), uint8."""
    from ..report.animation import frame  # which loads matplotlib, only to draw

    reach = float(np.sum(env.plant.length))
    image = frame(points, trail, reach, env.task.height, steps * env.config.dt)
    return np.asarray(image).copy()


class DoublePendulum(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment; its arguments are told at the top of the module.

    The same seed gives the same episodes, this one and those that follow it without a seed.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # Gymnasium declares it so
        "render_modes": ["rgb_array", "human"],
        "render_fps": 100,
    }

    def __init__(
        self,
        robot: str = "pendubot",
        *,
        plant: str = "",
        design: str = "",
        render_mode: str | None = None,
        **fields: Any,
    ):
        """Raises ``JaxpendError`` for an unknown or bad argument, or a window without a display."""
        self.functions = _environment(robot, plant, design, fields)
        if render_mode is not None:
            choose("render_mode", render_mode, self.metadata["render_modes"])
        dt = self.functions.config.dt
        self.metadata = self.metadata | {"render_fps": max(round(1 / dt), 1)}
        self.render_mode = render_mode
        self.observation_space = _observation_space(self.functions)
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        self._compiled = compiled(self.functions)
        self._episode: Episode | None = None
        self._steps = 0
        self._points = np.zeros((2, 2))  # m, elbow and end effector now, if it is shown
        self._tips: deque[np.ndarray] = deque(maxlen=max(round(TRAIL / dt), 2))
        self._window: Any = None
        if render_mode == "human":
            from ..report.window import Window

            self._window = Window(NAMES[robot])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode: its observation (obs_size,) and info. There are no options."""
        super().reset(seed=seed)
        _no_options(options)
        if seed is not None or self._episode is None:
            self._episode = self._compiled.begin(_data(self.np_random))
        else:
            self._episode = self._compiled.follow(self._episode)
        self._steps = 0
        self._tips.clear()
        self._shown()
        state = self._episode.state
        return _array(state.obs), {"state": _array(state.x)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period of ``dt`` with an action (1,).

        Raises ``JaxpendError`` for an action of another shape, or one that is not finite.
        """
        now, action = _begun(self._episode), _actions(action, (1,))
        self._episode, seen = self._compiled.step(now, action)
        self._steps += 1
        self._shown()
        info = {"state": _array(seen.state)}
        return _array(seen.obs), float(seen.reward), False, bool(seen.over), info

    def _shown(self) -> None:
        """Keep where the links are, and show them in the window where there is one."""
        if self.render_mode is None:
            return
        self._points = np.asarray(self._compiled.points(_begun(self._episode).state.x))
        self._tips.append(self._points[1])
        stride = max(round(1 / FPS / self.functions.config.dt), 1)
        if self._window is not None and self._steps % stride == 0:
            self._window.show(self._drawn(), stride * self.functions.config.dt)

    def _drawn(self) -> np.ndarray:
        _begun(self._episode)
        return _picture(self.functions, self._points, list(self._tips), self._steps)

    def render(self) -> Any:
        """A picture (height, width, 3), uint8; in a window of its own None."""
        if self.render_mode is None:
            gymnasium.logger.warn('make it with render_mode="rgb_array" or "human" to see it')
            return None
        if self._window is None:
            return self._drawn()
        self._window.show(self._drawn(), 0.0)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()


class VectorDoublePendulum(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many environments that step in one compiled call.

    An episode that is over is followed by the next in the same step (``AutoresetMode.SAME_STEP``):
    its last observation is in ``info["final_obs"]``, its info in ``info["final_info"]``, as
    Gymnasium's own vector environments have them. Environment i of a seed has the episodes of a
    ``DoublePendulum`` with the seed + i.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 100,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        robot: str = "pendubot",
        *,
        num_envs: int = 1,
        plant: str = "",
        design: str = "",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **fields: Any,
    ):
        """As ``DoublePendulum``; ``max_episode_steps`` makes episodes shorter, not longer."""
        self.num_envs = checked(Count, num_envs, "num_envs")
        env = _environment(robot, plant, design, fields)
        if max_episode_steps is not None:
            limit = checked(Count, max_episode_steps, "max_episode_steps")
            duration = min(limit, env.config.episode_steps) * env.config.dt
            env = dataclasses.replace(
                env, config=dataclasses.replace(env.config, duration=duration)
            )
        if render_mode is not None:
            choose("render_mode", render_mode, self.metadata["render_modes"])
        self.functions, self.render_mode = env, render_mode
        self.metadata = self.metadata | {"render_fps": max(round(1 / env.config.dt), 1)}
        self.single_observation_space = _observation_space(env)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._compiled = compiled(env)
        self._episodes: Episode | None = None

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New episodes: observations (num_envs, obs_size) and infos.

        Raises ``JaxpendError`` for a sequence of seeds of another length, or any options.
        """
        _no_options(options)
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=seed if seed is None else int(seed))
            first = int(self.np_random.integers(2**31)) if seed is None else int(seed)
            seeds: Sequence[int] = range(first, first + self.num_envs)
        else:
            seeds = seed if isinstance(seed, Sequence | np.ndarray) else [seed]
        if not all(isinstance(s, int | np.integer) and s >= 0 for s in seeds):
            raise JaxpendError(f"seed is {seed!r}; it must be integers that are not negative")
        if len(seeds) != self.num_envs:
            raise JaxpendError(f"there are {len(seeds)} seeds; there must be {self.num_envs}")
        if seed is None and self._episodes is not None:
            self._episodes = self._compiled.follow_all(self._episodes)
        else:
            data = np.array([_data(np_random(int(s))[0]) for s in seeds])
            self._episodes = self._compiled.begin_all(data)
        state = self._episodes.state
        return _array(state.obs), self._infos(state.x, np.ones(self.num_envs, bool))

    def _infos(self, x: Any, whose: np.ndarray) -> dict[str, Any]:
        """Infos of those environments ``whose`` (num_envs,) it says; zeros for the others."""
        return {"state": np.where(whose[:, None], _array(x), np.float32(0)), "_state": whose}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of all environments, with actions (num_envs, 1).

        Returns observations (num_envs, obs_size), rewards, terminations and truncations
        (num_envs,), and infos. Raises ``JaxpendError`` as ``DoublePendulum.step``.
        """
        now, actions = _begun(self._episodes), _actions(actions, (self.num_envs, 1))
        self._episodes, obs, x, seen = self._compiled.step_all(now, actions)
        over = np.array(seen.over)
        infos = self._infos(x, np.ones(self.num_envs, bool))
        if over.any():
            last, final = _array(seen.obs), np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(over):
                final[i] = last[i]
            infos |= {"final_obs": final, "_final_obs": over.copy()}
            infos["final_info"] = self._infos(seen.state, over.copy())
            infos["_final_info"] = over.copy()
        never = np.zeros(self.num_envs, bool)
        return _array(obs), _array(seen.reward), never, over, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (height, width, 3), uint8, of every environment: some milliseconds each."""
        if self.render_mode is None:
            gymnasium.logger.warn('make it with render_mode="rgb_array" to see it')
            return None
        now = _begun(self._episodes)
        points = np.asarray(jax.vmap(self._compiled.points)(now.state.x))
        pairs = zip(points, np.asarray(now.steps), strict=True)
        return tuple(_picture(self.functions, p, (), int(steps)) for p, steps in pairs)


for _robot, _name in NAMES.items():
    gymnasium.register(
        id=_name,
        entry_point="jaxpend.interop.gymnasium:DoublePendulum",
        vector_entry_point="jaxpend.interop.gymnasium:VectorDoublePendulum",
        kwargs={"robot": _robot},
    )
