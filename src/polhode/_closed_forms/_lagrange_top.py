"""Lagrange's top as a closed form: the method, the frame of the vertical, and two limits.

Momenta, forces and torques are divided by the transverse moment A throughout: cubes of numbers in
SI units leave the range of single precision. The closed form (``_lagrange_curve``) then measures
momenta in units of (L^2 + 2 |M|)^(1/2), M the moment of the weight. If that unit or the direction
of the weight does not exist, two other formulas are used:

``short_motion``: for times so short that the error of one Runge-Kutta step is below rounding. At
rest without weight there is no unit of momentum, and with little weight the derivatives by it are
differences of large numbers. The equations of motion are regular there: a body at rest remains at
rest. A step of fourth order has all terms of first and second derivatives by state and weight.
Apart from a rotation about its own axis at omega_z - L_z/A, the body moves like a sphere of moment
A. If q is the attitude of the sphere, e = R z the axis, and r e the point at which the weight F
acts, in space axes, with L and F divided by A,

    dL/dt = r e x F,    dq/dt = (0, L) q / 2.

``with_weight``: derivatives of the motion without weight by the weight. The closed form needs the
direction of the weight, although the motion is analytic in its three components. The sphere above
rotates as R(t) = exp(t [w]x) R(0), at the constant rate w = L in space axes. A small weight F at
r e changes its momentum and attitude by

    dL(t) = r I(t) x F,    I(t) = integral of e from 0 to t,
    dtheta(t) = r  integral from 0 to t of exp((t - s) [w]x) (I(s) x F) ds,

where dtheta is a rotation vector in space axes. With n = w/|w| and x = |w| t both are sums of
powers of [n]x times functions of x.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode import _policy, rotation
from polhode._closed_forms._closed_form import (
    NOT_AXIAL,
    NOT_PRINCIPAL,
    AbstractChunkedForm,
    as_lanes,
    axial_state,
    bodies_per_chunk,
    symmetry_objection,
    wheel_objection,
    wheels_have_constant_momentum,
)
from polhode._closed_forms._elementary import rotation_about
from polhode._closed_forms._lagrange_curve import cayley_klein, lagrange_constants
from polhode._closed_forms._lagrange_series import Complex, Series
from polhode._hamiltonian import components
from polhode._kernels import (
    any_of,
    derivable_once,
    is_nonzero_tangent,
    kernel,
    map_chunks,
    opaque_ones,
    spread,
    staged,
    with_derivative_rule,
)
from polhode._scene import Scene, UniformGravity, Wheels


class Top(NamedTuple):
    """N symmetric bodies about a fixed point, with their initial states.

    In units of A, the moment about any axis through the point perpendicular to body z: ``force``
    (N, 3): weight over A, space axes, acting at ``distance`` (N,) [m] along body z; ``wxyz``
    (N, 4), ``omega`` (N, 3) [rad/s]: initial state; ``axial`` (N,): momentum along body z over A
    [rad/s], including that of wheels on the axis.
    """

    force: Float[Array, "n 3"]
    distance: Float[Array, " n"]
    wxyz: Float[Array, "n 4"]
    omega: Float[Array, "n 3"]
    axial: Float[Array, " n"]

    @classmethod
    def of(cls, transverse, force, distance, wxyz, omega, axial) -> "Top":
        """From the moment A (N,) [kg m^2], the weight [N] and the axial momentum [kg m^2/s]."""
        return cls(force / transverse[:, None], distance, wxyz, omega, axial / transverse)


class LagrangeTop(AbstractChunkedForm):
    """Lagrange's top in theta functions, O(1) in time: exact.

    A body symmetric about body z (``ph.Inertia.axisymmetric``) that rotates about a fixed point of
    that axis under uniform gravity in any direction, with its centre of mass on the axis
    (``ph.UniformGravity.axial``). Wheels of constant momentum on the axis are permitted. All
    motions: looping, cuspidal and regular precession, sleeping and hanging tops, the separatrix,
    the pendulum, no gravity. The error is rounding: a few units in the last place of the phase.
    Derivatives are those within the class of symmetric bodies. Close to the marginal sleeping top
    (L_z^2 = 4 A m g l, axis and rates within 1e-9 of upright) their relative error is 1e-8, on it
    1e-2; values are accurate there. ``chunk``: maximum bodies times samples that are computed at
    once (None: chosen by the library).

    Source: Klein & Sommerfeld, Theorie des Kreisels, chapter VI.
    """

    chunk: int | None = eqx.field(static=True, default=None)

    def why_not(self, scene: Scene) -> str | None:
        refusal = self.objection(scene) or symmetry_objection(scene) or wheel_objection(scene)
        gravity: Any = scene.potential
        if refusal is None and gravity.distance is None:
            return "the potential is not one of ph.UniformGravity.axial"
        return refusal

    def objection(self, scene: Scene) -> str | None:
        if not isinstance(scene.potential, UniformGravity):
            return "the potential is not uniform gravity"
        if scene.torque is not None:
            return "a torque acts"
        if not scene.inertia.is_principal:
            return NOT_PRINCIPAL
        if isinstance(scene.rotors, Wheels) and any(axis != 2 for axis in scene.rotors.along):
            return NOT_AXIAL
        return None

    def _chunk_size(self, n: int, count: int) -> int:
        chunk = self.chunk
        if chunk is None:
            chunk = _policy.samples_at_once(_policy.TOP_CHUNK)
        return bodies_per_chunk(chunk, n, count)

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        transverse, moments, axial = axial_state(scene, state)
        gravity: Any = scene.potential
        centre = as_lanes(gravity.centre, n, 1)
        force = as_lanes(gravity.mass, n)[:, None] * as_lanes(gravity.gravity_space, n, 1)
        top = Top.of(transverse, force, centre[:, 2], state.wxyz, state.omega_body, axial)
        wxyz, omega = lagrange_motion(top, elapsed)
        is_valid = (moments[:, 0] == moments[:, 1]) & (centre[:, 0] == 0) & (centre[:, 1] == 0)
        return wxyz, omega, is_valid & wheels_have_constant_momentum(scene, n)


def upward(force: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array, Array], Array]:
    """Quaternion (w, x, y; z = 0) from space z to an axis along the force or against it, with a
    positive z component, and the signed size of the force along this axis.

    Without force the axis is z: the motion does not depend on it, and ``with_weight`` has the
    derivatives by the force.
    """
    square = sum(x * x for x in force)
    acting = square > 0
    force_component = jnp.sqrt(jnp.where(acting, square, 1))
    up = jnp.where(force[2] < 0, -1, 1).astype(force_component.dtype)
    a, b, c = (jnp.where(acting, up * v / force_component, w) for v, w in zip(force, (0, 0, 1)))
    half = jnp.sqrt((1 + c) / 2)
    return (half, -b / (2 * half), a / (2 * half)), jnp.where(
        acting, up * force_component, force[2]
    )


def _times_tilt(tilt: tuple[Array, Array, Array], q: tuple[Array, ...]) -> tuple[Array, ...]:
    """Quaternion product (w, x, y, 0) q on components."""
    a, b, c = tilt
    w, x, y, z = q
    return (
        a * w - b * x - c * y,
        a * x + b * w + c * z,
        a * y - b * z + c * w,
        a * z + b * y - c * x,
    )


def lagrange_motion(
    top: Top, elapsed: Float[Array, "n t"]
) -> tuple[Float[Array, "n t 4"], Float[Array, "n t 3"]]:
    """Attitude and body rates after ``elapsed`` [s] of a symmetric body about a fixed point.

    Klein & Sommerfeld, Theorie des Kreisels, VI. The closed form is ``_long_motion``;
    ``short_motion`` replaces it if the body hardly moves in that time, and ``with_weight`` has the
    derivatives by a force that is zero.
    """
    # The closed form fails in two cases: for a body that hardly moves its constants are quotients
    # of rounding errors, and without weight its derivatives by the weight are 0/0. Both have plain
    # formulas, which are evaluated only if a body of the batch needs them.
    frequency = momentum_frequency(jax.lax.stop_gradient(top._replace(wxyz=None)))
    angle = frequency[:, None] * jnp.abs(jax.lax.stop_gradient(elapsed))
    is_short = angle < short_angle(elapsed.dtype)
    # Derivatives of the closed form would be NaN for these bodies: it is evaluated for another
    # motion.
    at_rest = jnp.all(is_short, axis=-1)[:, None]
    weightless = jnp.all(top.force == 0, axis=-1, keepdims=True)
    other = top._replace(
        force=jnp.where(at_rest | weightless, 0, top.force), omega=jnp.where(at_rest, 1, top.omega)
    )
    closed_form: Any = kernel(_long_motion, repeated=True)
    motion = closed_form(other, jnp.where(is_short, 0, elapsed))

    # For one body at a time: for all at once, this rarely used branch would take a third of the
    # compilation of a gradient.
    def with_corrections(motion, top, elapsed):
        corrected: Any = kernel(_corrected, repeated=True)
        lanes = list(motion), top, elapsed, is_short, weightless, at_rest
        return map_chunks(lambda lane: corrected(*lane), lanes, elapsed.shape[0], 1)

    def unchanged(motion, top, elapsed):
        return list(motion)

    branch = any_of(jnp.where(is_short | weightless, 1, 0))
    wxyz, omega = jax.lax.cond(branch, with_corrections, unchanged, motion, top, elapsed)
    return wxyz, omega


def _corrected(motion, top: Top, elapsed, is_short, weightless, at_rest) -> Any:
    """The motion with the two cases that the closed form lacks: see ``lagrange_motion``."""
    short_samples = short_motion(top, jnp.where(is_short, elapsed, 0))
    corrected_motion = with_weight(top, elapsed, motion, weightless & ~at_rest)
    motion = [jnp.where(weightless[..., None], x, y) for x, y in zip(corrected_motion, motion)]
    return [jnp.where(is_short[..., None], x, y) for x, y in zip(short_samples, motion)]


def _long_motion(top: Top, elapsed):
    """The closed form, arguments and results as of ``lagrange_motion``."""
    # XLA compiles a loop for every axis, even of length one, and vectorises the last axis only:
    # axes of length one are removed, and the longer axis is last.
    lanes, count = elapsed.shape
    times, axis = elapsed, -1
    if lanes == 1:
        times, top = jax.tree.map(lambda x: x[0], (times, top))
    elif count < lanes:
        times, axis = times.T, -2
    if count == 1:
        times = jnp.squeeze(times, axis)
    force, distance, wxyz, omega, axial = top
    one = opaque_ones(axial)
    wxyz, omega = staged((jnp.unstack(wxyz, axis=-1), components(omega)), one)
    tilt, force_component = staged(upward(components(force)), one)
    inverse_tilt = (tilt[0], -tilt[1], -tilt[2])
    # In axes along the force the motion is that of the textbook. Spinors (Cayley-Klein parameters)
    # have no pole where the body is upright, unlike Euler angles.
    q, spin = staged(_times_tilt(inverse_tilt, wxyz), one), omega[2]
    momentum = (omega[0], omega[1], axial)
    spinor = Complex(q[0], q[3]), Complex(q[2], q[1])
    motion = lagrange_constants(spin, -force_component * distance, spinor, momentum)
    if count > 1:
        series = motion.series
        motion, h, tilt, spin = spread(
            (motion._replace(series=None), series.h, tilt, spin), axis, count
        )
        # separately, because of the series only h has cotangents to be summed
        weights = spread((series.weights, series.derivatives), axis, count)
        motion = motion._replace(series=Series(h, *weights))
    alpha, beta, across = cayley_klein(motion, times)
    square = 1 / (alpha.square + beta.square)
    scale = jnp.sqrt(square)
    q = _times_tilt(tuple(x * scale for x in tilt), (alpha.re, beta.im, beta.re, alpha.im))
    rates = (across.im * square, across.re * square, spin)

    def to_samples(parts):
        return jnp.stack([x.T if count < lanes else x for x in parts], axis=-1).reshape(
            lanes, count, -1
        )

    return to_samples(q), to_samples(rates)


def momentum_frequency(top: Top) -> Array:
    """(L^2 + 2 |M|)^(1/2) (N,) [rad/s]; 0 for a body that remains at rest."""
    force, distance, _, omega, axial = top
    weight = jnp.sqrt(jnp.sum(force * force, axis=-1)) * jnp.abs(distance)
    across = jnp.sum(omega[:, :2] ** 2, axis=-1)
    return jnp.sqrt(across + axial**2 + 2 * weight)


def short_angle(dtype) -> float:
    """``momentum_frequency`` times the time [rad] up to which the error of the step of
    ``short_motion`` is below rounding."""
    # The local error of the step of fourth order is estimated as angle^5 / 100.
    return (100 * float(jnp.finfo(dtype).eps)) ** (1 / 5)


def short_motion(top: Top, elapsed: Array) -> tuple[Array, Array]:
    """Attitude (N, T, 4) and body rates (N, T, 3); arguments as for ``lagrange_motion``."""
    force, distance, wxyz, omega, axial = top
    momentum = jnp.concatenate([omega[:, :2], axial[:, None]], axis=-1)
    arm_force = distance[:, None, None] * force[:, None]
    zero, one = jnp.zeros_like(elapsed), jnp.ones_like(elapsed)
    step = elapsed[..., None]
    start = (
        jnp.broadcast_to(wxyz[:, None], (*elapsed.shape, 4)),
        jnp.broadcast_to(rotation.rotate(wxyz, momentum)[:, None], (*elapsed.shape, 3)),
    )

    # One Runge-Kutta step of order 4, in space axes. The rotation about the axis of symmetry is
    # known exactly and added at the end: the fast spin of a top would shorten the time for which
    # the error of the step is below rounding.
    def field(q, rate):
        w, x, y, z = jnp.unstack(q, axis=-1)
        a, b, c = jnp.unstack(rate, axis=-1)
        q_rate = [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z]
        axis = [2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z]
        q_rate = jnp.stack([*q_rate, c * w + a * y - b * x], axis=-1) / 2
        return q_rate, jnp.cross(jnp.stack(axis, axis=-1), jnp.broadcast_to(arm_force, rate.shape))

    def stage(carry, weights):
        rates, total = carry
        rates = field(*(x + weights[0] * step * k for x, k in zip(start, rates)))
        return (rates, tuple(x + weights[1] * k for x, k in zip(total, rates))), None

    weights = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], elapsed.dtype)
    none = tuple(map(jnp.zeros_like, start))
    (_, total), _ = jax.lax.scan(stage, (none, none), weights)
    q, rate = (x + step * k for x, k in zip(start, total))
    own_rotation = rotation_about((zero, zero, one), (omega[:, 2] - axial)[:, None] * elapsed)
    q = rotation.normalise(rotation.multiply(q, own_rotation))
    rate = rotation.rotate(rotation.conjugate(q), rate)
    spin = jnp.broadcast_to(omega[:, None, 2:], (*elapsed.shape, 1))
    return q, jnp.concatenate([rate[..., :2], spin], axis=-1)


def with_weight(
    top: Top, elapsed: Array, motion: tuple[Array, Array], applies: Array
) -> list[Array]:
    """The ``motion`` without weight, with the derivatives by ``force``, which is zero.

    Second derivatives by it are NaN. ``applies`` (N, 1): bodies that rotate and have no weight; for
    all others the result and its derivatives are finite and not used. Other arguments as for
    ``short_motion``.
    """

    # The changes are zero, and computed only in programs that differentiate by the force.
    def rule(operands, tangents, values):
        if not is_nonzero_tangent(tangents[0]):
            return [jnp.zeros_like(x) for x in values]
        force, *others, elapsed, q, applies = operands

        def by_force(force):
            return _first_order(Top(force, *others), elapsed, q, applies)

        return jax.jvp(by_force, (force,), (tangents[0],))[1]

    operands = [*top, elapsed, motion[0], applies]
    changes = with_derivative_rule(rule, operands, [jnp.zeros_like(x) for x in motion])
    return [x + change for x, change in zip(motion, changes)]


def _first_order(top: Top, elapsed: Array, q: Array, applies: Array) -> list[Array]:
    """First-order changes of attitude (N, T, 4) and rates (N, T, 3) of a motion without weight by a
    small weight. ``q``: attitude of this motion; other arguments as for ``with_weight``.
    """
    force, distance, wxyz, omega, axial = top
    momentum = jnp.concatenate([omega[:, :2], axial[:, None]], axis=-1)
    rate = jnp.where(applies, rotation.rotate(wxyz, momentum), 1)
    size = jnp.sqrt(jnp.sum(rate * rate, axis=-1, keepdims=True))
    n = rate / size
    axis = rotation.rotate(wxyz, jnp.broadcast_to(jnp.array([0, 0, 1], n.dtype), n.shape))
    # NaN only for the bodies to which this applies
    once = derivable_once(force, jnp.broadcast_to(applies, force.shape))
    weight = once * distance[:, None]
    n_cross_axis = jnp.cross(n, axis)
    a, b, c = (
        jnp.cross(v, weight)[:, None] for v in (axis, n_cross_axis, jnp.cross(n, n_cross_axis))
    )

    # First order in the weight, about a motion without it (n: direction of L): the torque is a sum
    # of a constant, a cosine and a sine of x, whose integrals have closed forms. Differences such
    # as 1 - cos x are written without cancellation, since x may be small. Each of the functions of
    # x below is an integral of the one before; p1, p2, p3 are their convolutions with sin and x.
    x = (size * elapsed)[..., None]
    sine, cosine = jnp.sin(x), jnp.cos(x)
    one_less_cosine = 2 * jnp.sin(x / 2) ** 2
    x_less_sine, x2_less_cosine = x - sine, x * x / 2 - one_less_cosine
    p1, p2 = one_less_cosine - x * sine / 2, x_less_sine - (sine - x * cosine) / 2
    p3 = x2_less_cosine - p1
    n = jnp.broadcast_to(n[:, None], (*elapsed.shape, 3))
    first_sum = a * x_less_sine + b * p1 + c * p2
    second_sum = jnp.cross(n, a * x2_less_cosine + b * p2 + c * p3)
    angle = (
        a * (x * x / 2)
        + b * x_less_sine
        + c * x2_less_cosine
        + jnp.cross(n, first_sum + second_sum)
    )
    angle = angle / (size * size)[:, None]
    rate_change = (a * x + b * one_less_cosine + c * x_less_sine) / size[:, None]

    half_angle = jnp.concatenate([jnp.zeros_like(x), angle / 2], axis=-1)
    rate_change = rate_change + jnp.cross(jnp.broadcast_to(rate[:, None], n.shape), angle)
    rate_change = rotation.rotate(rotation.conjugate(q), rate_change)
    rate_change = jnp.concatenate([rate_change[..., :2], jnp.zeros_like(x)], axis=-1)
    return [rotation.multiply(half_angle, q), rate_change]
