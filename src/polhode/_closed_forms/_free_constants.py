"""The constants of the exact free motion; (n) are formulas of docs/free_motion.md.

``assign_roles`` orders and scales the axes; ``polhode_constants`` and ``precession_constants``
compute the constants that depend on the body and its initial state alone. ``staged`` prevents XLA
from repeating earlier arithmetic in every loop that uses its results.

``compensated_constants`` also computes the rounding errors of the two frequencies: over a long
horizon the error of the motion is that of its phases, one unit in the last place of the frequencies
times the time. In single precision the constants are computed in double precision and rounded. In
double precision the frequencies are computed by arithmetic-geometric means of unevaluated sums of
two floats. Let axis 3 be the one about which the momentum circulates, p = |1/I1 - 1/I2|, r = |1/I2
- 1/I3| and s = p + r. Then the half period of the momentum is 2 K(m) / omega_p, and the mean rate
of the Euler angle about L is |L| (1/I3 +- s Pi(-p/r, m) / K(m)), with Pi/K by DLMF 19.8.6.
"""

import math
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from polhode._closed_forms._arithmetic import (
    AGM_STEPS,
    Pair,
    add_pairs,
    agm_and_nome,
    arctangent,
    binade,
    divide_pairs,
    multiply_pairs,
    product_of,
    root_of,
    scale_pair,
    subtract_pairs,
    sum_of,
)
from polhode._hamiltonian import triple
from polhode._kernels import in_double, opaque_ones, staged

Scalars = Float[Array, "*b"]
Triple = tuple[Scalars, Scalars, Scalars]


def as_components(values) -> tuple[Scalars, ...]:
    """A tuple of component arrays, from one or from an array with the components last."""
    if isinstance(values, tuple | list):
        return tuple(values)
    return jnp.unstack(values, axis=-1)


class Roles(NamedTuple):
    """Renumbered axes of a body: the momentum circulates about axis 3, and axis 2 is intermediate.

    Rates are divided by a power of two close to the largest rate, and moments by one for which the
    largest momentum is close to one, so that products of momenta do not overflow or underflow. The
    scaled time is the time times ``rate_unit``, which is zero for a body at rest (its rates are
    then arbitrary).
    """

    moments: Triple
    rates: Triple
    rate_unit: Scalars  # the power of two that divides the rates
    moment_unit: Scalars  # the power of two that divides the moments
    gap: Scalars  # |I3 w3^2 (I3 - I2) - I1 w1^2 (I2 - I1)|, the distance from the separatrix
    sense: Scalars  # +1 when axis 3 has the largest moment, -1 when the smallest
    parity: Scalars  # +1 when axes 1, 2, 3 are a right-handed system
    axis_2: Scalars  # index of axis 2 among x, y, z: 0, 1 or 2
    axis_3: Scalars  # index of axis 3
    one: Scalars  # ones for ``staged``


def component_at(values: Triple, index) -> Scalars:
    """The value at an index 0, 1 or 2."""
    return jnp.where(index == 0, values[0], jnp.where(index == 1, values[1], values[2]))


def _extremes(x: Scalars, y: Scalars, z: Scalars) -> tuple[Int[Array, "*b"], Int[Array, "*b"]]:
    """Indices of the smallest and the largest of three values; different even if all are equal."""
    low = jnp.where(y < x, jnp.where(z < y, 2, 1), jnp.where(z < x, 2, 0))
    high = jnp.where(y >= x, jnp.where(z >= y, 2, 1), jnp.where(z >= x, 2, 0))
    return low, high


def _energy_term(moment: Scalars, rate: Scalars, larger: Scalars, smaller: Scalars) -> Pair:
    """moment * rate^2 * (larger - smaller), with its rounding error."""
    return multiply_pairs(scale_pair(product_of(rate, rate), moment), sum_of(larger, -smaller))


