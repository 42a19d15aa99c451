"""Zero crossings of a function of attitude, rates and time along a trajectory."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from polhode import _integrate  # its names load diffrax at first use
from polhode._batch import PARTS, flatten, lane_times
from polhode._checks import is_concrete
from polhode._events._event import Event, at_least, require_bodies
from polhode._events._search import (
    Brackets,
    Evaluation,
    entries,
    first_true,
    minima_of,
    search_roots,
)
from polhode._kernels import with_derivatives_of
from polhode._method import Status
from polhode._scene import Scene, State
from polhode._trajectory import Propagator, Trajectory, moved_through, moved_to, with_initial_spins

SAMPLES_PER_REVOLUTION = 32
"""Samples per revolution at the fastest natural rate."""

_MAX_SAMPLES = 20_000_000
"""Maximum number of samples of all bodies, limited by the memory."""

_MIN_CAPACITY = 16
"""Minimum number of turning points of the function that can be examined."""

_SAMPLING_EVALUATIONS = 64
"""Maximum number of evaluations of the motion in which all samples are computed. Roots take about
16 evaluations with the same number of times."""

CAPACITY = 256
"""Default number of crossings of each body that the integration loop stores."""

AT_START = 1e-6
"""Part of the time between two samples within which a crossing counts as the start."""


class Crossings(eqx.Module):
    """Zero crossings of a function for each body, in the order of the motion.

    **Fields:** ``times`` (..., M) [s], inf where there is none; ``slope`` (..., M): derivative
    of the function there [1/s], 0 where there is none; ``count`` (...): number of crossings, which
    may exceed the capacity M (see ``complete``).
    """

    times: Float[Array, "*b m"]
    slope: Float[Array, "*b m"]
    count: Int[Array, "*b"]

    @property
    def complete(self) -> Array:
        """Whether (...) all crossings of a body are stored."""
        return self.count <= self.times.shape[-1]


def crossings(
    trajectory: Trajectory,
    fn: Callable | Event,
    direction: int = 0,
    *,
    capacity: int | None = None,
    samples: int | None = None,
) -> Crossings:
    """Times at which ``fn(wxyz, omega_body, t)`` crosses zero during a ``trajectory``.

    **Arguments:** ``fn``: a function as in ``ph.Event``, or a ``ph.Event``; ``direction``: 1
    rising, -1 falling (in time), 0 both, or that of the event; ``capacity``: number of crossings
    stored for each body; None: all of them; ``samples``: see ``ph.Event``. Under ``jit``, ``vmap``
    and ``grad`` a motion in closed form needs both; an integrated one needs neither, and stores at
    most 256 crossings of a body.

    Times are as accurate as the motion: to rounding for closed forms, to ``rtol`` over the
    derivative of the function for integrated motions. Times and ``slope`` have first and second
    derivatives, by the implicit function theorem; third derivatives raise NotImplementedError. A
    zero at the first time (within 1e-6 of the time between two samples) does not count as a
    crossing. A zero exactly at the last time may not be found: use a later last time.

    The function and its derivative are sampled 32 times per revolution of the fastest natural rate,
    the largest of |L| over the smallest moment at the saved samples and of the rate of gravity. If
    the function turns back towards zero between two samples, its turning point is located, and a
    pair of crossings around it. A pair is therefore missed only if the function has three or more
    turning points between two samples, which a direction fixed in the body does not have. Functions
    that vary faster than the body rotates (high powers, other frequencies of the time) and rates
    that rise and fall again between two saved samples need ``samples``.

    Raises ValueError for two different directions, if the samples do not fit into memory, if the
    maximum number of steps of a body is reached (under ``jit`` the result is not ``complete``), or
    if ``capacity`` or ``samples`` are missing under ``jit``.

        up = ph.crossings(traj, lambda wxyz, omega_body, t: omega_body[0], direction=1)
        traj.at(up.times).euler()
    """
    event = fn if isinstance(fn, Event) else Event(fn, direction, samples)
    if isinstance(fn, Event) and direction not in (0, fn.direction):
        if fn.direction != 0:
            raise ValueError(
                f"the event has direction={fn.direction}, and crossings was given"
                f" direction={direction!r}: leave one out."
            )
        event = Event(fn.fn, direction, fn.samples)
    slots = at_least("capacity", capacity, 1)
    size = event.samples if samples is None else at_least("samples", samples, 2)
    if not _propagator(trajectory).method.exact:
        step_result = _by_steps(trajectory, event, slots or CAPACITY)
        if step_result is not None:
            _raise_if_failed(step_result[1], "before the last time")
            return (
                step_result[0]
                if capacity is not None
                else _all_of(step_result[0], trajectory, event)
            )
    if size is None:
        size = _sample_count(trajectory)
    if slots is None:
        if not is_concrete(trajectory):
            raise ValueError(
                "under jit, vmap or grad the number of stored crossings must be given: capacity=8."
            )
        slots = _MIN_CAPACITY
    (result,), _, has_failed = _by_sampling(trajectory, [event], slots, size)
    _raise_if_failed(has_failed, f"while {size:,} samples were computed")
    while capacity is None and int(np.max(result.count, initial=0)) > slots:
        slots = 2 ** int(np.ceil(np.log2(np.max(result.count))))
        (result,), *_ = _by_sampling(trajectory, [event], slots, size)
    if capacity is None:  # drop columns that no body uses
        count = int(np.max(result.count, initial=0))
        result = Crossings(result.times[..., :count], result.slope[..., :count], result.count)
    return result


def _propagator(trajectory: Trajectory) -> Propagator:
    """The propagator of the trajectory; raises ValueError if there is none."""
    for name in ("wxyz", "omega_body"):
        require_bodies(getattr(trajectory, name))  # raises if it was not recorded, too
    if trajectory.propagator is None:
        raise ValueError("this trajectory was made by hand: use one that ph.simulate returns.")
    if not isinstance(trajectory.propagator, Propagator):
        raise ValueError(
            "a SampledTorque holds a command that the samples do not contain: events between them"
            " are not searched for."
        )
    return trajectory.propagator


def _raise_if_failed(has_failed: Array, where: str) -> None:
    if is_concrete(has_failed) and np.any(np.asarray(has_failed)):
        raise ValueError(
            f"a body reached the limit of steps {where}: search a shorter time (traj.between), or"
            " allow more steps, ph.LiePoisson(..., max_steps=2**20)."
        )


def _all_of(result: Crossings, trajectory: Trajectory, event: Event) -> Crossings:
    """All crossings, in as many columns as needed; unchanged if their number is traced."""
    if not is_concrete(result):
        return result
    capacity = int(np.max(result.count, initial=0))
    if capacity > CAPACITY:
        result, _ = _by_steps(trajectory, event, 2 ** int(np.ceil(np.log2(capacity))))
    return Crossings(result.times[..., :capacity], result.slope[..., :capacity], result.count)


@eqx.filter_jit
def _by_steps(trajectory: Trajectory, event: Event, capacity: int) -> Any:
    """Crossings located during an integration, and the bodies (...) that did not reach the last
    time; None if the method does not search for events."""
    batch = trajectory.batch_shape
    propagator: Any = trajectory.propagator
    parts = {name: flatten(getattr(trajectory.scene, name), batch) for name in PARTS}
    wxyz, omega, *spins = (x.reshape(-1, *x.shape[len(batch) :])[:, 0] for x in trajectory._samples)
    ts = lane_times(trajectory.ts[..., jnp.array([0, -1])], batch)
    scene = with_initial_spins(Scene(**parts), spins)
    search = _integrate.Search((event.fn,), (event.direction,), (False,), capacity)
    rtol = jnp.min(propagator.rtol)
    solution = propagator.method.search(scene, State(wxyz, omega), ts, rtol, search, True)
    if solution is None:
        return None
    samples, events = solution
    spins = None if samples.spins is None else samples.spins[:, 1:]
    at_events = Trajectory(
        events.rows[:, 1:],
        samples.wxyz[:, 1:],
        samples.omega_body[:, 1:],
        samples.status,
        samples.steps,
        Scene(**parts),
        spins=spins,
        propagator=propagator,
    )
    times = events.rows[:, 1:]
    use = jnp.isfinite(events.times)
    tolerance = 64 * jnp.finfo(times.dtype).eps * jnp.abs(times)
    delay, at_events = event.differentiable_at(at_events, tolerance, events.side)
    _, slope = event.values(at_events)
    has_failed = samples.status != Status.SUCCESSFUL
    has_failed = has_failed & (trajectory.status.reshape(-1) == Status.SUCCESSFUL)
    count = jnp.where(has_failed, capacity + 1, events.count).astype(jnp.int32)
    times = jnp.where(use, times + delay, jnp.inf).reshape(*batch, capacity)
    slope = jnp.where(use, slope, 0).reshape(*batch, capacity)
    return Crossings(times, slope, count.reshape(batch)), has_failed.reshape(batch)


def _sample_count(trajectory: Trajectory) -> int:
    """Number of samples needed to find every crossing; the motion must not be traced."""
    if not is_concrete(trajectory):
        raise ValueError(
            "under jit, vmap or grad the number of samples must be known:"
            " ph.Event(fn, samples=1000), 32 or more per revolution of the fastest rate."
        )
    angle = np.max(np.asarray(_max_angle(trajectory)), initial=0)
    size = max(
        17,
        1 + int(np.ceil(SAMPLES_PER_REVOLUTION * angle / (2 * np.pi)))
        if np.isfinite(angle)
        else 17,
    )
    multiple = 2 ** max(0, int(np.log2(size)) - 2)  # few sizes, for few compiled programs
    size = 1 + -(-(size - 1) // multiple) * multiple
    if size * max(1, int(np.prod(trajectory.batch_shape))) > _MAX_SAMPLES:
        raise ValueError(
            f"{size:,} samples of each body are needed for the {angle:.3g} rad that it turns:"
            " search a shorter time or fewer bodies at once, or give samples= for a slow function."
        )
    return size


@eqx.filter_jit
def _max_angle(trajectory: Trajectory) -> Array:
    """Upper bound (...) of the angle of rotation from the first to the last time [rad]."""
    ts = trajectory._t
    span = jnp.max(ts, axis=-1) - jnp.min(ts, axis=-1)
    rate = jnp.max(max_angular_rates(trajectory), axis=-1)
    return jnp.maximum(rate, _natural_rates(trajectory)) * span


def max_angular_rates(trajectory: Trajectory) -> Array:
    """Upper bound (..., T) of the rate of a body, by its momentum at each sample [rad/s]."""
    carrier = trajectory._scene.carrier_at(trajectory._t)
    size = jnp.linalg.norm(carrier.momentum(trajectory.omega_body), axis=-1)
    return size / jnp.min(carrier.moments, axis=-1)


def _natural_rates(trajectory: Trajectory) -> Array:
    """Natural rates (...) [rad/s] at the first sample, including that of gravity."""
    batch = trajectory.batch_shape
    parts = {name: flatten(getattr(trajectory.scene, name), batch) for name in PARTS}
    lanes = flatten(trajectory.first, batch, shared=False)
    ends = lane_times(trajectory.ts[..., jnp.array([0, -1])], batch)
    return _integrate.natural_rates(Scene(**parts), lanes, ends).reshape(batch)


class EventCrossings(NamedTuple):
    """Crossings of E events, their states, and the bodies (...) that could not be sampled."""

    crossings: list[Crossings]
    states: list[list[Array]]
    has_failed: Array


def all_crossings(trajectory: Trajectory, events: Sequence[Event], capacity: int) -> EventCrossings:
    """The first ``capacity`` crossings of each event in one search of a concrete trajectory."""
    _propagator(trajectory)
    sizes = [event.samples for event in events]
    default = _sample_count(trajectory) if None in sizes else 2
    size = max(default if x is None else x for x in sizes)
    event_crossings = _by_sampling(trajectory, events, capacity, size)
    _raise_if_failed(event_crossings.has_failed, f"while {size:,} samples were computed")
    return event_crossings


@eqx.filter_jit
def _by_sampling(
    trajectory: Trajectory, events: Sequence[Event], capacity: int, size: int
) -> EventCrossings:
    """The first ``capacity`` crossings of each event."""
    stop_gradient = jax.lax.stop_gradient
    arrays, static = eqx.partition(trajectory, eqx.is_inexact_array)
    constant_trajectory: Trajectory = eqx.combine(stop_gradient(arrays), static)
    batch, rank = trajectory.batch_shape, len(trajectory.batch_shape)
    ts = constant_trajectory.ts
    share = jnp.linspace(0, 1, size, dtype=ts.dtype).at[0].set(AT_START / (size - 1))
    share = share.reshape((1,) * (ts.ndim - 1) + share.shape)
    times = ts[..., :1] + share * (ts[..., -1:] - ts[..., :1])
    grid = stop_gradient(jnp.broadcast_to(times, (*batch, size)).reshape(-1, size))
    time_sign = jnp.where(grid[:, -1:] < grid[:, :1], -1, 1).astype(grid.dtype)
    time_sign = jnp.tile(time_sign, (len(events), 1))
    direction = jnp.asarray([event.direction for event in events], grid.dtype)
    direction = jnp.repeat(direction, grid.shape[0])[:, None]

    def evaluation_of(evaluated: Trajectory) -> Evaluation:
        pairs = [event.values(evaluated) for event in events]
        values, derivatives = (
            jnp.stack(x).reshape(len(events), -1, x[0].shape[-1]) for x in zip(*pairs)
        )
        states = [x.reshape(-1, *x.shape[rank:]) for x in evaluated._samples]
        is_successful = jnp.ravel(evaluated.status == Status.SUCCESSFUL)
        return stop_gradient(Evaluation(values, derivatives, states, is_successful))

    origin, samples = constant_trajectory, None
    if not _propagator(trajectory).method.exact:  # integrated from the nearest sample
        origin = moved_through(constant_trajectory, times)
        samples = evaluation_of(origin)._replace(states=[])

    def evaluate(t):
        return evaluation_of(moved_to(origin, t.reshape(*batch, -1)))

    def analyse(samples):
        """The first intervals between samples in which the function changes its sign, the first in
        which it may do so twice, and the numbers of both."""
        values, derivatives = (x.reshape(-1, size) for x in (samples.values, samples.derivatives))
        sides = jnp.where(values >= 0, 1, -1)
        changes = sides[:, 1:] != sides[:, :-1]
        changes = changes & ((direction == 0) | (sides[:, 1:] * time_sign == direction))
        minima = minima_of(rows, values, derivatives, sides)
        counts = (jnp.sum(x, axis=-1) for x in (changes, minima))
        return first_true(changes, stored), first_true(minima, stored), *counts

    rows = jnp.tile(grid, (len(events), 1))
    stored = max(capacity, _MIN_CAPACITY)

    def turning_brackets(samples, analysis):
        derivatives, (_, (place, is_minimum), *_) = samples.derivatives.reshape(-1, size), analysis
        low, high, at_low, at_high = (
            entries(x, place + k) for x in (rows, derivatives) for k in (0, 1)
        )
        return Brackets(low, high, at_low, at_high, is_minimum)

    def brackets(samples, analysis, turning, turning_values):
        """Brackets between samples, and on both sides of turning points beyond zero, in order of
        time; and the number of crossings, or an upper bound of it."""
        values = samples.values.reshape(-1, size)
        (single, is_single), (place, is_minimum), changes, dipping = analysis
        sides = jnp.where(values >= 0, 1, -1)
        side = entries(sides, place)
        pairs = is_minimum & (jnp.where(turning_values >= 0, 1, -1) != side)
        columns = (
            (entries(rows, single), entries(rows, place), turning),
            (entries(rows, single + 1), turning, entries(rows, place + 1)),
            (entries(values, single), entries(values, place), turning_values),
            (entries(values, single + 1), turning_values, entries(values, place + 1)),
            (is_single, pairs, pairs),
            (entries(sides, single + 1) > 0, side < 0, side > 0),  # rising along the motion
        )
        *columns, use, rising = (jnp.concatenate(x, axis=-1) for x in columns)
        use = use & ((direction == 0) | (jnp.where(rising, 1, -1) * time_sign == direction))
        order = jnp.argsort(jnp.where(use, time_sign * columns[0], jnp.inf), axis=-1)[:, :stored]
        per_pair = jnp.where(direction[:, 0] == 0, 2, 1)
        count = changes + per_pair * jnp.sum(pairs, axis=-1)
        # minima beyond those stored were not examined: each may be a pair of crossings
        count = jnp.where(dipping > stored, jnp.maximum(count, per_pair * dipping), count)
        return Brackets(*(entries(x, order) for x in (*columns, use))), count

    width = max(len(events) * stored, -(-size // _SAMPLING_EVALUATIONS))
    result = search_roots(
        evaluate,
        grid,
        stored,
        width,
        analyse,
        turning_brackets,
        brackets,
        samples,
        store_states=False,
    )
    has_failed = ~result.samples.is_successful.reshape(batch)
    has_failed = has_failed & (trajectory.status == Status.SUCCESSFUL)

    def of_event(x, k):
        return x.reshape(len(events), *batch, *x.shape[1:])[k]

    crossings, states = [], []
    for k, event in enumerate(events):
        times, use = (of_event(x, k)[..., :capacity] for x in (result.roots, result.use))
        slope = of_event(result.derivatives, k)[..., :capacity]
        at_events = [of_event(x, k)[..., :capacity, :] for x in result.states]
        slope, times, at_events = _differentiable(trajectory, event, times, use, slope, at_events)
        total = jnp.where(has_failed, capacity + 1, of_event(result.auxiliary, k)).astype(jnp.int32)
        times, slope = jnp.where(use, times, jnp.inf), jnp.where(use, slope, 0)
        crossings.append(Crossings(times, slope, total))
        states.append(at_events)
    return EventCrossings(crossings, states, has_failed)


def _differentiable(trajectory: Trajectory, event: Event, times, use, slope, states):
    """Derivatives of the function by time, times, and states at events, with their derivatives."""
    finite_times = jnp.where(use, times, jax.lax.stop_gradient(trajectory.ts[..., :1]))
    arrays, static = eqx.partition(trajectory, eqx.is_inexact_array)

    def refined(arrays, finite_times):
        # The correction is limited to rounding: at a tangency (double root) it would be noise.
        tolerance = 64 * jnp.finfo(finite_times.dtype).eps * jnp.abs(finite_times)
        delay, at_events = event.refined(
            moved_to(eqx.combine(arrays, static), finite_times), tolerance
        )
        return [event.values(at_events)[1], finite_times + delay, *at_events._samples]

    slope, times, *states = with_derivatives_of(
        refined, (arrays, finite_times), [slope, finite_times, *states]
    )
    return slope, times, states
