"""Matrices, rotation vectors, axis-angle and modified Rodrigues parameters, and quaternions.

Matrices R carry body to space components, ``x_space = R x_body`` (docs/equations.md, 003: 3);
axis and angle are those of docs/equations.md, 002. Modified Rodrigues parameters are
``p = axis tan(angle/4)``: two sets describe each rotation, one for each sign of the quaternion, one
of length at most 1 (angle up to pi) and its shadow ``-p/|p|**2`` (Schaub and Junkins 1996).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_vectors
from polhode.rotation._quaternion import (
    as_axes,
    as_matrices,
    as_quaternions,
    canonical,
    matrix_row,
)
from polhode.rotation._scalar import arc_ratio, cosine, direction, length, sine_ratio


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
    cancellation for every rotation, angles of pi included (after Shepperd 1978). The derivative is
    the one for changes that keep the matrix a rotation.

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


def rotation_vector_to_wxyz(rotation_vector: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation vector (rad); smooth everywhere, any angle."""
    rotation_vector = as_vectors("rotation_vector", rotation_vector, 3)
    quarter_squared = jnp.sum(rotation_vector * rotation_vector, axis=-1, keepdims=True) / 4
    vector = sine_ratio(quarter_squared) * rotation_vector / 2
    return jnp.concatenate([cosine(quarter_squared), vector], axis=-1)


def wxyz_to_rotation_vector(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3"]:
    """Rotation vector (rad) of length at most pi of a quaternion (its scale does not matter).

    Smooth at the identity, with right derivatives of every order; at an angle of pi, where it jumps
    between two opposite vectors, its derivative is one-sided.
    """
    upper = canonical(as_quaternions(wxyz))
    return 2 * arc_ratio(upper[..., 0], upper[..., 1:])[..., None] * upper[..., 1:]


def axis_angle_to_wxyz(
    axis: Float[ArrayLike, "*b 3"], angle: Float[ArrayLike, "*b"]
) -> Float[Array, "*b 4"]:
    """Unit quaternion of the rotation by ``angle`` (rad) about the unit vector ``axis``.

    Raises ValueError for an axis that is known not to be of unit length.
    """
    axis = as_axes("axis", axis)
    half = jnp.asarray(angle, axis.dtype)[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], axis=-1)


def wxyz_to_axis_angle(
    wxyz: Float[ArrayLike, "*b 4"],
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """Unit axis and angle in [0, pi] (rad) of a quaternion (its scale does not matter).

    At the identity the axis is undefined and (0, 0, 1) is returned. There neither axis nor angle
    has a derivative, and zero is returned for it; `wxyz_to_rotation_vector` is smooth there.
    """
    upper = canonical(as_quaternions(wxyz))
    angle = 2 * jnp.arctan2(length(upper[..., 1:]), upper[..., 0])
    return direction(upper[..., 1:]), angle


def modified_rodrigues_to_wxyz(parameters: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of modified Rodrigues parameters of any length.

    The scalar part is negative for parameters longer than 1, so that each set is given back by
    `wxyz_to_modified_rodrigues` or `wxyz_to_shadow` respectively.
    """
    parameters = as_vectors("parameters", parameters, 3)
    # Both terms are scaled alike, which cannot change the quotient: no overflow for huge
    # parameters, and the derivative of the scale may be left out.
    largest = jnp.max(jnp.abs(parameters), axis=-1, keepdims=True)
    scale = jax.lax.stop_gradient(jnp.maximum(largest, jnp.ones_like(largest)))
    one, scaled = 1 / scale, parameters / scale
    squared = jnp.sum(scaled * scaled, axis=-1, keepdims=True)
    total = one * one + squared
    scalar = 2 * (one * one / total) - 1  # its derivative has no cancellation for long parameters
    return jnp.concatenate([scalar, 2 * one * scaled / total], axis=-1)


def _project(wxyz: Array) -> Array:
    return wxyz[..., 1:] / (length(wxyz) + wxyz[..., 0])[..., None]


def wxyz_to_modified_rodrigues(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3"]:
    """The set of length at most 1, smooth at the identity; its shadow follows at an angle of pi.

    The scale of the quaternion does not matter.
    """
    return _project(canonical(as_quaternions(wxyz)))


def wxyz_to_shadow(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3"]:
    """The set of length at least 1 of a rotation; infinite at the identity."""
    lower = -canonical(as_quaternions(wxyz))
    size = length(lower[..., 1:])
    # norm + scalar = vector**2/(norm - scalar), without cancellation for a negative scalar part
    return lower[..., 1:] * ((length(lower) - lower[..., 0]) / size)[..., None] / size[..., None]


def shadow(parameters: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b 3"]:
    """The other set of the same rotation, ``-p/|p|**2``; infinite for the identity."""
    parameters = as_vectors("parameters", parameters, 3)
    size = length(parameters)[..., None]
    return -(parameters / size) / size
