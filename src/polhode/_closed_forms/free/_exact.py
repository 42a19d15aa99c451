"""Sums and products of two floats kept together with their rounding errors.

Dekker, *A floating-point technique for extending the available precision*, Numer. Math. 18 (1971);
the halves are cut by masking bits, and only exact products are ever added, so that a compiler
that contracts a product and a sum into one operation changes nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalars = Float[Array, "*b"]

_INTEGERS = {4: jnp.uint32, 8: jnp.uint64}
# The leading half of the significand, and the exponent alone.
_HALF = {4: 0xFFFFF000, 8: 0xFFFFFFFFF8000000}
_EXPONENT = {4: 0x7F800000, 8: 0x7FF0000000000000}


class Pair(NamedTuple):
    """The unevaluated sum of a float and a much smaller one."""

    high: Scalars
    low: Scalars

    @property
    def value(self) -> Scalars:
        return self.high + self.low


def _masked(x: Scalars, masks: dict) -> Scalars:
    size = x.dtype.itemsize
    bits = jax.lax.bitcast_convert_type(x, _INTEGERS[size])
    return jax.lax.bitcast_convert_type(bits & jnp.array(masks[size], bits.dtype), x.dtype)


def split(x: Scalars) -> Pair:
    """Two halves of x with at most half of the bits each, their sum being exactly x."""
    high = _masked(x, _HALF)
    return Pair(high, x - high)


def binade(x: Scalars) -> Scalars:
    """The power of two next below |x|; one for zero."""
    power = _masked(x, _EXPONENT)
    return jnp.where(power > 0, power, 1)


def quick_sum(a: Scalars, b: Scalars) -> Pair:
    """a + b with its error, for |a| >= |b|."""
    high = a + b
    return Pair(high, b - (high - a))


def sum_of(a: Scalars, b: Scalars) -> Pair:
    """a + b with its error."""
    high = a + b
    part = high - a
    return Pair(high, (a - (high - part)) + (b - part))


def product_of(a: Scalars, b: Scalars) -> Pair:
    """a b with its error (to half a significand beyond the first one)."""
    x, y = split(a), split(b)
    return quick_sum(x.high * y.high, (x.high * y.low + x.low * y.high) + x.low * y.low)


def scale_pair(x: Pair, factor: Scalars) -> Pair:
    high, low = product_of(x.high, factor)
    return quick_sum(high, low + x.low * factor)


def multiply_pairs(x: Pair, y: Pair) -> Pair:
    high, low = product_of(x.high, y.high)
    return quick_sum(high, low + (x.high * y.low + x.low * y.high))


def subtract_pairs(x: Pair, y: Pair) -> Pair:
    high, low = sum_of(x.high, -y.high)
    return quick_sum(high, low + (x.low - y.low))


def add_pairs(x: Pair, y: Pair) -> Pair:
    high, low = sum_of(x.high, y.high)
    return quick_sum(high, low + (x.low + y.low))


def divide_pairs(x: Pair, y: Pair) -> Pair:
    high = x.high / y.high
    rest = subtract_pairs(x, scale_pair(y, high))
    return quick_sum(high, rest.high / y.high)


def root_of(x: Pair) -> Pair:
    """The square root of a positive pair."""
    high = jnp.sqrt(x.high)
    rest = subtract_pairs(x, product_of(high, high))
    return quick_sum(high, rest.high / (2 * high))


def turns(rate: Scalars, time: Scalars) -> tuple[Scalars, Scalars]:
    """rate * time as a whole number and a remainder in [-1/2, 1/2], nothing lost to its size."""
    x, y = split(rate), split(time)
    product = rate * time
    whole = jnp.round(product)
    rest = (x.high * y.high - whole) + (x.high * y.low + x.low * y.high) + x.low * y.low
    # The low parts of a tiny product would underflow.
    return whole, jnp.where(whole == 0, product, rest)
