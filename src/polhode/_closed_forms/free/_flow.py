"""The exact free motion at given times; (n) are the formulas of docs/free_motion.md."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms.free._exact import turns
from polhode._closed_forms.free._motion import Swing, Turning
from polhode._closed_forms.free._phase import cosine_sine, horner, parity, sine_half, sinh
from polhode._closed_forms.free._roles import Triple, restore
from polhode._hamiltonian import triple
from polhode._kernels import staged

Scalars = Float[Array, "*b"]


def _phase(motion: Swing | Turning, t: Scalars) -> tuple[Scalars, Scalars]:
    whole, rest = turns(motion.pace, t)
    return whole, rest if motion.pace_low is None else rest + motion.pace_low * t


def sweep(swing: Swing, t: Scalars) -> tuple[Scalars, Scalars]:
    """Half turns of the theta functions' argument: a whole number and the remainder."""
    whole, rest = _phase(swing, t)
    # Farther out the momentum has reached the middle axis and nothing but overflow would follow.
    far = math.log(2) * {4: 55, 8: 450}[rest.dtype.itemsize]
    rest = jnp.where(swing.endless, jnp.clip(swing.pace * t, -far, far), rest)
    whole = jnp.where(swing.endless, 0, whole)
    return whole, rest


def jacobi(swing: Swing, rest: Scalars, stage):
    """(7): sn / omega_p, cn, dn of the time since the last half turn, and the base sine."""
    half = stage(jnp.where(swing.circular, sine_half(rest), sinh(swing.span * rest)))
    sign = jnp.where(swing.circular, 1.0, -1.0).astype(half.dtype)
    base = sign * half * half
    cosine = 1 - 2 * base
    other = jnp.sqrt(1 - base)
    sine = 2 * half * other
    z = sign * sine * sine
    h = swing.nome
    h2 = h * h
    h4 = h2 * h2
    h6, h8 = h4 * h2, h4 * h4
    h9, h12 = h8 * h, h6 * h6
    n1 = 1 - 3 * h2 + 5 * h6 - 7 * h12
    n2 = 1 + h2 + h6 + h12
    n3 = 1 + 2 * h + 2 * h4 + 2 * h9
    n4 = 1 - 2 * h + 2 * h4 - 2 * h9
    p1 = horner((n1, 4 * h2 - 20 * h6 + 56 * h12, 16 * h6 - 112 * h12, 64 * h12), z) / n1
    p2 = horner((n2, -4 * h2 - 12 * h6 - 24 * h12, 16 * h6 + 80 * h12, -64 * h12), z) / n2
    p3 = horner((n3, -4 * h - 16 * h4 - 36 * h9, 16 * h4 + 96 * h9, -64 * h9), z) / n3
    p4 = horner((n4, 4 * h - 16 * h4 + 36 * h9, 16 * h4 - 96 * h9, 64 * h9), z) / n4
    turned = cosine * p2
    below = 1 / jnp.where(swing.circular, p4, turned)
    sn = sine * p1 * below * swing.inverse_rate
    cn = jnp.where(swing.circular, turned, p4) * below
    dn = p3 * below
    return half, (sn, cn, dn)


def momentum_of(swing: Swing, functions: Triple) -> Triple:
    """(6): L along axes 1, 2, 3 from its initial value, by the addition theorems."""
    S, C, N = functions
    l1, l2, l3 = swing.momentum
    k = swing.sense * swing.parity
    below = 1 / (C * C + swing.r * swing.s * (l3 * l3) * (S * S))
    return (
        (l1 * C - k * (swing.r * l2 * l3) * S * N) * below,
        (l2 * C * N + k * (swing.s * l1 * l3) * S) * below,
        (l3 * N - k * (swing.p * l1 * l2) * S * C) * below,
    )


def momentum(swing: Swing, functions: Triple) -> Triple:
    """The same; exact spin about a principal axis keeps its rates to the last bit."""
    now = momentum_of(swing, functions)
    return triple(jnp.where(swing.steady, l, x) for l, x in zip(swing.momentum, now, strict=True))


class Instant(NamedTuple):
    """The motion at one time, axes in their roles, scaled units."""

    whole: Scalars  # half turns of the theta functions' argument
    folded: Triple  # S, C, N less their half turns
    functions: Triple  # S = sn / omega_p, C = cn, N = dn
    momentum: Triple
    half: tuple[Scalars, Scalars] | None  # cosine and sine of half the angle about L, over |M|

    @property
    def turned(self) -> tuple[Scalars, Scalars]:
        """``half``, which is known where ``advance`` was given a ``Turning``."""
        if self.half is None:
            raise ValueError("the motion was worked out for its rates alone: give a Turning.")
        return self.half


