"""Euler angles of every sequence, to and from unit quaternions.

ZYZ, ``R = Rz(phi) Ry(theta) Rz(psi)``, is the convention of docs/equations.md;
the other sequences are reduced to the same formulas by a quarter turn (Bernardes and Viollet 2022).
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_floats
from polhode.rotation._input import as_quaternions, check_sequence
from polhode.rotation._scalar import length
from polhode.rotation._sequence import Sequence


def _parity(i: int, j: int, k: int) -> int:
    return (i - j) * (j - k) * (k - i) // 2


def _half_sum(left: Array, right: Array) -> tuple[Array, Array]:
    """Cosine and sine of (left + right)/2 for the exact sum, not only for the rounded one.

    Near |left + right| = 2 pi the rounding of the sum alone would spoil a small rotation. The
    rounding error is found exactly (Knuth 1969), and does not depend on the angles smoothly.
    """
    total = left + right
    shifted = total - left
    lost = jax.lax.stop_gradient((left - (total - shifted)) + (right - shifted)) / 2
    cos, sin = jnp.cos(total / 2), jnp.sin(total / 2)
    return cos - lost * sin, sin + lost * cos


def euler_to_wxyz(
    phi: Float[ArrayLike, "*#b"],
    theta: Float[ArrayLike, "*#b"],
    psi: Float[ArrayLike, "*#b"],
    sequence: Sequence = Sequence.ZYZ,
) -> Float[Array, "*b 4"]:
    """Unit quaternion of Euler angles (rad), smooth for all angles.

    The angles are given in the order of the sequence's axes. The sign of the quaternion follows the
    angles continuously; `canonical` picks the one with scalar part >= 0.
    """
    check_sequence(sequence)
    return _quaternion(
        sequence, *as_floats(finite=False, phi=(phi, ()), theta=(theta, ()), psi=(psi, ()))
    )


@partial(jax.jit, static_argnums=0)  # one program, not one for each operation
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
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(pair), axis=-1))
    is_zero = scale == 0
    safe = jnp.where(is_zero, jnp.ones_like(scale), scale)
    scaled = jnp.where(is_zero, jnp.ones_like(real), real / safe)
    return length(pair), scaled, jnp.where(is_zero, jnp.zeros_like(real), imaginary / safe)


def wxyz_to_euler(
    wxyz: Float[ArrayLike, "*b 4"], sequence: Sequence = Sequence.ZYZ
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]:
    """Euler angles (rad) of a quaternion (its scale and its sign do not matter).

    First and third angle lie in [-pi, pi]; the second in [0, pi] (same first and last axis) or
    [-pi/2, pi/2]. Where the second angle reaches an end of its range only the sum or the difference
    of the other two is defined, and it is shared equally between them; derivatives of the angles
    do not exist there, and the missing parts are returned as zero.

    Raises ValueError for a quaternion that is zero, TypeError for what is no ``Sequence``; the
    angles of a traced quaternion that is zero are NaN.
    """
    check_sequence(sequence)
    return _angles(sequence, as_quaternions(wxyz))


@partial(jax.jit, static_argnums=0)
def _angles(sequence: Sequence, wxyz: Array) -> tuple[Array, Array, Array]:
    wxyz = jnp.where(jnp.any(wxyz != 0, axis=-1, keepdims=True), wxyz, jnp.nan)
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
        # R_i(a) R_j(b) R_k(c), turned on by a quarter about j, is
        # R_i(a) R_j(b + pi/2) R_i(-parity c).
        sums = (w - along_j, along_i - along_k)
        differences = (w + along_j, along_i + along_k)
    sum_size, sum_cos, sum_sin = _phase(*sums)
    difference_size, difference_cos, difference_sin = _phase(*differences)
    # arguments of the products U V and U conj(V): one arctangent each, already within (-pi, pi]
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