def assign_roles(moments: Triple, rates: Triple) -> Roles:
    """Sort the axes, choose the one about which the momentum circulates, scale by powers of two."""
    largest = jnp.maximum(jnp.maximum(jnp.abs(rates[0]), jnp.abs(rates[1])), jnp.abs(rates[2]))
    rate_unit = binade(largest)
    moment_unit = binade(jnp.maximum(jnp.maximum(moments[0], moments[1]), moments[2]))
    one = opaque_ones(moments[0])
    # The momentum of a sphere circulates about no axis. The axis closest to it is chosen, so that
    # the momentum is not perpendicular to axis 3.
    sphere = (moments[0] == moments[1]) & (moments[1] == moments[2])
    order = tuple(jnp.where(sphere, jnp.abs(w), i) for w, i in zip(rates, moments, strict=True))
    k_low, k_high = _extremes(*order)
    k_mid = 3 - k_low - k_high
    low, mid, high = (component_at(moments, k) / moment_unit for k in (k_low, k_mid, k_high))
    w_low, w_mid, w_high = (component_at(rates, k) / rate_unit for k in (k_low, k_mid, k_high))
    at_rest = largest == 0
    w_high = jnp.where(at_rest, 1, w_high)
    momentum_unit = binade(
        jnp.maximum(jnp.maximum(jnp.abs(low * w_low), jnp.abs(mid * w_mid)), jnp.abs(high * w_high))
    )
    moment_unit = moment_unit * momentum_unit
    low, mid, high = low / momentum_unit, mid / momentum_unit, high / momentum_unit
    # Accurate close to the separatrix, where the terms cancel and the motion depends on the
    # difference.
    gap = subtract_pairs(
        _energy_term(high, w_high, high, mid), _energy_term(low, w_low, mid, low)
    ).value
    gap = staged(gap, one)
    # A gap of zero is the separatrix, or a rotation about a transverse axis of a symmetric body; in
    # the latter case axis 3 must be one of the two equal ones.
    larger = (gap > 0) | ((gap == 0) & (high - mid <= mid - low))
    sense = staged(jnp.where(larger, 1, -1).astype(low.dtype), one)
    larger = sense > 0
    k1, k3 = jnp.where(larger, k_low, k_high), jnp.where(larger, k_high, k_low)
    right_handed = (k_mid - k1 == 1) | (k_mid - k1 == -2)
    return Roles(
        staged((jnp.where(larger, low, high), mid, jnp.where(larger, high, low)), one),
        staged((jnp.where(larger, w_low, w_high), w_mid, jnp.where(larger, w_high, w_low)), one),
        staged(jnp.where(at_rest, 0, rate_unit), one),
        staged(moment_unit, one),
        jnp.abs(gap),
        sense,
        staged(jnp.where(right_handed, 1, -1).astype(low.dtype), one),
        staged(k_mid.astype(low.dtype), one),
        staged(k3.astype(low.dtype), one),
        one,
    )


def restore(values: Triple, axis_2: Scalars, axis_3: Scalars) -> Triple:
    """Values along axes 1, 2, 3 in the order of x, y, z."""
    first, second, third = values
    return triple(
        jnp.where(axis_3 == k, third, jnp.where(axis_2 == k, second, first)) for k in range(3)
    )


# Beyond this parameter m the series in the nome are replaced by those in the complementary nome.
# On either side three terms (five in the half nome of the attitude) are accurate to float64.
_CIRCULAR_BELOW = 0.8


class Polhode(NamedTuple):
    """Constants of the motion of the momentum in the body, along axes 1, 2, 3, in scaled units."""

    momentum: Triple
    inverse_moments: Triple
    moments: Triple
    p: Scalars  # |1/I1 - 1/I2|
    r: Scalars  # |1/I2 - 1/I3|
    s: Scalars  # |1/I1 - 1/I3|
    A: Scalars  # |2E - L^2/I3|
    B: Scalars  # |L^2/I1 - 2E|
    m: Scalars
    m1: Scalars
    circular: Bool[Array, "*b"]  # series in sines; else in hyperbolic sines, near the separatrix
    on_separatrix: Bool[Array, "*b"]  # infinite period
    permanent: Bool[Array, "*b"]  # permanent rotation about a principal axis
    nome: Scalars
    agm: Scalars  # the arithmetic-geometric mean, for the second kind
    log_nome: Scalars  # minus the logarithm of the nome
    rate: Scalars  # of the argument of the series, scaled time
    inverse_rate: Scalars
    half_turn_rate: Scalars  # half turns of that argument per unit of time
    half_log_nome: Scalars  # half of the hyperbolic argument per half turn
    sense: Scalars
    parity: Scalars
    rate_unit: Scalars
    moment_unit: Scalars
    axis_2: Scalars
    axis_3: Scalars
    one: Scalars
    half_turn_rate_low: Scalars | None = None  # rounding error of the rate, if compensated


