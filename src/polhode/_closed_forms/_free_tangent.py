"""The tangent of the exact free motion: how L(t) and the attitude depend on the initial state;
(14) to (16) of docs/free_motion.md.

The momentum is an algebraic function of its initial value and of S = sn/omega_p, C = cn, N = dn,
which depend on x = B r and y = A p alone; their derivatives need the integrals of S^2 and
(S/N)^2. Products of inertia rotate the principal axes: the divisions by differences of inverse
moments are carried out analytically, so that the code does not divide by differences that may
vanish.

The variation of the attitude follows from two conserved quantities. Let e be this variation (a
rotation vector in body axes), D the inverse inertia tensor and E the energy. Its part perpendicular
to L is given by R e x L = delta(ell) - R delta L, because ell = R L is constant. Its part along L
is e . L = t delta E + 1/2 delta D : integral of L L^T, because the rate of e . L is
omega . delta L + L . delta D L, where omega . delta L + 1/2 L . delta D L is the constant delta E.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms._arithmetic import deficit_per_parameter, nome_per_parameter, rd_series
from polhode._closed_forms._free_constants import Polhode, Triple, component_at, restore
from polhode._hamiltonian import cross, dot, triple

Scalars = Float[Array, "*b"]

_DUPLICATIONS = 14


def incomplete(S: Scalars, C: Scalars, N: Scalars, has_time_axis: bool) -> tuple[Scalars, Scalars]:
    """Integrals of S^2 and (S/N)^2 over less than half a turn, by Carlson's duplication.

    They are S^3/3 R_D(C^2, N^2, 1) and S^3/3 R_D(C^2, 1, N^2), which share their square roots.
    """

    def duplicate(_, carry):
        first, second, x, y, z, weight = carry
        return halve(first, second, x, y, z, weight, jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z))

    def halve(first, second, x, y, z, weight, u, v, w):
        growth = u * v + v * w + w * u
        first = first + weight / (w * (z + growth))
        second = second + weight / (v * (y + growth))
        return first, second, (x + growth) / 4, (y + growth) / 4, (z + growth) / 4, weight / 4

    zero, one = jnp.zeros_like(N), jnp.ones_like(N)
    # The first roots are C and N themselves, which are smooth where the root of C^2 is not.
    carry = halve(zero, zero, C * C, N * N, one, jnp.ones((), N.dtype), C, N, one)
    if has_time_axis:
        # With many times per body several loops use the result, and XLA would repeat all of it in
        # each. As a loop it is computed once, and compiles in half of the time.
        carry = jax.lax.fori_loop(1, _DUPLICATIONS, duplicate, carry)
    else:
        for k in range(1, _DUPLICATIONS):
            carry = duplicate(k, carry)
    first, second, x, y, z, weight = carry
    S_cubed = S * S * S
    first, second = (
        first + weight / 3 * rd_series(x, y, z),
        second + weight / 3 * rd_series(x, z, y),
    )
    return S_cubed * first, S_cubed * second


def complete(polhode: Polhode) -> tuple[Scalars, Scalars]:
    """The same integrals over a quarter of the momentum's period."""
    agm_and_nome = polhode.agm, polhode.log_nome, polhode.inverse_rate
    return quarter_turn(
        polhode.circular, polhode.on_separatrix, polhode.m, polhode.m1, *agm_and_nome
    )


def quarter_turn(circular, on_separatrix, m, m1, agm, log_nome, inverse_rate):
    """The same from the parameter, its complement and the results of ``agm_and_nome``."""
    square = jnp.where(circular, m, m1)
    other = jnp.sqrt(jnp.where(circular, m1, m))
    per_square = nome_per_parameter(square, jnp.sqrt(other))
    deficit = deficit_per_parameter(square * per_square, per_square, 1 / agm, jnp.sqrt(other / agm))
    quarter = jnp.where(circular, math.pi, log_nome) / (2 * agm)
    m = jnp.where(circular, 1, m)
    first = jnp.where(circular, quarter * deficit, (quarter * (1 - m1 * deficit) - agm) / m)
    second = jnp.where(circular, quarter * (1 - deficit), (agm + quarter * m1 * (deficit - 1)) / m)
    scale = inverse_rate * agm
    cube = scale * scale * scale
    cube = jnp.where(on_separatrix, 0, cube)
    return first * cube, second * cube / jnp.where(on_separatrix, 1, m1)


def second_kind(
    polhode: Polhode, half_turns: Scalars, reduced: Triple, has_time_axis: bool
) -> tuple[Scalars, Scalars]:
    """Integrals of S^2 and (S/N)^2 from the start; ``reduced``: S, C, N since the last half
    turn."""
    first, second = incomplete(*reduced, has_time_axis)
    turn_first, turn_second = complete(polhode)
    return first + 2 * half_turns * turn_first, second + 2 * half_turns * turn_second


