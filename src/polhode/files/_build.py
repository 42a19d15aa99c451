"""From a checked scene file to polhode's objects, in the dtype asked for."""

import contextlib
import functools
import operator
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

import polhode
from polhode import rotation
from polhode._scene import narrower
from polhode.files._bodies import AnySolid, Attitudes
from polhode.files._error import SceneFileError
from polhode.files._models import SceneFile
from polhode.files._table import Table
from polhode.inertia import Inertia, MassProperties, compose

_TORQUES = {
    "body": "BodyTorque",
    "space": "SpaceTorque",
    "linear-damping": "LinearDamping",
    "quadratic-damping": "QuadraticDamping",
    "energy-sink": "EnergySink",
    "rate-damping": "RateDamping",
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


def _float_parts(part: Any, dtype: DTypeLike) -> Any:
    """The part with all numbers, defaults too, in the dtype."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype) if eqx.is_array_like(x) else x, part)


def build_orbit(file: SceneFile, dtype: DTypeLike) -> "polhode.AbstractOrbit | None":
    """The [orbit], or None."""
    table = file.orbit
    if table is None:
        return None
    orbit = polhode.HyperbolicOrbit if table.is_hyperbolic else polhode.KeplerOrbit
    make = orbit if table.position is None else orbit.from_state
    with blamed(file, "[orbit]"):
        return _float_parts(make(**_numbers(table, dtype, "unit")), dtype)


def _potential(file: SceneFile, table: Any, orbit: Any, dtype: DTypeLike) -> Any:
    numbers = _numbers(table, dtype, "kind")
    if table.kind == "uniform-gravity":
        return narrower(polhode.UniformGravity(**numbers))
    if table.needs_orbit:
        return polhode.GravityGradient(orbit.mu, orbit)
    return polhode.GravityGradient(**numbers)


def _torque(file: SceneFile, table: Any, orbit: Any, dtype: DTypeLike) -> Any:
    if table.kind == "pointing":
        numbers = _numbers(table, dtype, "kind", "frame", "wxyz", "euler")
        torque = polhode.Pointing(**numbers, target=build_attitudes(table.target, dtype))
    elif table.kind == "magnetorquer":
        moment = table.moment_body
        if table.b_dot is not None:
            moment = _float_parts(polhode.BDot(**_numbers(table.b_dot, dtype)), dtype)
        else:
            moment = np.asarray(moment, dtype)
        if table.dipole_space is None:
            torque = polhode.MagneticDipole(moment, np.asarray(table.field_space, dtype))
        else:
            field = polhode.DipoleField(np.asarray(table.dipole_space, dtype))
            torque = polhode.MagneticDipole(moment, field, orbit)
    elif table.kind == "pulses":
        kind = polhode.BodyTorque if table.axes == "body" else polhode.SpaceTorque
        numbers = _numbers(table, dtype, "kind", "frame", "axes")
        torque = polhode.Pulses(kind(numbers["n"]), numbers["starts"], numbers["ends"])
    else:
        kind = getattr(polhode, _TORQUES[table.kind])
        torque = kind(**_numbers(table, dtype, "kind", "frame"))
    if table.frame == "lvlh":
        torque = polhode.RelativeTorque(torque, polhode.LVLH(orbit))
    return torque


def _rotor(file: SceneFile, table: Any, orbit: Any, dtype: DTypeLike) -> Any:
    couplings = []
    if table.viscous is not None:
        couplings.append(polhode.ViscousCoupling(np.asarray(table.viscous, dtype)))
    if table.coulomb is not None:
        couplings.append(polhode.CoulombFriction(**_numbers(table.coulomb, dtype)))
    if table.motor is not None:
        couplings.append(polhode.Motor(**_numbers(table.motor, dtype)))
    numbers = _numbers(table, dtype, "viscous", "coulomb", "motor")
    if couplings:
        numbers["coupling"] = functools.reduce(operator.add, couplings)
    return narrower(polhode.Rotor(**numbers))


def _sum(file: SceneFile, key: str, build: Callable, orbit: Any, dtype: DTypeLike) -> Any:
    """The parts of a list of tables, added; None where there is none."""
    parts, tables = [], getattr(file, key)
    for index, table in enumerate(tables):
        with blamed(file, f"[{key}]" if len(tables) == 1 else f"[{key} {index + 1}]"):
            parts.append(_float_parts(build(file, table, orbit, dtype), dtype))
    return functools.reduce(operator.add, parts) if parts else None


def build_scene(
    file: SceneFile, dtype: DTypeLike, inertia: Inertia | None = None
) -> "polhode.Scene":
    """The scene with `inertia`, or with the nominal one of the file.

    Raises SceneFileError, naming the place, for numbers that a constructor refuses.
    """
    inertia = build_inertia(file, dtype) if inertia is None else inertia
    orbit = build_orbit(file, dtype)
    builders = {"potential": _potential, "torque": _torque, "rotors": _rotor}
    parts = {key: _sum(file, key, build, orbit, dtype) for key, build in builders.items()}
    with blamed(file, ""):
        return polhode.Scene(inertia, **parts)


def build_events(file: SceneFile, dtype: DTypeLike) -> dict[str, "polhode.Event"]:
    """The [[events]] by name."""
    events = {}
    directions = {"rising": 1, "falling": -1, "both": 0}
    for table in file.events:
        direction = directions[table.crossing]
        if table.rate is not None:
            function = _RateLimit(jnp.asarray(table.rate, dtype))
        else:
            axis, space = (
                jnp.asarray(np.asarray(x) / np.linalg.norm(x), dtype)
                for x in (table.axis_body, table.direction_space)
            )
            function = _Angle(axis, space, jnp.asarray(table.angle, dtype))
            direction = -direction  # the cosine falls where the angle grows
        events[table.name] = polhode.Event(function, direction)
    return events


class _RateLimit(eqx.Module):
    """|omega|^2 less that of the limit."""

    limit: Array

    def __call__(self, wxyz: Array, omega_body: Array, t: Array) -> Array:
        return jnp.sum(omega_body**2) - self.limit**2


class _Angle(eqx.Module):
    """Cosine of the angle from a body axis to a direction in space, less that of the limit."""

    axis_body: Array
    direction_space: Array
    angle: Array

    def __call__(self, wxyz: Array, omega_body: Array, t: Array) -> Array:
        axis = rotation.rotate(wxyz, self.axis_body)
        return jnp.sum(axis * self.direction_space) - jnp.cos(self.angle)


def build_state(file: SceneFile, dtype: DTypeLike, inertia: Inertia) -> "polhode.State":
    """The nominal state at the first time."""
    with blamed(file, "[state]"):
        value = jnp.asarray(file.state.value, dtype)
        omega = inertia.rates(value) if file.state.rate == "momentum_body" else value
        wxyz = build_attitudes(file.state.attitude, dtype)
        if file.state.frame == "lvlh":
            frame = polhode.LVLH(build_orbit(file, dtype))
            first = jnp.asarray(file.times.seconds[0], dtype)
            wxyz, omega = frame.from_frame(wxyz, omega, first)
        return polhode.State(wxyz=wxyz, omega_body=omega)
