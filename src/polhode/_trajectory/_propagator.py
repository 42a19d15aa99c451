"""Trajectories at other times than their samples, by running the method of the simulation again."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from polhode._batch import PARTS, flatten, lane_times, map_arrays
from polhode._checks import ArrayLike, as_float_array
from polhode._failed import with_gradients
from polhode._kernels import is_differentiated, jit_distinct
from polhode._method import AbstractMethod, Record, Status, raise_on_failure
from polhode._scene import Scene, State, Wheels
from polhode._trajectory._trajectory import AbstractPropagator, Ending, Trajectory
from polhode.rotation._quaternion import wxyz_rate


class Propagator(AbstractPropagator):
    """The method that computed a trajectory, and its tolerance (None for exact methods).

    Arrays of the method are leaves and the rest of it is static, so that ``jax.jit`` and
    ``jax.vmap`` can return trajectories.
    """

    arrays: Any
    static: Any = eqx.field(static=True)
    rtol: Array | None

    @classmethod
    def of(cls, method: AbstractMethod, rtol: Any) -> "Propagator":
        """From the method and the tolerance of a simulation."""
        return cls(*eqx.partition(method, eqx.is_array), None if method.exact else rtol)

    @property
    def method(self) -> AbstractMethod:
        """The method."""
        return eqx.combine(self.arrays, self.static)

    def at(self, trajectory: Trajectory, t: ArrayLike) -> Trajectory:
        times = as_float_array("t", t, finite=False).astype(trajectory.ts.dtype)
        times = times[None] if times.ndim == 0 else times
        if times.size == 0:
            raise ValueError("t must hold at least one time, got none.")
        batch = trajectory.batch_shape
        try:
            fits = jnp.broadcast_shapes(times.shape[:-1], batch) == batch
        except ValueError:
            fits = False
        if not fits:
            raise ValueError(
                f"t must have shape (K,), or (..., K) with the batch axes {batch} of the bodies,"
                f" got {times.shape}."
            )
        if trajectory._ending is not None:
            times = _until_event(trajectory._ending, times, batch)
        result = moved_to(trajectory, times)
        if not isinstance(result.status, Tracer):
            raise_on_failure(result.status)
        return result


def moved_to(trajectory: Trajectory, t: Array) -> Trajectory:
    """The trajectory at times (K,) or (..., K) of its dtype, in any order, as ``Trajectory.at``."""
    return _at_times(trajectory, t, False)


def moved_through(trajectory: Trajectory, t: Array) -> Trajectory:
    """``moved_to`` for sorted times, by one integration from the first sample: faster for many."""
    return _at_times(trajectory, t, True)


@jit_distinct
def _at_times(trajectory: Trajectory, t: Array, in_order: bool) -> Trajectory:
    propagator: Any = trajectory.propagator
    batch, ts = trajectory.batch_shape, trajectory.ts
    parts = {name: flatten(getattr(trajectory.scene, name), batch) for name in PARTS}
    samples = [x.reshape(-1, *x.shape[len(batch) :]) for x in trajectory._samples]
    finite, times = jnp.isfinite(t), t
    if ts.ndim > 1 or times.ndim > 1:  # one row for each body
        ts, times = (lane_times(jnp.atleast_2d(x), batch) for x in (ts, times))
    times = jnp.where(jnp.isfinite(times), times, ts[..., :1])
    move = _from_first if in_order or propagator.method.exact else _from_nearest
    # when derivatives are computed, bodies with NaN samples get finite ones: see ``_failed``
    inputs = jax.tree.leaves(eqx.filter((parts, samples, t), eqx.is_inexact_array))
    is_sound = jnp.isfinite(sum(x.sum((-1, -2)) for x in samples)) | ~is_differentiated(inputs)
    samples = [jnp.where(is_sound[:, None, None], x, 0.5) for x in samples]
    states, status, steps = move(propagator, Scene(**parts), samples, ts, times)
    wxyz, omega, *spins = (x.reshape(*batch, *x.shape[1:]) for x in states)
    is_finite = jnp.broadcast_to(finite, wxyz.shape[:-1])[..., None]
    status = status.reshape(batch)
    steps = jax.tree.map(lambda x: x.reshape(batch), steps)
    # the samples of a body with more events than can be stored are valid
    good = (trajectory.status == Status.SUCCESSFUL) | (trajectory.status == Status.TOO_MANY_EVENTS)
    samples = [jnp.where(is_finite, x, jnp.nan) for x in (wxyz, omega, *spins)]
    status = jnp.where(good, status, trajectory.status)
    any_finished = jnp.where(jnp.any(status == Status.SUCCESSFUL), 1.0, 0.0)
    samples = [with_gradients(x, is_sound.reshape(batch), any_finished) for x in samples]
    return trajectory._with_samples(t, samples, status, steps, trajectory._ending)


def _until_event(ending: Ending, times: Array, batch: tuple[int, ...]) -> Array:
    """Times (..., K), those beyond the event of a body replaced by the time of its event."""
    times = jnp.broadcast_to(times, (*batch, times.shape[-1]))
    event, sign = (jnp.broadcast_to(x[..., None], times.shape) for x in ending)
    beyond = jnp.isfinite(event) & jnp.isfinite(times) & (sign * times > sign * event)
    return jnp.where(beyond, event, times)


def with_initial_spins(scene: Scene, spins: list[Array]) -> Scene:
    """The scene with these initial momenta of its coupled wheels, if it has any."""
    if not spins or not isinstance(scene.rotors, Wheels):
        return scene
    return Scene(
        scene.inertia, scene.potential, scene.torque, scene.rotors.with_spins_at_start(*spins)
    )


def _from_first(propagator: Propagator, scene: Scene, samples, ts, times):
    """States at ``times`` (sorted, or in any order for a closed form) from the first sample."""
    wxyz, omega, *spins = (x[:, 0] for x in samples)
    times = jnp.concatenate([ts[..., :1], times], axis=-1)
    rtol = None if propagator.rtol is None else jnp.min(propagator.rtol)
    result = propagator.method.run(
        with_initial_spins(scene, spins), State(wxyz, omega), times, rtol, Record()
    )
    states = [x[:, 1:] for x in (result.wxyz, result.omega_body, result.spins) if x is not None]
    return states, result.status, result.steps


def _from_nearest(propagator: Propagator, scene: Scene, samples, ts, times):
    """States at each time by integration from the nearest sample."""
    # a trajectory returned by vmap has one tolerance for each body; all are equal
    rtol = jnp.min(propagator.rtol)
    final = Record(final_only=True)
    unit = _gap(ts, times)

    def from_sample(scene, start, begin, end, unit):
        """Lanes at ``end`` () or (N,), their status and steps."""
        wxyz, omega, *spins = start
        scene = with_initial_spins(scene, spins)
        is_sample_time = begin == end
        span = jnp.stack([begin, jnp.where(is_sample_time, begin + unit, end)], axis=-1)
        result = propagator.method.run(scene, State(wxyz, omega), span, rtol, final)
        # at the time of a sample: the sample itself, with its time derivatives
        step = jnp.broadcast_to((end - begin)[..., None], (*wxyz.shape[:-1], 1))
        is_sample = jnp.broadcast_to(is_sample_time[..., None], step.shape)
        end_states = [
            x[:, 0] for x in (result.wxyz, result.omega_body, result.spins) if x is not None
        ]
        _, later = _along(scene, start, begin)
        start_states = later(jnp.where(is_sample, step, 0))
        states = [jnp.where(is_sample, x, end) for x, end in zip(start_states, end_states)]
        return (
            states,
            jnp.where(is_sample[:, 0], Status.SUCCESSFUL, result.status),
            jax.tree.map(lambda x: jnp.where(is_sample[:, 0], 0, x), result.steps),
        )

    if ts.ndim == 1:
        place = _nearest(ts, times)

        def state_at(arguments):
            k, t = arguments
            return from_sample(scene, [x[:, k] for x in samples], ts[k], t, unit)

        states, status, steps = jax.lax.map(state_at, (place, times))
        states = [jnp.moveaxis(x, 0, 1) for x in states]
        return states, jnp.max(status, axis=0), jax.tree.map(lambda x: jnp.sum(x, axis=0), steps)
    n, count = times.shape
    place = jax.vmap(_nearest)(ts, times)
    begin = jnp.take_along_axis(ts, place, axis=-1).reshape(-1)
    start = [
        jnp.take_along_axis(x, place[..., None], axis=1).reshape(n * count, -1) for x in samples
    ]

    def each_time(x, rank):
        return x[:, None] if x.ndim > rank else x

    parts = {name: map_arrays(getattr(scene, name), each_time) for name in PARTS}
    parts = {name: flatten(part, (n, count)) for name, part in parts.items()}
    states = from_sample(Scene(**parts), start, begin, times.reshape(-1), unit.reshape(-1))
    states, status, steps = jax.tree.map(lambda x: x.reshape(n, count, *x.shape[1:]), states)
    return states, jnp.max(status, axis=-1), jax.tree.map(lambda x: jnp.sum(x, axis=-1), steps)


def shortly_after(
    trajectory: Trajectory, shift: list[Array] | None = None
) -> tuple[list[Array], Callable[[Array], Trajectory]]:
    """Time derivatives of the samples, and a function of short delays (..., T) [s] that returns the
    trajectory later by these, by its Taylor series to second order: for delays of value zero it
    gives the values with correct first and second derivatives. ``shift``: changes of attitudes,
    rates and times at which the derivatives are evaluated."""
    t = trajectory
    rates, along = _along(t._scene, t._samples, t._t, shift)

    def later(delay: Array) -> Trajectory:
        return t._with_samples(t._t + delay, along(delay[..., None]), t.status, t._steps, None)

    return rates, later


def _along(
    scene: Scene, samples: list[Array], t: Array, shift: list[Array] | None = None
) -> tuple[list[Array], Callable[[Array], list[Array]]]:
    """Time derivatives of samples (..., 4), (..., 3) and of momenta of coupled wheels, and a
    function of a step (..., 1) [s] that returns the samples later by it; see ``shortly_after``."""

    def rates(samples, t):
        wxyz, omega, *spins = samples
        wheel_spins = tuple(jnp.moveaxis(spins[0], -1, 0)) if spins else ()
        acceleration, wheel_torques = scene.with_spins(wheel_spins).changes(wxyz, omega, t)
        spin_rates = (
            [jnp.stack(jnp.broadcast_arrays(*wheel_torques), axis=-1)] if wheel_torques else []
        )
        return [wxyz_rate(wxyz, omega), acceleration, *spin_rates]

    begin = list(samples), jnp.asarray(t)
    if shift is not None:
        *moves, delay = shift
        moved = [x + move for x, move in zip(samples, moves)]
        begin = [*moved, *samples[2:]], begin[1] + delay
    first_derivative = rates(*begin)
    _, second_derivative = jax.jvp(rates, begin, (first_derivative, jnp.ones_like(begin[1])))

    def later(step: Array) -> list[Array]:
        return [
            x + step * (a + step / 2 * b)
            for x, a, b in zip(samples, first_derivative, second_derivative)
        ]

    return first_derivative, later


def _nearest(ts: Array, times: Array) -> Array:
    """Indices (K,) of the nearest of ``ts`` (T,), which need not be sorted, to ``times`` (K,)."""
    ts, times = jax.lax.stop_gradient((ts, times))
    order = jnp.argsort(ts)
    later = jnp.clip(jnp.searchsorted(ts[order], times), 0, ts.shape[0] - 1)
    sooner = jnp.maximum(later - 1, 0)
    closer = jnp.abs(ts[order[sooner]] - times) < jnp.abs(ts[order[later]] - times)
    return order[jnp.where(closer, sooner, later)]


def _gap(ts: Array, times: Array) -> Array:
    """A positive duration () or (N, K) in place of zero, for integrations that are not used."""
    ts, times = jax.lax.stop_gradient((ts, times))
    span = jnp.max(ts, axis=-1) - jnp.min(ts, axis=-1)
    size = jnp.max(jnp.abs(ts), axis=-1)
    gap = jnp.where(span > 0, span, jnp.maximum(size, 1)) / 1024
    gap = jnp.maximum(gap, 1024 * jnp.finfo(ts.dtype).eps * size)
    return gap if ts.ndim == 1 else jnp.broadcast_to(gap[:, None], times.shape)
