"""From a checked scene file to polhode's objects, in the dtype asked for."""

import contextlib
import functools
import operator
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

import polhode
from polhode import rotation
from polhode.inertia import Inertia, MassProperties, compose
from polhode.io._error import SceneFileError
from polhode.io._specification import Attitudes, Part, SceneFile

_CLASSES = {
    "uniform-gravity": "UniformGravity",
    "gravity-gradient": "GravityGradient",
    "body": "BodyTorque",
    "space": "SpaceTorque",
    "linear-damping": "LinearDamping",
    "rotor": "Rotor",
}


@contextlib.contextmanager
def blamed(file: SceneFile, where: str) -> Iterator[None]:
    """Turn the error of a constructor into one that names the place in the scene file."""
    try:
        yield
    except SceneFileError:
        raise
    except (ValueError, TypeError) as error:
        raise SceneFileError(file.path, where, str(error)[:500]) from error


def build_attitudes(attitudes: Attitudes, dtype: DTypeLike) -> Float[Array, "*b 4"]:
    """Unit quaternions `wxyz`, body -> space."""
    values = jnp.asarray(attitudes.values, dtype)
    if attitudes.sequence is None:
        return rotation.normalise(values)
    sequence = rotation.Sequence[attitudes.sequence.upper()]
    return rotation.euler_to_wxyz(values[..., 0], values[..., 1], values[..., 2], sequence)


def build_inertia(file: SceneFile, dtype: DTypeLike) -> Inertia:
    """The nominal inertia. Raises SceneFileError for moments that no body has."""
    part = file.inertia
    with blamed(file, part.where):
        if part.kind == "parts":
            parts: Any = part.values["parts"]
            solids = [_solid(solid, place, dtype) for solid, place in parts]
            return compose(solids).inertia
        values = {name: np.asarray(value, dtype) for name, value in part.values.items()}
        if part.kind == "axisymmetric":
            return Inertia.axisymmetric(**values)
        make = {"moments": Inertia.from_moments, "tensor": Inertia.from_tensor}
        return make.get(part.kind, Inertia.spherical)(values[part.kind])


def _solid(part: Part, place: dict, dtype: DTypeLike) -> MassProperties:
    values = {name: np.asarray(value, dtype) for name, value in part.values.items()}
    solid = getattr(MassProperties, f"from_{part.kind}")(**values)
    turn = None if place["euler"] is None else build_attitudes(place["euler"], dtype)
    return solid.moved(np.asarray(place["centre"], dtype), turn)


def _objects(file: SceneFile, parts: tuple[Part, ...], dtype: DTypeLike) -> list:
    made = []
    for part in parts:
        kind = getattr(polhode, _CLASSES[part.kind])
        with blamed(file, part.where):
            thing = kind(**{k: np.asarray(v, dtype) for k, v in part.values.items()})
        # defaults that the file leaves out take the dtype too
        made.append(jax.tree.map(lambda x: jnp.asarray(x, dtype), thing))
    return made


def build_scene(
    file: SceneFile, dtype: DTypeLike, inertia: Inertia | None = None
) -> "polhode.Scene":
    """The scene with `inertia`, or with the nominal one of the file.

    Raises SceneFileError, naming the place, for numbers that a constructor refuses.
    """
    inertia = build_inertia(file, dtype) if inertia is None else inertia
    acting = {}
    for key, parts in zip(
        ("potential", "torque", "rotors"), (file.potentials, file.torques, file.rotors), strict=True
    ):
        objects = _objects(file, parts, dtype)
        if objects:
            acting[key] = functools.reduce(operator.add, objects)
    with blamed(file, ""):
        return polhode.Scene(inertia, **acting)


def build_state(file: SceneFile, dtype: DTypeLike, inertia: Inertia) -> "polhode.State":
    """The nominal state at the first time."""
    with blamed(file, "[state]"):
        value = jnp.asarray(file.state.value, dtype)
        omega = inertia.rates(value) if file.state.rate == "momentum_body" else value
        return polhode.State(wxyz=build_attitudes(file.state.attitude, dtype), omega_body=omega)
