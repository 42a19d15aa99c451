"""The base of the closed forms: the abstract method, chunks of bodies, conditions on scenes."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from polhode._batch import is_lane_tree
from polhode._kernels import map_chunks
from polhode._method import AbstractMethod, Record, Samples, Status, StepCounts
from polhode._parts import summands
from polhode._scene import BodyTorque, LinearDamping, Scene, State, Wheels
from polhode.inertia import Symmetry, VariableInertia


class AbstractClosedForm(AbstractMethod):
    """A closed-form solution as a method."""

    exact: ClassVar[bool] = True

    @abc.abstractmethod
    def objection(self, scene: Scene) -> str | None:
        """Why the solution is not valid for these parts, whatever their numbers; None if it may
        be."""

    @abc.abstractmethod
    def why_not(self, scene: Scene) -> str | None:
        """Why the types of the parts do not guarantee that the solution is valid; None if they do.

        It does not depend on numbers, so that the choice of the method is the same under ``jit``,
        ``vmap`` and ``grad``.
        """

    def refuse(self, scene: Scene) -> None:
        """ValueError if the solution is not valid for the parts of the scene."""
        variable = isinstance(scene.inertia, VariableInertia)
        objection = VARIABLE if variable else self.objection(scene)
        if objection is not None:
            raise ValueError(f"ph.{type(self).__name__}: {objection}; leave method=None.")


class AbstractChunkedForm(AbstractClosedForm):
    """A closed form that is evaluated for chunks of bodies, all samples of a body at once."""

    @abc.abstractmethod
    def _motion(
        self, scene: Scene, state: State, elapsed: Array
    ) -> tuple[Array | None, Array, Array]:
        """wxyz (N, T, 4), omega_body (N, T, 3), and for which bodies (N,) the solution is valid.

        ``elapsed`` (N, T) [s]: time since ``state``.
        """

    @abc.abstractmethod
    def _chunk_size(self, n: int, count: int) -> int:
        """Bodies of a chunk, for ``n`` bodies of ``count`` samples each."""

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        del rtol
        self.refuse(scene)
        count = 1 if record.final_only else ts.shape[-1] - 1
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

        def of_chunk(chunk):
            lanes, times = chunk
            scene, state = eqx.combine(lanes, shared)
            times = ts if times is None else times
            # the first sample is the state itself
            sample_times = times[..., -1:] if record.final_only else times[..., 1:]
            elapsed = sample_times - times[..., :1]
            n = state.wxyz.shape[0]
            elapsed = jnp.broadcast_to(elapsed if elapsed.ndim == 2 else elapsed[None], (n, count))
            wxyz, omega, is_valid = self._motion(scene, state, elapsed)
            if not record.final_only:
                wxyz, omega = with_first(state, wxyz, omega)
            return _samples(wxyz, omega, is_valid, record)

        n, times = state.wxyz.shape[0], ts if ts.ndim == 2 else None
        return map_chunks(of_chunk, (lanes, times), n, self._chunk_size(n, count))


def bodies_per_chunk(chunk: int | None, n: int, count: int) -> int:
    """Number of bodies for at most ``chunk`` bodies times samples; None: all of them."""
    return n if chunk is None else max(1, chunk // count)


def with_first(
    state: State, wxyz: Array | None, omega: Array | None
) -> tuple[Array | None, Array | None]:
    """Samples (N, T, ...) preceded by the initial state."""
    pairs = ((state.wxyz, wxyz), (state.omega_body, omega))
    wxyz, omega = (
        None if x is None else jnp.concatenate([initial[:, None], x], axis=1)
        for initial, x in pairs
    )
    return wxyz, omega


def _samples(wxyz, omega, is_valid, record: Record) -> Samples:
    finite = jnp.all(jnp.isfinite(omega), axis=(-1, -2))
    if record.attitude:
        finite = finite & jnp.all(jnp.isfinite(wxyz), axis=(-1, -2))
    status = jnp.where(finite & is_valid, Status.SUCCESSFUL, Status.NOT_FINITE)
    wxyz, omega = (jnp.where(is_valid[:, None, None], x, jnp.nan) for x in (wxyz, omega))
    return Samples(
        wxyz if record.attitude else None,
        omega if record.rates else None,
        status,
        StepCounts.of(jnp.zeros_like(status)),
    )


def as_lanes(array: Array, n: int, rank: int = 0) -> Array:
    """An array of one body or of N lanes as lanes (N, ...)."""
    core = array.shape[array.ndim - rank :]
    return jnp.broadcast_to(array, (n, *core))


def broadcast(*arrays):
    shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
    return tuple(jnp.broadcast_to(x, shape) for x in arrays)


def wheel_objection(scene: Scene) -> str | None:
    """Objection to rotors other than held wheels on body z, by type."""
    rotors = scene.rotors
    if rotors is None:
        return None
    if isinstance(rotors, Wheels):
        axes, are_held = rotors.along, rotors.is_held
    else:
        axes = tuple(wheel.axis for wheel in rotors.wheels)
        are_held = tuple(wheel.is_held for wheel in rotors.wheels)
    if any(axis != 2 for axis in axes):
        return NOT_AXIAL
    return None if all(are_held) else "a rotor spins freely or is driven by a motor"


VARIABLE = "the inertia changes with time"
NOT_AXIAL = "a rotor is not one of ph.Rotor.axial"
NOT_PRINCIPAL = "the body axes are not principal axes by the type of the inertia"


def symmetry_objection(scene: Scene) -> str | None:
    """Objection to an inertia whose type does not guarantee symmetry about body z."""
    inertia = scene.inertia
    if inertia.is_principal and inertia.symmetry is not Symmetry.NONE:
        return None
    return "the inertia is not one of ph.Inertia.axisymmetric"


def axial_state(scene: Scene, state: State) -> tuple[Array, Array, Array]:
    """Transverse moment (N,), principal moments (N, 3) of the carrier, and axial momentum (N,)."""
    n = state.wxyz.shape[0]
    moments = as_lanes(scene.carrier.moments, n, 1)
    axial = moments[:, 2] * state.omega_body[:, 2] + axial_wheel_momentum(scene, n)
    return (moments[:, 0] + moments[:, 1]) / 2, moments, axial


def axial_wheel_momentum(scene: Scene, n: int) -> Array:
    """Momentum (N,) along body z that wheels carry relative to the body [kg m^2/s]."""
    wheels: Any = scene.rotors
    if wheels is None:
        return jnp.zeros(n, scene.inertia.dtype)
    return as_lanes(wheels.body_momentum(wheels.start)[2], n)


def wheels_have_constant_momentum(scene: Scene, n: int) -> Array:
    """Whether (N,) the momenta of all wheels are constant: no motor or coupling acts on them."""
    wheels: Any = scene.rotors
    if wheels is None:
        return jnp.ones(n, bool)
    if wheels.coupled or any(f is not None for f in wheels.impulses):
        return jnp.zeros(n, bool)
    return jnp.all(as_lanes(wheels.torque, n, 1) == 0, axis=-1)


def torque_objection(scene: Scene) -> str | None:
    """Objection to anything but constant body torques and linear damping."""
    if scene.potential is not None:
        return "a potential acts"
    for term in summands(scene.torque):
        constant = isinstance(term, BodyTorque) and not callable(term.n)
        if not (constant or isinstance(term, LinearDamping)):
            return "a torque acts that is neither constant in body axes nor linear damping"
    return None


def torque_and_damping(scene: Scene) -> tuple[Array, Array]:
    """Total constant body torque and coefficients of damping, (..., 3) each."""
    torque = damping = jnp.zeros(3, scene.inertia.dtype)
    for term in summands(scene.torque):
        if isinstance(term, BodyTorque):
            torque = jnp.add(*broadcast(torque, term.n))
        else:
            damping = jnp.add(*broadcast(damping, term.c))
    return torque, damping
