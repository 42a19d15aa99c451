"""Unit quaternions, scalar first (``wxyz``), that rotate body components into space components.

Every function takes arrays of shape (..., 4) (quaternions) and (..., 3) (vectors), broadcasts
leading axes together, and preserves the dtype of its input. The matrix and the rate of a quaternion
are implemented once, for component arrays. Conversions of scalar-last quaternions and of SciPy's
``Rotation`` are here as well.

Shapes of arguments are always checked, values only if they are concrete. Under ``jit``, ``vmap``
and ``grad`` no error can be raised: a matrix that is not a rotation becomes NaN, and a quaternion
that is not of unit length is used unchanged.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_floats,
    as_vectors,
    batch_of,
    describe,
    is_concrete,
    on_host,
    require,
)
from polhode._kernels import smooth

# Scalar functions of the conversions, differentiable wherever the exact functions are. Automatic
# differentiation fails at a square root of zero, a quotient 0/0 or an arctangent of two zeros. Each
# function here has its analytic derivative, which is written with functions that are smooth
# themselves, so that second derivatives are correct as well.


@smooth
def largest(vector: Array) -> Array:
    """Largest absolute component (..., 1). It is used only as a scale that cancels, so that results
    are smooth although the largest component changes."""
    return jnp.max(jnp.abs(vector), axis=-1, keepdims=True)


def _dot(left: Array, right: Array) -> Array:
    return jnp.sum(left * right, axis=-1)


@jax.custom_jvp
def length(vector: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Euclidean length over the last axis, without overflow or underflow.

    Its derivative at the zero vector, where none exists, is returned as zero.
    """
    scale = largest(vector)[..., 0]
    safe = jnp.where(scale > 0, scale, jnp.ones_like(scale))
    scaled = vector / safe[..., None]
    return scale * jnp.sqrt(_dot(scaled, scaled))


