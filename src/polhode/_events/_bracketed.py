"""Roots of many functions at once, each within its bracket."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

_MOST = 100
"""Evaluations: halving alone would need about sixty."""


def bracketed(
    fn: Callable[[Array], tuple[Array, Array]],
    low: Array,
    high: Array,
    at_low: Array,
    at_high: Array,
    use: Array,
) -> tuple[Array, Array]:
    """Roots of ``fn``, entry by entry, between ``low`` and ``high``, to a few units in the last
    place of the larger; entries that are not in ``use`` stay at ``low``. ``fn`` returns its values
    and something else, which is returned as it is where the root was last looked at.

    Inverse quadratic interpolation where it is safe, halving elsewhere: T. R. Chandrupatla, Adv.
    Eng. Software 28 (1997) 145.
    """
    tolerance = 2 * jnp.finfo(low.dtype).eps * jnp.maximum(jnp.abs(low), jnp.abs(high))

    def on(walk):
        count, done = walk[0], walk[1]
        return (count < _MOST) & ~jnp.all(done)

    def one(walk):
        count, done, x1, x2, f1, f2, share, more = walk
        x = x1 + share * (x2 - x1)
        f, also = fn(jnp.where(done, low, x))
        same = jnp.sign(f) == jnp.sign(f1)
        x3, f3 = jnp.where(same, x1, x2), jnp.where(same, f1, f2)
        new2, g2 = jnp.where(same, x2, x1), jnp.where(same, f2, f1)
        bracket = jnp.abs(new2 - x)
        limit = tolerance / jnp.where(bracket > 0, bracket, 1)
        stop = (bracket <= 2 * tolerance) | (f == 0)
        a, b, c = f - g2, f3 - g2, f3 - f
        ab, ac, bc = (jnp.where(z == 0, 1, z) for z in (a, c, b))
        across = jnp.where(x3 == new2, 1, x3 - new2)
        xi, phi = (x - new2) / across, a / bc
        safe = (phi * phi < xi) & ((1 - phi) * (1 - phi) < 1 - xi)
        span = jnp.where(new2 == x, 1, new2 - x)
        inverse = -(f / ab) * (-f3 / bc) + (x3 - x) / span * (f / ac) * (g2 / bc)
        new = jnp.clip(jnp.where(safe, inverse, 0.5), limit, 1 - limit)

        def kept(old, new):
            return jnp.where(done, old, new)

        found = kept(x1, x), kept(x2, new2), kept(f1, f), kept(f2, g2), kept(share, new)
        found = (*found, kept(more, also))
        return count + 1, done | stop, *found

    zero = at_low == 0
    start = jnp.where(zero, low, high), low, jnp.where(zero, at_low, at_high), at_low
    done = ~use | zero | (at_high == 0)
    walk = (0, done, *start, jnp.full_like(low, 0.5), jnp.zeros_like(low))
    _, _, x1, x2, f1, f2, _, more = jax.lax.while_loop(on, one, walk)
    root = jnp.where(jnp.abs(f1) <= jnp.abs(f2), x1, x2)
    return jnp.where(use, root, low), more
