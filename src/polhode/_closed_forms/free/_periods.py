"""Rotation periods of a tumbling free body, in the convention of the long axis."""

import enum
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from polhode._closed_forms.free._carry import turn_of_axes
from polhode._closed_forms.free._evaluate import components
from polhode._closed_forms.free._frame import Frame, dot, matrix
from polhode._closed_forms.free._motion import Swing, descend, prepare_swing, prepare_turning
from polhode._closed_forms.free._roles import assign_roles
from polhode._closed_forms.free._rule import change_of_start, zero_where_symbolic
from polhode._closed_forms.free._second import complete
from polhode._closed_forms.free._tangent import change_of_invariants
from polhode._kernels import are_close, underivable

Scalars = Float[Array, "*b"]


class Mode(enum.IntEnum):
    """How a free body tumbles; ``Periods.mode`` holds these numbers."""

    LAM = 0  # long-axis mode: L circles the axis of the least moment
    SAM = 1  # short-axis mode: L circles the axis of the greatest moment
    SEPARATRIX = 2
    PROLATE = 3  # two equal greater moments; the numbers are those of LAM
    OBLATE = 4  # two equal lesser moments; the numbers are those of SAM
    SPHERICAL = 5
    AT_REST = 6


class Periods(NamedTuple):
    """Periods and nutation limits; every field has the shape of the batch."""

    P_psi: Scalars
    """Of the rotation about the long axis (LAM) or the oscillation about it (SAM)."""
    P_phi: Scalars
    """Mean, of the precession of the long axis about the angular momentum."""
    mode: Int[Array, "*b"]
    k2: Scalars
    """Elliptic parameter, 0 for a symmetric body and 1 on the separatrix."""
    theta_min: Scalars
    """Least angle between long axis and momentum [rad]; in LAM that to the nearer of its ends."""
    theta_max: Scalars


def periods(moments, omega, products=None) -> Periods:
    """Periods of bodies of principal ``moments`` (..., 3) and body rates ``omega`` (..., 3).

    Infinite where there is no such motion: P_psi on the separatrix, for a sphere and for a
    symmetric body that spins across its axis, both for a body at rest (nutation limits: 0, pi).
    ``products`` as in `prepare`. Formulas: Landau & Lifshitz, Mechanics, section 37, in the L
    convention of Samarasinha & A'Hearn, Icarus 93 (1991).
    """
    moments, omega = components(moments, 3), components(omega, 3)
    products = None if products is None else components(products, 3)
    values, mode = _periods((moments, products, omega))
    P_psi, P_phi, k2, low, high = values
    return Periods(P_psi, P_phi, mode, k2, low, high)


def _mean_precession(swing: Swing, turning, rest: Scalars) -> Scalars:
    """Mean rate about L of the long axis, scaled time."""
    half_turns = math.pi * swing.pace / rest
    whole = 2 * math.pi * turning.pace / rest
    # The long axis takes one turn less per period than the minimal rotation; for needles that
    # difference cancels, and the theta series of the axis itself is used instead.
    shift = descend(swing, turning.length)
    growth = jnp.where(swing.circular, shift + jnp.sqrt(1 + shift * shift), 1)
    decay = 1 / (growth * growth)
    q = swing.nome
    first, second = (q * growth) ** 2, (q * q * (q * growth * growth)) ** 2
    above = decay - first * (1 + 2 * decay**3) + second * (2 + 3 * decay**5)
    below = (1 - decay) - first * (1 - decay**3) + second * (1 - decay**5)
    level = turning.length * swing.inverse[0]
    series = level + swing.rate * 2 * above / jnp.where(below > 0, below, 1)
    long = jnp.where(swing.circular & (below > 0), series, whole - half_turns)
    return jnp.where(swing.sense < 0, long, whole)


def _limits(A, B, r, s, m1):
    """Amplitudes of L1, L2, L3 and the least L3."""

    def root(value):
        return jnp.where(value > 0, jnp.sqrt(jnp.where(value > 0, value, 1)), 0)

    even = jnp.where(s > 0, s, 1)
    first, third = root(A / even), root(B / even)
    second = root(jnp.where(r > 0, A / jnp.where(r > 0, r, 1), A / even))
    return first, second, third, third * root(m1)


def _angles(sense, A, B, r, s, m1):
    first, second, third, least = _limits(A, B, r, s, m1)
    wide = jnp.arctan2(third, first)
    low = jnp.where(sense < 0, jnp.arctan2(first, third), wide)
    high = jnp.where(sense < 0, jnp.arctan2(second, least), math.pi - wide)
    return low, high


