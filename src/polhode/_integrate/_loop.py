"""Explicit Runge-Kutta steps of a few bodies: samples, switches and events inside the steps.

Bodies are the last axis of all arrays and have steps of their own. A step holds the levels of all
switches of the field (``_switches.py``), so the field within it is smooth. If the margin of a
switch falls below zero within the step, the step ends where it does, on the polynomial of dense
output, and the switch turns. An event is a switch on which the field does not depend.

The step is one of DOP853 (``_dop853.py``). Its stages are a loop, so that the field stands in the
compiled program once for the steps and once, its margins only, for the search of a switch.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._integrate._dop853 import DENSE, DENSE_STAGES, ERROR_3, ERROR_5, NODES, STAGES, WEIGHTS
from polhode._integrate._units import weighted_length
from polhode._kernels import FEW, any_of, kernel, put

SHARE = 2.0
"""How much of the tolerance the estimated errors of the steps may add up to: the estimate, of lower
order, exceeds the error ten times and more. With 0.6 satellites keep a hundredth of ``rtol`` and
take 1.2 times the steps, with 4 the worst of 64 miss it by four times."""

LONG = 100
"""Over more radians than these the tolerance falls with the power 3/4 of the angle turned: an error
of the rates turns the body on."""

CAUTION, MEMORY = 0.9, 0.3
"""A step is this much shorter than its error allows; how much the last one's error counts."""

ROUNDING = 8
"""Units in the last place below which the error of a step is rounding."""

ORDER = 8

LOOKS = (0, 3, 6, 5, 9, 10, 12)
"""Stages, by their places in the step, at which margins are looked at."""

LOCATED = 1e-4
"""Part of a step, over ``rtol``, to which the place of a switch of the field is found. What a step
past it adds is the change of the rates times this, far below what the step may err by."""

SLIDING = 16
"""Switches that turn back at once, after which the motion is said to slide along one."""

TRIES = 4
"""Steps that may be tried for each that may be taken."""

_SEARCH = 60
"""Evaluations of the margins in the search for one switch."""


class Motion(NamedTuple):
    """What moves B bodies.

    ``rates(held, levels, t, y)``: rates (D, B), margins (K, B) and turned levels (K, B) for levels
    (K, B), times (B,) and states (D, B); ``levels(known, t, y)``: the levels at a point;
    ``units(told, y, rates)``: weights of the components of an error, whose squares are summed, and
    natural rates [rad/s] (B,). The last ``watched`` of the K switches are events; ``jumps``:
    whether the rates may jump at another one.
    """

    rates: Callable[..., tuple[Array, Array, Array]]
    levels: Callable[..., Array]
    units: Callable[..., tuple[list[Array], Array]]
    held: Any
    known: Any
    told: Any
    switches: int
    watched: int = 0
    jumps: bool = True


class Wanted(NamedTuple):
    """What the loop is asked for.

    ``rtol``: sum of the errors of the steps [rad]; ``max_steps``: of each body; ``capacity``:
    events stored for each body; ``directions``: of each event 1, -1 or 0 for both;
    ``terminal``: whether a body stops at each; ``linked``: whether the place of a switch is to have
    derivatives.
    """

    rtol: Array
    max_steps: int
    capacity: int = 0
    directions: tuple[int, ...] = ()
    terminal: tuple[bool, ...] = ()
    linked: bool = False


class Walk(NamedTuple):
    """Where the bodies are; arrays whose last axis are the bodies.

    ``gone``: time since the start [s]; ``y``, ``rate``: state and its rates; ``levels``;
    ``lately``: which switches turned where the step begins; ``fresh``: whether rates are to be
    worked out; ``width``: of the next step [s]; ``before``: logarithm of the last error over what
    was allowed; ``turned``: angle so far [rad]; ``error``: sum of estimated errors; ``steps``,
    ``tried``; ``margin``: at ``y``; ``back``: switches in sequence that
    turned back at once; ``place``: of the next sample; ``count``: of events; ``ended``: 0 or why.
    """

    gone: Array
    y: Array
    rate: Array
    levels: Array
    margin: Array
    lately: Array
    fresh: Array
    width: Array
    before: Array
    turned: Array
    error: Array
    steps: Array
    tried: Array
    back: Array
    place: Array
    count: Array
    ended: Array


class Rows(NamedTuple):
    """What is stored: ``samples`` (B * (T + 1), D); of events ``times``, ``which`` (B * (E + 1), 1)
    and ``states`` (B * (E + 1), D). The last row of each body is not used."""

    samples: Array
    times: Array
    which: Array
    states: Array


UNDER_WAY, ARRIVED, SPENT, SHORT, NO_NUMBER, SLID, STOPPED = range(7)
"""``Walk.ended``: goes on; at its last time; steps spent; steps too short to lead on, the same
because the rates are no numbers; slides along a switch; at a terminal event."""


