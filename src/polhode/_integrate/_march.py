"""From one time to another in as many extrapolated steps as an error asked for needs.

The error of a step is found from its own table. Let e be the difference of the results of orders p
and p - 2, and d that of p - 2 and p - 4. In a converging table the results' errors fall by about
the same factor from one to the next, so that the result itself is off by about e^2 / d. Over random
tops and gravity gradients with six decades of every parameter, orders 8 to 16 and steps of 0.3 to
2.2 radians the true error was 2 to 20 times that, 4.5 times in the median, for errors from 1e-13 to
1e-2 (``benchmarks/error_control.py``); e alone is too large by anything up to 1,000.

Steps are each body's own where the rates do not ask for the time: bodies march side by side, a few
at once, and those that have arrived make room for others (``_lanes.py``). Where the rates do ask
for it (an orbit, a torque that is a function of time) the bodies share their times, so that what
depends on the time alone is worked out once for all of them, and the body that needs the smallest
step decides.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._integrate._columns import Table, carried_on, extrapolated
from polhode._integrate._lanes import LANES, in_lanes
from polhode._integrate._units import weighted_length
from polhode._kernels import any_of, put


class Field(NamedTuple):
    """What moves bodies that are the entries of arrays, and the arrays ``known`` that it rests on:
    ``held`` of the rates, ``told`` of the units.

    ``rates(held, t, y, along)``: see ``extrapolated``. ``units(told, y, rates)``: weights of the
    components of an error, whose squares are summed, and the natural rate [rad/s]. ``own``: each
    body in steps of its own; the rates must then not depend on the time. ``by_entry``: whether
    bodies can be exchanged for others by exchanging the entries of all these arrays.
    """

    rates: Callable[..., tuple[list[Array], list[Array]]]
    units: Callable[..., tuple[list[Array], Array]]
    known: tuple[Any, Any]
    own: bool
    by_entry: bool = False


CALIBRATED = 5
"""The error of a step over e^2 / d (see above)."""

SHARE = 0.6
"""Part of the tolerance that the steps' errors may add up to. They add up to more where the motion
itself spreads errors (see ``docs/design_notes.md``)."""

FIRST = 0.05
"""What a radian at the start may err, of the mean over all; the rest is allowed as the square of
the angle turned. An early error has the longest time to grow, and at a high order a step of a
twentieth of the error is shorter by a fifth only."""

LONG = 100
"""Over more than so many radians an error of the rates turns the body on: the tolerance falls with
the power 3/4 of the angle (``_drift``). It does so in proportion where the errors of the steps all
have one sign, which is rare (1 body in 300)."""

CAUTION, MEMORY = 0.9, 0.3
"""A step is this much shorter than its error allows; how much the last one's error counts."""

ROUNDING, COMPENSATED = 8, 4
"""Units in the last place below which the error of a step is rounding, of plain and of compensated
steps."""

ROUGH = 32
"""How much the estimate may be too small where a torque jumps amid a step: the last two values of
the table differ by less than their errors. Seen from errors that do not fall with the order of the
method when a refused step is cut."""

_TRIES = 4
"""Steps that may be tried for each that may be taken."""

GAP = 1 / 16
"""Part of a step beside its ends, three times which is searched for jumps."""


class Limits(NamedTuple):
    """What a march keeps to: ``rtol``, the sum of errors [rad] at ``horizon`` [s] after its start;
    ``steps``: most of them; ``jumps`` (static): whether the rates may jump."""

    rtol: Array
    horizon: Array
    steps: int
    jumps: bool


class Progress(NamedTuple):
    """What is carried from one march to the next; arrays of one entry a body.

    ``width``: next step [s], 0: not known; ``turned``: angle so far [rad]; ``low``: what rounding
    took from the state; ``steps``; ``error``: sum of the estimated errors [rad]; ``gone``: time
    since the first start [s]; ``ended``: 0, or why the body was given up: 1 its steps were spent,
    2 they became too short to lead anywhere, 3 there so because the rates are no numbers; ``rows``:
    states (n, T + 1, C) at times to be saved, where one march leads through all of them; the last
    is not used.
    """

    width: Array
    turned: Array
    low: list[Array]
    steps: Array
    error: Array
    gone: Array
    ended: Array
    rows: Array | None = None


