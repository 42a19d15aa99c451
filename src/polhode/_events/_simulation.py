"""Events of a simulation: times, states there, and the end of the motion at a terminal one."""

from collections.abc import Sequence
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from polhode._batch import PARTS, flatten, lane_times
from polhode._events._crossings import crossings
from polhode._events._event import Event
from polhode._integrate import Search
from polhode._method import Record, Status
from polhode._scene import Scene, State
from polhode._trajectory import Events, Propagator, Trajectory, begun, moved_to


def checked_events(events: Any, until: Any, record: Record | None) -> tuple[Event, ...]:
    """``events`` as a tuple; raises TypeError or ValueError for what cannot be searched for."""
    some = (events,) if isinstance(events, Event) else tuple(events)
    for event in some:
        if not isinstance(event, Event):
            raise TypeError(
                f"events must be ph.Event objects, got {type(event).__name__}:"
                " events=[ph.Event(fn, direction)]."
            )
    if not some:
        raise ValueError("events is empty: leave it out, or give one or several ph.Event.")
    if until is not None:
        raise ValueError(
            "until= is the short form of one terminal event: with events= give it as"
            " ph.Event(fn, direction, terminal=True)."
        )
    if record is not None and record.of_states != Record():
        raise ValueError(
            "events= needs attitude and rates at all times and does not record work or error:"
            " leave record= out."
        )
    return some


@eqx.filter_jit
def found_by_steps(begin: Trajectory, ts: Array, events: Sequence[Event]) -> Trajectory | None:
    """The motion from ``begin``, its state at the first of ``ts``, and the events that the
    integration meets; None where the method does not search for events."""
    batch, propagator = begin.batch_shape, cast(Propagator, begin.propagator)
    method: Any = propagator.method
    if method.exact:
        return None
    parts = {name: flatten(getattr(begin.scene, name), batch) for name in PARTS}
    wxyz, omega, *spins = (x.reshape(-1, *x.shape[len(batch) :])[:, 0] for x in begin._samples)
    times, scene = lane_times(ts, batch), Scene(**parts)
    capacity = sum(event.capacity for event in events)
    search = Search(
        tuple(event.fn for event in events),
        tuple(event.direction for event in events),
        tuple(event.terminal for event in events),
        capacity,
    )
    solution = method.search(
        begun(scene, spins), State(wxyz, omega), times, propagator.rtol, search, False
    )
    if solution is None:
        return None
    samples, found = solution
    count = ts.shape[-1]
    there = Trajectory(
        found.rows[:, count:],
        samples.wxyz[:, count:],
        samples.omega_body[:, count:],
        samples.status,
        samples.steps,
        scene,
        spins=None if samples.spins is None else samples.spins[:, count:],
        propagator=propagator,
    )
    tolerance = 64 * jnp.finfo(ts.dtype).eps * jnp.abs(there._t)
    delay, states = jnp.zeros_like(there._t), there._samples
    for k, event in enumerate(events):
        more, shifted = event.differentiable_at(there, tolerance)
        is_this = found.which == k
        delay = jnp.where(is_this, more, delay)
        states = [
            jnp.where(is_this[..., None], x, y)
            for x, y in zip(shifted._samples, states, strict=True)
        ]
    status = jnp.where(
        (samples.status == Status.SUCCESSFUL) & (found.count > capacity),
        Status.TOO_MANY_EVENTS,
        samples.status,
    )
    path = [x[:, :count] for x in (samples.wxyz, samples.omega_body)]
    path += [] if samples.spins is None else [samples.spins[:, :count]]
    return _ended(
        begin,
        jnp.broadcast_to(times, path[0].shape[:2]),
        path,
        (status, samples.steps),
        events,
        (jnp.where(jnp.isfinite(found.times), there._t + delay, jnp.inf), found.which, found.count),
        states,
    )


def found_by_search(trajectory: Trajectory, events: Sequence[Event]) -> Trajectory:
    """The same for a motion that is known at every time: its trajectory is searched."""
    each = [crossings(trajectory, event, capacity=event.capacity) for event in events]
    return _merged(trajectory, [x.times for x in each], [x.count for x in each], events)