class Tried(NamedTuple):
    """An attempt: ``h`` (B,) signed width, ``stages`` (16, D, B), ``margins`` (16, K, B), levels
    ``turned`` (K, B) to at the start, ``depths`` (5, K, B) of turning points of the margins,
    ``dense`` (7, D, B) coefficients, of use where the inside of the step was asked for."""

    h: Array
    stages: Array
    margins: Array
    turned: Array
    depths: Array
    dense: Array


def run(motion: Motion, wanted: Wanted, start: Array, ts: Array, y: Array) -> tuple[Walk, Rows]:
    """From ``y`` (D, B) at ``start`` (B,) through ``ts`` (T, B), times in order."""
    walk, rows = begin(motion, wanted, start, ts, y)
    return jax.lax.while_loop(
        lambda c: any_of(jnp.where(c[0].ended == UNDER_WAY, 1.0, 0.0)),
        lambda c: advance(motion, wanted, start, ts, *c),
        (walk, rows),
    )


Make = Callable[..., tuple[Motion, Wanted]]
"""``make(arrays, told, linked)``: the motion that rests on ``arrays``, measured by ``told`` (units
and ``rtol``), and what is wanted."""


class Solved(NamedTuple):
    """Outcome of B bodies: see ``Walk`` and ``Rows``; of events None where none is stored."""

    steps: Array
    ended: Array
    error: Array
    count: Array | None
    samples: Array
    times: Array | None
    which: Array | None
    states: Array | None


def solve(make: Make, arrays: Any, told: Any, start: Array, ts: Array, y: Array) -> Solved:
    """From ``y`` (D, B) at ``start`` () or (B,) through ``ts`` (T,) or (B, T)."""
    motion, wanted = make(arrays, told, False)
    bodies = y.shape[1]

    def moved(held, known, told, rtol, start, ts, y):
        now = motion._replace(held=held, known=known, told=told)
        walk, rows = run(now, wanted._replace(rtol=rtol), *each_body(start, ts, bodies), y)
        none = (None,) * 4
        count, *events = (walk.count, *rows[1:]) if wanted.capacity else none
        return Solved(walk.steps, walk.ended, walk.error, count, rows.samples, *events)

    # of many bodies a unit compiles four times as long, and is no faster
    moved = kernel(moved) if bodies <= FEW else moved
    return moved(motion.held, motion.known, motion.told, wanted.rtol, start, ts, y)


def each_body(start: Array, ts: Array, bodies: int) -> tuple[Array, Array]:
    """``start`` () or (B,) and ``ts`` (T,) or (B, T) as (B,) and (T, B)."""
    rows = ts[:, None] if ts.ndim == 1 else ts.T
    return jnp.broadcast_to(start, (bodies,)), jnp.broadcast_to(rows, (rows.shape[0], bodies))


def begin(motion: Motion, wanted: Wanted, start: Array, ts: Array, y: Array) -> tuple[Walk, Rows]:
    """Before the first step."""
    zero = jnp.zeros_like(y[0])
    none = jnp.zeros(zero.shape, jnp.int32)
    levels = motion.levels(motion.known, start, y)
    unknown = jnp.zeros_like(levels)
    # the first turn, of no width, finds the rates
    walk = Walk(
        gone=zero, y=y, rate=jnp.zeros_like(y), levels=levels, margin=unknown, lately=unknown,
        fresh=jnp.ones_like(none, bool), width=zero, before=zero, turned=zero, error=zero,
        steps=none, tried=none, back=none, place=none, count=none, ended=none,
    )  # fmt: skip
    dtype, bodies = y.dtype, y.shape[1]
    samples = jnp.full((bodies * (ts.shape[0] + 1), y.shape[0]), jnp.nan, dtype)
    events = bodies * (wanted.capacity + 1)
    rows = Rows(
        samples, jnp.full((events, 1), jnp.inf, dtype), jnp.full((events, 1), -1.0, dtype),
        jnp.full((events, y.shape[0]), jnp.nan, dtype),
    )  # fmt: skip
    return walk, rows


