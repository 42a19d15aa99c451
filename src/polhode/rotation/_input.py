"""Checks of what users hand to the conversions: numbers of the right shape that are a rotation.

Shapes are looked at always, values where they are known. Under ``jit``, ``vmap`` and ``grad``
nothing is raised: what is no rotation becomes NaN where that costs nothing, and else is as given.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import as_float_array, as_vectors as as_vectors, describe, is_concrete, require
from polhode._kernels import smooth

_UNIT = 1e-3
"""How far from unit length or orthogonality numbers may be that were rounded for printing."""


def as_quaternions(value: Any, name: str = "wxyz", *, unit: bool = False) -> Array:
    """Quaternions (..., 4), none of them zero; ``unit``: of length one, where that is known."""
    wxyz = as_vectors(name, value, 4)
    if is_concrete(wxyz):
        _check_length(name, np.asarray(wxyz), unit, "(1, 0, 0, 0) is no rotation, scalar first")
    return wxyz


def as_axes(name: str, value: Any) -> Array:
    """Unit vectors (..., 3)."""
    axes = as_vectors(name, value, 3)
    if is_concrete(axes):
        _check_length(name, np.asarray(axes), True, "divide the axis by its length")
    return axes


@np.errstate(over="ignore")
def _check_length(name: str, seen: np.ndarray, unit: bool, hint: str) -> None:
    if seen.dtype.kind != "f":
        seen = seen.astype(np.float32)  # einsum knows no bfloat16
    square = np.einsum("...i,...i->...", seen, seen)  # ten times as fast as largest components
    if np.any(square == 0):  # or so small that squares vanish
        zero = np.all(seen == 0, axis=-1)
        require(~zero, f"{name} must not be zero, got {describe(seen)}: {hint}.")
    if not unit:
        return
    off = (square < (1 - _UNIT) ** 2) | (square > (1 + _UNIT) ** 2)  # NaN passes
    if np.any(off):
        length = np.nanmax(np.linalg.norm(seen.astype(np.float64), axis=-1))
        require(
            ~off,
            f"{name} must be of unit length, got length {length:.6g} in {describe(seen)}:"
            f" {'use ph.rotation.normalise' if seen.shape[-1] == 4 else hint}.",
        )


def as_matrices(value: Any) -> tuple[Array, Array]:
    """Matrices (..., 3, 3), and which of them (...) are rotations: orthogonal, of determinant 1."""
    matrix = value
    if not isinstance(value, jax.Array) or value.shape[-2:] != (3, 3):
        matrix = as_float_array("matrix", value, (3, 3), finite=False)
    if not is_concrete(matrix):
        return matrix, _judged(jax.lax.stop_gradient(matrix))[0]
    with jax.ensure_compile_time_eval():  # the numbers are known, also under jit
        good, size = _judged(matrix)
        require(
            np.asarray(good) | np.isnan(size),
            "matrix must be a rotation, orthogonal and of determinant +1, got"
            f" {describe(np.asarray(matrix), 9)}: a reflection (determinant -1) or a scaling has no"
            " quaternion.",
        )
    return matrix, good


@smooth  # a check of rounding errors: its comparisons are no kinks
def _judged(matrix: Array) -> tuple[Array, Array]:
    """Which are rotations, and how far they are from it."""
    a, b, c = (matrix[..., i, :] for i in range(3))
    # of orthonormal, right-handed rows each is the vector product of the two others
    off = [jnp.cross(a, b) - c, jnp.cross(b, c) - a, jnp.cross(c, a) - b]
    size = jnp.max(jnp.abs(jnp.stack(off)), axis=(0, -1))
    return (size <= _UNIT) & (jnp.max(jnp.abs(matrix), axis=(-2, -1)) > 0.5), size
