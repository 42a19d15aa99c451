"""Constants of the exact free motion; (n) are the formulas of docs/free_motion.md."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from polhode._closed_forms._elliptic import nome_per_parameter
from polhode._closed_forms.free._phase import arc
from polhode._closed_forms.free._roles import Roles, Triple, restore
from polhode._kernels import staged

Scalars = Float[Array, "*b"]

# Beyond this parameter the series in the nome are replaced by those in the complementary nome;
# on either side three terms (five in the half nome of the attitude) reach the last bit of a double.
_TURNING = 0.8
_STEPS = 5


class Swing(NamedTuple):
    """Constants of the momentum's motion in the body (axes in their roles, scaled units)."""

    momentum: Triple
    inverse: Triple  # inverse moments
    moments: Triple
    p: Scalars  # |1/I1 - 1/I2|
    r: Scalars  # |1/I2 - 1/I3|
    s: Scalars  # |1/I1 - 1/I3|
    A: Scalars  # |2E - L^2/I3|
    B: Scalars  # |L^2/I1 - 2E|
    m: Scalars
    m1: Scalars
    circular: Bool[Array, "*b"]  # series in sines (else hyperbolic, near the separatrix)
    endless: Bool[Array, "*b"]  # on the separatrix: infinite period
    steady: Bool[Array, "*b"]  # exact spin about a principal axis
    nome: Scalars
    mean: Scalars  # the arithmetic-geometric mean, for the second kind
    log_nome: Scalars  # minus the logarithm of the nome
    rate: Scalars  # of the argument of the series, scaled time
    inverse_rate: Scalars
    pace: Scalars  # half turns of that argument per unit of time
    span: Scalars  # half of the hyperbolic argument per half turn
    sense: Scalars
    parity: Scalars
    pulse: Scalars
    heft: Scalars
    middle: Scalars
    circled: Scalars
    one: Scalars
    pace_low: Scalars | None = None  # what the pace lacks, when it is compensated


class Turning(NamedTuple):
    """Constants of the angle about the momentum, and of the attitude."""

    pace: Scalars  # mean rate of half of the angle, in half turns per unit of time
    sway: Scalars
    real: tuple[Scalars, ...]  # the theta series of half of the angle, by powers
    imaginary: tuple[Scalars, ...]
    length: Scalars  # |L|
    peak: Scalars  # largest L3
    bend: Scalars
    start: tuple[Scalars, Scalars, Scalars, Scalars]  # initial attitude, less its tilt
    pace_low: Scalars | None = None


class FreeConstants(NamedTuple):
    """Per-body constants of the exact free motion; every field has the shape of the batch.

    ``moments``, ``products``, ``omega`` and ``wxyz`` are the input, through which alone
    derivatives flow; ``swing`` and ``turning`` are worked out from them.
    """

    moments: Triple
    products: Triple
    omega: Triple
    wxyz: tuple[Scalars, ...] | None
    swing: Swing
    turning: Turning | None