def advance(motion: Motion, wanted: Wanted, start: Array, ts: Array, walk: Walk, rows: Rows):
    """One step of each body that is under way."""
    still = jax.lax.stop_gradient
    eps = float(jnp.finfo(walk.y.dtype).eps)
    length = jnp.abs(ts[-1] - start)
    sign = jnp.where(ts[-1] < start, -1, 1).astype(walk.y.dtype)
    alive = walk.ended == UNDER_WAY
    width, last = _width(walk, length, alive, eps)
    t, h = start + sign * walk.gone, sign * width
    asked = alive & (walk.place < ts.shape[0])
    asked = asked & (jnp.abs(column(ts, walk.place) - start) <= walk.gone + width)
    tried = attempt(motion, walk, t, h, asked)
    error, allowed, angle = still(_judged(motion, wanted, walk, tried, width, length, eps))
    ratio = error / allowed
    begins = walk.tried == 0
    good = (ratio <= 1) & alive & ~begins
    end = dense_state(walk.y, tried.dense, jnp.ones_like(width))
    turn = None
    if motion.switches:
        wrong = walk.fresh[None] & (tried.margins[0] < 0) & (walk.lately == 0) & ~begins[None]
        good = good & ~jnp.any(wrong, axis=0)
        turn = _search(motion, wanted, walk, tried, t, good, eps)
    hit = jnp.zeros_like(good) if turn is None else turn.hit
    part = jnp.where(hit, turn.part, 1) if turn is not None else jnp.ones_like(width)

    gone = jnp.where(last, length, walk.gone + width)
    gone = jnp.where(hit, walk.gone + part * width, gone)
    size = jnp.log(jnp.clip(ratio, 1e-6, 1e12))
    factor = CAUTION * jnp.exp((jnp.where(good, MEMORY * walk.before, 0) - size) / (ORDER - 1))
    factor = jnp.clip(factor, jnp.where(good, 0.2, 0.1), jnp.where(good, 5, 0.9))
    cut = good & (width < 0.999 * walk.width)
    proposed = jnp.where(cut, jnp.maximum(walk.width, width * factor), width * factor)
    guess = still(_first_width(motion, wanted, walk.y, tried.stages[0], length))
    proposed = jnp.where(begins, guess, proposed)
    broken = None
    if motion.switches:
        broken, share = _broken(tried, ratio, alive & ~begins)
        proposed = jnp.where(broken.any, 0.98 * width * share, proposed)
        near = width * share <= 64 * eps * jnp.maximum(walk.gone, 0.01 * length)
        broken = broken._replace(snaps=broken.any & near)
        proposed = jnp.where(broken.snaps, guess, proposed)
    rows, place = _save(tried, walk, rows, ts, start, jnp.where(good, gone, -1), width)

    def pick(a, b):
        return jnp.where(good if a.ndim == 1 else good[None], a, b)

    def count(n, where):
        return n + jnp.where(where, 1, 0).astype(n.dtype)

    first = jnp.where(walk.fresh[None], tried.stages[0], walk.rate)
    now = walk._replace(
        gone=pick(gone, walk.gone),
        y=pick(jnp.where(hit[None], turn.state, end) if turn is not None else end, walk.y),
        rate=pick(tried.stages[STAGES - 1], first),
        fresh=hit,
        width=still(jnp.where(alive, proposed, walk.width)),
        before=pick(still(size), walk.before),
        turned=walk.turned + pick(angle * still(part), jnp.zeros_like(angle)),
        error=walk.error + pick(error, jnp.zeros_like(error)),
        steps=count(walk.steps, good),
        tried=count(walk.tried, alive),
        place=place,
    )
    if turn is not None and broken is not None:
        now, rows = _turned(motion, wanted, walk, now, rows, tried, turn, wrong, good, width, start)
        snaps = broken.snaps[None] & broken.flips
        now = now._replace(
            levels=jnp.where(snaps, 1 - walk.levels, now.levels),
            lately=jnp.where(snaps, 1, now.lately),
            fresh=now.fresh | broken.snaps,
        )
    return now._replace(ended=_ended(wanted, now, alive, length, ratio, eps)), rows


def _first_width(motion: Motion, wanted: Wanted, y: Array, rate: Array, length: Array) -> Array:
    _, pace = motion.units(motion.told, list(y), list(rate))
    return 4 * wanted.rtol.astype(y.dtype) ** (1 / ORDER) / jnp.maximum(pace, 1 / length)


def _width(walk: Walk, length: Array, alive: Array, eps: float) -> tuple[Array, Array]:
    """Width of the step, and whether it leads to the last time."""
    left = length - walk.gone
    last = left <= walk.width * (1 + 1e-9)
    # no step is much shorter than its neighbours for the sake of the end
    width = jnp.where(last, left, jnp.minimum(walk.width, left / 2))
    # to a time that is a number: thousands of rounded sums would add up to another time
    near = walk.gone + width
    exact = jax.lax.stop_gradient(near - walk.gone - width) + width
    exact = jnp.maximum(exact, eps * near)
    return jnp.where(alive, jnp.where(last, left, exact), 0), last


