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

from polhode._closed_forms.tops._complex import Complex, unit, where
from polhode._closed_forms.tops._cubic import Cubic, cubic, positive, safe
from polhode._closed_forms.tops._pochhammer import Curve, Series, curve, pair, point, unpaired
from polhode._kernels import opaque_ones, spread, staged


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

    series: Series
    start: Complex
    partner: Complex
    circular: Array
    nu: Array
    spinors: Spinor


def _only(condition: Array, value: Array, other=0) -> Array:
    return jnp.where(condition, value, other)


def _stack(*trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def _row(tree, rows: int):
    """Lanes (rows, N), to go with several values per lane."""
    return spread(tree, 0, rows)


def _rows_of_ones(rows: int, x: Array) -> Array:
    """Ones (rows, N) that are no broadcast to XLA, of one body neither."""
    scale = jnp.arange(1, rows + 1, dtype=x.dtype)
    return opaque_ones(x[None] * scale.reshape(-1, *(1,) * x.ndim))


def _reciprocal(a: Complex, b: Complex, times: Array) -> tuple[Complex, Complex]:
    """The pair so that its product is ``times`` where that is small and one is large, so that the
    other is rounding: near three equal roots all would be."""
    first, second = (x.square > 1 / 4 for x in (a, b))
    large = where(first, a, where(second, b, Complex(jnp.ones_like(a.re), jnp.zeros_like(a.re))))
    other = large.inverse * times
    return where(second & ~first, other, a), where(first, other, b)


def _places(f: Cubic, c: Curve, raw: Array):
    """Places of the state, of g = -1 and of g = 1 (before the turning over), and their partners."""
    circular = f.circular
    zero = jnp.zeros_like(f.across)
    # Twice dg/du at the place over the root of its depth; nearer to the third root (where that
    # bounds the motion) the square root of the turned depth instead.
    state_close = (~circular) & (f.depth < f.middle / 2)
    state_span = jnp.sqrt(safe(state_close, f.times))
    state_push = 2 * f.across / jnp.sqrt(safe(~state_close, positive(f.depth)))
    state_push = _only(~state_close, state_push)
    # g = -1, where A g' = i (p + b)
    lower_push = 2 * (f.along + f.momentum * f.above)
    lower_push = -lower_push / jnp.sqrt(positive(f.depth + f.amount * f.above))
    # g = 1, where A g' = i (p - b)
    depth = f.depth - f.amount * f.below
    upright = f.along - f.momentum * f.below
    close = (depth < f.middle / 2) | ~circular
    span = jnp.sqrt(safe(close, positive(f.below**2 - f.total * f.below + f.times)))
    push = _only(~close, -2 * upright / jnp.sqrt(safe(~close, depth)))
    mean = jnp.stack([
        _only(~state_close, f.total), f.total + 2 * f.above, _only(~close, f.total - 2 * f.below)
    ])  # fmt: skip
    step = Complex(
        jnp.stack([_only(~circular, state_push), _only(circular, lower_push), push]),
        jnp.stack([_only(circular, state_push), _only(~circular, -lower_push), zero]),
    )
    # near the third root
    root = _only(close, upright) / span
    near = jnp.stack([state_close, jnp.zeros_like(close), close])
    depth = jnp.stack([f.depth, zero, depth])
    span = jnp.stack([state_span, jnp.ones_like(span), span])
    fall = Complex(
        jnp.stack([-f.across / state_span, zero, _only(circular, root)]),
        jnp.stack([zero, zero, _only(~circular, -root)]),
    )
    middle, amount, width, reach, c = _row(
        (f.middle, f.amount, jnp.sqrt(f.width), f.reach, c._replace(series=None)), 3
    )
    one = _rows_of_ones(3, raw)
    near = staged(near, one)
    scale = 1 / safe(near, amount * span)
    lift, fall = staged(((middle + depth) * scale, fall * (scale * width)), one)
    mean, step = staged((mean * reach, step * reach), one)
    e, partner = _reciprocal(step + mean, -step + mean, c.square)
    half = staged(((1 + partner) * (1 + e).inverse).root, one)
    lead = where(near, -fall + lift, e * half)
    rest = where(near, fall + lift, partner * half.inverse)
    lead, rest = staged((lead, rest), one)
    pull = jnp.where(near, c.square, 1) * c.steps[0]
    first, second = point(lead, rest, pull, c, one)
    return staged((first * jnp.where(near, -1, c.per), second * jnp.where(near, -c.h, c.per)), one)


def _staged_start(c: Curve, start: Complex, partner: Complex):
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
    one = opaque_ones(transverse)
    f = staged(cubic(2 * transverse * pull, vertical, momentum), one)
    c = curve(staged(f.square, one), one)
    places, partners = _places(f, c, transverse)
    start, partner = staged(_staged_start(c, places.at(0), partners.at(0)), one)
    nu = staged(jnp.sqrt(f.width) / (4 * c.stretch), one)
    origin, twist = pair(start.re + partner.re, c.h, jnp.ones_like(c.h), c.series, one)
    base = staged((partner - start) * (twist / origin), one)
    x, mirror = places.at(slice(1, 3)), partners.at(slice(1, 3))
    both_ones = _rows_of_ones(2, transverse)
    turning = _turning(x, mirror, c, both_ones)
    # alpha vanishes where g = -1, before the turning over
    upward = f.sign > 0
    x, mirror, turning = (
        _stack(where(upward, v.at(0), v.at(1)), where(upward, v.at(1), v.at(0)))
        for v in (x, mirror, turning)
    )
    push = Complex(momentum[1], momentum[0]) * (1 / (2 * f.unit))
    one = both_ones
    value, rate = staged((_stack(alpha, beta), _stack(-(beta.conj * push), alpha.conj * push)), one)
    whole = Orbit(c.series, start, partner, f.circular, nu * f.unit / transverse, None)
    frequency = f.unit / transverse

    circular, live, axial, series, start, partner, origin, base, nu, frequency, spin = _row(
        (
            *(f.circular, f.live, f.momentum, c.series),
            *(start, partner, origin, base, nu, frequency, spin),
        ),
        2,
    )
    zero = jnp.zeros_like(value.re)
    nu_complex = Complex(_only(circular, nu), _only(~circular, nu))
    ahead, behind = staged((mirror * start, x * partner), one)
    theta, slope = staged(unpaired(ahead, behind, series, one), one)
    inverse = staged(theta.inverse, one)
    inner = staged(base + slope * inverse, one)
    # From the rate at the start. Where nothing nutates (nu = 0) the phase alone turns.
    steady = (rate * value.conj).im / safe(value.square > 0, value.square)
    k = -(nu_complex * (1 + 2 * turning)) - axial / 2
    k = staged(where(live, k, Complex(steady, zero)), one)
    drift = (k * value).times_i - rate
    d = drift * (-nu_complex.conj.times_i) * (1 / (2 * nu * nu)) + inner * value
    d = staged(where(live, d, Complex(zero, zero)), one)
    # d : c = E : x. Where one of them is far below the other, the difference from the rate would
    # leave it rounding, which exp(2 i nu t) near the separatrix makes large.
    unsteady = live & ~circular
    first = unsteady & (4 * start.square < x.square)
    second = unsteady & (4 * x.square < start.square)
    nothing = Complex(zero, zero)
    large = where(first, x, where(second, start, nothing + 1))
    ratio = where(first, start, where(second, x, nothing)) * large.inverse
    most = staged(value * (1 - ratio).inverse, one)
    least = staged(most * ratio, one)
    whole_part, d = (
        where(first, most, where(second, -least, value + d)),
        where(first, least, where(second, -most, d)),
    )
    scale = staged(inverse * origin, one)
    plain = circular | (x.square == 0)
    spinors = Spinor(
        scale * whole_part,
        scale * d,
        x,
        mirror,
        k * frequency + spin / 2,
        jnp.arctan2(_only(~plain, x.im), jnp.where(plain, 1, x.re)),
        jnp.stack([upward, ~upward]) & ~circular,
    )
    return whole._replace(spinors=staged(spinors, one))


def _turning(x: Complex, mirror: Complex, c: Curve, one: Array) -> Complex:
    """Difference of the logarithmic slopes at x and h/x, for the places of g = -1 and g = 1.

    Of g = -1 it comes of the pair x, h/x, of g = 1 of h x, h/x: their sums are real.
    """
    ones = jnp.ones_like(c.h)
    moved = x * jnp.stack([ones, c.h])
    times, rise = jnp.stack([c.h, c.h * c.h]), jnp.stack([ones, 2 * c.h])
    norm, twist = pair(moved.re + mirror.re, times, rise, _row(c.series, 2), one)
    turning = staged((mirror - moved) * (twist / norm), one)
    upper = x.at(1)
    return _stack(turning.at(0), turning.at(1) + upper * (1 - upper).inverse)


def at(o: Orbit, elapsed: Array) -> tuple[Complex, Complex, Complex]:
    """alpha, beta and omega_y + i omega_x at times [s] that broadcast against the lanes."""
    series, circular = o.series, o.circular
    angle = 2 * o.nu * elapsed
    # Whole periods of real exponentials; on the separatrix itself there is none.
    periodic = ~circular & (series.h > 0)
    period = -jnp.log(safe(periodic, series.h))
    count = jnp.round(angle / safe(periodic, period))
    count = _only(periodic, jax.lax.stop_gradient(count))
    limit = 0.4 * math.log(jnp.finfo(angle.dtype).max)
    fall = jnp.clip(_only(periodic, count * period) - angle, -limit, limit)
    half = jnp.exp(_only(~circular, fall / 2))
    size = half * half
    turn = unit(_only(circular, angle))
    f, inverse = turn * size, turn.conj * (1 / size)
    forward, backward = o.start * f, o.partner * inverse
    one = opaque_ones(elapsed)
    f, forward, backward = staged((f, forward, backward), one)
    below = pair(forward.re + backward.re, series.h, jnp.ones_like(series.h), series, one)[0]
    below = staged(1 / below, one)

    def parameter(s: Spinor):
        ahead, behind = staged((s.mirror * forward, s.place * backward), one)
        theta, twist = staged(unpaired(ahead, behind, series, one), one)
        fading = s.d * f
        left = s.c - fading
        whole, slope = staged((left * theta, left * twist - fading * theta), one)
        phase = unit(s.rate.re * elapsed + count * s.turn)
        factor = phase * (below * jnp.where(s.growing, 1 / half, 1))
        factor = staged(factor, one)
        nu = 2 * o.nu
        slope = where(circular, slope * nu, slope.times_i * nu)
        return staged((factor * whole, factor * (s.rate * whole + slope)), one)

    alpha, alpha_rate = parameter(jax.tree.map(lambda x: x[0], o.spinors))
    beta, beta_rate = parameter(jax.tree.map(lambda x: x[1], o.spinors))
    return alpha, beta, (alpha * beta_rate - beta * alpha_rate).times_i * 2
