"""Unit quaternions, scalar first (``wxyz``), turning body components into space components.

Every function takes arrays of shape (..., 4) (quaternions) and (..., 3) (vectors), broadcasts
leading axes together, and keeps the dtype of its input.
"""

from functools import reduce

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode.rotation._input import as_quaternions, as_vectors
from polhode.rotation._scalar import length


def identity(shape: tuple[int, ...] = (), dtype: DTypeLike | None = None) -> Float[Array, "*b 4"]:
    """Quaternions of no rotation, of leading shape ``shape``."""
    return jnp.zeros((*shape, 4), dtype or jnp.result_type(float)).at[..., 0].set(1)


def multiply(
    left: Float[ArrayLike, "*#b 4"], right: Float[ArrayLike, "*#b 4"]
) -> Float[Array, "*b 4"]:
    """Hamilton product ``left right``: the rotation ``right`` followed by ``left``."""
    return _product(as_vectors("left", left, 4), as_vectors("right", right, 4))


@jax.jit  # one program, not one for each operation; likewise below
def _product(left: Array, right: Array) -> Array:
    a, b, c, d = (left[..., i] for i in range(4))
    w, x, y, z = (right[..., i] for i in range(4))
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
    """Space components of a vector given by its body components, by a unit quaternion.

    Raises ValueError for a quaternion that is known not to be of unit length.
    """
    return _rotated(as_quaternions(wxyz, unit=True), as_vectors("vector", vector, 3))


@jax.jit
def _rotated(wxyz: Array, vector: Array) -> Array:
    w, axis = wxyz[..., :1], wxyz[..., 1:]
    twice = 2 * jnp.cross(axis, vector)
    return vector + w * twice + jnp.cross(axis, twice)


def normalise(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """The unit quaternion of the same direction; the components must not all vanish.

    Scaled by the largest component first, so that neither tiny nor huge input is lost.
    """
    return _normalised(as_quaternions(wxyz))


@jax.jit
def _normalised(wxyz: Array) -> Array:
    # Written out: XLA's sums over a short axis take twice as long as all else here. The result
    # does not depend on the scale, so that its derivative may be left out.
    parts = [wxyz[..., i] for i in range(4)]
    scale = jax.lax.stop_gradient(reduce(jnp.maximum, map(jnp.abs, parts)))
    size = jnp.sqrt(sum((x / scale) ** 2 for x in parts))
    return wxyz / scale[..., None] / size[..., None]


def canonical(wxyz: Float[ArrayLike, "*b 4"]) -> Float[Array, "*b 4"]:
    """The one of the two quaternions of a rotation whose scalar part is not negative."""
    wxyz = as_vectors("wxyz", wxyz, 4)
    return jnp.where(wxyz[..., :1] < 0, -wxyz, wxyz)


def between(
    start: Float[ArrayLike, "*#b 4"], end: Float[ArrayLike, "*#b 4"]
) -> Float[Array, "*b 4"]:
    """Rotation from ``start`` to ``end`` in body axes: ``end = start between``."""
    return multiply(conjugate(start), end)


def angle_between(
    start: Float[ArrayLike, "*#b 4"], end: Float[ArrayLike, "*#b 4"]
) -> Float[Array, "*b"]:
    """Angle in [0, pi] (rad) of the rotation from one attitude to the other."""
    return _angle(as_quaternions(start, "start"), as_quaternions(end, "end"))


@jax.jit
def _angle(start: Array, end: Array) -> Array:
    turn = between(start, end)
    return 2 * jnp.arctan2(length(turn[..., 1:]), jnp.abs(turn[..., 0]))
