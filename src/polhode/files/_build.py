"""Builders of polhode's objects from a validated scene file, in a given floating-point dtype."""

import functools
import inspect
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

import polhode
from polhode import rotation
from polhode._checks import require_positive
from polhode._hamiltonian import from_quaternion
from polhode._scene import narrower
from polhode.files._models import SceneFile
from polhode.files._read import SceneFileError, did_you_mean, possible_moments, scene_errors
from polhode.files._tables import AnySolid, Attitudes
from polhode.files._values import MOMENTS, NumberTable, Table, TimeTable
from polhode.inertia import Inertia, MassProperties, VariableInertia, compose
from polhode.inertia._physical import is_symmetric

if TYPE_CHECKING:
    import diffrax

_MAX_ROUNDS = 100  # rounds of drawing moments until enough of them are physical
_TORQUES = {
    "body": "BodyTorque",
    "space": "SpaceTorque",
    "linear-damping": "LinearDamping",
    "quadratic-damping": "QuadraticDamping",
    "energy-sink": "EnergySink",
    "rate-damping": "RateDamping",
}


def build_attitudes(attitudes: Attitudes, dtype: DTypeLike) -> Float[Array, "*b 4"]:
    """Unit quaternions `wxyz`, body -> space."""
    values = jnp.asarray(attitudes.values, dtype)
    if attitudes.sequence is None:
        return rotation.normalise(values)
    sequence = rotation.Sequence[attitudes.sequence]
    return rotation.euler_to_wxyz(values[..., 0], values[..., 1], values[..., 2], sequence)


def build_table(file: SceneFile, table: TimeTable, dtype: DTypeLike) -> "polhode.Table":
    """A table over time, from numbers in the scene or a CSV file beside it."""
    times, values = (np.asarray(x, dtype) for x in file.columns(table))
    return polhode.Table(
        times, values, table.order, kind="number" if values.ndim == 1 else "vector"
    )


def _over_time(file: SceneFile, value: Any, dtype: DTypeLike) -> Any:
    """A constant as an array, or a ``Table`` over time. Numbers (densities, visible parts of the
    Sun) must not be negative, in a table either."""
    if isinstance(value, TimeTable):
        table = build_table(file, value, dtype)
        if isinstance(value, NumberTable):
            hint = "remove rows without a value"
            require_positive("the numbers of a table", table.values, zero=True, hint=hint)
        return table
    return np.asarray(value, dtype)


def build_inertia(file: SceneFile, dtype: DTypeLike = float) -> "Inertia | VariableInertia":
    """The nominal inertia. Raises SceneFileError for unphysical moments."""
    table = file.inertia
    kind, value = next((name, value) for name, value in table.entries() if name != "unit")
    with scene_errors(file, f"[inertia] {kind}"):
        if kind == "parts":
            return compose([_solid(solid, dtype) for solid in value]).inertia
        if kind == "table":
            rows = build_table(file, value, dtype)
            unit = np.asarray(MOMENTS[table.unit], dtype)
            in_si = polhode.Table(rows.times, unit * rows.values, rows.order, kind="vector")
            _check_moments(file, np.asarray(in_si.values))
            return VariableInertia(in_si)
        if kind == "axisymmetric":
            return Inertia.axisymmetric(**_numbers(value, dtype))
        make = {"moments": Inertia.from_moments, "tensor": Inertia.from_tensor}
        return make.get(kind, Inertia.spherical)(np.asarray(value, dtype))