def _work_out(given):
    moments, _, omega = given
    roles = assign_roles(moments, omega)
    swing = prepare_swing(roles)
    one = jnp.ones_like(moments[0])
    turning = prepare_turning(swing, (one, 0 * one, 0 * one, 0 * one))
    resting, round_ = swing.pulse == 0, swing.s == 0
    pulse = jnp.where(resting, 1, swing.pulse)
    saddle = (roles.gap == 0) & (swing.B * swing.r > 0)
    level = jnp.where(saddle, swing.inverse[1], swing.inverse[2]) * turning.length
    steady = saddle | round_ | (swing.pace == 0)
    about = jnp.where(steady, level, _mean_precession(swing, turning, pulse)) * swing.pulse
    turns = jnp.where(saddle, 0, swing.pace)
    P_psi = jnp.where(turns > 0, 2 / jnp.where(turns > 0, turns, 1), jnp.inf)
    P_phi = jnp.where(about > 0, 2 * math.pi / jnp.where(about > 0, about, 1), jnp.inf)
    low, high = _angles(swing.sense, swing.A, swing.B, swing.r, swing.s, swing.m1)
    low, high = jnp.where(resting, 0, low), jnp.where(resting, math.pi, high)
    mode = jnp.where(swing.sense < 0, Mode.LAM, Mode.SAM)
    mode = jnp.where(saddle, Mode.SEPARATRIX, mode)
    i1, i2, i3 = swing.moments
    long_pair = jnp.where(swing.sense < 0, i1 == i2, i2 == i3)
    short_pair = jnp.where(swing.sense < 0, i2 == i3, i1 == i2)
    mode = jnp.where(long_pair, Mode.PROLATE, jnp.where(short_pair, Mode.OBLATE, mode))
    mode = jnp.where(round_, Mode.SPHERICAL, mode)
    mode = jnp.where(resting, Mode.AT_REST, mode).astype(jnp.int32)
    return ((P_psi, P_phi, swing.m, low, high), mode), (swing, turning, steady, about)


@jax.custom_jvp
def _periods(given):
    return _work_out(given)[0]


def _periods_rule(primals, tangents):
    given = primals[0]
    dm, dp, dw = (zero_where_symbolic(d, x) for d, x in zip(tangents[0], given, strict=True))
    # Of symmetric bodies the constants below have no right derivatives.
    a, b, c = given[0]
    symmetric = are_close(a, b) | are_close(b, c) | are_close(c, a)
    given = jax.tree.map(functools.partial(underivable, where=symmetric), given)
    if given[1] is not None:
        moments, products, omega = given
        given = moments, products, omega, None, None
        (*given, _, _), dm, dp, dw, _ = turn_of_axes(given, dm, dp, dw)
    (values, mode), (swing, turning, steady, about) = _work_out(given)
    P_psi, P_phi, k2, _, _ = values
    change = change_of_start(swing, Frame(swing), dm, dp, dw)
    dr, ds, dpp, dA, dB, dz = change_of_invariants(swing, change)
    start = swing.momentum
    spin = tuple(x * y for x, y in zip(start, swing.inverse, strict=True))
    energy = dot(spin, change.momentum) + dot(start, matrix(change, start)) / 2
    cross = 0.0
    if change.crossed is not None:
        l1, l2, l3 = start
        h12, h13, h23 = change.crossed
        cross = 2 * swing.sense * (h12 * l1 * l2 + h13 * l1 * l3 + h23 * l2 * l3)
    dA, dB, dz = dA + cross, dB - cross, dz - swing.s * cross
    x = swing.B * swing.r
    dx, dy = dB * swing.r + swing.B * dr, dA * swing.p + swing.A * dpp
    first, second = complete(swing)
    quarter = P_psi * swing.pulse / 4
    quarter = jnp.where(steady, 1, quarter)
    divisor = jnp.where(x > 0, x, 1)
    # By dx and dz = dx - dy, which alone counts next to the separatrix.
    relative = dx / divisor
    dquarter = (second * (swing.m1 * dx - dz) - quarter * relative) / 2
    period = 4 * quarter
    middle = swing.A * swing.B * 4 * first
    less = start[1] ** 2 * period - middle
    span = jnp.where(swing.s > 0, swing.s, 1)
    squares = (
        start[0] ** 2 * period + swing.r / span * less,
        middle,
        start[2] ** 2 * period + swing.p / span * less,
    )
    length = turning.length
    dangle = period * energy + dot(change.inverse, squares) / 2
    dangle = (dangle + dot(spin, start) * 4 * dquarter) / length
    pulse = jnp.where(swing.pulse > 0, swing.pulse, 1)
    rate = about / pulse  # scaled
    # A steady turn about L: the rate is twice the energy over |L|.
    dlength = dot(start, change.momentum) / length
    drate = jnp.where(
        steady,
        (2 * energy - rate * dlength) / length,
        (dangle - rate * 4 * dquarter) / period,
    )
    moving = about > 0
    dP_psi = jnp.where(steady, 0, 4 * dquarter / pulse)
    dP_phi = jnp.where(moving, -P_phi / jnp.where(moving, rate, 1) * drate, 0)
    dP_phi = jnp.where(moving, dP_phi, 0)
    dm1 = jnp.where(x > 0, (dz - swing.m1 * dx) / divisor, 0)
    dk2 = jnp.where(x > 0, (dy - k2 * dx) / divisor, 0)
    dm1, dk2 = jnp.where(swing.circular, -dk2, dm1), jnp.where(swing.circular, dk2, -dm1)
    angles = jax.jvp(
        lambda *a: _angles(swing.sense, *a),
        (swing.A, swing.B, swing.r, swing.s, swing.m1),
        (dA, dB, dr, ds, dm1),
    )[1]
    resting = swing.pulse == 0
    angles = tuple(jnp.where(resting, 0, a) for a in angles)
    none = jnp.zeros(mode.shape, jax.dtypes.float0)
    return (values, mode), ((dP_psi, dP_phi, dk2, *angles), none)


_periods.defjvp(_periods_rule, symbolic_zeros=True)
