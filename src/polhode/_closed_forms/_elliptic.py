"""Series of elliptic functions and integrals that the closed forms share.

NIST Digital Library of Mathematical Functions (DLMF), chapters 19 and 20; B. C. Carlson, Numer.
Algorithms 10 (1995) 13. The series hold for a parameter m <= 0.8, where they reach the last bit of
float64; callers take the complementary parameter beyond.
"""

import jax.numpy as jnp
from jax import Array


def nome_per_lambda(lam: Array) -> Array:
    """q over lambda = (1 - sqrt k') / (2 (1 + sqrt k')), to float64 for m <= 0.8: DLMF 20.9.2."""
    z = lam * lam
    z = z * z
    return 1 + z * (2 + z * (15 + z * (150 + z * (1707 + z * 20910))))


def nome_per_parameter(m: Array, fourth_root: Array) -> Array:
    """q/m, which is regular at m = 0; ``fourth_root``: of the complementary parameter 1 - m."""
    # lambda / m without the cancellation of 1 - sqrt k' at small m: both factors of
    # m = (1 - sqrt k') (1 + sqrt k') (1 + k') that do not vanish are divided out.
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
