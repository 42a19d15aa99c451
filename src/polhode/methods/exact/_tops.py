"""Exact motion of tops as methods: Lagrange's top, driven and damped spin, precession."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode import rotation, tops
from polhode._batch import is_lane_tree, map_chunks
from polhode._checks import is_concrete
from polhode._scene import Scene
from polhode._state import State
from polhode.inertia import Symmetry
from polhode.methods._base import AbstractMethod, Record, Samples
from polhode.methods._status import Status
from polhode.torques import (
    AbstractTorque,
    BodyTorque,
    LinearDamping,
    TorqueSum,
    UniformGravity,
    Wheels,
)
from polhode.xla import kernel


class AbstractTopMethod(AbstractMethod):
    """Base of the exact tops: chunks of lanes, and what the law asks of a scene."""

    chunk: eqx.AbstractVar[int | None]
    law: eqx.AbstractClassVar[str]

    exact: ClassVar[bool] = True

    @abc.abstractmethod
    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        """Why the law does not hold for the scene, in words; None where it is known to hold.

        Values are looked at where they are known; while they are traced only what is static counts.
        """

    @abc.abstractmethod
    def _refusal(self, scene: Scene) -> str | None:
        """What is wrong with the parts of the scene, whatever their values."""

    @abc.abstractmethod
    def _motion(
        self, scene: Scene, state: State, elapsed: Array
    ) -> tuple[Array | None, Array, Array]:
        """wxyz (N, T, 4), omega (N, T, 3) and which lanes obey the law, of one chunk."""

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        del rtol
        refusal = self._refusal(scene)
        if refusal is not None:
            raise ValueError(f"ph.{type(self).__name__}: {refusal}; leave method=None.")
        count = 1 if record.final_only else ts.shape[-1]
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

        def one(chunk):
            lanes, times = chunk
            scene, state = eqx.combine(lanes, shared)
            times = ts if times is None else times
            kept = times[..., -1:] if record.final_only else times
            elapsed = kept - times[..., :1]
            n = state.wxyz.shape[0]
            elapsed = jnp.broadcast_to(elapsed if elapsed.ndim == 2 else elapsed[None], (n, count))
            return _samples(*self._motion(scene, state, elapsed), record)

        n, times = state.wxyz.shape[0], ts if ts.ndim == 2 else None
        return map_chunks(one, (lanes, times), n, self._size(n, count))

    def _size(self, n: int, count: int) -> int:
        """Lanes of a chunk."""
        return max(1, self.chunk // count)


def _samples(wxyz, omega, lawful, record: Record) -> Samples:
    finite = jnp.all(jnp.isfinite(omega), axis=(-1, -2))
    if record.attitude:
        finite = finite & jnp.all(jnp.isfinite(wxyz), axis=(-1, -2))
    status = jnp.where(finite, Status.SUCCESSFUL, Status.NOT_FINITE)
    status = jnp.where(lawful, status, Status.WRONG_LAW)
    return Samples(
        wxyz if record.attitude else None,
        omega if record.rates else None,
        status,
        jnp.zeros(status.shape, status.dtype),
    )


def _lanes(array: Array, n: int, rank: int = 0) -> Array:
    """An array of one body or of N lanes as lanes (N, ...)."""
    core = array.shape[array.ndim - rank :]
    return jnp.broadcast_to(array, (n, *core))


def _axial_wheels(scene: Scene) -> str | None:
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


def _not_symmetric(scene: Scene) -> str | None:
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


def _start(scene: Scene, state: State, rank: int = 1):
    """Moments A, C of the carrier, and the axial momentum, of lanes."""
    n = state.wxyz.shape[0]
    moments = _lanes(scene.carrier.moments, n, 1)
    axial = moments[:, 2] * state.omega_body[:, 2]
    if scene.rotors is not None:
        axial = axial + _lanes(scene.rotors.body_momentum(scene.rotors.start)[2], n)
    return (moments[:, 0] + moments[:, 1]) / 2, moments, axial


class LagrangeTop(AbstractTopMethod):
    """Lagrange's top in theta functions, O(1) in time: exact.

    A body symmetric about body z (``ph.Inertia.axisymmetric``) turning about a point of that axis
    under uniform gravity in any direction, its centre of mass on the axis
    (``ph.UniformGravity.axial``), wheels of constant momentum on the axis allowed. All motions:
    looping, cuspidal and steady precession, sleeping and hanging tops, the separatrix, the
    pendulum, no gravity. The error is rounding: a few units in the last place of the phase.
    Derivatives hold the body symmetric. Within a hair of the marginal sleeping top (L_z^2 = 4 A m g
    l and axis and rates within 1e-9 of upright) they lose digits: 1e-8 there, 1e-2 on it; values do
    not. ``chunk`` bounds bodies times samples worked on at once (None: chosen).

    Source: Klein & Sommerfeld, Theorie des Kreisels, chapter VI.
    """

    chunk: int | None = eqx.field(static=True, default=None)

    law: ClassVar[str] = (
        "symmetric body, centre of mass on its axis, uniform gravity (Lagrange's top): exact motion"
        " in theta functions"
    )

    def _size(self, n, count):
        if self.chunk is not None:
            return max(1, self.chunk // count)
        # By measurement: at once twice as fast as in a loop, in which few bodies do best.
        if n * count <= 2**14:
            return n
        return max(1, 2**12 // count) if count > 32 else 128

    def why_not(self, scene, state, record):
        refusal = self._refusal(scene) or _not_symmetric(scene) or _axial_wheels(scene)
        if refusal is not None or scene.potential.on_axis:
            return refusal
        centre = scene.potential.centre_body
        if not is_concrete(centre) or np.any(np.asarray(centre)[..., :2] != 0):
            return "the centre of mass is not known to lie on body z (ph.UniformGravity.axial)"
        return None

    def _refusal(self, scene):
        if not isinstance(scene.potential, UniformGravity):
            return "the potential is not uniform gravity"
        if scene.torque is not None:
            return "a torque acts"
        if not scene.inertia.is_principal:
            return "the body axes are not known to be principal"
        if isinstance(scene.rotors, Wheels) and any(axis != 2 for axis in scene.rotors.along):
            return "a rotor is not known to lie on body z"
        return None

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        transverse, moments, axial = _start(scene, state)
        gravity = scene.potential
        centre = _lanes(gravity.centre_body, n, 1)
        force = _lanes(gravity.mass, n)[:, None] * _lanes(gravity.gravity_space, n, 1)
        wxyz, omega = kernel(tops.lagrange_motion, linearised=True)(
            transverse, force, centre[:, 2], state.wxyz, state.omega_body, axial, elapsed
        )
        lawful = (moments[:, 0] == moments[:, 1]) & (centre[:, 0] == 0) & (centre[:, 1] == 0)
        return wxyz, omega, lawful & _steady(scene, n)


def _steady(scene: Scene, n: int) -> Array:
    """Lanes on which no motor turns a wheel."""
    if scene.rotors is None:
        return jnp.ones(n, bool)
    if scene.rotors.coupled or any(f is not None for f in scene.rotors.impulses):
        return jnp.zeros(n, bool)
    return jnp.all(_lanes(scene.rotors.torque, n, 1) == 0, axis=-1)


def _terms(torque: AbstractTorque | None) -> tuple[AbstractTorque, ...]:
    if torque is None:
        return ()
    return torque.terms if isinstance(torque, TorqueSum) else (torque,)


def _linear(scene: Scene) -> str | None:
    """Objection to anything but constant body torques and linear damping."""
    if scene.potential is not None:
        return "a potential acts"
    for term in _terms(scene.torque):
        constant = isinstance(term, BodyTorque) and not callable(term.n)
        if not (constant or isinstance(term, LinearDamping)):
            return "a torque acts that is neither constant in body axes nor linear damping"
    return None


def _push(scene: Scene, n: int) -> tuple[Array, Array]:
    """Total constant body torque and damping coefficients of lanes, (N, 3) each."""
    zero = jnp.zeros((n, 3), scene.inertia.dtype)
    push, damping = zero, zero
    for term in _terms(scene.torque):
        if isinstance(term, BodyTorque):
            push = push + _lanes(term.n, n, 1)
        else:
            damping = damping + _lanes(term.c, n, 1)
    return push, damping


class SymmetricTop(AbstractTopMethod):
    """A symmetric body without potential, in elementary functions: exact.

    Constant torque about the axis of symmetry (body z), linear damping symmetric about it and
    wheels of constant momentum on it. The rates are elementary in all these; the attitude where
    the momentum keeps its direction: without torque, and with damping proportional to the moments
    (``c = k I``) and no wheel, so that otherwise ``ph.Record(attitude=False)`` is needed.
    """

    chunk: int = eqx.field(static=True, default=2**14)

    law: ClassVar[str] = (
        "symmetric body with torque, damping or wheels about its axis: exact motion in elementary"
        " functions"
    )

    def why_not(self, scene, state, record):
        refusal = self._refusal(scene) or _not_symmetric(scene) or _axial_wheels(scene)
        if refusal is not None:
            return refusal
        if not is_concrete(scene.torque):
            return "the torques are not known to be symmetric about body z"
        push, damping = (np.asarray(x) for x in _push_values(scene))
        if np.any(push[..., :2] != 0) or np.any(damping[..., 0] != damping[..., 1]):
            return "a torque is not symmetric about body z"
        if not record.attitude:
            return None
        if np.any(push != 0):
            return "the attitude of a driven body is not elementary (ph.Record(attitude=False))"
        if np.any(damping != 0):
            if scene.rotors is not None:
                return "the attitude of a damped body with wheels is not elementary"
            if not is_concrete(scene.inertia) or not _proportional(scene, damping):
                return "the attitude is elementary only for damping proportional to the moments"
        return None

    def _refusal(self, scene):
        return _linear(scene) or (
            None if scene.inertia.is_principal else "the body axes are not known to be principal"
        )

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        transverse, moments, axial = _start(scene, state)
        push, damping = _push(scene, n)
        own = moments[:, 2]
        carried = axial - own * state.omega_body[:, 2]
        fading, slowing = damping[:, 0] / transverse, damping[:, 2] / own
        spin, angle = tops.spin(
            state.omega_body[:, 2, None], slowing[:, None], (push[:, 2] / own)[:, None], elapsed
        )
        # W = omega_x + i omega_y obeys A dW/dt = i ((C - A) omega_z + h) W - c W
        turned = ((own - transverse) / transverse)[:, None] * angle
        turned = turned + (carried / transverse)[:, None] * elapsed
        c, s = jnp.cos(turned), jnp.sin(turned)
        shrink = jnp.exp(-fading[:, None] * elapsed)
        x, y = state.omega_body[:, 0, None], state.omega_body[:, 1, None]
        omega = jnp.stack([shrink * (x * c - y * s), shrink * (x * s + y * c), spin], axis=-1)
        flat = jnp.stack([transverse, transverse], axis=-1) * state.omega_body[:, :2]
        momentum = jnp.concatenate([flat, axial[:, None]], axis=-1)
        wxyz = tops.precession(
            state.wxyz,
            rotation.rotate(state.wxyz, momentum),
            transverse,
            state.omega_body[:, 2] - axial / transverse,
            tops.decay(fading[:, None], elapsed),
        )
        lawful = (moments[:, 0] == moments[:, 1]) & jnp.all(push[:, :2] == 0, axis=-1)
        lawful = lawful & (damping[:, 0] == damping[:, 1]) & _steady(scene, n)
        keeps = (push[:, 2] == 0) & _equal(fading, slowing) & ((carried == 0) | (fading == 0))
        wxyz = jnp.where(keeps[:, None, None], wxyz, jnp.nan)
        return wxyz, omega, lawful


def _equal(a: Array, b: Array) -> Array:
    """Equal to a few units in the last place: ratios of what was meant to be proportional."""
    return jnp.abs(a - b) <= 4 * jnp.finfo(a.dtype).eps * jnp.abs(a)


def _push_values(scene: Scene) -> tuple[Array, Array]:
    """As ``_push``, with whatever batch axes there are."""
    push = damping = jnp.zeros(3, scene.inertia.dtype)
    for term in _terms(scene.torque):
        if isinstance(term, BodyTorque):
            push = jnp.add(*_broadcast(push, term.n))
        else:
            damping = jnp.add(*_broadcast(damping, term.c))
    return push, damping


def _broadcast(*arrays):
    shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
    return tuple(jnp.broadcast_to(x, shape) for x in arrays)


def _proportional(scene: Scene, damping) -> bool:
    rates, moments = _broadcast(np.asarray(damping), np.asarray(scene.inertia.moments))
    rates = rates / moments
    return bool(np.all(_equal(rates[..., 0], rates[..., 2])))


class FixedAxis(AbstractTopMethod):
    """Spin about one principal axis that stays fixed, driven and damped: exact.

    All rates but one are zero at the start, the constant body torques lie along that axis and the
    damping is linear: d omega/dt = (N - c omega)/I. The axis may differ from body to body.
    Derivatives with respect to the rates that are zero are those of this motion only: zero.
    """

    chunk: int = eqx.field(static=True, default=2**14)

    law: ClassVar[str] = "spin about one fixed principal axis: exact motion in elementary functions"

    def why_not(self, scene, state, record):
        refusal = self._refusal(scene)
        if refusal is not None:
            return refusal
        if not is_concrete(scene.torque, state.omega_body):
            return "the rates are not known to lie along one principal axis"
        with jax.ensure_compile_time_eval():  # known numbers, also inside of jit
            push, _ = _push_values(scene)
            acting = _broadcast(np.asarray(push) != 0, np.asarray(state.omega_body) != 0)
            used = np.logical_or(*map(np.asarray, acting))
        if np.any(used.sum(axis=-1) > 1):
            return "rates or torques do not lie along one principal axis"
        return None

    def _refusal(self, scene):
        if scene.rotors is not None:
            return "rotors turn in the body"
        if not scene.inertia.is_principal:
            return "the body axes are not known to be principal"
        return _linear(scene)

    def _motion(self, scene, state, elapsed):
        n = state.wxyz.shape[0]
        push, damping = _push(scene, n)
        moments = _lanes(scene.inertia.moments, n, 1)
        used = (push != 0) | (state.omega_body != 0)
        later = elapsed[:, :, None] * jnp.ones_like(moments)[:, None]
        omega, angles = tops.spin(
            state.omega_body[:, None],
            (damping / moments)[:, None],
            (push / moments)[:, None],
            later,
        )
        axis = jnp.argmax(used, axis=-1)
        unit = jnp.where(jnp.arange(3)[None] == axis[:, None], 1, 0).astype(push.dtype)
        angle = jnp.sum(unit[:, None] * angles, axis=-1)
        turn = tops.turn(tuple(unit[:, i, None] for i in range(3)), angle)
        wxyz = rotation.multiply(jnp.broadcast_to(state.wxyz[:, None], turn.shape), turn)
        return wxyz, omega, jnp.sum(used, axis=-1) <= 1


_LAWS = (LagrangeTop(), SymmetricTop(), FixedAxis())


def exact_top(scene: Scene, state: State, record: Record) -> AbstractTopMethod | None:
    """The exact method whose law is known to hold for the scene, or None."""
    for method in _LAWS:
        if method.why_not(scene, state, record) is None:
            return method
    return None