class Variation(NamedTuple):
    """Variation of the initial momentum and the inverse tensor, along axes 1, 2, 3, in scaled
    units."""

    momentum: Triple
    inverse_moments: Triple  # of the inverse moments
    off_diagonal: Triple  # of the inverse tensor's entries 12, 13, 23


class Partials(NamedTuple):
    """Derivatives of S, C, N with respect to x at constant z = x - y, and with respect to z."""

    S: tuple[Scalars, Scalars]
    C: tuple[Scalars, Scalars]
    N: tuple[Scalars, Scalars]

    def along(self, dx: Scalars, dz: Scalars) -> Triple:
        return triple(fx * dx + fz * dz for fx, fz in self)


def partials(x: Scalars, y: Scalars, functions: Triple, first: Scalars, second: Scalars):
    """(15): derivatives of S, C, N from the integrals of S^2 and (S/N)^2."""
    S, C, N = functions
    square = S * S
    # By z, because z vanishes on the separatrix, where ``second`` grows without bound.
    return Partials(
        ((C * N * first - square * S) / 2, C * N * second / 2),
        (-S * (S * C + x * N * first) / 2, -x * S * N * second / 2),
        (-S * (S * N + y * C * first) / 2, S * (S / N - y * C * second) / 2),
    )


class Invariants(NamedTuple):
    """The quantities on which the integrals of products of momenta depend."""

    momentum: Triple
    p: Scalars
    r: Scalars
    s: Scalars
    A: Scalars
    B: Scalars


def _quotients(invariants: Invariants, functions: Triple):
    """Delta, (1 - C)/r, (1 - N)/p and (CN - Delta)/s, none with a vanishing divisor."""
    S, C, N = functions
    (l1, _, l3), p, r, s, A, B = invariants
    square = S * S
    tail = r * s * (l3 * l3) * square
    delta = C * C + tail
    # (1 - C)/r = B S^2/(1 + C) because 1 - C^2 = B r S^2: no divisor vanishes for C >= 0. If C is
    # negative r cannot be zero, and the plain quotient loses no digits.
    C_is_positive = C >= 0
    one_minus_C = jnp.where(
        C_is_positive,
        square * B / jnp.where(C_is_positive, 1 + C, 1),
        (1 - C) / jnp.where(C_is_positive, 1, r),
    )
    one_minus_N = square * A / (1 + N)
    skew_numerator = square * (p * (l1 * l1) * tail - delta * (p * l1 * l1 + r * l3 * l3))
    product = C * N
    product_less_delta = jnp.where(
        C_is_positive,
        skew_numerator / jnp.where(C_is_positive, product + delta, 1),
        (product - delta) / jnp.where(C_is_positive, 1, s),
    )
    return delta, one_minus_C, one_minus_N, product_less_delta


def products_of_momenta(invariants: Invariants, functions: Triple, sigma_pi: Scalars) -> Triple:
    """Integrals of L1 L2, L1 L3, L2 L3 over the time from the start."""
    S, C, N = functions
    l1, l2, l3 = invariants.momentum
    delta, _, _, product_less_delta = _quotients(invariants, functions)
    square = S * S
    # (1 - C)/r - p (l2 S)^2 and (1 - N)/p - r (l2 S)^2, rewritten: for a rotation about the
    # intermediate axis these differences cancel.
    C_is_positive = C >= 0
    one_minus_C = (invariants.s * l3 * l3 - invariants.p * l2 * l2 * C) * jnp.where(
        C_is_positive,
        square / jnp.where(C_is_positive, 1 + C, 1),
        (1 - C) / jnp.where(C_is_positive, 1, invariants.r * invariants.B),
    )
    one_minus_N = (invariants.s * l1 * l1 - invariants.r * l2 * l2 * N) * square / (1 + N)
    return (
        (l1 * l2 * S * C + sigma_pi * l3 * one_minus_N) / delta,
        (l1 * l3 * S + sigma_pi * l2 * product_less_delta) / delta,
        (l2 * l3 * S * N + sigma_pi * l1 * one_minus_C) / delta,
    )


