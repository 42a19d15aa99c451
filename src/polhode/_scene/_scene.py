"""Scene (a body and its forces) and State (initial attitude and rates); narrower constructors."""

import dataclasses
from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from polhode import rotation
from polhode._batch import map_arrays
from polhode._checks import ArrayLike, as_float_array, is_concrete, require
from polhode._hamiltonian import (
    Dynamics,
    Hamiltonian,
    canonical_from_momentum,
    components,
    from_quaternion,
    inverse_inertia,
    lie_poisson_field,
    momentum_from_canonical,
    rates_from_angle_rates,
)
from polhode._parts import AbstractPart, Printable, check_fields, shaped, summands
from polhode._scene._orbits import KeplerOrbit
from polhode._scene._potentials import (
    AbstractPotential,
    GravityGradient,
    PotentialSum,
    UniformGravity,
)
from polhode._scene._torques import AbstractTorque
from polhode._scene._wheels import AbstractRotor, Rotor, RotorSum, Wheels
from polhode.inertia import Inertia, MassProperties
from polhode.inertia._inertia import VariableInertia, check_form, inertia_at


class SciPyRotation(Protocol):
    """The part of ``scipy.spatial.transform.Rotation`` that ``State`` uses."""

    def as_quat(self) -> np.ndarray: ...


