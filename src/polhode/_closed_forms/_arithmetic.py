"""Functions common to the closed forms: double-double sums, polynomials, elliptic series.

A ``Pair`` is an unevaluated sum of two floats (Dekker, *A floating-point technique for extending
the available precision*, Numer. Math. 18 (1971)). Factors are split into halves by masking bits.
Only exact products are added, so that results do not change if the compiler contracts a product and
a sum into one operation (FMA).

The polynomials for sines and arctangents are Chebyshev fits, computed with 40 digits and accurate
to 1e-17 on their intervals. XLA compiles them to vector instructions, unlike its own sine.

Elliptic functions and integrals: NIST Digital Library of Mathematical Functions (DLMF), chapters 19
and 20; B. C. Carlson, Numer. Algorithms 10 (1995) 13. The series are accurate to the last bit of
float64 for a parameter m <= 0.8; for larger ones callers pass the complementary parameter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._kernels import staged

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
    """Two floats with at most half of the bits each, whose sum is exactly x."""
    high = _masked(x, _HALF)
    return Pair(high, x - high)


def binade(x: Scalars) -> Scalars:
    """The largest power of two that is not above |x|; one for zero."""
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
    """a b with its error, to a few units in the last place of the error itself."""
    x, y = split(a), split(b)
    # If the products of a high and a low half were added as plain floats, the error would lose a
    # quarter of its digits.
    middle = sum_of(x.high * y.low, x.low * y.high)
    total = sum_of(x.high * y.high, middle.high)
    return quick_sum(total.high, total.low + (middle.low + x.low * y.low))


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
    remainder = subtract_pairs(x, scale_pair(y, high))
    return quick_sum(high, remainder.high / y.high)


def root_of(x: Pair) -> Pair:
    """The square root of a positive pair."""
    high = jnp.sqrt(x.high)
    remainder = subtract_pairs(x, product_of(high, high))
    return quick_sum(high, remainder.high / (2 * high))


def whole_and_fraction(rate: Scalars, time: Scalars) -> tuple[Scalars, Scalars]:
    """rate * time as a whole number and a remainder in [-1/2, 1/2], without loss of digits for
    large products."""
    x, y = split(rate), split(time)
    product = rate * time
    integer = jnp.round(product)
    remainder = (x.high * y.high - integer) + (x.high * y.low + x.low * y.high) + x.low * y.low
    # the low parts of very small factors underflow
    return integer, jnp.where(integer == 0, product, remainder)


# sin(pi x / 2) / x for |x| <= 1/2
_SINE = (
    1.5707963267948966,
    -0.6459640975062443,
    0.07969262624604301,
    -0.004681754132340976,
    0.0001604411507421909,
    -3.59864335298231e-06,
    5.633933781537854e-08,
)
# sinh(x) / x for |x| <= 1
_SINH = (
    1.0,
    0.1666666666666574,
    0.008333333333481565,
    0.0001984126975236418,
    2.7557344608530327e-06,
    2.5048389847459933e-08,
    1.6328795874557297e-10,
)
# atan(x) / x for |x| <= tan(pi/16)
_ARCTANGENT = (
    1.0,
    -0.333333333333333,
    0.19999999999977505,
    -0.14285714279864764,
    0.11111110348139375,
    -0.0909085307967067,
    0.0768988435768423,
    -0.0660516727229625,
    0.050273062752334695,
)


def horner(coefficients, x: Scalars) -> Scalars:
    """Polynomial with coefficients in ascending order."""
    total = coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def sine_half(x: Scalars) -> Scalars:
    """sin(pi x / 2) for |x| <= 1/2."""
    return x * horner(_SINE, x * x)


def sinh(x: Scalars) -> Scalars:
    """Hyperbolic sine, accurate to rounding for small x as well."""
    growth = jnp.exp(jnp.abs(x))
    large = jnp.copysign((growth - 1 / growth) / 2, x)
    return jnp.where(jnp.abs(x) < 1, x * horner(_SINH, x * x), large)


def arctangent(tangent: Scalars) -> Scalars:
    """arctan for 0 <= tangent <= 1, by two halvings and a polynomial."""
    for _ in range(2):
        tangent = tangent / (1 + jnp.sqrt(1 + tangent * tangent))
    return 4 * tangent * horner(_ARCTANGENT, tangent * tangent)


def cosine_sine(fraction: Scalars) -> tuple[Scalars, Scalars]:
    """cos(pi x), sin(pi x) for |x| <= 1/2."""
    half = sine_half(fraction)
    return 1 - 2 * half * half, 2 * half * jnp.sqrt(1 - half * half)


def sign_of_parity(integer: Scalars) -> Scalars:
    """+1 for even and -1 for odd whole numbers."""
    half = integer / 2
    return 1 - 4 * jnp.abs(half - jnp.round(half))


def nome_per_lambda(lam: Array) -> Array:
    """q / lambda, where lambda = (1 - sqrt k') / (2 (1 + sqrt k')), for m <= 0.8: DLMF 20.9.2."""
    z = lam * lam
    z = z * z
    return 1 + z * (2 + z * (15 + z * (150 + z * (1707 + z * 20910))))


def nome_per_parameter(m: Array, fourth_root: Array) -> Array:
    """q/m, which is regular at m = 0; ``fourth_root``: of the complementary parameter 1 - m."""
    # lambda / m without the cancellation in 1 - sqrt k' at small m: in
    # m = (1 - sqrt k') (1 + sqrt k') (1 + k') the first factor cancels.
    share = 1 / (2 * (1 + fourth_root * fourth_root) * (1 + fourth_root) ** 2)
    return share * nome_per_lambda(share * m)


def theta3_squared_less_one(q: Array) -> Array:
    """theta3(0, q)^2 - 1 = 2 K/pi - 1, without cancellation, for q <= exp(-pi): DLMF 20.2.3."""
    q2 = q * q
    q4 = q2 * q2
    above = 2 * (q + q4 + q4 * q4 * q)
    return above * (2 + above)


def deficit_per_parameter(q: Array, per_m: Array, theta3_squared: Array, theta4: Array) -> Array:
    """(1 - E/K)/m = D/K: theta4'' over theta4, DLMF 20.2.4 and 19.25.1; ``per_m`` is q/m."""
    q3 = q * q * q
    q4 = q3 * q
    series = 1 - q3 * (4 - q4 * q * (9 - 16 * q4 * q3))
    return 8 * per_m * series / (theta4 * theta3_squared * theta3_squared)


def rd_series(x: Array, y: Array, z: Array) -> Array:
    """Carlson's R_D(x, y, z) of three arguments that nearly agree: DLMF 19.36.2, up to degree 7."""
    mean = (x + y + 3 * z) / 5
    x, y = 1 - x / mean, 1 - y / mean
    z = -(x + y) / 3
    xy, z2 = x * y, z * z
    e2, e3 = xy - 6 * z2, (3 * xy - 8 * z2) * z
    e4, e5 = 3 * (xy - z2) * z2, xy * z2 * z
    series = (
        1
        - 3 * e2 / 14
        + e3 / 6
        + 9 * e2 * e2 / 88
        - 3 * e4 / 22
        - 9 * e2 * e3 / 52
        + 3 * e5 / 26
        - e2 * e2 * e2 / 16
        + 3 * e3 * e3 / 40
        + 3 * e2 * e4 / 20
        + 45 * e2 * e2 * e3 / 272
        - 9 * (e3 * e4 + e2 * e5) / 68
    )
    return series / (mean * jnp.sqrt(mean))


AGM_STEPS = 5
"""Steps of the arithmetic-geometric mean: sufficient for ratios of sqrt(0.2) and larger."""


def agm_and_nome(circular, on_separatrix, x: Scalars, m: Scalars, m1: Scalars, one: Scalars):
    """Arithmetic-geometric mean, nome, minus its logarithm, and the rate of the argument v."""
    square = jnp.where(circular, m, m1)
    other = jnp.sqrt(jnp.where(circular, m1, m))
    omega = jnp.sqrt(x)
    # Quadratic convergence: from b >= sqrt(0.2) on the fifth mean is accurate to rounding. The
    # number of steps is the same for all lanes, without a loop.
    a, b = 1.0, other
    for _ in range(AGM_STEPS - 1):
        a, b = (a + b) / 2, jnp.sqrt(a * b)
    agm = (a + b) / 2
    nome = square * nome_per_parameter(square, jnp.sqrt(other))
    agm, nome = staged((agm, nome), one)
    log_nome = jnp.where(
        circular | on_separatrix, 1, -jnp.log(jnp.where(circular | on_separatrix, 0.5, nome))
    )
    return agm, nome, log_nome, staged(omega * agm, one)
