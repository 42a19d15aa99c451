"""Natural units of a state, in which errors are measured."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array


def weighted_length(weights: list[Array], error: list[Array]) -> Array:
    """Length of a vector whose components have ``weights``."""
    square = sum((w * e) ** 2 for w, e in zip(weights, error))
    return jnp.sqrt(jax.lax.stop_gradient(square))


class GroupUnits(eqx.Module):
    """Natural units of any state: each subtree at its top is a vector, measured by its length.

    What is zero is measured by what its rate makes of it in the time ``span`` [s].
    """

    groups: tuple[int, ...] = eqx.field(static=True)
    span: Array

    @classmethod
    def of(cls, y: Any, span: Array) -> "GroupUnits":
        """Of states like ``y``."""
        parts = [y] if eqx.is_array(y) else jax.tree.leaves(y, is_leaf=lambda x: x is not y)
        return cls(tuple(len(jax.tree.leaves(part)) for part in parts), span)

    def __call__(self, y: list[Array], rates: list[Array]) -> tuple[list[Array], Array]:
        weights, square, start = [], jnp.zeros_like(y[0]), 0
        for count in self.groups:
            these = slice(start, start + count)
            size = sum(x * x for x in y[these])
            size = size + 1e-6 * sum((self.span.astype(x.dtype) * x) ** 2 for x in rates[these])
            weight = 1 / jnp.sqrt(jnp.where(size > 0, size, 1))
            square = square + sum((weight * x) ** 2 for x in rates[these])
            weights += [weight] * count
            start += count
        return weights, jnp.sqrt(square)
