"""Lagrange's top on its elliptic curve: a symmetric body, its centre on the axis, uniform gravity.

Let u be the vertical, g = u . e3, M the moment of the weight, N = 2 A M, and p and b the momenta
about the vertical and the axis. Then (A dg/dt)^2 = f(g) = 2 A (E - M g)(1 - g^2) - (p - b g)^2, a
cubic. The arguments below are momenta and torques divided by A, as if A were 1. On its elliptic
curve the Cayley-Klein parameters alpha = w + iz and beta = y + ix (of the attitude relative to u)
are an exponential times a quotient of theta functions (Klein & Sommerfeld, Theorie des Kreisels,
VI.5). Here they are written as

    alpha(t) = exp(i k t) (c - d F) (h F E/x) (x E'/F) / ((F E) (E'/F)),   F = exp(2 i nu t),

where (a) = (a; h) as in ``_lagrange_series``, E is the coordinate of the initial state on the
curve, E' = h/E, and x is the coordinate of the point where alpha vanishes. E, E', x, h/x, nu and k
are analytic functions of the initial state, even where the nutation vanishes (regular precession,
sleeping and hanging tops), and c and d are linear in alpha and its rate. Therefore values and
derivatives are regular there and at both poles.

If the two lower roots of f are the close pair, nu is real and E' = conj(E). If the two upper ones
are (near the separatrix), the cubic is reversed: nu is imaginary, E and E' are real, and time is
reduced by whole periods. In both cases h <= exp(-2 pi).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._closed_forms._lagrange_series import (
    Complex,
    Curve,
    Series,
    curve,
    pair,
    point,
    rows_of_ones,
    unit,
    unpaired,
    where,
)
from polhode._kernels import opaque_ones, spread, staged


class Cubic(NamedTuple):
    """f as a polynomial in g minus its initial value, reversed if needed so that its third root is
    the isolated one.

    - ``momentum_unit`` [rad/s]: unit of all momenta below, which are divided by A;
    - ``nutating``: whether this unit and the frequency of the nutation differ from 0;
    - ``circular``: whether the motion is between the first two roots (the lower pair of f);
      otherwise it is between the third and the second (the upper pair is the close one);
    - ``sign``: -1 where g was reversed;
    - ``axial_momentum``: about the axis; ``nutation`` = A dg/dt; ``horizontal_product``: scalar
      product of the horizontal momentum and the vertical; ``one_plus_g``, ``one_minus_g``;
    - ``leading``: absolute value of the leading coefficient;
    - ``root_sum``, ``root_product``: of the first two roots minus g;
    - ``third_distance``: distance of the third root from g times ``leading``;
    - ``mean_distance``: geometric mean of the distances of the third root from the two others,
      times ``leading``; ``width``: (sum of the square roots of those distances)^2.
    """

    momentum_unit: Array
    nutating: Array
    circular: Array
    sign: Array
    axial_momentum: Array
    nutation: Array
    horizontal_product: Array
    one_plus_g: Array
    one_minus_g: Array
    leading: Array
    root_sum: Array
    root_product: Array
    third_distance: Array
    mean_distance: Array
    width: Array

    @property
    def scale(self) -> Array:
        """``leading / width``: differences of g in units of the curve."""
        return jnp.where(self.nutating, self.leading / self.width, 0)

    @property
    def landen_squared(self) -> Array:
        """The squared Landen modulus of the curve."""
        return self.scale**2 * jnp.maximum(self.root_sum**2 - 4 * self.root_product, 0)


def where_or_one(condition: Array, value: Array) -> Array:
    """The value where the condition is true, else 1, so that unused branches are finite."""
    return jnp.where(condition, value, 1)


def positive(x: Array) -> Array:
    """x, or the smallest positive number where x is zero or negative by rounding."""
    return jnp.where(x > 0, x, jnp.finfo(x.dtype).tiny)


def _third_of_angle(x: Array) -> Array:
    """c in [sqrt(3)/2, 1] with 4 c^3 - 3 c = x in [0, 1]."""
    # Newton's method: its derivative, 12 c^2 - 3, is at least 6 on the interval.
    c = 0.866 + 0.134 * x
    for _ in range(4):
        c = (8 * c**3 + x) / (12 * c * c - 3)
    return c


@jax.custom_jvp
def _isolated_root(f2: Array, f1: Array, f0: Array) -> tuple[Array, Array, Array]:
    """The isolated root of y^3 + f2 y^2 + f1 y + f0 (three real roots), the one farther from the
    middle root; whether it is the greatest; and a third of the spread of the roots."""
    q = (f2 * f2 - 3 * f1) / 9
    r = (2 * f2**3 - 9 * f2 * f1 + 27 * f0) / 54
    greatest = r <= 0
    size = jnp.sqrt(jnp.maximum(q, 0))
    cube = size**3
    ratio = jnp.where(cube > 0, jnp.abs(r) / where_or_one(cube > 0, cube), 1)
    part = 2 * size * _third_of_angle(jnp.minimum(ratio, 1))
    y = jnp.where(greatest, part, -part) - f2 / 3
    # Newton steps remove the rounding error of the trigonometric root. The derivative of the cubic
    # is farthest from zero at the isolated root, so that the divisor does not become small for a
    # close pair.
    for _ in range(2):
        derivative = (3 * y + 2 * f2) * y + f1
        y = y - jnp.where(
            derivative > 0,
            (((y + f2) * y + f1) * y + f0) / where_or_one(derivative > 0, derivative),
            0,
        )
    return y, greatest, size


@_isolated_root.defjvp
def _isolated_root_rule(primals, tangents):
    (f2, f1, _), (d2, d1, d0) = primals, tangents
    y, greatest, size = _isolated_root(*primals)
    derivative = (3 * y + 2 * f2) * y + f1
    inverse = -jnp.where(derivative > 0, 1 / where_or_one(derivative > 0, derivative), 0)
    dy = inverse * d0 + (inverse * y) * d1 + (inverse * y * y) * d2
    # the other results only select formulas
    none = np.zeros(greatest.shape, jax.dtypes.float0)
    return (y, greatest, size), (dy, none, jnp.zeros_like(size))


def cubic(weight: Array, vertical: tuple[Array, ...], momentum: tuple[Array, ...]) -> Cubic:
    """The cubic of a state.

    ``weight`` 2 M/A [1/s^2] of either sign; ``vertical``: body components of the vertical u1, u2,
    then 1 + g and 1 - g; ``momentum``: body components over A [rad/s].
    """
    square = momentum[0] ** 2 + momentum[1] ** 2 + momentum[2] ** 2 + jnp.abs(weight)
    is_nonzero = square > 0
    momentum_unit = jnp.sqrt(where_or_one(is_nonzero, square))
    l1, l2, b = (x / momentum_unit for x in momentum)
    n = weight / where_or_one(is_nonzero, square)
    u1, u2, one_plus_g, one_minus_g = vertical
    g = (one_plus_g - one_minus_g) / 2
    horizontal_product, nutation = u1 * l1 + u2 * l2, u1 * l2 - u2 * l1
    flat, lying = l1 * l1 + l2 * l2, u1 * u1 + u2 * u2
    # f0 + f1 x + f2 x^2 + n x^3 about g: near the poles f0 and f1 are small without cancellation
    f0 = nutation * nutation
    f1 = 2 * b * horizontal_product - 2 * g * flat - n * lying
    f2 = 2 * n * g - flat - b * b
    y, circular, size = _isolated_root(f2, n * f1, n * n * f0)
    side = jnp.where(circular, 1, -1).astype(g.dtype)
    sign = jnp.where(n < 0, -side, side)
    leading = jnp.abs(n)
    n = side * leading
    nutation, horizontal_product, f1 = sign * nutation, sign * horizontal_product, sign * f1
    one_plus_g, one_minus_g = (
        jnp.where(sign > 0, one_plus_g, one_minus_g),
        jnp.where(sign > 0, one_minus_g, one_plus_g),
    )
    # The sum and the product of the other two roots: by f2 and f1 if g is close to the third root
    # (y is small); otherwise by f1 and f0, which is accurate for a pair close to g.
    third_is_close = (~circular) & (jnp.abs(y) < size)
    third_root_distance = where_or_one(~third_is_close & (y != 0), y)
    root_sum = jnp.where(
        third_is_close,
        -(f2 + y) / where_or_one(third_is_close, n),
        (f1 + n * f0 / third_root_distance) / third_root_distance,
    )
    root_product = jnp.where(
        third_is_close,
        (f1 - root_sum * y) / where_or_one(third_is_close, n),
        -f0 / third_root_distance,
    )
    distances = side * (2 * y - n * root_sum)
    mean_distance = jnp.sqrt(positive(y * y - n * root_sum * y + n * n * root_product))
    width = distances + 2 * mean_distance
    nutating = is_nonzero & (width > 4 * jnp.finfo(g.dtype).tiny ** 0.5)
    return Cubic(
        momentum_unit,
        nutating,
        circular,
        sign,
        b,
        nutation,
        horizontal_product,
        one_plus_g,
        one_minus_g,
        leading,
        root_sum,
        root_product,
        side * y,
        mean_distance,
        where_or_one(nutating, width),
    )


class CayleyKlein(NamedTuple):
    """One Cayley-Klein parameter: the coefficients c and d, the coordinate x of its zero and h/x,
    its rate k, the angle of x, and whether its modulus has a factor F^(-1/2) if F is real."""

    c: Complex
    d: Complex
    place: Complex
    mirror: Complex
    rate: Complex
    angle: Array
    growing: Array


class LagrangeConstants(NamedTuple):
    """The constants of a motion of Lagrange's top, for any time (arrays of lanes).

    ``start``, ``partner``: E and h/E; ``nu`` [rad/s]: its real or imaginary part; ``spinors``:
    alpha and beta, stacked along a new first axis.
    """

    series: Series
    start: Complex
    partner: Complex
    circular: Array
    nu: Array
    spinors: CayleyKlein


def _where_or_zero(condition: Array, value: Array) -> Array:
    return jnp.where(condition, value, 0)


def _stack(*trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def _row(tree, rows: int):
    """Lanes repeated as (rows, N), for several values per lane."""
    return spread(tree, 0, rows)


def _reciprocal(a: Complex, b: Complex, times: Array) -> tuple[Complex, Complex]:
    """The pair a, b with the product ``times``: if one is large, the other one, which may consist
    of rounding alone, is computed from the product. Near three equal roots neither is changed."""
    first, second = (x.square > 1 / 4 for x in (a, b))
    large = where(first, a, where(second, b, Complex(jnp.ones_like(a.re), jnp.zeros_like(a.re))))
    other = large.inverse * times
    return where(second & ~first, other, a), where(first, other, b)


def _places(f: Cubic, c: Curve, raw: Array):
    """Coordinates of the state, of g = -1 and of g = 1 (before the reversal) on the curve, and
    their partners h/E."""
    circular = f.circular
    zero = jnp.zeros_like(f.nutation)
    # Twice dg/du at the point, divided by the root of its distance (``depth``) from the third root.
    # Close to the third root, if that bounds the motion, the signed root of the depth itself: the
    # nutation over the root of the product of the distances from the two other roots.
    state_close = (~circular) & (f.third_distance < f.mean_distance / 2)
    state_span = jnp.sqrt(where_or_one(state_close, f.root_product))
    state_push = 2 * f.nutation / jnp.sqrt(where_or_one(~state_close, positive(f.third_distance)))
    state_push = _where_or_zero(~state_close, state_push)
    # g = -1, where A g' = i (p + b)
    lower_push = 2 * (f.horizontal_product + f.axial_momentum * f.one_plus_g)
    lower_push = -lower_push / jnp.sqrt(positive(f.third_distance + f.leading * f.one_plus_g))
    # g = 1, where A g' = i (p - b)
    depth = f.third_distance - f.leading * f.one_minus_g
    upright = f.horizontal_product - f.axial_momentum * f.one_minus_g
    is_close = (depth < f.mean_distance / 2) | ~circular
    span = jnp.sqrt(
        where_or_one(
            is_close, positive(f.one_minus_g**2 - f.root_sum * f.one_minus_g + f.root_product)
        )
    )
    upper_push = _where_or_zero(~is_close, -2 * upright / jnp.sqrt(where_or_one(~is_close, depth)))
    mean = jnp.stack(
        [
            _where_or_zero(~state_close, f.root_sum),
            f.root_sum + 2 * f.one_plus_g,
            _where_or_zero(~is_close, f.root_sum - 2 * f.one_minus_g),
        ]
    )
    step = Complex(
        jnp.stack(
            [
                _where_or_zero(~circular, state_push),
                _where_or_zero(circular, lower_push),
                upper_push,
            ]
        ),
        jnp.stack(
            [_where_or_zero(circular, state_push), _where_or_zero(~circular, -lower_push), zero]
        ),
    )
    # near the third root
    root = _where_or_zero(is_close, upright) / span
    is_near_root = jnp.stack([state_close, jnp.zeros_like(is_close), is_close])
    depth = jnp.stack([f.third_distance, zero, depth])
    span = jnp.stack([state_span, jnp.ones_like(span), span])
    fall = Complex(
        jnp.stack([-f.nutation / state_span, zero, _where_or_zero(circular, root)]),
        jnp.stack([zero, zero, _where_or_zero(~circular, -root)]),
    )
    middle, amount, width, reach, c = _row(
        (f.mean_distance, f.leading, jnp.sqrt(f.width), f.scale, c._replace(series=None)), 3
    )
    one = rows_of_ones(3, raw)
    is_near_root = staged(is_near_root, one)
    scale = 1 / where_or_one(is_near_root, amount * span)
    lift, fall = staged(((middle + depth) * scale, fall * (scale * width)), one)
    mean, step = staged((mean * reach, step * reach), one)
    e, partner = _reciprocal(step + mean, -step + mean, c.square)
    half = staged(((1 + partner) * (1 + e).inverse).root, one)
    lead = where(is_near_root, -fall + lift, e * half)
    partner_place = where(is_near_root, fall + lift, partner * half.inverse)
    lead, partner_place = staged((lead, partner_place), one)
    pull = jnp.where(is_near_root, c.square, 1) * c.steps[0]
    first, second = point(lead, partner_place, pull, c, one)
    return staged(
        (first * jnp.where(is_near_root, -1, c.per), second * jnp.where(is_near_root, -c.h, c.per)),
        one,
    )


def _staged_start(c: Curve, start: Complex, partner: Complex):
    """E and h/E with the product h; near the separatrix the smaller one may be rounding alone.

    E and E/h are the same point: the larger one determines the other, unless both are small.
    """
    large, other = start.square > _SMALL**2, partner.square > _SMALL**2
    one = Complex(jnp.ones_like(c.h), jnp.zeros_like(c.h))
    inverse = where(large, start, where(other, partner, one)).inverse
    return (
        where(~large & other, inverse, start),
        where(large, inverse * c.h, where(other, partner * c.h, partner)),
    )


_SMALL = 0.05
"""A bound above the largest nome exp(-pi), which is the largest |E| if E and h/E are conjugate."""


def lagrange_constants(
    spin: Array,
    pull: Array,
    spinor: tuple[Complex, Complex],
    momentum: tuple[Array, Array, Array],
) -> LagrangeConstants:
    """The motion through a state.

    ``spin``: omega_z [rad/s]; ``pull``: M/A [1/s^2] of either sign in V = M u . e3; ``spinor``:
    alpha = w + iz and beta = y + ix of the attitude relative to u, of unit length; ``momentum``:
    body components over A [rad/s], including that of wheels on the axis. All of one shape.
    """
    alpha, beta = spinor
    product = alpha * beta
    vertical = (-2 * product.re, 2 * product.im, 2 * alpha.square, 2 * beta.square)
    one = opaque_ones(spin)
    f = staged(cubic(2 * pull, vertical, momentum), one)
    c = curve(staged(f.landen_squared, one), one)
    places, partners = _places(f, c, spin)
    start, partner = staged(_staged_start(c, places.at(0), partners.at(0)), one)
    nu = staged(jnp.sqrt(f.width) / (4 * c.stretch), one)
    origin, twist = pair(start.re + partner.re, c.h, jnp.ones_like(c.h), c.series, one)
    base = staged((partner - start) * (twist / origin), one)
    x, mirror = places.at(slice(1, 3)), partners.at(slice(1, 3))
    both_ones = rows_of_ones(2, spin)
    log_derivative = _log_derivative(x, mirror, c, both_ones)
    # alpha vanishes where g = -1, before the reversal
    upward = f.sign > 0
    x, mirror, log_derivative = (
        _stack(where(upward, v.at(0), v.at(1)), where(upward, v.at(1), v.at(0)))
        for v in (x, mirror, log_derivative)
    )
    momentum_coefficient = Complex(momentum[1], momentum[0]) * (1 / (2 * f.momentum_unit))
    one = both_ones
    value, rate = staged(
        (
            _stack(alpha, beta),
            _stack(-(beta.conj * momentum_coefficient), alpha.conj * momentum_coefficient),
        ),
        one,
    )
    constants = LagrangeConstants(c.series, start, partner, f.circular, nu * f.momentum_unit, None)
    frequency = f.momentum_unit

    circular, nutating, axial, series, start, partner, origin, base, nu, frequency, spin = _row(
        (
            *(f.circular, f.nutating, f.axial_momentum, c.series),
            *(start, partner, origin, base, nu, frequency, spin),
        ),
        2,
    )
    zero = jnp.zeros_like(value.re)
    nu_complex = Complex(_where_or_zero(circular, nu), _where_or_zero(~circular, nu))
    ahead, behind = staged((mirror * start, x * partner), one)
    theta, slope = staged(unpaired(ahead, behind, series, one), one)
    inverse = staged(theta.inverse, one)
    inner = staged(base + slope * inverse, one)
    # From the rate at the start. Without nutation (nu = 0) only the phase changes.
    precession_rate = (rate * value.conj).im / where_or_one(value.square > 0, value.square)
    k = -(nu_complex * (1 + 2 * log_derivative)) - axial / 2
    k = staged(where(nutating, k, Complex(precession_rate, zero)), one)
    drift = (k * value).times_i - rate
    d = drift * (-nu_complex.conj.times_i) * (1 / (2 * nu * nu)) + inner * value
    d = staged(where(nutating, d, Complex(zero, zero)), one)
    # d : c = E : x. If one of them is far below the other, its formula by the rate would give
    # rounding alone, which exp(2 i nu t) amplifies near the separatrix.
    hyperbolic = nutating & ~circular
    first = hyperbolic & (4 * start.square < x.square)
    second = hyperbolic & (4 * x.square < start.square)
    none = Complex(zero, zero)
    large = where(first, x, where(second, start, none + 1))
    ratio = where(first, start, where(second, x, none)) * large.inverse
    larger = staged(value * (1 - ratio).inverse, one)
    smaller = staged(larger * ratio, one)
    coefficient_c, d = (
        where(first, larger, where(second, -smaller, value + d)),
        where(first, smaller, where(second, -larger, d)),
    )
    scale = staged(inverse * origin, one)
    has_fixed_angle = circular | (x.square == 0)
    spinors = CayleyKlein(
        scale * coefficient_c,
        scale * d,
        x,
        mirror,
        k * frequency + spin / 2,
        jnp.arctan2(_where_or_zero(~has_fixed_angle, x.im), jnp.where(has_fixed_angle, 1, x.re)),
        jnp.stack([upward, ~upward]) & ~circular,
    )
    return constants._replace(spinors=staged(spinors, one))


def _log_derivative(x: Complex, mirror: Complex, c: Curve, one: Array) -> Complex:
    """Difference of the logarithmic derivatives at x and h/x, for the points of g = -1 and g = 1.

    For g = -1 it is computed from the pair x, h/x, for g = 1 from h x, h/x, whose sums are real.
    """
    ones = jnp.ones_like(c.h)
    argument = x * jnp.stack([ones, c.h])
    times, rise = jnp.stack([c.h, c.h * c.h]), jnp.stack([ones, 2 * c.h])
    norm, twist = pair(argument.re + mirror.re, times, rise, _row(c.series, 2), one)
    log_derivative = staged((mirror - argument) * (twist / norm), one)
    upper = x.at(1)
    return _stack(log_derivative.at(0), log_derivative.at(1) + upper * (1 - upper).inverse)


def cayley_klein(o: LagrangeConstants, elapsed: Array) -> tuple[Complex, Complex, Complex]:
    """alpha, beta and omega_y + i omega_x at times [s] that broadcast against the lanes."""
    series, circular = o.series, o.circular
    angle = 2 * o.nu * elapsed
    # Reduction by whole periods of the real exponentials; on the separatrix there is no period.
    periodic = ~circular & (series.h > 0)
    period = -jnp.log(where_or_one(periodic, series.h))
    count = jnp.round(angle / where_or_one(periodic, period))
    count = _where_or_zero(periodic, jax.lax.stop_gradient(count))
    limit = 0.4 * math.log(jnp.finfo(angle.dtype).max)
    fall = jnp.clip(_where_or_zero(periodic, count * period) - angle, -limit, limit)
    half = jnp.exp(_where_or_zero(~circular, fall / 2))
    size = half * half
    phasor = unit(_where_or_zero(circular, angle))
    f, inverse = phasor * size, phasor.conj * (1 / size)
    forward, backward = o.start * f, o.partner * inverse
    one = opaque_ones(elapsed)
    f, forward, backward, half = staged((f, forward, backward, half), one)
    below = pair(forward.re + backward.re, series.h, jnp.ones_like(series.h), series, one)[0]
    below = staged(1 / below, one)

    # Both parameters are rows of the same arrays, so that the program contains their formulas once.
    # With derivatives it compiles in a twelfth less time, and runs as fast.
    f, forward, backward, below, half, series, circular, nu, count, elapsed = _row(
        (f, forward, backward, below, half, series, circular, 2 * o.nu, count, elapsed), 2
    )
    one = rows_of_ones(2, elapsed[0])
    ahead, behind = staged((o.spinors.mirror * forward, o.spinors.place * backward), one)
    theta, twist = staged(unpaired(ahead, behind, series, one), one)
    fading = o.spinors.d * f
    difference = o.spinors.c - fading
    value, derivative = staged((difference * theta, difference * twist - fading * theta), one)
    phase = unit(o.spinors.rate.re * elapsed + count * o.spinors.angle)
    factor = phase * (below * jnp.where(o.spinors.growing, 1 / half, 1))
    factor = staged(factor, one)
    derivative = where(circular, derivative * nu, derivative.times_i * nu)
    spinors, rates = staged((factor * value, factor * (o.spinors.rate * value + derivative)), one)
    (alpha, alpha_rate), (beta, beta_rate) = ((spinors.at(k), rates.at(k)) for k in range(2))
    return alpha, beta, (alpha * beta_rate - beta * alpha_rate).times_i * 2