def _limits(dtype) -> tuple[float, float]:
    """Smallest complementary parameter and ratio of differences that are told from zero."""
    bits = {4: 110, 8: 900}[jnp.dtype(dtype).itemsize]
    return 2.0**-bits, 2.0 ** -(bits // 2)


def means(circular, endless, x: Scalars, m: Scalars, m1: Scalars, one: Scalars):
    """Arithmetic-geometric mean, nome, minus its logarithm, and the rate of the argument v."""
    square = jnp.where(circular, m, m1)
    other = jnp.sqrt(jnp.where(circular, m1, m))
    omega = jnp.sqrt(x)
    a, b = 1.0, other
    for _ in range(_STEPS - 1):
        a, b = (a + b) / 2, jnp.sqrt(a * b)
    mean = (a + b) / 2
    nome = square * nome_per_parameter(square, jnp.sqrt(other))
    mean, nome = staged((mean, nome), one)
    log_nome = jnp.where(circular | endless, 1, -jnp.log(jnp.where(circular | endless, 0.5, nome)))
    return mean, nome, log_nome, staged(omega * mean, one)


def prepare_swing(roles: Roles) -> Swing:
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
    moving = x > 0
    divisor = jnp.where(moving, x, 1)
    m = jnp.where(moving, A * p / divisor, 0)
    m1 = jnp.where(moving, s * roles.gap * d2 / divisor, 1)
    circular = m1 > 1 - _TURNING
    endless = moving & (m1 < floor)
    steady = (jnp.abs(l1) + jnp.minimum(jnp.abs(l2), jnp.abs(l3))) == 0
    mean, nome, log_nome, rate = means(circular, endless, x, m, m1, one)
    pace = rate / jnp.where(circular, math.pi, log_nome) * roles.pulse
    inverse_rate = jnp.where(moving, 1 / jnp.where(moving, rate, 1), 0)
    pace = staged(pace, one)
    return Swing(
        (l1, l2, l3), (d1, d2, d3), roles.moments, p, r, s, A, B, m, m1, circular, endless, steady,
        jnp.where(endless, 0, nome), mean, log_nome, rate,
        inverse_rate, pace, log_nome / 2,
        roles.sense, roles.parity, roles.pulse, roles.heft, roles.middle, roles.circled, one,
    )  # fmt: skip


def descend(swing: Swing, length: Scalars) -> Scalars:
    """(9): sinh of the imaginary shift b (circular) or tan of twice the angle beta (hyperbolic).

    Gauss's transformation, every step a sum of positive terms.
    """
    other = jnp.sqrt(jnp.where(swing.circular, swing.m1, swing.m))
    _, least = _limits(other.dtype)
    uneven = swing.r > 0
    p = jnp.maximum(swing.p, swing.r * least)
    start = jnp.where(uneven, jnp.sqrt(swing.r / jnp.where(uneven, p, 1)), 0)
    held = swing.B > 0
    ratio = jnp.where(swing.circular, swing.s, swing.p) / jnp.where(held, swing.B, 1)
    d = jnp.where(held, length * jnp.sqrt(ratio), 1)
    a, b = jnp.ones_like(other), other
    above, below = start, jnp.ones_like(other)
    for _ in range(_STEPS):
        mean = (a + b) / 2
        grown = jnp.sqrt(a * mean * ((b + d) / (a + d)))
        above = above * jnp.where(swing.circular, 2 * mean, grown)
        below = below * jnp.where(swing.circular, a + d, a)
        a, b, d = mean, jnp.sqrt(a * b), grown
    return above / below


def _circular_series(swing: Swing, shift: Scalars):
    """(10): theta_4(v + i b | q^2) in powers of sin(v)^2, the slope of its argument at v = 0."""
    q = swing.nome * swing.nome
    q2 = q * q
    even = q * (1 + 2 * shift * shift)  # q cosh 2b
    odd = 2 * (q * shift) * jnp.sqrt(1 + shift * shift)  # q sinh 2b
    even, odd = staged((even, odd), swing.one)
    c2, s2 = q2 * (2 * even * even - q2), 2 * q2 * even * odd
    c3 = q2 * q2 * q2 * even * (4 * even * even - 3 * q2)
    s3 = q2 * q2 * q2 * odd * (4 * odd * odd + 3 * q2)
    real = (
        1 - 2 * even + 2 * c2 - 2 * c3,
        4 * even - 16 * c2 + 36 * c3,
        16 * c2 - 96 * c3,
        64 * c3,
        jnp.zeros_like(q),
    )
    imaginary = (
        2 * odd - 4 * s2 + 6 * s3,
        8 * s2 - 32 * s3,
        32 * s3,
        jnp.zeros_like(q),
        jnp.zeros_like(q),
    )
    return real, imaginary, 2 * imaginary[0] / real[0]


def _hyperbolic_series(swing: Swing, tangent: Scalars):
    """(11): theta_2(beta - i w/2 | sqrt q') in powers of sinh(w/2)^2, its slope, and beta."""
    half = jnp.sqrt(swing.nome)
    double_cosine = 1 / jnp.sqrt(1 + tangent * tangent)
    double_sine = tangent * double_cosine
    cosine = jnp.sqrt((1 + double_cosine) / 2)
    sine = double_sine / (2 * cosine)
    double_sine = 2 * sine * cosine
    angle = arc(double_sine / (1 + double_cosine))
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
    real = (
        c[0] + c[1] + c[2] + c[3] + c[4],
        4 * c[1] + 12 * c[2] + 24 * c[3] + 40 * c[4],
        16 * c[2] + 80 * c[3] + 240 * c[4],
        64 * c[3] + 448 * c[4],
        256 * c[4],
    )
    imaginary = (
        s[0] + 3 * s[1] + 5 * s[2] + 7 * s[3] + 9 * s[4],
        4 * s[1] + 20 * s[2] + 56 * s[3] + 120 * s[4],
        16 * s[2] + 112 * s[3] + 432 * s[4],
        64 * s[3] + 576 * s[4],
        256 * s[4],
    )
    return real, imaginary, imaginary[0] / (2 * real[0]), angle


def prepare_turning(swing: Swing, wxyz: tuple[Scalars, ...]) -> Turning:
    """(10)-(12): mean rate of the angle about L, its theta series, and the untilted start."""
    l1, l2, l3 = swing.momentum
    d1, _, d3 = swing.inverse
    length = jnp.sqrt(l1 * l1 + l2 * l2 + l3 * l3)
    uneven = swing.s > 0
    divisor = jnp.where(uneven, swing.s, 1)
    peak = jnp.where(uneven, jnp.sqrt(swing.B / divisor), jnp.abs(l3))
    across = jnp.where(uneven, swing.A / divisor, l1 * l1 + l2 * l2)  # largest L1^2
    shift = descend(swing, length)
    real_c, imaginary_c, slope_c = _circular_series(swing, shift)
    real_h, imaginary_h, slope_h, beta = _hyperbolic_series(swing, shift)
    pick = swing.circular
    real = tuple(jnp.where(pick, x, y) for x, y in zip(real_c, real_h, strict=True))
    imaginary = tuple(
        swing.sense * jnp.where(pick, x, y) for x, y in zip(imaginary_c, imaginary_h, strict=True)
    )
    real, imaginary = staged((real, imaginary), swing.one)
    # (8) at the start of the reference motion, where the momentum is (sqrt(across), 0, peak).
    begin = (d3 * peak + d1 * across / (length + peak)) / 2
    slope = jnp.where(pick, slope_c, slope_h)
    still = pick | swing.endless
    sway = jnp.where(still, 0, swing.sense * 2 * beta)
    sway, slope = staged((sway, slope), swing.one)
    half_rate = begin + swing.rate * (swing.sense * slope - sway / swing.log_nome)
    # The minimal rotation carrying L to axis 3 is (|L| + |L3|, L x n3); the start undoes it.
    side = swing.parity * jnp.copysign(1, l3)
    tilt = restore((side * l2, -side * l1, jnp.zeros_like(l3)), swing.middle, swing.circled)
    w = length + jnp.abs(l3)
    q0, q1, q2, q3 = wxyz
    t1, t2, t3 = tilt
    scale = 1 / jnp.sqrt((q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3) * (w * w + l1 * l1 + l2 * l2))
    tilt, w, scale = staged(((t1, t2, t3), w, scale), swing.one)
    t1, t2, t3 = tilt
    start = (
        (q0 * w + q1 * t1 + q2 * t2 + q3 * t3) * scale,
        (q1 * w - q0 * t1 - q2 * t3 + q3 * t2) * scale,
        (q2 * w - q0 * t2 - q3 * t1 + q1 * t3) * scale,
        (q3 * w - q0 * t3 - q1 * t2 + q2 * t1) * scale,
    )
    bend = swing.sense * swing.p * (across / (length * (length + peak))) / peak_or_one(peak)
    return Turning(
        half_rate * swing.pulse / math.pi,
        sway / math.pi,
        real,
        imaginary,
        length,
        peak,
        bend,
        start,
    )


def peak_or_one(peak: Scalars) -> Scalars:
    return jnp.where(peak > 0, peak, 1)
