"""Rotation matrices R, ``x_space = R x_body`` (theory section 1; document 003 display 3)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.rotation._quaternion import canonical


def wxyz_to_matrix(wxyz: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a unit quaternion; either sign of the quaternion gives the same matrix."""
    w, x, y, z = (wxyz[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_wxyz(matrix: Float[Array, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion, scalar part >= 0, of a rotation matrix.

    The symmetric matrix ``4 q q^T`` is linear in R. Its row with the largest diagonal entry (at
    least 1) is parallel to q and far from zero, so that one normalisation gives q without
    cancellation for every rotation, half turns included (after Shepperd 1978).
    The derivative is the one for changes that keep the matrix a rotation.
    """
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
    return canonical(row / jnp.sqrt(jnp.sum(row * row, axis=-1, keepdims=True)))
