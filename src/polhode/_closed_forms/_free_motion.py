"""The exact free motion at a time, from its constants; (n) are formulas of docs/free_motion.md."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from polhode._closed_forms._arithmetic import (
    cosine_sine,
    horner,
    sign_of_parity,
    sine_half,
    sinh,
    whole_and_fraction,
)
from polhode._closed_forms._free_constants import (
    Polhode,
    Precession,
    Scalars,
    Triple,
    restore,
)
from polhode._hamiltonian import triple
from polhode._kernels import opaque_ones, staged


def _phase(motion: Polhode | Precession, t: Scalars) -> tuple[Scalars, Scalars]:
    half_turns, fraction = whole_and_fraction(motion.half_turn_rate, t)
    return (
        half_turns,
        fraction if motion.half_turn_rate_low is None else fraction + motion.half_turn_rate_low * t,
    )


def half_turns_at(polhode: Polhode, t: Scalars) -> tuple[Scalars, Scalars]:
    """Half turns of the theta functions' argument: a whole number and the remainder."""
    half_turns, fraction = _phase(polhode, t)
    # On the separatrix the argument is limited: beyond, the momentum is along the intermediate axis
    # to rounding, and the exponentials would overflow.
    limit = math.log(2) * {4: 55, 8: 450}[fraction.dtype.itemsize]
    fraction = jnp.where(
        polhode.on_separatrix, jnp.clip(polhode.half_turn_rate * t, -limit, limit), fraction
    )
    half_turns = jnp.where(polhode.on_separatrix, 0, half_turns)
    return half_turns, fraction


def jacobi(polhode: Polhode, fraction: Scalars, stage):
    """(7): sn / omega_p, cn, dn of the time since the last half turn, and the base sine."""
    half = stage(
        jnp.where(polhode.circular, sine_half(fraction), sinh(polhode.half_log_nome * fraction))
    )
    sign = jnp.where(polhode.circular, 1.0, -1.0).astype(half.dtype)
    base = sign * half * half
    cosine = 1 - 2 * base
    other = jnp.sqrt(1 - base)
    sine = 2 * half * other
    z = sign * sine * sine
    h = polhode.nome
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
    cosine_p2 = cosine * p2
    denominator = 1 / jnp.where(polhode.circular, p4, cosine_p2)
    sn = sine * p1 * denominator * polhode.inverse_rate
    cn = jnp.where(polhode.circular, cosine_p2, p4) * denominator
    dn = p3 * denominator
    return half, (sn, cn, dn)


def momentum_of(polhode: Polhode, functions: Triple) -> Triple:
    """(6): L along axes 1, 2, 3 from its initial value, by the addition theorems."""
    S, C, N = functions
    l1, l2, l3 = polhode.momentum
    k = polhode.sense * polhode.parity
    denominator = 1 / (C * C + polhode.r * polhode.s * (l3 * l3) * (S * S))
    return (
        (l1 * C - k * (polhode.r * l2 * l3) * S * N) * denominator,
        (l2 * C * N + k * (polhode.s * l1 * l3) * S) * denominator,
        (l3 * N - k * (polhode.p * l1 * l2) * S * C) * denominator,
    )


def momentum(polhode: Polhode, functions: Triple) -> Triple:
    """The same; the momentum of a permanent rotation about a principal axis is exactly constant."""
    momentum_at_t = momentum_of(polhode, functions)
    return triple(
        jnp.where(polhode.permanent, l, x)
        for l, x in zip(polhode.momentum, momentum_at_t, strict=True)
    )


class Instant(NamedTuple):
    """The motion at one time, along axes 1, 2, 3, in scaled units (see ``Roles``)."""

    half_turns: Scalars  # half turns of the theta functions' argument
    reduced: Triple  # S, C, N since the last half turn
    functions: Triple  # S = sn / omega_p, C = cn, N = dn
    momentum: Triple
    half: tuple[Scalars, Scalars] | None  # cosine and sine of half the angle about L, scaled

    @property
    def precession_half_angle(self) -> tuple[Scalars, Scalars]:
        """``half``; ValueError if ``advance`` had no ``Precession``."""
        if self.half is None:
            raise ValueError("the motion was evaluated for its rates alone: pass a Precession.")
        return self.half


