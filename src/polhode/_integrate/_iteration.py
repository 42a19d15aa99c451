"""One iteration of the loop of explicit Runge-Kutta steps: attempt a step, and accept it,
reject it or end it at a switch.

During a step the levels of all switches of the field (``_switches.py``) are constant, so that the
field is smooth. If the margin of a switch falls below zero within the step, the step ends at that
point, on the polynomial of dense output, and the switch flips: it changes its level. An event is a
switch on which the field does not depend.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

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
    Undefined,
    first_of_jumps,
    first_switch,
    is_unresolved,
    select_bodies,
    undefined_side,
)
from polhode._kernels import any_of, kernel, put

RUNNING, FINISHED, OUT_OF_STEPS, STEP_TOO_SHORT, NOT_FINITE, SLIDING, AT_EVENT = range(7)
"""Values of ``Progress.outcome``."""


class LoopOptions(NamedTuple):
    """Options of the integration loop.

    ``rtol``: bound of the sum of the errors of the steps [rad]; ``max_steps``: of each body;
    ``capacity``: events stored for each body; ``directions``: of each event 1, -1 or 0 for both;
    ``terminal``: whether a body stops at each; ``differentiable``: whether the times at which
    switches flip have derivatives."""

    rtol: Array
    max_steps: int
    capacity: int = 0
    directions: tuple[int, ...] = ()
    terminal: tuple[bool, ...] = ()
    differentiable: bool = False


class Storage(NamedTuple):
    """Output of the loop: ``samples`` (B * (T + 1), D); of events ``times``, ``which`` (B * (E +
    1), 1) and ``states`` (B * (E + 1), D). The last row of each body is a dummy row, which is
    written in iterations in which the body has nothing to store."""

    samples: Array
    times: Array
    which: Array
    states: Array


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
    # Dense output takes three additional stages (order 8). They are evaluated only if a sample lies
    # within the step, or if `attempt_step` finds that a switch may flip in it.
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
    switch = wrong_levels = None
    is_long = jnp.zeros_like(accepted)
    if motion.switches:
        # At the first step, and after another switch has flipped, a level may be wrong already at
        # the start of the step, because the argument of one comparison depends on another one, or
        # by rounding. The level is then corrected and the step repeated from the same state. A
        # switch that has just flipped is at its root, where the sign of its margin is rounding, and
        # is not corrected.
        wrong_levels = (
            progress.needs_rates[None]
            & (attempt.margins[0] < 0)
            & (progress.just_flipped == 0)
            & ~is_first[None]
        )
        wrong_levels = first_of_jumps(motion, wrong_levels)
        accepted = accepted & ~jnp.any(wrong_levels, axis=0)
        if motion.resolved_switches:
            is_long = width > control.MARGIN_STEPS * length / options.max_steps
            is_long = is_long & is_unresolved(motion, attempt.margins, motion.rule)
            accepted = accepted & ~is_long
        switch = first_switch(motion, options, progress, attempt, t, accepted, eps)
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
        is_long,
        wrong_levels,
        switch,
    )

    def conclude(*operands):
        return _conclude(motion, options, eps, *operands)

    # This function consists of many short loops over the bodies and does not contain the field, so
    # that it can be a unit where the whole loop cannot. Gradients through networks take a tenth
    # less time to run and to compile.
    conclude = conclude if motion.is_fusible else kernel(conclude)
    return conclude(start, ts, progress, storage, trial)


class _Trial(NamedTuple):
    """An attempted step of unsigned ``width``, its ``error`` [rad], the ``ratio`` of the error to
    the tolerance, and its ``angle`` [rad].

    ``is_long``: a margin has more turning points than the stages resolve; ``wrong_levels`` (K, B):
    switches with a wrong level at the start of the step; ``switch``: the first switch that flips in
    the step. Both are None if the field has no switches."""

    attempt: Attempt
    width: Array
    is_last: Array
    is_running: Array
    accepted: Array
    error: Array
    ratio: Array
    angle: Array
    is_unstable: Array
    is_long: Array
    wrong_levels: Array | None
    switch: SwitchPoint | None


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
    """State, width of the next step, levels and outcome after an attempted step."""
    stop_gradient = jax.lax.stop_gradient
    attempt, width, is_running, accepted = (
        trial.attempt,
        trial.width,
        trial.is_running,
        trial.accepted,
    )
    ratio, switch, length = trial.ratio, trial.switch, jnp.abs(ts[-1] - start)
    is_first = progress.attempts == 0
    hit = jnp.zeros_like(accepted) if switch is None else switch.hit
    fraction = jnp.where(hit, switch.fraction, 1) if switch is not None else jnp.ones_like(width)

    elapsed = jnp.where(trial.is_last, length, progress.elapsed + width)
    elapsed = jnp.where(hit, progress.elapsed + fraction * width, elapsed)
    # If the step ends at a switch, its final state is one of dense output, which is less accurate.
    # This larger error only affects the width of the next step: to reject the step until dense
    # output satisfies the tolerance would take one more attempt for every switch.
    state_ratio = ratio * jnp.where(hit, motion.rule.dense_error, 1)
    size = jnp.log(jnp.clip(state_ratio, control.MIN_RATIO, 1e12))
    memory = jnp.where(accepted, control.MEMORY * progress.last_error, 0)
    factor = control.SAFETY * jnp.exp((memory - size) / motion.rule.order)
    factor = jnp.clip(factor, control.MIN_FACTOR, control.MAX_FACTOR)
    is_cut = accepted & (width < control.CUT * progress.width)
    proposed = jnp.where(is_cut, jnp.maximum(progress.width, width * factor), width * factor)
    guess = stop_gradient(_first_width(motion, options, progress.y, attempt.stages[0], length))
    proposed = jnp.where(is_first, guess, jnp.where(trial.is_long, width / 2, proposed))
    # If the level `x > 0` stays fixed, `where(x > 0, sqrt(x), 0)` is NaN beyond the switch, and the
    # margin has no root that could be bracketed. The step is shortened towards the switch instead,
    # until it is within rounding of it; then the switch flips ("snaps").
    undefined = None
    if motion.switches:
        undefined, share = undefined_side(attempt, ratio, is_running & ~is_first, motion.rule)
        proposed = jnp.where(
            undefined.is_undefined, control.UNDEFINED_SIDE * width * share, proposed
        )
        time_resolution = min_snap_time(progress.elapsed, length, eps)
        snaps = undefined.is_undefined & (width * share <= time_resolution)
        undefined = undefined._replace(snaps=snaps)
        snap_time = jnp.minimum(
            jnp.maximum(2 * width * share, time_resolution), (length - progress.elapsed) / 2
        )
        # As short as the last step before the switch: derivatives may be unbounded there.
        proposed = jnp.where(snaps, snap_time, proposed)
        snap_time = _with_root_derivative(
            snap_time, width * share, attempt.margins[0], undefined.flips
        )
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
        y=choose(dense_state(progress.y, attempt.dense, fraction), progress.y),
        rate=choose(attempt.stages[motion.rule.stages - 1], rate_at_start),
        needs_rates=hit,
        width=stop_gradient(jnp.where(is_running, proposed, progress.width)),
        last_error=choose(stop_gradient(size), progress.last_error),
        angle=progress.angle + choose(trial.angle * stop_gradient(fraction), jnp.zeros_like(width)),
        error=progress.error + choose(trial.error, jnp.zeros_like(width)),
        steps=count(progress.steps, accepted),
        attempts=count(progress.attempts, is_running),
        at_switches=count(progress.at_switches, hit & accepted),
        unstable=count(progress.unstable, accepted & ~hit & trial.is_unstable),
        place=place,
    )
    if switch is not None and undefined is not None and trial.wrong_levels is not None:
        progress_after, flips = _flip_switches(
            motion, progress, progress_after, trial, switch, trial.wrong_levels
        )
        if motion.events:
            progress_after, storage = _store_events(
                motion, options, start, progress, progress_after, storage, trial, switch, flips
            )
        if options.differentiable and motion.jumps:
            y = _with_coincident_switch(
                motion, progress, progress_after, attempt.stages[0], trial.wrong_levels, ts, start
            )
            progress_after = progress_after._replace(y=y)
        sign = jnp.where(attempt.h < 0, -1, 1)
        progress_after = _snap(progress, progress_after, undefined, rate_at_start, snap_time, sign)
    return progress_after._replace(
        outcome=_outcome(options, progress_after, is_running, length, ratio, eps)
    ), storage


def min_snap_time(elapsed: Array, length: Array, eps: float) -> Array:
    """Distance in time to a switch below which the state is moved past it (see ``_snap``)."""
    return control.GRAIN * eps * jnp.maximum(elapsed, 0.01 * length)


def _snap(
    progress: Progress,
    progress_after: Progress,
    undefined: Undefined,
    rate: Array,
    snap_time: Array,
    sign: Array,
) -> Progress:
    """Flip switches beyond which the field with the previous levels is undefined.

    The state moves past the switch along the ``rate`` (D, B), by the time ``snap_time`` (B,);
    ``sign`` of time. It has to pass the switch, because the field after the flip is undefined
    before the switch, as with ``sqrt(abs(x))``."""
    snaps = undefined.snaps
    flips = snaps[None] & undefined.flips
    is_moved = snaps & jnp.all(jnp.isfinite(rate), axis=0)
    snap_time = jnp.where(is_moved, snap_time, 0)
    return progress_after._replace(
        elapsed=progress_after.elapsed + snap_time,
        y=progress_after.y + (sign * snap_time)[None] * jnp.where(is_moved[None], rate, 0),
        levels=jnp.where(flips, 1 - progress.levels, progress_after.levels),
        just_flipped=jnp.where(flips, 1, progress_after.just_flipped),
        needs_rates=progress_after.needs_rates | snaps,
    )


def _with_root_derivative(snap_time: Array, root: Array, margins: Array, flips: Array) -> Array:
    """``snap_time`` with the derivatives of the time ``root`` at which the margins (K, B) of the
    switches ``flips`` vanish, as far as the secant that gave ``root`` depends on these margins."""
    stop_gradient = jax.lax.stop_gradient
    margin = jnp.sum(jnp.where(flips, margins, 0), axis=0)
    is_positive = stop_gradient(margin) > 0
    relative_margin = jnp.where(
        is_positive, margin / stop_gradient(jnp.where(is_positive, margin, 1)), 1
    )
    return stop_gradient(snap_time) + stop_gradient(root) * (relative_margin - 1)


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
    """Width of the step, and whether it ends at the last time."""
    remaining = length - progress.elapsed
    is_last = remaining <= progress.width * (1 + 1e-9)
    # the remainder is divided in two so that the last step is not much shorter than the one before
    width = jnp.where(is_last, remaining, jnp.minimum(progress.width, remaining / 2))
    # The width is the difference of two representable times; otherwise rounding of the sums would
    # accumulate over thousands of steps.
    end = progress.elapsed + width
    exact_width = jax.lax.stop_gradient(end - progress.elapsed - width) + width
    exact_width = jnp.maximum(exact_width, eps * end)
    return jnp.where(is_running, jnp.where(is_last, remaining, exact_width), 0), is_last


def _error_and_tolerance(motion, options, progress, attempt, width, length, eps):
    """Error of a step [rad], its tolerance, the angle of the step [rad], and whether its width is
    at the limit of stability."""
    rule = motion.rule
    first_rates, last_rates = attempt.stages[0], attempt.stages[rule.stages - 1]
    step_change = weighted(rule.weights[rule.stages - 1], attempt.h[None, None] * attempt.stages)
    ends = (progress.y, first_rates), (progress.y + step_change, last_rates)
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
    # Each estimate of DOP853 is far above the error of the result. Their combination has the order
    # of the result, so that the width follows from the right power of the error.
    if lower_order_errors:
        combined_error = jnp.sqrt(
            error * error + 0.01 * lower_order_errors[0] * lower_order_errors[0]
        )
        error = error * jnp.where(
            combined_error > 0, error / jnp.where(combined_error > 0, combined_error, 1), 0
        )
    # The combination is far too small where the first estimate vanishes by chance, as it may if the
    # field has a narrow feature within the step. The sixth difference does not vanish there too.
    if rule.difference is not None:
        error = error + control.SIXTH_DIFFERENCE * length_of(rule.difference)
    angle = rate * width
    total_angle = jnp.maximum(progress.angle + rate * (length - progress.elapsed), 1)
    drift = control.drift_divisor(total_angle)
    tolerance = (
        control.EXPLICIT_SHARE * options.rtol.astype(error.dtype) * angle / (total_angle * drift)
    )
    tolerance = jnp.maximum(tolerance, control.ROUNDED_STEP * eps)
    is_finite = jnp.isfinite(error) & jnp.isfinite(angle)
    error, tolerance, angle = (
        jnp.where(is_finite, x, y) for x, y in ((error, jnp.inf), (tolerance, 1), (angle, 0))
    )
    # The last two stages are at the same time: the difference of their rates divided by that of
    # their states estimates the fastest rate of decay or growth (Hairer & Wanner, Solving Ordinary
    # Differential Equations II, section IV.2).
    last_weights = [rule.weights[k] for k in (rule.stages - 2, rule.stages - 1)]
    state_difference = list(
        attempt.h[None] * weighted(last_weights[1] - last_weights[0], attempt.stages)
    )
    step_change = list(attempt.h[None] * (last_rates - attempt.stages[rule.stages - 2]))
    state_difference, step_change = (
        weighted_length(weights, state_difference),
        weighted_length(weights, step_change),
    )
    return (
        error,
        tolerance,
        angle,
        step_change > control.NEAR_STABILITY * rule.stability * state_difference,
    )


def _save(
    attempt: Attempt, progress: Progress, storage: Storage, ts, start, elapsed, width
) -> tuple[Storage, Array]:
    """Store the samples up to ``elapsed`` (B,). Returns the storage and the index of the next
    sample."""
    size = ts.shape[0]
    base = (size + 1) * jnp.arange(width.shape[0], dtype=progress.place.dtype)

    def is_due(place):
        return (place < size) & (jnp.abs(column(ts, place) - start) <= elapsed)

    # One sample of each body per iteration. To evaluate all samples after the integration, as with
    # diffrax's dense output, the stages of all steps would have to be stored.
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


def _flip_switches(
    motion: Motion,
    progress: Progress,
    progress_after: Progress,
    trial: _Trial,
    switch: SwitchPoint,
    wrong_levels: Array,
) -> tuple[Progress, Array]:
    """Flip the switches at which the step ends, and correct wrong levels. Also returns which
    switches (K, B) flip."""
    attempt, accepted = trial.attempt, trial.accepted
    hit = switch.hit & accepted
    flips = switch.flips & hit[None]
    # the step was rejected if levels were wrong at its start; it is repeated with correct levels
    is_corrected = jnp.any(wrong_levels, axis=0) & (progress.outcome == RUNNING)
    is_at_start = switch.fraction <= switch.start_fraction
    # A switch may flip back by chance where it has just flipped. On a sliding surface, however, the
    # fields of both sides point towards the surface, and every step is shorter than the one before.
    # Such reversals are counted, so that the body ends with the status SLIDING.
    is_reversal = hit & jnp.any(flips & (progress.just_flipped > 0), axis=0) & is_at_start
    end_margins = attempt.margins[motion.rule.stages - 1]
    levels = jnp.where(flips, switch.levels, progress.levels)
    levels = jnp.where(wrong_levels & is_corrected[None], attempt.new_levels, levels)
    earlier_flips = jnp.where((hit & is_at_start)[None], progress.just_flipped, 0)
    just_flipped = select_bodies(
        accepted, jnp.zeros_like(progress.just_flipped), progress.just_flipped
    )
    just_flipped = select_bodies(
        hit, jnp.where(flips, 1, earlier_flips).astype(just_flipped.dtype), just_flipped
    )
    # A corrected switch is not at its root, so that its next root counts, however close.
    just_flipped = jnp.where(wrong_levels & is_corrected[None], 0, just_flipped)
    progress_after = progress_after._replace(
        levels=levels,
        margin=select_bodies(
            accepted,
            end_margins,
            select_bodies(progress.needs_rates, attempt.margins[0], progress.margin),
        ),
        just_flipped=just_flipped.astype(progress.just_flipped.dtype),
        needs_rates=hit | is_corrected,
        width=jnp.where(
            is_corrected,
            progress.width,
            jnp.where(is_reversal, trial.width / 4, progress_after.width),
        ),
        reversals=jnp.where(
            is_reversal, progress.reversals + 1, jnp.where(accepted & ~hit, 0, progress.reversals)
        ),
    )
    return progress_after, flips


def _store_events(
    motion: Motion,
    options: LoopOptions,
    start: Array,
    progress: Progress,
    progress_after: Progress,
    storage: Storage,
    trial: _Trial,
    switch: SwitchPoint,
    flips: Array,
) -> tuple[Progress, Storage]:
    """Store the events among the switches ``flips`` (K, B), and stop bodies at terminal ones."""
    attempt, width = trial.attempt, trial.width
    bodies, capacity = width.shape[0], options.capacity
    sign = jnp.where(attempt.h < 0, -1, 1)
    base = (capacity + 1) * jnp.arange(bodies, dtype=progress_after.count.dtype)
    count, has_terminal_event = progress_after.count, jnp.zeros_like(trial.accepted)
    # an event at the start is not one of the motion
    is_at_motion_start = progress_after.elapsed <= 1e-6 * jnp.abs(width)
    # If two event functions vanish at the same time, the second one is located at the start of the
    # next step. By rounding of its margin it may then flip back and forth; these are not events.
    latest_time = jnp.maximum(jnp.maximum(jnp.abs(start), progress.elapsed), jnp.abs(attempt.h))
    is_rounding = (
        switch.fraction * jnp.abs(attempt.h) <= 16 * jnp.finfo(width.dtype).eps * latest_time
    )
    # Events are located by the search for switches; each is one more row of the margins. Only the
    # action at the root differs.
    for k in range(motion.events):
        row = motion.switches - motion.events + k
        rises = jnp.where(switch.levels[row] > 0, 1, -1) * sign
        is_event = flips[row] & ~is_at_motion_start
        is_event = is_event & ~(is_rounding & (progress.just_flipped[row] > 0))
        if options.directions[k]:
            is_event = is_event & (rises == options.directions[k])
        # lanes have no branches: a body without an event writes to its dummy row
        rows = base + jnp.where(is_event & (count < capacity), count, capacity)
        if options.terminal[k]:  # always stored: it is the end of the motion
            rows = jnp.where(is_event & (count >= capacity), base + capacity - 1, rows)
        t = start + sign * progress_after.elapsed
        # index of the event function, plus 0.5 if the function is positive after the event
        which = k + jnp.where(switch.levels[row] > 0, 0.5, 0.0).astype(t.dtype)
        storage = storage._replace(
            times=put(storage.times, rows, t[:, None]),
            which=put(storage.which, rows, which[:, None]),
            states=put(storage.states, rows, progress_after.y.T),
        )
        count = count + jnp.where(is_event, 1, 0).astype(count.dtype)
        if options.terminal[k]:
            has_terminal_event = has_terminal_event | is_event
    outcome = jnp.where(has_terminal_event, AT_EVENT, progress_after.outcome).astype(
        progress_after.outcome.dtype
    )
    return progress_after._replace(count=count, outcome=outcome), storage


def _with_coincident_switch(
    motion, progress, progress_after, rate, wrong_levels, ts, start
) -> Array:
    """The state after switches ``wrong_levels`` have flipped immediately after another one, with
    the derivative by the time of each switch that has a root of its own, such as that of a pulse
    that begins when another one ends. ``rate`` (D, B): rates before they flipped."""
    sign = jnp.where(ts[-1] < start, -1, 1).astype(rate.dtype)
    t, y = start + sign * progress_after.elapsed, progress_after.y
    flips = wrong_levels & (progress.levels != progress_after.levels)
    flips = flips & (jnp.arange(motion.switches) < motion.switches - motion.events)[:, None]

    def margins_at(t, y):
        return motion.rates(motion.coefficients, progress.levels, t, y)[1]

    margins, margin_rates = jax.jvp(margins_at, (t, y), (jnp.ones_like(t), rate))
    flips = flips & has_own_root(margins, margin_rates, jnp.abs(ts[-1] - start))
    margin_rates = jax.lax.stop_gradient(jnp.where(flips, margin_rates, 1))
    delay = jnp.sum(jnp.where(flips, -margins / margin_rates, 0), axis=0)
    rate_after = motion.rates(motion.coefficients, progress_after.levels, t, y)[0]
    delay = delay - jax.lax.stop_gradient(delay)
    return y + jnp.where(jnp.any(flips, axis=0)[None], (rate - rate_after) * delay[None], 0)


def has_own_root(margins: Array, margin_rates: Array, length: Array) -> Array:
    """Whether switches that flip immediately after another one are at roots of their own margins.
    Otherwise they flip because their argument depends on the other switch, as in a search in a
    table."""
    max_margin = control.COINCIDENT * length[None] * jnp.abs(margin_rates)
    return (margin_rates != 0) & (jnp.abs(margins) <= max_margin)


def _outcome(options, progress: Progress, is_running, length, ratio, eps) -> Array:
    """The outcome of each body: RUNNING, or the reason why it has stopped."""
    attempts = control.ATTEMPTS * options.max_steps
    spent = (progress.steps >= options.max_steps) | (progress.attempts >= attempts)
    is_too_short = ~(progress.width > control.MIN_WIDTH * eps * length)
    is_finite = jnp.isfinite(ratio) & jnp.isfinite(progress.width)
    reason = jnp.where(is_too_short, jnp.where(is_finite, STEP_TOO_SHORT, NOT_FINITE), RUNNING)
    slides = progress.reversals >= control.MAX_REVERSALS
    slides = slides | (is_too_short & is_finite & (progress.reversals >= control.SHORT_REVERSALS))
    reason = jnp.where(slides, SLIDING, reason)
    reason = jnp.where(spent, OUT_OF_STEPS, reason)
    reason = jnp.where(progress.elapsed >= length, FINISHED, reason)
    reason = jnp.where(progress.outcome == AT_EVENT, AT_EVENT, reason)
    return jnp.where(is_running, reason, progress.outcome).astype(progress.outcome.dtype)
