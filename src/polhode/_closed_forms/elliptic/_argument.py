"""Arguments of the elliptic functions: dtype, and the parameter pair (m, 1 - m)."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from polhode._checks import ArrayLike


def as_floats(*values: ArrayLike) -> tuple[Array, ...]:
    """The arguments as arrays of one floating dtype (integers become the default float)."""
    arrays = [jnp.asarray(value) for value in values]
    dtype = jnp.result_type(*arrays)
    if not jnp.issubdtype(dtype, jnp.floating):
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise TypeError(f"expected real arguments, got dtype {dtype}; pass the real part")
        dtype = jnp.result_type(float)
    return tuple(array.astype(dtype) for array in arrays)


def broadcast(*arrays: Array) -> tuple[Array, ...]:
    """All arrays at their common shape."""
    shape = jnp.broadcast_shapes(*(array.shape for array in arrays))
    return tuple(jnp.broadcast_to(array, shape) for array in arrays)


@jax.custom_jvp
def _one_parameter(m: Array, m1: Array) -> tuple[Array, Array]:
    return m, m1


@_one_parameter.defjvp
def _one_parameter_rule(primals, tangents):
    m, m1 = primals
    dm, dm1 = tangents
    # One quantity, two roundings of it: with dm1 = -dm this is dm, whichever of the two is tiny.
    along_m = m1 * dm - m * dm1
    return (m, m1), (along_m, -along_m)


def parameter_pair(
    m: Float[Array, "..."], m1: Float[Array, "..."] | None
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The pair (m, 1 - m); NaN where either is negative.

    Given both, they are two roundings of one quantity: the derivative is taken along
    m1 dm - m dm1, which is dm (once) when the caller's tangents obey dm1 = -dm.
    """
    if m1 is None:
        m1 = 1 - m
    else:
        m, m1 = _one_parameter(*broadcast(m, m1))
    # As a factor, so that derivatives outside the domain are NaN too and not a silent 0.
    valid = jnp.where((m >= 0) & (m1 >= 0), 1, jnp.nan).astype(m.dtype)
    return m * valid, m1 * valid
