"""Simulations with events: times and states of all events, and motions that stop at one.

If the method does not search for events itself, a motion that stops is computed in windows, one
after another, until each body has reached its event: the work depends on the times of the events
and not on the last time.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import _integrate, _policy  # names of _integrate load diffrax at first use
from polhode._batch import PARTS, flatten, lane_times
from polhode._events._crossings import (
    AT_START,
    SAMPLES_PER_REVOLUTION,
    EventCrossings,
    all_crossings,
    max_angular_rates,
)
from polhode._events._event import Event
from polhode._events._search import (
    Brackets,
    Evaluation,
    entries,
    first_true,
    minima_of,
    search_roots,
)
from polhode._failed import where_lost
from polhode._method import Record, Status
from polhode._scene import Scene, State
from polhode._trajectory import (
    Ending,
    Events,
    Propagator,
    Trajectory,
    moved_through,
    moved_to,
    with_initial_spins,
)


def checked_events(events: Any, until: Any, record: Record | None) -> tuple[Event, ...]:
    """``events`` as a tuple; raises TypeError or ValueError if they cannot be searched for."""
    is_several = isinstance(events, (list, tuple))
    all_events = tuple(events) if is_several else (events,)
    for event in all_events:
        if not isinstance(event, Event):
            raise TypeError(
                f"events must be ph.Event objects, got {type(event).__name__}:"
                " events=[ph.Event(fn, direction)]."
            )
    if not all_events:
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
    return all_events


def events_by_steps(begin: Trajectory, ts: Array, events: Sequence[Event]) -> Trajectory | None:
    """The motion from ``begin``, its state at the first of ``ts``, and the events located during
    the integration; None if the method does not search for events."""
    batch, propagator = begin.batch_shape, cast(Propagator, begin.propagator)
    method: Any = propagator.method
    if method.exact:
        return None
    parts = {name: flatten(getattr(begin.scene, name), batch) for name in PARTS}
    wxyz, omega, *spins = (x.reshape(-1, *x.shape[len(batch) :])[:, 0] for x in begin._samples)
    times, scene = lane_times(ts, batch), Scene(**parts)
    capacity = sum(event.capacity for event in events)
    search = _integrate.Search(
        tuple(event.fn for event in events),
        tuple(event.direction for event in events),
        tuple(event.terminal for event in events),
        capacity,
    )
    solution = method.search(
        with_initial_spins(scene, spins), State(wxyz, omega), times, propagator.rtol, search, False
    )
    if solution is None:
        return None
    samples, record = solution
    count = ts.shape[-1]
    at_events = [
        x[:, count:] for x in (samples.wxyz, samples.omega_body, samples.spins) if x is not None
    ]
    is_known = jnp.isfinite(sum(x.sum(-1) for x in at_events))
    wxyz, omega, *spins = (where_lost(x, is_known, 0.5) for x in at_events)
    at_events = Trajectory(
        record.rows[:, count:],
        wxyz,
        omega,
        samples.status,
        samples.steps,
        scene,
        spins=spins[0] if spins else None,
        propagator=propagator,
    )
    tolerance = 64 * jnp.finfo(ts.dtype).eps * jnp.abs(at_events._t)
    delay, states = jnp.zeros_like(at_events._t), at_events._samples
    for k, event in enumerate(events):
        event_delay, at_event = event.differentiable_at(at_events, tolerance, record.side)
        is_this = record.which == k
        delay = jnp.where(is_this, event_delay, delay)
        states = [
            jnp.where(is_this[..., None], x, y)
            for x, y in zip(at_event._samples, states, strict=True)
        ]
    status = jnp.where(
        (samples.status == Status.SUCCESSFUL) & (record.count > capacity),
        Status.TOO_MANY_EVENTS,
        samples.status,
    )
    bad_input = begin.status.reshape(-1)  # invalid times or moments, found before the motion
    status = jnp.where(bad_input == Status.SUCCESSFUL, status, bad_input)
    path = [x[:, :count] for x in (samples.wxyz, samples.omega_body)]
    path += [] if samples.spins is None else [samples.spins[:, :count]]
    return _until_terminal(
        begin,
        jnp.broadcast_to(times, path[0].shape[:2]),
        path,
        (status, samples.steps),
        events,
        (
            jnp.where(jnp.isfinite(record.times), at_events._t + delay, jnp.inf),
            record.which,
            record.count,
        ),
        states,
    )


def events_by_search(trajectory: Trajectory, events: Sequence[Event]) -> Trajectory:
    """The same for methods that do not search for events themselves: by samples of a trajectory."""
    capacity = sum(event.capacity for event in events)  # each may need all of it
    return _in_order_of_time(trajectory, all_crossings(trajectory, events, capacity), events)


@eqx.filter_jit
def _in_order_of_time(
    trajectory: Trajectory, result: EventCrossings, events: Sequence[Event]
) -> Trajectory:
    times, counts = ([getattr(x, name) for x in result.crossings] for name in ("times", "count"))
    batch, ts = trajectory.batch_shape, trajectory.ts
    rows = jnp.broadcast_to(ts, (*batch, ts.shape[-1])).reshape(-1, ts.shape[-1])
    sign = jnp.where(rows[:, -1:] < rows[:, :1], -1, 1).astype(ts.dtype)
    which = [jnp.full(x.shape, k, jnp.int32) for k, x in enumerate(times)]
    event_times, which = (
        jnp.concatenate([y.reshape(rows.shape[0], -1) for y in x], axis=1) for x in (times, which)
    )
    # the total for each: all events may be of one kind
    capacity = event_times.shape[1] // len(events)
    states = [
        jnp.concatenate([y.reshape(rows.shape[0], -1, y.shape[-1]) for y in x], axis=1)
        for x in zip(*result.states)
    ]
    order = jnp.argsort(jnp.where(jnp.isfinite(event_times), sign * event_times, jnp.inf), axis=1)
    event_times, which = (jnp.take_along_axis(x, order, axis=1) for x in (event_times, which))
    states = [jnp.take_along_axis(x, order[..., None], axis=1) for x in states]
    # events after a terminal event are dropped
    is_terminal = jnp.isfinite(event_times) & _is_terminal(which, events)
    stop = jnp.min(jnp.where(is_terminal, sign * event_times, jnp.inf), axis=1, keepdims=True)
    event_times = jnp.where(sign * event_times > stop, jnp.inf, event_times)
    occurs = jnp.isfinite(event_times)
    count = jnp.sum(occurs, axis=1, dtype=jnp.int32)
    for k, (crossing_times, total) in enumerate(zip(times, counts, strict=True)):
        # events that were not stored come after the stored ones
        listed = jnp.sum(
            jnp.isfinite(crossing_times.reshape(-1, capacity)), axis=1, dtype=count.dtype
        )
        all_happen = jnp.sum(occurs & (which == k), axis=1, dtype=count.dtype) == listed
        unstored = jnp.ravel(total).astype(count.dtype) - listed
        count = count + jnp.where(all_happen, jnp.maximum(unstored, 0), 0)
    overflows = (count > capacity).reshape(batch)
    # a terminal event is always stored: it is the end of the motion
    end = jnp.where(jnp.any(is_terminal, axis=1), jnp.argmax(is_terminal, axis=1), 0)
    stored = jnp.broadcast_to(jnp.arange(capacity), (event_times.shape[0], capacity))
    stored = stored.at[:, -1].max(end)
    event_times, which = (jnp.take_along_axis(x, stored, axis=1) for x in (event_times, which))
    states = [jnp.take_along_axis(x, stored[..., None], axis=1) for x in states]
    status = jnp.where(
        (trajectory.status == Status.SUCCESSFUL) & overflows,
        Status.TOO_MANY_EVENTS,
        trajectory.status,
    )
    return _until_terminal(
        trajectory,
        rows,
        [x.reshape(-1, *x.shape[len(batch) :]) for x in trajectory._samples],
        jax.tree.map(jnp.ravel, (status, trajectory._steps)),
        events,
        (event_times, which, count),
        states,
    )


def _is_terminal(which: Array, events: Sequence[Event]) -> Array:
    table = jnp.asarray([event.terminal for event in events])
    return table[jnp.maximum(which, 0)] & (which >= 0)


def _until_terminal(begin: Trajectory, rows, path, outcome, events, occurrences, states):
    """The trajectory with its events; samples after a terminal event are those of the event."""
    batch = begin.batch_shape
    event_times, which, count = occurrences
    occurs = jnp.isfinite(event_times)
    which = jnp.where(occurs, which, -1)
    ending = None
    if any(event.terminal for event in events):
        is_terminal = occurs & _is_terminal(which, events)
        terminal_index = jnp.argmax(is_terminal, axis=1)[:, None]
        stops = jnp.any(is_terminal, axis=1, keepdims=True)
        stop_time = jnp.take_along_axis(event_times, terminal_index, axis=1)
        sign = jnp.where(rows[:, -1:] < rows[:, :1], -1, 1).astype(rows.dtype)
        is_past = stops & (sign * rows >= sign * jnp.where(stops, stop_time, 0))
        rows = jnp.where(is_past, stop_time, rows)
        path = [
            jnp.where(
                is_past[..., None], jnp.take_along_axis(y, terminal_index[..., None], axis=1), x
            )
            for x, y in zip(path, states, strict=True)
        ]
        event_time = jnp.where(stops, stop_time, jnp.inf)
        sign = jnp.broadcast_to(sign, event_time.shape)
        ending = Ending(event_time.reshape(batch), sign.reshape(batch))
    path = [x.reshape(*batch, *x.shape[1:]) for x in path]
    status, steps = jax.tree.map(lambda x: x.reshape(batch), outcome)
    is_missing = ~occurs[..., None]
    attitudes, rates, *_ = (
        jnp.where(is_missing, jnp.nan, x).reshape(*batch, *x.shape[1:]) for x in states
    )
    record = Events(
        times=event_times.reshape(*batch, -1),
        which=which.reshape(*batch, -1),
        wxyz=attitudes,
        omega_body=rates,
        count=count.reshape(batch),
    )
    one_row = ending is None and begin.ts.ndim == 1
    times = rows[0] if one_row else rows.reshape(*batch, -1)
    return begin._with_samples(times, path, status, steps, ending, record)


_SAMPLES = 64
"""Intervals between samples in a window: two revolutions of the fastest body."""

_FIRST, _GROWTH = 2**-10, 4.0
"""Maximum length of the first window, as a part of the time span, and maximum ratio of the lengths
of successive windows: a body that is at rest at first may be set in motion soon."""

_MAX_SPEED_UP = 1.5
"""Maximum ratio of the angular rate of a body within a window to that at its start."""

_MAX_WINDOWS = 2**20
"""Maximum number of windows; a body without an event by then has failed."""

_MINIMA = 2
"""Number of intervals in a window, for each body, in which a turning point of the function close to
zero is examined."""


def check_until(until: Any, record: Any) -> None:
    """Check that ``until`` is an event, and that attitude and rates are recorded at all times."""
    if not isinstance(until, Event):
        raise TypeError(
            f"until must be a ph.Event, got {type(until).__name__}: ph.Event(fn, direction)."
        )
    if record is not None and record.of_states != Record():
        raise ValueError(
            "until= needs attitude and rates at all times and computes neither work nor error:"
            " leave record= out."
        )


def stop_at_event(begin: Trajectory, ts: Array, until: Event) -> Trajectory:
    """The motion from ``begin``, its state at the first of ``ts``; from its first event on, each
    body is in the state of the event."""
    terminal = Event(until.fn, until.direction, until.samples, terminal=True, capacity=1)
    trajectory = events_by_steps(begin, ts, (terminal,))
    if trajectory is not None:
        return eqx.tree_at(lambda x: x._events, trajectory, None)
    batch = begin.batch_shape
    path = _stopped_by_windows(_of_lanes(begin), lane_times(ts, batch), until)
    wxyz, omega, spins, status, steps, times, ending = jax.tree.map(
        lambda x: x.reshape(*batch, *x.shape[1:]), path
    )
    samples = [wxyz, omega] if spins is None else [wxyz, omega, spins]
    return begin._with_samples(times, samples, status, steps, ending)


def _stopped_by_windows(lanes: Trajectory, ts: Array, until: Event):
    """By samples in windows of the motion: samples, status, steps, times and event times, with the
    derivatives of the motion."""
    arrays, static = eqx.partition((lanes, until), eqx.is_inexact_array)
    stop_gradient = jax.lax.stop_gradient
    constant_lanes, event = eqx.combine(stop_gradient(arrays), static)
    has_event, is_incomplete, event_time, step = stop_gradient(
        _first_event(constant_lanes, event, stop_gradient(ts))
    )
    path = _stopped_at(lanes, ts, until, has_event, event_time, step)
    return (*path[:3], jnp.where(is_incomplete, Status.MAX_STEPS, path[3]), *path[4:])


def _of_lanes(begin: Trajectory) -> Trajectory:
    """The trajectory with one batch axis."""
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


class _Minimum(NamedTuple):
    """The first turning point beyond zero between two samples of equal sign: the index of the
    interval (N,), ``_SAMPLES`` if there is none; its time, the value there and the sign before."""

    place: Array
    time: Array
    value: Array
    side: Array


class _Window(NamedTuple):
    """Carry of the search. ``share``: part of the time span at which the next window begins;
    ``width``: length of that window; ``samples``: the states there."""

    count: Array
    share: Array
    width: Array
    samples: list[Array]
    has_event: Array
    is_successful: Array
    event_time: Array


def _first_event(lanes: Trajectory, until: Event, ts: Array) -> tuple[Array, ...]:
    """Which bodies (N,) have an event, which have failed because the windows ran out, the times of
    the events, and the interval between two samples there [s]."""
    propagator: Any = lanes.propagator
    exact = propagator.method.exact
    start_time, end_time = ts[..., 0], ts[..., -1]
    span, dtype = end_time - start_time, ts.dtype
    n = lanes.status.size
    forward = jnp.broadcast_to(jnp.where(span < 0, -1, 1), (n,))
    min_width = 4 * _SAMPLES * float(jnp.finfo(dtype).eps)

    def times(share):
        """Times (K,) or (N, K) at the parts ``share`` (K,) of the time span."""
        share = share.reshape((1,) * span.ndim + share.shape)
        grid = start_time[..., None] + share * span[..., None]
        return jnp.where(share >= 1, end_time[..., None], grid)

    def trajectory_at(time, samples, share_of_error=None):
        """A trajectory of one sample at a time () or (N,). ``share_of_error``: part of ``rtol``
        for the motion from there on."""
        wxyz, omega, *spins = (x[:, None] for x in samples)
        limited_propagator = propagator
        if share_of_error is not None and propagator.rtol is not None:
            eps = jnp.finfo(propagator.rtol.dtype).eps
            rtol = jnp.maximum(
                propagator.rtol * share_of_error.astype(propagator.rtol.dtype), 8 * eps
            )
            limited_propagator = eqx.tree_at(lambda p: p.rtol, propagator, rtol)
        return Trajectory(
            time[..., None],
            wxyz,
            omega,
            lanes.status,
            lanes._steps,
            lanes.scene,
            spins=spins[0] if spins else None,
            propagator=limited_propagator,
        )

    def width_by_rate(share, samples, active):
        if until.samples is not None:
            return jnp.asarray(_SAMPLES / (until.samples - 1), dtype)
        time_range = jnp.stack(jnp.broadcast_arrays(times(share[None])[..., 0], end_time), axis=-1)
        rates = _integrate.natural_rates(lanes.scene, State(*samples[:2]), time_range)
        angle = jnp.max(
            jnp.where(active & jnp.isfinite(rates), rates * jnp.abs(span), 0), initial=0
        )
        angle = jnp.maximum(angle, jnp.finfo(dtype).tiny)
        return jnp.maximum(
            _SAMPLES * 2 * jnp.pi / SAMPLES_PER_REVOLUTION / angle, min_width
        ).astype(dtype)

    def search_window(carry: _Window) -> _Window:
        active = ~carry.has_event & carry.is_successful
        width = jnp.minimum(carry.width, 1 - carry.share)
        fractions = jnp.linspace(0, 1, _SAMPLES + 1, dtype=dtype)
        offset = jnp.where(carry.share == 0, AT_START / _SAMPLES, 0).astype(dtype)
        share = carry.share + width * fractions.at[0].set(offset)
        share = share.at[-1].set(jnp.where(width < carry.width, 1, share[-1]))
        begin = (
            lanes
            if exact
            else trajectory_at(times(carry.share[None])[..., 0], carry.samples, width)
        )
        sampled = None if exact else moved_through(begin, times(share))
        grid = jnp.broadcast_to(times(share), (n, _SAMPLES + 1))
        intervals = jnp.arange(_SAMPLES)

        def evaluation_of(trajectory: Trajectory) -> Evaluation:
            values, derivatives = until.values(trajectory)
            is_successful = trajectory.status == Status.SUCCESSFUL
            return Evaluation(values[None], derivatives[None], trajectory._samples, is_successful)

        def analyse(evaluation: Evaluation):
            """The first change of sign (N,), the turning points, and the index up to which the
            samples are valid: to where a body rotates too fast for them, or to a turning point
            beyond the number that is examined.
            """
            values, derivatives = evaluation.values[0], evaluation.derivatives[0]
            sides = jnp.where(values >= 0, 1, -1)
            changes = sides[:, 1:] != sides[:, :-1]
            if until.direction:
                changes = changes & (sides[:, 1:] * forward[:, None] == until.direction)
            change = jnp.min(jnp.where(changes, intervals, _SAMPLES), axis=-1)
            minima = minima_of(grid, values, derivatives, sides) & (
                intervals[None] < change[:, None]
            )
            place, is_minimum = first_true(minima & active[:, None], _MINIMA + 1)
            valid_end = jnp.min(
                jnp.where(is_minimum[:, _MINIMA], place[:, _MINIMA], _SAMPLES), initial=_SAMPLES
            )
            if until.samples is None:
                motion = lanes._with_samples(
                    grid, evaluation.states, lanes.status, lanes._steps, None
                )
                angle = max_angular_rates(motion) * jnp.abs(span).reshape(-1, 1)
                angle = jnp.where(active[:, None] & jnp.isfinite(angle), angle, 0)
                angle = jnp.max(angle, axis=0, initial=0) * width / _SAMPLES
                is_slow = (angle <= _MAX_SPEED_UP * 2 * jnp.pi / SAMPLES_PER_REVOLUTION) | (
                    width <= min_width
                )
                first_fast = jnp.min(jnp.where(is_slow, _SAMPLES, jnp.arange(_SAMPLES + 1)))
                valid_end = jnp.minimum(valid_end, jnp.maximum(first_fast, 1))
            place, is_minimum = place[:, :_MINIMA], is_minimum[:, :_MINIMA]
            return sides, change, place, is_minimum & (place < valid_end), valid_end

        def turning_brackets(evaluation: Evaluation, analysis) -> Brackets:
            _, _, place, is_minimum, _ = analysis
            derivatives = evaluation.derivatives[0]
            low, high, at_low, at_high = (
                entries(x, place + k) for x in (grid, derivatives) for k in (0, 1)
            )
            return Brackets(low, high, at_low, at_high, is_minimum)

        def brackets(evaluation: Evaluation, analysis, turning, turning_values):
            """A bracket of the event in the first column; which bodies have one, and the index up
            to which the samples are valid."""
            sides, change, place, is_minimum, valid_end = analysis
            minimum = _first_minimum(turning, turning_values, sides, place, is_minimum)
            is_new = active & (jnp.minimum(minimum.place, change) < valid_end)
            direction = until.direction * forward
            ends = _bracket(grid, evaluation.values[0], change, minimum, direction, is_new)
            low, high, at_low, at_high = (jnp.repeat(x[:, None], _MINIMA, axis=1) for x in ends)
            use = is_new[:, None] & (jnp.arange(_MINIMA) == 0)[None]
            return Brackets(low, high, at_low, at_high, use), (is_new, valid_end)

        origin = begin if exact else sampled
        evaluation_width = min(max(_MINIMA, _policy.EVENT_SAMPLES // n), _SAMPLES + 1)
        result = search_roots(
            lambda t: evaluation_of(moved_to(origin, t)),
            grid,
            _MINIMA,
            evaluation_width,
            analyse,
            turning_brackets,
            brackets,
            None if exact else evaluation_of(sampled),
        )
        evaluation, (is_new, valid_end) = result.samples, result.auxiliary
        event_time = jnp.where(is_new, result.roots[:, 0], carry.event_time)
        is_successful = carry.is_successful & evaluation.is_successful
        samples, has_event = [x[:, valid_end] for x in evaluation.states], carry.has_event | is_new
        next_width = jnp.where(valid_end < _SAMPLES, width, _GROWTH * width)
        next_width = jnp.minimum(
            next_width, width_by_rate(share[valid_end], samples, is_successful & ~has_event)
        )
        return _Window(
            carry.count + 1,
            share[valid_end],
            next_width,
            samples,
            has_event,
            is_successful,
            event_time,
        )

    def continues(carry: _Window):
        unfinished = (carry.share < 1) & (carry.count < _MAX_WINDOWS)
        return unfinished & jnp.any(~carry.has_event & carry.is_successful)

    samples = [x[:, 0] for x in lanes._samples]
    is_successful = lanes.status == Status.SUCCESSFUL
    begin = jnp.broadcast_to(start_time, (n,))
    start = jnp.zeros((), dtype)
    width = width_by_rate(start, samples, is_successful)
    width = width if until.samples is not None else jnp.minimum(width, _FIRST)
    carry = _Window(
        jnp.zeros((), jnp.int32), start, width, samples, jnp.zeros(n, bool), is_successful, begin
    )
    carry = jax.lax.while_loop(continues, search_window, carry)
    is_incomplete = ~carry.has_event & carry.is_successful & (carry.share < 1)
    return carry.has_event, is_incomplete, carry.event_time, jnp.abs(carry.width * span) / _SAMPLES


def _first_minimum(time, value, sides, place, is_minimum) -> _Minimum:
    """The first of the turning points (N, D), in the intervals ``place``, at which the function has
    crossed zero."""
    side = entries(sides, place)
    across = is_minimum & (jnp.where(value >= 0, 1, -1) != side)
    pair, exists = first_true(across, 1)
    interval = jnp.where(exists, entries(place, pair), _SAMPLES)
    return _Minimum(
        *(x[:, 0] for x in (interval, *(entries(x, pair) for x in (time, value, side))))
    )


def _bracket(grid, values, change, minimum: _Minimum, direction, is_new) -> tuple[Array, ...]:
    """Two times (N,) around the first event, between two samples or between a sample and a turning
    point, and the values there; ``direction`` (N,): in the order of the samples, 0 for any. Entries
    that are not ``is_new`` are arbitrary."""
    interval = jnp.where(is_new, jnp.minimum(minimum.place, change), 0)[:, None]
    # the second of the two crossings around a turning point, if the first has the other direction
    is_second = (direction != 0) & (jnp.where(minimum.side < 0, 1, -1) != direction)
    is_minimum = minimum.place < change
    ends_at_minimum, starts_at_minimum = is_minimum & ~is_second, is_minimum & is_second
    a, b, fa, fb = (entries(x, interval + k)[:, 0] for x in (grid, values) for k in (0, 1))
    return (
        jnp.where(starts_at_minimum, minimum.time, a),
        jnp.where(ends_at_minimum, minimum.time, b),
        jnp.where(starts_at_minimum, minimum.value, fa),
        jnp.where(ends_at_minimum, minimum.value, fb),
    )


def _stopped_at(
    lanes: Trajectory, ts: Array, until: Event, has_event: Array, event_time: Array, step: Array
):
    """Samples, status, steps, times and event times, with the derivatives of the motion."""
    is_backward = ts[..., -1] < ts[..., 0]
    sign = jnp.where(is_backward, -1, 1).astype(ts.dtype)
    end = jnp.where(has_event, event_time, ts[..., -1])
    if ts.ndim == 1:  # as far as the last event of all bodies
        end = sign * jnp.max(sign * end)
    is_past_end = (sign * end)[..., None] < sign[..., None] * ts
    states = moved_through(lanes, jnp.where(is_past_end, end[..., None], ts))
    if ts.ndim > 1 or has_event.size == 1:  # the last sample of each body is at its own event
        near_event = states[..., -1:]
    else:
        near_event = moved_to(states, jnp.where(has_event, event_time, ts[..., 0])[:, None])
    # the motion in windows differs from this one within the tolerance
    limit = 64 * jnp.finfo(ts.dtype).eps * jnp.abs(near_event._t)
    propagator: Any = lanes.propagator
    if not propagator.method.exact:
        limit = jnp.maximum(limit, 1e-4 * step.reshape(-1, 1))
    delay, at_event = until.refined(near_event, limit)
    event = near_event._t + delay
    rows = jnp.broadcast_to(ts, (event.shape[0], ts.shape[-1]))
    is_past = has_event[:, None] & (sign.reshape(-1, 1) * (rows - event) >= 0)
    path = [
        jnp.where(is_past[..., None], x, y)
        for x, y in zip(at_event._samples, states._samples, strict=True)
    ]
    wxyz, omega, *spins = path
    status = jnp.where(has_event, near_event.status, states.status)
    times = jnp.where(is_past, event, rows)
    event = jnp.where(has_event, event[:, 0], jnp.inf)
    ending = Ending(event, jnp.broadcast_to(sign, event.shape))
    return wxyz, omega, spins[0] if spins else None, status, states._steps, times, ending
