"""Any Python function of the measured state as a controller: slow, but through the same door."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..controller import Memoryless
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
        shape = (*x.shape[:-1], 2)
        if self.batched:
            u = self.law(t.reshape(-1), x.reshape(-1, 4))
        else:
            u = [self.law(float(a), b) for a, b in zip(t.ravel(), x.reshape(-1, 4), strict=True)]
        return np.asarray(u, x.dtype).reshape(shape)

    def __call__(self, carry, t, x):
        """The law's torque, (2,)."""
        shape = jax.ShapeDtypeStruct((2,), x.dtype)
        t = jnp.asarray(t, x.dtype)
        return carry, jax.pure_callback(self._call, shape, t, x, vmap_method="broadcast_all")
