"""Theta functions in Tate's form: the infinite product (a; h) = prod over n >= 0 of (1 - h^n a).

theta1(z) with nome q is, up to constants and a factor exp(-iz), the product (a; h)(h/a; h) with
a = exp(2iz), h = q^2 (Jacobi's triple product, NIST DLMF 20.5.1). In this form it depends on a and
h/a, both of which are regular where the amplitude of a motion vanishes.

Complex numbers are pairs of real arrays, because XLA compiles real arithmetic to vector
instructions, and products with real arrays need no promotion.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._closed_forms._arithmetic import nome_per_parameter, theta3_squared_less_one
from polhode._kernels import opaque_ones, staged


class Complex(NamedTuple):
    """``re + i im``; the second operand of +, - and * may be a real array or a number."""

    re: Array
    im: Array

    def __add__(self, other):
        if isinstance(other, Complex):
            return Complex(self.re + other.re, self.im + other.im)
        return Complex(self.re + other, self.im)

    def __mul__(self, other):
        if isinstance(other, Complex):
            return Complex(
                self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re
            )
        return Complex(self.re * other, self.im * other)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self):
        return Complex(-self.re, -self.im)

    def __sub__(self, other):
        return self + (-other)

    def __rsub__(self, other):
        return -self + other

    @property
    def conj(self) -> "Complex":
        return Complex(self.re, -self.im)

    @property
    def square(self) -> Array:
        """|z|^2."""
        return self.re * self.re + self.im * self.im

    @property
    def inverse(self) -> "Complex":
        scale = 1 / self.square
        return Complex(self.re * scale, -self.im * scale)

    @property
    def times_i(self) -> "Complex":
        return Complex(-self.im, self.re)

    @property
    def root(self) -> "Complex":
        """Principal square root of a number far from the negative real axis (|arg| < 2 pi/3)."""
        re = jnp.sqrt((jnp.sqrt(self.square) + self.re) / 2)
        return Complex(re, self.im / (2 * re))

    def at(self, lanes) -> "Complex":
        """Both parts, indexed."""
        return Complex(self.re[lanes], self.im[lanes])


def unit(angle: Array) -> Complex:
    """exp(i angle)."""
    return Complex(jnp.cos(angle), jnp.sin(angle))


def where(condition: Array, a: Complex, b: Complex) -> Complex:
    """``jnp.where`` of complex numbers."""
    return Complex(jnp.where(condition, a.re, b.re), jnp.where(condition, a.im, b.im))


_TERMS = 5
"""Terms of Euler's series: the coefficient of a^k falls like h^(k (k - 1)/2), h <= exp(-2 pi)."""


class Series(NamedTuple):
    """Euler's coefficients of (a; h), and their derivatives with respect to ``h``."""

    h: Array
    weights: tuple[Array, ...]
    derivatives: tuple[Array, ...]


class Curve(NamedTuple):
    """One elliptic curve: ``h`` = q^2 <= exp(-2 pi), and the constants of the map ``point``.

    ``square`` is lambda^2, lambda the modulus after one descending Landen step; ``steps`` are
    lambda'/lambda^2 of the next ones, ``step_derivatives`` their derivatives with respect to
    ``square``; ``per`` is q/lambda; ``stretch`` is theta3(h)^2.
    """

    h: Array
    square: Array
    steps: tuple[Array, Array, Array]
    step_derivatives: tuple[Array, Array, Array]
    per: Array
    stretch: Array
    series: Series


def _series(h: Array) -> Series:
    weights, derivatives = [jnp.ones_like(h)], [jnp.zeros_like(h)]
    power, power_derivative = jnp.ones_like(h), jnp.zeros_like(h)  # h^k and its derivative
    for k in range(_TERMS):
        above, below = weights[-1] * power, 1 / (1 - power * h)
        h_derivative = derivatives[-1] * power + weights[-1] * power_derivative
        derivatives.append(-(h_derivative + above * ((k + 1) * power * below)) * below)
        weights.append(-above * below)
        power, power_derivative = power * h, (k + 1) * power
    return Series(h, tuple(weights), tuple(derivatives))


def _curve(square: Array) -> Curve:
    per_square = nome_per_parameter(square, jnp.sqrt(jnp.sqrt(1 - square)))
    h = square * per_square
    steps, derivatives = [], []
    modulus, modulus_derivative = square, jnp.ones_like(square)
    for _ in range(3):
        root = jnp.sqrt(1 - modulus)
        steps.append(1 / (1 + root) ** 2)
        derivatives.append(steps[-1] / ((1 + root) * root) * modulus_derivative)
        next_modulus = steps[-1] * modulus
        modulus_derivative = (
            2 * next_modulus * (derivatives[-1] * modulus + steps[-1] * modulus_derivative)
        )
        modulus = next_modulus * next_modulus
    return Curve(
        h,
        square,
        tuple(steps),
        tuple(derivatives),
        jnp.sqrt(per_square),
        1 + theta3_squared_less_one(h),
        _series(h),
    )


