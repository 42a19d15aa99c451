"""The three axes in their roles, scaled so that neither size nor order of the input matters."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from polhode._closed_forms.free._exact import (
    Pair,
    binade,
    multiply_pairs,
    product_of,
    scale_pair,
    subtract_pairs,
    sum_of,
)
from polhode._hamiltonian import triple
from polhode._kernels import opaque_ones, staged

Scalars = Float[Array, "*b"]
Triple = tuple[Scalars, Scalars, Scalars]


class Roles(NamedTuple):
    """One body with its axes renumbered: 3 is the axis that the momentum circles, 2 the middle one.

    Rates are divided by a power of two near the largest, moments by one that leaves the largest
    momentum near one, so that no product of momenta leaves the range of the dtype; time is to be
    multiplied by ``pulse``, which is zero for a body at rest (its direction is then a dummy).
    """

    moments: Triple
    rates: Triple
    pulse: Scalars  # the power of two that divides the rates
    heft: Scalars  # the power of two that divides the moments
    gap: Scalars  # |I3 w3^2 (I3 - I2) - I1 w1^2 (I2 - I1)|, the distance from the separatrix
    sense: Scalars  # +1 when axis 3 has the largest moment, -1 when the smallest
    parity: Scalars  # +1 when axes 1, 2, 3 are a right-handed system
    middle: Scalars  # where axis 2 stands among x, y, z: 0, 1 or 2
    circled: Scalars  # where axis 3 stands
    one: Scalars


def pick(values: Triple, index) -> Scalars:
    """The value that stands at an index 0, 1 or 2."""
    return jnp.where(index == 0, values[0], jnp.where(index == 1, values[1], values[2]))


def _extremes(x: Scalars, y: Scalars, z: Scalars) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
    """Where the smallest and the largest of three values stand; never the same place."""
    low = jnp.where(y < x, jnp.where(z < y, 2, 1), jnp.where(z < x, 2, 0))
    high = jnp.where(y >= x, jnp.where(z >= y, 2, 1), jnp.where(z >= x, 2, 0))
    return low, high


def _pull(moment: Scalars, rate: Scalars, above: Scalars, below: Scalars) -> Pair:
    """moment * rate^2 * (above - below), with its rounding error."""
    return multiply_pairs(scale_pair(product_of(rate, rate), moment), sum_of(above, -below))


def assign_roles(moments: Triple, rates: Triple) -> Roles:
    """Sort the axes, choose the one that the momentum circles, scale by powers of two."""
    largest = jnp.maximum(jnp.maximum(jnp.abs(rates[0]), jnp.abs(rates[1])), jnp.abs(rates[2]))
    pulse = binade(largest)
    heft = binade(jnp.maximum(jnp.maximum(moments[0], moments[1]), moments[2]))
    one = opaque_ones(moments[0])
    # The momentum of a sphere circles no axis: the one that it is nearest to, so that it is not
    # across it.
    sphere = (moments[0] == moments[1]) & (moments[1] == moments[2])
    order = tuple(jnp.where(sphere, jnp.abs(w), i) for w, i in zip(rates, moments, strict=True))
    k_low, k_high = _extremes(*order)
    k_mid = 3 - k_low - k_high
    low, mid, high = (pick(moments, k) / heft for k in (k_low, k_mid, k_high))
    w_low, w_mid, w_high = (pick(rates, k) / pulse for k in (k_low, k_mid, k_high))
    resting = largest == 0
    w_high = jnp.where(resting, 1, w_high)
    lift = binade(
        jnp.maximum(jnp.maximum(jnp.abs(low * w_low), jnp.abs(mid * w_mid)), jnp.abs(high * w_high))
    )
    heft = heft * lift
    low, mid, high = low / lift, mid / lift, high / lift
    # Exact next to the separatrix, where the two terms cancel and all depends on the difference.
    gap = subtract_pairs(_pull(high, w_high, high, mid), _pull(low, w_low, mid, low)).value
    gap = staged(gap, one)
    # A tie is the separatrix, or a spin about an axis across that of a symmetric body: there the
    # circled axis must be one of the two equal ones.
    above = (gap > 0) | ((gap == 0) & (high - mid <= mid - low))
    sense = staged(jnp.where(above, 1, -1).astype(low.dtype), one)
    above = sense > 0
    k1, k3 = jnp.where(above, k_low, k_high), jnp.where(above, k_high, k_low)
    right = (k_mid - k1 == 1) | (k_mid - k1 == -2)
    return Roles(
        staged((jnp.where(above, low, high), mid, jnp.where(above, high, low)), one),
        staged((jnp.where(above, w_low, w_high), w_mid, jnp.where(above, w_high, w_low)), one),
        staged(jnp.where(resting, 0, pulse), one),
        staged(heft, one),
        jnp.abs(gap),
        sense,
        staged(jnp.where(right, 1, -1).astype(low.dtype), one),
        staged(k_mid.astype(low.dtype), one),
        staged(k3.astype(low.dtype), one),
        one,
    )


def restore(roles_values: Triple, middle: Scalars, circled: Scalars) -> Triple:
    """Values along axes 1, 2, 3 put back along x, y, z."""
    first, second, third = roles_values
    return triple(
        jnp.where(circled == k, third, jnp.where(middle == k, second, first)) for k in range(3)
    )
