"""Bodies that failed: their samples and tangents are NaN, and what they contribute to gradients.

Zero, as long as another body of the call finished, so that a loss that leaves failed bodies out has
the gradient of the others. If none finished the gradient is NaN: zeros would tell an optimiser that
it has arrived. For both, no state that is NaN may be in a program of derivatives: a cotangent of
zero times NaN is NaN, and reaches the parameters that all bodies share.
"""

import jax.numpy as jnp
from jaxtyping import Array

from polhode._kernels import any_of, attached, linear
from polhode._scene import State


def sound_state(
    state: State, is_needed: Array | bool = True, rate: float = 0.0
) -> tuple[State, Array]:
    """The state with attitudes and rates that are NaN or infinite replaced if that ``is_needed``,
    and which bodies (...) were finite. ``rate`` [rad/s]: about every axis in their place."""
    is_attitude, is_rate = (
        jnp.isfinite(x).all(-1) | ~jnp.asarray(is_needed) for x in (state.wxyz, state.omega_body)
    )
    sound = State.of_samples(
        jnp.where(is_attitude[..., None], state.wxyz, 0.5),
        jnp.where(is_rate[..., None], state.omega_body, rate),
        state.wheel_speed,
    )
    return sound, is_attitude & is_rate


def where_lost(x: Array, is_known: Array, value: float = jnp.nan) -> Array:
    """``x`` where it is known, elsewhere ``value``, with tangents of NaN or zero as that is.

    ``is_known`` has the first axes of ``x``. Cotangents pass unchanged: see ``with_gradients``.
    """
    is_known = jnp.expand_dims(is_known, tuple(range(is_known.ndim, x.ndim)))

    def rule(operands, tangents, values):
        def tangent(known, tangents):
            return [jnp.where(known[0], tangents[0], 0 * value)]

        def cotangent(known, cotangents):
            return cotangents

        return linear(tangent, cotangent, [operands[1]], [tangents[0]], [operands[0]])

    return attached(rule, [x, is_known], [jnp.where(is_known, x, value)])[0]


def with_gradients(x: Array, is_sound: Array, any_finished: Array) -> Array:
    """``x``, NaN with its tangents for bodies that are not ``is_sound``, with cotangents of zero
    where it is NaN or infinite, and of NaN if no body has finished.

    One value of a motion at a time: cotangents that nobody asks for are not computed.
    """
    mask = jnp.expand_dims(is_sound, tuple(range(is_sound.ndim, x.ndim)))

    def rule(operands, tangents, values):
        def tangent(constants, tangents):
            return [jnp.where(constants[0], tangents[0], jnp.nan)]

        def cotangent(constants, cotangents):
            _, is_known, nothing = constants
            return [jnp.where(is_known, cotangents[0], nothing)]

        mask, any_finished = operands[1:]
        is_known = any_finished & jnp.isfinite(values[0])
        nothing = jnp.where(any_finished, 0, jnp.nan).astype(values[0].dtype)
        return linear(tangent, cotangent, [mask, is_known, nothing], [tangents[0]], values)

    return attached(rule, [x, mask, any_of(any_finished)], [jnp.where(mask, x, jnp.nan)])[0]
