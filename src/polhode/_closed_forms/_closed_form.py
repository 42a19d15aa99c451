"""What closed forms have in common: the abstract method, chunks of bodies, conditions on scenes."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._batch import is_lane_tree, map_chunks
from polhode._checks import is_concrete
from polhode._method._base import AbstractMethod, Record, Samples
from polhode._method._status import Status
from polhode._scene import BodyTorque, LinearDamping, Scene, State, TorqueSum, Wheels
from polhode.inertia import Symmetry


class AbstractClosedForm(AbstractMethod):
    """A closed-form solution as a method: nothing is integrated."""

    exact: ClassVar[bool] = True

    @abc.abstractmethod
    def objection(self, scene: Scene) -> str | None:
        """What is wrong with the parts of the scene, whatever their values; None: nothing."""

    @abc.abstractmethod
    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        """Why the solution does not hold for the scene; None where it is known to hold.

        Values count where they are concrete; while they are traced only what is static counts.
        """

    def refuse(self, scene: Scene) -> None:
        """ValueError where the solution does not hold for the parts of the scene."""
        objection = self.objection(scene)
        if objection is not None:
            raise ValueError(f"ph.{type(self).__name__}: {objection}; leave method=None.")


def run_in_chunks(
    motion: Callable[[Scene, State, Array], tuple[Array | None, Array, Array]],
    size: Callable[[int, int], int],
    scene: Scene,
    state: State,
    ts: Array,
    record: Record,
) -> Samples:
    """Samples of ``motion(scene, state, elapsed)``, ``size(bodies, samples)`` bodies at a time.

    ``motion`` returns wxyz (N, T, 4), omega (N, T, 3) and for which bodies (N,) it holds.
    """
    count = 1 if record.final_only else ts.shape[-1] - 1
    lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

    def of_chunk(chunk):
        lanes, times = chunk
        scene, state = eqx.combine(lanes, shared)
        times = ts if times is None else times
        saved = times[..., -1:] if record.final_only else times[..., 1:]  # the first is the state
        elapsed = saved - times[..., :1]
        n = state.wxyz.shape[0]
        elapsed = jnp.broadcast_to(elapsed if elapsed.ndim == 2 else elapsed[None], (n, count))
        wxyz, omega, holds = motion(scene, state, elapsed)
        if not record.final_only:
            wxyz, omega = with_first(state, wxyz, omega)
        return _samples(wxyz, omega, holds, record)

    n, times = state.wxyz.shape[0], ts if ts.ndim == 2 else None
    return map_chunks(of_chunk, (lanes, times), n, size(n, count))


def bodies_per_chunk(chunk: int | None, n: int, count: int) -> int:
    """Bodies so that ``chunk`` bounds bodies times samples; None: all of them."""
    return n if chunk is None else max(1, chunk // count)


def with_first(
    state: State, wxyz: Array | None, omega: Array | None
) -> tuple[Array | None, Array | None]:
    """Samples (N, T, ...) preceded by the initial state."""
    both = ((state.wxyz, wxyz), (state.omega_body, omega))
    wxyz, omega = (
        None if x is None else jnp.concatenate([first[:, None], x], axis=1) for first, x in both
    )
    return wxyz, omega


def _samples(wxyz, omega, holds, record: Record) -> Samples:
    finite = jnp.all(jnp.isfinite(omega), axis=(-1, -2))
    if record.attitude:
        finite = finite & jnp.all(jnp.isfinite(wxyz), axis=(-1, -2))
    status = jnp.where(finite, Status.SUCCESSFUL, Status.NOT_FINITE)
    status = jnp.where(holds, status, Status.WRONG_LAW)
    return Samples(
        wxyz if record.attitude else None,
        omega if record.rates else None,
        status,
        jnp.zeros(status.shape, status.dtype),
    )


def as_lanes(array: Array, n: int, rank: int = 0) -> Array:
    """An array of one body or of N lanes as lanes (N, ...)."""
    core = array.shape[array.ndim - rank :]
    return jnp.broadcast_to(array, (n, *core))


def broadcast(*arrays):
    shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
    return tuple(jnp.broadcast_to(x, shape) for x in arrays)


def wheel_objection(scene: Scene) -> str | None:
    """Objection to rotors other than wheels of constant momentum on body z."""
    rotors = scene.rotors
    if rotors is None:
        return None
    along = rotors.along if isinstance(rotors, Wheels) else tuple(w.along for w in rotors.wheels)
    if any(axis != 2 for axis in along):
        return "a rotor is not known to lie on body z"
    if isinstance(rotors, Wheels):
        motor_acts = not all(held or f is None for held, f in zip(rotors.held, rotors.impulses))
        motor_acts = motor_acts or bool(rotors.coupled)
        torques = [rotors.torque]
    else:
        motor_acts = any(not (w.impulse is None and w.coupling is None) for w in rotors.wheels)
        torques = [w.torque for w in rotors.wheels if w.torque is not None]
    if motor_acts:
        return "a motor turns a rotor by a function of time or state"
    if not all(is_concrete(x) and np.all(np.asarray(x) == 0) for x in torques):
        return "a motor turns a rotor"
    return None


def symmetry_objection(scene: Scene) -> str | None:
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


def axial_state(scene: Scene, state: State) -> tuple[Array, Array, Array]:
    """Moments A, C of the carrier, and the axial momentum, of lanes."""
    n = state.wxyz.shape[0]
    moments = as_lanes(scene.carrier.moments, n, 1)
    axial = moments[:, 2] * state.omega_body[:, 2]
    wheels: Any = scene.rotors
    if wheels is not None:
        axial = axial + as_lanes(wheels.body_momentum(wheels.start)[2], n)
    return (moments[:, 0] + moments[:, 1]) / 2, moments, axial


def wheels_have_constant_momentum(scene: Scene, n: int) -> Array:
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


def torque_objection(scene: Scene) -> str | None:
    """Objection to anything but constant body torques and linear damping."""
    if scene.potential is not None:
        return "a potential acts"
    for term in _terms(scene.torque):
        constant = isinstance(term, BodyTorque) and not callable(term.n)
        if not (constant or isinstance(term, LinearDamping)):
            return "a torque acts that is neither constant in body axes nor linear damping"
    return None


def torque_and_damping(scene: Scene) -> tuple[Array, Array]:
    """Total constant body torque and coefficients of damping, (..., 3) each."""
    torque = damping = jnp.zeros(3, scene.inertia.dtype)
    for term in _terms(scene.torque):
        if isinstance(term, BodyTorque):
            torque = jnp.add(*broadcast(torque, term.n))
        else:
            damping = jnp.add(*broadcast(damping, term.c))
    return torque, damping
