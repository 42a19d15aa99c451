"""Integrals of the second kind that the tangent needs: (14) of docs/free_motion.md."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms._elliptic import (
    deficit_per_parameter,
    nome_per_parameter,
    rd_series,
)
from polhode._closed_forms.free._motion import Swing
from polhode._closed_forms.free._roles import Triple

Scalars = Float[Array, "*b"]

_DUPLICATIONS = 14


def incomplete(S: Scalars, C: Scalars, N: Scalars, many: bool) -> tuple[Scalars, Scalars]:
    """Integrals of S^2 and (S/N)^2 over less than half a turn, by Carlson's duplication.

    They are S^3/3 R_D(C^2, N^2, 1) and S^3/3 R_D(C^2, 1, N^2), which share their square roots.
    """

    def duplicate(_, carry):
        first, second, x, y, z, share = carry
        return halve(first, second, x, y, z, share, jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z))

    def halve(first, second, x, y, z, share, u, v, w):
        grow = u * v + v * w + w * u
        first = first + share / (w * (z + grow))
        second = second + share / (v * (y + grow))
        return first, second, (x + grow) / 4, (y + grow) / 4, (z + grow) / 4, share / 4

    zero, one = jnp.zeros_like(N), jnp.ones_like(N)
    # The first roots are known: C and N are smooth where the root of C^2 is not.
    carry = halve(zero, zero, C * C, N * N, one, jnp.ones((), N.dtype), C, N, one)
    if many:
        # With many times per body several kernels need the result, and each would repeat all of
        # it: as a loop it is worked out once, and compiles in half of the time.
        carry = jax.lax.fori_loop(1, _DUPLICATIONS, duplicate, carry)
    else:
        for k in range(1, _DUPLICATIONS):
            carry = duplicate(k, carry)
    first, second, x, y, z, share = carry
    cube = S * S * S
    first, second = first + share / 3 * rd_series(x, y, z), second + share / 3 * rd_series(x, z, y)
    return cube * first, cube * second


def complete(swing: Swing) -> tuple[Scalars, Scalars]:
    """The same integrals over a quarter of the momentum's period."""
    means = swing.mean, swing.log_nome, swing.inverse_rate
    return quarter_turn(swing.circular, swing.endless, swing.m, swing.m1, *means)


def quarter_turn(circular, endless, m, m1, mean, log_nome, inverse_rate):
    """The same from the parameter, its complement and what comes of their mean."""
    square = jnp.where(circular, m, m1)
    other = jnp.sqrt(jnp.where(circular, m1, m))
    per_square = nome_per_parameter(square, jnp.sqrt(other))
    half = deficit_per_parameter(square * per_square, per_square, 1 / mean, jnp.sqrt(other / mean))
    quarter = jnp.where(circular, math.pi, log_nome) / (2 * mean)
    m = jnp.where(circular, 1, m)
    first = jnp.where(circular, quarter * half, (quarter * (1 - m1 * half) - mean) / m)
    second = jnp.where(circular, quarter * (1 - half), (mean + quarter * m1 * (half - 1)) / m)
    inverse = inverse_rate * mean
    cube = inverse * inverse * inverse
    bounded = jnp.where(endless, 0, cube)
    return first * bounded, second * bounded / jnp.where(endless, 1, m1)


def second_kind(
    swing: Swing, whole: Scalars, folded: Triple, many: bool
) -> tuple[Scalars, Scalars]:
    """Integrals of S^2 and (S/N)^2 from the start; ``folded``: S, C, N less their half turns."""
    first, second = incomplete(*folded, many)
    turn_first, turn_second = complete(swing)
    return first + 2 * whole * turn_first, second + 2 * whole * turn_second
