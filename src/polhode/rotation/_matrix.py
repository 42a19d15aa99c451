"""Rotation matrices R, ``x_space = R x_body`` (docs/equations.md, 003: 3)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode.rotation._components import matrix_row
from polhode.rotation._input import as_matrices, as_quaternions
from polhode.rotation._quaternion import canonical


def wxyz_to_matrix(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a unit quaternion; either sign of the quaternion gives the same matrix.

    Raises ValueError for a quaternion that is known not to be of unit length.
    """
    return _matrix(as_quaternions(wxyz, unit=True))


@jax.jit  # one program, not one for each operation
def _matrix(wxyz: Array) -> Array:
    q = tuple(wxyz[..., i] for i in range(4))
    return jnp.stack([jnp.stack(matrix_row(q, i), axis=-1) for i in range(3)], axis=-2)


def matrix_to_wxyz(matrix: Float[ArrayLike, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion, scalar part >= 0, of a rotation matrix.

    The symmetric matrix ``4 q q^T`` is linear in R. Its row with the largest diagonal entry (at
    least 1) is parallel to q and far from zero, so that one normalisation gives q without
    cancellation for every rotation, half turns included (after Shepperd 1978).
    The derivative is the one for changes that keep the matrix a rotation.

    Raises ValueError for a matrix that is no rotation (a reflection, a scaling, entries off by more
    than 1e-3); while it is traced the quaternion of such a one is NaN.
    """
    return _quaternion(*as_matrices(matrix))


@jax.jit
def _quaternion(matrix: Array, good: Array) -> Array:
    (a, b, c), (d, e, f), (g, h, i) = (
        (matrix[..., row, 0], matrix[..., row, 1], matrix[..., row, 2]) for row in range(3)
    )
    outer = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    rows = jnp.stack([jnp.stack(row, axis=-1) for row in outer], axis=-2)
    diagonal = jnp.stack([outer[k][k] for k in range(4)], axis=-1)
    largest = jnp.argmax(diagonal, axis=-1)[..., None, None]
    row = jnp.take_along_axis(rows, largest, axis=-2)[..., 0, :]
    unit = canonical(row / jnp.sqrt(jnp.sum(row * row, axis=-1, keepdims=True)))
    return jnp.where(good[..., None], unit, jnp.nan)
