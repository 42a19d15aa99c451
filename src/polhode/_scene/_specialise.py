"""Numbers that a narrower constructor says by its name: what ``ph.specialise`` finds."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from polhode._checks import is_concrete
from polhode._parts import AbstractSum
from polhode._scene._orbits import KeplerOrbit
from polhode._scene._potentials import GravityGradient, PotentialSum, UniformGravity
from polhode._scene._scene import Scene
from polhode._scene._wheels import Rotor, RotorSum
from polhode.inertia import Inertia


def specialise(scene: Scene) -> Scene:
    """The scene with the narrowest constructors that its numbers allow.

    Equal principal moments become ``ph.Inertia.spherical``, equal moments about body x and y
    ``ph.Inertia.axisymmetric``, a diagonal tensor three moments; a centre of mass on body z
    becomes ``ph.UniformGravity.axial``; a wheel along a positive body axis ``ph.Rotor.axial``; an
    ellipse of eccentricity 0 a circle. The motion is the same, and ``ph.simulate`` may have a
    closed-form solution for it. Numbers that the narrower parts do not hold have no derivative any
    more: call it once, on a scene of concrete numbers. Of a batch all bodies must agree.

        scene = ph.Scene(ph.Inertia([1.0, 1.0, 0.5]), ph.UniformGravity(1.0, [0.0, 0.0, 0.3]))
        ph.simulate(ph.specialise(scene), state, ts)       # Lagrange's top, not integrated

    Raises TypeError for what is no ``ph.Scene``, ValueError while its numbers are traced.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"specialise takes a ph.Scene, got {type(scene).__name__}.")
    if not is_concrete(scene):
        raise ValueError("specialise needs concrete numbers: call it outside of jit and grad.")
    with jax.ensure_compile_time_eval():  # the numbers are known, also under jit
        inertia, potential, rotors = map(narrower, (scene.inertia, scene.potential, scene.rotors))
    return Scene(inertia, potential, scene.torque, rotors)


def narrower(part: Any) -> Any:
    """The same part by the narrowest constructor for its numbers."""
    if isinstance(part, (PotentialSum, RotorSum)):
        return type(part)(tuple(narrower(term) for term in part.terms))
    for kind, rule in _RULES.items():
        if isinstance(part, kind):
            return rule(part)
    return part


def constructors(scene: Scene, special: Scene) -> list[str]:
    """The names of the constructors by which ``special`` is narrower than ``scene``."""
    found = []
    if scene.inertia.symmetry is not special.inertia.symmetry:
        found.append(f"ph.Inertia.{special.inertia.symmetry.name.lower()}")
    elif scene.inertia.is_principal is not special.inertia.is_principal:
        found.append("ph.Inertia.from_moments")
    if _count(scene.potential, _is_axial_weight) < _count(special.potential, _is_axial_weight):
        found.append("ph.UniformGravity.axial")
    if _count(scene.rotors, _is_axial_wheel) < _count(special.rotors, _is_axial_wheel):
        found.append("ph.Rotor.axial")
    return found


def _is_axial_weight(part: Any) -> bool:
    return isinstance(part, UniformGravity) and part.distance is not None


def _is_axial_wheel(part: Any) -> bool:
    return isinstance(part, Rotor) and part.axis is not None


def _count(part: Any, condition: Any) -> int:
    return sum(map(condition, part.terms if isinstance(part, AbstractSum) else (part,)))


def _inertia(inertia: Inertia) -> Inertia:
    if inertia.symmetry.name == "SPHERICAL":
        return inertia
    tensor = np.asarray(inertia.tensor)
    x, y, z = (tensor[..., i, i] for i in range(3))
    products = tensor - np.stack([x, y, z], axis=-1)[..., None] * np.eye(3, dtype=tensor.dtype)
    if np.any(products != 0):
        return inertia
    if np.all((x == y) & (y == z)):
        return Inertia(moment=x, physical=inertia.physical)
    if np.all(x == y):
        return Inertia(transverse=x, axial=z, physical=inertia.physical)
    return Inertia(diagonal=np.stack([x, y, z], axis=-1), physical=inertia.physical)


def _weight(field: UniformGravity) -> UniformGravity:
    centre = field.centre_body
    if centre is None or np.any(np.asarray(centre)[..., :2] != 0):
        return field
    return UniformGravity.axial(field.mass, centre[..., 2], field.gravity_space)


def _gradient(field: GravityGradient) -> GravityGradient:
    orbit = narrower(field.position_space)
    return field if orbit is field.position_space else GravityGradient(field.mu, orbit)


def _wheel(wheel: Rotor) -> Rotor:
    if wheel.axis_body is None:
        return wheel
    vector = np.asarray(wheel.axis_body)
    for axis in range(3):
        if np.all(np.delete(vector, axis, axis=-1) == 0) and np.all(vector[..., axis] > 0):
            return Rotor.axial(
                wheel.inertia,
                wheel.momentum,
                wheel.speed,
                wheel.torque,
                wheel.impulse,
                wheel.coupling,
                axis=axis,
            )
    return wheel


def _orbit(orbit: KeplerOrbit) -> KeplerOrbit:
    if orbit.eccentricity is None or np.any(np.asarray(orbit.eccentricity) != 0):
        return orbit
    return eqx.tree_at(lambda o: o.eccentricity, orbit, None)


_RULES = {
    Inertia: _inertia,
    UniformGravity: _weight,
    GravityGradient: _gradient,
    Rotor: _wheel,
    KeplerOrbit: _orbit,
}
