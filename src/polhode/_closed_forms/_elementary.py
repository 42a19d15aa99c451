"""Symmetric tops and rotation about a fixed axis, driven and damped, in elementary functions."""

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
    axial_wheel_momentum,
    bodies_per_chunk,
    symmetry_objection,
    torque_and_damping,
    torque_objection,
    wheel_objection,
    wheels_have_constant_momentum,
)
from polhode._kernels import derivable_once, underivable
from polhode._scene import Scene, Wheels
from polhode.rotation import multiply, rotation_vector_to_wxyz


class SymmetricTop(AbstractChunkedForm):
    """A symmetric body without potential, in elementary functions: exact.

    Constant torque about the axis of symmetry (body z), linear damping symmetric about it and
    wheels of constant momentum on it. The rates are elementary functions in all these cases. The
    attitude is one only if the direction of the momentum is constant: without torque, and without
    damping, or with damping proportional to the moments (``c = k I``) and no wheel. Otherwise the
    attitude is NaN: pass ``ph.Record(attitude=False)``.

    Derivatives are those within this class of motions: by numbers that break the symmetry, such as
    one of two equal coefficients of damping, they are zero or wrong. Derivatives of the attitude by
    damping and moments are valid only for changes that preserve ``c = k I``; the one by axial
    damping alone is zero. Those by axial torque, by the momentum of a wheel in a damped body and by
    damping of a body with a wheel are NaN. Those of ``ph.LiePoisson()`` have no such restrictions.
    """

    chunk: int | None = eqx.field(static=True, default=None)

    def why_not(self, scene: Scene) -> str | None:
        refusal = self.objection(scene) or symmetry_objection(scene) or wheel_objection(scene)
        if refusal is None and scene.torque is not None:
            return "a torque acts, of which only numbers can be symmetric about body z"
        return refusal

    def objection(self, scene: Scene) -> str | None:
        if isinstance(scene.rotors, Wheels) and any(axis != 2 for axis in scene.rotors.along):
            return NOT_AXIAL
        return torque_objection(scene) or (None if scene.inertia.is_principal else NOT_PRINCIPAL)

    def _chunk_size(self, n: int, count: int) -> int:
        return _chunk_size(self.chunk, n, count)

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        transverse, moments, axial = axial_state(scene, state)
        torque, damping = (as_lanes(x, n, 1) for x in torque_and_damping(scene))
        axial_moment = moments[:, 2]
        wheel_momentum = axial_wheel_momentum(scene, n)
        transverse_decay, axial_decay = damping[:, 0] / transverse, damping[:, 2] / axial_moment
        spin, angle = driven_spin(
            state.omega_body[:, 2, None],
            axial_decay[:, None],
            (torque[:, 2] / axial_moment)[:, None],
            elapsed,
        )
        # W = omega_x + i omega_y obeys A dW/dt = i ((C - A) omega_z + h) W - c W
        phase = ((axial_moment - transverse) / transverse)[:, None] * angle
        phase = phase + (wheel_momentum / transverse)[:, None] * elapsed
        c, s = jnp.cos(phase), jnp.sin(phase)
        shrinkage = jnp.exp(-transverse_decay[:, None] * elapsed)
        x, y = state.omega_body[:, 0, None], state.omega_body[:, 1, None]
        omega = jnp.stack([shrinkage * (x * c - y * s), shrinkage * (x * s + y * c), spin], axis=-1)
        transverse_momentum = jnp.stack([transverse, transverse], axis=-1) * state.omega_body[:, :2]
        momentum = jnp.concatenate([transverse_momentum, axial[:, None]], axis=-1)
        wxyz = precession(
            state.wxyz,
            rotation.rotate(state.wxyz, momentum),
            transverse,
            state.omega_body[:, 2] - axial / transverse,
            decay(transverse_decay[:, None], elapsed),
        )
        is_valid = (moments[:, 0] == moments[:, 1]) & jnp.all(torque[:, :2] == 0, axis=-1)
        is_valid = (
            is_valid & (damping[:, 0] == damping[:, 1]) & wheels_have_constant_momentum(scene, n)
        )
        direction_is_constant = (
            (torque[:, 2] == 0)
            & _equal(transverse_decay, axial_decay)
            & ((wheel_momentum == 0) | (transverse_decay == 0))
        )
        if scene.torque is not None:
            zero = _zero_of_fixed_direction(torque[:, 2], damping[:, 0], wheel_momentum)
            wxyz = wxyz + zero[:, None, None]
        wxyz = jnp.where(direction_is_constant[:, None, None], wxyz, jnp.nan)
        return wxyz, omega, is_valid


def _zero_of_fixed_direction(torque: Array, damping: Array, wheel_momentum: Array) -> Array:
    """Zero (N,), whose derivatives are NaN by numbers that would change the momentum's direction.

    The formula of the attitude requires a constant direction, and so do its derivatives. Damping
    alone is not included: in reverse mode its two coefficients would have NaN derivatives even if
    their change preserves the proportion to the moments.
    """
    marked = (
        (torque, jnp.ones_like(torque, bool)),
        (wheel_momentum, damping != 0),
        (damping, wheel_momentum != 0),
    )
    return sum((underivable(x, where) - x for x, where in marked), jnp.zeros_like(torque))


def _chunk_size(chunk: int | None, n: int, count: int) -> int:
    chosen = _policy.samples_at_once(_policy.ELEMENTARY_CHUNK)
    return bodies_per_chunk(chosen if chunk is None else chunk, n, count)


def _equal(a: Array, b: Array) -> Array:
    """Equal to a few units in the last place: the ratios of proportional numbers are rounded."""
    return jnp.abs(a - b) <= 4 * jnp.finfo(a.dtype).eps * jnp.abs(a)


