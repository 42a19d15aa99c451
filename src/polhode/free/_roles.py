"""The three axes in their roles, scaled so that neither size nor order of the input matters."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from polhode.free._exact import (
    Pair,
    binade,
    multiply_pairs,
    product_of,
    scale_pair,
    subtract_pairs,
    sum_of,
)

Scalars = Float[Array, "*b"]
Triple = tuple[Scalars, Scalars, Scalars]


class Roles(NamedTuple):
    """One body with its axes renumbered: 3 is the axis that the momentum circles, 2 the middle one.

    Moments are divided by a power of two near the largest, rates by one near the largest rate;
    time is to be multiplied by ``pulse``, which is zero for a body at rest (its direction is
    then a dummy).
    """

    moments: Triple
    rates: Triple
    pulse: Scalars  # the power of two that divides the rates
    heft: Scalars  # the power of two that divides the moments
    gap: Scalars  # |I3 w3^2 (I3 - I2) - I1 w1^2 (I2 - I1)|, the distance from the separatrix
    sense: Scalars  # +1 when axis 3 has the largest moment, -1 when the smallest
    parity: Scalars  # +1 when axes 1, 2, 3 are a right-handed system
    middle: Int[Array, "*b"]  # where axis 2 stands among x, y, z
    circled: Int[Array, "*b"]  # where axis 3 stands


def _ordered(swap: Bool[Array, "*b"], a: tuple, b: tuple) -> tuple[tuple, tuple]:
    lower = tuple(jnp.where(swap, y, x) for x, y in zip(a, b, strict=True))
    upper = tuple(jnp.where(swap, x, y) for x, y in zip(a, b, strict=True))
    return lower, upper


def _pull(moment: Scalars, rate: Scalars, above: Scalars, below: Scalars) -> Pair:
    """moment * rate^2 * (above - below), with its rounding error."""
    return multiply_pairs(scale_pair(product_of(rate, rate), moment), sum_of(above, -below))


def assign_roles(moments: Triple, rates: Triple) -> Roles:
    """Sort the axes, choose the one that the momentum circles, scale by powers of two."""
    largest = jnp.maximum(jnp.maximum(jnp.abs(rates[0]), jnp.abs(rates[1])), jnp.abs(rates[2]))
    pulse = binade(largest)
    heft = binade(jnp.maximum(jnp.maximum(moments[0], moments[1]), moments[2]))
    axes = [
        (i / heft, w / pulse, jnp.full(jnp.shape(i), k, jnp.int32))
        for k, (i, w) in enumerate(zip(moments, rates, strict=True))
    ]
    for a, b in ((0, 1), (1, 2), (0, 1)):
        axes[a], axes[b] = _ordered(axes[a][0] > axes[b][0], axes[a], axes[b])
    axes = jax.lax.optimization_barrier(axes)
    (low, w_low, k_low), (mid, w_mid, k_mid), (high, w_high, k_high) = axes
    resting = largest == 0
    w_high = jnp.where(resting, 1, w_high)
    # Exact next to the separatrix, where the two terms cancel and all depends on the difference.
    gap = subtract_pairs(_pull(high, w_high, high, mid), _pull(low, w_low, mid, low)).value
    # A tie is the separatrix, or a spin about an axis across that of a symmetric body: there the
    # circled axis must be one of the two equal ones.
    above = (gap > 0) | ((gap == 0) & (high - mid <= mid - low))
    gap, above = jax.lax.optimization_barrier((gap, above))
    (i1, w1, k1), (i3, w3, k3) = _ordered(~above, (low, w_low, k_low), (high, w_high, k_high))
    one = jnp.ones_like(i1)
    return Roles(
        (i1, mid, i3),
        (w1, w_mid, w3),
        jnp.where(resting, 0, pulse),
        heft,
        jnp.abs(gap),
        jnp.where(above, one, -one),
        jnp.where((k_mid - k1) % 3 == 1, one, -one),
        k_mid,
        k3,
    )


def restore(roles_values: Triple, middle: Int[Array, "*b"], circled: Int[Array, "*b"]) -> Triple:
    """Values along axes 1, 2, 3 put back along x, y, z."""
    first, second, third = roles_values
    return tuple(
        jnp.where(circled == k, third, jnp.where(middle == k, second, first)) for k in range(3)
    )
