"""Modified Rodrigues parameters, ``p = axis tan(angle/4)``, and their shadow set.

Two sets describe each rotation, one for each sign of the quaternion: one of length at most 1
(angle up to pi) and its shadow ``-p/|p|**2`` (Schaub and Junkins 1996).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode.rotation._input import as_quaternions, as_vectors
from polhode.rotation._quaternion import canonical
from polhode.rotation._scalar import length


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
