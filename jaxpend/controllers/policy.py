"""A neural network policy as a controller, and its file: plain arrays and a JSON header."""

import dataclasses
import itertools
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from .. import config
from ..arrays import read_arrays, write_arrays
from ..controller import Controller
from ..designs import ROBOTS, active_joint
from ..errors import JaxpendError, choose
from ..observation import Observation
from ..pytree import pytree, static
from .search_space import WEIGHT

__all__ = ["ACTIVATIONS", "Policy", "load_policy", "save_policy"]

FORMAT = 1
ACTIVATIONS = {name: getattr(jax.nn, name) for name in config.ACTIVATIONS}


FASTEST = 0.001  # s, the shortest time between calls at which a history still goes back far enough


@pytree
class Memory:
    """The calls of a policy so far, the newest first; as many as its history may need."""

    x: jax.Array  # (N, 4) measured states
    actions: jax.Array  # (N,) sum of the actions of all calls before that one
    total: jax.Array  # () sum of the actions of all calls
    t: jax.Array  # () s, of the last call; -inf before the first

    def past(self, history: int, period: float, t: jax.Array, x: jax.Array) -> jax.Array:
        """What an ``Observation`` calls ``past``, (history, 5), at time ``t`` and state ``x``.

        States are those of 1, 2, ... periods ago; actions the means over the periods from then
        on. Called once a period, as in training, those are the actions there were; called more
        often they change as smoothly as the mean. Before the first call the state was the same,
        and the action 0.
        """
        calls = jnp.round(period / (t - self.t)).astype(jnp.int32)  # a period; the first time 0
        calls = jnp.clip(calls, 1, len(self.x) // history)
        ago = jnp.arange(1, history + 1) * calls - 1
        states = jnp.where(jnp.isfinite(self.t), self.x[ago], x)
        sums = jnp.append(self.total, self.actions[ago])
        return jnp.column_stack([states, (sums[:-1] - sums[1:]) / calls])

    def after(self, t: jax.Array, x: jax.Array, action: jax.Array) -> "Memory":
        """With a call at time ``t`` in state ``x`` that acted so."""
        states = jnp.concatenate([x[None], self.x[:-1]])
        states = jnp.where(jnp.isfinite(self.t), states, x)  # the first state was there before
        sums = jnp.append(self.total, self.actions[:-1])
        return Memory(states, sums, self.total + action, jnp.asarray(t, self.t.dtype))


@pytree
class Policy:
    """Multi-layer perceptron from an observation of the state to the driven joint's torque.

    With ``observation.history`` it sees past states and actions too, as far apart as in training
    (``control_dt``), however often it is called. ``action_noise`` is the standard deviation of
    the noise added to the action before the tanh (SNES trains with it); None means greedy and
    costs nothing.
    """

    SEARCHED: ClassVar = {"layers": WEIGHT}
    layers: tuple[tuple[jax.Array, jax.Array], ...]  # (kernel (in, out), bias (out,)) each
    torque_limit: jax.Array  # () N m, torque at action 1
    action_noise: jax.Array | None = None  # ()
    robot: str = static(default="pendubot")
    observation: Observation = static(default=Observation())
    activation: str = static(default="relu")
    control_dt: float = static(default=0.01)  # s, the period it was trained at

    def pre_action(self, x: jax.Array, past: jax.Array | None = None) -> jax.Array:
        """The action before the tanh, scalar, for a measured state (4,) and ``Memory.past``."""
        h = self.observation(x, past)
        *hidden, (kernel, bias) = self.layers
        for w, b in hidden:
            h = ACTIVATIONS[self.activation](h @ w + b)
        return (h @ kernel + bias)[0]

    def reset(self, key: jax.Array) -> tuple[jax.Array | None, Memory | None]:
        """The key for the action noise and the memory, or None where there is no such thing."""
        memory, dtype = None, jnp.result_type(float)
        if history := self.observation.history:
            calls = history * max(round(self.control_dt / FASTEST), 1)
            states, zero = jnp.zeros((calls, 4), dtype), jnp.zeros((), dtype)
            memory = Memory(states, jnp.zeros(calls, dtype), zero, zero - jnp.inf)
        return None if self.action_noise is None else key, memory

    def __call__(self, carry, t, x):
        """Torque (2,), N m, zero on the passive joint."""
        (key, memory), past = carry, None
        if memory is not None:
            past = memory.past(self.observation.history, self.control_dt, t, x)
        pre = self.pre_action(x, past)
        if self.action_noise is not None:
            key, key_noise = jax.random.split(key)
            pre = pre + self.action_noise * jax.random.normal(key_noise, (), pre.dtype)
        action = jnp.tanh(pre)
        if memory is not None:
            memory = memory.after(t, x, action)
        torque = self.torque_limit * action
        on_joint = np.arange(2) == active_joint(self.robot)
        return (key, memory), jnp.where(on_joint, torque, jnp.zeros_like(torque))


def change_policies(controller: Any, change: Callable[[Policy], Policy]) -> tuple[Any, int]:
    """A controller with every policy in it changed, and how many those are."""
    is_policy = lambda part: isinstance(part, Policy)  # noqa: E731
    parts, structure = jax.tree.flatten(controller, is_leaf=is_policy)
    changed = [change(part) if is_policy(part) else part for part in parts]
    return jax.tree.unflatten(structure, changed), sum(map(is_policy, parts))


def network_in(controller: Any, where: str | Path = "the controller") -> Policy:
    """The one policy in a controller. Raises ``JaxpendError``, naming ``where``, if it has none."""
    is_policy = lambda part: isinstance(part, Policy)  # noqa: E731
    found = [part for part in jax.tree.leaves(controller, is_leaf=is_policy) if is_policy(part)]
    if len(found) != 1:
        raise JaxpendError(f"{where} holds {len(found)} neural networks; one is needed")
    return found[0]


def _header(policy: Policy, provenance: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "robot": policy.robot,
        "torque_limit": float(policy.torque_limit),
        "observation": dataclasses.asdict(policy.observation),
        "activation": policy.activation,
        "layers": [policy.layers[0][0].shape[0], *(int(b.shape[0]) for _, b in policy.layers)],
        "control_dt": policy.control_dt,
        "provenance": provenance,
    }


def save_policy(
    path: str | Path, policy: Controller, provenance: dict[str, Any] | None = None
) -> None:
    """Write a policy file (.npz without pickle: float32 arrays and a JSON header), atomically.

    Args:
        path: of the file.
        policy: a ``Policy``, or a controller with one in it, such as a ``Guarded``.
        provenance: any JSON object: command, seed, scores, ...

    Raises:
        JaxpendError: a controller with no policy in it; use ``save_controller``.
    """
    if not isinstance(policy, Policy):
        from .files import save_controller

        return save_controller(path, policy, network_in(policy).robot, provenance)
    arrays = {}
    for i, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel{i}": np.asarray(kernel, "f4"), f"bias{i}": np.asarray(bias, "f4")}
    write_arrays(path, _header(policy, provenance or {}), arrays)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    header, arrays = read_arrays(path, "policy")
    if header.get("format") != FORMAT:
        raise JaxpendError(f"{path} has policy format {header.get('format')}; this reads {FORMAT}")
    return header, arrays


def read_header(robot_or_path: str | Path) -> dict[str, Any]:
    """The JSON header of a policy or controller file. Raises as ``arrays.read_arrays``."""
    return read_arrays(_locate(robot_or_path), "policy")[0]


def _locate(robot_or_path: str | Path) -> Path:
    if str(robot_or_path) not in ROBOTS:
        return Path(robot_or_path)
    return Path(str(resources.files("jaxpend").joinpath(f"policies/{robot_or_path}.npz")))


def load_policy(robot_or_path: str | Path, *, robot: str | None = None) -> Controller:
    """Load a policy file, or by "acrobot" / "pendubot" the policy that ships with the package.

    A network alone is a ``Policy``; one that is guarded is a ``Guarded`` around it.

    Args:
        robot_or_path: a path, or the name of a robot.
        robot: the robot that the policy must be for; None accepts either.

    Raises:
        JaxpendError: no such file, not a policy file, or the policy of the other robot.
    """
    path = _locate(robot_or_path)
    if read_header(path).get("kind") == "controller":
        from .files import load_controller  # it knows all controllers, this one too

        return load_controller(path, robot=robot)
    header, arrays = _read(path)
    try:
        sizes = header["layers"]
        layers = tuple(
            (jnp.asarray(arrays[f"kernel{i}"]), jnp.asarray(arrays[f"bias{i}"]))
            for i in range(len(sizes) - 1)
        )
        policy = Policy(
            layers=layers,
            torque_limit=jnp.asarray(header["torque_limit"], jnp.float32),
            robot=choose("robot", header["robot"], ROBOTS),
            observation=Observation(**header["observation"]),
            activation=choose("activation", header["activation"], ACTIVATIONS),
            control_dt=float(header["control_dt"]),
        )
        shapes = [(k.shape, b.shape) for k, b in layers]
    except (KeyError, TypeError) as error:
        raise JaxpendError(f"{path} lacks a part of a policy: {error}") from None
    expected = [((a, b), (b,)) for a, b in itertools.pairwise(sizes)]
    if shapes != expected or sizes[0] != policy.observation.size or sizes[-1] != 1:
        raise JaxpendError(f"{path}: the arrays do not have the shapes that its header says")
    if not all(np.isfinite(a).all() for a in arrays.values()) or not policy.torque_limit > 0:
        raise JaxpendError(f"{path}: the policy holds values that are not finite or not positive")
    if robot is not None and policy.robot != choose("robot", robot, ROBOTS):
        raise JaxpendError(f"{path} is a policy for the {policy.robot}, not for the {robot}")
    return policy
