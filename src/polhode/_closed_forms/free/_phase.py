"""Sines of a fraction of a turn, hyperbolic sines and small arcs, in arithmetic alone.

The polynomials are Chebyshev fits to 40 digits, good to 1e-17 on their intervals; the compiler
turns them into vector code, which its own sine is not.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

Scalars = Float[Array, "*b"]

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
_ARC = (
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
    """Polynomial with the coefficients in rising order."""
    total = coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def sine_half(x: Scalars) -> Scalars:
    """sin(pi x / 2) for |x| <= 1/2."""
    return x * horner(_SINE, x * x)


def sinh(x: Scalars) -> Scalars:
    """Hyperbolic sine, exact to rounding also for small x."""
    growth = jnp.exp(jnp.abs(x))
    large = jnp.copysign((growth - 1 / growth) / 2, x)
    return jnp.where(jnp.abs(x) < 1, x * horner(_SINH, x * x), large)


def arc(tangent: Scalars) -> Scalars:
    """arctan for 0 <= tangent <= 1, by two halvings and a polynomial."""
    for _ in range(2):
        tangent = tangent / (1 + jnp.sqrt(1 + tangent * tangent))
    return 4 * tangent * horner(_ARC, tangent * tangent)


def cosine_sine(rest: Scalars) -> tuple[Scalars, Scalars]:
    """cos(pi x), sin(pi x) for |x| <= 1/2."""
    half = sine_half(rest)
    return 1 - 2 * half * half, 2 * half * jnp.sqrt(1 - half * half)


def parity(whole: Scalars) -> Scalars:
    """+1 for even and -1 for odd whole numbers."""
    half = whole / 2
    return 1 - 4 * jnp.abs(half - jnp.round(half))
