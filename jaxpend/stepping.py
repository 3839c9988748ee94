"""A controller step by step from Python, numpy in and numpy out: for loops that are not jax's.

A step is compiled once for each kind of controller and precision. The precision is jax's default
when the controller is started, whatever the type of the numbers that come in.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from .errors import JaxpendError
from .fields import Positive, Seed, checked
from .pytree import Pytree
from .scenario import DT

__all__ = ["Startable", "Stepper", "called_every"]


def called_every(controller: Any, dt: float) -> Any:
    """A controller, or a part of one, for calls every ``dt`` s.

    A part that depends on that, such as an observer, has a method of this name that says what it
    is then; all else stays as it is.
    """
    if (own := getattr(type(controller), "called_every", None)) is not None:
        return own(controller, dt)
    if type(controller) in (tuple, list):
        parts = [called_every(part, dt) for part in controller]
        same = all(new is old for new, old in zip(parts, controller, strict=True))
        return controller if same else type(controller)(parts)
    if not dataclasses.is_dataclass(controller) or isinstance(controller, type):
        return controller
    fields = {f.name: getattr(controller, f.name) for f in dataclasses.fields(controller)}
    changed = {name: called_every(part, dt) for name, part in fields.items()}
    changed = {name: part for name, part in changed.items() if part is not fields[name]}
    return dataclasses.replace(controller, **changed) if changed else controller


def _strong(tree: Any) -> Any:
    """The same arrays with types that do not depend on others: a weak type would compile anew."""

    def strong(leaf: Any) -> Any:
        known = jnp.result_type(leaf)
        return leaf if jnp.issubdtype(known, jax.dtypes.extended) else jnp.asarray(leaf, known)

    return jax.tree.map(strong, tree)


@jax.jit
def _reset(controller: Any, key: jax.Array) -> Any:
    return _strong(controller.reset(key))


@jax.jit
def _first(controller: Any, key: jax.Array, t: jax.Array, x: jax.Array) -> jax.Array:
    return controller(controller.reset(key), t, x)[1]


@jax.jit
def _step(controller: Any, carry: Any, t: jax.Array, x: jax.Array) -> Any:
    return _strong(controller(carry, t, x))


def _of_type(controller: Any, dtype: Any) -> Any:
    """The controller with its real numbers of one type."""

    def cast(leaf: Any) -> jax.Array:
        known = jnp.result_type(leaf)
        wanted = dtype if jnp.issubdtype(known, jnp.floating) else known
        same = isinstance(leaf, jax.Array) and known == wanted and not leaf.weak_type
        return leaf if same else jnp.asarray(leaf, wanted)

    return jax.tree.map(cast, controller)


def _numbers(values: ArrayLike, shape: tuple[int, ...], what: str, dtype: Any) -> np.ndarray:
    """Finite numbers of that shape. Raises ``JaxpendError`` for anything else."""
    try:
        if np.iscomplexobj(values):
            raise TypeError
        with np.errstate(over="ignore"):  # what is too large is infinite
            array = np.asarray(values, dtype)
    except (TypeError, ValueError, OverflowError):
        kind = type(values).__name__
        raise JaxpendError(f"{what} is a {kind}; it must be numbers of shape {shape}") from None
    if array.shape != shape:
        raise JaxpendError(f"{what} has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        raise JaxpendError(f"{what} is {array}; its numbers must be finite")
    return array


class Stepper:
    """A controller in a run: it keeps the memory, and the time where nobody says it.

    Any controller can be given, also one of your own that is no ``Startable``.
    """

    def __init__(self, controller: Any, *, dt: float = DT, seed: int = 0) -> None:
        """Start a run.

        Args:
            controller: any.
            dt: s, between calls of ``torque``.
            seed: of a controller that draws something.

        Raises:
            JaxpendError: dt is not positive, seed is no seed, or it is no controller.
        """
        if isinstance(controller, type) or not callable(getattr(controller, "reset", None)):
            text = "no controller; a controller has reset(key) and __call__(carry, t, x)"
            raise JaxpendError(f"{controller!r:.40} is {text}")
        self.dt, self.seed = checked(Positive, dt, "dt"), checked(Seed, seed, "seed")
        self._dtype = jnp.result_type(float)
        self._x64 = bool(self._dtype == jnp.float64)
        self._controller = _of_type(called_every(controller, self.dt), self._dtype)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next call is the first of a run, at time 0."""
        self.t = 0.0  # s, of the next call of ``torque``
        with jax.enable_x64(self._x64):
            self._carry = _reset(self._controller, jax.random.key(self.seed))

    def __call__(self, t: float, x: ArrayLike) -> np.ndarray:
        """The torque (2,), N m, at time t (s) for a measured state (4,), rad and rad/s.

        Raises:
            JaxpendError: numbers of another shape, or that are not finite.
        """
        state, time = _numbers(x, (4,), "x", self._dtype), _numbers(t, (), "t", self._dtype)
        with jax.enable_x64(self._x64):
            self._carry, torque = _step(self._controller, self._carry, time, state)
        self.t = float(t) + self.dt
        return np.array(torque)

    def torque(self, x: ArrayLike) -> np.ndarray:
        """As a call at time 0, then at ``dt`` after the call before."""
        return self(self.t, x)


class Startable(Pytree):
    """What every controller of this package has: it can be called from a loop of your own.

    For a controller of your own derive from it, or use ``Stepper(controller)``.
    """

    def reset(self, key: jax.Array) -> Any:
        """Memory (any pytree) at the start of a run; ``key`` is consumed."""
        raise NotImplementedError

    def __call__(self, carry: Any, t: jax.Array, x: jax.Array) -> tuple[Any, jax.Array]:
        """New memory and torque (2,), N m, from memory, time (s) and measured state (4,)."""
        raise NotImplementedError

    def start(self, *, dt: float = DT, seed: int = 0) -> Stepper:
        """A run of this controller, which keeps its memory: ``Stepper(self)``."""
        return Stepper(self, dt=dt, seed=seed)

    def torque(self, x: ArrayLike, t: float = 0.0) -> np.ndarray:
        """The first torque (2,), N m, of a run that starts at time t (s) in state x (4,).

        Of a controller without memory that is its torque at any time. One with memory (an
        observer, a rescue, past states) forgets it between such calls: use ``start`` in a loop.

        Raises:
            JaxpendError: numbers of another shape, or that are not finite.
        """
        dtype = jnp.result_type(float)
        state, time = _numbers(x, (4,), "x", dtype), _numbers(t, (), "t", dtype)
        return np.array(_first(_of_type(self, dtype), jax.random.key(0), time, state))
