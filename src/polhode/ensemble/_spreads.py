"""How one body of an ensemble differs from the nominal one: each spread changes one thing.

A spread is any callable ``(key, scene, state) -> (scene, state)`` of one body; those here cover
what scene files can say.
"""

import dataclasses
import zlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode import rotation
from polhode._scene import BodyTorque, Scene, SpaceTorque, State
from polhode.files._arrays import possible_moments
from polhode.inertia import Inertia

_MOST_DRAWS = 100


class Deviate(eqx.Module):
    """Random numbers (3,) of mean zero: normal of standard deviation ``scale`` (3,), or uniform
    in +-``scale`` with ``uniform=True``.
    """

    scale: Float[Array, " 3"]
    uniform: bool = eqx.field(static=True, default=False)

    def __call__(self, key: Array) -> Array:
        if self.uniform:
            return self.scale * jax.random.uniform(key, (3,), self.scale.dtype, -1, 1)
        return self.scale * jax.random.normal(key, (3,), self.scale.dtype)


class SpreadMoments(eqx.Module):
    """Principal moments times (1 + deviate); draws that no body can have are drawn again.

    After 100 impossible draws the moments become NaN, and the status of the body says so.
    """

    relative: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        nominal = scene.inertia.moments

        def draw(trial):
            return nominal * (1 + self.relative(jax.random.fold_in(key, trial)))

        def unfinished(carry):
            trial, moments = carry
            return ~possible_moments(moments) & (trial < _MOST_DRAWS)

        def again(carry):
            trial, _ = carry
            return trial + 1, draw(trial)

        zero = jnp.zeros((), jnp.int32)
        _, moments = jax.lax.while_loop(unfinished, again, (zero + 1, draw(zero)))
        moments = jnp.where(possible_moments(moments), moments, jnp.nan)
        return dataclasses.replace(scene, inertia=Inertia.from_moments(moments)), state


class SpreadAttitude(eqx.Module):
    """The attitude followed by a rotation about body axes by the rotation vector ``turn`` [rad]."""

    turn: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        turn = rotation.rotation_vector_to_wxyz(self.turn(key))
        return scene, State(
            rotation.multiply(state.wxyz, turn), state.omega_body, state.wheel_speed
        )


class AnyAttitude(eqx.Module):
    """Attitudes spread evenly over all rotations."""

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        wxyz = jax.random.normal(key, (4,), state.wxyz.dtype)
        return scene, State(wxyz, state.omega_body, state.wheel_speed)


class SpreadEuler(eqx.Module):
    """Euler ``angles`` (3,) [rad] of a sequence, each with its deviate [rad]."""

    angles: Float[Array, " 3"]
    deviate: Deviate
    sequence: rotation.Sequence = eqx.field(static=True)

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        a = self.angles + self.deviate(key)
        wxyz = rotation.euler_to_wxyz(a[0], a[1], a[2], self.sequence)
        return scene, State(wxyz, state.omega_body, state.wheel_speed)


class SpreadRates(eqx.Module):
    """Body rates plus a deviate [rad/s]."""

    deviate: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        return scene, State(state.wxyz, state.omega_body + self.deviate(key), state.wheel_speed)


class SpreadMomentum(eqx.Module):
    """Body momentum ``momentum`` (3,) [kg m^2/s] plus a deviate: rates follow from the inertia
    that the spreads before this one left.
    """

    momentum: Float[Array, " 3"]
    deviate: Deviate | None = None

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        momentum = self.momentum if self.deviate is None else self.momentum + self.deviate(key)
        return scene, State(state.wxyz, scene.inertia.rates(momentum), state.wheel_speed)


class SpreadTorque(eqx.Module):
    """The constant torque of a scene (``BodyTorque`` or ``SpaceTorque``) plus a deviate [N m]."""

    deviate: Deviate

    def __call__(self, key: Array, scene: Scene, state: State) -> tuple[Scene, State]:
        return with_torque(scene, constant_torque(scene) + self.deviate(key)), state


def constant_torque(scene: Scene) -> Array:
    """The numbers of the one constant torque of a scene [N m]. Raises TypeError without one."""
    torque = scene.torque
    if not isinstance(torque, BodyTorque | SpaceTorque) or not isinstance(torque.n, Array):
        raise TypeError(
            "torques of an ensemble vary around one constant ph.BodyTorque or ph.SpaceTorque, got"
            f" {type(torque).__name__}: give the scene such a torque, or write your own spread."
        )
    return torque.n


def with_torque(scene: Scene, n: Array) -> Scene:
    """The scene with its constant torque replaced."""
    return eqx.tree_at(lambda s: s.torque.n, scene, n)


def stream_of(spread: Any) -> int:
    """The number of a spread's own stream of random numbers, from its name: adding one spread
    leaves the draws of the others as they are.
    """
    name = getattr(spread, "__name__", type(spread).__name__)
    return zlib.crc32(name.encode())
