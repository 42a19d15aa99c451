"""The nome q of the smaller one of m and 1 - m, and its theta constants.

With the smaller parameter x <= 1/2 the nome is at most exp(-pi) = 0.0432, so three or four terms
of every theta series reach float64. Functions of m > 1/2 use the imaginary transformation.
Source: NIST DLMF 20.2, 20.7(viii), 22.2; the series of q in lambda: DLMF 19.5.5 and 20.9.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

HALF_PI = 1.5707963267948966


class Nome(NamedTuple):
    """The nome of x = min(m, 1 - m) and what every theta quotient needs of it.

    `circular` is True where x = m. `per_x` is q/x, finite at x = 0. `excess` is
    theta3(q)^2 - 1, so K(x) = (pi/2) (1 + excess). `theta2` is theta2(q) / (2 q^(1/4)).
    `deficit_per_x` is (1 - E(x)/K(x)) / x = D(x)/K(x).
    """

    circular: Array
    x: Array
    q: Array
    per_x: Array
    excess: Array
    theta2: Array
    theta3: Array
    theta4: Array
    deficit_per_x: Array


def nome_per_lambda(lam: Array) -> Array:
    """q over lambda = (1 - sqrt k') / (2 (1 + sqrt k')), to float64 for m <= 0.8: DLMF 20.9.2."""
    z = lam * lam
    z = z * z
    return 1 + z * (2 + z * (15 + z * (150 + z * (1707 + z * 20910))))


def deficit_per_x(q: Array, per_x: Array, theta3_squared: Array, theta4: Array) -> Array:
    """(1 - E/K) / x = D/K of the parameter x <= 0.8: theta4'' over theta4, DLMF 20.2.4, 19.25.1."""
    q3 = q * q * q
    q4 = q3 * q
    bend = 1 - q3 * (4 - q4 * q * (9 - 16 * q4 * q3))
    return 8 * per_x * bend / (theta4 * theta3_squared * theta3_squared)


def nome(m: Array, m1: Array) -> Nome:
    """The nome and theta constants of min(m, m1), with m + m1 = 1, every number to a few ulps."""
    circular = m <= m1
    x = jnp.where(circular, m, m1)
    root = jnp.sqrt(jnp.where(circular, m1, m))
    fourth = jnp.sqrt(root)
    lam_per_x = 0.5 / ((1 + root) * (1 + fourth) * (1 + fourth))
    lam = lam_per_x * x
    correction = nome_per_lambda(lam)
    q, per_x = lam * correction, lam_per_x * correction
    q2 = q * q
    q4 = q2 * q2
    q9 = q4 * q4 * q
    above = 2 * (q + q4 + q9)
    theta3, theta4 = 1 + above, 1 - 2 * (q - q4 + q9)
    theta2 = 1 + q2 * (1 + q4)
    excess = above * (2 + above)
    deficit = deficit_per_x(q, per_x, 1 + excess, theta4)
    return Nome(circular, x, q, per_x, excess, theta2, theta3, theta4, deficit)


_LN2_HEAD, _LN2_TAIL = 0.693145751953125, 1.4286068203094173e-06


@jax.custom_jvp
def log_parts(q: Array) -> tuple[Array, Array]:
    """-log(q) for 0 < q <= 1 as an unevaluated sum, to a tenth of an ulp."""
    fraction, exponent = jnp.frexp(q)
    exponent = exponent.astype(q.dtype)
    # The head of ln 2 has 16 bits: its product with an exponent is exact in float64, and in
    # float32 as long as the exponent has at most 8 bits.
    head = -exponent * _LN2_HEAD
    tail = -exponent * _LN2_TAIL - jnp.log(fraction)
    total = head + tail
    back = total - head
    return total, (head - (total - back)) + (tail - back)


@log_parts.defjvp
def _log_parts_rule(primals, tangents):
    (q,), (dq,) = primals, tangents
    total, rest = log_parts(q)
    slope = -dq / q
    return (total, rest), (slope, jnp.zeros_like(slope))


def period_parts(parameter: Nome) -> tuple[Array, Array]:
    """2K of m > 1/2 as an unevaluated sum, (1 + excess) (-log q); 0 at q = 0."""
    q = parameter.q
    large, rest = log_parts(jnp.where(q > 0, q, 1))
    rest = rest + large * parameter.excess
    total = large + rest
    return total, rest - (total - large)
