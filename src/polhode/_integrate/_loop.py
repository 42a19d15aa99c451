"""Integration loop of explicit Runge-Kutta steps: samples, events and a record of the steps.

Bodies are the last axis of all arrays; each takes its own steps. ``_iteration.py`` contains the
body of the loop.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import _policy
from polhode._integrate._explicit_step import Motion, Progress
from polhode._integrate._iteration import AT_EVENT, RUNNING, LoopOptions, Storage, advance
from polhode._kernels import any_of, kernel
from polhode._method import StepCounts


class Solved(NamedTuple):
    """Results for B bodies: see ``Progress`` and ``Storage``. ``count`` and the fields after
    ``samples`` are None if no events are stored."""

    steps: StepCounts
    outcome: Array
    error: Array
    count: Array | None
    samples: Array | None
    times: Array | None
    which: Array | None
    states_at_events: Array | None

    @property
    def states(self) -> Array:
        """Samples (B, T, D)."""
        assert self.samples is not None
        return self.samples.reshape(self.outcome.shape[0], -1, self.samples.shape[1])[:, :-1]


class Note(NamedTuple):
    """Record of one iteration: state, levels (see ``compact``) and time since the start,
    before it. The values after it are those of the next record."""

    y: Array
    levels: Array
    elapsed: Array


class StepRecord(NamedTuple):
    """``notes`` of the first iterations; ``last``: the note after all ``iterations`` iterations;
    and the ``outcome`` of each body."""

    notes: Note
    last: Note
    iterations: Array
    outcome: Array


MakeMotion = Callable[..., tuple[Motion, LoopOptions]]
"""``make_motion(arrays, unit_data, differentiable)`` returns the equations of motion with
coefficients from ``arrays``, and the options; ``unit_data``: natural units of the errors, and
``rtol``."""


def solve(
    make_motion: MakeMotion,
    arrays: Any,
    unit_data: Any,
    start: Array,
    ts: Array,
    y: Array,
    iterations: int = 0,
) -> tuple[Solved, StepRecord | None]:
    """Integrate from ``y`` (D, B) at ``start`` () or (B,) through ``ts`` (T,) or (B, T), with a
    record of the first ``iterations`` iterations."""
    motion, options = make_motion(arrays, unit_data, False)
    bodies = y.shape[1]

    def integrate(coefficients, arguments, unit_data, rtol, start, ts, y):
        bound_motion = motion._replace(
            coefficients=coefficients, arguments=arguments, unit_data=unit_data
        )
        progress, storage, record = run(
            bound_motion,
            options._replace(rtol=rtol),
            *broadcast_times(start, ts, bodies),
            y,
            iterations,
        )
        no_events = (None,) * 4
        count, *events = (progress.count, *storage[1:]) if options.capacity else no_events
        # the first attempt only evaluates the rates and is not a rejected step
        rejected_steps = jnp.maximum(progress.attempts - progress.steps - 1, 0)
        steps = StepCounts.of(
            progress.steps, rejected_steps, progress.at_switches, at_stability=progress.unstable
        )
        solved = Solved(steps, progress.outcome, progress.error, count, storage.samples, *events)
        return solved, record

    # For more bodies a fused kernel takes four times as long to compile and is not faster.
    is_unit = motion.is_fusible and bodies <= _policy.KERNEL_BODIES
    integrate = kernel(integrate) if is_unit else integrate
    return integrate(
        motion.coefficients, motion.arguments, motion.unit_data, options.rtol, start, ts, y
    )


def run(
    motion: Motion, options: LoopOptions, start: Array, ts: Array, y: Array, iterations: int = 0
) -> tuple[Progress, Storage, StepRecord | None]:
    """Integrate from ``y`` (D, B) at ``start`` (B,) through the times ``ts`` (T, B), in order."""
    progress, storage = initial_carry(motion, options, start, ts, y)

    def iterate(carry):
        progress, storage, *record = carry
        if iterations:  # iterations beyond the capacity overwrite the last note
            count, notes = record
            record = count + 1, with_row(notes, count, note_of(motion, progress))
        return *advance(motion, options, start, ts, progress, storage), *record

    record = (
        (jnp.zeros((), jnp.int32), empty_rows(iterations, note_of(motion, progress)))
        if iterations
        else ()
    )
    progress, storage, *record = jax.lax.while_loop(
        lambda c: is_any_running(c[0]), iterate, (progress, storage, *record)
    )
    if not record:
        return progress, storage, None
    count, notes = record
    return progress, storage, StepRecord(notes, note_of(motion, progress), count, progress.outcome)


def is_any_running(progress: Progress) -> Array:
    """Whether any body is still running."""
    return any_of(jnp.where(progress.outcome == RUNNING, 1.0, 0.0))


def note_of(motion: Motion, progress: Progress) -> Note:
    """The values at the start of a step that its derivative needs."""
    return Note(progress.y, compact(motion, progress.levels), progress.elapsed)


def compact(motion: Motion, levels: Array) -> Array:
    """Levels (K, B) as int8 if all are 0 or 1, an eighth of the memory of floats.

    Levels of jumps may be any integer (``floor``) and stay floats. For a network of 64 relu, levels
    as floats would take ten times the memory of the states."""
    return levels if motion.jumps else levels.astype(jnp.int8)


def empty_rows(count: int, tree):
    """Zeros to store ``count`` trees like ``tree``, along a new leading axis."""
    return jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), tree)


def with_row(rows, k: Array, tree):
    """``rows`` with ``tree`` stored as row ``k``."""
    return jax.tree.map(lambda r, x: jax.lax.dynamic_update_index_in_dim(r, x, k, 0), rows, tree)


def initial_carry(
    motion: Motion, options: LoopOptions, start: Array, ts: Array, y: Array
) -> tuple[Progress, Storage]:
    """Carry and storage before the first step, which has zero width and evaluates the rates."""
    zero = jnp.zeros_like(y[0])
    zero_counts = jnp.zeros(zero.shape, jnp.int32)
    levels = motion.levels(motion.arguments, start, y)
    no_margins = jnp.zeros_like(levels)
    progress = Progress(
        elapsed=zero,
        y=y,
        rate=jnp.zeros_like(y),
        levels=levels,
        margin=no_margins,
        just_flipped=no_margins,
        needs_rates=jnp.ones_like(zero_counts, bool),
        width=zero,
        last_error=zero,
        angle=zero,
        error=zero,
        steps=zero_counts,
        attempts=zero_counts,
        at_switches=zero_counts,
        unstable=zero_counts,
        reversals=zero_counts,
        place=zero_counts,
        count=zero_counts,
        outcome=zero_counts,
    )
    dtype, bodies = y.dtype, y.shape[1]
    samples = jnp.full((bodies * (ts.shape[0] + 1), y.shape[0]), jnp.nan, dtype)
    events = bodies * (options.capacity + 1)
    storage = Storage(
        samples,
        jnp.full((events, 1), jnp.inf, dtype),
        jnp.full((events, 1), -1.0, dtype),
        jnp.full((events, y.shape[0]), jnp.nan, dtype),
    )
    return progress, storage


def broadcast_times(start: Array, ts: Array, bodies: int) -> tuple[Array, Array]:
    """``start`` () or (B,) and ``ts`` (T,) or (B, T) as (B,) and (T, B)."""
    times = ts[:, None] if ts.ndim == 1 else ts.T
    return jnp.broadcast_to(start, (bodies,)), jnp.broadcast_to(times, (times.shape[0], bodies))


class Search(NamedTuple):
    """Events to search for: their functions ``(wxyz, omega_body, t)``, the direction of each and
    whether it ends the motion; ``capacity``: number of events stored for each body. All static."""

    fns: tuple[Callable[..., Array], ...] = ()
    directions: tuple[int, ...] = ()
    terminal: tuple[bool, ...] = ()
    capacity: int = 0

    @property
    def without_storage(self) -> "Search":
        """The same events, but none of them is stored or ends the motion."""
        return Search(self.fns, self.directions, (False,) * len(self.fns), 0)


class LocatedEvents(NamedTuple):
    """Events of N bodies in the order of the motion.

    ``times`` (N, E) [s], inf where there is none; ``which`` (N, E): index of the event function;
    ``side`` (N, E): 1 where that function is positive before the event, else -1; ``count`` (N,):
    number of events; ``rows`` (N, T + E): times of the samples and of the events."""

    times: Array
    which: Array
    side: Array
    count: Array
    rows: Array


def samples_and_events(search: Search, solution: Solved, times: Array, states: Array):
    """The events, and the times (N, T + E) and states (N, T + E, D) of samples and events. Samples
    after a terminal event are replaced by the time and state of that event."""
    bodies, capacity = solution.outcome.shape[0], search.capacity
    assert solution.times is not None
    assert solution.states_at_events is not None
    assert solution.which is not None
    assert solution.count is not None
    event_times = solution.times.reshape(bodies, capacity + 1)[:, :-1]
    event_states = solution.states_at_events.reshape(bodies, capacity + 1, -1)[:, :-1]
    coded_index = solution.which.reshape(bodies, capacity + 1)[:, :-1]
    which = jnp.floor(coded_index).astype(jnp.int32)
    side = jnp.where(coded_index > which.astype(coded_index.dtype), -1, 1).astype(coded_index.dtype)
    times = jnp.broadcast_to(jnp.atleast_2d(times), states.shape[:2])
    is_event = jnp.isfinite(event_times)
    if any(search.terminal):
        sign = jnp.where(times[:, -1:] < times[:, :1], -1, 1).astype(times.dtype)
        last = jnp.minimum(solution.count, capacity)
        end = jnp.where(solution.outcome == AT_EVENT, last, capacity + 1)
        is_end = jnp.arange(1, capacity + 1, dtype=end.dtype)[None] == end[:, None]
        end_time = jnp.sum(jnp.where(is_end, event_times, 0), axis=1, keepdims=True)
        state = jnp.sum(jnp.where(is_end[..., None], event_states, 0), axis=1, keepdims=True)
        is_past_end = jnp.any(is_end, axis=1, keepdims=True) & (sign * (times - end_time) >= 0)
        times = jnp.where(is_past_end, end_time, times)
        states = jnp.where(is_past_end[..., None], state, states)
    at_events = jnp.where(is_event, event_times, times[:, -1:])
    event_states = jnp.where(is_event[..., None], event_states, states[:, -1:])
    times = jnp.concatenate([times, at_events], axis=1)
    states = jnp.concatenate([states, event_states], axis=1)
    return LocatedEvents(event_times, which, side, solution.count, times), times, states