def _off_diagonal_responses(
    invariants: Invariants, functions: Triple, momentum_at_t: Triple, by: Partials, sigma_pi, sense
) -> tuple:
    """Derivatives of L(t) by the entries 12, 13, 23 of the inverse tensor."""
    S, C, N = functions
    (l1, l2, l3), p, r, s, *_ = invariants
    n1, n2, n3 = momentum_at_t
    delta, one_minus_C, one_minus_N, _ = _quotients(invariants, functions)
    square = S * S
    aspherical = s > 0
    divisor = jnp.where(aspherical, s, 1)
    C_is_positive = C >= 0
    # (p C + r N) / s, without a division by s, which is small for a nearly spherical body.
    blend_share = (
        p
        * r
        / divisor
        * square
        * (invariants.B / jnp.where(C_is_positive, 1 + C, 1) + invariants.A / (1 + N))
    )
    blend = jnp.where(C_is_positive, 1 - blend_share, (p * C + r * N) / divisor)
    split = jnp.where(
        C_is_positive,
        -square * (r * l3 * l3 - p * l1 * l1) / jnp.where(C_is_positive, C + N, 1),
        (C - N) / divisor,
    )

    def response(product, dd, heads):
        dS, dC, dN = by.along(2 * r * product, 2 * s * product)
        dd = dd - 2 * p * r * l2 * l2 * S * dS
        terms = (
            -l1 * dC + sigma_pi * r * l2 * l3 * (dS * N + S * dN) + n1 * dd,
            -l2 * (dC * N + C * dN) - sigma_pi * s * l1 * l3 * dS + n2 * dd,
            -l3 * dN + sigma_pi * p * l1 * l2 * (dS * C + S * dC) + n3 * dd,
        )
        return tuple(sense * (a + b) / delta for a, b in zip(heads, terms, strict=True))

    q12, q13, q23 = l1 * l2, l1 * l3, l2 * l3
    swap = 1 + r * one_minus_N
    factor = 1 + p * one_minus_C
    return (
        response(
            q12,
            -2 * r * q12 * square,
            (
                l2 * C * one_minus_N - sigma_pi * q13 * S * swap,
                l1 * C * one_minus_N + sigma_pi * q23 * S * swap,
                sigma_pi * (l1 * l1 - l2 * l2) * S * C,
            ),
        ),
        response(
            q13,
            jnp.zeros_like(S),
            (
                l3 * split + sigma_pi * q12 * S * blend,
                -sigma_pi * (l1 * l1 - l3 * l3) * S,
                l1 * split - sigma_pi * q23 * S * blend,
            ),
        ),
        response(
            q23,
            2 * p * q23 * square,
            (
                sigma_pi * (l2 * l2 - l3 * l3) * S * N,
                -l3 * N * one_minus_C - sigma_pi * q12 * S * factor,
                -l2 * N * one_minus_C + sigma_pi * q13 * S * factor,
            ),
        ),
    )


def invariants_variation(polhode: Polhode, variation: Variation):
    """Variations of r, s, p, A, B and B r - A p, without those by entries 12, 13, 23 of the
    tensor."""
    (l1, l2, l3), (e1, e2, e3) = polhode.momentum, variation.inverse_moments
    g1, g2, g3 = variation.momentum
    dp, dr, ds = (polhode.sense * d for d in (e1 - e2, e2 - e3, e1 - e3))
    dA = 2 * (l1 * g1 * polhode.s + l2 * g2 * polhode.r) + l1 * l1 * ds + l2 * l2 * dr
    dB = 2 * (l2 * g2 * polhode.p + l3 * g3 * polhode.s) + l2 * l2 * dp + l3 * l3 * ds
    gap = polhode.r * l3 * l3 - polhode.p * l1 * l1
    dgap = 2 * (l3 * g3 * polhode.r - l1 * g1 * polhode.p) + l3 * l3 * dr - l1 * l1 * dp
    return dr, ds, dp, dA, dB, gap * ds + polhode.s * dgap


def momentum_tangent(
    polhode: Polhode,
    functions: Triple,
    momentum_at_t: Triple,
    by: Partials,
    variation: Variation,
    stage,
) -> Triple:
    """Variation of L(t) - L(0)."""
    sigma_pi = polhode.sense * polhode.parity
    invariants = Invariants(polhode.momentum, polhode.p, polhode.r, polhode.s, polhode.A, polhode.B)
    dr, ds, dp, dA, dB, dz = stage(invariants_variation(polhode, variation))
    functions_variation = stage(by.along(dB * polhode.r + polhode.B * dr, dz))
    (j12, j13, j23), (k12, k13, k23) = jax.jvp(
        lambda a, f: products_of_momenta(a, f, sigma_pi),
        (invariants, functions),
        (Invariants(variation.momentum, dp, dr, ds, dA, dB), functions_variation),
    )
    diagonal = (
        -sigma_pi * (dr * j23 + polhode.r * k23),
        sigma_pi * (ds * j13 + polhode.s * k13),
        -sigma_pi * (dp * j12 + polhode.p * k12),
    )
    if variation.off_diagonal is None:
        return diagonal
    responses = _off_diagonal_responses(
        invariants, functions, momentum_at_t, by, sigma_pi, polhode.sense
    )
    return tuple(
        total + sum(a[k] * h for a, h in zip(responses, variation.off_diagonal, strict=True))
        for k, total in enumerate(diagonal)
    )


