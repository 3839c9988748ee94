"""Any Python function of the measured state as a controller: slow, but judged like all others."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Memoryless
from ..errors import THEIRS, JaxpendError, blame
from ..pytree import pytree, static

__all__ = ["PythonLaw"]


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

    def _call(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        t, x = np.asarray(t), np.asarray(x)
        name = getattr(self.law, "__name__", "the law")
        times, states = t.ravel(), x.reshape(-1, 4)
        try:
            if self.batched:
                u = self.law(times, states)
            else:
                u = [self.law(float(a), b) for a, b in zip(times, states, strict=True)]
            torque = np.asarray(u, x.dtype)
        except THEIRS as error:
            raise JaxpendError(f"{name} cannot be called: {blame(error)}") from None
        if torque.shape != (t.size, 2):
            shape = torque.shape if self.batched else torque.shape[1:]
            wanted = f"({t.size}, 2)" if self.batched else "(2,)"
            raise JaxpendError(f"{name} returns a torque of shape {shape}; it must be {wanted}")
        return torque.reshape(*x.shape[:-1], 2)

    def check(self) -> None:
        """Call the law once, hanging at rest. Raises ``JaxpendError`` if it gives no torque."""
        if not callable(self.law):
            raise JaxpendError(f"{self.law!r} is no function of (t, x); write one that is")
        if not np.isfinite(self._call(np.zeros(1, "f4"), np.zeros((1, 4), "f4"))).all():
            raise JaxpendError("the law gives a torque that is not finite, hanging at rest")

    def __call__(self, carry, t, x):
        """The law's torque, (2,)."""
        shape = jax.ShapeDtypeStruct((2,), x.dtype)
        t = jnp.asarray(t, x.dtype)
        return carry, jax.pure_callback(self._call, shape, t, x, vmap_method="broadcast_all")
