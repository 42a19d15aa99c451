"""Conversions between quaternions, matrices, axis and angle, Rodrigues parameters, Euler angles.

Matrices R carry body to space components, ``x_space = R x_body`` (docs/equations.md, 003: 3);
axis and angle are those of docs/equations.md, 002. Modified Rodrigues parameters are
``p = axis tan(angle/4)``: two sets describe each rotation, one for each sign of the quaternion, one
of length at most 1 (angle up to pi) and its shadow ``-p/|p|**2`` (Schaub and Junkins 1996).

For Euler angles docs/equations.md uses ZYZ, ``R = Rz(phi) Ry(theta) Rz(psi)``; the other 23
sequences are reduced to the same formulas by a quarter turn (Bernardes and Viollet 2022). All
angles are in rad. ``sequence``, by default ZYZ, is a ``Sequence`` or its axes in SciPy's notation:
``"ZYX"`` about body axes, ``"zyx"`` about space axes. Every conversion goes through the unit
quaternion, the only description that is smooth and well scaled everywhere: small rotations retain
their relative accuracy, half turns their axis.
"""

import enum
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_floats, as_vectors
from polhode.rotation._quaternion import (
    arc_ratio,
    as_axes,
    as_matrices,
    as_quaternions,
    canonical,
    cosine,
    direction,
    largest,
    length,
    matrix_row,
    sine_ratio,
)


