"""Tensors of inertia: point masses, parallel axes, turned axes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import require, require_positive
from polhode.inertia._cholesky import symmetric


def check_points(masses: Array, positions: Array) -> None:
    """ValueError for an empty set of points, differing lengths, or a mass below zero."""
    count = positions.shape[-2]
    require(count > 0, "positions must hold at least one point, got none; is the file empty?")
    require(
        masses.shape[-1] == count,
        f"masses (..., n) and positions (..., n, 3) must have one n, got {masses.shape} and "
        f"{positions.shape}.",
    )
    require_positive("masses", masses, zero=True)
    require_positive("the sum of the masses", jnp.sum(masses, axis=-1))


def of_points(
    masses: Float[Array, "*b n"], positions: Float[Array, "*b n 3"]
) -> Float[Array, "*b 3 3"]:
    """``sum m (x.x 1 - x x^T)`` about the origin (docs/equations.md, 003: 24)."""
    x, y, z = (positions[..., i] for i in range(3))

    def second(u, v):
        return jnp.sum(masses * u * v, axis=-1)

    xx, yy, zz = second(x, x), second(y, y), second(z, z)
    return symmetric((yy + zz, zz + xx, xx + yy), (-second(y, z), -second(z, x), -second(x, y)))


def offset(mass: Float[Array, "*b"], shift: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """What a mass at distance ``shift`` (..., 3) adds: ``m (d.d 1 - d d^T)`` (Steiner)."""
    return of_points(mass[..., None], shift[..., None, :])


@jax.jit
def turned(
    tensor: Float[Array, "*#b 3 3"], matrix: Float[Array, "*#b 3 3"]
) -> Float[Array, "*b 3 3"]:
    """``R I R^T``, exactly symmetric."""
    exact = jax.lax.Precision.HIGHEST  # accelerators may round matrix products more coarsely
    found = jnp.einsum("...ij,...jk,...lk->...il", matrix, tensor, matrix, precision=exact)
    return (found + jnp.swapaxes(found, -1, -2)) / 2