def half_angle(swing: Swing, turning: Turning, t: Scalars, rest, half, N, turned: Triple, stage):
    """(10)-(12): cosine and sine of half of the angle about L, over the length of the tilt."""
    S, l2, l3 = turned
    whole, angle = _phase(turning, t)
    angle = angle + turning.sway * rest
    extra = jnp.round(angle)
    cosine, sine = cosine_sine(angle - extra)
    sign = parity(whole + extra)
    cosine, sine = stage((sign * cosine, sign * sine))
    square = half * half
    other = jnp.sqrt(1 + jnp.where(swing.circular, -square, square))
    double = 2 * half * other
    z = jnp.where(swing.circular, double * double, square)
    real = horner(turning.real, z) * jnp.where(swing.circular, 1, other)
    imaginary = horner(turning.imaginary, z) * jnp.where(
        swing.circular, 2 * double * (1 - 2 * square), half
    )
    real, imaginary = stage((real, imaginary))
    mu = turning.peak / turning.length
    y, w = jnp.abs(swing.momentum[2]) / turning.peak, jnp.abs(l3) / turning.peak
    # (12): the series hold for the motion that starts where L3 is largest.
    a = mu * (1 + N) * (1 + y) * (1 + w) + (1 - mu) * (1 + N + y + w)
    b = turning.bend * S * swing.momentum[1] * l2
    # (cosine + i sine) (real - i imaginary) (a + i b)
    f, g = real * a + imaginary * b, real * b - imaginary * a
    return cosine * f - sine * g, cosine * g + sine * f


def advance(swing: Swing, turning: Turning | None, t: Scalars, one: Scalars | None, fine=False):
    """The ``Instant`` of time t; with ``one``, of the shape of t, in stages (see ``staged``).

    ``fine``: in more stages, for results that many kernels need.
    """
    # One kernel per output repeats the arithmetic of all stages, which costs less than to write
    # and read them when every lane has many times, and more when it has one.
    stage = (lambda x: x) if one is None else (lambda x: staged(x, one))
    more = stage if fine else (lambda x: x)
    whole, rest = more(sweep(swing, t))
    half, folded = jacobi(swing, rest, stage)
    folded = more(folded)
    sign = parity(whole)
    S, C, N = stage((sign * folded[0], sign * folded[1], folded[2]))
    l1, l2, l3 = now = stage(momentum(swing, (S, C, N)))
    if turning is None:
        return Instant(whole, folded, (S, C, N), now, None)
    c, s = half_angle(swing, turning, t, rest, half, N, (S, l2, l3), stage)
    height = turning.length + jnp.abs(l3)
    scale = jax.lax.rsqrt((c * c + s * s) * (height * height + l1 * l1 + l2 * l2))
    return Instant(whole, folded, (S, C, N), now, stage((c * scale, s * scale)))


def rates(swing: Swing, at: Instant) -> Triple:
    """Body rates along x, y, z."""
    spin = tuple(swing.pulse * (l * d) for l, d in zip(at.momentum, swing.inverse, strict=True))
    return restore(spin, swing.middle, swing.circled)


def attitude(swing: Swing, turning: Turning, at: Instant) -> tuple[Scalars, ...]:
    """Attitude: the start, the turn about axis 3, and the minimal rotation carrying L to it."""
    l1, l2, l3 = at.momentum
    c, s = at.turned
    height = turning.length + jnp.abs(l3)
    facing = jnp.copysign(1, swing.momentum[2])
    side = swing.parity * facing
    v0 = c * height
    v1, v2, v3 = restore(
        (s * l1 + side * c * l2, s * l2 - side * c * l1, facing * s * height),
        swing.middle,
        swing.circled,
    )
    q0, q1, q2, q3 = turning.start
    return (
        q0 * v0 - q1 * v1 - q2 * v2 - q3 * v3,
        q0 * v1 + q1 * v0 + q2 * v3 - q3 * v2,
        q0 * v2 + q2 * v0 + q3 * v1 - q1 * v3,
        q0 * v3 + q3 * v0 + q1 * v2 - q2 * v1,
    )
