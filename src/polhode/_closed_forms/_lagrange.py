"""Lagrange's top as a method."""

from typing import Any

import equinox as eqx
import numpy as np

from polhode._checks import is_concrete
from polhode._closed_forms import tops
from polhode._closed_forms._closed_form import AbstractTopMethod
from polhode._closed_forms._conditions import (
    as_lanes,
    axial_start,
    axial_wheels,
    not_symmetric,
    steady_wheels,
)
from polhode._method._base import Record
from polhode._scene import Scene, State, UniformGravity, Wheels


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

    def _size(self, n, count):
        if self.chunk is not None:
            return max(1, self.chunk // count)
        # By measurement: at once twice as fast as in a loop, in which few bodies do best.
        if n * count <= 2**14:
            return n
        return max(1, 2**12 // count) if count > 32 else 128

    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        refusal = self.objection(scene) or not_symmetric(scene) or axial_wheels(scene)
        gravity: Any = scene.potential
        if refusal is not None or gravity.on_axis:
            return refusal
        centre = gravity.centre_body
        if not is_concrete(centre) or np.any(np.asarray(centre)[..., :2] != 0):
            return "the centre of mass is not known to lie on body z (ph.UniformGravity.axial)"
        return None

    def objection(self, scene: Scene) -> str | None:
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
        transverse, moments, axial = axial_start(scene, state)
        gravity: Any = scene.potential
        centre = as_lanes(gravity.centre_body, n, 1)
        force = as_lanes(gravity.mass, n)[:, None] * as_lanes(gravity.gravity_space, n, 1)
        wxyz, omega = tops.lagrange_motion(
            transverse, force, centre[:, 2], state.wxyz, state.omega_body, axial, elapsed
        )
        lawful = (moments[:, 0] == moments[:, 1]) & (centre[:, 0] == 0) & (centre[:, 1] == 0)
        return wxyz, omega, lawful & steady_wheels(scene, n)