class State(AbstractPart):
    """Attitude and body rates at one time, and optionally the speeds of wheels.

    **Arguments:** ``wxyz`` (..., 4): unit quaternion, scalar first, body -> space; one that is not
    of unit length is normalised; or a SciPy ``Rotation``. ``omega_body`` (..., 3): angular velocity
    in body axes [rad/s]. ``wheel_speed`` (..., m): speeds of the m wheels of the scene relative to
    the body [rad/s], in the order of its rotors; they replace the speeds and momenta of the
    ``ph.Rotor`` objects. None: those of the rotors. Entries of wheels with a prescribed speed are
    not used (they may be NaN), nor is any entry in a scene without rotors. Leading axes are a batch
    and broadcast together.

    Raises ValueError for a zero quaternion, NaN, wrong shapes or axes that do not broadcast.
    """

    wxyz: Float[Array, "*#b 4"] = shaped(4)
    omega_body: Float[Array, "*#b 3"] = shaped(3)
    wheel_speed: Float[Array, "*#b m"] | None = shaped(None)

    def __init__(
        self,
        wxyz: ArrayLike | SciPyRotation,
        omega_body: ArrayLike,
        wheel_speed: ArrayLike | None = None,
    ):
        rates = as_float_array("omega_body", omega_body, (3,))
        if hasattr(wxyz, "as_quat"):
            wxyz = rotation.scipy_to_wxyz(wxyz, rates.dtype)
        quaternion = as_float_array("wxyz", wxyz, (4,))
        arrays = {"wxyz": quaternion, "omega_body": rates}
        if wheel_speed is not None:
            wheel_speed = as_float_array("wheel_speed", wheel_speed, (None,), finite=False)
            arrays["wheel_speed"] = wheel_speed
        try:
            np.broadcast_shapes(*(x.shape[:-1] for x in arrays.values()))
        except ValueError as error:
            shapes = " and ".join(f"{name} {x.shape}" for name, x in arrays.items())
            raise ValueError(f"{shapes} must have leading axes that broadcast together.") from error
        self.wxyz = rotation.normalise(quaternion)
        self.omega_body = rates
        self.wheel_speed = wheel_speed

    @classmethod
    def of_samples(
        cls, wxyz: Array, omega_body: Array, wheel_speed: Array | None = None
    ) -> "State":
        """A state from results of a simulation, without checks: they are NaN for bodies that
        failed."""
        state = object.__new__(cls)
        values = {"wxyz": wxyz, "omega_body": omega_body, "wheel_speed": wheel_speed}
        for name, value in values.items():
            object.__setattr__(state, name, value)
        return state

    @classmethod
    def from_euler(
        cls,
        phi: ArrayLike,
        theta: ArrayLike,
        psi: ArrayLike,
        rates: ArrayLike | None = None,
        momenta: ArrayLike | None = None,
        inertia: Inertia | None = None,
    ) -> "State":
        """State from ZYZ Euler angles [rad] and their rates or canonical momenta.

        ``phi, theta, psi`` (...); exactly one of ``rates`` (..., 3) = d(phi, theta, psi)/dt
        [rad/s] and ``momenta`` (..., 3) = (p_phi, p_theta, p_psi) [kg m^2/s], the latter with
        ``inertia``. ValueError for momenta at theta = 0 or pi, where they do not determine rates.
        """
        angles = tuple(
            as_float_array(name, value)
            for name, value in (("phi", phi), ("theta", theta), ("psi", psi))
        )
        angles = tuple(jnp.broadcast_arrays(*angles))
        wxyz = rotation.euler_to_wxyz(*angles)
        if (rates is None) == (momenta is None):
            raise ValueError(
                "State.from_euler takes exactly one of rates (angle rates, rad/s) and momenta"
                " (canonical momenta, kg m^2/s, with inertia)."
            )
        if rates is not None:
            rates = as_float_array("rates", rates, (3,))
            omega = rates_from_angle_rates(angles, components(rates))
            return cls(wxyz, jnp.stack(jnp.broadcast_arrays(*omega), axis=-1))
        if not isinstance(inertia, Inertia):
            raise TypeError(
                "State.from_euler(momenta=...) needs inertia=, the body's ph.Inertia, got"
                f" {type(inertia).__name__}."
            )
        momenta = as_float_array("momenta", momenta, (3,))
        if is_concrete(angles[1]):
            theta = np.asarray(angles[1])  # the sine of the rounded pi is not zero
            require(
                np.abs(np.sin(theta)) > np.finfo(theta.dtype).eps * np.abs(theta),
                "theta at 0 or pi: canonical momenta do not determine the body rates there;"
                " give rates, or build the State from a quaternion.",
            )
        momentum = momentum_from_canonical(angles, components(momenta))
        momentum = jnp.stack(jnp.broadcast_arrays(*momentum), axis=-1)
        return cls(wxyz, inertia.rates(momentum))

    @property
    def without_wheels(self) -> "State":
        """Attitude and body rates alone, for a scene that contains the momenta of its wheels."""
        if self.wheel_speed is None:
            return self
        return eqx.tree_at(lambda s: s.wheel_speed, self, None)

    def as_unit(self) -> "State":
        """The state with unit quaternions, which an edit or an optimiser may have changed."""
        square, wxyz = jnp.sum(self.wxyz**2, -1, keepdims=True), rotation.normalise(self.wxyz)
        is_unit = jnp.abs(square - 1) <= 8 * jnp.finfo(wxyz.dtype).eps  # then digits are unchanged
        wxyz = wxyz + jax.lax.stop_gradient(jnp.where(is_unit, self.wxyz - wxyz, 0))
        return eqx.tree_at(lambda s: s.wxyz, self, wxyz)

    def canonical(self, inertia: Inertia) -> tuple[Array, Array]:
        """Angles q = (phi, theta, psi) [rad] and momenta p [kg m^2/s], arrays (..., 3)."""
        q = rotation.wxyz_to_euler(self.wxyz)
        p = canonical_from_momentum(q, components(inertia.momentum(self.omega_body)))
        return jnp.stack(q, axis=-1), jnp.stack(jnp.broadcast_arrays(*p), axis=-1)


