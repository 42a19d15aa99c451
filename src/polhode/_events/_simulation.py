"""Simulations with events: times and states of all events, and motions that stop at one.

Where the steps do not search for events themselves, a motion that stops is computed in windows, one
after the other, until each body has met its event: the work follows from where the events are and
not from the last time.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._batch import PARTS, flatten, lane_times
from polhode._events._crossings import (
    AT_START,
    SAMPLES_PER_TURN,
    bracketed,
    crossings,
    entries,
    first_true,
    minima_of,
    turning_rates,
)
from polhode._events._event import Event
from polhode._integrate import Search, natural_rates
from polhode._method import Record, Status
from polhode._scene import Scene, State
from polhode._trajectory import Events, Propagator, Trajectory, begun, moved_through, moved_to


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
    return _until_terminal(
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
    return _in_order_of_time(trajectory, [x.times for x in each], [x.count for x in each], events)


@eqx.filter_jit
def _in_order_of_time(trajectory: Trajectory, times, counts, events) -> Trajectory:
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

    return _until_terminal(
        trajectory,
        rows,
        lanes(trajectory._samples),
        jax.tree.map(jnp.ravel, (status, trajectory._steps)),
        events,
        (at, which, jnp.sum(met, axis=1)),
        lanes(there._samples),
    )


def _is_terminal(which: Array, events: Sequence[Event]) -> Array:
    table = jnp.asarray([event.terminal for event in events])
    return table[jnp.maximum(which, 0)] & (which >= 0)


def _until_terminal(begin: Trajectory, rows, path, outcome, events, met, states):
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
    status, steps = jax.tree.map(lambda x: x.reshape(batch), outcome)
    nothing = ~happens[..., None]
    attitudes, rates, *_ = (
        jnp.where(nothing, jnp.nan, x).reshape(*batch, *x.shape[1:]) for x in states
    )
    record = Events(
        times=at.reshape(*batch, -1),
        which=which.reshape(*batch, -1),
        wxyz=attitudes,
        omega_body=rates,
        count=count.reshape(batch),
    )
    one_row = event_time is None and begin.ts.ndim == 1
    times = rows[0] if one_row else rows.reshape(*batch, -1)
    return begin._with_samples(times, path, status, steps, event_time, record)


_SAMPLES = 64
"""Steps between samples in a window: two turns of the fastest body."""

_FIRST, _GROWTH = 2**-10, 4.0
"""Part of the whole that the first window is at limit, and how much longer the next may be: a body
that rests at first may be set in motion soon."""

_MAX_SPEED_UP = 1.5
"""How much faster than at its start a body may turn within a window."""

_MAX_WINDOWS = 2**20
"""Windows, of a thousandth of a second or less each: what has no event by then is given up."""

_MINIMA = 2
"""Places in a window, of each body, where the function may turn back before zero."""


def check_until(until: Any, record: Any) -> None:
    """An event, with samples of both attitude and rates."""
    if not isinstance(until, Event):
        raise TypeError(
            f"until must be a ph.Event, got {type(until).__name__}: ph.Event(fn, direction)."
        )
    if record is not None and record.of_states != Record():
        raise ValueError(
            "until= needs attitude and rates at all times and knows no work and error: leave"
            " record= out."
        )


@eqx.filter_jit
def stopped(begin: Trajectory, ts: Array, until: Event) -> Trajectory:
    """The motion from ``begin``, its state at the first of ``ts``, each body path from its first
    event on."""
    batch = begin.batch_shape
    lanes, ts = _of_lanes(begin), lane_times(ts, batch)
    path = _stopped_by_loop(lanes, ts, until)
    if path is None:
        path = _stopped_by_windows(lanes, ts, until)
    wxyz, omega, spins, status, steps, times, event = jax.tree.map(
        lambda x: x.reshape(*batch, *x.shape[1:]), path
    )
    samples = [wxyz, omega] if spins is None else [wxyz, omega, spins]
    return begin._with_samples(times, samples, status, steps, event)


def _stopped_by_loop(lanes: Trajectory, ts: Array, until: Event):
    """Where the steps themselves look for the event: samples, status, steps, times and event times,
    with the derivatives of the motion; None where they cannot."""
    propagator: Any = lanes.propagator
    method = propagator.method
    if method.exact:
        return None
    wxyz, omega, *spins = (x[:, 0] for x in lanes._samples)
    scene, search = begun(lanes.scene, spins), Search((until.fn,), (until.direction,), (True,), 1)
    solution = method.search(scene, State(wxyz, omega), ts, propagator.rtol, search, False)
    if solution is None:
        return None
    samples, events = solution
    spins = [] if samples.spins is None else [samples.spins]
    path = [samples.wxyz, samples.omega_body, *spins]
    met = jnp.isfinite(events.times[:, 0])
    near = Trajectory(
        events.rows[:, -1:],
        path[0][:, -1:],
        path[1][:, -1:],
        samples.status,
        samples.steps,
        lanes.scene,
        spins=spins[0][:, -1:] if spins else None,
        propagator=propagator,
    )
    tolerance = 64 * jnp.finfo(ts.dtype).eps * jnp.abs(near._t)
    delay, at_event = until.differentiable_at(near, tolerance)
    event = near._t + delay
    rows = jnp.broadcast_to(ts, (met.size, ts.shape[-1]))
    sign = jnp.where(rows[:, -1:] < rows[:, :1], -1, 1).astype(ts.dtype)
    past = met[:, None] & (sign * (rows - jax.lax.stop_gradient(event)) >= 0)
    wxyz, omega, *spins = (
        jnp.where(past[..., None], x, y[:, :-1]) for x, y in zip(at_event._samples, path)
    )
    times = jnp.where(past, event, rows)
    event = jnp.where(met, event[:, 0], jnp.inf)
    return (
        wxyz,
        omega,
        spins[0] if spins else None,
        samples.status,
        samples.steps,
        times,
        event,
    )


def _stopped_by_windows(lanes: Trajectory, ts: Array, until: Event):
    """The same by samples at windows of the motion."""
    arrays, rest = eqx.partition((lanes, until), eqx.is_inexact_array)
    still = jax.lax.stop_gradient
    fixed, event = eqx.combine(still(arrays), rest)
    met, lost, near, step = still(_first_event(fixed, event, still(ts)))
    path = _stopped_at(lanes, ts, until, met, near, step)
    return (*path[:3], jnp.where(lost, Status.MAX_STEPS, path[3]), *path[4:])


def _of_lanes(begin: Trajectory) -> Trajectory:
    """The same with one batch axis."""
    batch = begin.batch_shape
    n = begin.status.size
    parts = {name: flatten(getattr(begin.scene, name), batch) for name in PARTS}
    samples = (
        None if x is None else x.reshape(n, *x.shape[len(batch) :])
        for x in (begin._wxyz, begin._omega_body, begin._spins)
    )
    wxyz, omega, spins = samples
    return Trajectory(
        lane_times(begin.ts, batch),
        wxyz,
        omega,
        begin.status.reshape(n),
        jax.tree.map(jnp.ravel, begin._steps),
        Scene(**parts),
        spins=spins,
        propagator=begin.propagator,
    )


class _Bracket(NamedTuple):
    """Where each of N bodies meets its event: between two times, the values there, and the look
    before it."""

    low: Array
    high: Array
    at_low: Array
    at_high: Array
    look: Array  # its time
    samples: list[Array]


class _Minimum(NamedTuple):
    """Where a function that keeps its sign at the samples crosses zero and turns back: after which
    look (N,), ``_SAMPLES`` for nowhere; when it turns, its value there and its sign before."""

    place: Array
    time: Array
    value: Array
    side: Array


class _Window(NamedTuple):
    """The search under way: the next window begins at ``share`` of the whole, with ``samples``."""

    tried: Array
    share: Array
    width: Array
    samples: list[Array]
    met: Array
    alive: Array
    found: _Bracket


def _first_event(lanes: Trajectory, until: Event, ts: Array) -> tuple[Array, ...]:
    """Which bodies (N,) meet their event, and which were given up; when it is, and the time
    between two samples there [s]."""
    propagator: Any = lanes.propagator
    exact = propagator.method.exact
    first, last = ts[..., 0], ts[..., -1]
    span, dtype = last - first, ts.dtype
    n = lanes.status.size
    forward = jnp.broadcast_to(jnp.where(span < 0, -1, 1), (n,))
    least = 4 * _SAMPLES * float(jnp.finfo(dtype).eps)

    def times(share):
        """(K,) or (N, K) of parts (K,) of the whole."""
        share = share.reshape((1,) * span.ndim + share.shape)
        grid = first[..., None] + share * span[..., None]
        return jnp.where(share >= 1, last[..., None], grid)

    def at(time, samples, share_of_error=None):
        """The bodies at a time () or (N,), one sample each."""
        wxyz, omega, *spins = (x[:, None] for x in samples)
        now = propagator
        if share_of_error is not None and propagator.rtol is not None:
            eps = jnp.finfo(propagator.rtol.dtype).eps
            rtol = jnp.maximum(
                propagator.rtol * share_of_error.astype(propagator.rtol.dtype), 8 * eps
            )
            now = eqx.tree_at(lambda p: p.rtol, propagator, rtol)
        return Trajectory(
            time[..., None],
            wxyz,
            omega,
            lanes.status,
            lanes._steps,
            lanes.scene,
            spins=spins[0] if spins else None,
            propagator=now,
        )

    def width_by_rate(share, samples, busy):
        if until.samples is not None:
            return jnp.asarray(_SAMPLES / (until.samples - 1), dtype)
        ends = jnp.stack(jnp.broadcast_arrays(times(share[None])[..., 0], last), axis=-1)
        rates = natural_rates(lanes.scene, State(*samples[:2]), ends)
        angle = jnp.max(jnp.where(busy & jnp.isfinite(rates), rates * jnp.abs(span), 0), initial=0)
        angle = jnp.maximum(angle, jnp.finfo(dtype).tiny)
        return jnp.maximum(_SAMPLES * 2 * jnp.pi / SAMPLES_PER_TURN / angle, least).astype(dtype)

    def one(carry: _Window) -> _Window:
        busy = ~carry.met & carry.alive
        width = jnp.minimum(carry.width, 1 - carry.share)
        part = jnp.linspace(0, 1, _SAMPLES + 1, dtype=dtype)
        offset = jnp.where(carry.share == 0, AT_START / _SAMPLES, 0).astype(dtype)
        share = carry.share + width * part.at[0].set(offset)
        share = share.at[-1].set(jnp.where(width < carry.width, 1, share[-1]))
        begin = lanes if exact else at(times(carry.share[None])[..., 0], carry.samples, width)
        sampled = moved_through(begin, times(share))
        values, slopes = until.values(sampled)
        grid = jnp.broadcast_to(sampled.ts, values.shape)
        sides = jnp.where(values >= 0, 1, -1)
        changes = sides[:, 1:] != sides[:, :-1]
        if until.direction:
            changes = changes & (sides[:, 1:] * forward[:, None] == until.direction)
        samples = jnp.arange(_SAMPLES)
        change = jnp.min(jnp.where(changes, samples, _SAMPLES), axis=-1)
        minima = (
            minima_of(grid, values, slopes, sides)
            & (samples[None] < change[:, None])
            & busy[:, None]
        )
        place, is_minimum = first_true(minima, _MINIMA + 1)

        # as far as the bodies turn about as fast as thought, and no minimum is left out
        reach = jnp.min(
            jnp.where(is_minimum[:, _MINIMA], place[:, _MINIMA], _SAMPLES), initial=_SAMPLES
        )
        if until.samples is None:
            turned_angle = turning_rates(sampled) * jnp.abs(span).reshape(-1, 1)
            turned_angle = jnp.where(busy[:, None] & jnp.isfinite(turned_angle), turned_angle, 0)
            angle = jnp.max(turned_angle, axis=0, initial=0) * width / _SAMPLES
            slow = (angle <= _MAX_SPEED_UP * 2 * jnp.pi / SAMPLES_PER_TURN) | (width <= least)
            fast = jnp.min(jnp.where(slow, _SAMPLES, jnp.arange(_SAMPLES + 1)))
            reach = jnp.minimum(reach, jnp.maximum(fast, 1))
        place, is_minimum = (
            place[:, :_MINIMA],
            is_minimum[:, :_MINIMA] & (place[:, :_MINIMA] < reach),
        )
        minimum = _first_minimum(
            until, begin if exact else sampled, grid, slopes, sides, place, is_minimum
        )
        new = busy & (jnp.minimum(minimum.place, change) < reach)
        fresh = _bracket(sampled, grid, values, change, minimum, until.direction * forward, new)
        found = jax.tree.map(
            lambda x, y: jnp.where(new.reshape(-1, *(1,) * (x.ndim - 1)), x, y), fresh, carry.found
        )
        alive = carry.alive & (sampled.status == Status.SUCCESSFUL)
        samples, met = [x[:, reach] for x in sampled._samples], carry.met | new
        wider = jnp.where(reach < _SAMPLES, width, _GROWTH * width)
        wider = jnp.minimum(wider, width_by_rate(share[reach], samples, alive & ~met))
        return _Window(carry.tried + 1, share[reach], wider, samples, met, alive, found)

    def on(carry: _Window):
        unfinished = (carry.share < 1) & (carry.tried < _MAX_WINDOWS)
        return unfinished & jnp.any(~carry.met & carry.alive)

    samples, zero = [x[:, 0] for x in lanes._samples], jnp.zeros(n, dtype)
    alive = lanes.status == Status.SUCCESSFUL
    begin = jnp.broadcast_to(first, (n,))
    nowhere = _Bracket(begin, begin, zero, zero, begin, samples)
    start = jnp.zeros((), dtype)
    width = width_by_rate(start, samples, alive)
    width = width if until.samples is not None else jnp.minimum(width, _FIRST)
    carry = _Window(
        jnp.zeros((), jnp.int32), start, width, samples, jnp.zeros(n, bool), alive, nowhere
    )
    carry = jax.lax.while_loop(on, one, carry)
    low, high, at_low, at_high, look, samples = carry.found

    def fn(t):
        value, _ = until.values(moved_to(lanes if exact else at(look, samples), t))
        return value, value

    arguments = (x[:, None] for x in (low, high, at_low, at_high, carry.met))
    near, _ = bracketed(fn, *arguments)
    lost = ~carry.met & carry.alive & (carry.share < 1)
    return carry.met, lost, near[:, 0], jnp.abs(carry.width * span) / _SAMPLES


def _first_minimum(
    until: Event, motion: Trajectory, grid, slopes, sides, place, is_minimum
) -> _Minimum:
    """Of the places (N, D) where the function may turn back, the first where it crosses zero."""
    low, high = entries(grid, place), entries(grid, place + 1)

    def turning(_):
        def fn(t):
            value, slope = until.values(moved_to(motion, t))
            return slope, value

        return bracketed(
            fn, low, high, entries(slopes, place), entries(slopes, place + 1), is_minimum
        )

    none = low, jnp.zeros_like(low)
    time, value = jax.lax.cond(jnp.any(is_minimum), turning, lambda _: none, 0)
    side = entries(sides, place)
    across = is_minimum & (jnp.where(value >= 0, 1, -1) != side)
    pair, some = first_true(across, 1)
    interval = jnp.where(some, entries(place, pair), _SAMPLES)
    return _Minimum(
        *(x[:, 0] for x in (interval, *(entries(x, pair) for x in (time, value, side))))
    )


def _bracket(sampled: Trajectory, grid, values, change, minimum: _Minimum, wanted, new) -> _Bracket:
    """Around the first event, a change of sign between two samples or a minimum; ``wanted`` (N,) is
    the direction in the order of the samples, 0 for any. Where no event is ``new``, any numbers."""
    here = jnp.where(new, jnp.minimum(minimum.place, change), 0)[:, None]
    # of the pair of crossings at a minimum the second, where the first has the other direction
    second = (wanted != 0) & (jnp.where(minimum.side < 0, 1, -1) != wanted)
    is_minimum = minimum.place < change
    early, delay = is_minimum & ~second, is_minimum & second
    a, b, fa, fb = (entries(x, here + k)[:, 0] for x in (grid, values) for k in (0, 1))
    return _Bracket(
        jnp.where(delay, minimum.time, a),
        jnp.where(early, minimum.time, b),
        jnp.where(delay, minimum.value, fa),
        jnp.where(early, minimum.value, fb),
        a,
        [jnp.take_along_axis(x, here[..., None], axis=1)[:, 0] for x in sampled._samples],
    )


def _stopped_at(lanes: Trajectory, ts: Array, until: Event, met: Array, near: Array, step: Array):
    """Samples, status, steps, times and event times, with the derivatives of the motion."""
    back = ts[..., -1] < ts[..., 0]
    sign = jnp.where(back, -1, 1).astype(ts.dtype)
    end = jnp.where(met, near, ts[..., -1])
    if ts.ndim == 1:  # as far as the last event of all bodies
        end = sign * jnp.max(sign * end)
    far = (sign * end)[..., None] < sign[..., None] * ts
    states = moved_through(lanes, jnp.where(far, end[..., None], ts))
    if ts.ndim > 1 or met.size == 1:  # the last sample of each body is at its own event
        there = states[..., -1:]
    else:
        there = moved_to(states, jnp.where(met, near, ts[..., 0])[:, None])
    # the motion in windows differed from this one by no more than the tolerance allows
    limit = 64 * jnp.finfo(ts.dtype).eps * jnp.abs(there._t)
    propagator: Any = lanes.propagator
    if not propagator.method.exact:
        limit = jnp.maximum(limit, 1e-4 * step.reshape(-1, 1))
    delay, at_event = until.refined(there, limit)
    event = there._t + delay
    rows = jnp.broadcast_to(ts, (event.shape[0], ts.shape[-1]))
    past = met[:, None] & (sign.reshape(-1, 1) * (rows - event) >= 0)
    path = [
        jnp.where(past[..., None], x, y)
        for x, y in zip(at_event._samples, states._samples, strict=True)
    ]
    wxyz, omega, *spins = path
    status = jnp.where(met, there.status, states.status)
    times = jnp.where(past, event, rows)
    event = jnp.where(met, event[:, 0], jnp.inf)
    return wxyz, omega, spins[0] if spins else None, status, states._steps, times, event
