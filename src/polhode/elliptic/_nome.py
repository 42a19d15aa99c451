"""The nome q of the smaller one of m and 1 - m, and its theta constants.

With the smaller parameter x <= 1/2 the nome is at most exp(-pi) = 0.0432, so three or four terms
of every theta series reach float64. Functions of m > 1/2 use the imaginary transformation.
Source: NIST DLMF 20.2, 20.7(viii), 22.2; the series of q in lambda: DLMF 19.5.5 and 20.9.
"""

from typing import NamedTuple

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


def nome(m: Array, m1: Array) -> Nome:
    """The nome and theta constants of min(m, m1), with m + m1 = 1, every number to a few ulps."""
    circular = m <= m1
    x = jnp.where(circular, m, m1)
    root = jnp.sqrt(jnp.where(circular, m1, m))
    fourth = jnp.sqrt(root)
    lam_per_x = 0.5 / ((1 + root) * (1 + fourth) * (1 + fourth))
    lam = lam_per_x * x
    z = lam * lam
    z = z * z
    correction = 1 + z * (2 + z * (15 + z * (150 + z * 1707)))
    q, per_x = lam * correction, lam_per_x * correction
    q2 = q * q
    q4 = q2 * q2
    q9 = q4 * q4 * q
    above = 2 * (q + q4 + q9)
    theta3, theta4 = 1 + above, 1 - 2 * (q - q4 + q9)
    theta2 = 1 + q2 * (1 + q4)
    excess = above * (2 + above)
    deficit_per_x = 8 * per_x * (1 - q * q2 * (4 - 9 * q4 * q)) / (theta4 * (1 + excess) ** 2)
    return Nome(circular, x, q, per_x, excess, theta2, theta3, theta4, deficit_per_x)


def period_log(parameter: Nome) -> Array:
    """-log(q), with 0 in place of infinity at q = 0."""
    q = parameter.q
    return -jnp.log(jnp.where(q > 0, q, 1))
