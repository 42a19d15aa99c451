"""Elliptic integrals of the third kind for every characteristic n < 1, large negative n included.

Complete: the arithmetic-geometric mean, after n -> m/n where |n| is large (DLMF 19.7.9), so that
its auxiliary p never leaves [0.7, 1.5] and the number of steps depends on the dtype only.
Incomplete: Carlson's RJ, after n -> (m - n)/(1 - n) where -n sin^2 is large (DLMF 19.7.8), so that
p lies between the other arguments and every term is positive.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from polhode._checks import ArrayLike
from polhode._closed_forms.elliptic._argument import as_floats, broadcast, parameter_pair
from polhode._closed_forms.elliptic._carlson import rc_core, rf_rj_core
from polhode._closed_forms.elliptic._complete import first_kind
from polhode._closed_forms.elliptic._incomplete import angle_parts, sincos_arguments
from polhode._closed_forms.elliptic._partials import with_forward_partials

# Steps of the mean until its terms are equal for 1 - m = 1e-308 (1e-38), and two more so that the
# second derivatives have converged as well.
_STEPS_64, _STEPS_32 = 14, 10
_THIRD = (((0, 1.0),), ((1, 1.0), (2, -1.0)))


def _excess_of_small(p2: Array, m: Array, m1: Array) -> Array:
    """(Pi(n, m) - K(m)) / n for p2 = 1 - n in [1 - sqrt(m), 2]: DLMF 19.8.6 less its first term."""

    def halve(_, state):
        a, g, p, weight, total = state
        product, square = a * g, p * p
        both = square + product
        weight = 0.5 * weight * ((square - product) / both)
        return 0.5 * (a + g), jnp.sqrt(product), both / (2 * p), weight, total + weight

    # A loop and not an unrolled formula: its second derivatives compile ten times faster.
    one = jnp.ones_like(m1)
    steps = _STEPS_64 if p2.dtype == jnp.float64 else _STEPS_32
    total = jax.lax.fori_loop(0, steps, halve, (one, jnp.sqrt(m1), jnp.sqrt(p2), one, one))[-1]
    return first_kind(m, m1) * total / (2 * p2)


def _complete_core(n: Array, m: Array, m1: Array) -> tuple[Array, Array]:
    """Pi(n, m) and (Pi(n, m) - K(m)) / n."""
    # Below n = -1, and above both 1/2 and sqrt(m), the other root of n n' = m is the easier one.
    far = (n < -1) | ((n > 0.5) & (n * n > m))
    safe = jnp.where(far, n, 1)
    small = jnp.where(far, m / safe, n)
    away = jnp.where(n > 0.5, m1 - (1 - n), n - m)
    # 1 - m/n as (n - m)/n: nothing is lost where both are close to 1.
    excess = _excess_of_small(jnp.where(far, away / safe, 1 - n), m, m1)
    ratio = n / jnp.where(far, away, n - 1)
    # Two roots: their quotient neither overflows nor underflows for any n.
    turn = jnp.sqrt(jnp.where(far, ratio, 1)) / jnp.sqrt(jnp.where(far, 1 - n, 1))
    first = first_kind(m, m1)
    value = jnp.where(far, 0.5 * jnp.pi * turn - small * excess, first + n * excess)
    # Infinite for every n; the factor keeps the NaN of an n outside the domain.
    endless = m1 == 0
    return (
        jnp.where(endless, first * (1 + 0 * n), value),
        jnp.where(far & ~endless, (value - first) / safe, excess),
    )


def _complete_value(n: Array, m: Array, m1: Array) -> Array:
    return _complete_core(n, m, m1)[0]


def _complete_excess(n: Array, m: Array, m1: Array) -> Array:
    return _complete_core(n, m, m1)[1]


third_complete = with_forward_partials(_complete_value, _THIRD)
third_excess = with_forward_partials(_complete_excess, _THIRD)


def _quarter_core(n: Array, m: Array, m1: Array, s: Array, c: Array) -> Array:
    """Pi(n, phi, m) for tan phi = s/c with c >= 0, at any common scale of s and c."""
    s2, c2 = s * s, c * c
    r2, d2 = s2 + c2, c2 + m1 * s2
    endless = d2 == 0
    x, y = jnp.where(endless, 1, c2), jnp.where(endless, 1, d2)
    far = -2 * n * s2 > r2
    q = c2 + m1 * s2 / (1 - n)
    p = c2 + (1 - n) * s2
    pole = jnp.where(far, q, p)
    rf, rj = rf_rj_core(x, y, r2, jnp.where(pole > 0, pole, r2))
    first, cubic = s * rf, s2 * s / 3 * rj
    arc = s * c * rc_core(jnp.where(far, d2 * r2, 1), jnp.where(far, p * q, 1))
    swapped = (first - n * (arc + m1 / (1 - n) * cubic)) / (1 - n)
    value = jnp.where(far, swapped, first + n * cubic)
    return jnp.where(endless, jnp.inf * (1 + 0 * n) * s, value)


_quarter_parts = with_forward_partials(_quarter_core, (*_THIRD, ((3, 1.0),), ((4, 1.0),)))


@jax.custom_jvp
def _quarter(n: Array, m: Array, m1: Array, s: Array, c: Array) -> Array:
    return _quarter_core(n, m, m1, s, c)


def _quarter_rule(primals, tangents):
    n, m, m1, s, c = primals
    ds, dc = tangents[3:]
    moving = tuple(
        jnp.zeros_like(n) if isinstance(tangent, SymbolicZero) else tangent
        for tangent in tangents[:3]
    )
    still = jnp.zeros_like(s)
    if all(isinstance(tangent, SymbolicZero) for tangent in tangents[:3]):
        value, out = _quarter(*primals), still
    else:
        value, out = jax.jvp(lambda *a: _quarter_parts(*a, s, c), (n, m, m1), moving)
    s2, c2 = s * s, c * c
    slope = jnp.sqrt(s2 + c2) / ((c2 + (1 - n) * s2) * jnp.sqrt(c2 + m1 * s2))
    if not isinstance(ds, SymbolicZero):
        out = out + slope * c * ds
    if not isinstance(dc, SymbolicZero):
        out = out - slope * s * dc
    return value, out


_quarter.defjvp(_quarter_rule, symbolic_zeros=True)


def _any_angle(turns: Array, s: Array, c: Array, n: Array, m: Array, m1: Array) -> Array:
    """Pi of the angle turns pi + atan2(s, c)."""
    n = n * jnp.where(n < 1, 1, jnp.nan)
    turns, s, c, n, m, m1 = broadcast(turns, s, c, n, m, m1)
    behind = c < 0
    side = jnp.where(behind, -1, 1).astype(s.dtype)
    turns = turns + jnp.where(behind, jnp.where(s < 0, -1, 1), 0).astype(s.dtype)
    none = turns == 0
    whole = jnp.where(none, 0, 2 * turns * third_complete(n, m, jnp.where(none, 1 - m, m1)))
    return side * _quarter(n, m, m1, s, side * c) + whole


@jax.jit
def ellippi(
    n: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Complete elliptic integral of the third kind, Pi(n, m).

    The integrand is 1/((1 - n sin^2) sqrt(1 - m sin^2)) from 0 to pi/2.
    The characteristic `n` is any number below 1 (no cancellation however negative); n = 1 gives
    inf and n > 1 NaN (no Cauchy principal value). `m` in [0, 1] is the parameter, else NaN; `m1` =
    1 - m may be handed in beside it. Source: DLMF 19.2.8, 19.7.9, 19.8.6.
    """
    n, m, m1 = _third_arguments(n, m, m1)
    return third_complete(n, m, m1)


