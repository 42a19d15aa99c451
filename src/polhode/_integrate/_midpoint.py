"""Steps of the extrapolated midpoint rule from one time to another, with error control.

The error of a step is estimated from its extrapolation table. Let e be the difference of the
results of orders p and p - 2, and d that of orders p - 2 and p - 4. In a converging table the error
falls by about the same factor from one result to the next, so that the error of the result of order
p is about e^2 / d. For random tops and gravity gradients with six decades of every parameter,
orders 8 to 16 and steps of 0.3 to 2.2 radians, the true error is 2 to 20 times as large, 4.5 times
in the median, for errors from 1e-13 to 1e-2 (``benchmarks/error_control.py``). The difference e
alone may exceed the error by a factor of up to 1,000.

If the rates do not depend explicitly on time, each body takes steps of its own, and the SIMD lane
of a finished body is given to the next one (``in_lanes``). Otherwise the bodies have common steps,
so that terms that depend on time alone are evaluated once for all of them; the body that needs the
smallest step determines the width.

Work queue: bodies that are integrated at the same time, as entries of arrays, wait for the last one
to finish. With moments, weights and rates spread over decades, 64 bodies at a time take 2.5 times
the steps that they need, and tops of one shape 1.2 times. Therefore only running bodies are in the
lanes: when a few have finished, their results are stored and the next bodies take their lanes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode import _policy
from polhode._integrate import _error_control as control
from polhode._integrate._columns import Table, add_compensated, extrapolated
from polhode._integrate._field import weighted_length
from polhode._kernels import any_of, put


class Field(NamedTuple):
    """Equations of motion of bodies that are entries of arrays; ``data``: the ``coefficients`` of
    the rates and the ``unit_data`` of the units.

    ``rates(coefficients, t, y, with_integrands)``: see ``extrapolated``. ``units(unit_data, y,
    rates)``: weights of the components of an error, whose squares are summed, and the natural rate
    [rad/s]. ``individual_steps``: whether each body takes steps of its own; the rates must then not
    depend on the time. ``by_entry``: whether a body can be replaced by another one by replacing its
    entry in all of these arrays."""

    rates: Callable[..., tuple[list[Array], list[Array]]]
    units: Callable[..., tuple[list[Array], Array]]
    data: tuple[Any, Any]
    individual_steps: bool
    by_entry: bool = False


class Limits(NamedTuple):
    """Limits of an integration: ``rtol``: the sum of errors [rad] at the time ``horizon`` [s] after
    the start; ``steps``: their maximum number; ``jumps`` (static): whether the rates may jump."""

    rtol: Array
    horizon: Array
    steps: int
    jumps: bool


class Progress(NamedTuple):
    """State of the integration from one saved time to the next; arrays of one entry a body.

    ``width``: of the next step [s], 0 if unknown; ``total_angle`` so far [rad]; ``compensation``:
    rounding errors of the state (compensated steps); ``steps``; ``rejections``; ``at_times``: steps
    shortened to end at a saved time; ``error``: sum of the estimated errors [rad]; ``elapsed``:
    time since the first start [s]; ``reason``: 0, or why the body failed: 1: the maximum number of
    steps is reached, 2: the steps became too short, 3: they did because the rates are not finite;
    ``rows``: states (n, T + 1, C) at the saved times if one call integrates through all of them;
    the last row of each body is a dummy row.
    """

    width: Array
    total_angle: Array
    compensation: list[Array]
    steps: Array
    rejections: Array
    at_times: Array
    error: Array
    elapsed: Array
    reason: Array
    rows: Array | None = None


def initial_progress(y: list[Array], compensated: bool, t: Array) -> Progress:
    """Progress before the first step."""
    zero = jnp.zeros_like(y[0])
    compensation = [jnp.zeros_like(x) for x in y] if compensated else []
    reason = jnp.zeros(zero.shape, jnp.int32)
    return Progress(zero, zero, compensation, zero, zero, zero, zero, jnp.zeros_like(t), reason)


class _SaveCursor(NamedTuple):
    """Saved states: ``place`` (n,): index of the next one of each body, ``next_time`` (n,)
    [s] after the start."""

    place: Array
    next_time: Array

    @classmethod
    def at_start(
        cls, rows: Array, save_times: Array, y: list[Array]
    ) -> tuple["_SaveCursor", Array]:
        """Before the first step: the initial state at saved times that are the start, and NaN at
        all others. ``rows`` are overwritten, since this is faster than to read them."""
        is_start = save_times <= 0
        is_set = jnp.concatenate([is_start, jnp.zeros((1,), bool)])
        nan_rows = jnp.full_like(rows, jnp.nan)
        rows = jnp.where(is_set[:, None], jnp.stack(y, axis=-1)[:, None], nan_rows)
        place = jnp.broadcast_to(jnp.sum(jnp.where(is_start, 1, 0)).astype(jnp.int32), y[0].shape)
        save_cursor = cls(place, save_times.at[place].get(mode="clip"))
        return save_cursor, rows.reshape(-1, len(y))

    def update(
        self, is_due: Array, body: Array, save_times: Array, y: list[Array], rows: Array
    ) -> tuple["_SaveCursor", Array]:
        """Store the states of the bodies that have reached their next saved time (``is_due``) in
        ``rows`` (n (T + 1), C); the others write to their dummy row."""
        unused = save_times.shape[0]

        def store_states(carry):
            save_cursor, rows, _ = carry
            row_indices = body * (unused + 1) + jnp.where(is_due, save_cursor.place, unused)
            rows = put(rows, row_indices, jnp.stack(y, axis=-1))
            place = save_cursor.place + jnp.where(is_due, 1, 0)
            return _SaveCursor(place, save_times.at[place].get(mode="clip")), rows, False

        any_due = any_of(is_due.astype(self.next_time.dtype))
        # a loop of one iteration or none, because a branch (``cond``) would copy all saved states
        return jax.lax.while_loop(lambda carry: carry[2], store_states, (self, rows, any_due))[:2]


class _Carry(NamedTuple):
    """Carry of the integration loop; every array has one entry a body."""

    attempts: Array
    elapsed: Array  # time since the start of this call
    y: list[Array]
    rates: list[Array]
    compensation: list[Array]
    integrals: list[Array]
    width: Array
    last_error: Array  # logarithm of error over tolerance of the step before
    rejected_step: tuple[Array, Array]  # error and width; 0 after an accepted step
    total_angle: Array
    error: Array
    steps: Array
    at_times: Array
    save_cursor: _SaveCursor | None


class _LoopConstants(NamedTuple):
    """Constants of the loop: ``data`` of the field; the index of each body; the reason why it
    failed before, or 0. They are not part of the carry, in which constants may crash XLA."""

    data: Any
    body: Array
    reason: Array


def integrate(
    field: Field,
    table_for: Callable[[Array], Table],
    limits: Limits,
    span: tuple[Array, Array],
    y: list[Array],
    integrals: list[Array],
    progress: Progress,
    save_times: Array | None = None,
) -> tuple[list[Array], list[Array], Progress]:
    """State and integrals at ``span[1]``, of bodies that are the entries of arrays of one shape.

    ``table_for(rate)``: the columns of a step, by the natural rates [rad/s] at the start. A body
    that needs more than ``limits.steps`` ends as NaN. ``save_times`` (T,): sorted times since the
    start [s], the last one that of the end, at which the states are saved in the ``rows`` of the
    progress. A body that has reached one continues to its next without waiting for others.
    """
    compensated, individual_steps = bool(progress.compensation), field.individual_steps
    start, end = span
    length, sign = jnp.abs(end - start), jnp.where(end < start, -1, 1)
    dtype = y[0].dtype
    eps = float(jnp.finfo(dtype).eps)
    remaining = jnp.abs(limits.horizon - progress.elapsed - length).astype(dtype)
    duration, length = length, length.astype(dtype)
    zero = jnp.zeros_like(y[0])
    start_rates, _ = field.rates(field.data[0], start, y, False)
    _, rate = field.units(field.data[1], y, start_rates)
    columns = table_for(rate)
    power = 1 / (columns.order.astype(dtype) + 1)

    def worst(x, has_failed):
        """The maximum over bodies with common steps, without failed ones; otherwise ``x``."""
        return (
            x
            if individual_steps
            else jnp.broadcast_to(jnp.max(jnp.where(has_failed, 0, x)), x.shape)
        )

    def failed_bodies(constants, carry):
        """Bodies that have used all their steps, or whose steps have become too short."""
        can_continue = (carry.steps < limits.steps) & (
            carry.width > control.MIN_WIDTH * eps * length
        )
        return ~(can_continue & (constants.reason == 0))

    def active(constants, carry):
        return (carry.elapsed < duration) & ~failed_bodies(constants, carry)

    def bound_functions(constants):
        """Rates and units of bodies."""
        coefficients, unit_data = constants.data
        return partial(field.rates, coefficients), partial(field.units, unit_data)

    def error_and_tolerance(rates, units, carry, t, h, width, end_state, result, end_rates):
        """Error of a step [rad], its tolerance, and the angle of the step [rad]."""
        (weights, rate), (end_weights, end_rate) = (
            units(carry.y, carry.rates),
            units(end_state, end_rates),
        )
        # by the larger momentum and rate of both ends: otherwise errors of a body that a torque
        # sets in motion would be measured in units of its state at rest
        weights = [jnp.minimum(a, b) for a, b in zip(weights, end_weights)]
        rate = jnp.maximum(rate, end_rate)
        difference, lower_difference = (
            weighted_length(weights, e) for e in (result.difference, result.lower_difference)
        )
        error = (
            control.CALIBRATION
            * difference
            * jnp.where(difference < lower_difference, difference / lower_difference, 1)
        )
        if limits.jumps:
            error = error + _jump_error(rates, t, h, carry, end_state, end_rates, weights)
            fall = (
                width / jnp.where(carry.rejected_step[1] > 0, carry.rejected_step[1], 1)
            ) ** columns.order
            is_rough = (carry.rejected_step[1] > 0) & (
                error > control.ROUGH_FALL * fall * carry.rejected_step[0]
            )
            error = jnp.where(
                is_rough & (error > control.ROUGH_ROUNDING * eps),
                control.ROUGH_ERROR * error,
                error,
            )
        angle = rate * width
        expected = (
            carry.total_angle
            + angle
            + rate * (length - carry.elapsed.astype(dtype) - width + remaining)
        )
        expected = jnp.maximum(expected, 1)
        fraction = jnp.minimum(carry.total_angle / expected, 1)
        first_share = control.FIRST_SHARE
        share = control.MIDPOINT_SHARE * (first_share + 3 * (1 - first_share) * fraction * fraction)
        tolerance = share * limits.rtol * angle / (expected * control.drift_divisor(expected))
        rounding = control.COMPENSATED_STEP if compensated else control.ROUNDED_STEP
        tolerance = jnp.maximum(tolerance, rounding * eps)
        is_finite = jnp.isfinite(error) & jnp.isfinite(angle)  # a long attempt may overflow
        error, tolerance = jnp.where(is_finite, error, jnp.inf), jnp.where(is_finite, tolerance, 1)
        return jax.lax.stop_gradient((error, tolerance, jnp.where(is_finite, angle, 0)))

    def step_bodies(constants, carry, rows):
        """One step of each body."""
        rates, units = bound_functions(constants)
        is_running = active(constants, carry)
        target_time = duration if carry.save_cursor is None else carry.save_cursor.next_time
        time_left = (target_time - carry.elapsed).astype(dtype)
        # the remainder is divided in two so that the last step is not much shorter than the others
        width = jnp.where(
            time_left <= carry.width, time_left, jnp.minimum(carry.width, time_left / 2)
        )
        is_cut = width < control.CUT * carry.width  # shortened to end at a time, not by rounding
        # The width is the difference of two representable times; otherwise rounding would
        # accumulate. After a rejected step it is rounded down: rounded up, it could be the same
        # step again.
        end_time = carry.elapsed + width.astype(carry.elapsed.dtype)
        # one or two units in the last place of the time
        resolution = jnp.finfo(end_time.dtype).eps * end_time
        exact_width = (end_time - carry.elapsed).astype(dtype)
        rounds_down = (exact_width > width) & (carry.rejected_step[1] > 0)
        exact_width = jnp.where(
            rounds_down, (end_time - resolution - carry.elapsed).astype(dtype), exact_width
        )
        exact_width = jnp.minimum(jnp.maximum(exact_width, resolution.astype(dtype)), time_left)
        width = jnp.where(width == time_left, time_left, exact_width)
        width = jnp.where(is_running, width, 0)
        elapsed, h = (x if individual_steps else jnp.max(x) for x in (carry.elapsed, width))
        t, h = start + sign * elapsed, sign.astype(dtype) * h
        result = extrapolated(
            rates, columns, t, h, carry.y, carry.rates, carry.integrals, compensated
        )
        compensation = carry.compensation
        end_state = result.change
        if compensated:
            end_state, compensation = add_compensated(carry.y, carry.compensation, result.change)
        end_rates, _ = rates(t + h.astype(t.dtype), end_state, False)
        error, tolerance, angle = error_and_tolerance(
            rates, units, carry, t, h, width, end_state, result, end_rates
        )
        ratio = worst(error / tolerance, failed_bodies(constants, carry))
        accepted = (ratio <= 1) & is_running
        # by logarithms: a power takes as long as three of them
        size = jnp.log(jnp.maximum(ratio, control.MIN_RATIO))
        memory = jnp.where(accepted, control.MEMORY * carry.last_error, 0)
        factor = control.SAFETY * jnp.exp(power * (memory - size))
        factor = jnp.clip(factor, control.MIN_FACTOR, control.MAX_FACTOR)
        if limits.jumps:
            # The error of a step that a jump has shortened is rounding, which does not indicate the
            # possible width.
            is_rounding = jnp.maximum(
                angle / control.SHORT_STEP, error / (control.ROUNDED_STEP * eps)
            )
            is_short = worst(is_rounding, failed_bodies(constants, carry)) < 1
            is_short = is_short & (carry.rejected_step[1] == 0)
            factor = jnp.where(accepted & is_short & ~is_cut, control.MAX_FACTOR, factor)
        proposed = jnp.where(
            accepted & is_cut, jnp.maximum(carry.width, width * factor), width * factor
        )
        proposed = jnp.where(accepted | (width > resolution.astype(dtype)), proposed, 0)
        proposed = jnp.where(is_running, proposed, carry.width)
        later_time = jnp.where(
            width == time_left, target_time, carry.elapsed + width.astype(carry.elapsed.dtype)
        )
        elapsed = jnp.where(accepted, later_time, carry.elapsed)
        save_cursor = carry.save_cursor
        if save_cursor is not None:
            is_due = accepted & (width == time_left)
            save_cursor, rows = save_cursor.update(
                is_due, constants.body, save_times, end_state, rows
            )

        def select(a, b):
            return [jnp.where(accepted, x, y) for x, y in zip(a, b)]

        rejected_step = (accepted, 0, error), (accepted, 0, width)
        carry = _Carry(
            carry.attempts + jnp.where(is_running, 1, 0).astype(dtype),
            elapsed,
            select(end_state, carry.y),
            select(end_rates, carry.rates),
            select(compensation, carry.compensation),
            _select_integrals(accepted, result.sums, carry.integrals),
            proposed,
            jnp.where(accepted, size, carry.last_error),
            tuple(jnp.where(*x) for x in rejected_step),
            carry.total_angle + jnp.where(accepted, angle, 0),
            carry.error + jnp.where(accepted, error, 0),
            carry.steps + jnp.where(accepted, 1, 0),
            carry.at_times + jnp.where(accepted & is_cut, 1, 0),
            save_cursor,
        )
        return carry, rows

    body = jnp.arange(zero.size, dtype=jnp.int32).reshape(zero.shape)
    constants = _LoopConstants(field.data, body, progress.reason)
    # half of what a smooth motion permits, or the whole duration if that is shorter
    guess = control.FIRST_WIDTH * limits.rtol.astype(dtype) ** power
    guess = guess / jnp.maximum(rate, 1 / (length + remaining))
    guess = jnp.where(progress.width > 0, progress.width, guess)  # NaN where the rates are NaN
    guess = jax.lax.stop_gradient(guess)
    if not individual_steps:
        valid_guess = jnp.where(
            guess > 0, guess, jnp.inf
        )  # a body that is not finite does not delay others
        guess = jnp.where(guess > 0, jnp.min(valid_guess), guess)
    save_cursor, rows = None, None
    if save_times is not None:
        save_cursor, rows = _SaveCursor.at_start(progress.rows, save_times, y)
    carry = _Carry(
        zero,
        jnp.zeros(zero.shape, start.dtype),
        y,
        start_rates,
        progress.compensation,
        integrals,
        guess,
        zero,
        (zero, zero),
        progress.total_angle,
        progress.error,
        progress.steps,
        progress.at_times,
        save_cursor,
    )

    def can_step(constants, carry):
        return active(constants, carry) & (carry.attempts < control.ATTEMPTS * limits.steps)

    def finish(constants, carry):
        has_finished = (carry.elapsed >= duration) & (constants.reason == 0)
        y = [jnp.where(has_finished, x, jnp.nan) for x in carry.y]
        numbers = jnp.isfinite(carry.width) & jnp.isfinite(carry.rejected_step[0])
        steps_remain = (carry.steps < limits.steps) & (
            carry.attempts < control.ATTEMPTS * limits.steps
        )
        cause = jnp.where(steps_remain, jnp.where(numbers, 2, 3), 1)
        reason = jnp.where(
            has_finished, 0, jnp.where(constants.reason > 0, constants.reason, cause)
        )
        # a float, so that it can be stacked with the other numbers
        reason = reason.astype(dtype)
        steps = carry.steps, carry.attempts, carry.at_times
        numbers = carry.width, carry.total_angle, *steps, carry.error, reason
        return y, carry.integrals, carry.compensation, numbers

    queue = (
        zero.ndim == 1 and field.by_entry and individual_steps and _policy.is_refilled(zero.size)
    )
    if queue:
        result, rows = in_lanes(step_bodies, can_step, finish, constants, carry, rows)
    else:
        carry, rows = jax.lax.while_loop(
            lambda carry: any_of(can_step(constants, carry[0]).astype(dtype)),
            lambda carry: step_bodies(constants, *carry),
            (carry, rows),
        )
        result = finish(constants, carry)
    y, integrals, compensation, (width, total_angle, steps, attempts, at_times, error, reason) = (
        result
    )
    rejections = progress.rejections + attempts - (steps - progress.steps)
    elapsed = progress.elapsed + duration
    if rows is not None and save_times is not None:
        rows = rows.reshape(zero.size, save_times.shape[0] + 1, len(y))
    reason = reason.astype(jnp.int32)
    counts = steps, rejections, at_times
    return (
        y,
        integrals,
        Progress(width, total_angle, compensation, *counts, error, elapsed, reason, rows),
    )


def _select_integrals(accepted, candidates, integrals):
    """Integrals after accepted steps. An integral over all bodies, of another shape, is accepted
    with the step that the bodies have in common."""
    return [
        jnp.where(accepted if x.shape == accepted.shape else jnp.any(accepted), x, y)
        for x, y in zip(candidates, integrals)
    ]


def _jump_error(rates, t, width, carry, end_state, end_rates, weights) -> Array:
    """Error by rates that jump close to an end of a step, which the error estimate cannot detect.

    The midpoint rule does not evaluate the rates between an end of a step and its first or last
    substep, and repeated rejections near a jump shorten the step until the jump lies there. Here
    the rates are sampled along a straight line, the tangent at the start or the chord at the end.
    Differences of smooth rates fall with their order; those of rates that jump do not. On such a
    line the rates of a free body are quadratic in the distance, so that third and fourth
    differences show a weak jump.
    """
    gap = control.JUMP_GAP * width
    eps = float(jnp.finfo(width.dtype).eps)

    def select(at_end, a, b):
        return [jnp.where(at_end, y, x) for x, y in zip(a, b)]

    def add_end(end, total):
        """Add the error at one end: 0, the start, or 1. Loops over ends and samples, so that the
        program contains the rates once."""
        at_end = end == 1
        base, base_rates = (
            select(at_end, carry.y, end_state),
            select(at_end, carry.rates, end_rates),
        )
        # forward along the tangent at the start, backward along the chord at the end
        chord = [a - b for a, b in zip(carry.y, end_state)]
        sample_step = [gap * f for f in carry.rates]
        sample_step = select(at_end, sample_step, [control.JUMP_GAP * x for x in chord])
        start, sign = jnp.where(at_end, t + width, t), jnp.where(at_end, -1, 1)

        def further(k, result):
            """Backward differences of order 0, 1, ... at sample ``k``, and the sizes of those of
            order 3 and 4, each taken at the sample of its own order."""
            older_rows, sizes = result
            k = k.astype(width.dtype)
            time = (start + sign * k * gap).reshape(-1)[0]
            row = rates(time, [a + k * b for a, b in zip(base, sample_step)], False)[0]
            rows = [row]
            for older in older_rows:
                row = [a - b for a, b in zip(row, older)]
                rows.append(row)
            lengths = [weighted_length(weights, x) for x in rows[1:]]
            sizes = [jnp.where(k == n, x, y) for n, x, y in zip((3, 4), lengths[2:], sizes)]
            return rows[:4], sizes

        zero = [jnp.zeros_like(x) for x in base_rates]
        sizes = [jnp.zeros_like(total)] * 2
        _, sizes = jax.lax.fori_loop(1, 5, further, ([base_rates, zero, zero, zero], sizes))
        third, fourth = sizes
        noise = control.JUMP_NOISE * eps * weighted_length(weights, base_rates)
        jumps = fourth > jnp.maximum(control.JUMP_RATIO * third, noise)
        return total + jnp.where(jumps, fourth * jnp.abs(5 * gap), 0)

    return jax.lax.fori_loop(0, 2, add_end, jnp.zeros_like(carry.width))


def in_lanes(
    step: Callable[..., Any],
    can_step: Callable[..., Array],
    finish: Callable[..., Any],
    constants: Any,
    carry: Any,
    rows: Any,
) -> tuple[Any, Any]:
    """Integrate a queue of n bodies in a fixed number of lanes, which are refilled.

    Returns ``finish(constants, carry)`` of every body after its last step, and the ``rows``.

    - ``step(constants, carry, rows)``: ``carry`` and ``rows`` after one step of the bodies in the
      lanes;
    - ``can_step(constants, carry)``: whether each body continues; False if its ``carry`` is zero;
    - ``carry``: arrays (n,);
    - ``constants``: arrays (n,) and numbers that no step changes, among them ``constants.body``,
      the index of each body;
    - ``rows``: data common to all bodies, such as saved states.
    """
    n = constants.body.size
    # no more lanes than needed for the same number of bodies in each lane, a multiple of 8
    lane_count = -(-n // -(-n // _policy.LANES))
    lane_count += -lane_count % 8
    parts, tree = jax.tree.flatten(constants)
    constant_arrays = [x for x in parts if x.shape == (n,)]
    carry_arrays, carry_tree = jax.tree.flatten(carry)
    endings, result_tree = jax.tree.flatten(finish(constants, carry))
    queue = _stacked(constant_arrays), _stacked(carry_arrays)

    def constants_of(fixed_rows):
        """The constants of the bodies in the lanes."""
        lane_rows = iter(_with_dtypes(constant_arrays, fixed_rows))
        return jax.tree.unflatten(tree, [next(lane_rows) if x.shape == (n,) else x for x in parts])

    def refill(loop):
        """Store the results of the finished bodies and refill their lanes."""
        fixed_rows, carry, results, next_body, _ = loop
        constants = constants_of(fixed_rows)
        is_finished = ~can_step(constants, carry)
        endings = _stacked(jax.tree.leaves(finish(constants, carry)))
        results = put(results, constants.body, endings.T)
        lane = jnp.arange(lane_count)
        rank = jnp.sum(jnp.where((lane[:, None] > lane[None]) & is_finished[None], 1, 0), axis=1)
        index = next_body + rank
        is_refilled = is_finished & (index < n)
        next_constants, start = (x.at[:, index].get(mode="clip") for x in queue)
        start = jax.tree.unflatten(carry_tree, _with_dtypes(carry_arrays, start))
        carry = jax.tree.map(lambda a, b: jnp.where(is_refilled, a, b), start, carry)
        count = jnp.sum(jnp.where(is_finished, 1, 0))
        # n: the queue is empty; n + 1: all results are stored, and do not change while other queues
        # of a batch continue (under ``vmap``)
        is_last = (count == lane_count) & (next_body >= n)
        next_body = jnp.where(is_last, n + 1, jnp.minimum(next_body + count, n))
        return jnp.where(is_refilled, next_constants, fixed_rows), carry, results, next_body, False

    def iterate(loop):
        fixed_rows, carry, results, next_body, rows = loop
        idle_count = jnp.sum(jnp.where(can_step(constants_of(fixed_rows), carry), 0, 1))
        needs_refill = (idle_count >= _policy.REFILL_LANES) & (next_body < n) | (
            idle_count == lane_count
        )
        # a loop of one iteration or none, because a branch (``cond``) would copy all its results
        start = fixed_rows, carry, results, next_body, any_of(jnp.where(needs_refill, 1.0, 0.0))
        fixed_rows, carry, results, next_body, _ = jax.lax.while_loop(lambda c: c[4], refill, start)
        carry, rows = step(constants_of(fixed_rows), carry, rows)
        return fixed_rows, carry, results, next_body, rows

    # At the start every lane has a finished body of zeros; its results are overwritten later.
    fixed_rows, start = (jnp.zeros((len(x), lane_count), x.dtype) for x in queue)
    carry = jax.tree.unflatten(carry_tree, _with_dtypes(carry_arrays, start))
    results = jnp.zeros_like(_stacked(endings).T)
    start = fixed_rows, carry, results, jnp.zeros((), int), rows
    *_, results, _, rows = jax.lax.while_loop(
        lambda loop: any_of(jnp.where(loop[3] <= n, 1.0, 0.0)), iterate, start
    )
    return jax.tree.unflatten(result_tree, _with_dtypes(endings, results.T)), rows


def _stacked(arrays: list[Array]) -> Array:
    """Arrays as the rows of a matrix: one gather from it compiles faster than one for each array.
    Integers (indices of bodies and small numbers) are exact as floats."""
    floats = [x.dtype for x in arrays if jnp.issubdtype(x.dtype, jnp.floating)]
    widest = max(floats, key=lambda dtype: dtype.itemsize)
    return jnp.stack([x.astype(widest) for x in arrays])


def _with_dtypes(like: list[Array], rows: Array) -> list[Array]:
    """The rows of a matrix with the dtypes of the arrays that were stacked."""
    return [row.astype(x.dtype) for x, row in zip(like, rows)]