@jax.custom_jvp
def curve(square: Array, one: Array) -> Curve:
    """The curve of a squared Landen modulus in [0, 0.03]."""
    return staged(_curve(square), one)


@curve.defjvp
def _curve_rule(primals, tangents):
    # All constants are functions of one number: their derivatives are computed once, and each
    # tangent is a product. With ordinary differentiation the program would contain the recurrences
    # again for every tangent.
    square, one = primals
    _, derivatives = jax.jvp(_curve, (square,), (jnp.ones_like(square),))
    return curve(*primals), jax.tree.map(
        lambda derivative: derivative * tangents[0], staged(derivatives, one)
    )


def _polynomial(a: Complex, coefficients) -> Complex:
    """Polynomial with real coefficients, lowest first, in real arithmetic (Knuth, TAOCP 2,
    4.6.4)."""
    twice, square = 2 * a.re, a.square
    *lower, ahead, last = coefficients
    ahead = ahead + twice * last
    for weight in reversed(lower[1:]):
        ahead, last = weight + twice * ahead - square * last, ahead
    return Complex(lower[0] + a.re * ahead - square * last, a.im * ahead)


def _derivative_of(coefficients):
    """Coefficients of the derivative."""
    return [k * w for k, w in enumerate(coefficients) if k > 0]


def _pair(total: Array, times: Array, weights) -> tuple[Array, Array]:
    # At a and b, the roots of z^2 - total z + times, a polynomial is linear in z (Knuth's scheme).
    def line(coefficients):
        *lower, ahead, last = coefficients
        ahead = ahead + total * last
        for weight in reversed(lower[1:]):
            ahead, last = weight + total * ahead - times * last, ahead
        return lower[0] - times * last, ahead

    (low, high), (derivative, second_derivative) = line(weights), line(_derivative_of(weights))
    twist = (
        derivative * low + (second_derivative * low) * total + times * (second_derivative * high)
    )
    return low * low + (low * high) * total + times * (high * high), twist


@jax.custom_jvp
def pair(
    total: Array, times: Array, h_derivative: Array, series: Series, one: Array
) -> tuple[Array, Array]:
    """(a; h)(b; h), and T in a d/da log (a; h) - b d/db log (b; h) = T (a - b)/((a; h)(b; h)).

    Real functions of the sum and the product of a and b; the product is a function of h, with the
    derivative ``h_derivative``.
    """
    return staged(_pair(total, times, series.weights), one)


@pair.defjvp
def _pair_rule(primals, tangents):
    # derivatives by the sum and by h, of which the product of a and b is a function
    total, times, h_derivative, series, one = primals
    unit, zeros = jnp.ones_like(total), jnp.zeros_like(times)
    _, by_total = jax.jvp(lambda s: _pair(s, times, series.weights), (total,), (unit,))
    _, by_h = jax.jvp(
        lambda s, p, w: _pair(s, p, w),
        (total, times, series.weights),
        (jnp.zeros_like(total), zeros + h_derivative, series.derivatives),
    )
    by_total, by_h = staged((by_total, by_h), one)
    ds, dh = tangents[0], tangents[3].h  # the coefficients depend on h alone
    return pair(*primals), tuple(x * ds + y * dh for x, y in zip(by_total, by_h))


@jax.custom_jvp
def unpaired(a: Complex, b: Complex, series: Series, one: Array) -> tuple[Complex, Complex]:
    """(a; h)(b; h), and a d/da minus b d/db of it (Euler's series, DLMF 17.2.37)."""
    both, weights = _both(a, b), _for_both(series.weights)
    value = _polynomial(both, weights)
    derivative = both * _polynomial(both, _derivative_of(weights))
    value, derivative = staged((value, derivative), rows_of_ones(2, one))
    (x, y), (dx, dy) = ((v.at(0), v.at(1)) for v in (value, derivative))
    return x * y, dx * y - x * dy


def _both(a: Complex, b: Complex) -> Complex:
    """Two numbers along a new first axis, so that the program contains their formulas once."""
    return jax.tree.map(lambda x, y: jnp.stack([x, y]), a, b)


def _for_both(weights: tuple[Array, ...]) -> list[Array]:
    return [w[None] for w in weights]


def rows_of_ones(rows: int, x: Array) -> Array:
    """``opaque_ones`` (rows, *x.shape) that are not a broadcast, even for one body."""
    scale = jnp.arange(1, rows + 1, dtype=x.dtype)
    return opaque_ones(x[None] * scale.reshape(-1, *(1,) * x.ndim))


