"""The exact motion of the free body as a method: nothing is stepped."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from polhode import free, rotation
from polhode._lanes import along_time, is_lane_tree, map_chunks
from polhode._methods import AbstractMethod, Record, Samples
from polhode._scene import Scene
from polhode._state import State
from polhode._status import Status
from polhode.inertia import Symmetry, principal


class ClosedForm(AbstractMethod):
    """The exact free motion in Jacobi elliptic functions, O(1) in time, for every inertia.

    Bodies known to be axisymmetric or spherical (``ph.Inertia.axisymmetric``, ``spherical``) use
    circular functions only. Needs a scene without potential and torque. The error is rounding: a
    few units in the last place of the phase turned through. ``chunk`` bounds the bodies times
    samples worked on at once; None: chosen by the library. Steps are reported as 0.
    """

    chunk: int | None = eqx.field(static=True, default=None)

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        del rtol
        if not scene.is_free:
            raise ValueError(
                "ph.ClosedForm solves free bodies only, and this scene has a potential, a torque or"
                " rotors: leave method=None, or use ph.LiePoisson()."
            )
        count = 1 if record.final_only else ts.shape[-1]
        size = max(1, (_CHUNK if self.chunk is None else self.chunk) // count)
        lanes, shared = eqx.partition((scene, state), is_lane_tree((scene, state)))

        def one(chunk):
            lanes, times = chunk
            scene, state = eqx.combine(lanes, shared)
            return _motion(scene, state, ts if times is None else times, record)

        times = ts if ts.ndim == 2 else None
        return map_chunks(one, (lanes, times), state.wxyz.shape[0], size)


_CHUNK = 2**14
"""Bodies times samples per chunk: by measurement the largest that stays in a core's cache."""


def _motion(scene: Scene, state: State, ts: Array, record: Record) -> Samples:
    """Samples of one chunk of lanes."""
    kept = ts[..., -1:] if record.final_only else ts
    t = kept - ts[..., :1]
    t = t if t.ndim == 2 else t[None]
    inertia, wanted = scene.inertia, {"attitude": record.attitude, "rates": record.rates}
    if inertia.symmetry is Symmetry.NONE:
        wxyz, omega = _general(inertia, state, t, wanted)
    else:
        wxyz, omega = state.wxyz[:, None], state.omega_body[:, None]
        if inertia.symmetry is Symmetry.SPHERICAL:
            wxyz, omega = free.spherical_motion(wxyz, omega, t, **wanted)
        else:
            moments = along_time(inertia, 1).moments
            wxyz, omega = free.symmetric_motion(moments, wxyz, omega, t, **wanted)
    n = state.wxyz.shape[0]
    finite = jnp.ones(n, bool)
    for part in (wxyz, omega):
        if part is not None:
            finite = finite & jnp.all(jnp.isfinite(part), axis=(-1, -2))
    status = jnp.where(finite, Status.SUCCESSFUL, Status.NOT_FINITE)
    return Samples(wxyz, omega, status, jnp.zeros(n, status.dtype))


def _general(inertia, state, t, wanted):
    """Any inertia: into principal axes (found once), the exact motion, and back."""
    n = state.wxyz.shape[0]
    wxyz, omega, axes, products = state.wxyz, state.omega_body, None, None
    moments = inertia.diagonal
    if moments is None:
        moments, axes, products = principal(inertia.full)
        products = products[..., ::-1]  # (yz, zx, xy) -> (xy, xz, yz)
        axes, products = (jnp.broadcast_to(x, (n, x.shape[-1])) for x in (axes, products))
        wxyz = rotation.multiply(wxyz, axes)
        omega = rotation.rotate(rotation.conjugate(axes), omega)
    moments = jnp.broadcast_to(moments, (n, 3))
    omega, wxyz = free.free_motion(moments, wxyz, omega, t, products, **wanted)
    wxyz, omega = (None if x is None else jnp.stack(x, axis=-1) for x in (wxyz, omega))
    if axes is not None:
        axes = axes[:, None]
        wxyz = None if wxyz is None else rotation.multiply(wxyz, rotation.conjugate(axes))
        omega = None if omega is None else rotation.rotate(axes, omega)
    return wxyz, omega
