"""Any Python function of the measured state as a controller: slow, but judged like all others.

So are controllers written for the RealAIGym ``double_pendulum`` package, which are objects.
"""

import copy
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Memoryless
from ..errors import THEIRS, JaxpendError, blame
from ..pytree import pytree, static

__all__ = ["PythonLaw", "is_realaigym", "realaigym"]


def _real(torque: Any) -> np.ndarray:
    """Torques as float64. Raises as numpy does for what is no real number."""
    if np.iscomplexobj(torque):
        raise TypeError("a torque is complex; it must be real")
    return np.asarray(torque, float)


@pytree
class PythonLaw(Memoryless):
    """A plain function ``law(t, x) -> torque``, numpy or anything else, without memory.

    One state at a time: ``t`` is a float in s, ``x`` a numpy array (4,), and the torque (2,) in
    N m. With ``batched`` the law gets all rollouts of a step at once: (n,), (n, 4) -> (n, 2).

    What it costs: the compiled loop stops at every step to call Python. That is about 0.1 ms a
    step, and on top of it the law itself: once a step if batched, else once for every rollout.
    The 3.6 million calls of the robustness benchmark take a law of 10 us over half a minute
    and one of 1 ms an hour. The law must not call jax.
    """

    law: Callable = static()
    batched: bool = static(default=False)
    calls_python: ClassVar = True  # see ``devices.together``

    def _call(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        t, x = np.asarray(t), np.asarray(x)
        name = getattr(self.law, "__name__", "the law")
        times, states = t.ravel(), x.reshape(-1, 4)
        try:
            if self.batched:
                u = self.law(times, states)
            else:
                known = np.isfinite(states).all(axis=1)  # else it diverged, or a hand holds the arm
                rows = zip(times, states, known, strict=True)
                u = [self.law(float(a), b) if ok else (0.0, 0.0) for a, b, ok in rows]
            torque = _real(u)
        except JaxpendError:
            raise
        except THEIRS as error:
            raise JaxpendError(f"{name} cannot be called: {blame(error)}") from None
        if torque.shape != (t.size, 2):
            shape = torque.shape if self.batched else torque.shape[1:]
            wanted = f"({t.size}, 2)" if self.batched else "(2,)"
            raise JaxpendError(f"{name} returns a torque of shape {shape}; it must be {wanted}")
        with np.errstate(over="ignore"):  # what is too large is infinite
            return torque.reshape(*x.shape[:-1], 2).astype(x.dtype)

    def check(self) -> None:
        """Call the law once, hanging at rest. Raises ``JaxpendError`` if it gives no torque."""
        if not callable(self.law):
            raise JaxpendError(f"{self.law!r} is no function of (t, x); write one that is")
        if not np.isfinite(self._call(np.zeros(1, "f4"), np.zeros((1, 4), "f4"))).all():
            name = getattr(self.law, "__name__", "the law")
            raise JaxpendError(f"{name} gives a torque that is not finite, hanging at rest")

    def __call__(self, carry, t, x):
        """The law's torque, (2,)."""
        # As bits: in a thread of its own, where jax calls Python, it would make float64 float32.
        dtype, wide = x.dtype, (x.dtype.itemsize // 4,)

        def call(t, x):
            t, x = (np.ascontiguousarray(bits).view(dtype)[..., 0] for bits in (t, x))
            return self._call(t, x)[..., None].view(np.uint32)

        def bits(value):
            found = jax.lax.bitcast_convert_type(jnp.asarray(value, dtype), jnp.uint32)
            return found.reshape(*jnp.shape(value), *wide)

        shape = jax.ShapeDtypeStruct((2, *wide), jnp.uint32)
        torque = jax.pure_callback(call, shape, bits(t), bits(x), vmap_method="broadcast_all")
        return carry, jax.lax.bitcast_convert_type(torque if wide[0] > 1 else torque[..., 0], dtype)


def is_realaigym(thing: Any) -> bool:
    """Whether it is an object with the methods of a controller of RealAIGym."""
    return not isinstance(thing, type) and callable(getattr(thing, "get_control_output_", None))


def realaigym(controller: Any) -> PythonLaw:
    """A controller object of RealAIGym (``get_control_output_(x, t)``, ``reset_``, ``init_``).

    Every run has a copy of the object as it is now, so that the runs of a sweep do not share its
    memory. A run begins with ``reset`` and ``init`` (or ``reset_`` and ``init_`` alone), as in the
    benchmark of the boards, and calls ``get_control_output``, with the object's own filter and
    compensations, where there is such a method.
    """
    return PythonLaw(_Copies(controller), batched=True)


class _Copies:
    """A law of all rollouts of a step: a call at time 0 begins as many runs as it has rows."""

    def __init__(self, controller: Any) -> None:
        self.__name__ = type(controller).__name__
        self._original, self._running = controller, list[Any]()

    def __call__(self, times: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Torques (n, 2), N m, at times (n,), s, in states (n, 4); 0 where one has diverged."""
        if times[0] == 0 or len(self._running) != len(times):
            self._running = [self._begun() for _ in times]
        torques = np.zeros((len(times), 2))
        for row, (one, t, x) in enumerate(zip(self._running, times, states, strict=True)):
            if np.isfinite(x).all():
                call = getattr(one, "get_control_output", one.get_control_output_)
                torque = _real(call(np.array(x, float), float(t)))
                if torque.shape != (2,):
                    text = f"{self.__name__} returns a torque of shape {torque.shape}"
                    raise JaxpendError(f"{text}; it must be (2,)")
                torques[row] = torque
        return torques

    def _begun(self) -> Any:
        try:
            one = copy.deepcopy(self._original)
        except THEIRS as error:
            text = f"{self.__name__} cannot be copied, and every run needs its own"
            raise JaxpendError(f"{text}: {blame(error)}") from None
        for names in (("reset", "reset_"), ("init", "init_")):
            methods = (getattr(one, name, None) for name in names)
            if begin := next(filter(callable, methods), None):
                begin()
        return one