@jax.jit
def associate_j(
    n: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Associate complete integral of the third kind, J(n, m) = (Pi(n, m) - K(m)) / n.

    The integrand is sin^2/((1 - n sin^2) sqrt(1 - m sin^2)) from 0 to pi/2.
    Free of cancellation at n = 0, where it is D(m). Arguments and domain as in `ellippi`.
    Source: Fukushima (2012), J. Comput. Appl. Math. 236, 1961.
    """
    n, m, m1 = _third_arguments(n, m, m1)
    return third_excess(n, m, m1)


@jax.jit
def ellippi_inc(
    n: Float[ArrayLike, "..."],
    phi: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Incomplete integral of the third kind, Pi(n, phi, m), for any real angle phi [rad].

    `n` below 1 (else NaN), `m` and `m1` as in `ellippi`. Source: DLMF 19.2.7, 19.25.14, 19.7.8.
    """
    n, m, m1 = _third_arguments(n, m, m1)
    (phi,) = as_floats(phi)
    return _any_angle(*angle_parts(phi), n, m, m1)


@jax.jit
def ellippi_inc_sincos(
    n: Float[ArrayLike, "..."],
    s: Float[ArrayLike, "..."],
    c: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Pi(n, atan2(s, c), m) from the sine and cosine; these as in `ellipf_sincos`."""
    (n,) = as_floats(n)
    turns, s, c, m, m1 = sincos_arguments(s, c, m, m1)
    return _any_angle(turns, s, c, n, m, m1)


def _third_arguments(n: ArrayLike, m: ArrayLike, m1: ArrayLike | None):
    if m1 is None:
        n, m = as_floats(n, m)
        m, m1 = parameter_pair(m, None)
    else:
        n, m, m1 = as_floats(n, m, m1)
        m, m1 = parameter_pair(m, m1)
    return broadcast(n * jnp.where(n <= 1, 1, jnp.nan), m, m1)
