"""Derivatives of the steps of ``_loop.py``, both ways, through the switches that end them.

With its levels held a step is a smooth map, and its derivative is that of an ordinary Runge-Kutta
step of fixed width. Where a switch turns at the time tau, the rates change from f to f', and a
small change of the state before it, which shifts tau by d tau, is followed by one of
``(f - f') d tau`` more (the saltation of piecewise smooth systems: M. di Bernardo et al.,
Piecewise-smooth Dynamical Systems (2008), section 2.5). Without this term derivatives through a
jump are wrong at any step width.

*Forward*, the loop itself is differentiated, with the place of each switch by two steps of Newton's
rule. *Backward*, the loop is run again and its state kept at ``KEPT`` turns, each second one of
which is dropped whenever there is no more room; from one to the next it is run once more, its steps
noted, and these are passed in reverse order.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.interpreters import ad
from jaxtyping import Array

from polhode._integrate._dop853 import DENSE_STAGES, NODES, STAGES, WEIGHTS
from polhode._integrate._loop import (
    ARRIVED,
    UNDER_WAY,
    Make,
    Motion,
    Walk,
    advance,
    begin,
    column,
    dense_of,
    dense_state,
    each_body,
    run,
    weighted,
)
from polhode._kernels import any_of, attached, is_slope, kernel, linear, zeros

KEPT = 128
"""Turns of the loop whose state is kept."""


def samples(make: Make, arrays, told, y, start, ts, found) -> Array:
    """``found`` (B, T, D), samples at ``ts`` (T,) or (B, T) of the motion from ``y`` (D, B) at
    ``start`` () or (B,), with their derivatives. Times of one body may stand in any order."""
    leaves, tree = jax.tree.flatten(told)
    size, extra = len(arrays), len(leaves)

    def opened(given, linked=False):
        told = jax.tree.unflatten(tree, given[size : size + extra])
        return make(given[:size], told, linked)

    def rule(operands, tangents, values):
        *fixed, y, start, ts = operands
        *more, dy, dstart, dts = tangents
        motion, _ = opened(fixed)
        starts, rows = each_body(start, ts, y.shape[1])
        at = [i for i, x in enumerate(more[:size]) if is_slope(x)]
        dy = dy if is_slope(dy) else zeros(dy)
        if is_slope(dstart):
            dy = dy - dstart * _rates(motion, starts[None], y[None])[0]
        change = linear(
            lambda given, moved: _tangent(opened, at, given, moved),
            lambda given, slopes: _cotangent(opened, at, given, slopes[0]),
            list(operands),
            [dy, *(more[i] for i in at)],
            values,
        )
        if is_slope(dts):
            rate = _rates(motion, rows, jnp.moveaxis(values[0], 0, -1))
            late = each_body(start, dts, y.shape[1])[1]
            change = [change[0] + jnp.moveaxis(late[:, None] * rate, -1, 0)]
        return change

    order = None
    if ts.ndim > 1:
        sign = jnp.where(ts[:, -1:] < jnp.reshape(start, (-1, 1)), -1, 1).astype(ts.dtype)
        order = jnp.argsort(jax.lax.stop_gradient(sign * ts), axis=1)
        ts = jnp.take_along_axis(ts, order, axis=1)
        found = jnp.take_along_axis(found, order[..., None], axis=1)
    (found,) = attached(rule, [*arrays, *leaves, y, start, ts], [found])
    if order is None:
        return found
    return jnp.take_along_axis(found, jnp.argsort(order, axis=1)[..., None], axis=1)


def _rates(motion: Motion, ts: Array, states: Array) -> Array:
    """Rates (T, D, B) at times (T, B) and states (T, D, B)."""

    def one(given):
        t, y = given
        return motion.rates(motion.held, motion.levels(motion.known, t, y), t, y)[0]

    return jax.lax.map(one, (ts, states))


def _tangent(opened, at, given, moved):
    """Changes (B, T, D) of the samples."""
    *arrays, y, start, ts = given
    dy, *some = moved

    def path(y, *some):
        full = list(arrays)
        for i, x in zip(at, some):
            full[i] = x
        motion, wanted = opened(full, True)
        _, rows = run(motion, wanted, *each_body(start, ts, y.shape[1]), y)
        return rows.samples.reshape(y.shape[1], ts.shape[-1] + 1, -1)[:, :-1]

    return [jax.jvp(path, (y, *(arrays[i] for i in at)), (dy, *some))[1]]


class _Note(NamedTuple):
    """A turn of the loop: state and levels before it, the time since the start, the signed width of
    the step, 0 where none was accepted; state and levels after it."""

    y: Array
    levels: Array
    gone: Array
    h: Array
    end: Array
    after: Array


def _cotangent(opened, at, given, slopes):
    """Slopes by the state at the start and by ``arrays[i]``, i in ``at``."""
    *arrays, y, start, ts = given
    start, times = each_body(start, ts, y.shape[1])
    slopes = jnp.moveaxis(slopes, 0, -1)  # (T, D, B)
    chosen = [arrays[i] for i in at]

    def held_of(*some):
        full = list(arrays)
        for i, x in zip(at, some):
            full[i] = x
        return [x for x in opened(full)[0].held if jnp.issubdtype(x.dtype, jnp.inexact)]

    # derivatives of slopes ask for those of the places of switches
    linked = any(isinstance(x, ad.JVPTracer) for x in given)
    motion, wanted = opened(arrays, linked)
    floats = [k for k, x in enumerate(motion.held) if jnp.issubdtype(x.dtype, jnp.inexact)]
    _, pull = jax.vjp(held_of, *chosen)
    sums = [jnp.zeros_like(motion.held[k]) for k in floats]
    found, sums = kernel(
        lambda held, known, told, *rest: _backward(
            motion._replace(held=held, known=known, told=told), wanted, floats, *rest
        )
    )(motion.held, motion.known, motion.told, start, times, y, slopes, sums)
    return [found, *pull(sums)]


def _backward(motion, wanted, floats, start, times, y, slopes, sums):
    """Slopes by the state at the start and by the floats among ``motion.held``."""
    walk, rows = begin(motion, wanted, start, times[-1:], y)
    end = times[-1:]
    kept = jax.tree.map(
        lambda x: jnp.broadcast_to(x[None], (KEPT, *x.shape)) + jnp.zeros_like(x)[None], walk
    )
    length = -(-4 * wanted.max_steps // KEPT) + 1

    def on(walk):
        return any_of(jnp.where(walk.ended == UNDER_WAY, 1.0, 0.0))

    def turn(carry):
        walk, kept, count, stride = carry
        row = count // stride
        full = row >= KEPT
        thinned = jax.lax.cond(full, lambda k: jax.tree.map(_every_second, k), lambda k: k, kept)
        stride = jnp.where(full, 2 * stride, stride)
        row = count // stride
        begins = count == row * stride

        def keep(rows, x):
            x = jnp.where(begins, x, jax.lax.dynamic_index_in_dim(rows, row, 0, False))
            return jax.lax.dynamic_update_index_in_dim(rows, x, row, 0)

        kept = jax.tree.map(keep, thinned, walk)
        walk, _ = advance(motion, wanted, start, end, walk, rows)
        return walk, kept, count + 1, stride

    one = jnp.ones((), jnp.int32)
    last, kept, count, stride = jax.lax.while_loop(
        lambda c: on(c[0]), turn, (walk, kept, 0 * one, one)
    )
    sound = last.ended == ARRIVED
    sign = jnp.where(end[0] < start, -1, 1).astype(y.dtype)
    note = _noted(walk, walk, sign)
    notes = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), note)

    def segment(carry):
        number, *some = carry
        first = number * stride
        turns = jnp.minimum(stride, count - first)
        walk = jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, number, 0, False), kept)

        def note_one(i, carry):
            walk, notes = carry
            after, _ = advance(motion, wanted, start, end, walk, rows)
            new = _noted(walk, after, sign)
            notes = jax.tree.map(
                lambda rows, x: jax.lax.dynamic_update_index_in_dim(rows, x, i, 0), notes, new
            )
            return after, notes

        _, noted = jax.lax.fori_loop(0, turns, note_one, (walk, notes))

        def back(i, some):
            k = turns - 1 - i
            note = jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, k, 0, False), noted)
            return _step_back(motion, floats, start, times, slopes, sound, note, *some)

        return number - 1, *jax.lax.fori_loop(0, turns, back, tuple(some))

    place = jnp.full(start.shape, times.shape[0] - 1, jnp.int32)
    begun = (count - 1) // stride, jnp.zeros_like(y), sums, place
    _, slope, sums, _ = jax.lax.while_loop(lambda c: c[0] >= 0, segment, begun)
    return slope, sums


def _every_second(rows: Array) -> Array:
    half = rows[::2]
    return jnp.concatenate([half, half])


def _noted(before: Walk, after: Walk, sign: Array) -> _Note:
    h = sign * (after.gone - before.gone)
    return _Note(before.y, before.levels, before.gone, h, after.y, after.levels)


def _step_back(motion, floats, start, times, slopes, sound, note: _Note, slope, sums, place):
    """From slopes after a turn of the loop to those before it. ``place`` (B,): of the last sample
    that has not been met yet."""
    sign = jnp.where(times[-1] < start, -1, 1).astype(slope.dtype)
    t = start + sign * note.gone
    live = sound & ((note.h != 0) | jnp.any(note.levels != note.after, axis=0))
    h = jnp.where(live, note.h, 0)

    def of(some, levels, t, y):
        held = list(motion.held)
        for k, x in zip(floats, some):
            held[k] = x
        return motion.rates(held, levels, t, y)

    known = [motion.held[k] for k in floats]
    if motion.jumps:
        pulled, more = _jump_back(of, known, motion, note, t + h, slope, live)
        slope, sums = slope + pulled, [a + b for a, b in zip(sums, more)]

    def met(place):
        due = jnp.abs(column(times, place) - start)
        return live & (place >= 0) & (h != 0) & ((due > note.gone) | (note.gone == 0))

    top = jnp.where(any_of(jnp.where(met(place), 1.0, 0.0)), DENSE_STAGES, STAGES - 1)
    table, nodes = jnp.asarray(WEIGHTS, slope.dtype), jnp.asarray(NODES, slope.dtype)

    def stage(i, found):
        rates, states = found
        y = note.y + h[None] * weighted(table[i], rates)
        rate, *_ = of(known, note.levels, t + nodes[i] * h, y)
        put_in = jax.lax.dynamic_update_index_in_dim
        return put_in(rates, rate, i, 0), put_in(states, y, i, 0)

    rooms = jnp.zeros((DENSE_STAGES, *slope.shape), slope.dtype)
    _, states = jax.lax.fori_loop(0, top, stage, (rooms, rooms))

    def sample(carry):
        place, slope, bars = carry
        here = met(place)
        x = jnp.abs(column(times, place) - start) - note.gone
        x = jnp.minimum(x / jnp.where(h != 0, jnp.abs(h), 1), 1)
        _, pull = jax.vjp(lambda y, k: dense_state(y, dense_of(h, k), x), note.y, rooms)
        some, more = pull(jnp.where(here[None], column(slopes, place), 0))
        return place - jnp.where(here, 1, 0).astype(place.dtype), slope + some, bars + more

    bars = h[None, None] * slope[None] * table[STAGES - 1][:, None, None]
    passed = jnp.where(sound[None], slope, 0)
    place, slope, bars = jax.lax.while_loop(
        lambda c: any_of(jnp.where(met(c[0]), 1.0, 0.0)), sample, (place, passed, bars)
    )

    def back(j, found):
        bars, slope, sums = found
        i = top - 1 - j
        y = jax.lax.dynamic_index_in_dim(states, i, 0, False)
        bar = jax.lax.dynamic_index_in_dim(bars, i, 0, False)
        _, pull = jax.vjp(lambda some, y: of(some, note.levels, t + nodes[i] * h, y)[0], known, y)
        more, change = pull(bar)
        bars = bars + (h[None] * change)[None] * table[i][:, None, None]
        return bars, slope + change, [a + b for a, b in zip(sums, more)]

    _, slope, sums = jax.lax.fori_loop(0, top, back, (bars, slope, sums))
    return slope, sums, place


def _jump_back(of, known, motion, note: _Note, t, slope, live):
    """What the time of a switch that turned adds to the slopes by the state and by ``known``."""
    flips = (note.levels != note.after) & live[None]
    # events move nothing
    field = jnp.arange(motion.switches) < motion.switches - motion.watched
    flips = flips & field[:, None]
    share = jnp.where(flips, 1, 0).astype(slope.dtype)
    share = share / jnp.maximum(jnp.sum(share, axis=0, keepdims=True), 1)
    before, *_ = of(known, note.levels, t, note.end)
    later, *_ = of(known, note.after, t, note.end)

    def margin(some, t, y):
        return jnp.sum(jnp.where(flips, share * of(some, note.levels, t, y)[1], 0), axis=0)

    _, pace = jax.jvp(lambda t, y: margin(known, t, y), (t, note.end), (jnp.ones_like(t), before))
    some = jnp.any(flips, axis=0) & (pace != 0)
    weight = jnp.sum(slope * (later - before), axis=0) / jnp.where(some, pace, 1)
    _, pull = jax.vjp(lambda some, y: margin(some, t, y), known, note.end)
    more, change = pull(jnp.where(some, weight, 0))
    return change, more