@unpaired.defjvp
def _unpaired_rule(primals, tangents):
    a, b, series, one = primals
    da, db, dh = *tangents[:2], tangents[2].h
    both, weights = _both(a, b), _for_both(series.weights)
    h_weights, first = _for_both(series.derivatives), _derivative_of(weights)
    value, derivative = _polynomial(both, weights), _polynomial(both, first)
    second_derivative = derivative + both * _polynomial(both, _derivative_of(first))
    by_h = (
        _polynomial(both, h_weights),
        both * _polynomial(both, _derivative_of(h_weights)),
    )
    parts = staged(
        (value, derivative, both * derivative, second_derivative, *by_h), rows_of_ones(2, one)
    )
    (x, x1, dx, dx1, xh, dxh), (y, y1, dy, dy1, yh, dyh) = (
        [v.at(k) for v in parts] for k in range(2)
    )
    of_value = x1 * y, x * y1, xh * y + x * yh
    of_twist = (
        dx1 * y - x1 * dy,
        dx * y1 - x * dy1,
        dxh * y + dx * yh - xh * dy - x * dyh,
    )
    of_value, of_twist = staged((of_value, of_twist), one)
    return unpaired(*primals), tuple(p * da + q * db + r * dh for p, q, r in (of_value, of_twist))


@jax.custom_jvp
def _descend(e: Complex, partner: Complex, c: Curve, one: Array) -> Complex:
    """Product over n >= 1 of ((1 + partner_n)/(1 + e_n))^(1/2^(n+1)) along Landen's descent.

    ``e`` and ``partner`` are those of n = 1. The last level, where the square is below 1e-20, is
    summed in closed form, so that e may be large.
    """
    # From the last level to the first: each takes the square root of the product of later levels.
    # These roots are on the principal branch; a single root of the whole product would not be.
    *levels, (_, _, roots) = _levels(e, partner, c, one)
    total = (1 + roots[1]) * (1 + roots[0]).inverse
    total = staged((levels[1][2] * (total * total)).root, one)
    total = staged((levels[0][2] * total).root, one)
    return total.root


def _levels(e: Complex, partner: Complex, c: Curve, one: Array):
    """e, its partner and (1 + partner)/(1 + e) of each level; for the last level the roots of 1 + e
    and 1 + partner instead of the quotient."""
    levels = []
    for step in c.steps[1:]:
        ratio = staged((1 + partner) * (1 + e).inverse, one)
        levels.append((e, partner, ratio))
        e, partner = e * e * ratio * step, partner * partner * ratio.inverse * step
        e, partner = staged((e, partner), one)
    return *levels, (e, partner, staged(((1 + e).root, (1 + partner).root), one))


@_descend.defjvp
def _descend_rule(primals, tangents):
    e, partner, c, one = primals
    de, dpartner, dc, _ = tangents
    *levels, (e, partner, (root_e, root_partner)) = _levels(e, partner, c, one)
    # Partial derivatives of the logarithm, from the last level back to the first.
    by_e = (root_e * (1 + root_e)).inverse * (-1 / 8)
    by_partner = (root_partner * (1 + root_partner)).inverse * (1 / 8)
    by_e, by_partner = staged((by_e, by_partner), one)
    by_square = Complex(jnp.zeros_like(one), jnp.zeros_like(one))
    for k in (1, 0):
        by_log_e, by_log_partner = by_e * e, by_partner * partner
        by_square = by_square + (by_log_e + by_log_partner) * (
            c.step_derivatives[k + 1] / c.steps[k + 1]
        )
        log_share = by_log_e - by_log_partner + 1 / 4 / 2**k
        e, partner, ratio = levels[k]
        step = c.steps[k + 1]
        by_e = by_e * (e * ratio) * (2 * step) - log_share * (1 + e).inverse
        by_partner = by_partner * (partner * ratio.inverse) * (2 * step)
        by_partner = by_partner + log_share * (1 + partner).inverse
        by_e, by_partner = staged((by_e, by_partner), one)
    value = _descend(*primals)
    by_e, by_partner, by_square = staged((by_e * value, by_partner * value, by_square * value), one)
    return value, by_e * de + by_partner * dpartner + by_square * dc.square


def point(
    factor_e: Complex, partner_factor: Complex, scale_of_squares: Array, c: Curve, one: Array
):
    """Coordinate E of a point on the curve and h/E, without constant factors.

    ``factor_e``, ``partner_factor``: exponentials of twice the amplitude (times lambda, after half
    of the first Landen step), whose squares times ``scale_of_squares`` are those of the next level.
    """
    factor = staged(
        _descend(
            factor_e * factor_e * scale_of_squares,
            partner_factor * partner_factor * scale_of_squares,
            c,
            one,
        ),
        one,
    )
    return factor_e * factor, partner_factor * factor.inverse