def fresh(y: list[Array], compensated: bool, t: Array) -> Progress:
    """Progress before the first step."""
    zero = jnp.zeros_like(y[0])
    low = [jnp.zeros_like(x) for x in y] if compensated else []
    ended = jnp.zeros(zero.shape, jnp.int32)
    return Progress(zero, zero, low, zero, zero, jnp.zeros_like(t), ended)


class _Saved(NamedTuple):
    """States saved on the way: ``place`` (n,): the next one among those of its body, which is
    ``due`` (n,) [s] after the start."""

    place: Array
    due: Array

    @classmethod
    def first(cls, rows: Array, elapsed: Array, y: list[Array]) -> tuple["_Saved", Array]:
        """Before the first step: what is saved at the start is the given state, all else is NaN,
        whatever ``rows`` hold: to look at them takes longer than to write anew."""
        now = elapsed <= 0
        here = jnp.concatenate([now, jnp.zeros((1,), bool)])
        empty = jnp.full_like(rows, jnp.nan)
        rows = jnp.where(here[:, None], jnp.stack(y, axis=-1)[:, None], empty)
        place = jnp.broadcast_to(jnp.sum(jnp.where(now, 1, 0)).astype(jnp.int32), y[0].shape)
        saved = cls(place, elapsed.at[place].get(mode="clip"))
        return saved, rows.reshape(-1, len(y))

    def after(
        self, reached: Array, body: Array, elapsed: Array, y: list[Array], rows: Array
    ) -> tuple["_Saved", Array]:
        """With the states of the bodies that have ``reached`` what was due among the ``rows``
        (n (T + 1), C), the last of each body not used."""
        unused = elapsed.shape[0]

        def once(carry):
            saved, rows, _ = carry
            at = body * (unused + 1) + jnp.where(reached, saved.place, unused)
            rows = put(rows, at, jnp.stack(y, axis=-1))
            place = saved.place + jnp.where(reached, 1, 0)
            return _Saved(place, elapsed.at[place].get(mode="clip")), rows, False

        some = any_of(reached.astype(self.due.dtype))
        # once or not at all: a branch would copy all that is saved
        return jax.lax.while_loop(lambda carry: carry[2], once, (self, rows, some))[:2]


class _Walk(NamedTuple):
    """What changes in a march; every array has one entry a body."""

    tried: Array
    gone: Array  # time since the start of this march
    y: list[Array]
    rates: list[Array]
    low: list[Array]
    integrals: list[Array]
    width: Array
    before: Array  # logarithm of error over tolerance of the step before
    refused: tuple[Array, Array]  # error and width of a step refused
    turned: Array
    error: Array
    steps: Array
    saved: _Saved | None


class _Fixed(NamedTuple):
    """What does not: ``known`` of the field; which of all bodies each is; why it was given up
    before. As part of a loop's state what does not change may end the process in XLA."""

    known: Any
    body: Array
    ended: Array


