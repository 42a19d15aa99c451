"""The tangent of the exact free motion: how L(t) and the attitude answer to what they start from;
(15) and (16) of docs/free_motion.md.

The momentum is an algebraic function of its initial value and of S = sn/omega_p, C = cn, N = dn,
which depend on x = B r and y = A p alone; their derivatives need the integrals of S^2 and
(S/N)^2. Products of inertia turn the principal axes: the quotients by differences of inverse
moments are carried out on paper, so that nothing is divided by a difference that may vanish.

The attitude follows from two conserved quantities. With e the variation of the attitude (a
rotation vector in body axes), R e x L = delta(ell) - R delta L is known because ell = R L is
constant, and e . L = t delta E + 1/2 delta D : integral of L L^T, because the rate of e . L is
omega . delta L + L . delta D L, of which omega . delta L + 1/2 L . delta D L is the constant
delta E (D: inverse inertia tensor, E: energy).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms.free._motion import Swing
from polhode._closed_forms.free._roles import Triple
from polhode._hamiltonian import triple

Scalars = Float[Array, "*b"]


class Change(NamedTuple):
    """Variation of the start, axes in their roles, scaled units."""

    momentum: Triple
    inverse: Triple  # of the inverse moments
    crossed: Triple  # of the inverse tensor's entries 12, 13, 23


class Partials(NamedTuple):
    """Derivatives of S, C, N with respect to x, at fixed z = x - y, and to z."""

    S: tuple[Scalars, Scalars]
    C: tuple[Scalars, Scalars]
    N: tuple[Scalars, Scalars]

    def along(self, dx: Scalars, dz: Scalars) -> Triple:
        return triple(fx * dx + fz * dz for fx, fz in self)


def partials(x: Scalars, y: Scalars, functions: Triple, first: Scalars, second: Scalars):
    """(15): derivatives of S, C, N from the integrals of S^2 and (S/N)^2."""
    S, C, N = functions
    square = S * S
    # z is what vanishes on the separatrix, where ``second`` grows without bound.
    return Partials(
        ((C * N * first - square * S) / 2, C * N * second / 2),
        (-S * (S * C + x * N * first) / 2, -x * S * N * second / 2),
        (-S * (S * N + y * C * first) / 2, S * (S / N - y * C * second) / 2),
    )


class Setting(NamedTuple):
    """What the integrals of products of momenta depend on."""

    momentum: Triple
    p: Scalars
    r: Scalars
    s: Scalars
    A: Scalars
    B: Scalars


def _quotients(at: Setting, functions: Triple):
    """Delta, (1 - C)/r, (1 - N)/p and (CN - Delta)/s, none with a vanishing divisor."""
    S, C, N = functions
    (l1, _, l3), p, r, s, A, B = at
    square = S * S
    tail = r * s * (l3 * l3) * square
    delta = C * C + tail
    ahead = C >= 0
    up = jnp.where(ahead, square * B / jnp.where(ahead, 1 + C, 1), (1 - C) / jnp.where(ahead, 1, r))
    tilt = square * A / (1 + N)
    near = square * (p * (l1 * l1) * tail - delta * (p * l1 * l1 + r * l3 * l3))
    product = C * N
    skew = jnp.where(
        ahead,
        near / jnp.where(ahead, product + delta, 1),
        (product - delta) / jnp.where(ahead, 1, s),
    )
    return delta, up, tilt, skew


def products_of_momenta(at: Setting, functions: Triple, hand: Scalars) -> Triple:
    """Integrals of L1 L2, L1 L3, L2 L3 over the time from the start."""
    S, C, N = functions
    l1, l2, l3 = at.momentum
    delta, _, _, skew = _quotients(at, functions)
    square = S * S
    # (1 - C)/r - p (l2 S)^2 and (1 - N)/p - r (l2 S)^2: on a spin about the middle axis the second
    # term takes all but the last digits of the first.
    ahead = C >= 0
    up = (at.s * l3 * l3 - at.p * l2 * l2 * C) * jnp.where(
        ahead,
        square / jnp.where(ahead, 1 + C, 1),
        (1 - C) / jnp.where(ahead, 1, at.r * at.B),
    )
    tilt = (at.s * l1 * l1 - at.r * l2 * l2 * N) * square / (1 + N)
    return (
        (l1 * l2 * S * C + hand * l3 * tilt) / delta,
        (l1 * l3 * S + hand * l2 * skew) / delta,
        (l2 * l3 * S * N + hand * l1 * up) / delta,
    )


def _crossed(at: Setting, functions: Triple, now: Triple, by: Partials, hand, sense) -> tuple:
    """Answers of L(t) to the entries 12, 13, 23 of the inverse tensor."""
    S, C, N = functions
    (l1, l2, l3), p, r, s, *_ = at
    n1, n2, n3 = now
    delta, up, tilt, _ = _quotients(at, functions)
    square = S * S
    uneven = s > 0
    span = jnp.where(uneven, s, 1)
    ahead = C >= 0
    # (p C + r N) / s, whose derivative in a nearly spherical body is not to be divided by s.
    share = p * r / span * square * (at.B / jnp.where(ahead, 1 + C, 1) + at.A / (1 + N))
    blend = jnp.where(ahead, 1 - share, (p * C + r * N) / span)
    split = jnp.where(
        ahead,
        -square * (r * l3 * l3 - p * l1 * l1) / jnp.where(ahead, C + N, 1),
        (C - N) / span,
    )

    def answer(product, dd, heads):
        dS, dC, dN = by.along(2 * r * product, 2 * s * product)
        dd = dd - 2 * p * r * l2 * l2 * S * dS
        rest = (
            -l1 * dC + hand * r * l2 * l3 * (dS * N + S * dN) + n1 * dd,
            -l2 * (dC * N + C * dN) - hand * s * l1 * l3 * dS + n2 * dd,
            -l3 * dN + hand * p * l1 * l2 * (dS * C + S * dC) + n3 * dd,
        )
        return tuple(sense * (a + b) / delta for a, b in zip(heads, rest, strict=True))

    q12, q13, q23 = l1 * l2, l1 * l3, l2 * l3
    swap = 1 + r * tilt
    turn = 1 + p * up
    return (
        answer(q12, -2 * r * q12 * square, (
            l2 * C * tilt - hand * q13 * S * swap,
            l1 * C * tilt + hand * q23 * S * swap,
            hand * (l1 * l1 - l2 * l2) * S * C,
        )),
        answer(q13, jnp.zeros_like(S), (
            l3 * split + hand * q12 * S * blend,
            -hand * (l1 * l1 - l3 * l3) * S,
            l1 * split - hand * q23 * S * blend,
        )),
        answer(q23, 2 * p * q23 * square, (
            hand * (l2 * l2 - l3 * l3) * S * N,
            -l3 * N * up - hand * q12 * S * turn,
            -l2 * N * up + hand * q13 * S * turn,
        )),
    )  # fmt: skip


def change_of_invariants(swing: Swing, change: Change):
    """Variations of r, s, p, A, B and B r - A p, but for the tensor's entries 12, 13, 23."""
    (l1, l2, l3), (e1, e2, e3) = swing.momentum, change.inverse
    g1, g2, g3 = change.momentum
    dp, dr, ds = (swing.sense * d for d in (e1 - e2, e2 - e3, e1 - e3))
    dA = 2 * (l1 * g1 * swing.s + l2 * g2 * swing.r) + l1 * l1 * ds + l2 * l2 * dr
    dB = 2 * (l2 * g2 * swing.p + l3 * g3 * swing.s) + l2 * l2 * dp + l3 * l3 * ds
    gap = swing.r * l3 * l3 - swing.p * l1 * l1
    dgap = 2 * (l3 * g3 * swing.r - l1 * g1 * swing.p) + l3 * l3 * dr - l1 * l1 * dp
    return dr, ds, dp, dA, dB, gap * ds + swing.s * dgap


