"""Unit quaternions, scalar first (``wxyz``), turning body components into space components.

Every function takes arrays of shape (..., 4) (quaternions) and (..., 3) (vectors), broadcasts
leading axes together, and keeps the dtype of its input.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def multiply(left: Float[Array, "*#b 4"], right: Float[Array, "*#b 4"]) -> Float[Array, "*b 4"]:
    """Hamilton product ``left right``: first turn by ``right``, then by ``left``."""
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


def conjugate(wxyz: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Conjugate; for a unit quaternion the inverse rotation (space -> body)."""
    return jnp.concatenate([wxyz[..., :1], -wxyz[..., 1:]], axis=-1)


def rotate(wxyz: Float[Array, "*#b 4"], vector: Float[Array, "*#b 3"]) -> Float[Array, "*b 3"]:
    """Space components of a vector given by its body components."""
    w, axis = wxyz[..., :1], wxyz[..., 1:]
    twice = 2 * jnp.cross(axis, vector)
    return vector + w * twice + jnp.cross(axis, twice)


def to_matrix(wxyz: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix R, ``x_space = R x_body`` (theory section 1), of a unit quaternion."""
    w, x, y, z = (wxyz[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def normalise(wxyz: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """The unit quaternion of the same direction; the components must not all vanish.

    Scaled by the largest component first, so that neither tiny nor huge input is lost.
    """
    scale = jnp.max(jnp.abs(wxyz), axis=-1, keepdims=True)
    scaled = wxyz / scale
    return scaled / jnp.sqrt(jnp.sum(scaled * scaled, axis=-1, keepdims=True))
