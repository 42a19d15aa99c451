"""The free body as a closed form: the method, its batches, and symmetric bodies."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode import _policy, rotation
from polhode._batch import PARTS
from polhode._closed_forms._closed_form import AbstractClosedForm, with_first
from polhode._closed_forms._free_constants import (
    FreeConstants,
    Polhode,
    Precession,
    Triple,
    as_components,
    compensated_constants,
    motion_constants,
)
from polhode._closed_forms._free_derivatives import EvaluatedMotion, results_rule
from polhode._closed_forms._free_motion import Instant, advance, attitude_at, body_rates
from polhode._closed_forms._free_tangent import Quadruple
from polhode._kernels import computed_once, kernel, map_chunks
from polhode._method import Record, Samples, Status, StepCounts
from polhode._scene import Scene, State
from polhode.inertia import Symmetry, principal


class ClosedForm(AbstractClosedForm):
    """The exact free motion in Jacobi elliptic functions, O(1) in time, for every inertia.

    For bodies of symmetric type (``ph.Inertia.axisymmetric``, ``spherical``) the functions are
    circular. The scene must have no potential and no torque. The error is rounding: a few units in
    the last place of the phase. ``chunk``: maximum bodies times samples that are computed at once;
    None: chosen by the library. Steps are reported as 0.

    ``compensated``: frequencies as sums of two floats, so that the error does not grow with the
    phase over a long horizon. This takes a few hundred nanoseconds per body and 2 ns per sample.
    It has no effect on bodies of symmetric type, nor, in float64, on bodies within 1e-15 of the
    separatrix or of a symmetry.
    """

    chunk: int | None = eqx.field(static=True, default=None)
    compensated: bool = eqx.field(static=True, default=False)

    @property
    def is_compensated(self) -> bool:
        return self.compensated

    def objection(self, scene: Scene) -> str | None:
        if scene.is_free:
            return None
        acting = (part for part in PARTS[1:] if getattr(scene, part) is not None)
        return f"it solves free bodies only, and the scene has a {' and '.join(acting)}"

    def why_not(self, scene: Scene) -> str | None:
        return self.objection(scene)

    def run(self, scene: Scene, state: State, ts: Array, rtol: Array, record: Record) -> Samples:
        del rtol
        self.refuse(scene)
        # the first sample is the state itself
        sample_times = ts[..., -1:] if record.final_only else ts[..., 1:]
        t = sample_times - ts[..., :1]
        inertia = scene.constant_inertia
        axes = products = None
        moments, wxyz, omega = inertia.moments, state.wxyz, state.omega_body
        if not inertia.is_principal:
            tensor = jnp.broadcast_to(inertia.full, (wxyz.shape[0], 3, 3))
            moments, axes, products = principal(tensor)
            products = products[..., ::-1]  # (yz, zx, xy) -> (xy, xz, yz)
            wxyz, omega = kernel(_in_axes)(axes, wxyz, omega)
        n, requested = wxyz.shape[0], {"attitude": record.attitude, "rates": record.rates}
        of_inertia = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (n, x.shape[-1])), (moments, products)
        )
        times = t if t.ndim == 2 else None
        motion = _MOTION[inertia.symmetry]
        if inertia.symmetry is Symmetry.NONE:
            requested["compensated"] = self.compensated

        samples, chunk = t.shape[-1], self.chunk
        if chunk is None:
            chunk = _policy.samples_at_once(_policy.FREE_CHUNK)
        single_body = n == 1 and samples > chunk
        size, pieces = max(1, chunk // samples), n
        lanes = (of_inertia, wxyz, omega)
        time_by_time = (
            self.chunk is None and motion is _triaxial and _policy.is_time_loop(n, samples)
        )
        if single_body:  # one body at many times is computed as several bodies at a part of them
            pieces = -(-samples // chunk)
            samples_per_piece = -(-samples // pieces)
            times = jnp.pad(t.reshape(-1), (0, pieces * samples_per_piece - samples), mode="edge")
            times = times.reshape(pieces, samples_per_piece)
            lanes = jax.tree.map(lambda x: jnp.repeat(x, pieces, axis=0), lanes)
        elif time_by_time:
            size = chunk_size(n)

        def move(chunk):
            (moments, products), wxyz, omega, times = chunk
            times = t[None] if times is None else times
            return motion(moments, products, wxyz, omega, times, requested)

        def assemble(parts, axes, state):
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

        if time_by_time:
            wxyz, omega, finite = map_chunks(
                lambda chunk: assemble(move(chunk[0]), *chunk[1:]),
                ((*lanes, times), axes, state),
                n,
                size,
            )
        else:
            parts = map_chunks(move, (*lanes, times), pieces, size)
            if single_body:
                parts = jax.tree.map(lambda x: x.reshape(1, -1)[:, :samples], parts)
            wxyz, omega, finite = assemble(parts, axes, state)
        status = jnp.where(finite, Status.SUCCESSFUL, Status.NOT_FINITE)
        return Samples(wxyz, omega, status, StepCounts.of(jnp.zeros_like(status)))


def _in_axes(axes, wxyz, omega):
    """Attitude and rates in the principal axes, which result from the body's by ``axes`` (wxyz)."""
    return rotation.multiply(wxyz, axes), rotation.rotate(rotation.conjugate(axes), omega)


