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