def _judged(motion, wanted, walk, tried, width, length, eps):
    """Error of a step [rad], what it may be, and the angle of the step."""
    first, later = tried.stages[0], tried.stages[STAGES - 1]
    change = weighted(WEIGHTS[STAGES - 1], tried.h[None, None] * tried.stages)
    ends = (walk.y, first), (walk.y + change, later)
    (weights, rate), (other, rate_) = (motion.units(motion.told, list(y), list(f)) for y, f in ends)
    weights = [jnp.minimum(a, b) for a, b in zip(weights, other)]
    rate = jnp.maximum(rate, rate_)
    five, three = (
        weighted_length(weights, list(tried.h[None] * weighted(e, tried.stages)))
        for e in (ERROR_5, ERROR_3)
    )
    both = jnp.sqrt(five * five + 0.01 * three * three)
    error = five * jnp.where(both > 0, five / jnp.where(both > 0, both, 1), 0)
    angle = rate * width
    whole = jnp.maximum(walk.turned + rate * (length - walk.gone), 1)
    far = jnp.maximum(whole / LONG, 1)
    drift = jnp.sqrt(far * jnp.sqrt(far))
    allowed = SHARE * wanted.rtol.astype(error.dtype) * angle / (whole * drift)
    allowed = jnp.maximum(allowed, ROUNDING * eps)
    sound = jnp.isfinite(error) & jnp.isfinite(angle)
    return tuple(jnp.where(sound, x, y) for x, y in ((error, jnp.inf), (allowed, 1), (angle, 0)))


def _save(tried: Tried, walk: Walk, rows: Rows, ts, start, gone, width) -> tuple[Rows, Array]:
    """The samples up to the time ``gone`` (B,) since the start, and the place of the next one."""
    size = ts.shape[0]
    base = (size + 1) * jnp.arange(width.shape[0], dtype=walk.place.dtype)

    def due(place):
        return (place < size) & (jnp.abs(column(ts, place) - start) <= gone)

    def one(carry):
        place, samples = carry
        here = due(place)
        x = (jnp.abs(column(ts, place) - start) - walk.gone) / jnp.where(width > 0, width, 1)
        y = dense_state(walk.y, tried.dense, jnp.minimum(x, 1))
        samples = put(samples, base + jnp.where(here, place, size), y.T)
        return place + jnp.where(here, 1, 0).astype(place.dtype), samples

    place, samples = jax.lax.while_loop(
        lambda c: any_of(jnp.where(due(c[0]), 1.0, 0.0)), one, (walk.place, rows.samples)
    )
    return rows._replace(samples=samples), place


def _ended(wanted, now: Walk, alive, length, ratio, eps) -> Array:
    """Whether each body is under way still, and why not."""
    spent = (now.steps >= wanted.max_steps) | (now.tried >= TRIES * wanted.max_steps)
    short = ~(now.width > 0.1 * eps * length)
    number = jnp.isfinite(ratio) & jnp.isfinite(now.width)
    why = jnp.where(short, jnp.where(number, SHORT, NO_NUMBER), UNDER_WAY)
    why = jnp.where(now.back >= SLIDING, SLID, why)
    why = jnp.where(spent, SPENT, why)
    why = jnp.where(now.gone >= length, ARRIVED, why)
    why = jnp.where(now.ended == STOPPED, STOPPED, why)
    return jnp.where(alive, why, now.ended).astype(now.ended.dtype)


class _Broken(NamedTuple):
    """Steps that held a side beyond which the field is no number, as that of ``where(x > 0,
    sqrt(x), 0)``: ``any`` (B,); ``flips`` (K, B), the switches that were passed; ``snaps`` (B,):
    the start is so near that they turn there."""

    any: Array
    flips: Array
    snaps: Array


def _broken(tried: Tried, ratio: Array, alive: Array) -> tuple[_Broken, Array]:
    """Such steps, and the part of each up to the first switch."""
    margins = tried.margins[:STAGES]
    below = margins < 0
    order = jnp.arange(STAGES)[:, None]
    stage = jnp.min(jnp.where(jnp.any(below, axis=1), order, STAGES), axis=0)
    pick = order == stage[None]
    there = jnp.sum(jnp.where(pick[:, None], jnp.where(below, margins, 0), 0), axis=0)
    node = jnp.sum(jnp.where(pick, jnp.asarray(NODES[:STAGES], ratio.dtype)[:, None], 0), axis=0)
    begin = jnp.maximum(margins[0], 0)
    flips = there < 0
    share = jnp.min(jnp.where(flips, begin / jnp.where(flips, begin - there, 1), 1), axis=0)
    broken = alive & ~jnp.isfinite(ratio) & jnp.any(flips, axis=0)
    return _Broken(broken, flips, broken), jax.lax.stop_gradient(node * share)