def _triaxial(moments, products, wxyz, omega, t, requested):
    if t.shape[-1] > 1:
        return free_motion(moments, wxyz, omega, t, products, **requested)
    # For one time per body there is a separate kernel, nearly twice as fast.
    motion = free_motion(moments, wxyz, omega, t[:, 0], products, **requested)
    return jax.tree.map(lambda x: x[:, None], motion)


def _symmetric(moments, products, wxyz, omega, t, requested):
    moments, wxyz, omega = (x[:, None] for x in (moments, wxyz, omega))
    return _components(symmetric_motion(moments, wxyz, omega, t, **requested))


def _spherical(moments, products, wxyz, omega, t, requested):
    return _components(spherical_motion(wxyz[:, None], omega[:, None], t, **requested))


def _components(motion):
    wxyz, omega = motion
    return tuple(None if x is None else jnp.unstack(x, axis=-1) for x in (omega, wxyz))


_MOTION = {
    Symmetry.NONE: _triaxial,
    Symmetry.AXISYMMETRIC: _symmetric,
    Symmetry.SPHERICAL: _spherical,
}


def prepare(moments, wxyz, omega, products=None, *, compensated: bool = False) -> FreeConstants:
    """Constants of the exact motion of free bodies.

    **Arguments:** principal ``moments`` (..., 3), positive, in any order; initial attitude
    ``wxyz`` (..., 4), or None where only rates are requested; initial body rates ``omega``
    (..., 3) along the principal axes; ``products`` (..., 3), the entries xy, xz, yz of the inertia
    tensor, whose values are zero and which are needed for derivatives only. Each may be a tuple of
    component arrays; all components have one shape, that of the batch. ``compensated``: the
    frequencies as sums of two floats, for long horizons.
    """
    moments, omega = as_components(moments), as_components(omega)
    products = None if products is None else as_components(products)
    wxyz = None if wxyz is None else as_components(wxyz)
    constants_of = compensated_constants if compensated else motion_constants
    return FreeConstants(moments, products, omega, wxyz, *constants_of(moments, omega, wxyz))


def evaluate(
    motion: FreeConstants, t: Float[Array, "..."], *, attitude: bool = True, rates: bool = True
) -> tuple[Triple | None, Quadruple | None]:
    """Body rates and attitude at times ``t`` from the start, as tuples of component arrays.

    ``t`` has the rank of the batch and broadcasts with it, or one trailing axis more: the times
    of each body. Times may be negative. Results that are not requested are None and not computed.
    """
    batch = motion.moments[0].ndim
    t = jnp.asarray(t)
    if t.ndim > batch + 1:
        raise ValueError(f"t has {t.ndim} axes, the motion {batch}: expected as many or one more")
    if attitude and motion.precession is None:
        raise ValueError("the motion was prepared without wxyz: pass it, or attitude=False")
    has_time_axis = t.ndim == batch + 1
    if has_time_axis:
        motion = jax.tree.map(lambda x: x[..., None], motion)
    elif t.ndim < batch:
        t = t.reshape((1,) * (batch - t.ndim) + t.shape)
    precession = motion.precession if attitude else None
    arguments = (
        motion.moments,
        motion.products,
        motion.omega,
        motion.wxyz if attitude else None,
        t,
    )
    # The constants are not differentiated (see ``_free_derivatives``).
    constants = jax.lax.stop_gradient((motion.polhode, precession))
    return _evaluate((attitude, rates, has_time_axis), constants, arguments)