def march(
    field: Field,
    table_for: Callable[[Array], Table],
    limits: Limits,
    span: tuple[Array, Array],
    y: list[Array],
    integrals: list[Array],
    progress: Progress,
    elapsed: Array | None = None,
) -> tuple[list[Array], list[Array], Progress]:
    """State and integrals at ``span[1]``, of bodies that are the entries of arrays of one shape.

    ``table_for(rate)``: the columns of a step, by the natural rates [rad/s] at the start. A body
    that has used up ``limits.steps`` ends as NaN. ``elapsed`` (T,): times since the start
    [s] in order, the last that of the end, at which the states are to be saved, as the ``rows`` of
    the progress: a body that has reached one goes on to its next without waiting for others.
    """
    compensated, own = bool(progress.low), field.own
    start, end = span
    length, sign = jnp.abs(end - start), jnp.where(end < start, -1, 1)
    dtype = y[0].dtype
    eps = float(jnp.finfo(dtype).eps)
    rest = jnp.abs(limits.horizon - progress.gone - length).astype(dtype)
    whole_length, length = length, length.astype(dtype)
    zero = jnp.zeros_like(y[0])
    first, _ = field.rates(field.known[0], start, y, False)
    _, rate = field.units(field.known[1], y, first)
    given = table_for(rate)
    power = 1 / (given.order.astype(dtype) + 1)

    def worst(x, dead):
        """Of the bodies that share their steps, but for those that are given up."""
        return x if own else jnp.broadcast_to(jnp.max(jnp.where(dead, 0, x)), x.shape)

    def given_up(fixed, walk):
        """Bodies whose steps ran out, or became so short that they lead nowhere."""
        able = (walk.steps < limits.steps) & (walk.width > 0.1 * eps * length)
        return ~(able & (fixed.ended == 0))

    def live(fixed, walk):
        return (walk.gone < whole_length) & ~given_up(fixed, walk)

    def bound(fixed):
        """Rates and units of bodies."""
        held, told = fixed.known
        return partial(field.rates, held), partial(field.units, told)

    def judged(rates, units, walk, t, h, width, new, found, later):
        """Error of a step, and what it may be."""
        (weights, rate), (weights_, rate_) = units(walk.y, walk.rates), units(new, later)
        # by the larger and faster of both ends: a body that a torque sets in motion is not held
        # to digits of what it had at rest
        weights = [jnp.minimum(a, b) for a, b in zip(weights, weights_)]
        rate = jnp.maximum(rate, rate_)
        last, before = (weighted_length(weights, e) for e in (found.last, found.before))
        error = CALIBRATED * last * jnp.where(last < before, last / before, 1)
        if limits.jumps:
            error = error + _missed(rates, t, h, walk, new, later, weights)
            fall = (width / jnp.where(walk.refused[1] > 0, walk.refused[1], 1)) ** given.order
            rough = (walk.refused[1] > 0) & (error > 2 * fall * walk.refused[0])
            error = jnp.where(rough & (error > 128 * eps), ROUGH * error, error)
        angle = rate * width
        whole = walk.turned + angle + rate * (length - walk.gone.astype(dtype) - width + rest)
        whole = jnp.maximum(whole, 1)
        done = jnp.minimum(walk.turned / whole, 1)
        share = SHARE * (FIRST + 3 * (1 - FIRST) * done * done)
        allowed = share * limits.rtol * angle / (whole * _drift(whole))
        allowed = jnp.maximum(allowed, (COMPENSATED if compensated else ROUNDING) * eps)
        sound = jnp.isfinite(error) & jnp.isfinite(angle)  # a step may well end beyond all numbers
        error, allowed = jnp.where(sound, error, jnp.inf), jnp.where(sound, allowed, 1)
        return jax.lax.stop_gradient((error, allowed, jnp.where(sound, angle, 0)))

    def one(fixed, walk, rows):
        """One step of each body."""
        rates, units = bound(fixed)
        alive = live(fixed, walk)
        due = whole_length if walk.saved is None else walk.saved.due
        left = (due - walk.gone).astype(dtype)
        # no step is much shorter than its neighbours for the sake of the end
        width = jnp.where(left <= walk.width, left, jnp.minimum(walk.width, left / 2))
        cut = width < 0.999 * walk.width  # for the sake of a time, not by rounding
        # to a time that is a number: thousands of rounded sums would add up to another time; down
        # after a step refused, or that would be tried again and again
        near = walk.gone + width.astype(walk.gone.dtype)
        grain = jnp.finfo(near.dtype).eps * near  # one or two units in its last place
        exact = (near - walk.gone).astype(dtype)
        down = (exact > width) & (walk.refused[1] > 0)
        exact = jnp.where(down, (near - grain - walk.gone).astype(dtype), exact)
        exact = jnp.minimum(jnp.maximum(exact, grain.astype(dtype)), left)
        width = jnp.where(width == left, left, exact)
        width = jnp.where(alive, width, 0)
        gone, h = (x if own else jnp.max(x) for x in (walk.gone, width))
        t, h = start + sign * gone, sign.astype(dtype) * h
        found = extrapolated(rates, given, t, h, walk.y, walk.rates, walk.integrals, compensated)
        low = walk.low
        new = found.change
        if compensated:
            new, low = carried_on(walk.y, walk.low, found.change)
        later, _ = rates(t + h.astype(t.dtype), new, False)
        error, allowed, angle = judged(rates, units, walk, t, h, width, new, found, later)
        ratio = worst(error / allowed, given_up(fixed, walk))
        good = (ratio <= 1) & alive
        size = jnp.log(jnp.maximum(ratio, 1e-6))  # logarithms: a power takes as long as three
        factor = CAUTION * jnp.exp(power * (jnp.where(good, MEMORY * walk.before, 0) - size))
        factor = jnp.clip(factor, jnp.where(good, 0.2, 0.1), jnp.where(good, 4, 0.9))
        # of steps that a jump has cut to units in the last place of the time the error is rounding,
        # which does not tell how much longer they may be
        factor = jnp.where(good & (width < 64 * grain.astype(dtype)) & ~cut, 4, factor)
        wanted = jnp.where(good & cut, jnp.maximum(walk.width, width * factor), width * factor)
        wanted = jnp.where(good | (width > grain.astype(dtype)), wanted, 0)
        wanted = jnp.where(alive, wanted, walk.width)
        later_time = jnp.where(width == left, due, walk.gone + width.astype(walk.gone.dtype))
        gone = jnp.where(good, later_time, walk.gone)
        saved = walk.saved
        if saved is not None:
            reached = good & (width == left)
            saved, rows = saved.after(reached, fixed.body, elapsed, new, rows)

        def pick(a, b):
            return [jnp.where(good, x, y) for x, y in zip(a, b)]

        refused = (good, 0, error), (good, 0, width)
        walk = _Walk(
            walk.tried + jnp.where(alive, 1, 0).astype(dtype), gone,
            pick(new, walk.y), pick(later, walk.rates), pick(low, walk.low),
            _picked(good, found.sums, walk.integrals), wanted, jnp.where(good, size, walk.before),
            tuple(jnp.where(*x) for x in refused),
            walk.turned + jnp.where(good, angle, 0), walk.error + jnp.where(good, error, 0),
            walk.steps + jnp.where(good, 1, 0), saved,
        )  # fmt: skip
        return walk, rows

    body = jnp.arange(zero.size, dtype=jnp.int32).reshape(zero.shape)
    fixed = _Fixed(field.known, body, progress.ended)
    # at first half of what a smooth motion allows, at once the whole way if that is short
    guess = 4 * limits.rtol.astype(dtype) ** power / jnp.maximum(rate, 1 / (length + rest))
    guess = jnp.where(progress.width > 0, progress.width, guess)  # NaN where the rates are
    guess = jax.lax.stop_gradient(guess)
    if not own:
        sound = jnp.where(guess > 0, guess, jnp.inf)  # a body that is no number holds up no other
        guess = jnp.where(guess > 0, jnp.min(sound), guess)
    saved, rows = None, None
    if elapsed is not None:
        saved, rows = _Saved.first(progress.rows, elapsed, y)
    walk = _Walk(
        zero, jnp.zeros(zero.shape, start.dtype), y, first, progress.low, integrals, guess, zero,
        (zero, zero), progress.turned, progress.error, progress.steps, saved,
    )  # fmt: skip

    def able(fixed, walk):
        return live(fixed, walk) & (walk.tried < _TRIES * limits.steps)

    def finished(fixed, walk):
        arrived = (walk.gone >= whole_length) & (fixed.ended == 0)
        y = [jnp.where(arrived, x, jnp.nan) for x in walk.y]
        numbers = jnp.isfinite(walk.width) & jnp.isfinite(walk.refused[0])
        left = (walk.steps < limits.steps) & (walk.tried < _TRIES * limits.steps)
        why = jnp.where(left, jnp.where(numbers, 2, 3), 1)
        ended = jnp.where(arrived, 0, jnp.where(fixed.ended > 0, fixed.ended, why))
        # as floats, like all the rest
        numbers = walk.width, walk.turned, walk.steps, walk.error, ended.astype(dtype)
        return y, walk.integrals, walk.low, numbers

    # an accelerator holds them all
    several = zero.ndim == 1 and zero.size > LANES and jax.default_backend() == "cpu"
    if several and field.by_entry and own:
        found, rows = in_lanes(one, able, finished, fixed, walk, rows)
    else:
        walk, rows = jax.lax.while_loop(
            lambda carry: any_of(able(fixed, carry[0]).astype(dtype)),
            lambda carry: one(fixed, *carry),
            (walk, rows),
        )
        found = finished(fixed, walk)
    y, integrals, low, (width, turned, steps, error, ended) = found
    gone = progress.gone + whole_length
    if rows is not None and elapsed is not None:
        rows = rows.reshape(zero.size, elapsed.shape[0] + 1, len(y))
    ended = ended.astype(jnp.int32)
    return y, integrals, Progress(width, turned, low, steps, error, gone, ended, rows)