class Turn(NamedTuple):
    """Where the first switch turns within a step: ``hit`` (B,), the ``part`` of the step, ``state``
    (D, B) there, ``levels`` (K, B) that the switches ``flips`` (K, B) turn to; parts up to ``near``
    (B,) are the start itself."""

    hit: Array
    part: Array
    state: Array
    levels: Array
    flips: Array
    near: Array


class _Hunt(NamedTuple):
    """The search under way. ``mode`` (B,): 0 ended, 1 between ``low`` and ``high``, where a margin
    is below zero, 2 looking whether it is there, 3 for a turning point within ``triple``."""

    mode: Array
    low: Array
    high: Array
    at_low: Array
    at_high: Array
    turned: Array
    flips: Array
    side: Array
    triple: tuple[Array, ...]
    values: tuple[Array, ...]
    whose: Array
    count: Array
    hit: Array


def _search(motion, wanted, walk: Walk, tried: Tried, t, good, eps) -> Turn:
    """The first place within each step where a margin falls below zero."""
    looks = _looks(tried.margins)
    places = jnp.asarray(_PLACES, looks.dtype)[:, None]
    size = len(_PLACES)
    below = jnp.any(looks < 0, axis=1)  # (L, B)
    order = jnp.arange(size)[:, None]
    first = jnp.min(jnp.where(below, order, size), axis=0)

    def entry(rows, k):
        """Entry ``k`` (B,) along the first axis, by a sum that a unit can hold."""
        pick = order == k[None]
        pick = pick.reshape(size, *[1] * (rows.ndim - 2), -1)
        return jnp.sum(jnp.where(pick, rows, 0), axis=0)

    spots = jnp.broadcast_to(places, below.shape)
    low, high = entry(spots, first - 1), entry(spots, jnp.minimum(first, size - 1))
    at_low, at_high = entry(looks, first - 1), entry(looks, jnp.minimum(first, size - 1))
    # of the turning points the one that comes nearest to zero, before any look below it
    depth = tried.depths
    inner = jnp.arange(1, size - 1)[:, None, None]
    depth = jnp.where(inner < first[None, None], depth, 1)
    least = jnp.min(depth, axis=(0, 1))
    dips = (least <= 0.5) & good
    which = (depth == least[None, None]) & dips[None, None]  # (L - 2, K, B)
    middle = jnp.min(jnp.where(jnp.any(which, axis=1), inner[:, 0], size), axis=0)
    whose = jnp.any(which & (inner == middle[None, None]), axis=0)  # (K, B)

    def lowest(margins):
        return jnp.min(jnp.where(whose, margins, jnp.inf), axis=0)

    triple = tuple(entry(spots, middle + k) for k in (-1, 0, 1))
    values = tuple(lowest(entry(looks, middle + k)) for k in (-1, 0, 1))
    busy = good & jnp.any(below, axis=0)
    zero = jnp.zeros_like(tried.h)
    # a margin after the end is known exactly, those between are of stages
    sure = busy & (first == size - 1)
    mode = jnp.where(dips, 3, jnp.where(sure, 1, jnp.where(busy, 2, 0)))
    end = looks[-1]
    tolerance = 4 * eps * jnp.maximum(1, walk.gone / jnp.where(tried.h != 0, jnp.abs(tried.h), 1))
    if not motion.watched:  # an event is wanted to rounding, a change of the rates is not
        tolerance = jnp.maximum(tolerance, LOCATED * wanted.rtol.astype(tolerance.dtype))

    def margins_at(x):
        y = dense_state(walk.y, tried.dense, x)
        _, margins, turned = motion.rates(motion.held, walk.levels, t + x * tried.h, y)
        return margins, turned

    def secant(hunt):
        m_low, m_high = jnp.maximum(hunt.at_low, 0), hunt.at_high
        fall = jnp.where(m_high < 0, m_low - m_high, 1)
        share = jnp.min(jnp.where(m_high < 0, m_low / fall, 1), axis=0)
        gap, room = hunt.high - hunt.low, tolerance / 2
        x = hunt.low + gap * jnp.where(hunt.count % 8 == 7, 0.5, share)
        # nearer to an end than the tolerance it would move that end by nothing
        return jnp.minimum(jnp.maximum(x, hunt.low + room), hunt.high - room)

    def one(hunt: _Hunt) -> _Hunt:
        turning, unsure, known = hunt.mode == 3, hunt.mode == 2, hunt.mode == 1
        (xa, xb, xc), (fa, fb, fc) = hunt.triple, hunt.values
        vertex, _ = _vertex(hunt.triple, hunt.values)
        room = 0.05 * (xc - xa)
        vertex = jnp.clip(vertex, xa + room, xc - room)
        vertex = jnp.where(jnp.abs(vertex - xb) < 0.2 * room, xb + 0.3 * room, vertex)
        x = jnp.where(turning, vertex, jnp.where(unsure, hunt.high, secant(hunt)))
        margins, turned = margins_at(x)
        under = jnp.any(margins < 0, axis=0)
        f = lowest(margins)

        # a turning point
        left = vertex < xb
        lower = f < fb
        ta = jnp.where(lower, jnp.where(left, xa, xb), jnp.where(left, vertex, xa))
        tb = jnp.where(lower, vertex, xb)
        tc = jnp.where(lower, jnp.where(left, xb, xc), jnp.where(left, xc, vertex))
        va = jnp.where(lower, jnp.where(left, fa, fb), jnp.where(left, f, fa))
        vb = jnp.where(lower, f, fb)
        vc = jnp.where(lower, jnp.where(left, fb, fc), jnp.where(left, fc, f))
        _, bottom = _vertex((ta, tb, tc), (va, vb, vc))
        over = (bottom > 0.7 * vb) | (hunt.count > 12)
        found = turning & under
        flat = turning & ~under & over  # nothing here: what a later look has shown comes next
        mode = jnp.where(
            found, 1, jnp.where(flat, jnp.where(sure, 1, jnp.where(busy, 2, 0)), hunt.mode)
        )
        begun = found | flat

        # whether a stage was right
        false = unsure & ~under
        late = false & jnp.any(end < 0, axis=0) & (hunt.high < 1)
        mode = jnp.where(unsure, jnp.where(under | late, 1, 0), mode)

        # between low and high
        down, up = (known | unsure | found) & under, known & ~under
        twice = hunt.side == jnp.where(under, 1, -1)
        low_ = jnp.where(found, xa, jnp.where(flat, low, hunt.low))
        m_low = _pick(flat, at_low, hunt.at_low)
        m_low = _pick(found, jnp.maximum(at_start(xa), 0), m_low)
        new_low = jnp.where(up, x, jnp.where(late, hunt.high, low_))
        new_high = jnp.where(down, x, jnp.where(late, 1, jnp.where(flat, high, hunt.high)))
        half = jnp.where(known & twice, 0.5, 1)
        new_at_low = _pick(up | late, margins, m_low * jnp.where(down, half, 1)[None])
        kept = _pick(late, end, _pick(flat, at_high, hunt.at_high))
        new_at_high = _pick(down, margins, kept * jnp.where(up, half, 1)[None])
        tight = (mode == 1) & (new_high - new_low <= tolerance) & (down | up)
        stop = tight | (hunt.count >= _SEARCH)
        hit = hunt.hit | ((mode == 1) & stop)
        return _Hunt(
            jnp.where(stop, 0, mode), new_low, new_high, new_at_low, new_at_high,
            _pick(down, turned, hunt.turned), _pick(down, margins < 0, hunt.flips),
            jnp.where(known, jnp.where(under, 1, -1), jnp.where(begun, 0, hunt.side)),
            (ta, tb, tc), (va, vb, vc), hunt.whose,
            jnp.where(begun, 0, hunt.count + 1), hit,
        )  # fmt: skip

    def at_start(x):
        """Margins at the look at ``x``, one of the places."""
        return entry(looks, jnp.min(jnp.where(spots >= x[None] - 1e-6, order, size - 1), axis=0))

    none = jnp.zeros(zero.shape, jnp.int32)
    flips = at_high < 0
    hunt = _Hunt(
        mode, low, high, at_low, at_high, walk.levels, flips, none, triple, values, whose, none,
        jnp.zeros_like(good),
    )  # fmt: skip
    hunt = jax.lax.while_loop(
        lambda c: any_of(jnp.where(c.mode > 0, 1.0, 0.0)), one, jax.lax.stop_gradient(hunt)
    )
    part = hunt.high
    if wanted.linked:
        part = _linked(hunt, part, margins_at)
    state = dense_state(walk.y, tried.dense, part)
    lost = hunt.hit & ~jnp.any(hunt.flips, axis=0)
    near = jnp.maximum(1e-3, 4 * tolerance)
    return Turn(hunt.hit & ~lost, part, state, hunt.turned, hunt.flips, near)


