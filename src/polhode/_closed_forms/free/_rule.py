"""The derivative of the exact free motion, which can itself be differentiated."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from polhode._closed_forms.free._carry import (
    difference,
    from_rest,
    functions_of,
    momentum_at,
    start_of,
    turn_of_axes,
)
from polhode._closed_forms.free._flow import Instant
from polhode._closed_forms.free._frame import Frame, Quadruple, cross, dot, hamilton, matrix
from polhode._closed_forms.free._motion import Swing, Turning
from polhode._closed_forms.free._roles import Triple
from polhode._closed_forms.free._second import second_kind
from polhode._closed_forms.free._tangent import (
    Change,
    Setting,
    momentum_tangent,
    partials,
    products_of_momenta,
    squares_of_momenta,
)
from polhode._hamiltonian import triple
from polhode._kernels import opaque_ones, staged

Scalars = Float[Array, "*b"]


class Found(NamedTuple):
    """The motion at time t and the constants it came from: values without derivatives."""

    swing: Swing
    turning: Turning | None
    at: Instant
    results: tuple[Triple | None, Quadruple | None]


def zero_where_symbolic(tangents, primals):
    """None where every tangent is zero, arrays otherwise."""
    if tangents is None or all(isinstance(x, SymbolicZero) for x in jax.tree.leaves(tangents)):
        return None
    return jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if isinstance(d, SymbolicZero) else d, tangents, primals
    )


def change_of_start(swing: Swing, frame: Frame, dm, dp, dw) -> Change:
    """Variation of the initial momentum and of the inverse tensor, in roles and scaled units."""
    zero = (jnp.zeros_like(swing.heft),) * 3
    inverse_pulse = 1 / jnp.where(swing.pulse > 0, swing.pulse, 1)
    di = tuple(x / swing.heft for x in frame.to_roles(dm)) if dm is not None else zero
    dv = tuple(x * inverse_pulse for x in frame.to_roles(dw)) if dw is not None else zero
    d1, d2, d3 = d = swing.inverse
    w1, w2, w3 = w = tuple(x * y for x, y in zip(swing.momentum, d, strict=True))
    gain = tuple(i * v + e * u for i, v, e, u in zip(swing.moments, dv, di, w, strict=True))
    inverse = tuple(-k * k * e for k, e in zip(d, di, strict=True))
    if dp is None:
        return Change(gain, inverse, None)
    p12, p13, p23 = (x / swing.heft for x in frame.to_pairs(dp))
    gain = (
        gain[0] + p12 * w2 + p13 * w3,
        gain[1] + p12 * w1 + p23 * w3,
        gain[2] + p13 * w1 + p23 * w2,
    )
    return Change(gain, inverse, (-d1 * d2 * p12, -d1 * d3 * p13, -d2 * d3 * p23))


def _relative_turn(swing: Swing, turning: Turning, frame: Frame, at: Instant, step: Triple):
    """Quaternion from the attitude at t to that at the start, its vector part exact when small."""
    l1, l2, l3 = frame.turned(swing.momentum)
    s1, s2, s3 = frame.turned(step)
    c, s = at.turned
    height = turning.length + l3
    tilt = jnp.sqrt(height * height + l1 * l1 + l2 * l2)
    c, s = c / tilt, s / tilt
    along = s * (tilt * tilt / turning.length)
    v0 = c * s3
    v = (c * s2 + s * s1, s * s2 - c * s1, s * s3)
    back = cross((l2, -l1, jnp.zeros_like(l1)), v)
    vector = (
        along * l1 + height * v[0] - v0 * l2 - back[0],
        along * l2 + height * v[1] + v0 * l1 - back[1],
        along * l3 + height * v[2] - back[2],
    )
    scalar = c * tilt * tilt + height * v0 + l2 * v[0] - l1 * v[1]
    return scalar, vector


def _turn_tangent(swing, frame: Frame, functions, now, relative, change: Change, moved, first, t):
    """Variation of the attitude: a rotation vector along axes 1, 2, 3 at time t."""
    hand = swing.sense * swing.parity
    setting = Setting(swing.momentum, swing.p, swing.r, swing.s, swing.A, swing.B)
    scalar, vector = relative
    gain = frame.turned(change.momentum)
    once = cross(vector, gain)
    twice = cross(vector, once)
    lag = tuple(
        2 * (b - scalar * a) - m for a, b, m in zip(once, twice, frame.turned(moved), strict=True)
    )
    squares = squares_of_momenta(swing, functions, now, first, t)
    start = swing.momentum
    spin = tuple(x * y for x, y in zip(start, swing.inverse, strict=True))
    energy = dot(spin, change.momentum) + dot(start, matrix(change, start)) / 2
    about = t * energy + dot(change.inverse, squares) / 2
    if change.crossed is not None:
        about = about + dot(change.crossed, products_of_momenta(setting, functions, hand))
    here = frame.turned(now)
    inverse = 1 / dot(start, start)
    turn = tuple((a + about * b) * inverse for a, b in zip(cross(here, lag), here, strict=True))
    return frame.turned(turn)


def _for_tangent(swing: Swing, at: Instant, t: Scalars) -> Instant:
    """S, C, N as the tangent needs them; the momentum itself does not.

    Where omega_p is zero S is the time. On the separatrix derivatives grow without bound: they are
    held where their products would overflow.
    """
    still = swing.inverse_rate == 0
    least = 2.0 ** -{4: 17, 8: 140}[t.dtype.itemsize]

    def mend(functions: Triple) -> Triple:
        S, C, N = functions
        C, N = (jnp.where(swing.endless, jnp.maximum(x, least), x) for x in (C, N))
        return jnp.where(still, t, S), C, N

    return at._replace(folded=mend(at.folded), functions=mend(at.functions))


def _staged(ones, values):
    return staged(values, *ones)


class _Tangent(NamedTuple):
    """Variations at time t along axes 1, 2, 3, scaled: of L, of the attitude, but for the time."""

    swing: Swing
    frame: Frame
    now: Triple
    change: Change
    momentum: Triple
    turn: Triple | None


def _tangent(many: bool, attitude: bool, found: Found, given, dm, dp, dw) -> _Tangent:
    """The formulas of _tangent.py, every value in them with a derivative of its own."""
    moments, _, omega, _, t = given
    scaled = t * found.swing.pulse
    ones = opaque_ones(scaled), found.swing.one
    # The transpose of a stage is a stage: it keeps cotangents from being summed again and again.
    stage = functools.partial(_staged, ones)
    swing = start_of(found.swing, moments, omega)
    frame = Frame(swing)
    change = stage(change_of_start(swing, frame, dm, dp, dw))
    at = _for_tangent(found.swing, found.at, scaled)
    integrals = stage(second_kind(found.swing, at.whole, at.folded, many))
    x, y = swing.B * swing.r, swing.A * swing.p
    *functions, first, second = functions_of(
        many, (*at.functions, *integrals), (swing, at.whole), x, difference(swing, x, y), scaled
    )
    functions = tuple(functions)
    now = momentum_at(swing, functions, at.momentum)
    by = stage(partials(x, y, functions, first, second))
    moved = stage(momentum_tangent(swing, functions, now, by, change, stage))
    total = tuple(g + m for g, m in zip(change.momentum, moved, strict=True))
    turn = None
    if attitude:
        relative = _relative(many, found._replace(results=None), given)
        turn = _turn_tangent(swing, frame, functions, now, relative, change, moved, first, scaled)
    return _Tangent(swing, frame, now, change, total, turn)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _relative(many: bool, found: Found, given):
    """Turn from the start to time t, of which the tangent of the attitude is made, as quaternion.

    Right-handed axes 1, 2, 3; its derivative is the tangent of the attitude itself.
    """
    swing, at = found.swing, found.at
    hand = swing.sense * swing.parity
    setting = Setting(swing.momentum, swing.p, swing.r, swing.s, swing.A, swing.B)
    functions = _for_tangent(swing, at, given[-1] * swing.pulse).functions
    j12, j13, j23 = products_of_momenta(setting, functions, hand)
    step = (-hand * swing.r * j23, hand * swing.s * j13, -hand * swing.p * j12)
    return _relative_turn(swing, found.turning, Frame(swing), at, step)


def _relative_rule(many, primals, tangents):
    found, given = primals
    dm, dp, dw, _, dt = (zero_where_symbolic(d, x) for d, x in zip(tangents[1], given, strict=True))
    scalar, vector = value = _relative(many, found, given)
    tangent = _tangent(many, True, found, given, dm, dp, dw)
    turn = _turn_in_time(tangent, dt)
    half = tuple(x / 2 for x in tangent.frame.turned(turn))
    ahead = tuple(scalar * a + b for a, b in zip(half, cross(vector, half), strict=True))
    return value, (-dot(vector, half), ahead)


_relative.defjvp(_relative_rule, symbolic_zeros=True)


def _turn_in_time(tangent: _Tangent, dt) -> Triple:
    turn, swing = tangent.turn, tangent.swing
    if turn is None:
        raise ValueError("the tangent was worked out for the rates alone: ask for the attitude.")
    if dt is None:
        return turn
    return triple(
        e + n * d * (swing.pulse * dt)
        for e, n, d in zip(turn, tangent.now, swing.inverse, strict=True)
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def answer(asked: tuple[bool, bool, bool], found: Found, given):
    """The results of a motion that has been worked out, with their derivative by ``given``."""
    return found.results


def answer_rule(asked, primals, tangents):
    found, given = primals
    results = answer(asked, found, given)
    return results, tangent_of(asked, found, given, tangents[1], results)


answer.defjvp(answer_rule, symbolic_zeros=True)


def tangent_of(asked, found: Found, given, tangents, results):
    """Variations of rates and attitude."""
    dm, dp, dw, dq, dt = (zero_where_symbolic(d, x) for d, x in zip(tangents, given, strict=True))
    start, back = given[3], tuple
    if given[1] is not None:
        given, dm, dp, dw, back = turn_of_axes(given, dm, dp, dw)
    tangent = _tangent(asked[2], asked[0], found, given, dm, dp, dw)
    swing, frame, (n1, n2, n3) = tangent.swing, tangent.frame, tangent.now
    resting = swing.pulse == 0
    push, drift = from_rest(resting, given, dw, dt)
    d_omega = d_wxyz = None
    if asked[1]:
        total = tangent.momentum
        if dt is not None:
            late = swing.sense * swing.parity * swing.pulse * dt
            total = (
                total[0] - swing.r * n2 * n3 * late,
                total[1] + swing.s * n1 * n3 * late,
                total[2] - swing.p * n1 * n2 * late,
            )
        spun = tuple(
            swing.pulse * (d * x + e)
            for d, x, e in zip(
                swing.inverse, total, matrix(tangent.change, tangent.now), strict=True
            )
        )
        d_omega = back(
            tuple(jnp.where(resting, h, x) for h, x in zip(push, frame.to_body(spun), strict=True))
        )
    if asked[0]:
        turn = _turn_in_time(tangent, dt)
        turn = back(
            tuple(jnp.where(resting, h, e) for h, e in zip(drift, frame.to_body(turn), strict=True))
        )
        d_wxyz = hamilton(results[1], (jnp.zeros_like(n1), *(x / 2 for x in turn)))
        if dq is not None:
            d_wxyz = _start_tangent(start, dq, results[1], d_wxyz)
    return d_omega, d_wxyz


def _start_tangent(start: Quadruple, change: Quadruple, now: Quadruple, other: Quadruple):
    """Adds the answer to the initial attitude, which is normalised before use."""
    inverse = 1 / dot(start, start)
    along = dot(start, change)
    unit = tuple((d - along * inverse * q) * inverse for d, q in zip(change, start, strict=True))
    left = hamilton(unit, (start[0], -start[1], -start[2], -start[3]))
    return tuple(a + b for a, b in zip(other, hamilton(left, now), strict=True))