def _drift(whole: Array) -> Array:
    """What the tolerance falls by: the power 3/4 of the angle, by roots, which are faster."""
    far = jnp.maximum(whole / LONG, 1)
    return jnp.sqrt(far * jnp.sqrt(far))


def _picked(good, new, old):
    """Integrals of shapes that all bodies share are kept or dropped with the step they share."""
    return [
        jnp.where(good if x.shape == good.shape else jnp.any(good), x, y) for x, y in zip(new, old)
    ]


def _missed(rates, t, width, walk, new, later, weights) -> Array:
    """Error by rates that jump beside an end of a step, unseen by its estimate.

    No column of the midpoint rule looks between either end of a step and its first or last
    substep but at the end itself, and steps that are refused again and again near a jump end up
    with it there. Along a straight line, the tangent at the start or the chord at the end,
    differences of smooth rates fall with their order; those of rates that jump do not.
    """
    gap = GAP * width
    eps = float(jnp.finfo(width.dtype).eps)

    def pick(at_end, a, b):
        return [jnp.where(at_end, y, x) for x, y in zip(a, b)]

    def beside(end, total):
        """One end: 0, the start, or 1. In loops, so that the rates stand in the program once."""
        at_end = end == 1
        base, there = pick(at_end, walk.y, new), pick(at_end, walk.rates, later)
        # along the tangent at the start, back along the chord at the end
        chord = [a - b for a, b in zip(walk.y, new)]
        part = [gap * f for f in walk.rates]
        part = pick(at_end, part, [GAP * x for x in chord])
        start, sign = jnp.where(at_end, t + width, t), jnp.where(at_end, -1, 1)

        def further(k, found):
            """Differences of order 0, 1, ... up to the rates ``k`` times so far; the sizes of
            those from the end on, of which the one of order ``k`` is new."""
            before, sizes = found
            k = k.astype(width.dtype)
            now = (start + sign * k * gap).reshape(-1)[0]
            row = rates(now, [a + k * b for a, b in zip(base, part)], False)[0]
            rows = [row]
            for older in before:
                row = [a - b for a, b in zip(row, older)]
                rows.append(row)
            lengths = [weighted_length(weights, x) for x in rows[1:]]
            sizes = [jnp.where(k == n, x, y) for n, x, y in zip((1, 2, 3), lengths, sizes)]
            return rows[:3], sizes

        zero = [jnp.zeros_like(x) for x in there]
        sizes = [jnp.zeros_like(total)] * 3
        _, sizes = jax.lax.fori_loop(1, 4, further, ([there, zero, zero], sizes))
        first, second, third = sizes
        noise = 64 * eps * weighted_length(weights, there)
        jumps = third > jnp.maximum(0.5 * jnp.maximum(second, 0.5 * first), noise)
        return total + jnp.where(jumps, third * jnp.abs(4 * gap), 0)

    return jax.lax.fori_loop(0, 2, beside, jnp.zeros_like(walk.width))
