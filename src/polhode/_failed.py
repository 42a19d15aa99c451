"""Bodies that failed: their samples and tangents are NaN, and they do not contribute to gradients.

The gradient of a failed body is zero, so that a loss that leaves it out has the gradient of the
other bodies. If no body of a call finished, the gradient is NaN, because an optimiser would take
zero for convergence.

Zero cotangents alone are not sufficient: zero times a state that is NaN is NaN, and the sum over
the bodies adds it to every shared parameter. Therefore programs that compute derivatives replace
NaN by numbers, and write NaN to their results at the end.
"""

import jax.numpy as jnp
from jaxtyping import Array

from polhode._kernels import any_of, linear, with_derivative_rule
from polhode._scene import State


def sound_state(
    state: State, is_needed: Array | bool = True, rate: float = 0.0
) -> tuple[State, Array]:
    """The state, in which numbers replace NaN and infinity if ``is_needed``; and which bodies (...)
    were finite. ``rate`` [rad/s]: the replacement for body rates, about every axis."""
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
    """``x`` where ``is_known``, elsewhere ``value``, with tangents of NaN if ``value`` is NaN, and
    of zero otherwise.

    ``is_known`` has the first axes of ``x``. Cotangents are not changed: see ``with_gradients``.
    """
    is_known = jnp.expand_dims(is_known, tuple(range(is_known.ndim, x.ndim)))

    def rule(operands, tangents, values):
        def tangent(known, tangents):
            return [jnp.where(known[0], tangents[0], 0 * value)]

        def cotangent(known, cotangents):
            return cotangents

        return linear(tangent, cotangent, [operands[1]], [tangents[0]], [operands[0]])

    return with_derivative_rule(rule, [x, is_known], [jnp.where(is_known, x, value)])[0]


def numbers(x: Array, value: float) -> Array:
    """``x``; in programs that compute derivatives, ``value`` replaces NaN and infinity, with zero
    tangents. Cotangents are not changed: see ``with_gradients``."""

    def again(operands):
        is_known = jnp.isfinite(operands[0])
        return [jnp.where(is_known, operands[0], value)], is_known

    def rule(operands, tangents, values, is_known):
        def tangent(known, tangents):
            return [jnp.where(known[0], tangents[0], 0)]

        def cotangent(known, cotangents):
            return cotangents

        return linear(tangent, cotangent, [is_known], [tangents[0]], values)

    return with_derivative_rule(rule, [x], [x], again)[0]


def with_gradients(x: Array, is_sound: Array, any_finished: Array) -> Array:
    """``x``, which is NaN with NaN tangents for bodies that are not ``is_sound``. Its cotangents
    are zero where it is NaN or infinite, and NaN everywhere if no body finished.

    It is applied to each array of a trajectory separately, so that only those cotangents are
    computed that a gradient needs.
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

    return with_derivative_rule(
        rule, [x, mask, any_of(any_finished)], [jnp.where(mask, x, jnp.nan)]
    )[0]