def _pick(where: Array, a: Array, b: Array) -> Array:
    """Of each body (K, B) one or the other."""
    return jnp.where(where[None], a, b)


def _linked(hunt: _Hunt, part: Array, margins_at) -> Array:
    """The place of a switch with its first and second derivatives: two steps of Newton's rule with
    one slope for both."""
    still = jax.lax.stop_gradient
    share = jnp.where(hunt.flips, 1, 0).astype(part.dtype)
    share = share / jnp.maximum(jnp.sum(share, axis=0, keepdims=True), 1)

    def value(x):
        return jnp.sum(jnp.where(hunt.flips, share * margins_at(x)[0], 0), axis=0)

    _, slope = jax.jvp(value, (part,), (jnp.ones_like(part),))
    slope = still(jnp.where(hunt.hit & (slope != 0), slope, 1))
    for _ in range(2):
        change = jnp.where(hunt.hit, -value(part) / slope, 0)
        part = part + (change - still(change))
    return part


def _turned(motion, wanted, walk, now, rows, tried, turn: Turn, wrong, good, width, start):
    """What follows from switches that turned: levels, and events that were met."""
    hit = turn.hit & good
    flips = turn.flips & hit[None]
    repaired = jnp.any(wrong, axis=0) & (walk.ended == UNDER_WAY)
    near = turn.part <= turn.near
    again = hit & jnp.any(flips & (walk.lately > 0), axis=0) & near
    there = tried.margins[STAGES - 1]
    levels = jnp.where(flips, turn.levels, walk.levels)
    levels = jnp.where(wrong & repaired[None], tried.turned, levels)
    kept = jnp.where((hit & near)[None], walk.lately, 0)
    lately = _pick(good, jnp.zeros_like(walk.lately), walk.lately)
    lately = _pick(hit, jnp.where(flips, 1, kept).astype(lately.dtype), lately)
    lately = jnp.where(wrong & repaired[None], 1, lately)
    now = now._replace(
        levels=levels,
        margin=_pick(good, there, _pick(walk.fresh, tried.margins[0], walk.margin)),
        lately=lately.astype(walk.lately.dtype),
        fresh=hit | repaired,
        width=jnp.where(repaired, walk.width, jnp.where(again, width / 4, now.width)),
        back=jnp.where(again, walk.back + 1, jnp.where(good & ~hit, 0, walk.back)),
    )
    if not motion.watched:
        return now, rows
    bodies, capacity = width.shape[0], wanted.capacity
    sign = jnp.where(tried.h < 0, -1, 1)
    base = (capacity + 1) * jnp.arange(bodies, dtype=now.count.dtype)
    count, stopped = now.count, jnp.zeros_like(hit)
    first = now.gone <= 1e-6 * jnp.abs(width)  # where the motion comes from
    for k in range(motion.watched):
        row = motion.switches - motion.watched + k
        rises = jnp.where(turn.levels[row] > 0, 1, -1) * sign
        met = flips[row] & ~first
        if wanted.directions[k]:
            met = met & (rises == wanted.directions[k])
        here = base + jnp.where(met & (count < capacity), count, capacity)
        t = start + sign * now.gone
        rows = rows._replace(
            times=put(rows.times, here, t[:, None]),
            which=put(rows.which, here, jnp.full((bodies, 1), k, t.dtype)),
            states=put(rows.states, here, now.y.T),
        )
        count = count + jnp.where(met, 1, 0).astype(count.dtype)
        if wanted.terminal[k]:
            stopped = stopped | met
    ended = jnp.where(stopped, STOPPED, now.ended).astype(now.ended.dtype)
    return now._replace(count=count, ended=ended), rows


