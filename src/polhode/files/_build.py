"""From a checked scene file to polhode's objects, in the dtype asked for."""

import contextlib
import functools
import operator
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

import polhode
from polhode import rotation
from polhode.files._bodies import AnySolid, Attitudes
from polhode.files._error import SceneFileError
from polhode.files._models import SceneFile
from polhode.files._table import Table
from polhode.inertia import Inertia, MassProperties, compose

_CLASSES = {
    "uniform-gravity": "UniformGravity",
    "gravity-gradient": "GravityGradient",
    "body": "BodyTorque",
    "space": "SpaceTorque",
    "linear-damping": "LinearDamping",
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
    table = file.inertia
    kind, value = next((name, value) for name, value in table.given() if name != "unit")
    with blamed(file, f"[inertia] {kind}"):
        if kind == "parts":
            return compose([_solid(solid, dtype) for solid in value]).inertia
        if kind == "axisymmetric":
            return Inertia.axisymmetric(**_numbers(value, dtype))
        make = {"moments": Inertia.from_moments, "tensor": Inertia.from_tensor}
        return make.get(kind, Inertia.spherical)(np.asarray(value, dtype))


def _numbers(table: Table, dtype: DTypeLike, *others: str) -> dict[str, np.ndarray]:
    """The keys that hold numbers: all but the `others`."""
    return {k: np.asarray(value, dtype) for k, value in table.given() if k not in others}


def _solid(table: AnySolid, dtype: DTypeLike) -> MassProperties:
    make = getattr(MassProperties, f"from_{table.shape}")
    turn = None if table.euler is None else build_attitudes(table.euler.attitude, dtype)
    solid = make(**_numbers(table, dtype, "shape", "centre", "euler"))
    return solid.moved(np.asarray(table.centre, dtype), turn)


def _objects(file: SceneFile, key: str, dtype: DTypeLike) -> list:
    made, tables = [], getattr(file, key)
    for index, table in enumerate(tables):
        kind = getattr(polhode, "Rotor" if key == "rotors" else _CLASSES[table.kind])
        with blamed(file, f"[{key}]" if len(tables) == 1 else f"[{key} {index + 1}]"):
            thing = kind(**_numbers(table, dtype, "kind"))
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
    acting = {key: _objects(file, key, dtype) for key in ("potential", "torque", "rotors")}
    acting = {key: functools.reduce(operator.add, made) for key, made in acting.items() if made}
    with blamed(file, ""):
        return polhode.Scene(inertia, **acting)


def build_state(file: SceneFile, dtype: DTypeLike, inertia: Inertia) -> "polhode.State":
    """The nominal state at the first time."""
    with blamed(file, "[state]"):
        value = jnp.asarray(file.state.value, dtype)
        omega = inertia.rates(value) if file.state.rate == "momentum_body" else value
        return polhode.State(wxyz=build_attitudes(file.state.attitude, dtype), omega_body=omega)
