"""Derivatives of what the tangent of the free motion is made of: second derivatives pass here.

The constants of the motion are worked out by formulas made for rounding, with branches and
quotients of differences, whose chain rule is 0/0 in a symmetric body and on the separatrix. The
tangent uses their values alone. Here each value is given the derivative of a plain formula, which
is regular everywhere; nothing of it is evaluated unless the tangent is differentiated again.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms.free._flow import momentum_of
from polhode._closed_forms.free._frame import Frame, cross
from polhode._closed_forms.free._motion import Swing, means
from polhode._closed_forms.free._phase import parity
from polhode._closed_forms.free._roles import Triple
from polhode._closed_forms.free._second import incomplete, quarter_turn
from polhode._closed_forms.free._tangent import partials
from polhode._hamiltonian import triple
from polhode._kernels import over_gap

Scalars = Float[Array, "*b"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def carrying(formula, value, fixed, given):
    """``value``, with the derivative of ``formula(fixed, given)`` with respect to ``given``."""
    return value


@carrying.defjvp
def _carrying_rule(formula, primals, tangents):
    value, fixed, given = primals
    _, change = jax.jvp(lambda x: formula(fixed, x), (given,), (tangents[2],))
    return carrying(formula, value, fixed, given), change


def _start(swing: Swing, given):
    """Plain formulas of the constants in ``start_of``."""
    frame = Frame(swing)
    moments, omega = given
    pulse = jnp.where(swing.pulse > 0, swing.pulse, 1)
    i = i1, i2, i3 = tuple(x / swing.heft for x in frame.to_roles(moments))
    w = tuple(x / pulse for x in frame.to_roles(omega))
    d = d1, d2, d3 = tuple(1 / x for x in i)
    momentum = l1, l2, l3 = tuple(x * y for x, y in zip(i, w, strict=True))
    p = swing.sense * (i2 - i1) * d1 * d2
    r = swing.sense * (i3 - i2) * d2 * d3
    s = swing.sense * (i3 - i1) * d1 * d3
    return momentum, d, i, p, r, s, s * l1 * l1 + r * l2 * l2, p * l2 * l2 + s * l3 * l3


def start_of(swing: Swing, moments: Triple, omega: Triple) -> Swing:
    """The constants that stand in the tangent, with derivatives by moments and initial rates."""
    value = swing.momentum, swing.inverse, swing.moments
    value = (*value, swing.p, swing.r, swing.s, swing.A, swing.B)
    momentum, inverse, moments, p, r, s, A, B = carrying(_start, value, swing, (moments, omega))
    return swing._replace(
        momentum=momentum, inverse=inverse, moments=moments, p=p, r=r, s=s, A=A, B=B
    )


def _now(swing: Swing, given):
    start, p, r, s, functions = given
    return momentum_of(swing._replace(momentum=start, p=p, r=r, s=s), functions)


def momentum_at(swing: Swing, functions: Triple, now: Triple) -> Triple:
    """The momentum at time t, with its derivative by the start and by S, C, N."""
    given = (swing.momentum, swing.p, swing.r, swing.s, functions)
    return carrying(_now, now, swing, given)


def _difference(_, given):
    x, y = given
    return x - y


def difference(swing: Swing, x: Scalars, y: Scalars) -> Scalars:
    """B r - A p, exact where it vanishes on the separatrix."""
    return carrying(_difference, swing.m1 * x, (), (x, y))


def _quarter(circular, endless, x: Scalars, z: Scalars):
    moving = x > 0
    x, z = jnp.where(moving, x, 1), jnp.where(moving, z, 1)
    m1 = z / x
    m, one = 1 - m1, jnp.ones_like(x)
    mean, _, log_nome, rate = means(circular, endless, x, m, m1, one)
    return quarter_turn(circular, endless, m, m1, mean, log_nome, 1 / rate)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def functions_of(many: bool, value, fixed, x: Scalars, z: Scalars, t: Scalars):
    """``value``: S, C, N and the integrals of S^2 and (S/N)^2; with their derivatives.

    ``fixed``: the swing and its half turns so far; ``x`` = B r, ``z`` = B r - A p.
    """
    return value


@functions_of.defjvp
def _functions_rule(many, primals, tangents):
    value, fixed, x, z, t = primals
    _, _, dx, dz, dt = tangents
    value = functions_of(many, value, fixed, x, z, t)
    swing, whole = fixed
    S, C, N, first, second = value
    y = carrying(_difference, swing.A * swing.p, (), (x, z))
    dS, dC, dN = partials(x, y, (S, C, N), first, second).along(dx, dz)
    dS, dC, dN = dS + C * N * dt, dC - x * S * N * dt, dN - y * S * C * dt
    sign = parity(whole)
    _, change = jax.jvp(
        lambda s, c, n: incomplete(s, c, n, many),
        (sign * S, sign * C, N),
        (sign * dS, sign * dC, dN),
    )
    _, turn = jax.jvp(functools.partial(_quarter, swing.circular, swing.endless), (x, z), (dx, dz))
    parts = tuple(
        a + jnp.where(whole == 0, 0, 2 * whole * b) for a, b in zip(change, turn, strict=True)
    )
    return value, (dS, dC, dN, *parts)


def _axes(_, given) -> Triple:
    """Turn of the principal axes that entries xy, xz, yz of the tensor make."""
    (a, b, c), (xy, xz, yz) = given
    return over_gap(yz, b, c), over_gap(xz, c, a), over_gap(xy, a, b)


def turn_of_axes(given, dm, dp, dw):
    """Everything along principal axes that turn with the tensor, and the way back of a vector.

    The products of inertia are zero and only carry a tangent, so that the turn is zero as well: it
    counts in second derivatives alone. Axes of equal moments have no such turn, and second
    derivatives by the product between them are NaN.
    """
    moments, products, omega, wxyz, t = given
    none = tuple(jnp.zeros_like(x) for x in products)
    turn = carrying(_axes, none, (), (moments, products))

    def along(v):
        return None if v is None else tuple(a - b for a, b in zip(v, cross(turn, v), strict=True))

    def back(v):
        return tuple(a + b for a, b in zip(v, cross(turn, v), strict=True))

    if dm is not None or dp is not None:
        a, b, c = none if dm is None else dm
        xy, xz, yz = none if dp is None else dp
        x, y, z = turn
        # M K - K M for the turn's cross product K.
        dm = (a + 2 * (xy * z - xz * y), b + 2 * (yz * x - xy * z), c + 2 * (xz * y - yz * x))
        dp = (
            xy + (b - a) * z + xz * x - yz * y,
            xz + (a - c) * y - xy * x + yz * z,
            yz + (c - b) * x + xy * y - xz * z,
        )
    given = moments, jax.lax.stop_gradient(products), along(omega), wxyz, t
    return given, dm, dp, along(dw), back


def from_rest(resting, given, dw, dt) -> tuple[Triple, Triple]:
    """Variations of rates and attitude of a body at rest, to second order in the rates."""
    (i1, i2, i3), _, omega, _, t = given
    w1, w2, w3 = w = triple(jnp.where(resting, x, 0) for x in omega)
    zero = jnp.zeros_like(t * i1)
    late = (zero, zero, zero) if dt is None else triple(x * dt for x in w)
    if dw is None:
        return (zero, zero, zero), late
    h1, h2, h3 = dw
    gained = (
        (i2 - i3) / i1 * (h2 * w3 + h3 * w2) * t,
        (i3 - i1) / i2 * (h3 * w1 + h1 * w3) * t,
        (i1 - i2) / i3 * (h1 * w2 + h2 * w1) * t,
    )
    push = triple(h + g for h, g in zip(dw, gained, strict=True))
    drift = triple(
        t * (h + (g - t * c) / 2) + e
        for h, g, c, e in zip(dw, gained, cross(w, dw), late, strict=True)
    )
    return push, drift
