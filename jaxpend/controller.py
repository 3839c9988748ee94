"""The controller protocol, what checks it, and the simplest controllers on it."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from .errors import THEIRS, JaxpendError, blame
from .pytree import pytree, static
from .robots import ROBOTS
from .stepping import Startable

__all__ = [
    "Controller", "Feedback", "Memoryless", "OpenLoop", "Zero", "check_controller", "check_form",
    "check_robot", "robot_of",
]  # fmt: skip


class Controller(Protocol):
    """Anything that turns measured states into torques. Pure, and itself a pytree."""

    def reset(self, key: jax.Array) -> Any:
        """Memory (any pytree) at the start of a run; ``key`` is consumed."""

    def __call__(self, carry: Any, t: jax.Array, x: jax.Array) -> tuple[Any, jax.Array]:
        """New memory and torque (2,), N m, from memory, time (s) and measured state (4,)."""
        raise NotImplementedError


LEAVES = jax.Array | np.ndarray | np.generic | float | int | jax.ShapeDtypeStruct
HOW = (
    "a controller is a jaxpend.pytree.pytree dataclass with reset(key) -> carry and "
    "__call__(carry, t, x) -> (carry, torque (2,))"
)


def check_form(controller: Any) -> None:
    """Refuse what is no controller by its form; cheap enough for every call of ``rollout``.

    Raises:
        JaxpendError: no ``reset``, not callable, a class instead of an instance, or not a pytree
            of arrays and numbers.
    """
    name = controller.__name__ if isinstance(controller, type) else type(controller).__name__
    if isinstance(controller, type):
        raise JaxpendError(f"{name} is a class, not an instance of it; {HOW}")
    if not callable(getattr(controller, "reset", None)) or not callable(controller):
        raise JaxpendError(f"{name} is no controller; {HOW}")
    for leaf in jax.tree.leaves(controller):
        if leaf is controller:
            raise JaxpendError(f"{name} is not a pytree, so jax cannot trace it; {HOW}")
        if not isinstance(leaf, LEAVES):
            what = type(leaf).__name__
            raise JaxpendError(f"{name} holds a {what} where an array should be; {HOW}")


def check_controller(controller: Any) -> None:
    """Refuse what would end in a traceback of jax later; the check at every door but ``rollout``.

    A controller with a method ``check`` is asked too. Controllers of one form are called once.

    Raises:
        JaxpendError: as ``check_form``; an array with NaN in it; it raises when it is called; or
            it does not return its memory, of the same form as before, and a torque (2,).
    """
    check_form(controller)
    name = type(controller).__name__
    leaves, structure = jax.tree.flatten(controller)
    for leaf in leaves:
        known = not isinstance(leaf, jax.core.Tracer | jax.ShapeDtypeStruct)
        if known and jnp.issubdtype(jnp.result_type(leaf), jnp.floating) and np.isnan(leaf).any():
            raise JaxpendError(f"{name} holds a number that is NaN; all of them must be numbers")
    if hasattr(controller, "check"):
        controller.check()
    for path, value in _static_fields(controller):
        try:
            hash(value)
        except TypeError:
            what = type(value).__name__
            text = f"{name} has a {what} in its static field {path}; what is static is hashable"
            raise JaxpendError(text) from None
    forms = tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
    _check_call(structure, forms, jnp.result_type(float))


def _static_fields(part: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of what jax takes for constant in a dataclass and in its parts."""
    for field in dataclasses.fields(part) if dataclasses.is_dataclass(part) else ():
        value = getattr(part, field.name)
        if field.metadata.get("static"):
            yield path + field.name, value
        else:
            yield from _static_fields(value, f"{path}{field.name}.")


@lru_cache(maxsize=64)
def _check_call(structure: Any, forms: tuple[tuple[Any, Any], ...], _precision: Any) -> None:
    """What ``check_controller`` says of a call, of controllers of one form."""
    controller = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*form) for form in forms])
    name = type(controller).__name__

    def first_call(controller: Any) -> Any:
        carry = controller.reset(jax.random.key(0))
        return carry, controller(carry, jnp.zeros(()), jnp.zeros(4))

    try:
        carry, returned = jax.eval_shape(first_call, controller)
    except JaxpendError:
        raise
    except THEIRS as error:
        raise JaxpendError(f"{name} cannot be called: {blame(error)}") from error
    if not (isinstance(returned, tuple) and len(returned) == 2):
        raise JaxpendError(f"{name} returns {type(returned).__name__}, not (carry, torque)")
    after, torque = returned
    if getattr(torque, "shape", None) != (2,):
        shape = getattr(torque, "shape", type(torque).__name__)
        raise JaxpendError(f"{name} returns a torque of shape {shape}; it must be (2,)")
    memories = [
        (jax.tree.structure(tree), [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)])
        for tree in (carry, after)
    ]
    if memories[0] != memories[1]:
        raise JaxpendError(f"{name} returns a memory of another form than that of its reset")


def robot_of(controller: Any) -> str | None:
    """The robot that a controller, or a part of it, says that it is for; None: it says nothing."""
    robot = getattr(controller, "robot", None)
    if isinstance(robot, str) and robot in ROBOTS:
        return robot
    if not dataclasses.is_dataclass(controller):
        return None
    parts = (getattr(controller, field.name) for field in dataclasses.fields(controller))
    return next((robot for part in parts if (robot := robot_of(part))), None)


def check_robot(controller: Any, robot: str) -> None:
    """Raise ``JaxpendError`` for a controller that says that it is for the other robot."""
    its = robot_of(controller)
    if its is not None and its != robot:
        raise JaxpendError(f"this controller is for the {its}, not for the {robot}")


class Memoryless(Startable):
    """A controller whose torque depends on time and state alone."""

    def reset(self, key: jax.Array) -> None:
        """No memory."""
        return None


@pytree
class Zero(Memoryless):
    """No torque."""

    def __call__(self, carry, t, x):
        """Zeros, shape (2,)."""
        return carry, jnp.zeros(2, x.dtype)


@pytree
class Feedback(Memoryless):
    """A law ``law(t, x) -> torque (2,)`` written in jax."""

    law: Callable = static()

    def __call__(self, carry, t, x):
        """The law at time ``t`` and state ``x``."""
        return carry, self.law(t, x)


@pytree
class OpenLoop(Memoryless):
    """Recorded torques, held from one time stamp to the next; the last one is held on."""

    t: jax.Array  # (N,) s, increasing
    u: jax.Array  # (N, 2) N m

    def check(self) -> None:
        """Raise ``JaxpendError`` for stamps that do not rise, or not one for each torque."""
        if isinstance(self.t, jax.core.Tracer | jax.ShapeDtypeStruct):
            return
        if (shapes := (np.shape(self.t), np.shape(self.u))) != ((len(self.t),), (len(self.t), 2)):
            raise JaxpendError(f"t and u have shapes {shapes[0]} and {shapes[1]}; not (N,), (N, 2)")
        if (np.diff(self.t) < 0).any():
            raise JaxpendError("the time stamps of these torques go back; they must rise")

    def __call__(self, carry, t, x):
        """The torque of the latest stamp that is not after ``t``."""
        index = jnp.searchsorted(self.t, t, side="right") - 1
        return carry, self.u[jnp.clip(index, 0, self.u.shape[0] - 1)]
