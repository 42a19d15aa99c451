"""How far a tensor is from the boundary of what a body can have."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.inertia._cholesky import second_moments
from polhode.inertia._eigen import principal


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