@eqx.filter_jit
def _merged(trajectory: Trajectory, times, counts, events) -> Trajectory:
    batch, ts = trajectory.batch_shape, trajectory.ts
    rows = jnp.broadcast_to(ts, (*batch, ts.shape[-1])).reshape(-1, ts.shape[-1])
    sign = jnp.where(rows[:, -1:] < rows[:, :1], -1, 1).astype(ts.dtype)
    which = [jnp.full(x.shape, k, jnp.int32) for k, x in enumerate(times)]
    at, which = (
        jnp.concatenate([y.reshape(rows.shape[0], -1) for y in x], axis=1) for x in (times, which)
    )
    lost = sum(
        jnp.where(count > event.capacity, 1, 0) for count, event in zip(counts, events, strict=True)
    )
    order = jnp.argsort(jnp.where(jnp.isfinite(at), sign * at, jnp.inf), axis=1)
    at, which = (jnp.take_along_axis(x, order, axis=1) for x in (at, which))
    # what lies beyond a terminal event does not happen
    ends = jnp.isfinite(at) & _is_terminal(which, events)
    at = jnp.where(jnp.cumsum(ends, axis=1) - jnp.where(ends, 1, 0) > 0, jnp.inf, at)
    met = jnp.isfinite(at)
    there = moved_to(trajectory, jnp.where(met, at, rows[:, :1]).reshape(*batch, -1))
    status = jnp.where(
        (trajectory.status == Status.SUCCESSFUL) & (lost > 0),
        Status.TOO_MANY_EVENTS,
        trajectory.status,
    )

    def lanes(samples):
        return [x.reshape(-1, *x.shape[len(batch) :]) for x in samples]

    return _ended(
        trajectory,
        rows,
        lanes(trajectory._samples),
        (status.reshape(-1), trajectory.steps.reshape(-1)),
        events,
        (at, which, jnp.sum(met, axis=1)),
        lanes(there._samples),
    )


def _is_terminal(which: Array, events: Sequence[Event]) -> Array:
    table = jnp.asarray([event.terminal for event in events])
    return table[jnp.maximum(which, 0)] & (which >= 0)


def _ended(begin: Trajectory, rows, path, outcome, events, met, states):
    """Samples beyond a terminal event are those of the event."""
    batch = begin.batch_shape
    at, which, count = met
    happens = jnp.isfinite(at)
    which = jnp.where(happens, which, -1)
    event_time = None
    if any(event.terminal for event in events):
        ends = happens & _is_terminal(which, events)
        last = jnp.argmax(ends, axis=1)[:, None]
        stops = jnp.any(ends, axis=1, keepdims=True)
        stop = jnp.take_along_axis(at, last, axis=1)
        sign = jnp.where(rows[:, -1:] < rows[:, :1], -1, 1).astype(rows.dtype)
        past = stops & (sign * rows >= sign * jnp.where(stops, stop, 0))
        rows = jnp.where(past, stop, rows)
        path = [
            jnp.where(past[..., None], jnp.take_along_axis(y, last[..., None], axis=1), x)
            for x, y in zip(path, states, strict=True)
        ]
        event_time = jnp.where(stops, stop, jnp.inf)[:, 0].reshape(batch)
    path = [x.reshape(*batch, *x.shape[1:]) for x in path]
    status, steps = (x.reshape(batch) for x in outcome)
    nothing = ~happens[..., None]
    attitudes, rates, *_ = (
        jnp.where(nothing, jnp.nan, x).reshape(*batch, *x.shape[1:]) for x in states
    )
    found = Events(
        times=at.reshape(*batch, -1),
        which=which.reshape(*batch, -1),
        wxyz=attitudes,
        omega_body=rates,
        count=count.reshape(batch),
    )
    one_row = event_time is None and begin.ts.ndim == 1
    times = rows[0] if one_row else rows.reshape(*batch, -1)
    return begin._with_samples(times, path, status, steps, event_time, found)
