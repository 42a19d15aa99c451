"""Values that are worked out once, and not again in every loop that uses them."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


def opaque_ones(x: Array) -> Array:
    """Ones of the shape of x that the compiler cannot know to be ones (NaN where x is)."""
    x = jax.lax.stop_gradient(x)
    return jnp.where(jnp.isnan(x), x, 1)


def staged(values: Any, *ones: Array) -> Any:
    """The same values, each divided by the ``ones`` of its own shape.

    The compiler repeats cheap arithmetic in every fused loop that needs its result, but never a
    division; it drops optimisation barriers before fusing on the CPU. A division by a broadcast
    scalar would be a multiplication to it. Truth values stay as they are.
    """

    def divided(x):
        if x.dtype == bool:
            return x
        one = next((one for one in ones if one.shape == x.shape), ones[0])
        return x / (one if one.ndim >= x.ndim else jnp.broadcast_to(one, x.shape))

    return jax.tree.map(divided, values)
