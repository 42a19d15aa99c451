"""Bounds of unknowns: maps from numbers that may be anything, and their curvature in a fit."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

_BENT = 0.02
"""Distance from a bound within which values are bent, over that of the start."""


def to_bounded(number: Array, start: Array, low: Array, high: Array) -> Array:
    """A value between its bounds; any number may be given.

    At one bound a hyperbola, ``low + sqrt(s^2 + number^2) - s``: a straight line but for a parabola
    near the bound, where steps may arrive from either side. A smooth maximum, flat beyond the bound
    and bent as far from it as the start, took hundreds of steps: of 24 recordings of a body without
    one of two kinds of drag it found 3 in time, this finds all. At two bounds a sigmoid.
    """
    side, end, soft, has_bound = _one_sided(start, low, high)
    half, middle, has_both = _two_sided(low, high)
    y = (number - middle) / half
    between = middle + half * y / jnp.sqrt(1 + y**2)
    distance = number**2 / (soft + jnp.sqrt(soft**2 + number**2))
    return jnp.where(has_both, between, jnp.where(has_bound, end + side * distance, number))


def to_unbounded(value: Array, start: Array, low: Array, high: Array) -> Array:
    """The inverse of ``to_bounded``."""
    side, end, soft, has_bound = _one_sided(start, low, high)
    half, middle, has_both = _two_sided(low, high)
    y = jnp.where(has_both, (value - middle) / half, 0)
    between = middle + half * y / jnp.sqrt(1 - y**2)
    distance = jnp.where(has_bound, side * (value - end), 1)
    inside = jnp.sqrt(distance * (distance + 2 * soft))
    return jnp.where(has_both, between, jnp.where(has_bound, inside, value))


def _two_sided(low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Half the width between two bounds, their middle, and whether there are two."""
    half, middle = (high - low) / 2, (high + low) / 2
    has_both = jnp.isfinite(half)
    return jnp.where(has_both, half, 1), jnp.where(has_both, middle, 0), has_both


def _one_sided(start: Array, low: Array, high: Array) -> tuple[Array, Array, Array, Array]:
    """Of one bound the sign of values inside, the bound, the distance within which values are bent,
    and whether there is one."""
    side = jnp.where(jnp.isfinite(low), 1, -1)
    has_bound = jnp.isfinite(low) | jnp.isfinite(high)
    end = jnp.where(jnp.isfinite(low), low, jnp.where(jnp.isfinite(high), high, 0))
    # any positive number where there is no bound, for finite derivatives of what is not chosen
    return side, end, jnp.where(has_bound, _BENT * jnp.abs(start - end), 1), has_bound


def curvature_rows(bounded: Callable, scaled: Any, scale: Any, cost_at: Callable) -> list[Array]:
    """Residuals of value zero that add the curvature of the bounds to Gauss-Newton steps.

    Of a cost C(x(n)), x the bounded value of a number n, the second derivative is x'^2 C'' + x''
    C'. Steps know the first term only, and where C' presses x against its bound, as a parabola in
    n, that vanishes with n: they would go to and fro across it (8 of the 24 recordings of
    ``to_bounded`` stopped at the limit). ``bounded``: x of n, elementwise; ``scaled`` times
    ``scale``: the present n; ``cost_at``: C near them, a function of x.
    """
    numbers = jax.tree.map(lambda a, b: a.astype(b.dtype) * b, scaled, scale)
    numbers = jax.lax.stop_gradient(numbers)

    def slope(step):
        moved = jax.tree.map(lambda n, b: n + step * b, numbers, scale)
        return jax.jvp(bounded, (moved,), (scale,))[1]

    zero = jnp.zeros((), jax.tree.leaves(numbers)[0].dtype)
    bends = jax.jvp(slope, (zero,), (jnp.ones_like(zero),))[1]
    slopes = jax.grad(cost_at)(jax.lax.stop_gradient(bounded(numbers)))
    rows = []
    for x, bend, by_value in zip(*map(jax.tree.leaves, (scaled, bends, slopes))):
        size = jax.lax.stop_gradient(jnp.sqrt(jnp.maximum(bend * by_value, 0)))
        rows.append(jnp.ravel(size * (x - jax.lax.stop_gradient(x)).astype(size.dtype)))
    return rows
