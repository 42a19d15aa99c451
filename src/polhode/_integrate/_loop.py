"""Integration loop of explicit Runge-Kutta steps: samples, events and a record of the steps.

Bodies are the last axis of all arrays and have steps of their own. What happens in one turn of the
loop: ``_turn.py``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import _policy
from polhode._integrate._explicit_step import Motion, Progress
from polhode._integrate._turn import AT_EVENT, RUNNING, LoopOptions, Storage, advance
from polhode._kernels import any_of, kernel
from polhode._method import StepCounts


class Solved(NamedTuple):
    """Result of B bodies: see ``Progress`` and ``Storage``; None where no event is stored."""

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
    """Before a turn of the loop: state, levels, and the time since the start. What a turn leads to
    stands in the note of the next one. Levels as ``packed`` leaves them."""

    y: Array
    levels: Array
    elapsed: Array


class StepRecord(NamedTuple):
    """``notes`` of the first turns of the loop, the note after the last of all ``turns``, and the
    ``outcome`` of each body."""

    notes: Note
    last: Note
    turns: Array
    outcome: Array


Make = Callable[..., tuple[Motion, LoopOptions]]
"""``make(arrays, unit_data, differentiable)``: the motion with coefficients from ``arrays``, errors
measured by ``unit_data`` (units and ``rtol``), and the options."""


def solve(
    make: Make, arrays: Any, unit_data: Any, start: Array, ts: Array, y: Array, turns: int = 0
) -> tuple[Solved, StepRecord | None]:
    """Integrate from ``y`` (D, B) at ``start`` () or (B,) through ``ts`` (T,) or (B, T), with a
    record of the first ``turns`` of the loop."""
    motion, options = make(arrays, unit_data, False)
    bodies = y.shape[1]

    def integrate(coefficients, arguments, unit_data, rtol, start, ts, y):
        bound_motion = motion._replace(
            coefficients=coefficients, arguments=arguments, unit_data=unit_data
        )
        progress, storage, record = run(
            bound_motion, options._replace(rtol=rtol), *each_body(start, ts, bodies), y, turns
        )
        no_events = (None,) * 4
        count, *events = (progress.count, *storage[1:]) if options.capacity else no_events
        # the first attempt has no width
        rejected_steps = jnp.maximum(progress.attempts - progress.steps - 1, 0)
        steps = StepCounts.of(
            progress.steps, rejected_steps, progress.at_switches, at_stability=progress.unstable
        )
        solved = Solved(steps, progress.outcome, progress.error, count, storage.samples, *events)
        return solved, record

    # for more bodies a fused kernel takes four times as long to compile and is not faster
    is_unit = motion.is_whole and bodies <= _policy.KERNEL_BODIES
    integrate = kernel(integrate) if is_unit else integrate
    return integrate(
        motion.coefficients, motion.arguments, motion.unit_data, options.rtol, start, ts, y
    )


def run(
    motion: Motion, options: LoopOptions, start: Array, ts: Array, y: Array, turns: int = 0
) -> tuple[Progress, Storage, StepRecord | None]:
    """Integrate from ``y`` (D, B) at ``start`` (B,) through the times ``ts`` (T, B), in order."""
    progress, storage = begin(motion, options, start, ts, y)

    def turn(carry):
        progress, storage, *record = carry
        if turns:  # turns for which there is no room overwrite the last note
            count, notes = record
            record = count + 1, put_in(notes, count, noted(motion, progress))
        return *advance(motion, options, start, ts, progress, storage), *record

    record = (jnp.zeros((), jnp.int32), room_for(turns, noted(motion, progress))) if turns else ()
    progress, storage, *record = jax.lax.while_loop(
        lambda c: is_any_running(c[0]), turn, (progress, storage, *record)
    )
    if not record:
        return progress, storage, None
    count, notes = record
    return progress, storage, StepRecord(notes, noted(motion, progress), count, progress.outcome)


def is_any_running(progress: Progress) -> Array:
    """Whether any body goes on."""
    return any_of(jnp.where(progress.outcome == RUNNING, 1.0, 0.0))


def noted(motion: Motion, progress: Progress) -> Note:
    """What the derivative of a step needs to know of its start."""
    return Note(progress.y, packed(motion, progress.levels), progress.elapsed)


def packed(motion: Motion, levels: Array) -> Array:
    """Levels (K, B) in an eighth of the memory: those of kinks are 0 or 1, those of jumps may be
    any integer (``floor``). Records of a network of 64 relu would else be ten times the states."""
    return levels if motion.jumps else levels.astype(jnp.int8)


def room_for(count: int, tree):
    """Rows for ``count`` trees of the same shapes."""
    return jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), tree)


def put_in(rows, k: Array, tree):
    """Rows with the tree as row ``k``."""
    return jax.tree.map(lambda r, x: jax.lax.dynamic_update_index_in_dim(r, x, k, 0), rows, tree)


def begin(
    motion: Motion, options: LoopOptions, start: Array, ts: Array, y: Array
) -> tuple[Progress, Storage]:
    """Carry and storage before the first step, which has no width and evaluates the rates."""
    zero = jnp.zeros_like(y[0])
    zero_counts = jnp.zeros(zero.shape, jnp.int32)
    levels = motion.levels(motion.arguments, start, y)
    unknown = jnp.zeros_like(levels)
    progress = Progress(
        elapsed=zero,
        y=y,
        rate=jnp.zeros_like(y),
        levels=levels,
        margin=unknown,
        just_turned=unknown,
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


def each_body(start: Array, ts: Array, bodies: int) -> tuple[Array, Array]:
    """``start`` () or (B,) and ``ts`` (T,) or (B, T) as (B,) and (T, B)."""
    times = ts[:, None] if ts.ndim == 1 else ts.T
    return jnp.broadcast_to(start, (bodies,)), jnp.broadcast_to(times, (times.shape[0], bodies))


class Search(NamedTuple):
    """Events to search for: functions ``(wxyz, omega_body, t)``, the direction of each and whether
    it ends the motion; ``capacity``: how many of a body are stored. All static."""

    fns: tuple[Callable[..., Array], ...] = ()
    directions: tuple[int, ...] = ()
    terminal: tuple[bool, ...] = ()
    capacity: int = 0

    @property
    def passing(self) -> "Search":
        """The same events, none of which is stored or ends the motion."""
        return Search(self.fns, self.directions, (False,) * len(self.fns), 0)


class Found(NamedTuple):
    """Events of N bodies in the order of the motion: ``times`` (N, E) [s], inf where there is none,
    ``which`` (N, E) event, ``side`` (N, E): 1 where its function is positive before it, or else -1;
    ``count`` (N,): their number; ``rows`` (N, T): times of the samples."""

    times: Array
    which: Array
    side: Array
    count: Array
    rows: Array


def with_events(search: Search, solution: Solved, times: Array, states: Array):
    """The events, and times (N, T + E) and states (N, T + E, D) of samples and events; samples
    beyond a terminal event are that event."""
    bodies, capacity = solution.outcome.shape[0], search.capacity
    assert solution.times is not None
    assert solution.states_at_events is not None
    assert solution.which is not None
    assert solution.count is not None
    event_times = solution.times.reshape(bodies, capacity + 1)[:, :-1]
    event_states = solution.states_at_events.reshape(bodies, capacity + 1, -1)[:, :-1]
    code = solution.which.reshape(bodies, capacity + 1)[:, :-1]
    which = jnp.floor(code).astype(jnp.int32)
    side = jnp.where(code > which.astype(code.dtype), -1, 1).astype(code.dtype)
    times = jnp.broadcast_to(jnp.atleast_2d(times), states.shape[:2])
    is_event = jnp.isfinite(event_times)
    if any(search.terminal):
        sign = jnp.where(times[:, -1:] < times[:, :1], -1, 1).astype(times.dtype)
        last = jnp.minimum(solution.count, capacity)
        end = jnp.where(solution.outcome == AT_EVENT, last, capacity + 1)
        stop = jnp.arange(1, capacity + 1, dtype=end.dtype)[None] == end[:, None]
        final = jnp.sum(jnp.where(stop, event_times, 0), axis=1, keepdims=True)
        state = jnp.sum(jnp.where(stop[..., None], event_states, 0), axis=1, keepdims=True)
        is_past_end = jnp.any(stop, axis=1, keepdims=True) & (sign * (times - final) >= 0)
        times = jnp.where(is_past_end, final, times)
        states = jnp.where(is_past_end[..., None], state, states)
    at_events = jnp.where(is_event, event_times, times[:, -1:])
    event_states = jnp.where(is_event[..., None], event_states, states[:, -1:])
    times = jnp.concatenate([times, at_events], axis=1)
    states = jnp.concatenate([states, event_states], axis=1)
    return Found(event_times, which, side, solution.count, times), times, states