class Scene(Printable):
    """A rigid body with its potential, torque and rotors; those that are None are not compiled.

    **Arguments:** ``inertia``: ``ph.Inertia`` or ``ph.VariableInertia``; ``potential``:
    ``ph.AbstractPotential`` or None; ``torque``: ``ph.AbstractTorque`` or None; ``rotors``:
    ``ph.Rotor`` or a sum of such, or None (the inertia includes the wheels). Any leaf may carry
    leading batch axes; they broadcast together and with those of the state.

    Raises TypeError for a part of the wrong kind.
    """

    if TYPE_CHECKING:  # so that users of a constant inertia need no isinstance check
        inertia: Inertia
    else:
        inertia: Inertia | VariableInertia
    potential: AbstractPotential | None = None
    torque: AbstractTorque | None = None
    rotors: AbstractRotor | None = None

    def __init__(
        self,
        inertia: Inertia | VariableInertia,
        potential: AbstractPotential | None = None,
        torque: AbstractTorque | None = None,
        rotors: AbstractRotor | None = None,
    ):
        any_inertia: Any = inertia
        self.inertia, self.potential = any_inertia, potential
        self.torque, self.rotors = torque, rotors

    def __check_init__(self):
        _check_kinds(self)
        constant = isinstance(self.inertia, Inertia)
        if constant and self.rotors is not None and is_concrete(self.inertia, self.rotors):
            self.rotors.check_within(self.inertia)

    @property
    def is_free(self) -> bool:
        """Whether the inertia is constant, without a potential, torque or wheel (static)."""
        acting = (self.potential, self.torque, self.rotors)
        return isinstance(self.inertia, Inertia) and all(part is None for part in acting)

    @property
    def constant_inertia(self) -> Inertia:
        """The inertia; ValueError where it changes with time."""
        if isinstance(self.inertia, Inertia):
            return self.inertia
        raise ValueError(
            "this takes scenes whose inertia is constant: use ph.Inertia, not ph.VariableInertia."
        )

    def settled(self, state: State, start: Array) -> "Scene":
        """The scene with ``Wheels``, whose motion the state at the time ``start`` determines."""
        if self.rotors is None:
            return self
        wheels = self.rotors.settle(state.omega_body, start, state.wheel_speed)
        return Scene(self.inertia, self.potential, self.torque, wheels)

    def with_momentum(
        self, state: State, momentum: Float[Array, "*#b 3"], t: Array | float = 0.0
    ) -> State:
        """The state with the body rates that give this momentum in body axes at the time ``t``.

        ``momentum`` [kg m^2/s] includes that of the wheels, whose speeds are those of the state or
        else of the rotors.
        """
        if self.rotors is None:
            rates = inertia_at(self.inertia, t).rates(momentum)
            return State(state.wxyz, rates, state.wheel_speed)
        zero = jnp.zeros_like(momentum)

        def momentum_of(omega):
            turning = State(state.wxyz, omega, state.wheel_speed)
            return self.settled(turning, jnp.asarray(t, momentum.dtype)).momentum(omega, t)

        # the momentum is an affine function of the rates
        at_rest = momentum_of(zero)
        columns = [momentum_of(zero + row) - at_rest for row in jnp.eye(3, dtype=momentum.dtype)]
        rates = jnp.linalg.solve(jnp.stack(columns, axis=-1), (momentum - at_rest)[..., None])
        return State(state.wxyz, rates[..., 0], state.wheel_speed)

    @property
    def is_possible(self) -> Bool[Array, "*#b"]:
        """Whether (...) inertia and wheels are physical; works under JAX transformations.

        An inertia that varies with time is not checked.
        """
        if not isinstance(self.inertia, Inertia):
            return jnp.ones((), bool)
        wheels = self.rotors
        if not isinstance(wheels, Wheels) or wheels.is_constant:
            return self.inertia.is_possible
        conditions = self.inertia.is_possible, self.carrier.is_possible, wheels.is_possible
        return reduce(jnp.logical_and, jnp.broadcast_arrays(*conditions))

    @property
    def _wheels(self) -> Wheels | None:
        if self.rotors is None or isinstance(self.rotors, Wheels):
            return self.rotors
        raise ValueError(
            "the momentum of rotors follows from the state: use scene.settled(state, t) first."
        )

    @property
    def carrier(self) -> Inertia:
        """The inertia without the axial moments of wheels whose speed is not prescribed.

        If the inertia varies with time, at t = 0; see ``carrier_at``.
        """
        return self.carrier_at(0.0)

    def carrier_at(self, t: Array | float) -> Inertia:
        """``carrier`` at the time ``t`` [s]."""
        inertia = inertia_at(self.inertia, t)
        return inertia if self._wheels is None else self._wheels.carrier(inertia)

    def wheel_momentum(self, t: Array | float) -> Array | None:
        """Wheel momentum h(t) = L - carrier omega (..., 3) [kg m^2/s]; None without wheels."""
        if self._wheels is None:
            return None
        return jnp.stack(jnp.broadcast_arrays(*self._wheels.body_momentum(t)), axis=-1)

    def momentum(self, omega: Array, t: Array | float) -> Array:
        """Body momentum (..., 3) [kg m^2/s] for body rates (..., 3) [rad/s], wheels included."""
        momentum = self.carrier_at(t).momentum(omega)
        wheels = self.wheel_momentum(t)
        return momentum if wheels is None else jnp.add(*jnp.broadcast_arrays(momentum, wheels))

    def rates(self, momentum: Array, t: Array | float) -> Array:
        """Body rates (..., 3) [rad/s] for body momenta (..., 3) [kg m^2/s], wheels included."""
        wheels = self.wheel_momentum(t)
        if wheels is not None:
            momentum = jnp.subtract(*jnp.broadcast_arrays(momentum, wheels))
        return self.carrier_at(t).rates(momentum)

    def acceleration(self, wxyz: Array | None, omega: Array, t: Array | float) -> Array:
        """Derivative (..., 3) of the body rates [rad/s^2] by the equations of motion.

        ``wxyz`` (..., 4): attitude, None if nothing depends on it; ``omega`` (..., 3): body rates
        [rad/s]; ``t``: time [s]. All leading axes broadcast, including those of the parts. For
        coupled wheels see ``with_spins``.
        """
        return self.changes(wxyz, omega, t)[0]

    def changes(
        self, wxyz: Array | None, omega: Array, t: Array | float
    ) -> tuple[Array, tuple[Array, ...]]:
        """The acceleration, and the torques (...) [N m] on the coupled wheels."""
        t = jnp.asarray(t, omega.dtype)
        if wxyz is None:
            wxyz = jnp.zeros((*omega.shape[:-1], 4), omega.dtype).at[..., 0].set(1)
        momentum = self.momentum(omega, t)
        state = jnp.unstack(momentum, axis=-1), jnp.unstack(wxyz, axis=-1)
        dynamics = self.dynamics
        spins = dynamics.wheels.spins if dynamics.coupled else ()
        push, _, *groups = lie_poisson_field(t, (*state, spins) if spins else state, dynamics)
        rate = jnp.stack(jnp.broadcast_arrays(*push), axis=-1)
        spin_rates = tuple(groups[0]) if spins else ()

        def carried(t, spins):
            return self.with_spins(spins).wheel_momentum(t)

        if self.rotors is not None:  # momentum that wheels take up does not accelerate the body
            _, wheel_momentum_rate = jax.jvp(carried, (t, spins), (jnp.ones_like(t), spin_rates))
            rate = rate - jnp.broadcast_to(wheel_momentum_rate, rate.shape)
        if isinstance(self.inertia, VariableInertia):  # I domega/dt = dL/dt - (dI/dt) omega

            def carried_momentum(t):
                return self.carrier_at(t).momentum(omega)

            _, change = jax.jvp(carried_momentum, (t,), (jnp.ones_like(t),))
            rate = rate - change
        return self.carrier_at(t).rates(rate), spin_rates

    @property
    def dynamics(self) -> Dynamics:
        """The vector field of the equations of motion."""
        wheels = self._wheels
        loose = None if wheels is None or wheels.is_constant else wheels
        return Dynamics(self.hamiltonian, self.torque, wheels=loose)

    def with_spins(self, spins: Sequence[Array] = ()) -> "Scene":
        """The scene at an instant when its coupled wheels have these momenta [kg m^2/s]."""
        wheels = self._wheels
        if wheels is None or not spins:
            return self
        return Scene(self.inertia, self.potential, self.torque, wheels.at(spins))

    @property
    def hamiltonian(self) -> Hamiltonian:
        """The Hamiltonian of this scene."""
        wheels = self._wheels
        carried = None if wheels is None else wheels.body_momentum
        spinning = None if wheels is None or wheels.is_constant else wheels.energy
        if isinstance(self.inertia, VariableInertia):
            inverse: Any = InverseOverTime(self.inertia, wheels)
        else:
            inverse = inverse_inertia(self.carrier)
        return Hamiltonian(inverse, self.inertia, self.potential, carried, spinning)