def _check_moments(file: SceneFile, rows: np.ndarray) -> None:
    """SceneFileError for an unphysical row of moments (n, 3) or tensors (n, 9)."""

    def check(bad, what, name, values, remedy):
        if bad.any():
            row = int(np.argmax(bad))
            found = f"row {row + 1}: {name}{values[row].tolist()}"
            raise SceneFileError(file.path, "[inertia.table]", what, found, remedy)

    if rows.shape[-1] == 9:
        tensors = rows.reshape(-1, 3, 3)
        is_skew = ~np.asarray(is_symmetric(jnp.asarray(tensors)))
        remedy = "equal products of inertia above and below the diagonal"
        check(is_skew, "a tensor that is not symmetric", "", tensors, remedy)
        rows = np.linalg.eigvalsh(tensors)
    remedy = "positive moments of which none exceeds the sum of the others"
    check(~possible_moments(rows), "impossible moments", "principal moments ", rows, remedy)


def _numbers(table: Table, dtype: DTypeLike, *others: str) -> dict[str, np.ndarray]:
    """The numbers of a table by key: all keys but the `others`."""
    return {k: np.asarray(value, dtype) for k, value in table.entries() if k not in others}


def _solid(table: AnySolid, dtype: DTypeLike) -> MassProperties:
    make = getattr(MassProperties, f"from_{table.shape}")
    turn = None if table.euler is None else build_attitudes(table.euler.attitude, dtype)
    solid = make(**_numbers(table, dtype, "shape", "centre", "euler"))
    return solid.moved(np.asarray(table.centre, dtype), turn)