class Precession(NamedTuple):
    """Constants of the angle about the momentum, and of the attitude."""

    half_turn_rate: Scalars  # mean rate of half of the angle, in half turns per unit of time
    beta: Scalars  # 2 sigma beta / pi of (11)
    theta_real: tuple[Scalars, ...]  # the theta series of half of the angle, by powers
    theta_imaginary: tuple[Scalars, ...]
    length: Scalars  # |L|
    L3_max: Scalars  # largest L3
    addition_coefficient: Scalars  # sigma p a^2 / (|L| (|L| + c) c) of (12)
    start: tuple[Scalars, Scalars, Scalars, Scalars]  # initial attitude without its tilt
    half_turn_rate_low: Scalars | None = None


class FreeConstants(NamedTuple):
    """Per-body constants of the exact free motion; every field has the shape of the batch.

    ``moments``, ``products``, ``omega`` and ``wxyz`` are the input, and the only fields that are
    differentiated; ``polhode`` and ``precession`` are computed from them.
    """

    moments: Triple
    products: Triple
    omega: Triple
    wxyz: tuple[Scalars, ...] | None
    polhode: Polhode
    precession: Precession | None


def _limits(dtype) -> tuple[float, float]:
    """Smallest complementary parameter and ratio of differences that count as non-zero."""
    bits = {4: 110, 8: 900}[jnp.dtype(dtype).itemsize]
    return 2.0**-bits, 2.0 ** -(bits // 2)


def polhode_constants(roles: Roles) -> Polhode:
    """(1), (3), (5): parameter, periods and amplitudes of the momentum in the body."""
    i1, i2, i3 = roles.moments
    one = roles.one
    w1, w2, w3 = roles.rates
    floor, _ = _limits(i1.dtype)
    d1, d2, d3 = 1 / i1, 1 / i2, 1 / i3
    l1, l2, l3 = i1 * w1, i2 * w2, i3 * w3
    d12, d23, d13 = jnp.abs(i2 - i1), jnp.abs(i3 - i2), jnp.abs(i3 - i1)
    p, r, s = d12 * d1 * d2, d23 * d2 * d3, d13 * d1 * d3
    A = (l1 * w1 * d13 + l2 * w2 * d23) * d3
    B = (l2 * w2 * d12 + l3 * w3 * d13) * d1
    A, B = staged((A, B), one)
    x = B * r
    is_nonzero = x > 0
    divisor = jnp.where(is_nonzero, x, 1)
    m = jnp.where(is_nonzero, A * p / divisor, 0)
    m1 = jnp.where(is_nonzero, s * roles.gap * d2 / divisor, 1)
    circular = m1 > 1 - _CIRCULAR_BELOW
    on_separatrix = is_nonzero & (m1 < floor)
    permanent = (jnp.abs(l1) + jnp.minimum(jnp.abs(l2), jnp.abs(l3))) == 0
    agm, nome, log_nome, rate = agm_and_nome(circular, on_separatrix, x, m, m1, one)
    half_turn_rate = rate / jnp.where(circular, math.pi, log_nome) * roles.rate_unit
    inverse_rate = jnp.where(is_nonzero, 1 / jnp.where(is_nonzero, rate, 1), 0)
    half_turn_rate = staged(half_turn_rate, one)
    return Polhode(
        momentum=(l1, l2, l3),
        inverse_moments=(d1, d2, d3),
        moments=roles.moments,
        p=p,
        r=r,
        s=s,
        A=A,
        B=B,
        m=m,
        m1=m1,
        circular=circular,
        on_separatrix=on_separatrix,
        permanent=permanent,
        nome=jnp.where(on_separatrix, 0, nome),
        agm=agm,
        log_nome=log_nome,
        rate=rate,
        inverse_rate=inverse_rate,
        half_turn_rate=half_turn_rate,
        half_log_nome=log_nome / 2,
        sense=roles.sense,
        parity=roles.parity,
        rate_unit=roles.rate_unit,
        moment_unit=roles.moment_unit,
        axis_2=roles.axis_2,
        axis_3=roles.axis_3,
        one=one,
    )


def descend(polhode: Polhode, length: Scalars) -> Scalars:
    """(9): sinh of the imaginary shift b (circular) or tan of twice the angle beta (hyperbolic).

    Gauss's transformation, every step a sum of positive terms.
    """
    other = jnp.sqrt(jnp.where(polhode.circular, polhode.m1, polhode.m))
    _, smallest_ratio = _limits(other.dtype)
    aspherical = polhode.r > 0
    p = jnp.maximum(polhode.p, polhode.r * smallest_ratio)
    start = jnp.where(aspherical, jnp.sqrt(polhode.r / jnp.where(aspherical, p, 1)), 0)
    has_B = polhode.B > 0
    ratio = jnp.where(polhode.circular, polhode.s, polhode.p) / jnp.where(has_B, polhode.B, 1)
    d = jnp.where(has_B, length * jnp.sqrt(ratio), 1)
    a, b = jnp.ones_like(other), other
    numerator, denominator = start, jnp.ones_like(other)
    for _ in range(AGM_STEPS):
        mean = (a + b) / 2
        next_d = jnp.sqrt(a * mean * ((b + d) / (a + d)))
        numerator = numerator * jnp.where(polhode.circular, 2 * mean, next_d)
        denominator = denominator * jnp.where(polhode.circular, a + d, a)
        a, b, d = mean, jnp.sqrt(a * b), next_d
    return numerator / denominator


def _circular_series(polhode: Polhode, shift: Scalars):
    """(10): theta_4(v + i b | q^2) in powers of sin(v)^2, and the derivative of its phase at
    v = 0."""
    q = polhode.nome * polhode.nome
    q2 = q * q
    even = q * (1 + 2 * shift * shift)  # q cosh 2b
    odd = 2 * (q * shift) * jnp.sqrt(1 + shift * shift)  # q sinh 2b
    even, odd = staged((even, odd), polhode.one)
    c2, s2 = q2 * (2 * even * even - q2), 2 * q2 * even * odd
    c3 = q2 * q2 * q2 * even * (4 * even * even - 3 * q2)
    s3 = q2 * q2 * q2 * odd * (4 * odd * odd + 3 * q2)
    theta_real = (
        1 - 2 * even + 2 * c2 - 2 * c3,
        4 * even - 16 * c2 + 36 * c3,
        16 * c2 - 96 * c3,
        64 * c3,
        jnp.zeros_like(q),
    )
    theta_imaginary = (
        2 * odd - 4 * s2 + 6 * s3,
        8 * s2 - 32 * s3,
        32 * s3,
        jnp.zeros_like(q),
        jnp.zeros_like(q),
    )
    return theta_real, theta_imaginary, 2 * theta_imaginary[0] / theta_real[0]


def _hyperbolic_series(polhode: Polhode, tangent: Scalars):
    """(11): theta_2(beta - i w/2 | sqrt q') in powers of sinh(w/2)^2, derivative, beta."""
    half = jnp.sqrt(polhode.nome)
    double_cosine = 1 / jnp.sqrt(1 + tangent * tangent)
    double_sine = tangent * double_cosine
    cosine = jnp.sqrt((1 + double_cosine) / 2)
    sine = double_sine / (2 * cosine)
    double_sine = 2 * sine * cosine
    angle = arctangent(double_sine / (1 + double_cosine))
    cosines, sines = (
        [cosine, cosine * (2 * double_cosine - 1)],
        [
            sine,
            sine * (2 * double_cosine + 1),
        ],
    )
    for _ in range(3):
        cosines.append(2 * double_cosine * cosines[-1] - cosines[-2])
        sines.append(2 * double_cosine * sines[-1] - sines[-2])
    h2 = half * half
    h6 = h2 * h2 * h2
    weights = (jnp.ones_like(half), h2, h6, h6 * h6, h6 * h6 * h6 * h2)
    c = [x * y for x, y in zip(weights, cosines, strict=True)]
    s = [x * y for x, y in zip(weights, sines, strict=True)]
    theta_real = (
        c[0] + c[1] + c[2] + c[3] + c[4],
        4 * c[1] + 12 * c[2] + 24 * c[3] + 40 * c[4],
        16 * c[2] + 80 * c[3] + 240 * c[4],
        64 * c[3] + 448 * c[4],
        256 * c[4],
    )
    theta_imaginary = (
        s[0] + 3 * s[1] + 5 * s[2] + 7 * s[3] + 9 * s[4],
        4 * s[1] + 20 * s[2] + 56 * s[3] + 120 * s[4],
        16 * s[2] + 112 * s[3] + 432 * s[4],
        64 * s[3] + 576 * s[4],
        256 * s[4],
    )
    return theta_real, theta_imaginary, theta_imaginary[0] / (2 * theta_real[0]), angle


def precession_constants(polhode: Polhode, wxyz: tuple[Scalars, ...]) -> Precession:
    """(10)-(12): mean rate of the angle about L, its theta series, and the initial attitude without
    its tilt."""
    l1, l2, l3 = polhode.momentum
    d1, _, d3 = polhode.inverse_moments
    length = jnp.sqrt(l1 * l1 + l2 * l2 + l3 * l3)
    aspherical = polhode.s > 0
    divisor = jnp.where(aspherical, polhode.s, 1)
    L3_max = jnp.where(aspherical, jnp.sqrt(polhode.B / divisor), jnp.abs(l3))
    L1_max_squared = jnp.where(aspherical, polhode.A / divisor, l1 * l1 + l2 * l2)  # largest L1^2
    shift = descend(polhode, length)
    circular = polhode.circular
    real_c, imaginary_c, slope_circular = _circular_series(polhode, shift)
    real_h, imaginary_h, slope_hyperbolic, shift_angle = _hyperbolic_series(polhode, shift)
    theta_real = tuple(jnp.where(circular, x, y) for x, y in zip(real_c, real_h, strict=True))
    theta_imaginary = tuple(
        polhode.sense * jnp.where(circular, x, y)
        for x, y in zip(imaginary_c, imaginary_h, strict=True)
    )
    theta_real, theta_imaginary = staged((theta_real, theta_imaginary), polhode.one)
    # (8) at the start of the reference motion, where the momentum is (sqrt(A/s), 0, L3_max).
    start_rate = (d3 * L3_max + d1 * L1_max_squared / (length + L3_max)) / 2
    slope = jnp.where(circular, slope_circular, slope_hyperbolic)
    no_shift = circular | polhode.on_separatrix
    beta = jnp.where(no_shift, 0, polhode.sense * 2 * shift_angle)
    beta, slope = staged((beta, slope), polhode.one)
    half_rate = start_rate + polhode.rate * (polhode.sense * slope - beta / polhode.log_nome)
    # The minimal rotation that carries L to axis 3 is (|L| + |L3|, L x n3); ``start`` is without
    # it.
    side = polhode.parity * jnp.copysign(1, l3)
    tilt = restore((side * l2, -side * l1, jnp.zeros_like(l3)), polhode.axis_2, polhode.axis_3)
    w = length + jnp.abs(l3)
    q0, q1, q2, q3 = wxyz
    t1, t2, t3 = tilt
    scale = 1 / jnp.sqrt((q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3) * (w * w + l1 * l1 + l2 * l2))
    tilt, w, scale = staged(((t1, t2, t3), w, scale), polhode.one)
    t1, t2, t3 = tilt
    start = (
        (q0 * w + q1 * t1 + q2 * t2 + q3 * t3) * scale,
        (q1 * w - q0 * t1 - q2 * t3 + q3 * t2) * scale,
        (q2 * w - q0 * t2 - q3 * t1 + q1 * t3) * scale,
        (q3 * w - q0 * t3 - q1 * t2 + q2 * t1) * scale,
    )
    addition_coefficient = (
        polhode.sense
        * polhode.p
        * (L1_max_squared / (length * (length + L3_max)))
        / jnp.where(L3_max > 0, L3_max, 1)
    )
    return Precession(
        half_rate * polhode.rate_unit / math.pi,
        beta / math.pi,
        theta_real,
        theta_imaginary,
        length,
        L3_max,
        addition_coefficient,
        start,
    )


def motion_constants(
    moments: Triple, omega: Triple, wxyz: tuple[Scalars, ...] | None
) -> tuple[Polhode, Precession | None]:
    """All constants; without ``wxyz`` only those of the momentum."""
    polhode = polhode_constants(assign_roles(moments, omega))
    return polhode, None if wxyz is None else precession_constants(polhode, wxyz)


# Sufficient for 1 - m down to 1e-20 and for moments that differ by a millionth.
_AGM_STEPS = 8
_INVERSE_PI = 0.3183098861837907, -1.9678676675182486e-17


def _where(condition, x: Pair, y: Pair) -> Pair:
    return Pair(*(jnp.where(condition, a, b) for a, b in zip(x, y, strict=True)))


def _absolute(x: Pair) -> Pair:
    sign = jnp.where(x.high < 0, -1, 1).astype(x.high.dtype)
    return Pair(sign * x.high, sign * x.low)


def _halved(x: Pair) -> Pair:
    return Pair(x.high / 2, x.low / 2)


def _means(complement: Pair, pole: Pair) -> tuple[Pair, Pair, Scalars]:
    """agm(1, complement), the sum of the Q of DLMF 19.8.6, and the size of the last step; ``pole``:
    the square root of 1 - n."""
    one = Pair(jnp.ones_like(pole.high), jnp.zeros_like(pole.high))

    def step(_, state):
        a, b, p, weight, pi_sum = state
        product, square = multiply_pairs(a, b), multiply_pairs(p, p)
        total = add_pairs(square, product)
        weight = _halved(
            multiply_pairs(weight, divide_pairs(subtract_pairs(square, product), total))
        )
        p = _halved(divide_pairs(total, p))
        return _halved(add_pairs(a, b)), root_of(product), p, weight, add_pairs(pi_sum, weight)

    # As a loop it compiles in a tenth of the time of an unrolled formula.
    a, b, _, weight, pi_sum = jax.lax.fori_loop(
        0, _AGM_STEPS, step, (one, complement, pole, one, one)
    )
    return a, pi_sum, jnp.abs(weight.high) + jnp.abs(subtract_pairs(a, b).high)


def compensated_rates(roles: Roles) -> tuple[Pair, Pair, Scalars]:
    """Half-turn rates of ``Polhode`` and ``Precession`` per scaled time, and size of the last step.

    Pi is computed for the characteristic -p/r or that of DLMF 19.7.9, whichever is closer to zero.
    With the latter the angle includes the rotations of the momentum in the body.
    """
    i1, i2, i3 = roles.moments
    d12, d23, d13 = (_absolute(sum_of(a, -b)) for a, b in ((i2, i1), (i3, i2), (i3, i1)))
    x1, x2, x3 = (
        scale_pair(product_of(w, w), i) for w, i in zip(roles.rates, roles.moments, strict=True)
    )
    A = add_pairs(multiply_pairs(x2, d12), multiply_pairs(x3, d13))
    B = add_pairs(multiply_pairs(x1, d13), multiply_pairs(x2, d23))
    gap = _absolute(subtract_pairs(multiply_pairs(x3, d23), multiply_pairs(x1, d12)))
    square = multiply_pairs(A, d23)
    length2 = add_pairs(add_pairs(scale_pair(x1, i1), scale_pair(x2, i2)), scale_pair(x3, i3))
    length = root_of(length2)
    complement = root_of(divide_pairs(multiply_pairs(d13, gap), square))
    n_small = divide_pairs(scale_pair(d13, i2), scale_pair(d23, i1))
    n_large = divide_pairs(multiply_pairs(length2, d13), scale_pair(A, i3))
    near_zero = n_small.high < n_large.high
    pole = root_of(_where(near_zero, n_small, n_large))
    mean, pi_sum, last_step = _means(complement, pole)
    inverse_pi = Pair(*(jnp.full_like(i1, x) for x in _INVERSE_PI))
    volume = scale_pair(product_of(i1, i2), i3)
    half_turn_rate = multiply_pairs(
        multiply_pairs(root_of(divide_pairs(square, volume)), mean), inverse_pi
    )
    # |L|/I1 (1 -+ (I2 - I1) total / (2 I2)) minus one rotation per period, or
    # |L|/I3 +- A total / (2 |L|).
    parts = _where(near_zero, multiply_pairs(length, d12), divide_pairs(B, length))
    pi_part = multiply_pairs(_halved(parts), pi_sum)
    span = scale_pair(
        _where(near_zero, product_of(i1, i2), Pair(i3, jnp.zeros_like(i3))), roles.sense
    )
    pi_part = divide_pairs(pi_part, span)
    plain_rate = divide_pairs(length, Pair(jnp.where(near_zero, i1, i3), jnp.zeros_like(i1)))
    pi_part = Pair(
        jnp.where(near_zero, -pi_part.high, pi_part.high),
        jnp.where(near_zero, -pi_part.low, pi_part.low),
    )
    angle = _halved(multiply_pairs(add_pairs(plain_rate, pi_part), inverse_pi))
    own_turn = scale_pair(_halved(half_turn_rate), jnp.where(near_zero, -roles.sense, 0))
    return half_turn_rate, add_pairs(angle, own_turn), last_step


def compensated_constants(
    moments: Triple, omega: Triple, wxyz: tuple[Scalars, ...] | None
) -> tuple[Polhode, Precession | None]:
    """All constants, with the rounding errors of both rates."""
    if omega[0].dtype == jnp.float32:
        return in_double(_rounded_constants, moments, omega, wxyz)
    roles = assign_roles(moments, omega)
    polhode = polhode_constants(roles)
    # Staged, because both parts of a pair must be results of the same evaluation.
    half_turn_rate, angle, last_step = staged(compensated_rates(roles), roles.one)
    # Convergence is quadratic: the remaining error is the square of the last step.
    converged = (last_step < jnp.finfo(last_step.dtype).eps / 64) & ~polhode.on_separatrix
    precession = None if wxyz is None else precession_constants(polhode, wxyz)
    polhode = _with_rate(polhode, half_turn_rate, converged, roles.rate_unit)
    if precession is not None:
        precession = _with_rate(precession, angle, converged, roles.rate_unit)
    return polhode, precession


_Motion = TypeVar("_Motion", Polhode, Precession)


def _with_rate(
    motion: _Motion, compensated: Pair, converged: Bool[Array, "*b"], rate_unit: Scalars
) -> _Motion:
    """With the pair instead of the plain rate, unless it has not converged or disagrees with it."""
    rate, high, low = motion.half_turn_rate, *(x * rate_unit for x in compensated)
    converged = converged & (jnp.abs(high - rate) <= 2.0**-30 * jnp.abs(rate))
    return motion._replace(
        half_turn_rate=jnp.where(converged, high, rate),
        half_turn_rate_low=jnp.where(converged, low, 0),
    )


def _rounded_constants(moments, omega, wxyz) -> tuple[Polhode, Precession | None]:
    """Constants computed in double precision, rounded to single precision.

    Sums of two single-precision floats take 2.4 times as long to compile, and their error is 1.2
    times as large (docs/design_notes.md).
    """
    polhode, precession = motion_constants(moments, omega, wxyz)

    def rounded(motion):
        rate = motion.half_turn_rate
        # Not by conversion to float32 and back: on a GPU XLA removes both, and low becomes zero.
        low = rate - jax.lax.reduce_precision(rate, exponent_bits=8, mantissa_bits=23)
        return _cast(motion._replace(half_turn_rate_low=low), jnp.float32)

    return rounded(polhode), None if precession is None else rounded(precession)


def _cast(tree: Any, dtype) -> Any:
    """The tree with its floats in another precision."""
    return jax.tree.map(
        lambda x: (
            jax.lax.convert_element_type(x, dtype) if jnp.issubdtype(x.dtype, jnp.inexact) else x
        ),
        tree,
    )
