"""Incomplete elliptic integrals of the first and second kind, by the arithmetic-geometric mean.

With the sides C = |cos|, D = sqrt(cos^2 + m1 sin^2), N = sqrt(cos^2 + sin^2) Gauss's transformation
halves (N, D) to their mean when m <= 1/2, and (C, D) when m > 1/2; either converges quadratically
and only ever adds positive numbers. Source: DLMF 19.8.16-20, 19.8(iii); Carlson (1979).
"""

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from polhode._checks import ArrayLike
from polhode._closed_forms.elliptic._argument import as_floats, broadcast, parameter_pair
from polhode._closed_forms.elliptic._complete import first_kind, second_kind
from polhode._closed_forms.elliptic._jacobi import (
    arguments,
    reduce_half_turns,
    sd_squared,
    sn_squared,
)


def _quarter(s: Array, c: Array, m: Array, m1: Array) -> Array:
    """F for s of any sign and c >= 0, at any common scale of s and c."""
    circular = m <= m1
    mean, root = jnp.ones_like(m), jnp.sqrt(jnp.where(circular, m1, m))
    gap2 = jnp.where(circular, m, m1)
    s2 = s * s
    n = jnp.sqrt(s2 + c * c)
    d = jnp.sqrt(c * c + m1 * s2)
    size = jnp.abs(s)
    narrow_c, narrow_n, narrow_d = c, n, d
    wide_c, wide_d = c, d
    for _ in range(4 if s.dtype == jnp.float64 else 3):
        left, right = narrow_n + mean * size, narrow_d + root * size
        narrow_c = narrow_c * (left + right) / (2 * jnp.sqrt(left * right))
        narrow_n = 0.5 * (narrow_n + narrow_d)
        wide_c = 0.5 * (wide_c + wide_d)
        # gap = (mean - root)/2 of the next level, from the squares: no cancellation.
        after = 0.5 * (mean + root)
        gap2 = (gap2 / (4 * after)) ** 2
        root = jnp.sqrt(mean * root)
        mean = after
        part = gap2 * s2
        narrow_d = jnp.sqrt(jnp.maximum(narrow_n * narrow_n - part, 0))
        wide_d = jnp.sqrt(wide_c * wide_c + part)
    base = mean * size
    # asinh(base / C) as log1p, right for small and for large quotients.
    safe_c = jnp.where(circular, 1, wide_c)
    hypotenuse = jnp.sqrt(safe_c * safe_c + base * base)
    logarithm = jnp.log1p(base * (1 + base / (hypotenuse + safe_c)) / safe_c)
    value = jnp.where(circular, jnp.arctan2(base, narrow_c), logarithm) / mean
    return jnp.where(s < 0, -value, value)


def _fold(s: Array, c: Array) -> tuple[Array, Array]:
    """(offset, sign) with integral = 2 offset * complete + sign * quarter(s, |c|)."""
    behind = c < 0
    half = jnp.where(s < 0, -1.0, 1.0).astype(s.dtype)
    return jnp.where(behind, half, 0), jnp.where(behind, -1, 1).astype(s.dtype)


def _whole(turns: Array, complete: Array) -> Array:
    none = turns == 0
    return jnp.where(none, 0, 2 * turns * jnp.where(none, 1, complete))


@jax.custom_jvp
def first_of(turns: Array, s: Array, c: Array, m: Array, m1: Array) -> Array:
    """F of the angle turns pi + atan2(s, c)."""
    offset, sign = _fold(s, c)
    return sign * _quarter(s, jnp.abs(c), m, m1) + _whole(turns + offset, first_kind(m, m1))


@jax.custom_jvp
def second_of(turns: Array, s: Array, c: Array, m: Array, m1: Array) -> Array:
    """E of the angle turns pi + atan2(s, c)."""
    offset, sign = _fold(s, c)
    quarter = sn_squared(_quarter(s, jnp.abs(c), m, m1), m, m1)[1]
    return sign * quarter + _whole(turns + offset, second_kind(m, m1))


