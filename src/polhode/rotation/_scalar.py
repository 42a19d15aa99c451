"""Scalar functions that every conversion rests on, smooth where the mathematics is smooth.

A square root, a quotient 0/0 or an arctangent of two zeros has a value but no usable derivative
under automatic differentiation. Here each such function carries its analytic derivative, written
with functions that are themselves smooth, so that second derivatives are right as well.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode._kernels import smooth


@smooth
def largest(vector: Array) -> Array:
    """Largest absolute component (..., 1): a scale that cancels in what is computed with it, so
    that its changes from one component to another are no kinks."""
    return jnp.max(jnp.abs(vector), axis=-1, keepdims=True)


def _dot(left: Array, right: Array) -> Array:
    return jnp.sum(left * right, axis=-1)


@jax.custom_jvp
def length(vector: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Euclidean length over the last axis, without overflow or underflow.

    Its derivative at the zero vector, where none exists, is taken as zero.
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
    # Written with 1/length once: the general rule of a quotient would form 1/length**2,
    # which overflows for vectors of 1e-200.
    (vector,), (tangent,) = primals, tangents
    unit = direction(vector)
    size = length(vector)[..., None]
    is_zero = size == 0
    across = tangent - unit * _dot(unit, tangent)[..., None]
    direction_rate = across / jnp.where(is_zero, jnp.ones_like(size), size)
    return unit, jnp.where(is_zero, jnp.zeros_like(direction_rate), direction_rate)


# --- sin(a)/a as a function of a**2 --------------------------------------------------------------

# Beyond a**2 = 4 the closed form of (a - sin a)/a**3 loses less than a factor two; below, the
# power series (3 + 2 j)!, j = 0 .. 12 has converged together with its second derivative.
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
# Chebyshev interpolant of degree 25 in x = 2 c - 1, written in powers of x. Its error is 6e-20, so
# that its first two derivatives are exact to rounding too; one formula serves the whole range.
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
    # one division after the other: powers of the length overflow in single precision from 1e13 on
    along = _dot(vector / norm[..., None], vector_tangent)
    change = (2 * slope * along - scalar_tangent) / norm / norm
    return arc_ratio(scalar, vector), change
