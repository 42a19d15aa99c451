"""Theta functions in Tate's form: the infinite product (a; h) = prod over n >= 0 of (1 - h^n a).

theta1(z) with nome q is, up to constants and a factor exp(-iz), the product (a; h)(h/a; h) with
a = exp(2iz), h = q^2 (Jacobi's triple product, NIST DLMF 20.5.1). Written so it depends on a and
h/a, both of which are regular where the amplitude of a motion vanishes.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from polhode.elliptic._nome import nome
from polhode.tops._complex import Complex, settle

_TERMS = 6


class Curve(NamedTuple):
    """One elliptic curve: ``h`` = q^2 <= exp(-2 pi), and what the map of its points needs.

    ``square`` is lambda^2, lambda the modulus after one descending Landen step; ``steps`` are
    lambda'/lambda^2 of the next ones; ``per`` is q/lambda; ``stretch`` is theta3(h)^2;
    ``weights`` are Euler's coefficients of (a; h).
    """

    h: Array
    square: Array
    steps: tuple[Array, Array, Array]
    per: Array
    stretch: Array
    weights: tuple[Array, ...]


def curve(square: Array) -> Curve:
    """The curve of a squared Landen modulus in [0, 0.03]."""
    constants = nome(square, 1 - square)
    h = constants.q
    weights, power = [jnp.ones_like(h)], jnp.ones_like(h)
    for _ in range(_TERMS):
        weights.append(-weights[-1] * power / (1 - power * h))
        power = power * h
    steps, modulus = [], square
    for _ in range(3):
        steps.append(1 / (1 + jnp.sqrt(1 - modulus)) ** 2)
        modulus = (steps[-1] * modulus) ** 2
    root, stretch = jnp.sqrt(constants.per_x), 1 + constants.excess
    return Curve(h, square, tuple(steps), root, stretch, tuple(weights))


def product(a: Complex, weights: tuple[Array, ...]) -> tuple[Complex, Complex]:
    """(a; h) and a d/da (a; h) for |a| <= 1 (Euler's series, DLMF 17.2.37)."""
    value = a * weights[-1] + weights[-2]
    slope = a * (_TERMS * weights[-1]) + (_TERMS - 1) * weights[-2]
    for k in range(_TERMS - 2, -1, -1):
        value = value * a + weights[k]
        slope = slope * a + k * weights[k]
    return value, slope


def log_slope(a: Complex, weights: tuple[Array, ...]) -> Complex:
    """-a d/da log (a; h)."""
    value, slope = product(a, weights)
    return -slope * value.inverse


def _descend(e: Complex, partner: Complex, c: Curve, one: Array) -> Complex:
    """Product over n >= 1 of ((1 + partner_n)/(1 + e_n))^(1/2^(n+1)) along Landen's descent.

    ``e`` and ``partner`` are those of n = 1. The last level, where the square is below 1e-20, is
    summed in closed form, so that e may be large.
    """
    ratios = []
    for step in c.steps[1:]:
        ratio = settle((1 + partner) * (1 + e).inverse, one)
        e, partner = e * e * ratio * step, partner * partner * ratio.inverse * step
        e, partner = settle((e, partner), one)
        ratios.append(ratio)
    roots = settle(((1 + partner).root, (1 + e).root), one)
    total = (1 + roots[0]) * (1 + roots[1]).inverse
    total = settle((ratios[1] * (total * total)).root, one)
    total = settle((ratios[0] * total).root, one)
    return total.root


class Place(NamedTuple):
    """A point before the descent: ``lead``/``rest`` times/over the product, and e, its partner."""

    lead: Complex
    rest: Complex
    e: Complex
    partner: Complex


def from_pole(e: Complex, partner: Complex, c: Curve) -> Place:
    """A point given by lambda exp(2i am) and lambda exp(-2i am), am its amplitude.

    Regular for lambda -> 0; not near e = -1, the root opposite the pole.
    """
    ratio = (1 + partner) * (1 + e).inverse
    half = ratio.root
    return Place(
        e * half * c.per,
        partner * half.inverse * c.per,
        e * e * ratio * c.steps[0],
        partner * partner * ratio.inverse * c.steps[0],
    )


def from_opposite(z: Complex, inverse: Complex, c: Curve) -> Place:
    """A point given by z = exp(i am'), 1/z: am' the amplitude, after one Landen step, counted from
    the root opposite the pole."""
    first = c.square * c.steps[0]
    return Place(-z, -inverse * c.h, z * z * first, inverse * inverse * first)


def point(place: Place, c: Curve, one: Array) -> tuple[Complex, Complex]:
    """Multiplicative coordinate E of a point on the curve, and h/E."""
    turn = settle(_descend(place.e, place.partner, c, one), one)
    return place.lead * turn, place.rest * turn.inverse