class InverseOverTime(eqx.Module):
    """Entries of the inverse of a variable inertia, as a function of time."""

    inertia: VariableInertia
    wheels: Wheels | None

    def __call__(self, t: Array | float) -> tuple[Array, ...]:
        inertia = self.inertia.at(t)
        return inverse_inertia(inertia if self.wheels is None else self.wheels.carrier(inertia))


def places_of(scene: Scene, free: Any) -> tuple[int, ...]:
    """Indices of the leaves of the scene that ``free`` returns, in its order. Unlike a function,
    they can be compared, so that compiled programs are reused. TypeError or ValueError otherwise.
    """
    if not callable(free):
        raise TypeError(
            "free must be a function of the scene that returns arrays of it, such as"
            f" lambda s: [s.torque.c], got {type(free).__name__}."
        )
    leaves, tree = jax.tree.flatten(scene)
    marks = [object() for _ in leaves]
    requirement = "free must point at arrays that the scene holds, such as s.torque.c"
    try:
        places = tuple(marks.index(x) for x in jax.tree.leaves(free(tree.unflatten(marks))))
    except (AttributeError, TypeError, ValueError, IndexError) as error:
        raise TypeError(
            f"{requirement}, neither a part of one nor made from it: {error}."
        ) from error
    kinds = (jnp.result_type(leaves[i]) for i in places)
    if not places or not all(jnp.issubdtype(kind, jnp.floating) for kind in kinds):
        raise TypeError(f"{requirement}: one or more of real numbers.")
    if len(set(places)) < len(places):
        raise ValueError("free points at the same array twice.")
    return places


