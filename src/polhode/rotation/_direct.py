"""Euler angles to and from every other description, through the unit quaternion.

The quaternion is the only description that is smooth and well scaled everywhere, so that going
through it loses nothing: small rotations keep their relative accuracy, half turns their axis.
All angles are in rad; ``sequence`` defaults to ZYZ.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode.rotation._euler import euler_to_wxyz, wxyz_to_euler
from polhode.rotation._matrix import matrix_to_wxyz, wxyz_to_matrix
from polhode.rotation._modified_rodrigues import (
    modified_rodrigues_to_wxyz,
    wxyz_to_modified_rodrigues,
)
from polhode.rotation._rotation_vector import (
    axis_angle_to_wxyz,
    rotation_vector_to_wxyz,
    wxyz_to_axis_angle,
    wxyz_to_rotation_vector,
)
from polhode.rotation._sequence import Sequence

_Angles = tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]


def euler_to_matrix(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence = Sequence.ZYZ,
) -> Float[Array, "*b 3 3"]:
    """Rotation matrix R of Euler angles."""
    return wxyz_to_matrix(euler_to_wxyz(phi, theta, psi, sequence))


def matrix_to_euler(
    matrix: Float[ArrayLike, "*b 3 3"], sequence: Sequence = Sequence.ZYZ
) -> _Angles:
    """Euler angles of a rotation matrix; ranges and ends as in `wxyz_to_euler`."""
    return wxyz_to_euler(matrix_to_wxyz(matrix), sequence)


def euler_to_rotation_vector(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence = Sequence.ZYZ,
) -> Float[Array, "*b 3"]:
    """Rotation vector, of length at most pi, of Euler angles."""
    return wxyz_to_rotation_vector(euler_to_wxyz(phi, theta, psi, sequence))


def rotation_vector_to_euler(
    rotation_vector: Float[ArrayLike, "*b 3"], sequence: Sequence = Sequence.ZYZ
) -> _Angles:
    """Euler angles of a rotation vector; ranges and ends as in `wxyz_to_euler`."""
    return wxyz_to_euler(rotation_vector_to_wxyz(rotation_vector), sequence)


def euler_to_axis_angle(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence = Sequence.ZYZ,
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """Unit axis and angle in [0, pi] of Euler angles: robust (docs/equations.md, 002: 3-12).

    For ZYZ the axis is that of R; the matrix K turns about ``(l, -m, -n)``.
    """
    return wxyz_to_axis_angle(euler_to_wxyz(phi, theta, psi, sequence))


def axis_angle_to_euler(
    axis: Float[ArrayLike, "*b 3"], angle: Float[ArrayLike, "*b"], sequence: Sequence = Sequence.ZYZ
) -> _Angles:
    """Euler angles of the rotation by ``angle`` about the unit vector ``axis``."""
    return wxyz_to_euler(axis_angle_to_wxyz(axis, angle), sequence)


def euler_to_modified_rodrigues(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence = Sequence.ZYZ,
) -> Float[Array, "*b 3"]:
    """Modified Rodrigues parameters, of length at most 1, of Euler angles."""
    return wxyz_to_modified_rodrigues(euler_to_wxyz(phi, theta, psi, sequence))


def modified_rodrigues_to_euler(
    parameters: Float[ArrayLike, "*b 3"], sequence: Sequence = Sequence.ZYZ
) -> _Angles:
    """Euler angles of modified Rodrigues parameters, either set."""
    return wxyz_to_euler(modified_rodrigues_to_wxyz(parameters), sequence)


def euler_to_matrix_k(
    phi: Float[ArrayLike, "*#b"], theta: Float[ArrayLike, "*#b"], psi: Float[ArrayLike, "*#b"]
) -> Float[Array, "*b 3 3"]:
    """The matrix K (docs/equations.md, 002): R of the same ZYZ angles, y and z axes reversed.

    ``K(phi, theta, psi) = D R D = R(-phi, -theta, -psi) = R(psi, theta, phi)^T``, with
    ``D = diag(1, -1, -1)``. K is neither R nor its transpose.
    """
    w, x, y, z = jnp.moveaxis(euler_to_wxyz(phi, theta, psi), -1, 0)
    return wxyz_to_matrix(jnp.stack([w, x, -y, -z], axis=-1))
