"""The derivative of the exact free motion as a JAX rule, which can itself be differentiated.

The formulas of the constants minimise rounding. They have branches and quotients of differences,
whose derivatives by the chain rule are 0/0 for a symmetric body and on the separatrix. The tangent
(``_free_tangent``) therefore uses only the values of the constants. For second derivatives, each
value gets the derivative of a plain formula, which is regular everywhere and evaluated only if the
tangent is differentiated again.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from polhode._closed_forms._arithmetic import agm_and_nome, sign_of_parity
from polhode._closed_forms._free_constants import Polhode, Precession, Triple
from polhode._closed_forms._free_motion import Instant, momentum_of
from polhode._closed_forms._free_tangent import (
    Frame,
    Invariants,
    Quadruple,
    Variation,
    apply_variation,
    cross,
    dot,
    incomplete,
    momentum_tangent,
    partials,
    products_of_momenta,
    quarter_turn,
    quaternion_product,
    second_kind,
    squares_of_momenta,
)
from polhode._hamiltonian import triple
from polhode._kernels import opaque_ones, over_gap, staged

Scalars = Float[Array, "*b"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def with_formula_derivative(formula, value, constants, arguments):
    """``value``, with the derivative of ``formula(constants, arguments)`` by ``arguments``."""
    return value


@with_formula_derivative.defjvp
def _with_formula_derivative_rule(formula, primals, tangents):
    value, constants, arguments = primals
    _, variation = jax.jvp(lambda x: formula(constants, x), (arguments,), (tangents[2],))
    return with_formula_derivative(formula, value, constants, arguments), variation


def _start_formula(polhode: Polhode, arguments):
    """Plain formulas of the constants in ``with_start_derivative``."""
    # Differences of moments and momenta, without branches. Their values lose digits for nearly
    # symmetric bodies, which is why `polhode_constants` has other formulas; their derivatives are
    # accurate everywhere.
    frame = Frame(polhode)
    moments, omega = arguments
    rate_unit = jnp.where(polhode.rate_unit > 0, polhode.rate_unit, 1)
    i = i1, i2, i3 = tuple(x / polhode.moment_unit for x in frame.to_roles(moments))
    w = tuple(x / rate_unit for x in frame.to_roles(omega))
    d = d1, d2, d3 = tuple(1 / x for x in i)
    momentum = l1, l2, l3 = tuple(x * y for x, y in zip(i, w, strict=True))
    p = polhode.sense * (i2 - i1) * d1 * d2
    r = polhode.sense * (i3 - i2) * d2 * d3
    s = polhode.sense * (i3 - i1) * d1 * d3
    return momentum, d, i, p, r, s, s * l1 * l1 + r * l2 * l2, p * l2 * l2 + s * l3 * l3


def with_start_derivative(polhode: Polhode, moments: Triple, omega: Triple) -> Polhode:
    """The constants with derivatives by moments and initial rates, as the tangent needs them."""
    value = polhode.momentum, polhode.inverse_moments, polhode.moments
    value = (*value, polhode.p, polhode.r, polhode.s, polhode.A, polhode.B)
    momentum, inverse_moments, moments, p, r, s, A, B = with_formula_derivative(
        _start_formula, value, polhode, (moments, omega)
    )
    return polhode._replace(
        momentum=momentum, inverse_moments=inverse_moments, moments=moments, p=p, r=r, s=s, A=A, B=B
    )


def _momentum_formula(polhode: Polhode, arguments):
    start, p, r, s, functions = arguments
    return momentum_of(polhode._replace(momentum=start, p=p, r=r, s=s), functions)


def with_momentum_derivative(polhode: Polhode, functions: Triple, momentum_at_t: Triple) -> Triple:
    """The momentum at time t, with derivatives by the initial momentum and by S, C, N."""
    arguments = (polhode.momentum, polhode.p, polhode.r, polhode.s, functions)
    return with_formula_derivative(_momentum_formula, momentum_at_t, polhode, arguments)


def _difference_formula(_, arguments):
    x, y = arguments
    return x - y


def with_difference_derivative(polhode: Polhode, x: Scalars, y: Scalars) -> Scalars:
    """x - y = B r - A p, accurate where it vanishes, on the separatrix."""
    return with_formula_derivative(_difference_formula, polhode.m1 * x, (), (x, y))


def _quarter_formula(circular, on_separatrix, x: Scalars, z: Scalars):
    is_moving = x > 0
    x, z = jnp.where(is_moving, x, 1), jnp.where(is_moving, z, 1)
    m1 = z / x
    m, one = 1 - m1, jnp.ones_like(x)
    agm, _, log_nome, rate = agm_and_nome(circular, on_separatrix, x, m, m1, one)
    return quarter_turn(circular, on_separatrix, m, m1, agm, log_nome, 1 / rate)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def with_functions_derivative(
    has_time_axis: bool, value, constants, x: Scalars, z: Scalars, t: Scalars
):
    """``value``: S, C, N and the integrals of S^2 and (S/N)^2, with their derivatives.

    ``constants``: the ``Polhode`` and the number of half turns; ``x`` = B r, ``z`` = B r - A p.
    """
    return value


@with_functions_derivative.defjvp
def _functions_rule(has_time_axis, primals, tangents):
    value, constants, x, z, t = primals
    _, _, dx, dz, dt = tangents
    value = with_functions_derivative(has_time_axis, value, constants, x, z, t)
    polhode, half_turns = constants
    S, C, N, first, second = value
    # y = A p has the derivative of x - z, in which that of z is accurate on the separatrix.
    # S' = C N, C' = -x S N, N' = -y S C in the time, and `partials` are those by the coefficients.
    y = with_formula_derivative(_difference_formula, polhode.A * polhode.p, (), (x, z))
    dS, dC, dN = partials(x, y, (S, C, N), first, second).along(dx, dz)
    dS, dC, dN = dS + C * N * dt, dC - x * S * N * dt, dN - y * S * C * dt
    sign = sign_of_parity(half_turns)
    _, variation = jax.jvp(
        lambda s, c, n: incomplete(s, c, n, has_time_axis),
        (sign * S, sign * C, N),
        (sign * dS, sign * dC, dN),
    )
    # With each half turn the integrals grow by twice those over a quarter period. The incomplete
    # and the complete parts are differentiated separately; their sum is smooth where the number of
    # half turns changes.
    _, quarter_variation = jax.jvp(
        functools.partial(_quarter_formula, polhode.circular, polhode.on_separatrix),
        (x, z),
        (dx, dz),
    )
    parts = tuple(
        a + jnp.where(half_turns == 0, 0, 2 * half_turns * b)
        for a, b in zip(variation, quarter_variation, strict=True)
    )
    return value, (dS, dC, dN, *parts)


def _axes_rotation(_, arguments) -> Triple:
    """Rotation of the principal axes by small entries xy, xz, yz of the tensor."""
    (a, b, c), (xy, xz, yz) = arguments
    return over_gap(yz, b, c), over_gap(xz, c, a), over_gap(xy, a, b)


def along_rotating_axes(arguments, dm, dp, dw):
    """Arguments and tangents along principal axes that rotate with the tensor, and the function
    that transforms a vector back to the body axes.

    The products of inertia are zero and have tangents only, so that the rotation is zero as well:
    it contributes to second derivatives only. It is not defined for axes of equal moments, and
    second derivatives by the product between them are NaN.
    """
    moments, products, omega, wxyz, t = arguments
    zeros = tuple(jnp.zeros_like(x) for x in products)
    axes_rotation = with_formula_derivative(_axes_rotation, zeros, (), (moments, products))

    # In axes that rotate with the tensor, its products remain zero. The differentiated functions
    # then depend on moments only, as the closed form does, and vectors are transformed back.
    def in_rotating_axes(v):
        return (
            None
            if v is None
            else tuple(a - b for a, b in zip(v, cross(axes_rotation, v), strict=True))
        )

    def to_body(v):
        return tuple(a + b for a, b in zip(v, cross(axes_rotation, v), strict=True))

    if dm is not None or dp is not None:
        a, b, c = zeros if dm is None else dm
        xy, xz, yz = zeros if dp is None else dp
        x, y, z = axes_rotation
        # M K - K M, where K is the cross-product matrix of the rotation
        dm = (a + 2 * (xy * z - xz * y), b + 2 * (yz * x - xy * z), c + 2 * (xz * y - yz * x))
        dp = (
            xy + (b - a) * z + xz * x - yz * y,
            xz + (a - c) * y - xy * x + yz * z,
            yz + (c - b) * x + xy * y - xz * z,
        )
    arguments = moments, jax.lax.stop_gradient(products), in_rotating_axes(omega), wxyz, t
    return arguments, dm, dp, in_rotating_axes(dw), to_body


def variation_at_rest(at_rest, arguments, dw, dt) -> tuple[Triple, Triple]:
    """Variations of rates and attitude of a body at rest, to second order in the rates."""
    # The closed form divides by the size of the momentum. At rest Euler's equations are expanded
    # instead: to second order, because this variation is differentiated once more for Hessians.
    (i1, i2, i3), _, omega, _, t = arguments
    w1, w2, w3 = w = triple(jnp.where(at_rest, x, 0) for x in omega)
    zero = jnp.zeros_like(t * i1)
    d_time = (zero, zero, zero) if dt is None else triple(x * dt for x in w)
    if dw is None:
        return (zero, zero, zero), d_time
    h1, h2, h3 = dw
    gain = (
        (i2 - i3) / i1 * (h2 * w3 + h3 * w2) * t,
        (i3 - i1) / i2 * (h3 * w1 + h1 * w3) * t,
        (i1 - i2) / i3 * (h1 * w2 + h2 * w1) * t,
    )
    d_rates = triple(h + g for h, g in zip(dw, gain, strict=True))
    d_attitude = triple(
        t * (h + (g - t * c) / 2) + e
        for h, g, c, e in zip(dw, gain, cross(w, dw), d_time, strict=True)
    )
    return d_rates, d_attitude


class EvaluatedMotion(NamedTuple):
    """The motion at time t and its constants: values without derivatives."""

    polhode: Polhode
    precession: Precession | None
    at: Instant
    results: tuple[Triple | None, Quadruple | None]


def dense_or_none(tangents, primals):
    """None if every tangent is a symbolic zero; otherwise arrays."""
    if tangents is None or all(isinstance(x, SymbolicZero) for x in jax.tree.leaves(tangents)):
        return None
    return jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if isinstance(d, SymbolicZero) else d, tangents, primals
    )


def start_variation(polhode: Polhode, frame: Frame, dm, dp, dw) -> Variation:
    """Variation of the initial momentum and of the inverse tensor, along axes 1, 2, 3, in scaled
    units."""
    zero = (jnp.zeros_like(polhode.moment_unit),) * 3
    inverse_rate_unit = 1 / jnp.where(polhode.rate_unit > 0, polhode.rate_unit, 1)
    di = tuple(x / polhode.moment_unit for x in frame.to_roles(dm)) if dm is not None else zero
    dv = tuple(x * inverse_rate_unit for x in frame.to_roles(dw)) if dw is not None else zero
    d1, d2, d3 = d = polhode.inverse_moments
    w1, w2, w3 = w = tuple(x * y for x, y in zip(polhode.momentum, d, strict=True))
    momentum_variation = tuple(
        i * v + e * u for i, v, e, u in zip(polhode.moments, dv, di, w, strict=True)
    )
    inverse_moments = tuple(-k * k * e for k, e in zip(d, di, strict=True))
    if dp is None:
        return Variation(momentum_variation, inverse_moments, None)
    p12, p13, p23 = (x / polhode.moment_unit for x in frame.to_pairs(dp))
    momentum_variation = (
        momentum_variation[0] + p12 * w2 + p13 * w3,
        momentum_variation[1] + p12 * w1 + p23 * w3,
        momentum_variation[2] + p13 * w1 + p23 * w2,
    )
    return Variation(
        momentum_variation, inverse_moments, (-d1 * d2 * p12, -d1 * d3 * p13, -d2 * d3 * p23)
    )


def _relative_rotation(
    polhode: Polhode, precession: Precession, frame: Frame, at: Instant, momentum_step: Triple
):
    """Quaternion from the attitude at t to that at the start, whose vector part is accurate if it
    is small."""
    l1, l2, l3 = frame.reflected(polhode.momentum)
    s1, s2, s3 = frame.reflected(momentum_step)
    c, s = at.precession_half_angle
    height = precession.length + l3
    tilt = jnp.sqrt(height * height + l1 * l1 + l2 * l2)
    c, s = c / tilt, s / tilt
    along = s * (tilt * tilt / precession.length)
    v0 = c * s3
    v = (c * s2 + s * s1, s * s2 - c * s1, s * s3)
    to_body = cross((l2, -l1, jnp.zeros_like(l1)), v)
    vector = (
        along * l1 + height * v[0] - v0 * l2 - to_body[0],
        along * l2 + height * v[1] + v0 * l1 - to_body[1],
        along * l3 + height * v[2] - to_body[2],
    )
    scalar = c * tilt * tilt + height * v0 + l2 * v[0] - l1 * v[1]
    return scalar, vector


def _rotation_tangent(
    polhode,
    frame: Frame,
    functions,
    momentum_at_t,
    relative,
    variation: Variation,
    variation_since_start,
    first,
    t,
):
    """Variation of the attitude: a rotation vector along axes 1, 2, 3 at time t."""
    # The part perpendicular to L follows from the conservation of L in space: the direction of L in
    # body axes must change as the momentum in the body does (`momentum_lag`). The part along L is
    # the variation of the energy times t, plus an integral along the motion of L L^T contracted
    # with the variation of the inverse tensor. Thus the precession angle, an integral of the third
    # kind, is not differentiated.
    sigma_pi = polhode.sense * polhode.parity
    invariants = Invariants(polhode.momentum, polhode.p, polhode.r, polhode.s, polhode.A, polhode.B)
    scalar, vector = relative
    momentum_variation = frame.reflected(variation.momentum)
    once = cross(vector, momentum_variation)
    twice = cross(vector, once)
    momentum_lag = tuple(
        2 * (b - scalar * a) - m
        for a, b, m in zip(once, twice, frame.reflected(variation_since_start), strict=True)
    )
    squares = squares_of_momenta(polhode, functions, momentum_at_t, first, t)
    start = polhode.momentum
    spin = tuple(x * y for x, y in zip(start, polhode.inverse_moments, strict=True))
    energy = dot(spin, variation.momentum) + dot(start, apply_variation(variation, start)) / 2
    about_L = t * energy + dot(variation.inverse_moments, squares) / 2
    if variation.off_diagonal is not None:
        about_L = about_L + dot(
            variation.off_diagonal, products_of_momenta(invariants, functions, sigma_pi)
        )
    L_now = frame.reflected(momentum_at_t)
    inverse_square = 1 / dot(start, start)
    rotation = tuple(
        (a + about_L * b) * inverse_square
        for a, b in zip(cross(L_now, momentum_lag), L_now, strict=True)
    )
    return frame.reflected(rotation)


def _regularised(polhode: Polhode, at: Instant, t: Scalars) -> Instant:
    """The motion with regular S, C, N for the tangent; the momentum does not need them.

    If omega_p is zero, S is the time. On the separatrix derivatives grow without bound: C and N are
    limited from below, so that products do not overflow.
    """
    is_still = polhode.inverse_rate == 0
    smallest = 2.0 ** -{4: 17, 8: 140}[t.dtype.itemsize]

    def regular_functions(functions: Triple) -> Triple:
        S, C, N = functions
        C, N = (jnp.where(polhode.on_separatrix, jnp.maximum(x, smallest), x) for x in (C, N))
        return jnp.where(is_still, t, S), C, N

    return at._replace(
        reduced=regular_functions(at.reduced), functions=regular_functions(at.functions)
    )


def _staged(ones, values):
    return staged(values, *ones)


class _Tangent(NamedTuple):
    """Variations of L and of the attitude at time t, along axes 1, 2, 3, in scaled units, without
    the contribution of a variation of t.
    """

    polhode: Polhode
    frame: Frame
    momentum_at_t: Triple
    variation: Variation
    momentum: Triple
    rotation: Triple | None


def _tangent(
    has_time_axis: bool, attitude: bool, motion: EvaluatedMotion, arguments, dm, dp, dw
) -> _Tangent:
    """The formulas of ``_free_tangent``, in which every value has a derivative rule."""
    moments, _, omega, _, t = arguments
    scaled_time = t * motion.polhode.rate_unit
    ones = opaque_ones(scaled_time), motion.polhode.one
    # The transpose of a stage is a stage, so that sums of cotangents are not repeated either.
    stage = functools.partial(_staged, ones)
    polhode = with_start_derivative(motion.polhode, moments, omega)
    frame = Frame(polhode)
    variation = stage(start_variation(polhode, frame, dm, dp, dw))
    at = _regularised(motion.polhode, motion.at, scaled_time)
    integrals = stage(second_kind(motion.polhode, at.half_turns, at.reduced, has_time_axis))
    x, y = polhode.B * polhode.r, polhode.A * polhode.p
    *functions, first, second = with_functions_derivative(
        has_time_axis,
        (*at.functions, *integrals),
        (polhode, at.half_turns),
        x,
        with_difference_derivative(polhode, x, y),
        scaled_time,
    )
    functions = tuple(functions)
    momentum_at_t = with_momentum_derivative(polhode, functions, at.momentum)
    by = stage(partials(x, y, functions, first, second))
    variation_since_start = stage(
        momentum_tangent(polhode, functions, momentum_at_t, by, variation, stage)
    )
    total = tuple(g + m for g, m in zip(variation.momentum, variation_since_start, strict=True))
    rotation = None
    if attitude:
        relative = _relative(has_time_axis, motion._replace(results=None), arguments)
        rotation = _rotation_tangent(
            polhode,
            frame,
            functions,
            momentum_at_t,
            relative,
            variation,
            variation_since_start,
            first,
            scaled_time,
        )
    return _Tangent(polhode, frame, momentum_at_t, variation, total, rotation)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _relative(has_time_axis: bool, motion: EvaluatedMotion, arguments):
    """Quaternion of the rotation between the start and time t, which the tangent of the attitude
    contains, along right-handed axes 1, 2, 3. Its derivative follows from that tangent.
    """
    polhode, at = motion.polhode, motion.at
    sigma_pi = polhode.sense * polhode.parity
    invariants = Invariants(polhode.momentum, polhode.p, polhode.r, polhode.s, polhode.A, polhode.B)
    functions = _regularised(polhode, at, arguments[-1] * polhode.rate_unit).functions
    j12, j13, j23 = products_of_momenta(invariants, functions, sigma_pi)
    momentum_step = (
        -sigma_pi * polhode.r * j23,
        sigma_pi * polhode.s * j13,
        -sigma_pi * polhode.p * j12,
    )
    return _relative_rotation(polhode, motion.precession, Frame(polhode), at, momentum_step)


def _relative_rule(has_time_axis, primals, tangents):
    motion, arguments = primals
    dm, dp, dw, _, dt = (dense_or_none(d, x) for d, x in zip(tangents[1], arguments, strict=True))
    scalar, vector = value = _relative(has_time_axis, motion, arguments)
    tangent = _tangent(has_time_axis, True, motion, arguments, dm, dp, dw)
    rotation = _rotation_in_time(tangent, dt)
    half = tuple(x / 2 for x in tangent.frame.reflected(rotation))
    vector_variation = tuple(scalar * a + b for a, b in zip(half, cross(vector, half), strict=True))
    return value, (-dot(vector, half), vector_variation)


_relative.defjvp(_relative_rule, symbolic_zeros=True)


def _rotation_in_time(tangent: _Tangent, dt) -> Triple:
    rotation, polhode = tangent.rotation, tangent.polhode
    if rotation is None:
        raise ValueError("the tangent was computed for the rates alone: request the attitude.")
    if dt is None:
        return rotation
    return triple(
        e + n * d * (polhode.rate_unit * dt)
        for e, n, d in zip(rotation, tangent.momentum_at_t, polhode.inverse_moments, strict=True)
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def with_results_derivative(requested: tuple[bool, bool, bool], motion: EvaluatedMotion, arguments):
    """The results of an evaluated motion, with their derivative by ``arguments``."""
    return motion.results


def results_rule(requested, primals, tangents):
    motion, arguments = primals
    results = with_results_derivative(requested, motion, arguments)
    return results, results_tangent(requested, motion, arguments, tangents[1], results)


with_results_derivative.defjvp(results_rule, symbolic_zeros=True)


def results_tangent(requested, motion: EvaluatedMotion, arguments, tangents, results):
    """Variations of rates and attitude."""
    dm, dp, dw, dq, dt = (dense_or_none(d, x) for d, x in zip(tangents, arguments, strict=True))
    start, to_body = arguments[3], tuple
    if arguments[1] is not None:
        arguments, dm, dp, dw, to_body = along_rotating_axes(arguments, dm, dp, dw)
    tangent = _tangent(requested[2], requested[0], motion, arguments, dm, dp, dw)
    polhode, frame, (n1, n2, n3) = tangent.polhode, tangent.frame, tangent.momentum_at_t
    at_rest = polhode.rate_unit == 0
    d_rates_at_rest, d_attitude_at_rest = variation_at_rest(at_rest, arguments, dw, dt)
    d_omega = d_wxyz = None
    if requested[1]:
        total = tangent.momentum
        if dt is not None:
            d_time = polhode.sense * polhode.parity * polhode.rate_unit * dt
            total = (
                total[0] - polhode.r * n2 * n3 * d_time,
                total[1] + polhode.s * n1 * n3 * d_time,
                total[2] - polhode.p * n1 * n2 * d_time,
            )
        d_rates = tuple(
            polhode.rate_unit * (d * x + e)
            for d, x, e in zip(
                polhode.inverse_moments,
                total,
                apply_variation(tangent.variation, tangent.momentum_at_t),
                strict=True,
            )
        )
        d_omega = to_body(
            tuple(
                jnp.where(at_rest, h, x)
                for h, x in zip(d_rates_at_rest, frame.to_body(d_rates), strict=True)
            )
        )
    if requested[0]:
        rotation = _rotation_in_time(tangent, dt)
        rotation = to_body(
            tuple(
                jnp.where(at_rest, h, e)
                for h, e in zip(d_attitude_at_rest, frame.to_body(rotation), strict=True)
            )
        )
        d_wxyz = quaternion_product(results[1], (jnp.zeros_like(n1), *(x / 2 for x in rotation)))
        if dq is not None:
            d_wxyz = _start_tangent(start, dq, results[1], d_wxyz)
    # staged: otherwise XLA computes all components again for each entry of the stacked result
    return staged((d_omega, d_wxyz), opaque_ones(motion.polhode.rate_unit * arguments[4]))


def _start_tangent(start: Quadruple, variation: Quadruple, attitude: Quadruple, tangent: Quadruple):
    """Add the variation due to the initial attitude, which is normalised before use."""
    inverse_square = 1 / dot(start, start)
    along = dot(start, variation)
    unit = tuple(
        (d - along * inverse_square * q) * inverse_square
        for d, q in zip(variation, start, strict=True)
    )
    relative = quaternion_product(unit, (start[0], -start[1], -start[2], -start[3]))
    return tuple(
        a + b for a, b in zip(tangent, quaternion_product(relative, attitude), strict=True)
    )