# Square of the phase below which the series is used. Its next term is then below the last bit; for
# larger phases the error of the quotient of differences is at most sixty times rounding.
_SHORT = 2.0**-12


def _spread(invariants: Invariants, S: Scalars, first: Scalars, t: Scalars, is_short, divisor):
    """((l2)^2 (t - S) - A B first) / s; for short times, when s may vanish, by a series."""
    (l1, l2, l3), p, r, _, A, B = invariants
    x, y = B * r, A * p
    b, a = B * l1 * l1, A * l3 * l3
    square = t * t
    series = b + a
    series = series - square / 20 * ((x + 7 * y) * b + (7 * x + y) * a)
    cross = 104 * x * y
    terms = (x * x + cross + 31 * y * y) * b + (31 * x * x + cross + y * y) * a
    series = series + square * square / 840 * terms
    series = -t * square / 6 * series
    return jnp.where(is_short, series, (l2 * l2 * (t - S) - A * B * first) / divisor)


def squares_of_momenta(
    polhode, functions: Triple, momentum_at_t: Triple, first: Scalars, t: Scalars
):
    """Integrals of L1^2, L2^2, L3^2 over the time from the start."""
    S, _, _ = functions
    l1, l2, l3 = polhode.momentum
    sigma_pi = polhode.sense * polhode.parity
    invariants = Invariants(polhode.momentum, polhode.p, polhode.r, polhode.s, polhode.A, polhode.B)
    square_2 = polhode.A * polhode.B * first + S * l2 * momentum_at_t[1]
    # (l2^2 t - square_2) / s, which contains the change of L2
    is_short = (polhode.B * polhode.r + polhode.A * polhode.p) * t * t < _SHORT
    divisor = jnp.where(is_short, 1, polhode.s)
    delta, _, _, product_less_delta = _quotients(invariants, functions)
    l2_excess = _spread(invariants, S, first, t, is_short, divisor) - l2 * S * (
        (l2 * product_less_delta + sigma_pi * l1 * l3 * S) / delta
    )
    return l1 * l1 * t + polhode.r * l2_excess, square_2, l3 * l3 * t + polhode.p * l2_excess


Quadruple = tuple[Scalars, Scalars, Scalars, Scalars]


class Frame:
    """Transformation between x, y, z and axes 1, 2, 3; ``reflected``: between the latter and
    right-handed axes with a positive L3."""

    def __init__(self, polhode: Polhode):
        self.polhode = polhode
        facing = jnp.copysign(1, polhode.momentum[2])
        self.signs = (jnp.ones_like(facing), polhode.parity * facing, facing)
        self.index = (3 - polhode.axis_2 - polhode.axis_3, polhode.axis_2, polhode.axis_3)

    def to_roles(self, values: Triple) -> Triple:
        return triple(component_at(values, k) for k in self.index)

    def to_pairs(self, values: Triple) -> Triple:
        """Entries xy, xz, yz as entries 12, 13, 23."""
        i, j, k = self.index
        return triple(component_at(values, n - 1) for n in (i + j, i + k, j + k))

    def to_body(self, values: Triple) -> Triple:
        return restore(values, self.polhode.axis_2, self.polhode.axis_3)

    def reflected(self, values: Triple) -> Triple:
        return triple(e * x for e, x in zip(self.signs, values, strict=True))


def quaternion_product(a: Quadruple, b: Quadruple) -> Quadruple:
    v = cross(a[1:], b[1:])
    vector = triple(a[0] * b[k + 1] + a[k + 1] * b[0] + v[k] for k in range(3))
    return a[0] * b[0] - dot(a[1:], b[1:]), *vector


def apply_variation(variation: Variation, vector: Triple) -> Triple:
    """The variation of the inverse tensor times a vector."""
    a, b, c = vector
    diagonal_part = triple(e * x for e, x in zip(variation.inverse_moments, vector, strict=True))
    if variation.off_diagonal is None:
        return diagonal_part
    h12, h13, h23 = variation.off_diagonal
    return (
        diagonal_part[0] + h12 * b + h13 * c,
        diagonal_part[1] + h12 * a + h23 * c,
        diagonal_part[2] + h13 * a + h23 * b,
    )
