"""Values whose derivatives are not known: they become NaN, never numbers that are wrong."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._kernels._linear import linear


@jax.custom_jvp
def underivable(x: Array, where: Array) -> Array:
    """``x``, with NaN for its derivatives ``where`` (of the shape of x) it has a tangent.

    Tangents and cotangents that are zero stay zero: what does not depend on ``x`` is not affected.
    """
    del where
    return x


@underivable.defjvp
def _underivable_rule(primals, tangents):
    x, where = primals
    return underivable(x, where), linear(_spoiled, _spoiled, [where], [tangents[0]], [x])[0]


def _spoiled(given: Any, tangents: Any) -> list[Array]:
    (where,), (tangent,) = given, tangents
    return [jnp.where(where & (tangent != 0), np.nan, tangent)]


def are_close(first: Array, second: Array) -> Array:
    """Where two numbers agree to half of their digits."""
    limit = jnp.finfo(first.dtype).eps ** 0.5
    return jnp.abs(first - second) <= limit * jnp.maximum(jnp.abs(first), jnp.abs(second))


def over_gap(entry: Array, first: Array, second: Array) -> Array:
    """``entry / (first - second)`` of an entry whose value is zero; all of one shape.

    It counts in derivatives alone. Where the two agree to half of their digits the derivative by
    the entry is NaN: it loses digits in proportion to their relative difference.
    """
    close = are_close(first, second)
    return underivable(entry, close) / jnp.where(close, 1, first - second)


@jax.custom_jvp
def derivable_once(x: Array, where: Array) -> Array:
    """``x`` (..., n) with its first derivatives, and NaN for the second ones by any two of its last
    axis ``where`` they are taken."""
    del where
    return x


@derivable_once.defjvp
def _once_rule(primals, tangents):
    x, where = primals
    one = 1 + jnp.sum(underivable(x, where) - x, axis=-1, keepdims=True)
    return derivable_once(x, where), tangents[0] * one