@jax.custom_jvp
def direction(vector: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """Unit vector along ``vector``; the last axis (0, ..., 0, 1) for the zero vector."""
    scale = largest(vector)
    is_zero = scale == 0
    last = jnp.zeros_like(vector).at[..., -1].set(1)
    scaled = jnp.where(is_zero, last, vector / jnp.where(is_zero, jnp.ones_like(scale), scale))
    return scaled / jnp.sqrt(_dot(scaled, scaled))[..., None]


@length.defjvp
def _length_jvp(primals, tangents):
    (vector,), (tangent,) = primals, tangents
    size = length(vector)
    along = _dot(direction(vector), tangent)
    return size, jnp.where(size > 0, along, jnp.zeros_like(along))


@direction.defjvp
def _direction_jvp(primals, tangents):
    # Contains only 1/length: the quotient rule of automatic differentiation would form
    # 1/length**2, which overflows for vectors of 1e-200.
    (vector,), (tangent,) = primals, tangents
    unit = direction(vector)
    size = length(vector)[..., None]
    is_zero = size == 0
    across = tangent - unit * _dot(unit, tangent)[..., None]
    direction_rate = across / jnp.where(is_zero, jnp.ones_like(size), size)
    return unit, jnp.where(is_zero, jnp.zeros_like(direction_rate), direction_rate)


# --- sin(a)/a as a function of a**2 --------------------------------------------------------------

# Above a**2 = 4 cancellation in the closed form of (a - sin a)/a**3 loses less than a factor of
# two in accuracy; below, the power series with the terms j = 0 .. 12 has converged, as has its
# second derivative.
_SERIES_BELOW = 4.0
_CUBIC_SERIES = tuple((-1) ** j / math.factorial(2 * j + 3) for j in range(13))


@jax.custom_jvp
def sine_ratio(squared: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """``sin(a)/a`` from ``a**2``; 1 at zero, smooth there."""
    positive = squared > 0
    angle = jnp.sqrt(jnp.where(positive, squared, jnp.ones_like(squared)))
    return jnp.where(positive, jnp.sin(angle) / angle, jnp.ones_like(squared))


def _cubic_ratio(squared: Array) -> Array:
    """``(a - sin a)/a**3`` from ``a**2``."""
    is_near_zero = squared < _SERIES_BELOW
    small_square = jnp.where(is_near_zero, squared, jnp.zeros_like(squared))
    large_square = jnp.where(is_near_zero, jnp.full_like(squared, _SERIES_BELOW), squared)
    series = jnp.polyval(jnp.asarray(_CUBIC_SERIES[::-1], squared.dtype), small_square)
    return jnp.where(is_near_zero, series, (1 - sine_ratio(large_square)) / large_square)


@sine_ratio.defjvp
def _sine_ratio_jvp(primals, tangents):
    # d/dn c1 = -(c2 - c3)/2 for Stumpff's functions, with c2 = (1 - cos a)/a**2.
    (squared,), (tangent,) = primals, tangents
    half = sine_ratio(squared / 4)
    slope = -(half * half / 2 - _cubic_ratio(squared)) / 2
    return sine_ratio(squared), slope * tangent


@jax.custom_jvp
def cosine(squared: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """``cos(a)`` from ``a**2``, smooth at zero."""
    positive = squared > 0
    angle = jnp.sqrt(jnp.where(positive, squared, jnp.ones_like(squared)))
    return jnp.where(positive, jnp.cos(angle), jnp.ones_like(squared))


@cosine.defjvp
def _cosine_jvp(primals, tangents):
    (squared,), (tangent,) = primals, tangents
    return cosine(squared), -sine_ratio(squared) / 2 * tangent


# --- half angle of a quaternion over the length of its vector part -------------------------------

# h(c) = (c s - A)/(2 s**3) with c = cos A, s = sin A, on 0 <= c <= 1, where it is analytic: the
# Chebyshev interpolant of degree 25 in x = 2 c - 1, in powers of x, for the whole range. Its error
# is 6e-20, so that its first two derivatives are also accurate to rounding error.
_ARC_SLOPE = (
    -0.47279971743743015587,
    0.19386694922923651107,
    -0.074844067694351302865,
    0.027951035895165174228,
    -0.010221751284606706654,
    0.0036844634160227834663,
    -0.0013141241435336877061,
    0.00046494500831136438395,
    -0.00016346050648811383662,
    5.7174091417565572612e-5,
    -1.9913653589420472045e-5,
    6.9113636165458511614e-6,
    -2.3914898532519324692e-6,
    8.253636545333793857e-7,
    -2.8419112529355782942e-7,
    9.7663674960293114079e-8,
    -3.3543934276893109002e-8,
    1.1493384813087104926e-8,
    -3.8772870859793396836e-9,
    1.3208441706010904031e-9,
    -5.0068724386336248337e-10,
    1.729816384232066061e-10,
    -2.9043730830260218537e-11,
    9.0400531347674008863e-12,
    -1.3460551466144728653e-11,
    4.7073746409958029524e-12,
)


@jax.custom_jvp
def arc_ratio(scalar: Float[Array, "*b"], vector: Float[ArrayLike, "*b 3"]) -> Float[Array, "*b"]:
    """``atan2(r, scalar)/r`` with ``r`` the length of ``vector``, for ``scalar >= 0``.

    Half the rotation angle of a quaternion over the length of its vector part: 1/scalar at r = 0.
    """
    size = length(vector)
    is_zero = size == 0
    safe = jnp.where(is_zero, jnp.ones_like(size), size)
    return jnp.where(
        is_zero, 1 / jnp.where(is_zero, scalar, safe), jnp.arctan2(safe, scalar) / safe
    )


@arc_ratio.defjvp
def _arc_ratio_jvp(primals, tangents):
    (scalar, vector), (scalar_tangent, vector_tangent) = primals, tangents
    norm = length(jnp.concatenate([scalar[..., None], vector], axis=-1))
    slope = jnp.polyval(jnp.asarray(_ARC_SLOPE[::-1], scalar.dtype), 2 * (scalar / norm) - 1)
    # separate divisions, because powers of lengths above 1e13 overflow in single precision
    along = _dot(vector / norm[..., None], vector_tangent)
    change = (2 * slope * along - scalar_tangent) / norm / norm
    return arc_ratio(scalar, vector), change


_UNIT = 1e-3
"""Tolerance of unit length and orthogonality, for numbers that were rounded for printing."""


# Checks of arguments, and the functions of quaternions.


def as_quaternions(value: Any, name: str = "wxyz", *, unit: bool = False) -> Array:
    """Quaternions (..., 4); ValueError for concrete ones that are zero or, with ``unit``, not of
    unit length."""
    wxyz = as_vectors(name, value, 4)
    if is_concrete(wxyz):
        _check_length(name, np.asarray(wxyz), unit, "(1, 0, 0, 0) is no rotation, scalar first")
    return wxyz


def as_axes(name: str, value: Any) -> Array:
    """Unit vectors (..., 3); ValueError for concrete ones that are not of unit length."""
    axes = as_vectors(name, value, 3)
    if is_concrete(axes):
        _check_length(name, np.asarray(axes), True, "divide the axis by its length")
    return axes


@np.errstate(over="ignore")
def _check_length(name: str, values: np.ndarray, unit: bool, hint: str) -> None:
    if values.dtype.kind != "f":
        values = values.astype(np.float32)  # einsum does not support bfloat16
    # ten times faster than the largest absolute component
    square = np.einsum("...i,...i->...", values, values)
    if np.any(square == 0):  # zero, or so small that squares underflow
        zero = np.all(values == 0, axis=-1)
        require(~zero, f"{name} must not be zero, got {describe(values)}: {hint}.")
    if not unit:
        return
    off = (square < (1 - _UNIT) ** 2) | (square > (1 + _UNIT) ** 2)  # NaN passes
    if np.any(off):
        size = np.nanmax(np.linalg.norm(values.astype(np.float64), axis=-1))
        require(
            ~off,
            f"{name} must be of unit length, got length {size:.6g} in {describe(values)}:"
            f" {'use ph.rotation.normalise' if values.shape[-1] == 4 else hint}.",
        )


def as_matrices(value: Any) -> tuple[Array, Array]:
    """Matrices (..., 3, 3), and whether (...) they are rotations: orthogonal, with determinant 1.

    ValueError for a concrete matrix that is not.
    """
    matrix = value
    fits = isinstance(value, jax.Array) and value.shape[-2:] == (3, 3)
    if not fits or not jnp.issubdtype(value.dtype, jnp.floating):
        matrix = as_float_array("matrix", value, (3, 3), finite=False)
    if not is_concrete(matrix):
        return matrix, _rotation_error(jax.lax.stop_gradient(matrix))[0]
    with jax.ensure_compile_time_eval():  # concrete numbers: evaluated now, even under jit
        good, size = _rotation_error(matrix)
        require(
            np.asarray(good) | np.isnan(size),
            "matrix must be a rotation, orthogonal and of determinant +1, got"
            f" {describe(np.asarray(matrix), 9)}: a reflection (determinant -1) or a scaling has no"
            " quaternion.",
        )
    return matrix, good


@smooth  # a check only: its comparisons do not affect results
def _rotation_error(matrix: Array) -> tuple[Array, Array]:
    """Whether matrices are rotations, and their largest error of orthonormality."""
    a, b, c = (matrix[..., i, :] for i in range(3))
    # each of three orthonormal, right-handed rows is the cross product of the two others
    off = [jnp.cross(a, b) - c, jnp.cross(b, c) - a, jnp.cross(c, a) - b]
    size = jnp.max(jnp.abs(jnp.stack(off)), axis=(0, -1))
    return (size <= _UNIT) & (jnp.max(jnp.abs(matrix), axis=(-2, -1)) > 0.5), size


def matrix_row(wxyz: Sequence[Any], i: int) -> tuple[Any, Any, Any]:
    """Row ``i`` of the rotation matrix: body components of space axis ``i`` (JAX or NumPy)."""
    w, x, y, z = wxyz
    if i == 0:
        return 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    if i == 1:
        return 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    return 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


def quaternion_rate(wxyz: Sequence[Array], omega: Sequence[Array | float]) -> tuple[Array, ...]:
    """dq/dt = q (0, omega) / 2 for body rates omega [rad/s], four and three component arrays."""
    w, x, y, z = wxyz
    a, b, c = (rate / 2 for rate in omega)
    return (
        -x * a - y * b - z * c,
        w * a + y * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y * a,
    )


def wxyz_rate(
    wxyz: Float[Array, "*#b 4"], omega_body: Float[Array, "*#b 3"]
) -> Float[Array, "*b 4"]:
    """dq/dt [1/s] of an attitude (..., 4) with body rates (..., 3) [rad/s]."""
    q, omega = (jnp.unstack(x, axis=-1) for x in (wxyz, omega_body))
    return jnp.stack(quaternion_rate(q, omega), axis=-1)


def identity(shape: tuple[int, ...] = (), dtype: DTypeLike | None = None) -> Float[Array, "*b 4"]:
    """Identity quaternions (..., 4) with the leading axes ``shape``."""
    return jnp.zeros((*shape, 4), dtype or jnp.result_type(float)).at[..., 0].set(1)


def multiply(
    left: Float[ArrayLike, "*#b 4"], right: Float[ArrayLike, "*#b 4"]
) -> Float[Array, "*b 4"]:
    """Hamilton product ``left right``: the rotation ``right`` followed by ``left``."""
    return _product(*_as_pair(left=(left, 4), right=(right, 4)))


def _as_pair(**arguments: tuple[Any, int]) -> tuple[Array, Array]:
    """Two arrays ``name=(value, size)`` of vectors, of one dtype; their batch axes broadcast."""
    first, second = (as_vectors(name, value, n) for name, (value, n) in arguments.items())
    batch_of(**dict(zip(arguments, ((first, 1), (second, 1)))))
    if first.dtype != second.dtype:
        sizes = {name: (value, (n,)) for name, (value, n) in arguments.items()}
        first, second = as_floats(finite=False, **sizes)
    return first, second


@jax.jit  # outside jit too, one program for all operations; likewise below
def _product(left: Array, right: Array) -> Array:
    a, b, c, d = jnp.unstack(left, axis=-1)
    w, x, y, z = jnp.unstack(right, axis=-1)
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def conjugate(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """Conjugate; for a unit quaternion the inverse rotation (space -> body)."""
    wxyz = as_vectors("wxyz", wxyz, 4)
    return jnp.concatenate([wxyz[..., :1], -wxyz[..., 1:]], axis=-1)


def rotate(
    wxyz: Float[ArrayLike, "*#b 4"], vector: Float[ArrayLike, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """Space components of a vector from its body components, by a unit quaternion.

    Raises ValueError for a concrete quaternion that is not of unit length.
    """
    as_quaternions(wxyz, unit=True)
    return _rotated(*_as_pair(wxyz=(wxyz, 4), vector=(vector, 3)))


@jax.jit
def _rotated(wxyz: Array, vector: Array) -> Array:
    w, axis = wxyz[..., :1], wxyz[..., 1:]
    twice = 2 * jnp.cross(axis, vector)
    return vector + w * twice + jnp.cross(axis, twice)


def normalise(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """The unit quaternion with the same direction. A zero quaternion raises ValueError.

    Tiny and huge input does not underflow or overflow: the largest component is scaled to 1 first.
    """
    wxyz = as_quaternions(wxyz)
    values = on_host(wxyz)
    if isinstance(values, np.ndarray) and values.ndim == 1:  # by NumPy, without compilation
        values = values / np.max(np.abs(values))
        return as_float_array("wxyz", values / np.sqrt(np.sum(values**2)), finite=False)
    return _normalised(wxyz)


@smooth
def _largest_of(*parts: Array) -> Array:
    """Largest absolute value, used only as a scale that cancels."""
    return reduce(jnp.maximum, map(jnp.abs, parts))


@jax.jit
def _normalised(wxyz: Array) -> Array:
    # Sums are written out: an XLA sum over a short axis takes twice as long as the rest of this
    # function. The scale cancels, so that its derivative may be omitted.
    parts = jnp.unstack(wxyz, axis=-1)
    scale = jax.lax.stop_gradient(_largest_of(*parts))
    size = jnp.sqrt(sum((x / scale) ** 2 for x in parts))
    return wxyz / scale[..., None] / size[..., None]


def canonical(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """Of the two quaternions of a rotation the one with a scalar part >= 0."""
    wxyz = as_vectors("wxyz", wxyz, 4)
    return jnp.where(wxyz[..., :1] < 0, -wxyz, wxyz)


def between(
    start: Float[ArrayLike, "*#b 4"], end: Float[ArrayLike, "*#b 4"]
) -> Float[Array, "*b 4"]:
    """Rotation (..., 4) in body axes: ``end = multiply(start, between(start, end))``."""
    first, second = _as_pair(start=(start, 4), end=(end, 4))
    return _product(conjugate(first), second)


def angle_between(
    start: Float[ArrayLike, "*#b 4"], end: Float[ArrayLike, "*#b 4"]
) -> Float[Array, "*b"]:
    """Angle in [0, pi] (rad) of the rotation from one attitude to the other."""
    as_quaternions(start, "start")
    as_quaternions(end, "end")
    return _angle(*_as_pair(start=(start, 4), end=(end, 4)))


@jax.jit
def _angle(start: Array, end: Array) -> Array:
    turn = between(normalise(start), normalise(end))
    return 2 * jnp.arctan2(length(turn[..., 1:]), jnp.abs(turn[..., 0]))


if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def wxyz_to_xyzw(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """Scalar-last order (SciPy, ROS, Eigen's storage) of a scalar-first quaternion."""
    wxyz = as_vectors("wxyz", wxyz, 4)
    return jnp.concatenate([wxyz[..., 1:], wxyz[..., :1]], axis=-1)


def xyzw_to_wxyz(xyzw: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """Scalar-first order of a scalar-last quaternion."""
    xyzw = as_vectors("xyzw", xyzw, 4)
    return jnp.concatenate([xyzw[..., 3:], xyzw[..., :3]], axis=-1)


def wxyz_to_scipy(wxyz: Float[ArrayLike, "*b 4"]) -> "Rotation":
    """SciPy's ``Rotation`` of quaternions, body -> space (its ``apply`` is our `rotate`).

    Leading axes are flattened to a single one, the only form that all SciPy releases support; a
    quaternion of shape (4,) gives a single rotation. Not for use under a JAX transformation.
    """
    if isinstance(wxyz, jax.core.Tracer):
        raise TypeError(
            "wxyz_to_scipy was given a traced array: SciPy works on concrete values only; "
            "convert outside jit, vmap and grad"
        )
    from scipy.spatial.transform import Rotation

    xyzw = np.array(wxyz_to_xyzw(as_quaternions(wxyz)), np.float64)  # SciPy needs a writable one
    return Rotation.from_quat(xyzw if xyzw.ndim == 1 else xyzw.reshape(-1, 4))


def scipy_to_wxyz(rotation: "Rotation", dtype: DTypeLike | None = None) -> Float[Array, "*b 4"]:
    """Quaternions, scalar first, of SciPy's ``Rotation``; ``dtype`` defaults to JAX's float."""
    if not hasattr(rotation, "as_quat"):
        raise TypeError(
            "scipy_to_wxyz takes a scipy.spatial.transform.Rotation, got"
            f" {type(rotation).__name__}; for an array that is scalar last use xyzw_to_wxyz."
        )
    xyzw = jnp.asarray(rotation.as_quat(), dtype or jnp.result_type(float))
    return xyzw_to_wxyz(xyzw)
