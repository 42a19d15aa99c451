"""Free motion by algebra alone: the discrete Moser-Veselov step with moments made for its width.

One step turns a body that carries the momentum L by the unit quaternion (e_0, e), where

    h L_1 / 2 = J_1 e_0 e_1 + (J_3 - J_2) e_2 e_3   and cyclically.

With J the moments of inertia it is of order 2. It keeps energy and |L| whatever the moments, so it
moves along the right curve at a slightly wrong pace; moments 1/J_i = (1 + s)/I_i + d, with s and d
polynomials of the energy and of |L|^2, set the pace right to order 4, 6, 8 or 10.

E. Hairer, G. Vilmart, J. Phys. A: Math. Gen. 39 (2006) 13225.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._hamiltonian import cross, dot

ORDERS = (2, 4, 6, 8, 10)

_SCALE = {
    (1, 0): "1/6 010",
    (1, 1): "-1/3 100",
    (2, 0): "1/30 020  -1/10 101",
    (2, 1): "-1/30 110  2/15 001",
    (2, 2): "1/30 200  -1/60 010",
    (3, 0): "17/2520 030  -11/420 111  5/126 002",
    (3, 1): "-1/70 120  11/210 201  -1/84 011",
    (3, 2): "1/420 210  41/2520 020  -53/630 101",
    (3, 3): "-1/630 300  1/630 110  1/35 001",
    (4, 0): "31/22680 040  -19/2520 121  1/120 202  97/15120 012",
    (4, 1): "-11/3240 130  17/1260 211  47/7560 021  -47/945 102",
    (4, 2): "13/3780 220  1/2520 030  -17/1260 301  1/252 111  53/1260 002",
    (4, 3): "-1/11340 310  -11/1890 120  23/945 201  -23/1260 011",
    (4, 4): "1/22680 400  -1/15120 210  17/5040 020  -3/280 101",
}  # fmt: skip
"""The polynomial s: (k, m) names the factor of h^2k H^m C^(k - m), H the energy, C = |L|^2 / 2.

"1/30 020  -1/10 101" means e_2^2 / 30 - e_1 e_3 / 10, with e_1, e_2, e_3 the elementary symmetric
polynomials of the 1/I_i. Each is the series of the exact motion's step put into the equations above
and solved for J, in rational numbers; the terms with k = 1 stand in the paper.
"""

_SHIFT = {
    (1, 0): "-1/3 001",
    (1, 1): "1/6 010",
    (2, 0): "-1/60 011",
    (2, 1): "-1/60 020  2/15 101",
    (2, 2): "-1/60 110  -1/10 001",
    (3, 0): "-19/2520 021  1/35 102",
    (3, 1): "1/1260 030  -1/1260 111  -22/315 002",
    (3, 2): "13/2520 120  -8/315 201  11/252 011",
    (3, 3): "1/1260 210  -13/1260 020  1/42 101",
    (4, 0): "-61/45360 031  3/560 112  -61/4536 003",
    (4, 1): "-1/45360 040  37/7560 121  -2/105 202  19/1260 012",
    (4, 2): "-1/1512 130  19/7560 211  -19/1080 021  89/1890 102",
    (4, 3): "-1/1512 220  97/22680 030  8/2835 301  -23/1890 111  -1/35 002",
    (4, 4): "-1/45360 310  -1/7560 120  -1/360 201  17/1680 011",
}  # fmt: skip
"""The polynomial d, likewise."""


def _polynomials(table: Mapping[tuple[int, int], str], symmetric, order: int) -> list[list[Array]]:
    """Coefficients of H^m C^j for one body: a list over m of lists over j, of one order."""
    found = [[jnp.zeros_like(symmetric[0])] * (order // 2 - m) for m in range(order // 2)]
    for (k, m), text in table.items():
        if 2 * k < order:
            words = text.split()
            total = jnp.zeros_like(symmetric[0])
            for share, powers in zip(words[::2], words[1::2]):
                term = float(Fraction(share))
                for base, power in zip(symmetric, powers):
                    term = term * base ** int(power)
                total = total + term
            found[m][k - m] = total
    return found


def _value(polynomials: list[list[Array]], h: Array, c: Array) -> Array:
    """Horner's rule in both variables; there is no constant term."""

    def along(coefficients):
        total = coefficients[-1]
        for x in reversed(coefficients[:-1]):
            total = total * c + x
        return total

    total = jnp.zeros_like(h)
    for m in reversed(range(1, len(polynomials))):
        inner = along(polynomials[m])
        total = inner if m + 1 == len(polynomials) else total * h + inner
    return total * h + along(polynomials[0][1:]) * c if len(polynomials) > 1 else total