_KINDS = {
    "inertia": (
        Inertia | VariableInertia,
        "ph.Inertia, such as ph.Inertia.from_moments([1, 2, 3])",
    ),
    "potential": (AbstractPotential, "a potential (such as ph.Potential(fn) of fn(R, t)) or None"),
    "torque": (
        AbstractTorque,
        "a torque (such as ph.BodyTorque(fn) of fn(t), or ph.FeedbackTorque(fn) of"
        " fn(t, wxyz, omega_body)) or None",
    ),
    "rotors": (AbstractRotor, "rotors (ph.Rotor, a sum of them) or None"),
}


def _check_kinds(scene: Scene) -> None:
    for name, (kind, expected) in _KINDS.items():
        value = getattr(scene, name)
        if not (isinstance(value, kind) or (value is None and name != "inertia")):
            hint = ": pass its .inertia" if isinstance(value, MassProperties) else ""
            for field in (k for k, (other, _) in _KINDS.items() if isinstance(value, other)):
                hint = f": pass it as {field}="
            raise TypeError(f"Scene {name} must be {expected}, got {type(value).__name__}{hint}.")
    if isinstance(scene.inertia, Inertia):
        check_form(scene.inertia)


def check_scene(scene: Scene) -> None:
    """TypeError or ValueError, with the field, for a scene that an edit has made inconsistent."""
    _check_kinds(scene)
    for name in _KINDS:
        part = getattr(scene, name)
        if part is not None:
            check_fields(part, f"scene.{name}")
    for torque in summands(scene.torque):
        _check_batch_axes(torque)


_CHECKED: set[Any] = set()  # classes and shapes checked before, since a check takes a trace


def _check_batch_axes(torque: AbstractTorque) -> None:
    """ValueError for batch axes of a user's class that its ``core_ranks`` does not declare."""
    if type(torque).__module__.partition(".")[0] == "polhode":
        return
    arrays = {f.name: getattr(torque, f.name) for f in dataclasses.fields(torque)}
    others = [
        name
        for name, x in arrays.items()
        if name not in torque.core_ranks and isinstance(x, jax.Array | np.ndarray) and x.ndim
    ]
    key = type(torque), *(arrays[name].shape for name in others)
    if not others or key in _CHECKED:
        return
    one = map_arrays(torque, lambda x, rank: x[(0,) * (x.ndim - rank)])
    dtype = jnp.result_type(*(arrays[name] for name in others))
    numbers = [jax.ShapeDtypeStruct((), dtype, weak_type=True)] * 8

    def components_of(t, *numbers):
        return one.body_components(t, from_quaternion(numbers[:4]), numbers[4:])

    shapes = [np.shape(x) for x in jax.eval_shape(components_of, *numbers)]
    if any(shapes):
        raise ValueError(
            f"{type(torque).__name__}.body_components returned components of the shapes {shapes}"
            f" for one body, where () is expected. If {', '.join(others)} of it may have batch"
            ' axes, let core_ranks return {"NAME": n} for each, n being the axes of one body.'
        )
    _CHECKED.add(key)