def _d_angle(s: Array, c: Array, ds, dc) -> Array:
    """(c ds - s dc) / sqrt(s^2 + c^2): the change of the angle times the common scale."""
    total = jnp.zeros_like(s * c)
    if not isinstance(ds, SymbolicZero):
        total = total + c * ds
    if not isinstance(dc, SymbolicZero):
        total = total - s * dc
    return total / jnp.sqrt(s * s + c * c)


def _first_rule(primals, tangents):
    _, s, c, m, m1 = primals
    _, ds, dc, dm, _ = tangents
    value = first_of(*primals)
    out = jnp.zeros_like(value)
    if not (isinstance(ds, SymbolicZero) and isinstance(dc, SymbolicZero)):
        out = out + _d_angle(s, c, ds, dc) / jnp.sqrt(c * c + m1 * s * s)
    if not isinstance(dm, SymbolicZero):
        out = out + 0.5 * sd_squared(value, m, m1)[0] * dm
    return value, out


def _second_rule(primals, tangents):
    _, s, c, m, m1 = primals
    _, ds, dc, dm, _ = tangents
    value = second_of(*primals)
    out = jnp.zeros_like(value)
    if not (isinstance(ds, SymbolicZero) and isinstance(dc, SymbolicZero)):
        slope = jnp.sqrt(c * c + m1 * s * s) / (s * s + c * c)
        out = out + _d_angle(s, c, ds, dc) * slope
    if not isinstance(dm, SymbolicZero):
        out = out - 0.5 * sn_squared(first_of(*primals), m, m1)[0] * dm
    return value, out


first_of.defjvp(_first_rule, symbolic_zeros=True)
second_of.defjvp(_second_rule, symbolic_zeros=True)


def angle_parts(phi: Array) -> tuple[Array, Array, Array]:
    """(turns, sine, cosine) of phi - pi turns, the cosine not negative."""
    turns, rest = reduce_half_turns(phi, jnp.zeros_like(phi))
    return turns, jnp.sin(rest), jnp.maximum(jnp.cos(rest), 0)


def sincos_arguments(
    s: ArrayLike, c: ArrayLike, m: ArrayLike, m1: ArrayLike | None
) -> tuple[Array, Array, Array, Array, Array]:
    """(0, s, c, m, 1 - m) as floats of one dtype."""
    if m1 is None:
        s, c, m = as_floats(s, c, m)
        m, m1 = parameter_pair(m, None)
    else:
        s, c, m, m1 = as_floats(s, c, m, m1)
        m, m1 = parameter_pair(m, m1)
    s, c = broadcast(s, c)
    return jnp.zeros_like(s), s, c, m, m1


@jax.jit
def ellipf(
    phi: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Incomplete elliptic integral of the first kind, F(phi, m), for any real angle phi [rad].

    `m` in [0, 1] is the parameter (the square of the modulus); `m1` = 1 - m may be handed in beside
    it when m is close to 1. An m outside [0, 1] gives NaN. Close to
    phi = pi/2 and m = 1 the angle itself no longer carries the answer: use `ellipf_sincos`.
    Source: DLMF 19.2.4, 19.8(ii).
    """
    phi, m, m1 = arguments(phi, m, m1)
    return first_of(*angle_parts(phi), m, m1)


@jax.jit
def ellipf_sincos(
    s: Float[ArrayLike, "..."],
    c: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """F(atan2(s, c), m) from the sine and cosine, which lose nothing near a right angle.

    `s` and `c` need not be normalised: only their ratio and signs count (their squares must neither
    overflow nor underflow). `m`, `m1` as in `ellipf`.
    """
    return first_of(*sincos_arguments(s, c, m, m1))


@jax.jit
def ellipe_inc(
    phi: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Incomplete elliptic integral of the second kind, E(phi, m). Arguments as in `ellipf`.

    Source: DLMF 19.2.5, 22.16.31.
    """
    phi, m, m1 = arguments(phi, m, m1)
    return second_of(*angle_parts(phi), m, m1)


@jax.jit
def ellipe_inc_sincos(
    s: Float[ArrayLike, "..."],
    c: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """E(atan2(s, c), m) from the sine and cosine. Arguments as in `ellipf_sincos`."""
    return second_of(*sincos_arguments(s, c, m, m1))
