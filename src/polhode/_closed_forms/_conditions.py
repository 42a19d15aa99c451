"""What the exact tops ask of a scene, and what they read from it."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import is_concrete
from polhode._scene import BodyTorque, LinearDamping, Scene, State, TorqueSum, Wheels
from polhode.inertia import Symmetry


def as_lanes(array: Array, n: int, rank: int = 0) -> Array:
    """An array of one body or of N lanes as lanes (N, ...)."""
    core = array.shape[array.ndim - rank :]
    return jnp.broadcast_to(array, (n, *core))


def broadcast(*arrays):
    shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
    return tuple(jnp.broadcast_to(x, shape) for x in arrays)


def axial_wheels(scene: Scene) -> str | None:
    """Objection to rotors other than wheels of constant momentum on body z."""
    rotors = scene.rotors
    if rotors is None:
        return None
    along = rotors.along if isinstance(rotors, Wheels) else tuple(w.along for w in rotors.wheels)
    if any(axis != 2 for axis in along):
        return "a rotor is not known to lie on body z"
    if isinstance(rotors, Wheels):
        moved = not all(held or f is None for held, f in zip(rotors.held, rotors.impulses))
        moved = moved or bool(rotors.coupled)
        torques = [rotors.torque]
    else:
        moved = any(not (w.impulse is None and w.coupling is None) for w in rotors.wheels)
        torques = [w.torque for w in rotors.wheels if w.torque is not None]
    if moved:
        return "a motor turns a rotor by a function of time or state"
    if not all(is_concrete(x) and np.all(np.asarray(x) == 0) for x in torques):
        return "a motor turns a rotor"
    return None


def not_symmetric(scene: Scene) -> str | None:
    inertia = scene.inertia
    if not inertia.is_principal:
        return "the body axes are not known to be principal"
    if inertia.symmetry is Symmetry.NONE:
        if not is_concrete(inertia):
            return "the moments about body x and y are not known to be equal"
        moments = np.asarray(inertia.moments)
        if np.any(moments[..., 0] != moments[..., 1]):
            return "the moments about body x and y differ"
    return None


def axial_start(scene: Scene, state: State) -> tuple[Array, Array, Array]:
    """Moments A, C of the carrier, and the axial momentum, of lanes."""
    n = state.wxyz.shape[0]
    moments = as_lanes(scene.carrier.moments, n, 1)
    axial = moments[:, 2] * state.omega_body[:, 2]
    wheels: Any = scene.rotors
    if wheels is not None:
        axial = axial + as_lanes(wheels.body_momentum(wheels.start)[2], n)
    return (moments[:, 0] + moments[:, 1]) / 2, moments, axial


def steady_wheels(scene: Scene, n: int) -> Array:
    """Lanes on which no motor turns a wheel."""
    wheels: Any = scene.rotors
    if wheels is None:
        return jnp.ones(n, bool)
    if wheels.coupled or any(f is not None for f in wheels.impulses):
        return jnp.zeros(n, bool)
    return jnp.all(as_lanes(wheels.torque, n, 1) == 0, axis=-1)


def _terms(torque: Any) -> tuple[Any, ...]:
    if torque is None:
        return ()
    return torque.terms if isinstance(torque, TorqueSum) else (torque,)


def not_linear(scene: Scene) -> str | None:
    """Objection to anything but constant body torques and linear damping."""
    if scene.potential is not None:
        return "a potential acts"
    for term in _terms(scene.torque):
        constant = isinstance(term, BodyTorque) and not callable(term.n)
        if not (constant or isinstance(term, LinearDamping)):
            return "a torque acts that is neither constant in body axes nor linear damping"
    return None


def push_and_damping(scene: Scene) -> tuple[Array, Array]:
    """Total constant body torque and coefficients of damping, (..., 3) each."""
    push = damping = jnp.zeros(3, scene.inertia.dtype)
    for term in _terms(scene.torque):
        if isinstance(term, BodyTorque):
            push = jnp.add(*broadcast(push, term.n))
        else:
            damping = jnp.add(*broadcast(damping, term.c))
    return push, damping