def column(rows: Array, k: Array) -> Array:
    """Of each body (last axis) the entry ``k`` (B,) along the first axis."""
    k = jnp.clip(k, 0, rows.shape[0] - 1)
    k = jnp.broadcast_to(k.reshape(*[1] * (rows.ndim - 1), -1), (1, *rows.shape[1:]))
    return jnp.take_along_axis(rows, k, axis=0)[0]


def weighted(weights: np.ndarray | Array, stages: Array) -> Array:
    """Sum (D, B) of ``stages`` (S, D, B) with ``weights`` (S,); what is known to be zero is left
    out. A sum term by term is one fused loop, a product of matrices would leave the unit."""
    total = None
    for j in range(weights.shape[0]):
        if isinstance(weights, np.ndarray) and weights[j] == 0:
            continue
        term = jnp.asarray(weights[j], stages.dtype) * stages[j]
        total = term if total is None else total + term
    return jnp.zeros_like(stages[0]) if total is None else total


def attempt(motion: Motion, walk: Walk, t: Array, h: Array, asked: Array) -> Tried:
    """A step of each body, of signed width ``h`` (B,) from ``t`` (B,). Where nothing is ``asked``
    (B,) of its inside and no switch is near, without the stages of dense output."""
    dtype = walk.y.dtype
    table, nodes = jnp.asarray(WEIGHTS, dtype), jnp.asarray(NODES, dtype)
    stages = _padded(walk.rate)
    margins = _padded(walk.margin)
    watched = motion.switches > 0

    def stage(i, found):
        stages, margins, turned = found
        y = walk.y + h[None] * weighted(table[i], stages)
        rate, margin, turn = motion.rates(motion.held, walk.levels, t + nodes[i] * h, y)
        stages = jax.lax.dynamic_update_index_in_dim(stages, rate, i, 0)
        if watched:
            margins = jax.lax.dynamic_update_index_in_dim(margins, margin, i, 0)
            turned = jnp.where(i == 0, turn, turned)
        return stages, margins, turned

    def phase(number, found):
        *some, depths, looked = found
        more = jnp.where(looked, DENSE_STAGES, STAGES)
        first = jnp.where(any_of(jnp.where(walk.fresh, 1.0, 0.0)), 0, 1)
        begin, end = jnp.where(number == 0, first, STAGES), jnp.where(number == 0, STAGES, more)
        some = jax.lax.fori_loop(begin, end, stage, tuple(some))
        if watched:
            depths = jnp.where(number == 0, _depths(_looks(some[1])), depths)
            looked = looked | any_of(_is_near(some[1], depths))
        return *some, depths, looked

    looked = any_of(jnp.where(asked, 1.0, 0.0)) if not motion.watched else jnp.ones((), bool)
    depths = jnp.ones((len(LOOKS) - 2, *walk.levels.shape), dtype) if watched else walk.levels
    found = jax.lax.fori_loop(0, 2, phase, (stages, margins, walk.levels, depths, looked))
    stages, margins, turned, depths, looked = found
    return Tried(h, stages, margins, turned, depths, dense_of(h, stages))


