"""Driven and damped spin in elementary functions as methods: symmetric tops, a fixed axis."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode import rotation
from polhode._checks import is_concrete
from polhode._closed_forms import tops
from polhode._closed_forms._closed_form import AbstractTopMethod
from polhode._closed_forms._conditions import (
    as_lanes,
    axial_start,
    axial_wheels,
    broadcast,
    not_linear,
    not_symmetric,
    push_and_damping,
    steady_wheels,
)
from polhode._kernels import derivable_once
from polhode._method._base import Record
from polhode._scene import Scene, State


class SymmetricTop(AbstractTopMethod):
    """A symmetric body without potential, in elementary functions: exact.

    Constant torque about the axis of symmetry (body z), linear damping symmetric about it and
    wheels of constant momentum on it. The rates are elementary in all these; the attitude where
    the momentum keeps its direction: without torque, and with damping proportional to the moments
    (``c = k I``) and no wheel, so that otherwise ``ph.Record(attitude=False)`` is needed.
    """

    chunk: int = eqx.field(static=True, default=2**14)

    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        refusal = self.objection(scene) or not_symmetric(scene) or axial_wheels(scene)
        if refusal is not None:
            return refusal
        if not is_concrete(scene.torque):
            return "the torques are not known to be symmetric about body z"
        push, damping = (np.asarray(x) for x in push_and_damping(scene))
        if np.any(push[..., :2] != 0) or np.any(damping[..., 0] != damping[..., 1]):
            return "a torque is not symmetric about body z"
        if not record.attitude:
            return None
        if np.any(push != 0):
            return "the attitude of a driven body is not elementary (ph.Record(attitude=False))"
        if np.any(damping != 0):
            if scene.rotors is not None:
                return "the attitude of a damped body with wheels is not elementary"
            if not is_concrete(scene.inertia) or not _proportional(scene, damping):
                return "the attitude is elementary only for damping proportional to the moments"
        return None

    def objection(self, scene: Scene) -> str | None:
        return not_linear(scene) or (
            None if scene.inertia.is_principal else "the body axes are not known to be principal"
        )

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        transverse, moments, axial = axial_start(scene, state)
        push, damping = (as_lanes(x, n, 1) for x in push_and_damping(scene))
        own = moments[:, 2]
        carried = axial - own * state.omega_body[:, 2]
        fading, slowing = damping[:, 0] / transverse, damping[:, 2] / own
        spin, angle = tops.spin(
            state.omega_body[:, 2, None], slowing[:, None], (push[:, 2] / own)[:, None], elapsed
        )
        # W = omega_x + i omega_y obeys A dW/dt = i ((C - A) omega_z + h) W - c W
        turned = ((own - transverse) / transverse)[:, None] * angle
        turned = turned + (carried / transverse)[:, None] * elapsed
        c, s = jnp.cos(turned), jnp.sin(turned)
        shrink = jnp.exp(-fading[:, None] * elapsed)
        x, y = state.omega_body[:, 0, None], state.omega_body[:, 1, None]
        omega = jnp.stack([shrink * (x * c - y * s), shrink * (x * s + y * c), spin], axis=-1)
        flat = jnp.stack([transverse, transverse], axis=-1) * state.omega_body[:, :2]
        momentum = jnp.concatenate([flat, axial[:, None]], axis=-1)
        wxyz = tops.precession(
            state.wxyz,
            rotation.rotate(state.wxyz, momentum),
            transverse,
            state.omega_body[:, 2] - axial / transverse,
            tops.decay(fading[:, None], elapsed),
        )
        lawful = (moments[:, 0] == moments[:, 1]) & jnp.all(push[:, :2] == 0, axis=-1)
        lawful = lawful & (damping[:, 0] == damping[:, 1]) & steady_wheels(scene, n)
        keeps = (push[:, 2] == 0) & _equal(fading, slowing) & ((carried == 0) | (fading == 0))
        wxyz = jnp.where(keeps[:, None, None], wxyz, jnp.nan)
        return wxyz, omega, lawful


def _equal(a: Array, b: Array) -> Array:
    """Equal to a few units in the last place: ratios of what was meant to be proportional."""
    return jnp.abs(a - b) <= 4 * jnp.finfo(a.dtype).eps * jnp.abs(a)


def _proportional(scene: Scene, damping) -> bool:
    rates, moments = broadcast(np.asarray(damping), np.asarray(scene.inertia.moments))
    rates = rates / moments
    return bool(np.all(_equal(rates[..., 0], rates[..., 2])))


class FixedAxis(AbstractTopMethod):
    """Spin about one principal axis that stays fixed, driven and damped: exact.

    All rates but one are zero at the start, the constant body torques lie along that axis and the
    damping is linear: d omega/dt = (N - c omega)/I. The axis may differ from body to body.
    Derivatives with respect to rates and torques across the axis of a body that turns are those of
    this motion only: zero. Second ones of a body at rest are NaN. (Where these are traced,
    ``ph.simulate`` does not choose this method by itself.)
    """

    chunk: int = eqx.field(static=True, default=2**14)

    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        refusal = self.objection(scene)
        if refusal is not None:
            return refusal
        if not is_concrete(scene.torque, state.omega_body):
            return "the rates are not known to lie along one principal axis"
        with jax.ensure_compile_time_eval():  # known numbers, also inside of jit
            push, _ = push_and_damping(scene)
            acting = broadcast(np.asarray(push) != 0, np.asarray(state.omega_body) != 0)
            used = np.logical_or(*map(np.asarray, acting))
        if np.any(used.sum(axis=-1) > 1):
            return "rates or torques do not lie along one principal axis"
        return None

    def objection(self, scene: Scene) -> str | None:
        if scene.rotors is not None:
            return "rotors turn in the body"
        if not scene.inertia.is_principal:
            return "the body axes are not known to be principal"
        return not_linear(scene)

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        push, damping = (as_lanes(x, n, 1) for x in push_and_damping(scene))
        moments = as_lanes(scene.inertia.moments, n, 1)
        used = (push != 0) | (state.omega_body != 0)
        later = elapsed[:, :, None] * jnp.ones_like(moments)[:, None]
        axis = jnp.argmax(used, axis=-1)
        along = jnp.arange(3)[None] == axis[:, None]
        moving = jnp.any(used, axis=-1, keepdims=True)
        # Across the axis of a body that turns nothing is differentiated; at rest the equations are
        # coupled in second order only.
        held = jax.lax.stop_gradient
        rates, push = (jnp.where(along | ~moving, x, held(x)) for x in (state.omega_body, push))
        both = jnp.concatenate([rates, push], axis=-1)
        resting = jnp.broadcast_to(~moving, both.shape)
        once = jnp.sum(derivable_once(both, resting) - both, axis=-1, keepdims=True)  # zero
        omega, angles = tops.spin(
            (rates + once)[:, None],
            (damping / moments)[:, None],
            (push / moments)[:, None],
            later,
        )
        turn = rotation.rotation_vector_to_wxyz(angles)  # regular at rest
        wxyz = rotation.multiply(jnp.broadcast_to(state.wxyz[:, None], turn.shape), turn)
        return wxyz, omega, jnp.sum(used, axis=-1) <= 1