def momentum_tangent(
    swing: Swing, functions: Triple, now: Triple, by: Partials, change: Change, stage
) -> Triple:
    """Variation of L(t) - L(0)."""
    hand = swing.sense * swing.parity
    at = Setting(swing.momentum, swing.p, swing.r, swing.s, swing.A, swing.B)
    dr, ds, dp, dA, dB, dz = stage(change_of_invariants(swing, change))
    moved = stage(by.along(dB * swing.r + swing.B * dr, dz))
    (j12, j13, j23), (k12, k13, k23) = jax.jvp(
        lambda a, f: products_of_momenta(a, f, hand),
        (at, functions),
        (Setting(change.momentum, dp, dr, ds, dA, dB), moved),
    )
    straight = (
        -hand * (dr * j23 + swing.r * k23),
        hand * (ds * j13 + swing.s * k13),
        -hand * (dp * j12 + swing.p * k12),
    )
    if change.crossed is None:
        return straight
    answers = _crossed(at, functions, now, by, hand, swing.sense)
    return tuple(
        total + sum(a[k] * h for a, h in zip(answers, change.crossed, strict=True))
        for k, total in enumerate(straight)
    )


# Squares of the phase below which the series serves: its next term is then below the last bit, and
# the quotient of differences loses no more than a factor of sixty.
_SHORT = 2.0**-12


def _spread(at: Setting, S: Scalars, first: Scalars, t: Scalars, short, span):
    """((l2)^2 (t - S) - A B first) / s: a series where s may vanish."""
    (l1, l2, l3), p, r, _, A, B = at
    x, y = B * r, A * p
    b, a = B * l1 * l1, A * l3 * l3
    square = t * t
    series = b + a
    series = series - square / 20 * ((x + 7 * y) * b + (7 * x + y) * a)
    cross = 104 * x * y
    terms = (x * x + cross + 31 * y * y) * b + (31 * x * x + cross + y * y) * a
    series = series + square * square / 840 * terms
    series = -t * square / 6 * series
    return jnp.where(short, series, (l2 * l2 * (t - S) - A * B * first) / span)


def squares_of_momenta(swing, functions: Triple, now: Triple, first: Scalars, t: Scalars):
    """Integrals of L1^2, L2^2, L3^2 over the time from the start."""
    S, _, _ = functions
    l1, l2, l3 = swing.momentum
    hand = swing.sense * swing.parity
    at = Setting(swing.momentum, swing.p, swing.r, swing.s, swing.A, swing.B)
    middle = swing.A * swing.B * first + S * l2 * now[1]
    # (l2^2 t - middle) / s, of which the change of L2 is a part.
    short = (swing.B * swing.r + swing.A * swing.p) * t * t < _SHORT
    span = jnp.where(short, 1, swing.s)
    delta, _, _, skew = _quotients(at, functions)
    less = _spread(at, S, first, t, short, span) - l2 * S * (
        (l2 * skew + hand * l1 * l3 * S) / delta
    )
    return l1 * l1 * t + swing.r * less, middle, l3 * l3 * t + swing.p * less