class Prepared(NamedTuple):
    """What the step needs of the bodies: the largest 1/I_i, all 1/I_i in units of it, and the
    coefficients of both polynomials in these units, which keep any body's numbers near one."""

    unit: Array
    inverse: tuple[Array, ...]
    scale: list[list[Array]]
    shift: list[list[Array]]


def prepare(inverse: Sequence[Array], order: int) -> Prepared:
    """``inverse``: 1/I_i [1/(kg m^2)], three arrays of one shape."""
    unit = jnp.maximum(jnp.maximum(inverse[0], inverse[1]), inverse[2])
    a, b, c = inverse = tuple(x / unit for x in inverse)
    symmetric = (a + b + c, a * b + b * c + c * a, a * b * c)
    tables = (_polynomials(table, symmetric, order) for table in (_SCALE, _SHIFT))
    return Prepared(unit, inverse, *tables)


_SWEEPS, _NEWTON = 2, 3
"""Fixed-point sweeps and Newton steps: to rounding up to 1 rad, where the series ends."""

_WIDEST, _LOST = 1.5, 1e-3
"""Angle [rad] of the widest turn, far beyond what the series is good for, and the last Newton step
beyond which the equations have no solution near."""


def paced(prepared: Prepared, span: Array, momentum: Sequence[Array]) -> tuple[list[Array], ...]:
    """Rates that momenta alone would give, times the time ``span``, and the 1/J_i for that time.

    Both in units of ``prepared``; momentum in body components.
    """
    angle = [span * prepared.unit * x for x in momentum]
    x, y, z = (x * x for x in angle)
    a, b, c = prepared.inverse
    half = (a * x + b * y + c * z) / 2, (x + y + z) / 2
    scale, shift = (_value(p, *half) for p in (prepared.scale, prepared.shift))
    shift = jnp.where(a * a * x + b * b * y + c * c * z < _WIDEST**2, shift, jnp.nan)
    return angle, [i + (i * scale + shift) for i in prepared.inverse]


def tangents(angle: Sequence[Array], inverse: Sequence[Array]) -> tuple[list[Array], Array]:
    """The e_i / e_0 of the quaternion that the body turns by, and 1 / e_0^2.

    NaN for a body that would turn too far, by more than 1.5 rad.
    """
    each = 1 / (inverse[0] * inverse[1] * inverse[2])
    u = [i * x / 2 for i, x in zip(inverse, angle)]
    k = [inverse[i] ** 2 * (inverse[i - 2] - inverse[i - 1]) * each for i in range(3)]
    f, last = _solved(u, k)
    return f, jnp.where(last < _LOST**2, 1 + dot(f, f), jnp.nan)


@jax.custom_jvp
def _solved(u, k):
    """f_1 = (1 + f^2) u_1 - k_1 f_2 f_3 and cyclically; and the square of the last correction."""
    f = u
    for _ in range(_SWEEPS):
        f = _image(u, k, f)
    for _ in range(_NEWTON):
        step = _against_slope(u, k, f, [x - y for x, y in zip(f, _image(u, k, f))])
        f = [x - y for x, y in zip(f, step)]
    return f, dot(step, step)


@_solved.defjvp
def _solved_jvp(given, changes):
    """The equations' own slope: that of the iterations would be a far larger program."""
    (u, k), (du, dk) = given, changes
    f, last = _solved(u, k)
    length = 1 + dot(f, f)
    moved = [length * du[i] - dk[i] * (f[i - 2] * f[i - 1]) for i in range(3)]
    return (f, last), (_against_slope(u, k, f, moved), jnp.zeros_like(last))


def _image(u, k, f):
    length = 1 + dot(f, f)
    return [length * u[i] - k[i] * (f[i - 2] * f[i - 1]) for i in range(3)]


def _against_slope(u, k, f, gap):
    """x with x - (slope of the image at f) x = gap."""
    rows = [[-2 * u[i] * x for x in f] for i in range(3)]
    for i in range(3):
        rows[i][i] = 1 + rows[i][i]
        rows[i][i - 2] = rows[i][i - 2] + k[i] * f[i - 1]
        rows[i][i - 1] = rows[i][i - 1] + k[i] * f[i - 2]
    crosses = [cross(rows[i - 2], rows[i - 1]) for i in range(3)]
    each = 1 / dot(rows[0], crosses[0])
    return [each * dot(gap, column) for column in zip(*crosses)]
