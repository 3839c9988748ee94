"""Trigonometric functions that a CPU computes fast in float32; in float64 they are jax's own.

Short polynomials, of which XLA makes vector instructions; their coefficients are those of
Moshier's Cephes library (``sinf``, ``cosf``, ``atanf``).
"""

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["arctan", "sincos"]


@jax.jit
def sincos(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine (...) of (...) rad; in float32 to 8e-8 by one reduction for both.

    XLA's own took most of the time of a step on a CPU. The reduction to [-pi/4, pi/4] in three
    parts is good to 8000 rad; far beyond, where a float32 means nothing, both stay within [-1, 1].
    """
    return _sincos(x)


@jax.custom_jvp
def _sincos(x):
    if jnp.result_type(x) != jnp.float32:
        return jnp.sin(x), jnp.cos(x)
    turns = jnp.round(x * (2 / np.pi))  # in quarters
    r = ((x - turns * 1.5703125) - turns * 4.837512969970703e-4) - turns * 7.549789954891882e-8
    r = jnp.clip(r, -0.8, 0.8)
    z = r * r
    sin = ((-1.9515295891e-4 * z + 8.3321608736e-3) * z - 1.6666654611e-1) * z * r + r
    cos = (2.443315711809948e-5 * z - 1.388731625493765e-3) * z + 4.166664568298827e-2
    cos = cos * z * z - 0.5 * z + 1
    # Not by an integer, into which a diverged angle does not fit, nor by a remainder, a slow call.
    half = jnp.floor(0.5 * turns)
    odd, sign = turns != 2 * half, 1 - 2 * (half - 2 * jnp.floor(0.5 * half))
    return sign * jnp.where(odd, cos, sin), sign * jnp.where(odd, -sin, cos)


@_sincos.defjvp
def _slopes(primals, tangents):
    """Each is the slope of the other: cheaper than those of the polynomials, and exact."""
    (sin, cos), (tangent,) = _sincos(*primals), tangents
    return (sin, cos), (cos * tangent, -sin * tangent)


@jax.jit
def arctan(x: jax.Array) -> jax.Array:
    """Arctangent (...), rad; in float32 to 1.4e-7 by one division and a short polynomial.

    The reduction is to [0, tan(pi/8)].
    """
    if jnp.result_type(x) != jnp.float32:
        return jnp.arctan(x)
    a = jnp.abs(x)
    middle, far = a > 0.41421356, a > 2.41421356
    numerator = jnp.where(far, -1.0, jnp.where(middle, a - 1.0, a))
    r = numerator / jnp.where(far, a, jnp.where(middle, a + 1.0, 1.0))
    offset = jnp.where(far, jnp.pi / 2, jnp.where(middle, jnp.pi / 4, 0.0))
    z = r * r
    p = ((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z - 3.33329491539e-1
    y = offset + (p * z * r + r)
    return jnp.where(x < 0, -y, y)
