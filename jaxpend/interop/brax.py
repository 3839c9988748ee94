"""The learning environment as a Brax ``Env``, for Brax's wrappers and algorithms."""

import contextlib
import io

import jax
import jax.numpy as jnp

from ..boards import v2
from ..env import Env as Functions
from ..env import EnvConfig, EnvState
from ..errors import JaxpendError
from ..task import Task

# MuJoCo, which Brax loads, prints what it lacks to standard output.
with contextlib.redirect_stdout(io.StringIO()):
    from brax.envs.base import Env, State

__all__ = ["DoublePendulum"]


class DoublePendulum(Env):
    """Acrobot or pendubot; ``pipeline_state`` is an ``EnvState``, the action has shape (1,).

    An observation is what the policy sees (its first ``seen_size`` entries), then what only the
    critics see. ``done`` is always 0: Brax's ``EpisodeWrapper`` truncates at its time limit, and
    nothing does beyond ``max_speed``. ``reset`` takes typed and old-style keys, but that wrapper
    around a ``VmapWrapper``, as in ``training.wrap``, reads the batch from the shape of the keys
    and needs old-style ones (``jax.random.PRNGKey``).
    """

    def __init__(self, config: EnvConfig | None = None, task: Task | None = None):
        """By default the pendubot of the v2 board, and the default configuration.

        Raises ``JaxpendError`` for what is no configuration or task, and as ``env.Env``.
        """
        for name, given, kind in (("config", config, EnvConfig), ("task", task, Task)):
            if not isinstance(given, kind | None):
                what = f"{name} is of the type {type(given).__name__}"
                raise JaxpendError(f"{what}; it must be of {kind.__name__}")
        self.functions = Functions(config or EnvConfig(), task or v2("pendubot").task)

    def reset(self, rng: jax.Array) -> State:
        """A new episode; ``rng`` is consumed."""
        now = self.functions.reset(rng)
        return State(now, self._observation(now), now.reward, jnp.zeros(()), {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        """One control period; ``action`` (1,) is clipped to [-1, 1] and held."""
        if (shape := jnp.shape(action)) != (1,):
            raise JaxpendError(f"the action has shape {shape}; it must be (1,): vmap over batches")
        # Of the type of the one before, so that a scan keeps the types of its carry.
        before = state.pipeline_state
        now = self.functions.step(before, jnp.asarray(action, before.action.dtype)[0])
        return state.replace(pipeline_state=now, obs=self._observation(now), reward=now.reward)

    def _observation(self, now: EnvState) -> jax.Array:
        return jnp.concatenate([now.obs, now.privileged])

    @property
    def seen_size(self) -> int:
        """How much of the observation, from the front, the policy sees."""
        return len(self.functions.mirrored[0])

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return sum(map(len, self.functions.mirrored))

    @property
    def action_size(self) -> int:
        """One: the driven joint."""
        return 1

    @property
    def backend(self) -> str:
        """There is no Brax physics pipeline behind it."""
        return "jaxpend"