def free_motion(
    moments,
    wxyz,
    omega,
    t,
    products=None,
    *,
    attitude: bool = True,
    rates: bool = True,
    compensated: bool = False,
) -> tuple[Triple | None, Quadruple | None]:
    """The exact free motion: `prepare` and `evaluate` in one call.

    A long batch of one axis is computed in chunks that fit into the cache of a processor core.

    First and second derivatives, in forward and reverse mode, are accurate to rounding for all
    motions, with two exceptions for second derivatives. The relative error of those by ``products``
    grows with the inverse relative difference of two moments, and they are NaN if two agree to half
    of their digits. The relative error of those by the rates grows with one radian over the angle
    of rotation, except at rest.
    """
    parts = (
        as_components(moments),
        as_components(wxyz) if attitude else None,
        as_components(omega),
        None if products is None else as_components(products),
    )

    t = jnp.asarray(t)
    requested = {"attitude": attitude, "rates": rates}
    if t.ndim == 2 and parts[0][0].ndim == 1 and _policy.is_time_loop(len(parts[0][0]), t.shape[1]):
        return _chunked(
            lambda arguments, t: _time_by_time(arguments, t, compensated, requested),
            parts,
            t,
            _policy.FREE_LANES,
        )

    def whole_motion(arguments, t):
        return evaluate(prepare(*arguments, compensated=compensated), t, **requested)

    chunk = _policy.samples_at_once(_policy.FREE_CHUNK)
    if t.ndim <= parts[0][0].ndim:
        # With one time per body, derivatives evaluate the motion again: to store the hundreds of
        # coefficients takes longer, and Hessians would take minutes to compile. With many times,
        # the program that stores them compiles faster.
        return _chunked(kernel(whole_motion, repeated=True), parts, t, chunk)
    rows = max(1, chunk // max(t.shape[1] if t.ndim == 2 else 1, 1))
    return _chunked(kernel(whole_motion, linearised=True), parts, t, rows)


def _time_by_time(arguments, t, compensated: bool, requested):
    """The motion of many bodies in a loop over the times; the constants are computed once."""

    def constants(arguments):
        motion = prepare(*arguments, compensated=compensated)
        return motion.polhode, motion.precession

    prepared = kernel(constants)(jax.lax.stop_gradient(arguments))

    def at(arguments, prepared, t):
        moments, wxyz, omega, products = arguments
        return evaluate(FreeConstants(moments, products, omega, wxyz, *prepared), t, **requested)

    # Coefficients of the derivative are computed again where they are used: to store them for all
    # times takes longer, because of the memory bandwidth.
    at_time = jax.checkpoint(kernel(at, linearised=True), prevent_cse=False)
    samples = jax.lax.map(lambda t: at_time(arguments, prepared, t), t.T)
    return jax.tree.map(jnp.transpose, samples)


def chunk_size(count: int, largest: int = _policy.FREE_LANES) -> int:
    """Bodies of a chunk: if possible a divisor of ``count``, so that no array is padded."""
    if count < 2 * largest:
        return count
    return next(
        (n for n in range(largest, largest // 4 - 1, -1) if n > 0 and count % n == 0), largest
    )


def _chunked(fn, parts, t, rows):
    """``fn(parts, t)``, for large batches in chunks of ``rows`` bodies."""
    lanes = parts[0][0]
    if lanes.ndim != 1 or lanes.shape[0] < 2 * rows:
        return fn(parts, t)
    count = lanes.shape[0]
    rows = chunk_size(count, rows)
    padding = -count % rows

    def pieces_of(x):
        if padding == 0:
            return x.reshape(-1, rows, *x.shape[1:])
        fill = jnp.broadcast_to(x[-1:], (padding, *x.shape[1:]))
        return jnp.concatenate([x, fill]).reshape(-1, rows, *x.shape[1:])

    own_times = t.ndim > 0 and t.shape[0] == count
    pieces = jax.tree.map(pieces_of, (parts, t) if own_times else (parts, None))
    out = jax.lax.map(lambda p: fn(p[0], p[1] if own_times else t), pieces)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], out)


def _results(requested, polhode: Polhode, precession: Precession | None, at: Instant):
    return (
        body_rates(polhode, at) if requested[1] else None,
        attitude_at(polhode, precession, at) if requested[0] else None,
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _evaluate(requested, constants, arguments):
    polhode, precession = constants
    at = advance(polhode, precession, arguments[-1])
    return _results(requested, polhode, precession, at)


def _evaluate_rule(requested, primals, tangents):
    (polhode, precession), arguments = primals
    t = jax.lax.stop_gradient(arguments[-1])
    # In finer stages: the tangent consists of many loops, and XLA would repeat the motion in each.
    at = advance(polhode, precession, t, more_stages=True)
    motion = EvaluatedMotion(polhode, precession, at, _results(requested, polhode, precession, at))
    return results_rule(requested, (motion, arguments), (None, tangents[1]))


_evaluate.defjvp(_evaluate_rule, symbolic_zeros=True)


class SymmetricMotion(NamedTuple):
    """Attitude (..., 4) and rates (..., 3) of a symmetric free body; None where not requested."""

    wxyz: Array | None
    omega_body: Array | None


def symmetric_motion(
    moments: Float[Array, "*#b 3"],
    wxyz: Float[Array, "*#b 4"],
    omega_body: Float[Array, "*#b 3"],
    t: Float[Array, "*#b"],
    *,
    attitude: bool = True,
    rates: bool = True,
) -> SymmetricMotion:
    """Regular precession of a body with equal moments about body x and y.

    ``moments`` (..., 3) [kg m^2], of which the first two are assumed equal; ``t`` (...) [s] since
    the state ``wxyz``, ``omega_body``. The body rotates about its axis at ``lambda = (1 - I3/I1)
    w3``, and its axis about the constant momentum at ``|L|/I1``.
    """
    transverse, axial = moments[..., 0], moments[..., 2]
    slip = (transverse - axial) / transverse * omega_body[..., 2]
    wxyz_at_t = omega_at_t = None
    if rates:
        # here and below: computed once, not again for each component of the result
        cos, sin = computed_once((jnp.cos(slip * t), jnp.sin(slip * t)))
        x, y = omega_body[..., 0], omega_body[..., 1]
        spin = jnp.broadcast_to(omega_body[..., 2], cos.shape)
        omega_at_t = jnp.stack([x * cos + y * sin, y * cos - x * sin, spin], axis=-1)
    if attitude:
        own_momentum = computed_once(omega_body * moments)
        momentum = rotation.rotate(wxyz, own_momentum) / transverse[..., None]
        angle = computed_once(momentum * t[..., None])
        precession = rotation.rotation_vector_to_wxyz(angle)
        half = slip * t / 2
        zero = jnp.zeros_like(half)
        axial_rotation = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1)
        precession, axial_rotation = computed_once((precession, axial_rotation))
        after_precession = computed_once(rotation.multiply(precession, wxyz))
        wxyz_at_t = rotation.multiply(after_precession, axial_rotation)
    return SymmetricMotion(wxyz_at_t, omega_at_t)


def spherical_motion(
    wxyz: Float[Array, "*#b 4"],
    omega_body: Float[Array, "*#b 3"],
    t: Float[Array, "*#b"],
    *,
    attitude: bool = True,
    rates: bool = True,
) -> SymmetricMotion:
    """Constant rates of a body with three equal moments: rotation about a fixed axis."""
    shape = jnp.broadcast_shapes(omega_body.shape[:-1], t.shape)
    wxyz_at_t = None
    if attitude:
        rotation_quaternion = rotation.rotation_vector_to_wxyz(omega_body * t[..., None])
        rotation_quaternion = computed_once(rotation_quaternion)
        wxyz_at_t = rotation.multiply(wxyz, rotation_quaternion)
    return SymmetricMotion(wxyz_at_t, jnp.broadcast_to(omega_body, (*shape, 3)) if rates else None)
