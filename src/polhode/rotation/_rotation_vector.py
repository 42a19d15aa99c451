"""Rotation vectors (axis times angle) and axis-angle pairs (docs/equations.md, 002)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode.rotation._input import as_axes, as_quaternions, as_vectors
from polhode.rotation._quaternion import canonical
from polhode.rotation._scalar import arc_ratio, cosine, direction, length, sine_ratio


def rotation_vector_to_wxyz(rotation_vector: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation vector (rad); smooth everywhere, any angle."""
    rotation_vector = as_vectors("rotation_vector", rotation_vector, 3)
    quarter_squared = jnp.sum(rotation_vector * rotation_vector, axis=-1, keepdims=True) / 4
    vector = sine_ratio(quarter_squared) * rotation_vector / 2
    return jnp.concatenate([cosine(quarter_squared), vector], axis=-1)


def wxyz_to_rotation_vector(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3"]:
    """Rotation vector (rad) of length at most pi of a quaternion (its scale does not matter).

    Smooth at the identity, with right derivatives of every order; at a half turn, where it jumps
    between two opposite vectors, its derivative is that of the side taken.
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
