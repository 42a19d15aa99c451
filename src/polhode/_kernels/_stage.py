"""Values that are worked out once, and not again in every loop that uses them."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import _policy


def opaque_ones(x: Array) -> Array:
    """Ones of the shape of x that XLA cannot know to be ones, but LLVM after it does.

    Half of a truth value, rounded down, is zero: XLA does not look at the bits of a number. So it
    stages what is divided by them, and LLVM drops the division.
    """
    if not _policy.is_staged():
        return jnp.ones_like(x)
    half = (jax.lax.stop_gradient(x) > 0).astype(jnp.int32) >> 1
    return 1 + half.astype(x.dtype)


def staged(values: Any, *ones: Array) -> Any:
    """The same values, each divided by the ``ones`` of its own shape.

    The compiler repeats cheap arithmetic in every fused loop that needs its result, but never a
    division; it drops optimisation barriers before fusing on the CPU. A division by a broadcast
    scalar would be a multiplication to it: of arrays of one body too, the ones need every axis.
    Conditions are staged as numbers. What else is no float stays as it is.
    """

    if not _policy.is_staged():
        return values

    def divided(x):
        if x.dtype == bool:
            return divided(x.astype(ones[0].dtype)) > 0
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        one = next((one for one in ones if one.shape == x.shape), ones[0])
        return x / (one if one.ndim >= x.ndim else jnp.broadcast_to(one, x.shape))

    return jax.tree.map(divided, values)


def computed_once(values: Any) -> Any:
    """The same values behind an optimisation barrier: they are computed once, and not anew for
    each result that follows from them, where XLA has not yet fused the computation."""
    return jax.lax.optimization_barrier(values) if _policy.is_staged() else values
