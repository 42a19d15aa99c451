"""Jacobi's functions sn, cn, dn, am, and the integrals of dn^2, sn^2, (sn/dn)^2 along u.

For m <= 1/2 the theta series run in sin v, cos v; for m > 1/2 (imaginary transformation) in
exp(-v). Either way the nome is at most exp(-pi). Source: NIST DLMF 20.2, 20.7.30-33, 22.2, 22.16.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from polhode._checks import ArrayLike
from polhode._closed_forms.elliptic._argument import as_floats, parameter_pair
from polhode._closed_forms.elliptic._complete import associate_b_of, associate_d_of, second_kind
from polhode._closed_forms.elliptic._nome import Nome, nome, period_parts

# pi in three parts; the first two have 26 (10) significant bits, so that their products with a
# count of half periods below 2^27 (2^14) are exact.
_PI_PARTS_64 = (3.1415926814079285, -2.781813535079891e-08, 1.2246467991473532e-16)
_PI_PARTS_32 = (3.140625, 0.0009679794311523438, -3.2584136988589307e-07)
_SMALL_U = 0.17


class Phase(NamedTuple):
    """The argument u in half periods (2K), and the remainder as series variables.

    `sign` is (-1)^turns. Circular: `v` = pi u/(2K) - pi turns with its sine and cosine.
    Hyperbolic: `w` = |u - 2K turns|, `side` its sign, `h` = exp(-v), `x` = h^2,
    `rise` = 1 - x, `y` = q/x with v = pi w/(2K').
    """

    turns: Array
    sign: Array
    v: Array
    sine: Array
    cosine: Array
    w: Array
    side: Array
    h: Array
    x: Array
    rise: Array
    y: Array


def reduce_half_turns(angle: Array, correction: Array) -> tuple[Array, Array]:
    """(turns, rest) with angle - correction = pi turns + rest and abs(rest) <= pi/2."""
    parts = _PI_PARTS_64 if angle.dtype == jnp.float64 else _PI_PARTS_32
    turns = jax.lax.stop_gradient(jnp.round((angle - correction) / jnp.pi))
    first, second, third = (jnp.asarray(part, angle.dtype) for part in parts)
    return turns, (((angle - turns * first) - correction) - turns * second) - turns * third


def phase(u: Array, p: Nome) -> Phase:
    """Reduce u and evaluate the few transcendental functions that the series need."""
    # v = u / (1 + excess) as u - u excess/(1 + excess): only the small part is rounded twice.
    circular_turns, v = reduce_half_turns(u, u * (p.excess / (1 + p.excess)))
    period, period_rest = period_parts(p)
    endless = (p.q == 0) | p.circular
    period = jnp.where(endless, 1, period)
    count = jax.lax.stop_gradient(jnp.where(endless, 0, jnp.round(u / period)))
    # A head of half the bits, so that its product with the count is exact.
    bits = (11, 25) if u.dtype == jnp.float64 else (8, 11)
    head = jax.lax.reduce_precision(jax.lax.stop_gradient(period), *bits)
    r = (u - count * head) - count * ((period - head) + period_rest)
    w = jnp.abs(r)
    # Beyond `largest` cn and dn underflow; the bound keeps their derivatives finite.
    largest = -0.98 * math.log(jnp.finfo(u.dtype).tiny)
    decay = jnp.minimum(w / (1 + p.excess), largest)
    h = jnp.exp(-decay)
    turns = jnp.where(p.circular, circular_turns, count)
    return Phase(
        turns=turns,
        sign=1 - 2 * jnp.abs(turns - 2 * jnp.round(turns / 2)),
        v=v,
        sine=jnp.sin(v),
        cosine=jnp.cos(v),
        w=w,
        side=jnp.where(r < 0, -1, 1).astype(u.dtype),
        h=h,
        x=h * h,
        rise=-jnp.expm1(-2 * decay),
        y=p.q / h / h,
    )


def _circular_terms(p: Nome, a: Phase) -> tuple[Array, ...]:
    """theta1/(2 q^(1/4)), theta2/(2 q^(1/4)), theta3, theta4 of v."""
    q = p.q
    q2 = q * q
    q4 = q2 * q2
    q6, q9, q12 = q4 * q2, q4 * q4 * q, q4 * q4 * q4
    z = a.sine * a.sine
    s3 = 3 - 4 * z
    s5 = 5 - z * (20 - 16 * z)
    s7 = 7 - z * (56 - z * (112 - 64 * z))
    c3 = 1 - 4 * z
    c5 = 1 - z * (12 - 16 * z)
    c7 = 1 - z * (24 - z * (80 - 64 * z))
    theta1 = a.sine * (1 - q2 * s3 + q6 * s5 - q12 * s7)
    theta2 = a.cosine * (1 + q2 * c3 + q6 * c5 + q12 * c7)
    cos2 = 1 - 2 * z
    cos4 = 2 * cos2 * cos2 - 1
    odd = 2 * q * cos2 + 2 * q9 * cos2 * (2 * cos4 - 1)
    even = 2 * q4 * cos4
    return theta1, theta2, 1 + (even + odd), 1 + (even - odd)


def _hyperbolic_terms(p: Nome, a: Phase) -> tuple[Array, ...]:
    """theta1/i, theta2, theta3, theta4 of i v; the first two over q^(1/4) exp(v)."""
    q, x, y = p.q, a.x, a.y
    q2 = q * q
    qy, q4y2, q9y3 = q * y, (q2 * y) ** 2, (q2 * q * y) ** 3
    ramp3 = 1 + x * (1 + x)
    ramp5 = 1 + x * (1 + x * ramp3)
    theta1 = a.rise * (1 - qy * ramp3 + q4y2 * ramp5 - q9y3 * ramp3)
    x2 = x * x
    theta2 = (1 + x) + qy * (1 + x * x2) + q4y2 * (1 + x * x2 * x2) + q9y3
    q2y2, cubes = (q * y) ** 2, (q2 * y) ** 3 + (q2 * q * x) ** 3
    q12y4 = q2y2 * q2y2 * (q2 * q2) ** 2
    qx = q * x
    odd = y + qx + cubes
    even = q2y2 + (q * qx) ** 2 + q12y4
    return theta1, theta2, (1 + even) + odd, (1 - y) + (even - qx - cubes)


def _copolar(p: Nome, a: Phase) -> tuple[Array, Array, Array]:
    """sn, cn, dn from the reduced phase."""
    t1, t2, t3, t4 = _circular_terms(p, a)
    inverse = 1 / (t4 * p.theta2)
    sn_c = p.theta3 * t1 * inverse
    cn_c = p.theta4 * t2 * inverse
    dn_c = p.theta4 / p.theta3 * (t3 / t4)
    h1, h2, h3, h4 = _hyperbolic_terms(p, a)
    inverse = 1 / (h2 * p.theta4)
    sn_h = a.side * (p.theta3 * h1 * inverse)
    lead = 2 * p.theta2 * a.h
    cn_h = lead * (h4 * inverse)
    dn_h = lead * (h3 / (h2 * p.theta3))
    return (
        a.sign * jnp.where(p.circular, sn_c, sn_h),
        a.sign * jnp.where(p.circular, cn_c, cn_h),
        jnp.where(p.circular, dn_c, dn_h),
    )


def _log_slope(p: Nome, a: Phase, sign: int) -> Array:
    """v G'(0) - G(v), G = sum of n (sign q)^(n^2 - 1) sin(2 n v) over theta3 of nome sign q."""
    q = p.q
    q3, q8, q15 = sign * q**3, q**8, sign * q**15
    z = a.sine * a.sine
    sin2 = 2 * a.sine * a.cosine
    cos2 = 1 - 2 * z
    cos4 = 2 * cos2 * cos2 - 1
    wave = sin2 * (1 + 4 * q3 * cos2 + 3 * q8 * (2 * cos4 + 1) + 16 * q15 * cos2 * cos4)
    theta = 1 + 2 * sign * q * (cos2 + q3 * cos4 + q8 * cos2 * (2 * cos4 - 1))
    origin = 1 + 2 * sign * q * (1 + q3 + q8)
    slope = (2 + 8 * q3 + 18 * q8 + 32 * q15) / origin
    return (a.v + a.turns * jnp.pi) * slope - wave / theta


def _small_series(sn: Array, m: Array, first: float) -> Array:
    """Integral of x^2 (1 - x^2)^(-1/2) (1 - m x^2)^(-first) from 0 to a small sn."""
    z = sn * sn
    before, now = jnp.zeros_like(m * z), jnp.ones_like(m * z)
    power = jnp.ones_like(z)
    total = now / 3
    for j in range(11 if sn.dtype == jnp.float64 else 5):
        later = ((1 + m) * j + 0.5 + first * m) * now - m * (j - 0.5 + first) * before
        before, now = now, later / (j + 1)
        power = power * z
        total = total + now * power / (2 * j + 5)
    return total * z * sn


def _along(turns: Array, complete: Array) -> Array:
    """2 turns times a complete integral, 0 where turns = 0 even if that integral is infinite."""
    none = turns == 0
    return jnp.where(none, 0, 2 * turns * jnp.where(none, 1, complete))


def _sd_squared_core(u: Array, m: Array, m1: Array) -> tuple[Array, Array]:
    """The integral of (sn/dn)^2 from 0 to u, bare and times dn (which stays finite for longer)."""
    p = nome(m, m1)
    a = phase(u, p)
    sn, _, dn = _copolar(p, a)
    circular = 4 * p.per_x / ((1 + p.excess) * jnp.where(p.circular, m1, 1)) * _log_slope(p, a, 1)
    _, t2, t3, _ = _hyperbolic_terms(p, a)
    q, x, y = p.q, a.x, a.y
    x2 = x * x
    bracket = (
        a.rise
        * (1 + x)
        * (1 + 2 * q * q * y * (1 + x2) + 3 * (q * q * q * y) ** 2 * (1 + x2 * (1 + x2)))
    )
    share = 1 - p.deficit_per_x
    lead = 2 * p.per_x / (1 + p.excess)
    scale = a.side / jnp.where(p.circular, 1, m)
    hyperbolic = scale * (lead * bracket / (a.h * a.h * t3) - a.w * share)
    scaled = scale * (lead * 2 * p.theta2 / p.theta3 * bracket / (a.h * t2) - dn * a.w * share)
    whole = _along(a.turns, associate_b_of(m, m1) / m1)
    small = _small_series(jnp.where(jnp.abs(u) < _SMALL_U, sn, 0), m, 1.5)
    bare = jnp.where(p.circular, circular, hyperbolic + whole)
    times_dn = jnp.where(p.circular, circular * dn, scaled + dn * whole)
    is_small = jnp.abs(u) < _SMALL_U
    return jnp.where(is_small, small, bare), jnp.where(is_small, small * dn, times_dn)


def _sn_squared_core(u: Array, m: Array, m1: Array) -> tuple[Array, Array]:
    """The integrals of sn^2 and of dn^2 = 1 - m sn^2 from 0 to u, neither by cancellation."""
    p = nome(m, m1)
    a = phase(u, p)
    sn = _copolar(p, a)[0]
    circular = 4 * p.per_x / (1 + p.excess) * _log_slope(p, a, -1)
    _, t2, _, _ = _hyperbolic_terms(p, a)
    q, x, y = p.q, a.x, a.y
    ramp3 = 1 + x * (1 + x)
    ramp5 = 1 + x * (1 + x * ramp3)
    slope = a.rise * (1 + 3 * q * y * ramp3 + 5 * (q * q * y) ** 2 * ramp5) + 7 * (q**3 * y) ** 3
    rest = slope / (t2 * (1 + p.excess))
    deficit = p.x * p.deficit_per_x
    hyperbolic = a.side * (a.w * (1 - deficit) - rest) / jnp.where(p.circular, 1, m)
    hyperbolic = hyperbolic + _along(a.turns, associate_d_of(m, m1))
    is_small = jnp.abs(u) < _SMALL_U
    small = _small_series(jnp.where(is_small, sn, 0), m, 0.5)
    sn_squared = jnp.where(is_small, small, jnp.where(p.circular, circular, hyperbolic))
    # deficit is 0 at m = 1, where w may be infinite.
    linear = jnp.where(deficit == 0, 0, a.w * deficit)
    dn_squared = a.side * (linear + rest) + _along(a.turns, second_kind(m, m1))
    dn_squared = jnp.where(p.circular | is_small, u - m * sn_squared, dn_squared)
    return sn_squared, dn_squared


def _along_parameter(core, u: Array, m: Array, m1: Array):
    """The derivative of core(u, m, 1 - m) with respect to m."""
    return jax.jvp(lambda a, b: core(u, a, b), (m, m1), (jnp.ones_like(m), -jnp.ones_like(m1)))[1]


@jax.custom_jvp
def sd_squared(u: Array, m: Array, m1: Array) -> tuple[Array, Array]:
    """Integral of (sn/dn)^2 from 0 to u, bare and times dn(u)."""
    return _sd_squared_core(u, m, m1)


def _sd_squared_rule(primals, tangents):
    u, m, m1 = primals
    du, dm, _ = tangents
    bare, times_dn = sd_squared(u, m, m1)
    d_bare = d_times = jnp.zeros_like(bare)
    if not isinstance(du, SymbolicZero):
        sn, cn, dn, _ = jacobi(u, m, m1)
        d_bare = d_bare + (sn / dn) ** 2 * du
        d_times = d_times + (sn * sn / dn - m * sn * cn * bare) * du
    if not isinstance(dm, SymbolicZero):
        along, along_times = _along_parameter(_sd_squared_core, u, m, m1)
        d_bare, d_times = d_bare + along * dm, d_times + along_times * dm
    return (bare, times_dn), (d_bare, d_times)


sd_squared.defjvp(_sd_squared_rule, symbolic_zeros=True)


@jax.custom_jvp
def sn_squared(u: Array, m: Array, m1: Array) -> tuple[Array, Array]:
    """Integrals of sn^2 and of dn^2 from 0 to u."""
    return _sn_squared_core(u, m, m1)


def _sn_squared_rule(primals, tangents):
    u, m, m1 = primals
    du, dm, _ = tangents
    first, second = sn_squared(u, m, m1)
    d_first = d_second = jnp.zeros_like(first)
    if not isinstance(du, SymbolicZero):
        sn, _, dn, _ = jacobi(u, m, m1)
        d_first, d_second = d_first + sn * sn * du, d_second + dn * dn * du
    if not isinstance(dm, SymbolicZero):
        dn = jacobi(u, m, m1)[2]
        along = _along_parameter(lambda *args: _sn_squared_core(*args)[0], u, m, m1)
        d_first = d_first + along * dm
        d_second = d_second - 0.5 * (dn * sd_squared(u, m, m1)[1] + first) * dm
    return (first, second), (d_first, d_second)


sn_squared.defjvp(_sn_squared_rule, symbolic_zeros=True)


@jax.custom_jvp
def jacobi(u: Array, m: Array, m1: Array) -> tuple[Array, Array, Array, Array]:
    """sn, cn, dn, am for a pair already made by `parameter_pair`."""
    p = nome(m, m1)
    a = phase(u, p)
    sn, cn, dn = _copolar(p, a)
    am = jnp.arctan2(a.sign * sn, a.sign * cn) + a.turns * jnp.pi
    return sn, cn, dn, am


def _jacobi_rule(primals, tangents):
    u, m, m1 = primals
    du, dm, _ = tangents
    sn, cn, dn, am = jacobi(u, m, m1)
    d_am, d_dn = jnp.zeros_like(am), jnp.zeros_like(dn)
    if not isinstance(du, SymbolicZero):
        d_am, d_dn = d_am + dn * du, d_dn - m * sn * cn * du
    if not isinstance(dm, SymbolicZero):
        # At fixed u the amplitude moves by -(dn/2) times the integral of (sn/dn)^2: DLMF 22.16.
        half = 0.5 * sd_squared(u, m, m1)[1]
        d_am = d_am - half * dm
        d_dn = d_dn + (m * sn * cn * half - 0.5 * sn * sn) / dn * dm
    return (sn, cn, dn, am), (cn * d_am, -sn * d_am, d_dn, d_am)


jacobi.defjvp(_jacobi_rule, symbolic_zeros=True)


@jax.jit
def ellipj(
    u: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Jacobi's elliptic functions sn, cn, dn and the amplitude am of u for the parameter m.

    `u` is any real number, `m` in [0, 1] the parameter (the square of the modulus), and `m1` =
    1 - m may be handed in beside it when m is close to 1. The amplitude is continuous in u
    (not folded). `u` and `m` may have different shapes that broadcast: what depends on m alone is
    then evaluated at the shape of m. An m outside [0, 1] gives NaN.
    Source: DLMF 22.2 (theta series), 20.7(viii) (imaginary transformation).
    """
    u, m, m1 = arguments(u, m, m1)
    return jacobi(u, m, m1)


@jax.jit
def jacobi_epsilon(
    u: Float[ArrayLike, "..."],
    m: Float[ArrayLike, "..."],
    *,
    m1: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, "..."]:
    """Jacobi's epsilon, the integral of dn^2 from 0 to u (= E(am u, m)). Arguments as `ellipj`.

    Source: DLMF 22.16(ii).
    """
    u, m, m1 = arguments(u, m, m1)
    return sn_squared(u, m, m1)[1]


def arguments(u: ArrayLike, m: ArrayLike, m1: ArrayLike | None) -> tuple[Array, Array, Array]:
    """u and the parameter pair as floats of one dtype."""
    if m1 is None:
        u, m = as_floats(u, m)
        return (u, *parameter_pair(m, None))
    u, m, m1 = as_floats(u, m, m1)
    return (u, *parameter_pair(m, m1))