def dense_of(h: Array, stages: Array) -> Array:
    """Coefficients (7, D, B) of the polynomial through a step."""
    h_rates = h[None, None] * stages
    change = weighted(WEIGHTS[STAGES - 1], h_rates)
    first, last = h_rates[0], h_rates[STAGES - 1]
    return jnp.stack(
        [change, first - change, 2 * change - (first + last)]
        + [weighted(row, h_rates) for row in DENSE]
    )


def _padded(first: Array) -> Array:
    """Rooms for all stages, the first one filled."""
    rest = jnp.zeros((DENSE_STAGES - 1, *first.shape), first.dtype)
    return jnp.concatenate([first[None], rest])


def dense_state(y: Array, dense: Array, x: Array) -> Array:
    """States (D, B) at the parts ``x`` (B,) of a step from ``y``."""
    total, x = jnp.zeros_like(y), x[None]
    rest = 1 - x
    for k in range(dense.shape[0] - 1, -1, -1):
        total = (total + dense[k]) * (x if k % 2 == 0 else rest)
    return y + total


def _looks(margins: Array) -> Array:
    """Margins (L, K, B) in order of the places; a switch that has just turned starts at zero."""
    looks = jnp.stack([margins[k] for k in LOOKS])
    return jnp.concatenate([jnp.maximum(looks[:1], 0), looks[1:]])


_PLACES = tuple(float(NODES[k]) for k in LOOKS)


def _depths(looks: Array) -> Array:
    """How low a parabola through three looks lies where it turns (L - 2, K, B), over the least of
    the three; 1 where it does not turn between them."""
    x = np.array(_PLACES)
    inverse = 1 / np.diff(x)

    def column(values):
        return jnp.asarray(values, looks.dtype)[:, None, None]

    chords = (looks[1:] - looks[:-1]) * column(inverse)
    left, bend = chords[:-1], (chords[1:] - chords[:-1]) * column(1 / (x[2:] - x[:-2]))
    # slopes at both ends tell whether it turns between them, without a division for most
    falls = left - bend * column(x[1:-1] - x[:-2])
    rises = left + bend * column(2 * x[2:] - x[:-2] - x[1:-1])
    a = looks[:-2]
    least = jnp.minimum(jnp.minimum(a, looks[1:-1]), looks[2:])
    turns = (falls < 0) & (rises > 0) & (bend > 0) & (least >= 0)
    scale = jnp.where(turns & (least > 0), 4 * bend * least, 1)
    return jnp.where(turns, (4 * bend * a - falls * falls) / scale, 1)


def _vertex(x, f):
    """Where the parabola through three points turns, and its value there; far off if none."""
    (x0, x1, x2), (a, b, c) = x, f
    left, right = (b - a) / (x1 - x0), (c - b) / (x2 - x1)
    bend = (right - left) / (x2 - x0)
    up = bend > 0
    safe = jnp.where(up, bend, 1)
    place = jnp.where(up, (x0 + x1) / 2 - left / (2 * safe), 2.0)
    value = a + (place - x0) * (left + bend * (place - x1))
    return place, value


def _is_near(margins: Array, depths: Array) -> Array:
    """Whether (B,) a switch may turn within the step."""
    near = jnp.any(_looks(margins) < 0, axis=(0, 1)) | jnp.any(depths <= 0.5, axis=(0, 1))
    return jnp.where(near, 1.0, 0.0)
