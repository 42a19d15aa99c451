"""Derivatives of the steps of ``_iteration.py``, in both modes, through the switches that end them.

With fixed levels a step is a smooth map, and its derivative is that of an ordinary Runge-Kutta step
of fixed width. At a switch, at the time tau, the rates change from f to f'. A small change of the
state before the switch shifts tau by d tau, and thereby adds ``(f - f') d tau`` to the change of
the state after it (the saltation term of piecewise smooth systems: M. di Bernardo et al.,
Piecewise-smooth Dynamical Systems (2008), section 2.5). Without this term derivatives through a
jump are wrong at any step width, and those through a kink by about the square root of the
tolerance.

*Forward mode* differentiates the loop; the time of each switch gets its derivative from two steps
of Newton's method. *Reverse mode* processes recorded steps (state, levels and time) in reverse
order. The first ``RECORDED_ITERATIONS`` iterations of the loop are recorded while the values are
computed. If there are more, the motion is integrated once more: the maximum number of attempts is
divided into ``RECORD_SEGMENTS`` equal segments, and the carry of the loop is stored at the start of
each (checkpoint). Only one segment is recorded at a time, so that all segments but the last are
integrated a third time. Full records of all steps would take 100 times the memory; a checkpoint at
every 16th step would take one more integration of all steps.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.interpreters import ad
from jaxtyping import Array

from polhode import _policy
from polhode._integrate import _error_control as control
from polhode._integrate._explicit_step import (
    Motion,
    Progress,
    column,
    dense_of,
    dense_state,
    in_parts,
    weighted,
)
from polhode._integrate._field import REVERSE_ONCE
from polhode._integrate._iteration import FINISHED, advance, has_own_root, min_snap_time
from polhode._integrate._loop import (
    MakeMotion,
    Note,
    Solved,
    broadcast_times,
    compact,
    empty_rows,
    initial_carry,
    is_any_running,
    note_of,
    run,
    solve,
    with_row,
)
from polhode._kernels import (
    any_of,
    is_nonzero_tangent,
    kernel,
    linear,
    max_over_batch,
    with_derivative_rule,
    zeros,
)


def samples(
    make_motion: MakeMotion,
    arrays,
    unit_data,
    y,
    start,
    ts,
    states: Array,
    solved: Solved,
    iterations: int = 0,
    first_order_only: bool = False,
) -> tuple[Array, Solved]:
    """``states`` with their derivatives, and ``solved``.

    ``states`` (B, T, D): samples at ``ts`` (T,) or (B, T), in any order, of the motion from ``y``
    (D, B) at ``start`` () or (B,). In a program that computes derivatives and with ``iterations``,
    both come from an integration that records the first ``iterations`` iterations.
    ``first_order_only``: raise an error for second derivatives."""
    leaves, tree = jax.tree.flatten(unit_data)
    size, end = len(arrays), len(arrays) + len(leaves)

    def problem_of(operands, differentiable=False):
        unit_data = jax.tree.unflatten(tree, operands[size:end])
        return make_motion(operands[:size], unit_data, differentiable)

    def recompute(operands):
        *inputs, y, start, ts = operands
        unit_data = jax.tree.unflatten(tree, inputs[size:])
        solved, record = solve(make_motion, inputs[:size], unit_data, start, ts, y, iterations)
        return [solved.states, *jax.tree.leaves(solved._replace(samples=None))], record

    def rule(operands, tangents, values, record=None):
        *inputs, y, start, ts = operands
        *input_tangents, dy, dstart, dts = tangents
        motion, _ = problem_of(inputs)
        starts, rows = broadcast_times(start, ts, y.shape[1])
        order = None
        states, ordered_ts = values[0], ts
        # The times of a body may be in any order (`Trajectory.at`); the loop needs them sorted.
        if ts.ndim > 1:
            sign = jnp.where(ts[:, -1:] < jnp.reshape(start, (-1, 1)), -1, 1).astype(ts.dtype)
            order = jnp.argsort(jax.lax.stop_gradient(sign * ts), axis=1)
            ordered_ts = jnp.take_along_axis(ts, order, axis=1)
            states = jnp.take_along_axis(states, order[..., None], axis=1)
        at = [i for i, x in enumerate(input_tangents[:size]) if is_nonzero_tangent(x)]
        dy = dy if is_nonzero_tangent(dy) else zeros(dy)
        # Derivatives by times need no integration: a change of the start time is equivalent to a
        # change of the initial state against the rates, and a sample moves along the rates.
        if is_nonzero_tangent(dstart):
            dy = dy - dstart * _rates(motion, starts[None], y[None])[0]
        recorded, record_tree = jax.tree.flatten(record)
        count = len(operands)

        def tangent(constants, tangents):
            return _tangent(problem_of, at, _checked(constants[:count], first_order_only), tangents)

        def cotangent(constants, cotangents):
            record = jax.tree.unflatten(record_tree, constants[count:])
            primals = _checked(constants[:count], first_order_only)
            return _cotangent(problem_of, at, primals, record, cotangents[0])

        change = linear(
            tangent,
            cotangent,
            [*inputs, y, start, ordered_ts, *recorded],
            [dy, *(input_tangents[i] for i in at)],
            [states],
            partial(kernel, of_units=True) if motion.is_fusible else None,
            REVERSE_ONCE,
        )
        if order is not None:
            place = jnp.argsort(order, axis=1)[..., None]
            change = [jnp.take_along_axis(change[0], place, axis=1)]
        if is_nonzero_tangent(dts):
            rate = _rates(motion, rows, jnp.moveaxis(values[0], 0, -1))
            dtimes = broadcast_times(start, dts, y.shape[1])[1]
            change = [change[0] + jnp.moveaxis(dtimes[:, None] * rate, -1, 0)]
        return change

    other_results, result_tree = jax.tree.flatten(solved._replace(samples=None))
    operands, values = [*arrays, *leaves, y, start, ts], [states, *other_results]
    states, *other_results = with_derivative_rule(
        rule, operands, values, recompute if iterations else None
    )
    return states, jax.tree.unflatten(result_tree, other_results)


def segment_iterations(max_steps: int) -> int:
    """Iterations of the loop from one checkpoint to the next."""
    return -(-control.ATTEMPTS * max_steps // _policy.RECORD_SEGMENTS)


def _is_differentiated(operands) -> bool:
    return any(isinstance(x, ad.JVPTracer) for x in operands)


def _checked(operands, first_order_only: bool):
    """The operands of a derivative; raises an error if ``first_order_only`` and they are
    differentiated again."""
    if first_order_only and _is_differentiated(operands):
        raise NotImplementedError(
            "second derivatives of steps that pass kinks or jumps are wrong: leave"
            " method=ph.CoarseSteps() out, so that the steps end there."
        )
    return operands


def _rates(motion: Motion, ts: Array, states: Array) -> Array:
    """Rates (T, D, B) at times (T, B) and states (T, D, B)."""

    def rates_at(point):
        t, y = point
        return motion.rates(motion.coefficients, motion.levels(motion.arguments, t, y), t, y)[0]

    return jax.lax.map(rates_at, (ts, states))


def _tangent(problem_of, at, primals, tangents):
    """Tangents (B, T, D) of the samples."""
    *arrays, y, start, ts = primals
    dy, *parameter_tangents = tangents

    def path(y, *parameters):
        inputs = list(arrays)
        for i, x in zip(at, parameters):
            inputs[i] = x
        motion, options = problem_of(inputs, True)
        _, rows, _ = run(motion, options, *broadcast_times(start, ts, y.shape[1]), y)
        return rows.samples.reshape(y.shape[1], ts.shape[-1] + 1, -1)[:, :-1]

    def tangent(primals, tangents):
        return jax.jvp(path, primals, tangents)[1]

    parameters = tuple(arrays[i] for i in at)
    return [kernel(tangent)((y, *parameters), (dy, *parameter_tangents))]


def _cotangent(problem_of, at, primals, record, cotangents):
    """Cotangents of the state at the start and of ``arrays[i]``, i in ``at``."""
    *arrays, y, start, ts = primals
    start, times = broadcast_times(start, ts, y.shape[1])
    cotangents = jnp.moveaxis(cotangents, 0, -1)  # (T, D, B)
    parameters = [arrays[i] for i in at]

    # Second derivatives need derivatives of the times of switches, which the record does not have.
    differentiable = _is_differentiated(primals)
    record = None if differentiable else record

    def coefficients_of(*parameters):
        inputs = list(arrays)
        for i, x in zip(at, parameters):
            inputs[i] = x
        coefficients = problem_of(inputs, differentiable)[0].coefficients
        return [x for x in coefficients if jnp.issubdtype(x.dtype, jnp.inexact)]

    motion, options = problem_of(arrays, differentiable)
    floats = [k for k, x in enumerate(motion.coefficients) if jnp.issubdtype(x.dtype, jnp.inexact)]
    # Cotangents of the loop's coefficients are summed over steps and bodies as they arise, so that
    # weights of a network common to all bodies have one cotangent. At the end they are pulled back
    # to the parameters, once.
    _, pullback = jax.vjp(coefficients_of, *parameters)
    sums = [jnp.zeros_like(motion.coefficients[k]) for k in floats]

    def backward(coefficients, arguments, unit_data, *operands):
        bound_motion = motion._replace(
            coefficients=coefficients, arguments=arguments, unit_data=unit_data
        )
        return _backward(bound_motion, options, floats, *operands)

    y_cotangent, sums = (kernel(backward) if motion.is_fusible else backward)(
        motion.coefficients,
        motion.arguments,
        motion.unit_data,
        start,
        times,
        y,
        cotangents,
        sums,
        record,
    )
    return [y_cotangent, *pullback(sums)]


def _backward(motion, options, floats, start, times, y, cotangents, sums, record):
    """Cotangents of the state at the start and of the floats among ``motion.coefficients``."""
    first_progress, rows = initial_carry(motion, options, start, times[-1:], y)
    end = times[-1:]
    length = segment_iterations(options.max_steps)

    def checkpoint_of(progress):
        """The carry as a checkpoint, without rates and margins. These are evaluated again at the
        start of a segment, in both integrations, so that both take the same steps. All numbers are
        in one array, because each array of a checkpoint takes three operations in every
        iteration."""
        numbers = [progress._asdict()[name].astype(y.dtype) for name in _NUMBERS]
        levels, just_flipped = (
            compact(motion, x) for x in (progress.levels, progress.just_flipped)
        )
        return jnp.concatenate([progress.y, jnp.stack(numbers)]), levels, just_flipped

    def from_checkpoint(checkpoint):
        rows, *switches = checkpoint
        levels, just_flipped = (x.astype(y.dtype) for x in switches)
        like = first_progress._asdict()
        numbers = {
            name: row.astype(like[name].dtype)
            for name, row in zip(_NUMBERS, rows[y.shape[0] :], strict=True)
        }
        return first_progress._replace(
            y=rows[: y.shape[0]], levels=levels, just_flipped=just_flipped, **numbers
        )

    def entry(rows, k):
        return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, k, 0, False), rows)

    def select(where, a, b):
        return jax.tree.map(lambda a, b: jnp.where(where, a, b), a, b)

    def iterate(carry):
        progress, checkpoints, notes, count = carry
        number, place = count // length, count % length
        is_segment_start = place == 0
        progress = progress._replace(needs_rates=progress.needs_rates | is_segment_start)
        checkpoint = select(is_segment_start, checkpoint_of(progress), entry(checkpoints, number))
        checkpoints = with_row(checkpoints, number, checkpoint)
        notes = with_row(notes, place, note_of(motion, progress))
        progress, _ = advance(motion, options, start, end, progress, rows)
        return progress, checkpoints, notes, count + 1

    def replace_failed(finished, note):
        # The rates of a body that failed may be NaN, and zero cotangents times NaN would be added
        # to coefficients shared with other bodies. Its state is replaced by that of a body that
        # finished.
        index = jnp.arange(finished.shape[0])  # not argmax, which a fused kernel cannot contain
        finished_body = jnp.min(jnp.where(finished, index, finished.shape[0] - 1))
        return jax.tree.map(
            lambda x: jnp.where(finished, x, x[..., finished_body][..., None]), note
        )

    # In its first iteration this loop integrates to the end of the motion, and processes the last
    # segment. In the following ones it integrates earlier segments again, each from its checkpoint.
    def segment(carry):
        number, count, stop, checkpoints, notes, finished, after, later_levels, *sums_so_far = carry
        progress, checkpoints, notes, count = jax.lax.while_loop(
            lambda c: is_any_running(c[0]) & (c[3] < stop),
            iterate,
            (from_checkpoint(entry(checkpoints, number)), checkpoints, notes, count),
        )
        is_last = stop == _NEVER
        finished = jnp.where(is_last, progress.outcome == FINISHED, finished)
        after = select(is_last, replace_failed(finished, note_of(motion, progress)), after)
        if motion.jumps:
            later_levels = jnp.where(is_last, after.levels, later_levels)
        number = (count - 1) // length
        iterations = count - number * length

        def reverse(i, carry):
            index = iterations - 1 - i
            note = entry(notes, index)
            if record is not None:
                note = select(index < recorded_iterations, note, record.last)
            note = replace_failed(finished, note)
            return _reverse_step(motion, floats, start, times, cotangents, finished, note, *carry)

        carry = jax.lax.fori_loop(0, iterations, reverse, (after, later_levels, *sums_so_far))
        first = number * length
        return number - 1, first - length, first, checkpoints, notes, finished, *carry

    checkpoint = checkpoint_of(first_progress)
    note = note_of(motion, first_progress)
    notes, count = empty_rows(length, note), jnp.zeros((), jnp.int32)
    if record is not None:
        # If all iterations are recorded, integration starts with every body stopped and takes none.
        capacity = record.notes.elapsed.shape[0]
        is_complete = max_over_batch(record.iterations) <= capacity
        # Under ``vmap``, chunks of bodies may have been integrated one after another, with
        # different numbers of iterations. After its last iteration a chunk does not change.
        recorded_iterations = jnp.where(is_complete, record.iterations, _NEVER)
        notes = jax.tree.map(lambda x, r: jnp.concatenate([r, x[capacity:]]), notes, record.notes)
        count = jnp.where(is_complete, max_over_batch(record.iterations), 0)
        levels = record.last.levels.astype(y.dtype)
        after_all = first_progress._replace(
            **record.last._replace(levels=levels)._asdict(), outcome=record.outcome
        )
        checkpoint = select(is_complete, checkpoint_of(after_all), checkpoint)
    checkpoints = with_row(
        empty_rows(_policy.RECORD_SEGMENTS, checkpoint), jnp.zeros_like(count), checkpoint
    )
    carry = (
        jnp.zeros_like(count),
        count,
        jnp.full_like(count, _NEVER),
        checkpoints,
        notes,
        jnp.zeros(start.shape, bool),
        note,
        note.levels if motion.jumps else None,
        jnp.zeros_like(y),
        sums,
        jnp.full(start.shape, times.shape[0] - 1, jnp.int32),
    )
    carry = jax.lax.while_loop(lambda c: c[2] > 0, segment, carry)
    *_, finished, _, _, cotangent, sums, _ = carry
    # zero, or NaN where the cotangents are NaN, as they are if no body of the call finished
    zero_or_nan = 0 * jnp.sum(cotangents[0] + cotangents[-1], axis=0)
    any_finished = jnp.sum(jnp.where(finished, 1, 0)) > 0
    return (
        jnp.where(finished[None], cotangent, zero_or_nan),
        [jnp.where(any_finished, x, jnp.sum(zero_or_nan).astype(x.dtype)) for x in sums],
    )


_NEVER = jnp.iinfo(jnp.int32).max
"""A number of iterations that no motion takes."""

_ARRAYS = "y", "rate", "levels", "margin", "just_flipped"
_NUMBERS = tuple(name for name in Progress._fields if name not in _ARRAYS)
"""Fields of the carry of the loop that are one number for each body."""


def _reverse_step(
    motion,
    floats,
    start,
    times,
    cotangents,
    finished,
    note: Note,
    after: Note,
    later_levels,
    cotangent,
    sums,
    place,
):
    """From cotangents after an iteration of the loop to those before it.

    ``later_levels``: the levels with which the motion continues from ``after``, including
    corrections of levels that depend on the switch that flipped (of a search in a table every
    comparison but the first); ``place`` (B,): index of the last sample that has not been processed
    yet."""
    levels = note.levels.astype(cotangent.dtype)
    sign = jnp.where(times[-1] < start, -1, 1).astype(cotangent.dtype)
    t = start + sign * note.elapsed
    h = sign * (after.elapsed - note.elapsed)
    has_flipped = jnp.any(note.levels != after.levels, axis=0)
    # At a switch beyond which the field is undefined, the state moves without a step: see `_snap`
    # in `_iteration.py`.
    length, eps = jnp.abs(times[-1] - start), float(jnp.finfo(cotangent.dtype).eps)
    is_snap = has_flipped & (jnp.abs(h) <= 2 * min_snap_time(note.elapsed, length, eps))
    active = finished & ((h != 0) | has_flipped)
    end = t + h
    h = jnp.where(active & ~is_snap, h, 0)

    def rates_of(parameters, levels, t, y):
        coefficients = list(motion.coefficients)
        for k, x in zip(floats, parameters):
            coefficients[k] = x
        return motion.rates(coefficients, levels, t, y)

    values = [motion.coefficients[k] for k in floats]
    if motion.jumps:
        jump, parameter_cotangents, is_correction = _switch_cotangents(
            rates_of,
            values,
            motion,
            note,
            after,
            later_levels,
            end,
            length,
            cotangent,
            active,
            is_snap,
        )
        later_levels = jnp.where(is_correction[None], later_levels, note.levels)
        cotangent, sums = cotangent + jump, [a + b for a, b in zip(sums, parameter_cotangents)]

    def has_sample(place):
        sample_time = jnp.abs(column(times, place) - start)
        return (
            active & (place >= 0) & (h != 0) & ((sample_time > note.elapsed) | (note.elapsed == 0))
        )

    rule, dtype = motion.rule, cotangent.dtype
    table, nodes = in_parts(rule.weights, dtype), jnp.asarray(rule.nodes, dtype)
    stage_count = jnp.where(
        any_of(jnp.where(has_sample(place), 1.0, 0.0)), rule.dense_stages, rule.stages - 1
    )

    # The stages are evaluated again from the state, because a record of them would multiply the
    # memory by their number. The residuals of their derivatives are stored for this step: to
    # evaluate the stages a third time would take a tenth to a sixth of the time of gradients
    # through networks.
    rebuild: list[Callable] = []

    def linearised(i, rates):
        y = note.y + h[None] * weighted([part[i] for part in table], rates)
        rate, pullback = jax.vjp(
            lambda parameters, y: rates_of(parameters, levels, t + nodes[i] * h, y)[0], values, y
        )
        arrays, build = _stacked_residuals(pullback, [*values, levels, t, h])
        rebuild.append(build)  # the same in every trace
        return rate, arrays

    def stage(i, carry):
        rates, residuals = carry
        rate, arrays = linearised(i, rates)
        update = jax.lax.dynamic_update_index_in_dim
        residuals = [update(rows, x, i, 0) for rows, x in zip(residuals, arrays, strict=True)]
        return update(rates, rate, i, 0), residuals

    buffers = jnp.zeros((rule.dense_stages, *cotangent.shape), cotangent.dtype)
    _, shapes = jax.eval_shape(linearised, 0, buffers)
    residuals = [jnp.zeros((rule.dense_stages, *x.shape), x.dtype) for x in shapes]
    _, residuals = jax.lax.fori_loop(0, stage_count, stage, (buffers, residuals))

    def sample(carry):
        place, cotangent, bars = carry
        in_step = has_sample(place)
        x = jnp.abs(column(times, place) - start) - note.elapsed
        x = jnp.minimum(x / jnp.where(h != 0, jnp.abs(h), 1), 1)
        _, pullback = jax.vjp(lambda y, k: dense_state(y, dense_of(h, k, rule), x), note.y, buffers)
        y_cotangent, stage_cotangents = pullback(
            jnp.where(in_step[None], column(cotangents, place), 0)
        )
        return (
            place - jnp.where(in_step, 1, 0).astype(place.dtype),
            cotangent + y_cotangent,
            bars + stage_cotangents,
        )

    # Reverse mode of the Runge-Kutta method: `bars` are the cotangents of the rates of the stages.
    # The result of the step contributes its weights, samples those of dense output, and each stage,
    # from the last to the first, contributes to the stages from which it was computed.
    bars = h[None, None] * cotangent[None] * table[0][rule.stages - 1][:, None, None]
    initial_cotangent = jnp.where(finished[None], cotangent, 0)
    place, cotangent, bars = jax.lax.while_loop(
        lambda c: any_of(jnp.where(has_sample(c[0]), 1.0, 0.0)),
        sample,
        (place, initial_cotangent, bars),
    )

    def reverse_stage(j, carry):
        bars, cotangent, sums = carry
        i = stage_count - 1 - j
        bar = jax.lax.dynamic_index_in_dim(bars, i, 0, False)
        pullback = rebuild[-1](
            [jax.lax.dynamic_index_in_dim(rows, i, 0, False) for rows in residuals]
        )
        parameter_cotangents, change = pullback(bar)
        bars = bars + (h[None] * change)[None] * table[0][i][:, None, None]
        return (bars, cotangent + change, [a + b for a, b in zip(sums, parameter_cotangents)])

    _, cotangent, sums = jax.lax.fori_loop(0, stage_count, reverse_stage, (bars, cotangent, sums))
    return note, later_levels, cotangent, sums, place


def _stacked_residuals(linear_map, shared_arrays: list[Array]) -> tuple[list[Array], Callable]:
    """The arrays in a linear map of ``jax.vjp`` (its residuals) without those in ``shared_arrays``,
    and a function that builds the map from them. Arrays of one shape are stacked: a field written
    in components has about a hundred of them, each with one number for every body."""
    leaves, structure = jax.tree.flatten(linear_map)
    numbers = {id(x): k for k, x in enumerate(shared_arrays)}
    residuals = [x for x in leaves if id(x) not in numbers]
    kinds = list(dict.fromkeys((x.shape, x.dtype) for x in residuals))
    groups = [[x for x in residuals if (x.shape, x.dtype) == kind] for kind in kinds]

    def rebuild(stacks):
        rows = [iter([stack[i] for i in range(stack.shape[0])]) for stack in stacks]
        arrays = [
            shared_arrays[numbers[id(x)]]
            if id(x) in numbers
            else next(rows[kinds.index((x.shape, x.dtype))])
            for x in leaves
        ]
        return jax.tree.unflatten(structure, arrays)

    return [jnp.stack(group) for group in groups], rebuild


def _switch_cotangents(
    rates_of,
    values,
    motion,
    note: Note,
    after: Note,
    later_levels,
    t,
    length,
    cotangent,
    active,
    is_snap,
):
    """Contribution of the time of a switch to the cotangents of the state and of ``values`` (the
    saltation term). Also whether the iteration corrected levels that depend on the switch before,
    whose contribution includes theirs."""
    flips = note.levels != after.levels
    flips = jnp.where(jnp.any(flips, axis=0), flips, after.levels != later_levels)
    # events do not change the rates
    affects_rates = jnp.arange(motion.switches) < motion.switches - motion.events
    flips = flips & affects_rates[:, None]
    # beyond the switch the field with the previous levels may be undefined
    y_before = jnp.where(is_snap[None], note.y, after.y)
    rates_before, *_ = rates_of(values, note.levels, t, y_before)
    margins, margin_rates = jax.jvp(
        lambda t, y: rates_of(values, note.levels, t, y)[1],
        (t, y_before),
        (jnp.ones_like(t), rates_before),
    )
    stands_alone = jnp.any(flips & has_own_root(margins, margin_rates, length), axis=0)
    is_correction = (after.elapsed == note.elapsed) & (note.elapsed > 0) & ~stands_alone
    flips = flips & (active & ~is_correction)[None]
    weights = jnp.where(flips, 1, 0).astype(cotangent.dtype)
    weights = weights / jnp.maximum(jnp.sum(weights, axis=0, keepdims=True), 1)
    # Switches that flip together contribute equal shares: their margins vanish at the same time
    # only if the same comparison occurs several times, or by symmetry.
    rates_after, *_ = rates_of(values, later_levels, t, after.y)

    def margin(parameters, t, y):
        return jnp.sum(
            jnp.where(flips, weights * rates_of(parameters, note.levels, t, y)[1], 0), axis=0
        )

    margin_rate = jnp.sum(jnp.where(flips, weights * margin_rates, 0), axis=0)
    # If the margin has zero time derivative at its root (grazing), the time of the switch has no
    # derivative; it is treated as fixed.
    crosses_surface = jnp.any(flips, axis=0) & (margin_rate != 0)
    weight = jnp.sum(cotangent * (rates_after - rates_before), axis=0) / jnp.where(
        crosses_surface, margin_rate, 1
    )
    _, pullback = jax.vjp(lambda parameters, y: margin(parameters, t, y), values, y_before)
    parameter_cotangents, state_cotangent = pullback(jnp.where(crosses_surface, weight, 0))
    return state_cotangent, parameter_cotangents, is_correction
