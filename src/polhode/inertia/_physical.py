"""How far a tensor is from the boundary of what a body can have."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from polhode.inertia._cholesky import second_moments
from polhode.inertia._eigen import principal
from polhode.inertia._input import tolerance


def physical_margin(tensor: Float[Array, "*b 3 3"]) -> Float[Array, "*b"]:
    """Signed distance (...), kg m^2, of a tensor to the boundary of the physical ones.

    A tensor belongs to a body exactly when its second moments ``Sigma = tr(I)/2 - I`` have no
    negative eigenvalue: positive moments and the triangle inequality in one. The distance is that
    of Sigma to the nearest singular one in the Frobenius norm: positive inside (the smallest
    eigenvalue), zero for a flat body, negative outside (the norm of the negative part).
    """
    least = principal(second_moments(tensor))[0]
    negative = jnp.minimum(least, 0)
    outside = least[..., 0] < 0
    square = jnp.sum(negative * negative, axis=-1)
    # both branches must be differentiable where the other one is taken
    distance = jnp.sqrt(jnp.where(outside, square, 1))
    return jnp.where(outside, -distance, least[..., 0])


def is_physical(tensor: Float[Array, "*b 3 3"], slack: float = 0.0) -> Array:
    """Whether (...) a body can have this tensor; ``slack``: tolerance relative to its trace."""
    trace = tensor[..., 0, 0] + tensor[..., 1, 1] + tensor[..., 2, 2]
    return physical_margin(tensor) >= -slack * trace


def possible_moments(moments: Float[Array, "*b 3"], triangle: bool) -> Bool[Array, "*b"]:
    """Whether moments are positive and finite and, with ``triangle``, those of a body.

    The tolerance is that of the constructors; nothing is looked for, so that it costs a few
    operations in a compiled program.
    """
    moments = jax.lax.stop_gradient(moments)
    good = jnp.all((moments > 0) & (moments < jnp.inf), axis=-1)
    if triangle:
        quarter = moments / 4  # so that no sum overflows
        largest = jnp.max(quarter, axis=-1)
        good = good & (jnp.sum(quarter, axis=-1) >= (2 - tolerance(moments)) * largest)
    return good


def possible_tensor(tensor: Float[Array, "*b 3 3"], triangle: bool) -> Bool[Array, "*b"]:
    """Whether a tensor is symmetric, positive and, with ``triangle``, that of a body.

    Definiteness shows in the pivots of elimination, which need no eigenvalues.
    """
    tensor = jax.lax.stop_gradient(tensor)
    unit = tensor / jnp.max(jnp.abs(tensor), axis=(-2, -1), keepdims=True)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=tensor.dtype), unit.shape)
    rounding = 16 * float(jnp.finfo(tensor.dtype).eps)
    good = is_symmetric(tensor) & _is_positive(unit - rounding * identity)
    if triangle:
        spread = second_moments(unit)
        trace = unit[..., 0, 0] + unit[..., 1, 1] + unit[..., 2, 2]
        shift = jnp.broadcast_to((tolerance(tensor) / 2 * trace)[..., None, None], unit.shape)
        good = good & _is_positive(spread + shift * identity)
    return good


def is_symmetric(tensor: Float[Array, "*b 3 3"]) -> Bool[Array, "*b"]:
    """Whether tensors are symmetric, up to the tolerance of the constructors; NaN is not."""
    tensor = jax.lax.stop_gradient(tensor)
    skew = jnp.max(jnp.abs(tensor - jnp.swapaxes(tensor, -1, -2)), axis=(-2, -1))
    return skew <= tolerance(tensor) * jnp.max(jnp.abs(tensor), axis=(-2, -1))


def _is_positive(matrix: Array) -> Array:
    """Whether symmetric matrices have positive pivots."""
    a, b, c = (matrix[..., i, i] for i in range(3))
    p, q, r = matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1]
    second = b - p / a * p
    last = c - q / a * q - (r - p / a * q) ** 2 / second
    return (a > 0) & (second > 0) & (last > 0)