class FixedAxis(AbstractChunkedForm):
    """Rotation about a fixed principal axis, driven and damped, in closed form.

    All rates but one are zero at the start, the constant body torques are along that axis and the
    damping is linear: d omega/dt = (N - c omega)/I. Bodies may have different axes. Derivatives are
    those within this class of motions: with respect to transverse rates and torques they are zero.
    Second derivatives of a body at rest are NaN. For bodies with other rates or torques results are
    NaN with ``ph.Status.NOT_FINITE``: ``ph.simulate`` never chooses this method by itself.
    """

    chunk: int | None = eqx.field(static=True, default=None)

    def why_not(self, scene: Scene) -> str | None:
        return self.objection(scene) or "only numbers can lie along one principal axis"

    def objection(self, scene: Scene) -> str | None:
        if scene.rotors is not None:
            return "rotors turn in the body"
        if not scene.inertia.is_principal:
            return NOT_PRINCIPAL
        return torque_objection(scene)

    def _chunk_size(self, n: int, count: int) -> int:
        return _chunk_size(self.chunk, n, count)

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        torque, damping = (as_lanes(x, n, 1) for x in torque_and_damping(scene))
        moments = as_lanes(scene.inertia.moments, n, 1)
        is_axis = (torque != 0) | (state.omega_body != 0)
        times = elapsed[:, :, None] * jnp.ones_like(moments)[:, None]
        axis = jnp.argmax(is_axis, axis=-1)
        along = jnp.arange(3)[None] == axis[:, None]
        is_moving = jnp.any(is_axis, axis=-1, keepdims=True)
        # Derivatives by transverse rates and torques of a rotating body are set to zero. At rest
        # the axes are coupled in second order only, and first derivatives by all of them are right.
        constant = jax.lax.stop_gradient
        rates, torque = (
            jnp.where(along | ~is_moving, x, constant(x)) for x in (state.omega_body, torque)
        )
        rates_and_torque = jnp.concatenate([rates, torque], axis=-1)
        at_rest = jnp.broadcast_to(~is_moving, rates_and_torque.shape)
        # Zero, whose second derivatives are NaN for a body at rest, since this motion lacks them.
        zero = jnp.sum(
            derivable_once(rates_and_torque, at_rest) - rates_and_torque, axis=-1, keepdims=True
        )
        omega, angles = driven_spin(
            (rates + zero)[:, None],
            (damping / moments)[:, None],
            (torque / moments)[:, None],
            times,
        )
        rotations = rotation.rotation_vector_to_wxyz(angles)  # regular at rest
        wxyz = rotation.multiply(jnp.broadcast_to(state.wxyz[:, None], rotations.shape), rotations)
        return wxyz, omega, jnp.sum(is_axis, axis=-1) <= 1


def decay(rate: Array, t: Array) -> Array:
    """(1 - exp(-k t))/k, t at k = 0: the integral of exp(-k t) [s]."""
    x = rate * t
    is_small = jnp.abs(x) < 0.5
    large_x = jnp.where(is_small, 1, x)
    return t * jnp.where(is_small, _series(x, 1), -jnp.expm1(-large_x) / large_x)


def decay_twice(rate: Array, t: Array) -> Array:
    """(t - decay)/k, t^2/2 at k = 0: the integral of ``decay`` [s^2]."""
    x = rate * t
    is_small = jnp.abs(x) < 0.5
    large_x = jnp.where(is_small, 1, x)
    return (
        t
        * t
        * jnp.where(is_small, _series(x, 2), (large_x + jnp.expm1(-large_x)) / (large_x * large_x))
    )


def _series(x: Array, first: int) -> Array:
    """Sum of (-x)^n/(n + first)! for |x| < 1/2; elsewhere a number with finite derivatives."""
    x = jnp.where(jnp.abs(x) < 0.5, x, 0)
    total, n = jnp.ones_like(x), 14
    for k in range(n + first, first, -1):
        total = 1 - x * total / k
    return total / first


def driven_spin(
    start: Array, rate: Array, gain: Array, t: Array
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Rate [rad/s] and angle [rad] of ds/dt = gain - rate s from s = ``start``."""
    decayed = decay(rate, t)
    return start * jnp.exp(-rate * t) + gain * decayed, start * decayed + gain * decay_twice(
        rate, t
    )


def rotation_about(axis: tuple[Array, Array, Array], angle: Array) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation by ``angle`` [rad] about the unit ``axis``."""
    c, s = jnp.cos(angle / 2), jnp.sin(angle / 2)
    return jnp.stack(jnp.broadcast_arrays(c, *(s * a for a in axis)), axis=-1)


def precession(
    wxyz: Float[Array, "*b 4"],
    momentum_space: Float[Array, "*b 3"],
    transverse: Array,
    axial_rate: Array,
    elapsed: Float[Array, "*b t"],
) -> Float[Array, "*b t 4"]:
    """Attitude of a symmetric body whose momentum has a constant direction (regular precession).

    The axis rotates about ``momentum_space`` at |L|/A, and the body about its axis at
    ``axial_rate`` = omega_z - L_z/A [rad/s]; ``elapsed``: time, or the integral of the factor by
    which both rates decay.
    """
    rate = momentum_space / transverse[..., None]
    outer = rotation_vector_to_wxyz(rate[..., None, :] * elapsed[..., None])  # regular at rest
    zero = jnp.zeros_like(elapsed)
    inner = rotation_about((zero, zero, zero + 1), axial_rate[..., None] * elapsed)
    start = jnp.broadcast_to(wxyz[..., None, :], outer.shape)
    return multiply(multiply(outer, start), inner)