def _float_parts(part: Any, dtype: DTypeLike) -> Any:
    """The part with all numbers, including defaults, in the dtype."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype) if eqx.is_array_like(x) else x, part)


def build_orbit(file: SceneFile, dtype: DTypeLike) -> "polhode.AbstractOrbit | None":
    """The [orbit], or None."""
    table = file.orbit
    if table is None:
        return None
    orbit = polhode.HyperbolicOrbit if table.is_hyperbolic else polhode.KeplerOrbit
    make = orbit if table.position is None else orbit.from_state
    with scene_errors(file, "[orbit]"):
        return _float_parts(make(**_numbers(table, dtype, "unit")), dtype)


def _potential(file: SceneFile, table: Any, orbit: Any, dtype: DTypeLike) -> Any:
    numbers = _numbers(table, dtype, "kind")
    if table.kind == "uniform-gravity":
        return narrower(polhode.UniformGravity(**numbers))
    if table.needs_orbit:
        return polhode.GravityGradient(orbit.mu, orbit)
    return polhode.GravityGradient(**numbers)


def _plates(table: Any, dtype: DTypeLike) -> "polhode.Plates":
    def column(name):
        return np.asarray([getattr(plate, name) for plate in table.plates], dtype)

    return polhode.Plates(column("area"), column("normal"), column("centre"))


class _Velocity(eqx.Module):
    """Velocity on an orbit, in space axes, as a function of time."""

    orbit: "polhode.AbstractOrbit"

    def __call__(self, t: Array) -> Array:
        return self.orbit.velocity_at(t)


def _surface_torque(file: SceneFile, table: Any, orbit: Any, dtype: DTypeLike) -> Any:
    """The torque of drag or solar pressure."""
    plates = _plates(table, dtype)
    if table.kind == "drag":
        density = _over_time(file, table.density, dtype)
        along = table.velocity == "orbit"
        velocity = _Velocity(orbit) if along else _over_time(file, table.velocity, dtype)
        return polhode.Drag(plates, density, velocity, np.asarray(table.coefficient, dtype))
    direction = _over_time(file, table.direction, dtype)
    lit = _over_time(file, table.lit, dtype)
    if table.eclipse is not None:
        lit = polhode.Eclipse(orbit, direction, np.asarray(table.eclipse.radius, dtype))
    others = _numbers(table, dtype, *_NO_NUMBERS)
    return polhode.SolarPressure(plates, direction, lit, **others)


_NO_NUMBERS = ("kind", "frame", "plates", "direction", "lit", "eclipse")


def _torque(file: SceneFile, table: Any, orbit: Any, dtype: DTypeLike) -> Any:
    if table.kind in ("drag", "solar-pressure"):
        torque = _surface_torque(file, table, orbit, dtype)
    elif table.kind in ("body", "space"):
        torque = getattr(polhode, _TORQUES[table.kind])(_over_time(file, table.n, dtype))
    elif table.kind == "momentum-dumping":
        numbers = _numbers(table, dtype, "kind", "frame", "dipole_space", "field_space")
        if table.dipole_space is None:
            field = {"field": np.asarray(table.field_space, dtype)}
        else:
            dipole = polhode.DipoleField(np.asarray(table.dipole_space, dtype))
            field = {"field": dipole, "position": orbit}
        torque = polhode.MomentumDumping(**numbers, **field)
    elif table.kind == "control-moment-gyro":
        numbers = _numbers(table, dtype, "kind", "frame", "angle")
        angle = build_table(file, table.angle, dtype)
        torque = polhode.ControlMomentGyro(**numbers, angle=angle)
    elif table.kind == "pointing":
        numbers = _numbers(table, dtype, "kind", "frame", "wxyz", "euler")
        torque = polhode.Pointing(**numbers, target=build_attitudes(table.attitude, dtype))
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


class _PointingLaw(eqx.Module):
    """Commanded torque of a wheel cluster: a pointing law."""

    law: "polhode.Pointing"

    def __call__(self, t: Array, wxyz: Array, omega_body: Array) -> Array:
        attitude = from_quaternion(tuple(wxyz[i] for i in range(4)))
        rates = tuple(omega_body[i] for i in range(3))
        return jnp.stack(self.law.body_components(t, attitude, rates))


def _cluster(file: SceneFile, table: Any, dtype: DTypeLike, first_wheel: int) -> Any:
    kp, kd = np.asarray(table.kp, dtype), np.asarray(table.kd, dtype)
    law = polhode.Pointing(kp, kd, build_attitudes(table.attitude, dtype))
    numbers = _numbers(table, dtype, "wxyz", "euler", "kp", "kd", "viscous")
    if table.viscous is not None:
        numbers["friction"] = polhode.ViscousCoupling(np.asarray(table.viscous, dtype))
    law = _float_parts(law, dtype)
    return polhode.wheel_cluster(command=_PointingLaw(law), first=first_wheel, **numbers)


def _wheels(file: SceneFile, dtype: DTypeLike) -> Any:
    """All wheels of the scene: [[rotors]], then [[clusters]]."""
    wheels = _sum(file, "rotors", _rotor, None, dtype)
    first_wheel = len(file.rotors)
    for index, table in enumerate(file.clusters):
        place = "[clusters]" if len(file.clusters) == 1 else f"[clusters {index + 1}]"
        with scene_errors(file, place):
            cluster = _float_parts(_cluster(file, table, dtype, first_wheel), dtype)
        wheels, first_wheel = (
            cluster if wheels is None else wheels + cluster,
            first_wheel + len(table.axes),
        )
    return wheels


def _sum(file: SceneFile, key: str, build: Callable, orbit: Any, dtype: DTypeLike) -> Any:
    """The sum of the parts of a list of tables; None for an empty list."""
    parts, tables = [], getattr(file, key)
    for index, table in enumerate(tables):
        with scene_errors(file, f"[{key}]" if len(tables) == 1 else f"[{key} {index + 1}]"):
            parts.append(_float_parts(build(file, table, orbit, dtype), dtype))
    return functools.reduce(operator.add, parts) if parts else None


def build_scene(
    file: SceneFile,
    dtype: DTypeLike = float,
    inertia: "Inertia | VariableInertia | None" = None,
) -> "polhode.Scene":
    """The scene with `inertia`, or with the nominal one of the file.

    `dtype`: of its numbers; `float` is the default precision of JAX.

    Raises SceneFileError, with the place in the file, for numbers that a constructor rejects.
    """
    inertia = build_inertia(file, dtype) if inertia is None else inertia
    orbit = build_orbit(file, dtype)
    builders = {"potential": _potential, "torque": _torque}
    parts = {key: _sum(file, key, build, orbit, dtype) for key, build in builders.items()}
    parts["rotors"] = _wheels(file, dtype)
    with scene_errors(file, ""):
        return polhode.Scene(inertia, **parts)


def build_events(file: SceneFile, dtype: DTypeLike = float) -> dict[str, "polhode.Event"]:
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
            direction = -direction  # the cosine decreases as the angle increases
        events[table.name] = polhode.Event(function, direction)
    return events


class _RateLimit(eqx.Module):
    """|omega|^2 minus the square of the limit."""

    limit: Array

    def __call__(self, wxyz: Array, omega_body: Array, t: Array) -> Array:
        return jnp.sum(omega_body**2) - self.limit**2


class _Angle(eqx.Module):
    """Cosine of the angle between a body axis and a direction in space, minus that of the limit."""

    axis_body: Array
    direction_space: Array
    angle: Array

    def __call__(self, wxyz: Array, omega_body: Array, t: Array) -> Array:
        axis = rotation.rotate(wxyz, self.axis_body)
        return jnp.sum(axis * self.direction_space) - jnp.cos(self.angle)


def _rates_of(file: SceneFile, inertia, wxyz: Array, momentum: Array, start: Array) -> Array:
    """Body rates (..., 3) for the total body momentum (..., 3), wheels included."""
    scene = polhode.Scene(inertia, rotors=_wheels(file, momentum.dtype))
    return scene.with_momentum(polhode.State(wxyz, momentum), momentum, start).omega_body


def build_state(
    file: SceneFile,
    dtype: DTypeLike = float,
    inertia: "Inertia | VariableInertia | None" = None,
) -> "polhode.State":
    """The nominal state at the first time, of the body with `inertia` (None: that of the file)."""
    inertia = build_inertia(file, dtype) if inertia is None else inertia
    with scene_errors(file, "[state]"):
        value = jnp.asarray(file.state.value, dtype)
        start_time = jnp.asarray(file.times.seconds[0], dtype)
        omega, wxyz = value, build_attitudes(file.state.attitude, dtype)
        if file.state.rate == "momentum_body":
            omega = _rates_of(file, inertia, wxyz, value, start_time)
        if file.state.frame == "lvlh":
            frame = polhode.LVLH(build_orbit(file, dtype))
            wxyz, omega = frame.from_frame(wxyz, omega, start_time)
        return polhode.State(wxyz=wxyz, omega_body=omega)


def build_method(file: SceneFile) -> "polhode.AbstractMethod | None":
    """The method object, or None for an automatic choice.

    Raises SceneFileError for a solver that neither polhode nor diffrax has.
    """
    method = file.method
    if method.kind == "auto":
        return None
    if method.kind == "closed-form":
        return polhode.ClosedForm()
    coordinates = polhode.LiePoisson if method.kind == "lie-poisson" else polhode.EulerAngles
    options = {}
    with scene_errors(file, "[method]"):
        if method.solver is not None:
            options["solver"] = _solver(file, method.solver)
        if method.step is not None:
            import diffrax

            options |= {"dt0": method.step, "controller": diffrax.ConstantStepSize()}
        return coordinates(**options)


def _solver(file: SceneFile, name: str) -> "diffrax.AbstractSolver":
    import diffrax

    from polhode import _integrate

    solvers = {
        key: value
        for module in (diffrax, _integrate)
        for key, value in vars(module).items()
        if inspect.isclass(value)
        and issubclass(value, diffrax.AbstractSolver)
        and not key.startswith("Abstract")
    }
    if name not in solvers:
        raise SceneFileError(
            file.path,
            "[method] solver",
            "unknown solver",
            name,
            "the name of a solver of diffrax or polhode, such as Dopri8",
            did_you_mean(name, solvers),
        )
    try:
        return solvers[name]()
    except TypeError:
        raise SceneFileError(
            file.path,
            "[method] solver",
            "a solver that needs arguments",
            name,
            "one that is made without, such as Dopri8",
            "use it from Python instead",
        ) from None


class Clones(NamedTuple):
    """A batch of bodies, the nominal one first; `redrawn`: number of unphysical draws, rejected."""

    inertia: Inertia
    state: "polhode.State"
    redrawn: int


def draw_clones(file: SceneFile, dtype: DTypeLike = float) -> Clones:
    """The nominal body followed by the clones of [monte_carlo], drawn in float64 from its seed.

    Every quantity has its own stream of random numbers, so that adding a spread for one does not
    change the draws of the others. Moments that violate the triangle inequality are drawn again.
    Raises SceneFileError if too few draws are physical.
    """
    plan = file.monte_carlo
    nominal = build_inertia(file, dtype)
    if plan is None:
        return Clones(nominal, build_state(file, dtype, nominal), 0)
    noise = {
        name: _Noise(plan.seed, name, np.array(table.sigma)) for name, table in plan.spreads.items()
    }
    count, redrawn, inertia = plan.clones, 0, nominal
    if "moments" in noise:
        moments = np.asarray(file.inertia.moments, np.float64)
        rows, redrawn = _draw_moments(file, moments, noise["moments"], count)
        inertia = Inertia.from_moments(np.concatenate([moments[None], rows]).astype(dtype))
    attitude = file.state.attitude
    if "euler" in noise:
        angles = _around(np.array(attitude.values), noise["euler"], count)
        attitude = Attitudes(angles, attitude.sequence)
    wxyz = build_attitudes(attitude, dtype)
    if "attitude" in noise:
        turns = jnp.asarray(_around(np.zeros(3), noise["attitude"], count), dtype)
        wxyz = jnp.broadcast_to(wxyz, (count + 1, 4))
        wxyz = rotation.multiply(wxyz, rotation.rotation_vector_to_wxyz(turns))
    rates = np.array(file.state.value)
    if file.state.rate in noise:
        rates = _around(rates, noise[file.state.rate], count)
    rates = jnp.broadcast_to(rates.astype(dtype), (count + 1, 3))
    start_time = jnp.asarray(file.times.seconds[0], dtype)
    omega = rates
    if file.state.rate == "momentum_body":
        omega = _rates_of(file, inertia, wxyz, rates, start_time)
    return Clones(inertia, polhode.State(wxyz=wxyz, omega_body=omega), redrawn)


class _Noise:
    """Normal deviates of one quantity."""

    def __init__(self, seed: int, quantity: str, sigma: np.ndarray):
        label = int.from_bytes(quantity.encode(), "big")
        self.stream, self.sigma = np.random.default_rng([seed, label]), sigma

    def __call__(self, count: int) -> np.ndarray:
        return self.sigma * self.stream.standard_normal((count, 3))


def _around(value: np.ndarray, noise: _Noise, count: int) -> np.ndarray:
    """(count + 1, 3): the value itself, then draws around it."""
    return np.concatenate([value[None], value + noise(count)])


def _draw_moments(file: SceneFile, moments: np.ndarray, noise: _Noise, count: int):
    accepted, total, redrawn = np.empty((0, 3)), 0, 0
    for _ in range(_MAX_ROUNDS):
        draws = moments * (1 + noise(count))
        total += count
        possible = np.flatnonzero(possible_moments(draws))[: count - len(accepted)]
        accepted = np.concatenate([accepted, draws[possible]])
        if len(accepted) == count:  # later draws of this round are not used, and not counted
            return accepted, redrawn + int(possible[-1]) + 1 - len(possible)
        redrawn += count - len(possible)
    raise SceneFileError(
        file.path,
        "[monte_carlo.moments] relative_sigma",
        "impossible moments",
        f"{len(accepted)} of {total} draws around {moments} are moments of a body",
        "a spread that keeps most draws positive and within the triangle inequality",
        "make relative_sigma smaller",
    )
