"""Derivatives of the steps of ``_loop.py``, both ways, through the switches that end them.

With its levels held a step is a smooth map, and its derivative is that of an ordinary Runge-Kutta
step of fixed width. Where a switch turns at the time tau, the rates change from f to f', and a
small change of the state before it, which shifts tau by d tau, is followed by one of
``(f - f') d tau`` more (the saltation of piecewise smooth systems: M. di Bernardo et al.,
Piecewise-smooth Dynamical Systems (2008), section 2.5). Without this term derivatives through a
jump are wrong at any step width.

*Forward*, the loop itself is differentiated, with the place of each switch by two steps of Newton's
rule. *Backward*, the loop is run again, every step noted, and the steps are passed in reverse
order. There is room for the notes of one ``KEPT``th of the steps that may be taken; of more than
these the state is kept where each such segment begins, and it is run once more from there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.interpreters import ad
from jaxtyping import Array

from polhode._integrate._dop853 import DENSE_STAGES, NODES, STAGES, WEIGHTS
from polhode._integrate._loop import (
    ARRIVED,
    TRIES,
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

KEPT = 256
"""Turns of the loop, equally spaced over as many as there may be, whose whole state is kept."""


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
    """Before a turn of the loop: state, levels, and the time since the start. What a turn leads to
    stands in the note of the next one."""

    y: Array
    levels: Array
    gone: Array


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
    first, rows = begin(motion, wanted, start, times[-1:], y)
    end = times[-1:]
    length = -(-TRIES * wanted.max_steps // KEPT)

    def rooms(size, tree):
        return jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), tree)

    def put_in(rows, k, tree):
        return jax.tree.map(
            lambda r, x: jax.lax.dynamic_update_index_in_dim(r, x, k, 0), rows, tree
        )

    def entry(rows, k):
        return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, k, 0, False), rows)

    def turn(carry):
        walk, kept, notes, count = carry
        number, place = count // length, count % length
        begins = place == 0
        old = entry(kept, number)
        kept = put_in(kept, number, jax.tree.map(lambda x, o: jnp.where(begins, x, o), walk, old))
        notes = put_in(notes, place, _noted(walk))
        walk, _ = advance(motion, wanted, start, end, walk, rows)
        return walk, kept, notes, count + 1

    last, kept, notes, count = jax.lax.while_loop(
        lambda c: any_of(jnp.where(c[0].ended == UNDER_WAY, 1.0, 0.0)),
        turn,
        (first, rooms(KEPT, first), rooms(length, _noted(first)), jnp.zeros((), jnp.int32)),
    )
    sound = last.ended == ARRIVED
    final = (count - 1) // length

    def segment(carry):
        number, notes, *some = carry
        turns = jnp.minimum(length, count - number * length)

        def note_one(i, carry):
            walk, notes = carry
            notes = put_in(notes, i, _noted(walk))
            walk, _ = advance(motion, wanted, start, end, walk, rows)
            return walk, notes

        # the notes of the final one are there already
        missing = jnp.where(number == final, 0, turns)
        _, notes = jax.lax.fori_loop(0, missing, note_one, (entry(kept, number), notes))

        def back(i, some):
            note = entry(notes, turns - 1 - i)
            return _step_back(motion, floats, start, times, slopes, sound, note, *some)

        return number - 1, notes, *jax.lax.fori_loop(0, turns, back, tuple(some))

    place = jnp.full(start.shape, times.shape[0] - 1, jnp.int32)
    begun = final, notes, _noted(last), jnp.zeros_like(y), sums, place
    *_, slope, sums, _ = jax.lax.while_loop(lambda c: c[0] >= 0, segment, begun)
    return slope, sums


def _noted(walk: Walk) -> _Note:
    return _Note(walk.y, walk.levels, walk.gone)


def _step_back(
    motion, floats, start, times, slopes, sound, note: _Note, after: _Note, slope, sums, place
):
    """From slopes after a turn of the loop to those before it. ``place`` (B,): of the last sample
    that has not been met yet."""
    sign = jnp.where(times[-1] < start, -1, 1).astype(slope.dtype)
    t = start + sign * note.gone
    h = sign * (after.gone - note.gone)
    live = sound & ((h != 0) | jnp.any(note.levels != after.levels, axis=0))
    h = jnp.where(live, h, 0)

    def of(some, levels, t, y):
        held = list(motion.held)
        for k, x in zip(floats, some):
            held[k] = x
        return motion.rates(held, levels, t, y)

    known = [motion.held[k] for k in floats]
    if motion.jumps:
        pulled, more = _jump_back(of, known, motion, note, after, t + h, slope, live)
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
    return note, slope, sums, place


def _jump_back(of, known, motion, note: _Note, after: _Note, t, slope, live):
    """What the time of a switch that turned adds to the slopes by the state and by ``known``."""
    flips = (note.levels != after.levels) & live[None]
    # events move nothing
    field = jnp.arange(motion.switches) < motion.switches - motion.watched
    flips = flips & field[:, None]
    share = jnp.where(flips, 1, 0).astype(slope.dtype)
    share = share / jnp.maximum(jnp.sum(share, axis=0, keepdims=True), 1)
    before, *_ = of(known, note.levels, t, after.y)
    later, *_ = of(known, after.levels, t, after.y)

    def margin(some, t, y):
        return jnp.sum(jnp.where(flips, share * of(some, note.levels, t, y)[1], 0), axis=0)

    _, pace = jax.jvp(lambda t, y: margin(known, t, y), (t, after.y), (jnp.ones_like(t), before))
    some = jnp.any(flips, axis=0) & (pace != 0)
    weight = jnp.sum(slope * (later - before), axis=0) / jnp.where(some, pace, 1)
    _, pull = jax.vjp(lambda some, y: margin(some, t, y), known, after.y)
    more, change = pull(jnp.where(some, weight, 0))
    return change, more
