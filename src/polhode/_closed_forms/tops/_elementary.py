"""Tops that elementary functions solve: decaying and driven spin, precession about a fixed L."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.rotation import multiply, rotation_vector_to_wxyz


def decay(rate: Array, t: Array) -> Array:
    """(1 - exp(-k t))/k, t at k = 0: the integral of exp(-k t) [s]."""
    x = rate * t
    near = jnp.abs(x) < 0.5
    far = jnp.where(near, 1, x)
    return t * jnp.where(near, _series(x, 1), -jnp.expm1(-far) / far)


def decay_twice(rate: Array, t: Array) -> Array:
    """(t - decay)/k, t^2/2 at k = 0: the integral of ``decay`` [s^2]."""
    x = rate * t
    near = jnp.abs(x) < 0.5
    far = jnp.where(near, 1, x)
    return t * t * jnp.where(near, _series(x, 2), (far + jnp.expm1(-far)) / (far * far))


def _series(x: Array, first: int) -> Array:
    """Sum of (-x)^n/(n + first)! for |x| < 1/2."""
    total, n = jnp.ones_like(x), 14
    for k in range(n + first, first, -1):
        total = 1 - x * total / k
    return total / first


def spin(
    start: Array, rate: Array, gain: Array, t: Array
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Rate [rad/s] and angle [rad] of ds/dt = gain - rate s from s = ``start``."""
    once = decay(rate, t)
    return start * jnp.exp(-rate * t) + gain * once, start * once + gain * decay_twice(rate, t)


def turn(axis: tuple[Array, Array, Array], angle: Array) -> Float[Array, "*b 4"]:
    """Unit quaternion of a turn by ``angle`` [rad] about the unit ``axis``."""
    c, s = jnp.cos(angle / 2), jnp.sin(angle / 2)
    return jnp.stack(jnp.broadcast_arrays(c, *(s * a for a in axis)), axis=-1)


def precession(
    wxyz: Float[Array, "*b 4"],
    momentum_space: Float[Array, "*b 3"],
    transverse: Array,
    own: Array,
    elapsed: Float[Array, "*b t"],
) -> Float[Array, "*b t 4"]:
    """Attitude of a symmetric body whose momentum keeps its direction (steady precession).

    The axis turns about ``momentum_space`` at |L|/A while the body turns about its axis at ``own``
    = omega_z - L_z/A [rad/s]; ``elapsed``: time, or the integral of what both decay by.
    """
    rate = momentum_space / transverse[..., None]
    outer = rotation_vector_to_wxyz(rate[..., None, :] * elapsed[..., None])  # regular at rest
    zero = jnp.zeros_like(elapsed)
    inner = turn((zero, zero, zero + 1), own[..., None] * elapsed)
    middle = jnp.broadcast_to(wxyz[..., None, :], outer.shape)
    return multiply(multiply(outer, middle), inner)