def specialise(scene: Scene) -> Scene:
    """The scene with the narrowest constructors that its numbers allow.

    Equal principal moments become ``ph.Inertia.spherical``, equal moments about body x and y
    ``ph.Inertia.axisymmetric``, a diagonal tensor three moments; a centre of mass on body z
    becomes ``ph.UniformGravity.axial``; a wheel along a positive body axis ``ph.Rotor.axial``; an
    ellipse of eccentricity 0 a circle. The motion is the same, and ``ph.simulate`` may have a
    closed-form solution for it. Numbers absent from the narrower parts no longer have derivatives:
    call it once, on a scene of concrete numbers. All bodies of a batch must allow a constructor.

        scene = ph.Scene(ph.Inertia([1.0, 1.0, 0.5]), ph.UniformGravity(1.0, [0.0, 0.0, 0.3]))
        ph.simulate(ph.specialise(scene), state, ts)       # Lagrange's top, not integrated

    Raises TypeError unless given a ``ph.Scene``, ValueError if its numbers are traced.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"specialise takes a ph.Scene, got {type(scene).__name__}.")
    if not is_concrete(scene):
        raise ValueError("specialise needs concrete numbers: call it outside of jit and grad.")
    with jax.ensure_compile_time_eval():  # concrete numbers: evaluated now, even under jit
        inertia, potential, rotors = map(narrower, (scene.inertia, scene.potential, scene.rotors))
        torque = jax.tree.map(narrower, scene.torque, is_leaf=lambda x: isinstance(x, KeplerOrbit))
    return Scene(inertia, potential, torque, rotors)


def narrower(part: Any) -> Any:
    """The same part, built with the narrowest constructor for its numbers."""
    if isinstance(part, (PotentialSum, RotorSum)):
        return type(part)(tuple(narrower(term) for term in part.terms))
    for kind, rule in _RULES.items():
        if isinstance(part, kind):
            return rule(part)
    return part


def constructors(scene: Scene, special: Scene) -> list[str]:
    """The names of the constructors of ``special`` that are narrower than those of ``scene``."""
    names = []
    if scene.inertia.symmetry is not special.inertia.symmetry:
        names.append(f"ph.Inertia.{special.inertia.symmetry.name.lower()}")
    elif scene.inertia.is_principal is not special.inertia.is_principal:
        names.append("ph.Inertia.from_moments")
    if _count(scene.potential, _is_axial_weight) < _count(special.potential, _is_axial_weight):
        names.append("ph.UniformGravity.axial")
    if _count(scene.rotors, _is_axial_wheel) < _count(special.rotors, _is_axial_wheel):
        names.append("ph.Rotor.axial")
    return names


def _is_axial_weight(part: Any) -> bool:
    return isinstance(part, UniformGravity) and part.distance is not None


def _is_axial_wheel(part: Any) -> bool:
    return isinstance(part, Rotor) and part.axis is not None


def _count(part: Any, condition: Any) -> int:
    return sum(map(condition, summands(part)))


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
    if field.centre_body is None:
        return field
    centre = np.asarray(field.centre_body)
    if np.any(centre[..., :2] != 0):
        return field
    return UniformGravity.axial(field.mass, centre[..., 2], field.gravity_space)


def _gradient(field: GravityGradient) -> GravityGradient:
    orbit = narrower(field.position_space)
    return field if orbit is field.position_space else GravityGradient(field.mu, orbit)


def _wheel(wheel: Rotor) -> Rotor:
    if wheel.axis_body is None:
        return wheel
    vector = np.asarray(wheel.axis_body)
    momentum, speed = (  # with the batch axes of the axis, which is dropped
        None if x is None else jnp.broadcast_to(x, np.broadcast_shapes(x.shape, vector.shape[:-1]))
        for x in (wheel.momentum, wheel.speed)
    )
    for axis in range(3):
        if np.all(np.delete(vector, axis, axis=-1) == 0) and np.all(vector[..., axis] > 0):
            rest = wheel.torque, wheel.impulse, wheel.coupling
            return Rotor.axial(wheel.inertia, momentum, speed, *rest, axis=axis)
    return wheel


def _orbit(orbit: KeplerOrbit) -> KeplerOrbit:
    if orbit.eccentricity is None or np.any(np.asarray(orbit.eccentricity) != 0):
        return orbit
    shape = np.broadcast_shapes(orbit.mu.shape, orbit.eccentricity.shape)  # of the batch
    circle = eqx.tree_at(lambda o: o.mu, orbit, jnp.broadcast_to(orbit.mu, shape))
    return eqx.tree_at(lambda o: o.eccentricity, circle, None)


_RULES = {
    Inertia: _inertia,
    UniformGravity: _weight,
    GravityGradient: _gradient,
    Rotor: _wheel,
    KeplerOrbit: _orbit,
}