def half_angle(
    polhode: Polhode, precession: Precession, t: Scalars, fraction, half, N, factors: Triple, stage
):
    """(10)-(12): cosine and sine of half of the angle about L, without normalisation."""
    S, l2, l3 = factors
    half_turns, angle = _phase(precession, t)
    angle = angle + precession.beta * fraction
    whole_turns = jnp.round(angle)
    cosine, sine = cosine_sine(angle - whole_turns)
    sign = sign_of_parity(half_turns + whole_turns)
    cosine, sine = stage((sign * cosine, sign * sine))
    square = half * half
    other = jnp.sqrt(1 + jnp.where(polhode.circular, -square, square))
    double = 2 * half * other
    z = jnp.where(polhode.circular, double * double, square)
    theta_real = horner(precession.theta_real, z) * jnp.where(polhode.circular, 1, other)
    theta_imaginary = horner(precession.theta_imaginary, z) * jnp.where(
        polhode.circular, 2 * double * (1 - 2 * square), half
    )
    theta_real, theta_imaginary = stage((theta_real, theta_imaginary))
    mu = precession.L3_max / precession.length
    y, w = jnp.abs(polhode.momentum[2]) / precession.L3_max, jnp.abs(l3) / precession.L3_max
    # (12): the series are those of the motion that starts where L3 is largest.
    a = mu * (1 + N) * (1 + y) * (1 + w) + (1 - mu) * (1 + N + y + w)
    b = precession.addition_coefficient * S * polhode.momentum[1] * l2
    # (cosine + i sine) (real - i imaginary) (a + i b): angles are added as products of complex
    # numbers, without an arctangent and its branch cuts.
    f, g = theta_real * a + theta_imaginary * b, theta_real * b - theta_imaginary * a
    return cosine * f - sine * g, cosine * g + sine * f


def advance(polhode: Polhode, precession: Precession | None, t: Scalars, more_stages: bool = False):
    """The ``Instant`` of time t.

    It is computed in stages (see ``staged``): without them XLA repeats all arithmetic in the loop
    over each component of the result. ``more_stages``: more stages, for results that many loops
    use.
    """
    one = opaque_ones(t * polhode.one)

    def stage(values):
        return staged(values, one)

    extra_stage = stage if more_stages else (lambda x: x)
    half_turns, fraction = extra_stage(half_turns_at(polhode, t))
    half, reduced = jacobi(polhode, fraction, stage)
    reduced = extra_stage(reduced)
    sign = sign_of_parity(half_turns)
    S, C, N = stage((sign * reduced[0], sign * reduced[1], reduced[2]))
    l1, l2, l3 = momentum_at_t = stage(momentum(polhode, (S, C, N)))
    if precession is None:
        return Instant(half_turns, reduced, (S, C, N), momentum_at_t, None)
    c, s = half_angle(polhode, precession, t, fraction, half, N, (S, l2, l3), stage)
    height = precession.length + jnp.abs(l3)
    scale = jax.lax.rsqrt((c * c + s * s) * (height * height + l1 * l1 + l2 * l2))
    return Instant(half_turns, reduced, (S, C, N), momentum_at_t, stage((c * scale, s * scale)))


def body_rates(polhode: Polhode, at: Instant) -> Triple:
    """Body rates along x, y, z."""
    spin = tuple(
        polhode.rate_unit * (l * d)
        for l, d in zip(at.momentum, polhode.inverse_moments, strict=True)
    )
    return restore(spin, polhode.axis_2, polhode.axis_3)


def attitude_at(polhode: Polhode, precession: Precession, at: Instant) -> tuple[Scalars, ...]:
    """Attitude: the initial one without its tilt, the rotation about axis 3, and the minimal
    rotation that carries L to it."""
    l1, l2, l3 = at.momentum
    c, s = at.precession_half_angle
    height = precession.length + jnp.abs(l3)
    facing = jnp.copysign(1, polhode.momentum[2])
    side = polhode.parity * facing
    v0 = c * height
    v1, v2, v3 = restore(
        (s * l1 + side * c * l2, s * l2 - side * c * l1, facing * s * height),
        polhode.axis_2,
        polhode.axis_3,
    )
    q0, q1, q2, q3 = precession.start
    return (
        q0 * v0 - q1 * v1 - q2 * v2 - q3 * v3,
        q0 * v1 + q1 * v0 + q2 * v3 - q3 * v2,
        q0 * v2 + q2 * v0 + q3 * v1 - q1 * v3,
        q0 * v3 + q3 * v0 + q1 * v2 - q2 * v1,
    )
