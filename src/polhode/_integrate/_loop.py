"""Integration loop of explicit Runge-Kutta steps: samples, switches and events inside the steps.

Bodies are the last axis of all arrays and have steps of their own. A step holds the levels of all
switches of the field (``_switches.py``), so the field within it is smooth. If the margin of a
switch falls below zero within the step, the step ends where it does, on the polynomial of dense
output, and the switch turns. An event is a switch on which the field does not depend.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import _policy
from polhode._integrate import _error_control as control
from polhode._integrate._explicit_step import (
    Attempt,
    Motion,
    Progress,
    attempt_step,
    column,
    dense_state,
    weighted,
)
from polhode._integrate._field import weighted_length
from polhode._integrate._switch_location import (
    SwitchPoint,
    first_of_jumps,
    first_switch,
    pick,
    undefined_side,
)
from polhode._kernels import any_of, kernel, put
from polhode._method import StepCounts

RUNNING, FINISHED, OUT_OF_STEPS, STEP_TOO_SHORT, NOT_FINITE, SLIDING, AT_EVENT = range(7)
"""Values of ``Progress.outcome``."""


class LoopOptions(NamedTuple):
    """Options of the integration loop.

    ``rtol``: bound of the sum of the errors of the steps [rad]; ``max_steps``: of each body;
    ``capacity``: events stored for each body; ``directions``: of each event 1, -1 or 0 for both;
    ``terminal``: whether a body stops at each; ``differentiable``: whether the place of a switch
    carries derivatives."""

    rtol: Array
    max_steps: int
    capacity: int = 0
    directions: tuple[int, ...] = ()
    terminal: tuple[bool, ...] = ()
    differentiable: bool = False


class Storage(NamedTuple):
    """Output of the loop: ``samples`` (B * (T + 1), D); of events ``times``, ``which`` (B * (E +
    1), 1) and ``states`` (B * (E + 1), D). The last row of each body is a bin for what is not
    stored."""

    samples: Array
    times: Array
    which: Array
    states: Array


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


def advance(
    motion: Motion,
    options: LoopOptions,
    start: Array,
    ts: Array,
    progress: Progress,
    storage: Storage,
):
    """One attempt of every body that is still running."""
    stop_gradient = jax.lax.stop_gradient
    eps = float(jnp.finfo(progress.y.dtype).eps)
    length = jnp.abs(ts[-1] - start)
    sign = jnp.where(ts[-1] < start, -1, 1).astype(progress.y.dtype)
    is_running = progress.outcome == RUNNING
    width, is_last = _width(progress, length, is_running, eps)
    t, h = start + sign * progress.elapsed, sign * width
    # Three stages more (of order 8), evaluated only where a sample lies within the step or, in
    # `attempt_step`, a switch comes near: a step without either costs what it does without both.
    needs_dense = is_running & (progress.place < ts.shape[0])
    needs_dense = needs_dense & (
        jnp.abs(column(ts, progress.place) - start) <= progress.elapsed + width
    )
    attempt = attempt_step(motion, progress, t, h, needs_dense)
    error, tolerance, angle, is_unstable = stop_gradient(
        _error_and_tolerance(motion, options, progress, attempt, width, length, eps)
    )
    ratio = error / tolerance
    is_first = progress.attempts == 0
    accepted = (ratio <= 1) & is_running & ~is_first
    turn = wrong_levels = None
    if motion.switches:
        # At the first step, and where another switch has just turned, a level may be that of the
        # wrong side already at the start: one comparison moves another one's argument, or rounding
        # decides. The step is then repeated with the level turned, without moving on. A switch that
        # has just turned itself stands at its root, where the sign of its margin is rounding.
        wrong_levels = (
            progress.needs_rates[None]
            & (attempt.margins[0] < 0)
            & (progress.just_turned == 0)
            & ~is_first[None]
        )
        wrong_levels = first_of_jumps(motion, wrong_levels)
        accepted = accepted & ~jnp.any(wrong_levels, axis=0)
        turn = first_switch(motion, options, progress, attempt, t, accepted, eps)
    trial = _Trial(
        attempt,
        width,
        is_last,
        is_running,
        accepted,
        error,
        ratio,
        angle,
        is_unstable,
        wrong_levels,
        turn,
    )

    def conclude(*operands):
        return _conclude(motion, options, eps, *operands)

    # Many short loops over the bodies, and no field in them: a unit also where the whole loop
    # cannot be one. Gradients through networks take a tenth less time, and a tenth less to compile.
    conclude = conclude if motion.is_whole else kernel(conclude)
    return conclude(start, ts, progress, storage, trial)


class _Trial(NamedTuple):
    """A step that was tried, of unsigned ``width``, with its ``error`` [rad], the ``ratio`` of that
    to its tolerance, and its ``angle`` [rad]; ``wrong_levels`` (K, B): switches on the wrong side
    at its start; ``turn``: the first switch in it; None where there are no switches."""

    attempt: Attempt
    width: Array
    is_last: Array
    is_running: Array
    accepted: Array
    error: Array
    ratio: Array
    angle: Array
    is_unstable: Array
    wrong_levels: Array | None
    turn: SwitchPoint | None


def _conclude(
    motion: Motion,
    options: LoopOptions,
    eps: float,
    start: Array,
    ts: Array,
    progress: Progress,
    storage: Storage,
    trial: _Trial,
) -> tuple[Progress, Storage]:
    """What follows from a step that was tried: the next state, width, levels and outcome."""
    stop_gradient = jax.lax.stop_gradient
    attempt, width, is_running, accepted = (
        trial.attempt,
        trial.width,
        trial.is_running,
        trial.accepted,
    )
    ratio, turn, length = trial.ratio, trial.turn, jnp.abs(ts[-1] - start)
    is_first = progress.attempts == 0
    hit = jnp.zeros_like(accepted) if turn is None else turn.hit
    part = jnp.where(hit, turn.part, 1) if turn is not None else jnp.ones_like(width)

    elapsed = jnp.where(trial.is_last, length, progress.elapsed + width)
    elapsed = jnp.where(hit, progress.elapsed + part * width, elapsed)
    # of a step that a switch cuts the state is that of dense output, which is less accurate
    state_ratio = ratio * jnp.where(hit, motion.rule.dense_error, 1)
    # Only the width is chosen by that larger error. Refusing such a step instead, to shorten it
    # until dense output keeps the tolerance, would cost an attempt for every switch.
    size = jnp.log(jnp.clip(state_ratio, control.MIN_RATIO, 1e12))
    memory = jnp.where(accepted, control.MEMORY * progress.last_error, 0)
    factor = control.SAFETY * jnp.exp((memory - size) / motion.rule.order)
    factor = jnp.clip(factor, control.MIN_FACTOR, control.MAX_FACTOR)
    is_cut = accepted & (width < control.CUT * progress.width)
    proposed = jnp.where(is_cut, jnp.maximum(progress.width, width * factor), width * factor)
    guess = stop_gradient(_first_width(motion, options, progress.y, attempt.stages[0], length))
    proposed = jnp.where(is_first, guess, proposed)
    # With `x > 0` held, `where(x > 0, sqrt(x), 0)` is NaN beyond the switch, so that there is no
    # root to search for. The step is shortened towards the switch instead, and turns it when it
    # cannot come nearer ("snaps").
    undefined = None
    if motion.switches:
        undefined, share = undefined_side(attempt, ratio, is_running & ~is_first, motion.rule)
        proposed = jnp.where(
            undefined.is_undefined, control.UNDEFINED_SIDE * width * share, proposed
        )
        time = jnp.maximum(progress.elapsed, 0.01 * length)
        is_close = width * share <= control.GRAIN * eps * time
        undefined = undefined._replace(snaps=undefined.is_undefined & is_close)
        proposed = jnp.where(undefined.snaps, guess, proposed)
    storage, place = _save(
        attempt, progress, storage, ts, start, jnp.where(accepted, elapsed, -1), width
    )

    def choose(a, b):
        return jnp.where(accepted if a.ndim == 1 else accepted[None], a, b)

    def count(n, where):
        return n + jnp.where(where, 1, 0).astype(n.dtype)

    rate_at_start = jnp.where(progress.needs_rates[None], attempt.stages[0], progress.rate)
    progress_after = progress._replace(
        elapsed=choose(elapsed, progress.elapsed),
        y=choose(dense_state(progress.y, attempt.dense, part), progress.y),
        rate=choose(attempt.stages[motion.rule.stages - 1], rate_at_start),
        needs_rates=hit,
        width=stop_gradient(jnp.where(is_running, proposed, progress.width)),
        last_error=choose(stop_gradient(size), progress.last_error),
        angle=progress.angle + choose(trial.angle * stop_gradient(part), jnp.zeros_like(width)),
        error=progress.error + choose(trial.error, jnp.zeros_like(width)),
        steps=count(progress.steps, accepted),
        attempts=count(progress.attempts, is_running),
        at_switches=count(progress.at_switches, hit & accepted),
        unstable=count(progress.unstable, accepted & ~hit & trial.is_unstable),
        place=place,
    )
    if turn is not None and undefined is not None and trial.wrong_levels is not None:
        progress_after, storage = _apply_switch(
            motion,
            options,
            progress,
            progress_after,
            storage,
            attempt,
            turn,
            trial.wrong_levels,
            accepted,
            width,
            start,
        )
        snaps = undefined.snaps[None] & undefined.flips
        progress_after = progress_after._replace(
            levels=jnp.where(snaps, 1 - progress.levels, progress_after.levels),
            just_turned=jnp.where(snaps, 1, progress_after.just_turned),
            needs_rates=progress_after.needs_rates | undefined.snaps,
        )
    return progress_after._replace(
        outcome=_outcome(options, progress_after, is_running, length, ratio, eps)
    ), storage


def _first_width(
    motion: Motion, options: LoopOptions, y: Array, rate: Array, length: Array
) -> Array:
    _, natural_rate = motion.units(motion.unit_data, list(y), list(rate))
    return (
        control.FIRST_WIDTH
        * options.rtol.astype(y.dtype) ** (1 / (motion.rule.order + 1))
        / jnp.maximum(natural_rate, 1 / length)
    )


def _width(progress: Progress, length: Array, is_running: Array, eps: float) -> tuple[Array, Array]:
    """Width of the step, and whether it leads to the last time."""
    remaining = length - progress.elapsed
    is_last = remaining <= progress.width * (1 + 1e-9)
    # no step is much shorter than its neighbours for the sake of the end
    width = jnp.where(is_last, remaining, jnp.minimum(progress.width, remaining / 2))
    # the width is the difference of two representable times: otherwise rounding of the sum would
    # accumulate over thousands of steps
    end = progress.elapsed + width
    exact = jax.lax.stop_gradient(end - progress.elapsed - width) + width
    exact = jnp.maximum(exact, eps * end)
    return jnp.where(is_running, jnp.where(is_last, remaining, exact), 0), is_last


def _error_and_tolerance(motion, options, progress, attempt, width, length, eps):
    """Error of a step [rad], its tolerance, the angle of the step [rad], and whether its width is
    one that stability allows just so."""
    rule = motion.rule
    first_rates, last_rates = attempt.stages[0], attempt.stages[rule.stages - 1]
    change = weighted(rule.weights[rule.stages - 1], attempt.h[None, None] * attempt.stages)
    ends = (progress.y, first_rates), (progress.y + change, last_rates)
    (weights, rate), (end_weights, end_rate) = (
        motion.units(motion.unit_data, list(y), list(f)) for y, f in ends
    )
    weights = [jnp.minimum(a, b) for a, b in zip(weights, end_weights)]
    rate = jnp.maximum(rate, end_rate)

    def length_of(stage_weights):
        return weighted_length(
            weights, list(attempt.h[None] * weighted(stage_weights, attempt.stages))
        )

    error, *lower_order_errors = map(length_of, rule.errors)
    # Both estimates of DOP853 are far above the error of its result; their combination falls with
    # the order of the result, so that the width is chosen by the right power.
    if lower_order_errors:  # of two estimates as in DOP853, of higher order than either
        combined_error = jnp.sqrt(
            error * error + 0.01 * lower_order_errors[0] * lower_order_errors[0]
        )
        error = error * jnp.where(
            combined_error > 0, error / jnp.where(combined_error > 0, combined_error, 1), 0
        )
    # The combination is far too small where the first estimate vanishes by chance, as it may where
    # something narrow lies within the step; the difference does not vanish at the same place.
    if rule.difference is not None:
        error = error + control.SIXTH_DIFFERENCE * length_of(rule.difference)
    angle = rate * width
    total_angle = jnp.maximum(progress.angle + rate * (length - progress.elapsed), 1)
    drift_ratio = jnp.maximum(total_angle / control.DRIFT_ANGLE, 1)
    drift = jnp.sqrt(drift_ratio * jnp.sqrt(drift_ratio))
    tolerance = (
        control.EXPLICIT_SHARE * options.rtol.astype(error.dtype) * angle / (total_angle * drift)
    )
    tolerance = jnp.maximum(tolerance, control.ROUNDED_STEP * eps)
    sound = jnp.isfinite(error) & jnp.isfinite(angle)
    error, tolerance, angle = (
        jnp.where(sound, x, y) for x, y in ((error, jnp.inf), (tolerance, 1), (angle, 0))
    )
    # The last two stages stand at the same time: the change of their rates over that of their
    # states is the fastest rate of decay or growth (Hairer & Wanner, Solving Ordinary Differential
    # Equations II, section IV.2).
    apart = [rule.weights[k] for k in (rule.stages - 2, rule.stages - 1)]
    moved = list(attempt.h[None] * weighted(apart[1] - apart[0], attempt.stages))
    change = list(attempt.h[None] * (last_rates - attempt.stages[rule.stages - 2]))
    moved, change = weighted_length(weights, moved), weighted_length(weights, change)
    return error, tolerance, angle, change > control.NEAR_STABILITY * rule.stability * moved


def _save(
    attempt: Attempt, progress: Progress, storage: Storage, ts, start, elapsed, width
) -> tuple[Storage, Array]:
    """Store the samples up to ``elapsed`` (B,); the index of the next one."""
    size = ts.shape[0]
    base = (size + 1) * jnp.arange(width.shape[0], dtype=progress.place.dtype)

    def is_due(place):
        return (place < size) & (jnp.abs(column(ts, place) - start) <= elapsed)

    # One sample of each body at a time. To evaluate all times of the whole motion by their step
    # afterwards, as diffrax's dense output does, would need the stages of all steps in memory.
    def store_one(carry):
        place, samples = carry
        is_stored = is_due(place)
        x = (jnp.abs(column(ts, place) - start) - progress.elapsed) / jnp.where(width > 0, width, 1)
        y = dense_state(progress.y, attempt.dense, jnp.minimum(x, 1))
        samples = put(samples, base + jnp.where(is_stored, place, size), y.T)
        return place + jnp.where(is_stored, 1, 0).astype(place.dtype), samples

    place, samples = jax.lax.while_loop(
        lambda c: any_of(jnp.where(is_due(c[0]), 1.0, 0.0)),
        store_one,
        (progress.place, storage.samples),
    )
    return storage._replace(samples=samples), place


def _apply_switch(
    motion,
    options,
    progress,
    progress_after,
    storage,
    attempt,
    turn: SwitchPoint,
    wrong_levels,
    accepted,
    width,
    start,
):
    """Turn the switches that were met, and store events."""
    hit = turn.hit & accepted
    flips = turn.flips & hit[None]
    # a body whose levels were wrong from the start has refused the step and goes on from there
    repaired = jnp.any(wrong_levels, axis=0) & (progress.outcome == RUNNING)
    is_at_start = turn.part <= turn.start_fraction
    # A switch that turns back where it has just turned: once is chance, but at a sliding surface
    # both sides push towards it and every step is shorter than the one before. Counted, to end
    # with a status instead of with steps of rounding.
    is_reversal = hit & jnp.any(flips & (progress.just_turned > 0), axis=0) & is_at_start
    end_margins = attempt.margins[motion.rule.stages - 1]
    levels = jnp.where(flips, turn.levels, progress.levels)
    levels = jnp.where(wrong_levels & repaired[None], attempt.new_levels, levels)
    earlier_turns = jnp.where((hit & is_at_start)[None], progress.just_turned, 0)
    just_turned = pick(accepted, jnp.zeros_like(progress.just_turned), progress.just_turned)
    just_turned = pick(
        hit, jnp.where(flips, 1, earlier_turns).astype(just_turned.dtype), just_turned
    )
    # not at a root: its next one is a switch as any other, however soon
    just_turned = jnp.where(wrong_levels & repaired[None], 0, just_turned)
    progress_after = progress_after._replace(
        levels=levels,
        margin=pick(
            accepted, end_margins, pick(progress.needs_rates, attempt.margins[0], progress.margin)
        ),
        just_turned=just_turned.astype(progress.just_turned.dtype),
        needs_rates=hit | repaired,
        width=jnp.where(
            repaired, progress.width, jnp.where(is_reversal, width / 4, progress_after.width)
        ),
        reversals=jnp.where(
            is_reversal, progress.reversals + 1, jnp.where(accepted & ~hit, 0, progress.reversals)
        ),
    )
    if not motion.events:
        return progress_after, storage
    bodies, capacity = width.shape[0], options.capacity
    sign = jnp.where(attempt.h < 0, -1, 1)
    base = (capacity + 1) * jnp.arange(bodies, dtype=progress_after.count.dtype)
    count, stopped = progress_after.count, jnp.zeros_like(hit)
    is_at_motion_start = progress_after.elapsed <= 1e-6 * jnp.abs(
        width
    )  # an event at the start is not one of the motion
    # An event costs one row of margins, whatever its kind: it is located by the search for
    # switches, and only what happens at its root is different.
    for k in range(motion.events):
        row = motion.switches - motion.events + k
        rises = jnp.where(turn.levels[row] > 0, 1, -1) * sign
        is_event = flips[row] & ~is_at_motion_start
        if options.directions[k]:
            is_event = is_event & (rises == options.directions[k])
        # lanes have no branches: every body writes, those without an event into the bin
        rows = base + jnp.where(is_event & (count < capacity), count, capacity)
        t = start + sign * progress_after.elapsed
        storage = storage._replace(
            times=put(storage.times, rows, t[:, None]),
            which=put(storage.which, rows, jnp.full((bodies, 1), k, t.dtype)),
            states=put(storage.states, rows, progress_after.y.T),
        )
        count = count + jnp.where(is_event, 1, 0).astype(count.dtype)
        if options.terminal[k]:
            stopped = stopped | is_event
    outcome = jnp.where(stopped, AT_EVENT, progress_after.outcome).astype(
        progress_after.outcome.dtype
    )
    return progress_after._replace(count=count, outcome=outcome), storage


def _outcome(options, progress: Progress, is_running, length, ratio, eps) -> Array:
    """Whether each body is still running, or why not."""
    attempts = control.ATTEMPTS * options.max_steps
    spent = (progress.steps >= options.max_steps) | (progress.attempts >= attempts)
    is_too_short = ~(progress.width > control.MIN_WIDTH * eps * length)
    number = jnp.isfinite(ratio) & jnp.isfinite(progress.width)
    why = jnp.where(is_too_short, jnp.where(number, STEP_TOO_SHORT, NOT_FINITE), RUNNING)
    slides = progress.reversals >= control.MAX_REVERSALS
    slides = slides | (is_too_short & number & (progress.reversals >= control.SHORT_REVERSALS))
    why = jnp.where(slides, SLIDING, why)
    why = jnp.where(spent, OUT_OF_STEPS, why)
    why = jnp.where(progress.elapsed >= length, FINISHED, why)
    why = jnp.where(progress.outcome == AT_EVENT, AT_EVENT, why)
    return jnp.where(is_running, why, progress.outcome).astype(progress.outcome.dtype)


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
    ``which`` (N, E) event, ``count`` (N,): their number; ``rows`` (N, T): times of the samples."""

    times: Array
    which: Array
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
    which = solution.which.reshape(bodies, capacity + 1)[:, :-1].astype(jnp.int32)
    times = jnp.broadcast_to(jnp.atleast_2d(times), states.shape[:2])
    is_event = jnp.isfinite(event_times)
    if any(search.terminal):
        sign = jnp.where(times[:, -1:] < times[:, :1], -1, 1).astype(times.dtype)
        end = jnp.where(solution.outcome == AT_EVENT, solution.count, capacity + 1)
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
    return Found(event_times, which, solution.count, times), times, states
