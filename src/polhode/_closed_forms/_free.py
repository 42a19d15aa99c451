"""The exact motion of the free body as a method: nothing is stepped."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import rotation
from polhode._batch import PARTS, map_chunks
from polhode._closed_forms import free
from polhode._closed_forms._law import AbstractExact, with_first
from polhode._method._base import Record, Samples
from polhode._method._status import Status
from polhode._scene import Scene, State
from polhode.inertia import Symmetry, principal


class ClosedForm(AbstractExact):
    """The exact free motion in Jacobi elliptic functions, O(1) in time, for every inertia.

    Bodies known to be axisymmetric or spherical (``ph.Inertia.axisymmetric``, ``spherical``) use
    circular functions only. Needs a scene without potential and torque. The error is rounding: a
    few units in the last place of the phase turned through. ``chunk`` bounds the bodies times
    samples worked on at once; None: chosen by the library. Steps are reported as 0.

    ``compensated``: frequencies in sums of two floats (double-double in float64), so that over a
    long horizon the error no longer grows with the phase. It costs a few hundred nanoseconds per
    body, and 2 per sample, and no digit elsewhere. Bodies within 1e-15 of the separatrix or of a
    symmetry, or known to be symmetric, have none of it.
    """

    chunk: int | None = eqx.field(static=True, default=None)
    compensated: bool = eqx.field(static=True, default=False)

    def objection(self, scene: Scene) -> str | None:
        if scene.is_free:
            return None
        acting = (part for part in PARTS[1:] if getattr(scene, part) is not None)
        return f"it solves free bodies only, and the scene has a {' and '.join(acting)}"

    def why_not(self, scene: Scene, state: State, record: Record) -> str | None:
        return self.objection(scene)

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        del rtol
        self.refuse(scene)
        kept = ts[..., -1:] if record.final_only else ts[..., 1:]  # at the first it is given
        t = kept - ts[..., :1]
        inertia = scene.inertia
        axes = products = None
        moments, wxyz, omega = inertia.moments, state.wxyz, state.omega_body
        if not inertia.is_principal:
            whole = jnp.broadcast_to(inertia.full, (wxyz.shape[0], 3, 3))
            moments, axes, products = principal(whole)
            products = products[..., ::-1]  # (yz, zx, xy) -> (xy, xz, yz)
            wxyz = rotation.multiply(wxyz, axes)
            omega = rotation.rotate(rotation.conjugate(axes), omega)
        n, wanted = wxyz.shape[0], {"attitude": record.attitude, "rates": record.rates}
        given = jax.tree.map(lambda x: jnp.broadcast_to(x, (n, x.shape[-1])), (moments, products))
        times = t if t.ndim == 2 else None
        motion = _MOTION[inertia.symmetry]
        if inertia.symmetry is Symmetry.NONE:
            wanted["compensated"] = self.compensated

        chunk, samples = _CHUNK if self.chunk is None else self.chunk, t.shape[-1]
        lone = n == 1 and samples >= _WORTH_TWO
        size, pieces = max(1, chunk // samples), n
        lanes = (given, wxyz, omega)
        abreast = self.chunk is None and motion is _triaxial and free.is_abreast(n, samples)
        if lone:  # one body at many times: as several bodies, each at a part of them
            pieces = max(2, -(-samples // chunk))
            each = -(-samples // pieces)
            times = jnp.pad(t.reshape(-1), (0, pieces * each - samples), mode="edge")
            times = times.reshape(pieces, each)
            lanes = jax.tree.map(lambda x: jnp.repeat(x, pieces, axis=0), lanes)
        elif abreast:
            size = free.even_rows(n)
        elif n * samples >= _WORTH_TWO:
            size = min(size, -(-n // 2))

        def one(chunk):
            (moments, products), wxyz, omega, times = chunk
            times = t[None] if times is None else times
            return motion(moments, products, wxyz, omega, times, wanted)

        def finished(parts, axes, state):
            omega, wxyz = (None if x is None else jnp.stack(x, axis=-1) for x in parts)
            if axes is not None:
                axes = axes[:, None]
                wxyz = None if wxyz is None else rotation.multiply(wxyz, rotation.conjugate(axes))
                omega = None if omega is None else rotation.rotate(axes, omega)
            if not record.final_only:
                wxyz, omega = with_first(state, wxyz, omega)
            finite = jnp.ones(state.wxyz.shape[0], bool)
            for part in (wxyz, omega):
                if part is not None:
                    finite = finite & jnp.all(jnp.isfinite(part), axis=(-1, -2))
            return wxyz, omega, finite

        if abreast:
            wxyz, omega, finite = map_chunks(
                lambda chunk: finished(one(chunk[0]), *chunk[1:]),
                ((*lanes, times), axes, state), n, size,
            )  # fmt: skip
        else:
            # Components are put together only here: fused with the motion, the stacking would have
            # all of them worked out anew for each entry. A loop of two chunks keeps them apart.
            parts = map_chunks(one, (*lanes, times), pieces, size)
            if lone:
                parts = jax.tree.map(lambda x: x.reshape(1, -1)[:, :samples], parts)
            wxyz, omega, finite = finished(parts, axes, state)
        status = jnp.where(finite, Status.SUCCESSFUL, Status.NOT_FINITE)
        return Samples(wxyz, omega, status, jnp.zeros(n, status.dtype))


_CHUNK = 2**13
"""Bodies times samples per chunk: by measurement the largest that stays in a core's cache."""


_WORTH_TWO = 8
"""Bodies times samples from which two chunks cost less than one without a loop."""


def _triaxial(moments, products, wxyz, omega, t, wanted):
    if t.shape[-1] > 1:
        return free.free_motion(moments, wxyz, omega, t, products, **wanted)
    # One time per body has kernels of its own, nearly twice as fast.
    motion = free.free_motion(moments, wxyz, omega, t[:, 0], products, **wanted)
    return jax.tree.map(lambda x: x[:, None], motion)


def _symmetric(moments, products, wxyz, omega, t, wanted):
    moments, wxyz, omega = (x[:, None] for x in (moments, wxyz, omega))
    return _components(free.symmetric_motion(moments, wxyz, omega, t, **wanted))


def _spherical(moments, products, wxyz, omega, t, wanted):
    return _components(free.spherical_motion(wxyz[:, None], omega[:, None], t, **wanted))


def _components(motion):
    wxyz, omega = motion
    return tuple(
        None if x is None else tuple(x[..., k] for k in range(x.shape[-1])) for x in (omega, wxyz)
    )


_MOTION = {
    Symmetry.NONE: _triaxial,
    Symmetry.AXISYMMETRIC: _symmetric,
    Symmetry.SPHERICAL: _spherical,
}