def wxyz_to_matrix(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a unit quaternion; either sign of the quaternion gives the same matrix.

    Raises ValueError for a concrete quaternion that is not of unit length.
    """
    return _matrix(as_quaternions(wxyz, unit=True))


@jax.jit  # outside jit too, one program for all operations
def _matrix(wxyz: Array) -> Array:
    q = jnp.unstack(wxyz, axis=-1)
    return jnp.stack([jnp.stack(matrix_row(q, i), axis=-1) for i in range(3)], axis=-2)


def matrix_to_wxyz(matrix: Float[ArrayLike, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion, scalar part >= 0, of a rotation matrix.

    The symmetric matrix ``4 q q^T`` is linear in R. Its row with the largest diagonal entry (at
    least 1) is parallel to q and far from zero, so that one normalisation gives q without
    cancellation for every rotation, angles of pi included (after Shepperd 1978). The derivative is
    the one for changes that keep the matrix a rotation.

    Raises ValueError for a matrix that is not a rotation (a reflection, a scaling, errors above
    1e-3); for a traced one the quaternion is NaN.
    """
    return _quaternion_of_matrix(*as_matrices(matrix))


@jax.jit
def _quaternion_of_matrix(matrix: Array, good: Array) -> Array:
    (a, b, c), (d, e, f), (g, h, i) = (
        (matrix[..., row, 0], matrix[..., row, 1], matrix[..., row, 2]) for row in range(3)
    )
    outer = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    # The row with the largest diagonal entry, by comparisons: an index would make the cotangent a
    # scatter, which a fused kernel cannot contain.
    row, largest = jnp.stack(outer[0], axis=-1), outer[0][0]
    for k in range(1, 4):
        is_larger = outer[k][k] > largest
        row = jnp.where(is_larger[..., None], jnp.stack(outer[k], axis=-1), row)
        largest = jnp.where(is_larger, outer[k][k], largest)
    unit = canonical(row / jnp.sqrt(jnp.sum(row * row, axis=-1, keepdims=True)))
    return jnp.where(good[..., None], unit, jnp.nan)


def rotation_vector_to_wxyz(rotation_vector: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation vector (rad), smooth everywhere.

    NaN where the square of the vector overflows; its rounding error then exceeds many turns.
    """
    return _turned_by(as_vectors("rotation_vector", rotation_vector, 3))


@jax.jit
def _turned_by(rotation_vector: Array) -> Array:
    quarter_squared = jnp.sum(rotation_vector * rotation_vector, axis=-1, keepdims=True) / 4
    vector = sine_ratio(quarter_squared) * rotation_vector / 2
    return jnp.concatenate([cosine(quarter_squared), vector], axis=-1)


def wxyz_to_rotation_vector(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3"]:
    """Rotation vector (rad) of length at most pi of a quaternion (its scale does not matter).

    Smooth at the identity, with correct derivatives of every order; at an angle of pi, where it
    jumps between two opposite vectors, its derivative is one-sided.
    """
    return _rotation_vector(as_quaternions(wxyz))


@jax.jit
def _rotation_vector(wxyz: Array) -> Array:
    upper = canonical(wxyz)
    return 2 * arc_ratio(upper[..., 0], upper[..., 1:])[..., None] * upper[..., 1:]


def axis_angle_to_wxyz(
    axis: Float[ArrayLike, "*#b 3"], angle: Float[ArrayLike, "*#b"]
) -> Float[Array, "*b 4"]:
    """Unit quaternion of the rotation by ``angle`` (rad) about the unit vector ``axis``.

    Raises ValueError for a concrete axis that is not of unit length.
    """
    as_axes("axis", axis)
    axis, angle = as_floats(finite=False, axis=(axis, (3,)), angle=(angle, ()))
    half = angle[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], axis=-1)


def wxyz_to_axis_angle(
    wxyz: Float[ArrayLike, "*b 4"],
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """Unit axis and angle in [0, pi] (rad) of a quaternion (its scale does not matter).

    At the identity the axis is undefined and (0, 0, 1) is returned. Neither axis nor angle has a
    derivative there, and zero is returned for it; `wxyz_to_rotation_vector` is smooth there.
    Raises ValueError for a zero quaternion; axis and angle of a traced one are NaN.
    """
    return _axis_angle(as_quaternions(wxyz))


@jax.jit
def _axis_angle(wxyz: Array) -> tuple[Array, Array]:
    upper = canonical(_nan_if_zero(wxyz))
    angle = 2 * jnp.arctan2(length(upper[..., 1:]), upper[..., 0])
    return direction(upper[..., 1:]), angle


def _nan_if_zero(wxyz: Array) -> Array:
    """The quaternions, with NaN in place of zero ones, which describe no rotation."""
    return jnp.where(jnp.any(wxyz != 0, axis=-1, keepdims=True), wxyz, jnp.nan)


def modified_rodrigues_to_wxyz(parameters: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of modified Rodrigues parameters of any length.

    The scalar part is negative for parameters longer than 1. `wxyz_to_modified_rodrigues` returns
    parameters of length up to 1, `wxyz_to_shadow` longer ones.
    """
    return _of_modified_rodrigues(as_vectors("parameters", parameters, 3))


@jax.jit
def _of_modified_rodrigues(parameters: Array) -> Array:
    # A common scale, which cancels in the quotient, avoids overflow for huge parameters. Its
    # derivative may be omitted.
    largest = jnp.max(jnp.abs(parameters), axis=-1, keepdims=True)
    scale = jax.lax.stop_gradient(jnp.maximum(largest, jnp.ones_like(largest)))
    one, scaled = 1 / scale, parameters / scale
    squared = jnp.sum(scaled * scaled, axis=-1, keepdims=True)
    total = one * one + squared
    scalar = 2 * (one * one / total) - 1  # its derivative has no cancellation for long parameters
    return jnp.concatenate([scalar, 2 * one * scaled / total], axis=-1)


@jax.jit
def _modified_rodrigues(wxyz: Array) -> Array:
    upper = canonical(wxyz)
    return upper[..., 1:] / (length(upper) + upper[..., 0])[..., None]


def wxyz_to_modified_rodrigues(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3"]:
    """Modified Rodrigues parameters (..., 3) of length at most 1.

    They are smooth at the identity and jump to the shadow set at an angle of pi.

    The scale of the quaternion does not matter.
    """
    return _modified_rodrigues(as_quaternions(wxyz))


def wxyz_to_shadow(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 3"]:
    """Modified Rodrigues parameters (..., 3) of length at least 1, the shadow set.

    NaN at the identity, where their direction is undefined.
    """
    return _shadow(as_quaternions(wxyz))


@jax.jit
def _shadow(wxyz: Array) -> Array:
    lower = -canonical(wxyz)
    size = length(lower[..., 1:])
    # norm + scalar = vector**2/(norm - scalar), without cancellation for a negative scalar part
    return lower[..., 1:] * ((length(lower) - lower[..., 0]) / size)[..., None] / size[..., None]


def shadow(parameters: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b 3"]:
    """The other set of the same rotation, ``-p/|p|**2``.

    NaN for the identity, whose other set is infinite with an undefined direction.
    """
    parameters = as_vectors("parameters", parameters, 3)
    size = length(parameters)[..., None]
    return -(parameters / size) / size


class Sequence(enum.Enum):
    """Order of the three rotations of Euler angles.

    ``Sequence.ZYZ`` is the convention here, ``R = Rz(phi) Ry(theta) Rz(psi)``. A plain member
    is *intrinsic*: the second and third rotation are about the rotated body axes, and ``R =
    R_i(first) R_j(second) R_k(third)``. A member ending in ``_SPACE`` is *extrinsic*: all rotations
    are about fixed space axes, and ``R = R_k(third) R_j(second) R_i(first)``.

    The second angle lies in [0, pi] when the first and last axis are the same (proper Euler angles)
    and in [-pi/2, pi/2] when all three differ (Tait-Bryan angles).
    """

    XYX = ((0, 1, 0), False)
    XZX = ((0, 2, 0), False)
    YXY = ((1, 0, 1), False)
    YZY = ((1, 2, 1), False)
    ZXZ = ((2, 0, 2), False)
    ZYZ = ((2, 1, 2), False)
    XYZ = ((0, 1, 2), False)
    XZY = ((0, 2, 1), False)
    YXZ = ((1, 0, 2), False)
    YZX = ((1, 2, 0), False)
    ZXY = ((2, 0, 1), False)
    ZYX = ((2, 1, 0), False)
    XYX_SPACE = ((0, 1, 0), True)
    XZX_SPACE = ((0, 2, 0), True)
    YXY_SPACE = ((1, 0, 1), True)
    YZY_SPACE = ((1, 2, 1), True)
    ZXZ_SPACE = ((2, 0, 2), True)
    ZYZ_SPACE = ((2, 1, 2), True)
    XYZ_SPACE = ((0, 1, 2), True)
    XZY_SPACE = ((0, 2, 1), True)
    YXZ_SPACE = ((1, 0, 2), True)
    YZX_SPACE = ((1, 2, 0), True)
    ZXY_SPACE = ((2, 0, 1), True)
    ZYX_SPACE = ((2, 1, 0), True)

    @classmethod
    def of(cls, axes: str) -> "Sequence":
        """The sequence in SciPy's notation: ``"ZYX"`` intrinsic, ``"zyx"`` extrinsic.

        Raises TypeError unless ``axes`` is a string, ValueError unless it has three letters of one
        case, with different neighbours.
        """
        if not isinstance(axes, str):
            raise TypeError(
                f'axes must be a string such as "ZYX", got {type(axes).__name__}: {axes!r:.40}.'
            )
        name = axes.upper() + ("_SPACE" if axes.islower() else "")
        if name not in cls.__members__ or not (axes.islower() or axes.isupper()):
            raise ValueError(
                f"no sequence is called {axes!r}: give three of XYZ about body axes or three of xyz"
                ' about space axes, neighbours different, such as "ZYX" (yaw, pitch, roll).'
            )
        return cls[name]

    @property
    def axes(self) -> tuple[int, int, int]:
        """Axes in the order in which the angles are given; 0, 1, 2 are x, y, z."""
        return self.value[0]

    @property
    def is_extrinsic(self) -> bool:
        """Whether all three rotations are about fixed space axes."""
        return self.value[1]

    @property
    def is_proper(self) -> bool:
        """Whether the first and the last axis are the same."""
        return self.axes[0] == self.axes[2]


def as_sequence(sequence: Any) -> Sequence:
    """A ``Sequence``, also from letters in SciPy's notation; TypeError for anything else."""
    if isinstance(sequence, str):
        return Sequence.of(sequence)
    if not isinstance(sequence, Sequence):
        raise TypeError(
            'sequence must be letters such as "ZYX" (about body axes) or "zyx" (about space axes),'
            f" or a ph.rotation.Sequence, got {type(sequence).__name__}: {sequence!r:.40}."
        )
    return sequence


def _parity(i: int, j: int, k: int) -> int:
    return (i - j) * (j - k) * (k - i) // 2


def _half_sum(left: Array, right: Array) -> tuple[Array, Array]:
    """Cosine and sine of (left + right)/2 for the exact sum instead of the rounded one.

    Near |left + right| = 2 pi the rounding error of the sum would be large compared with a small
    rotation. It is computed exactly (two-sum, Knuth 1969); as it is not a smooth function of the
    angles, its derivative is stopped.
    """
    total = left + right
    right_part = total - left
    rounding_error = jax.lax.stop_gradient((left - (total - right_part)) + (right - right_part)) / 2
    cos, sin = jnp.cos(total / 2), jnp.sin(total / 2)
    return cos - rounding_error * sin, sin + rounding_error * cos


def euler_to_wxyz(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence | str = Sequence.ZYZ,
) -> Float[Array, "*b 4"]:
    """Unit quaternion of Euler angles (rad), smooth for all angles.

    The angles are in the order of the sequence's axes; ``sequence``: a ``Sequence``, or its axes in
    SciPy's notation, ``"ZYX"`` about body axes, ``"zyx"`` about space axes. The sign of the
    quaternion depends continuously on the angles; `canonical` returns the one with scalar part
    >= 0.

    Raises ValueError for letters that are not a sequence, TypeError for other kinds.
    """
    return _quaternion(
        as_sequence(sequence),
        *as_floats(finite=False, phi=(phi, ()), theta=(theta, ()), psi=(psi, ())),
    )


@partial(jax.jit, static_argnums=0)  # outside jit too, one program for all operations
def _quaternion(sequence: Sequence, first: Array, second: Array, third: Array) -> Array:
    i, j, k = sequence.axes
    if sequence.is_extrinsic:
        (i, j, k), first, third = (k, j, i), third, first
    cos, sin = jnp.cos(second / 2), jnp.sin(second / 2)
    if sequence.is_proper:
        k = 3 - i - j
        parity = _parity(i, j, k)
        cos_sum, sin_sum = _half_sum(first, third)
        cos_difference, sin_difference = _half_sum(first, -third)
        parts = {
            -1: cos * cos_sum,
            i: cos * sin_sum,
            j: sin * cos_difference,
            k: parity * sin * sin_difference,
        }
    else:
        parity = _parity(i, j, k)
        cos_a, sin_a = jnp.cos(first / 2), jnp.sin(first / 2)
        cos_c, sin_c = jnp.cos(third / 2), jnp.sin(third / 2)
        parts = {
            -1: cos_a * cos * cos_c - parity * (sin_a * sin * sin_c),
            i: sin_a * cos * cos_c + parity * (cos_a * sin * sin_c),
            j: cos_a * sin * cos_c - parity * (sin_a * cos * sin_c),
            k: cos_a * cos * sin_c + parity * (sin_a * sin * cos_c),
        }
    return jnp.stack([parts[axis] for axis in (-1, 0, 1, 2)], axis=-1)


def _phase(real: Array, imaginary: Array) -> tuple[Array, Array, Array]:
    """Modulus of a complex number, and the number scaled to size about 1 (1 for zero)."""
    pair = jnp.stack([real, imaginary], axis=-1)
    scale = jax.lax.stop_gradient(largest(pair)[..., 0])
    is_zero = scale == 0
    safe = jnp.where(is_zero, jnp.ones_like(scale), scale)
    scaled = jnp.where(is_zero, jnp.ones_like(real), real / safe)
    return length(pair), scaled, jnp.where(is_zero, jnp.zeros_like(real), imaginary / safe)


def wxyz_to_euler(
    wxyz: Float[ArrayLike, "*b 4"], sequence: Sequence | str = Sequence.ZYZ
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]:
    """Euler angles (rad) of a quaternion (its scale and its sign do not matter).

    First and third angle lie in [-pi, pi]; the second in [0, pi] (same first and last axis) or
    [-pi/2, pi/2]. At the ends of the range of the second angle only the sum or the difference of
    the other two is defined, and it is divided equally between them; derivatives of the angles do
    not exist there, and the missing parts are returned as zero. ``sequence`` as for
    `euler_to_wxyz`.

    Raises ValueError for a zero quaternion, and as `euler_to_wxyz` for a ``sequence``; the angles
    of a traced quaternion that is zero are NaN.
    """
    return _angles(as_sequence(sequence), as_quaternions(wxyz))


@partial(jax.jit, static_argnums=0)
def _angles(sequence: Sequence, wxyz: Array) -> tuple[Array, Array, Array]:
    wxyz = _nan_if_zero(wxyz)
    # Without scaling, products of components of tiny or huge quaternions would underflow or
    # overflow. The scale cancels, so that its derivative may be omitted. It is a power of two,
    # because near an end of the range of the second angle rounded components would change the
    # other two.
    size = jax.lax.stop_gradient(largest(wxyz))
    wxyz = wxyz / (size / jnp.frexp(size)[0])
    i, j, k = sequence.axes
    if sequence.is_extrinsic:
        i, j, k = k, j, i
    k = 3 - i - j
    parity = _parity(i, j, k)
    w, along_i, along_j = wxyz[..., 0], wxyz[..., 1 + i], wxyz[..., 1 + j]
    along_k = parity * wxyz[..., 1 + k]
    if sequence.is_proper:
        sums, differences = (w, along_i), (along_j, along_k)
    else:
        # R_i(a) R_j(b) R_k(c) followed by a quarter turn about body axis j is
        # R_i(a) R_j(b + pi/2) R_i(-parity c).
        sums = (w - along_j, along_i - along_k)
        differences = (w + along_j, along_i + along_k)
    sum_size, sum_cos, sum_sin = _phase(*sums)
    difference_size, difference_cos, difference_sin = _phase(*differences)
    # arguments of the products U V and U conj(V), by one arctangent each, within (-pi, pi]
    first = jnp.arctan2(
        sum_cos * difference_sin + sum_sin * difference_cos,
        sum_cos * difference_cos - sum_sin * difference_sin,
    )
    third = jnp.arctan2(
        sum_sin * difference_cos - sum_cos * difference_sin,
        sum_cos * difference_cos + sum_sin * difference_sin,
    )
    if sequence.is_proper:
        second = 2 * jnp.arctan2(difference_size, sum_size)
    else:
        third = -parity * third
        sine = 2 * (w * along_j + along_i * along_k)
        second = jnp.arctan2(sine, sum_size * difference_size)
    if sequence.is_extrinsic:
        first, third = third, first
    return first, second, third


_Angles = tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]


def euler_to_matrix(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence | str = Sequence.ZYZ,
) -> Float[Array, "*b 3 3"]:
    """Rotation matrix R of Euler angles."""
    return wxyz_to_matrix(euler_to_wxyz(phi, theta, psi, sequence))


def matrix_to_euler(
    matrix: Float[ArrayLike, "*b 3 3"], sequence: Sequence | str = Sequence.ZYZ
) -> _Angles:
    """Euler angles of a rotation matrix; ranges and ends as in `wxyz_to_euler`."""
    return wxyz_to_euler(matrix_to_wxyz(matrix), sequence)


def euler_to_rotation_vector(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence | str = Sequence.ZYZ,
) -> Float[Array, "*b 3"]:
    """Rotation vector, of length at most pi, of Euler angles."""
    return wxyz_to_rotation_vector(euler_to_wxyz(phi, theta, psi, sequence))


def rotation_vector_to_euler(
    rotation_vector: Float[ArrayLike, "*b 3"], sequence: Sequence | str = Sequence.ZYZ
) -> _Angles:
    """Euler angles of a rotation vector; ranges and ends as in `wxyz_to_euler`."""
    return wxyz_to_euler(rotation_vector_to_wxyz(rotation_vector), sequence)


def euler_to_axis_angle(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence | str = Sequence.ZYZ,
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b"]]:
    """Unit axis (l, m, n) and angle in [0, pi] of Euler angles (docs/equations.md, 002: 3-12).

    For ZYZ they are those of R; the matrix K of docs/equations.md rotates about ``(l, -m, -n)``.
    """
    return wxyz_to_axis_angle(euler_to_wxyz(phi, theta, psi, sequence))


def axis_angle_to_euler(
    axis: Float[ArrayLike, "*#b 3"],
    angle: Float[ArrayLike, "*#b"],
    sequence: Sequence | str = Sequence.ZYZ,
) -> _Angles:
    """Euler angles of the rotation by ``angle`` about the unit vector ``axis``."""
    return wxyz_to_euler(axis_angle_to_wxyz(axis, angle), sequence)


def euler_to_modified_rodrigues(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence | str = Sequence.ZYZ,
) -> Float[Array, "*b 3"]:
    """Modified Rodrigues parameters, of length at most 1, of Euler angles."""
    return wxyz_to_modified_rodrigues(euler_to_wxyz(phi, theta, psi, sequence))


def modified_rodrigues_to_euler(
    parameters: Float[ArrayLike, "*b 3"], sequence: Sequence | str = Sequence.ZYZ
) -> _Angles:
    """Euler angles of modified Rodrigues parameters, either set."""
    return wxyz_to_euler(modified_rodrigues_to_wxyz(parameters), sequence)


def euler_to_matrix_k(
    phi: Float[ArrayLike, "*#b"], theta: Float[ArrayLike, "*#b"], psi: Float[ArrayLike, "*#b"]
) -> Float[Array, "*b 3 3"]:
    """The matrix K (docs/equations.md, 002): R of the same ZYZ angles with reversed y and z axes.

    ``K(phi, theta, psi) = D R D = R(-phi, -theta, -psi) = R(psi, theta, phi)^T``, with
    ``D = diag(1, -1, -1)``. K is neither R nor its transpose.
    """
    w, x, y, z = jnp.moveaxis(euler_to_wxyz(phi, theta, psi), -1, 0)
    return wxyz_to_matrix(jnp.stack([w, x, -y, -z], axis=-1))
