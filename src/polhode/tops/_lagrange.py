"""Lagrange's top in closed form: a symmetric body, its centre on the axis, uniform gravity.

With u the vertical, g = u . e3, N = 2 A M (M the moment of the weight), p and b the momenta about
the vertical and the axis, (A dg/dt)^2 = f(g) = 2 A (E - M g)(1 - g^2) - (p - b g)^2, a cubic. On
its curve the Cayley-Klein parameters alpha = w + iz, beta = y + ix (of the attitude against u) are
an exponential times a quotient of theta functions (Klein & Sommerfeld, Theorie des Kreisels,
VI.5). Here each is written

    alpha(t) = exp(i k t) (c - d F) (h F E/x) (x E'/F) / ((F E) (E'/F)),   F = exp(2 i nu t),

(a) = (a; h) as in ``_pochhammer``, E the place of the initial state on the curve (E' = h/E), x the
place where alpha vanishes. E, E', x, h/x, nu, k are analytic functions of the initial state even
where the nutation vanishes (steady precession, sleeping and hanging tops), and c, d are linear in
alpha and its rate: values and derivatives are regular there and at both poles.

When the two lower roots of f are the close pair, nu is real and E' = conj(E). When the two upper
ones are (near the separatrix), the cubic is turned over: nu is imaginary, E and E' are real, and
time is reduced by whole periods. In both h <= exp(-2 pi).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode.tops._complex import Complex, opaque_one, settle, unit, where
from polhode.tops._cubic import Cubic, cubic, positive, safe
from polhode.tops._pochhammer import (
    Curve,
    curve,
    from_opposite,
    from_pole,
    log_slope,
    point,
    product,
)


class Spinor(NamedTuple):
    """One Cayley-Klein parameter: coefficients c and d, the place x of its zero and h/x, its rate
    k, the angle of x, and whether its modulus grows by F^(-1/2) where F is real."""

    c: Complex
    d: Complex
    place: Complex
    mirror: Complex
    rate: Complex
    turn: Array
    growing: Array


class Orbit(NamedTuple):
    """A motion of Lagrange's top, ready to be evaluated at any time (arrays of lanes).

    ``start``, ``partner``: E and h/E; ``nu`` [rad/s]: its real or imaginary part; ``spinors``:
    alpha and beta, stacked in front.
    """

    curve: Curve
    start: Complex
    partner: Complex
    circular: Array
    nu: Array
    spinors: Spinor

    def along_time(self, axis: int) -> "Orbit":
        """With an axis of length 1 after (-1) or before (-2) the lanes, ready for samples."""
        return jax.tree.map(lambda x: jnp.expand_dims(x, axis), self)


def _only(condition: Array, value: Array, other=0) -> Array:
    return jnp.where(condition, value, other)


def _near_pole(f: Cubic, shift: Array, push: Complex, c: Curve):
    """Place of a value g + shift/2 (see ``from_pole``); ``push``: twice dg/du there over depth."""
    mean = f.reach * (f.total + shift)
    step = push * f.reach
    return from_pole(step + mean, -step + mean, c)


def _near_third(f: Cubic, depth: Array, root: Complex, span: Array, c: Curve):
    """The same for values nearer to the third root; ``root``: square root of the turned depth."""
    scale = 1 / (f.amount * span)
    lift, fall = (f.middle + depth) * scale, root * (jnp.sqrt(f.width) * scale)
    return from_opposite(lift - fall, lift + fall, c)


def _stack(*trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def _choose(condition, a, b):
    return type(a)(*(where(condition, x, y) for x, y in zip(a, b)))


def _places(f: Cubic, c: Curve, one: Array):
    """Places of the state, of g = -1 and of g = 1 (before the turning over), and their partners."""
    circular = f.circular
    zero = jnp.zeros_like(f.across)
    # the state: g' is ``across``; nearer to the third root only where that bounds the motion
    close = (~circular) & (f.depth < f.middle / 2)
    span = jnp.sqrt(safe(close, f.times))
    push = _only(~close, 2 * f.across / jnp.sqrt(safe(~close, positive(f.depth))))
    far = _near_pole(
        f._replace(total=_only(~close, f.total)),
        zero,
        Complex(_only(~circular, push), _only(circular, push)),
        c,
    )
    third = _near_third(f, f.depth * _only(close, 1), Complex(-f.across / span, zero), span, c)
    state = _choose(close, third, far)
    # g = -1, where A g' = i (p + b)
    push = -2 * (f.along + f.momentum * f.above) / jnp.sqrt(positive(f.depth + f.amount * f.above))
    lower = _near_pole(f, 2 * f.above, Complex(_only(circular, push), _only(~circular, -push)), c)
    # g = 1, where A g' = i (p - b)
    depth = f.depth - f.amount * f.below
    upright = f.along - f.momentum * f.below
    close = (depth < f.middle / 2) | ~circular
    span = jnp.sqrt(safe(close, positive(f.below**2 - f.total * f.below + f.times)))
    far = _near_pole(
        f._replace(total=_only(~close, f.total)),
        _only(~close, -2 * f.below),
        Complex(_only(~close, -2 * upright / jnp.sqrt(safe(~close, depth))), zero),
        c,
    )
    root = _only(close, upright) / span
    third = _near_third(
        f, _only(close, depth), Complex(_only(circular, root), _only(~circular, -root)), span, c
    )
    upper = _choose(close, third, far)
    stacked = settle(_stack(state, lower, upper), one)
    return settle(jax.vmap(point, in_axes=(0, None, None))(stacked, c, one), one)


def _settled_start(c: Curve, start: Complex, partner: Complex):
    """E and h/E so that their product is h although it may be rounding (near the separatrix).

    E and E/h are the same place; taken is the one far from 0, unless both are small.
    """
    large, other = start.square > _SMALL**2, partner.square > _SMALL**2
    one = Complex(jnp.ones_like(c.h), jnp.zeros_like(c.h))
    inverse = where(large, start, where(other, partner, one)).inverse
    return (
        where(~large & other, inverse, start),
        where(large, inverse * c.h, where(other, partner * c.h, partner)),
    )


_SMALL = 0.05
"""Above the greatest nome exp(-pi), which |E| is where E and h/E are conjugate."""


def orbit(
    transverse: Array,
    spin: Array,
    pull: Array,
    spinor: tuple[Complex, Complex],
    momentum: tuple[Array, Array, Array],
) -> Orbit:
    """The motion through a state.

    ``transverse``: moment A [kg m^2]; ``spin``: omega_z [rad/s]; ``pull``: M [N m] of either sign
    in V = M u . e3; ``spinor``: alpha = w + iz and beta = y + ix of the attitude against u, of unit
    length; ``momentum``: body components [kg m^2/s], that of wheels on the axis included. All of
    one shape.
    """
    alpha, beta = spinor
    both = alpha * beta
    vertical = (-2 * both.re, 2 * both.im, 2 * alpha.square, 2 * beta.square)
    one = opaque_one(alpha.re)
    f = settle(cubic(2 * transverse * pull, vertical, momentum), one)
    c = settle(curve(f.square), one)
    places, partners = _places(f, c, one)
    start, partner = _settled_start(c, places.at(0), partners.at(0))
    nu = jnp.sqrt(f.width) / (4 * c.stretch)
    zero = jnp.zeros_like(nu)
    nu_complex = Complex(_only(f.circular, nu), _only(~f.circular, nu))
    push = Complex(momentum[1], momentum[0]) * (1 / (2 * f.unit))
    base = log_slope(start, c.weights) - log_slope(partner, c.weights)
    frequency = f.unit / transverse

    origin = product(start, c.weights)[0] * product(partner, c.weights)[0]
    base, origin = settle((base, origin), one)

    def parameter(value, rate, below):
        x, mirror = (where(below, v.at(1), v.at(2)) for v in (places, partners))
        x, mirror = settle((x, mirror), one)
        turning = settle(log_slope(x, c.weights) - log_slope(mirror, c.weights), one)
        k = -(nu_complex * (1 + 2 * turning)) - f.momentum / 2
        ahead, behind = settle((mirror * start, x * partner), one)
        behind_value, behind_slope = settle(product(behind, c.weights), one)
        ahead_value, ahead_slope = settle(product(ahead, c.weights), one)
        ratios = ahead_slope * ahead_value.inverse, behind_slope * behind_value.inverse
        inner = settle(base + ratios[0] - ratios[1], one)
        # From the rate at the start. Where nothing nutates (nu = 0) the phase alone turns.
        steady = (rate * value.conj).im / safe(value.square > 0, value.square)
        k = settle(where(f.live, k, Complex(steady, zero)), one)
        drift = (k * value).times_i - rate
        d = drift * (-nu_complex.conj.times_i) * (1 / (2 * nu * nu)) + inner * value
        d = settle(where(f.live, d, Complex(zero, zero)), one)
        scale = settle(origin * (ahead_value * behind_value).inverse, one)
        angle = where(f.circular | (x.square == 0), Complex(jnp.ones_like(zero), zero), x)
        return Spinor(
            scale * (value + d),
            scale * d,
            x,
            mirror,
            k * frequency + spin / 2,
            jnp.arctan2(angle.im, angle.re),
            below & ~f.circular,
        )

    lowered = f.sign > 0
    spinors = jax.vmap(parameter)(
        _stack(alpha, beta),
        _stack(-(beta.conj * push), alpha.conj * push),
        _stack(lowered, ~lowered),
    )
    return Orbit(c, start, partner, f.circular, nu * frequency, settle(spinors, one))


def at(o: Orbit, elapsed: Array) -> tuple[Complex, Complex, Complex]:
    """alpha, beta and omega_y + i omega_x at times [s] that broadcast against the lanes."""
    weights, circular = o.curve.weights, o.circular
    angle = 2 * o.nu * elapsed
    # Whole periods of real exponentials; on the separatrix itself there is none.
    periodic = ~circular & (o.curve.h > 0)
    period = -jnp.log(safe(periodic, o.curve.h))
    count = jnp.round(angle / safe(periodic, period))
    count = _only(periodic, jax.lax.stop_gradient(count))
    limit = 0.4 * math.log(jnp.finfo(angle.dtype).max)
    fall = jnp.clip(_only(periodic, count * period) - angle, -limit, limit)
    half = jnp.exp(_only(~circular, fall / 2))
    size = half * half
    turn = unit(_only(circular, angle))
    f, inverse = turn * size, turn.conj * (1 / size)
    forward, backward = o.start * f, o.partner * inverse
    one = opaque_one(angle)
    f, forward, backward = settle((f, forward, backward), one)
    below = settle(product(forward, weights)[0], one) * settle(product(backward, weights)[0], one)
    below = settle(below.inverse, one)

    def parameter(s: Spinor):
        first, first_slope = settle(product(settle(s.mirror * forward, one), weights), one)
        second, second_slope = settle(product(settle(s.place * backward, one), weights), one)
        fading = s.d * f
        theta = first * second
        whole = (s.c - fading) * theta
        slope = (s.c - fading) * (first_slope * second - first * second_slope) - fading * theta
        whole, slope = settle((whole, slope), one)
        phase = unit(s.rate.re * elapsed + count * s.turn)
        factor = below * phase * jnp.where(s.growing, 1 / half, 1)
        factor = settle(factor, one)
        nu = 2 * o.nu
        slope = where(circular, slope * nu, slope.times_i * nu)
        return settle((factor * whole, factor * (s.rate * whole + slope)), one)

    alpha, alpha_rate = parameter(jax.tree.map(lambda x: x[0], o.spinors))
    beta, beta_rate = parameter(jax.tree.map(lambda x: x[1], o.spinors))
    return alpha, beta, (alpha * beta_rate - beta * alpha_rate).times_i * 2
