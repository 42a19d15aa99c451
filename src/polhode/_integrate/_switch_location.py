"""Where within a step the first switch of the field turns, or the first event lies."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._integrate import _error_control as control
from polhode._integrate._explicit_step import (
    Attempt,
    Progress,
    dense_state,
    margin_samples,
    vertex_of,
)
from polhode._integrate._tableau import Tableau
from polhode._kernels import any_of

LOCATED_JUMP, LOCATED_KINK, LOCATED_ROOT = 1e-4, 1.0, 0.1
"""Width of the bracket of a switch of the field, relative to the step: times ``rtol`` at a jump,
and at a kink, there at most ``LOCATED_ROOT`` times its square root. A step beyond a jump adds an
error of the change of the rates times this width, one beyond a kink of its square: both are far
below the error of a step. Derivatives through a kink are off by the width itself, so that the root
alone, which is enough from 1e-2 on, would leave errors of 100 ``rtol`` at 1e-10. With ten times
``rtol`` gradients through networks of relu take as long, and with a tenth of it a tenth more time;
their errors are the same."""

_TRIES = 2
"""Evaluations below the root after which the upper end of the bracket is checked."""

_EVALUATIONS = 80
"""Most evaluations of the margins in the search for one switch."""

_SECANTS = 24
"""Evaluations in the search from which brackets are halved: 56 times, to rounding."""


class SwitchPoint(NamedTuple):
    """First switch within a step: ``hit`` (B,), the fraction ``part`` of the step, ``levels``
    (K, B) to which the switches ``flips`` (K, B) turn there; fractions up to ``start_fraction``
    (B,) count as the start itself."""

    hit: Array
    part: Array
    levels: Array
    flips: Array
    start_fraction: Array


def first_switch(
    motion, options, progress: Progress, attempt: Attempt, t, accepted, eps
) -> SwitchPoint:
    """The first place within each step at which a margin falls below zero.

    Margins are known at a few stages. The first stage with a negative one gives a bracket; a
    minimum of the parabola through three neighbours that comes near zero is searched before it,
    because a margin may dip below zero and return between two stages. Brackets are closed by the
    Illinois rule (secant, with the retained end halved), every switch with a secant of its own and
    the earliest root taken. The search aims half the tolerance beyond the root, and ends where the
    secant says that the upper end is within the tolerance of it: 3 evaluations for a typical
    switch; 5 if the upper end is checked first, and both ends must come that near."""
    # The search has no derivatives: a loop whose body closed over tangents would carry them through
    # every iteration. `_differentiable_part` gives the place its derivatives afterwards.
    traced_constants = motion.coefficients, progress, attempt, t
    stopped_constants = jax.lax.stop_gradient(traced_constants)
    _, progress, attempt, t = stopped_constants
    nodes = motion.rule.margin_nodes
    sampled = margin_samples(attempt.margins, motion.rule)
    places = jnp.asarray(nodes, sampled.dtype)[:, None]
    size = len(nodes)
    below = jnp.any(sampled < 0, axis=1)  # (L, B)
    order = jnp.arange(size)[:, None]
    first_below = jnp.min(jnp.where(below, order, size), axis=0)

    def entry(storage, k):
        """Entry ``k`` (B,) along the first axis, as a sum, which a fused kernel can hold."""
        pick = order == k[None]
        pick = pick.reshape(size, *[1] * (storage.ndim - 2), -1)
        return jnp.sum(jnp.where(pick, storage, 0), axis=0)

    spots = jnp.broadcast_to(places, below.shape)
    low, high = entry(spots, first_below - 1), entry(spots, jnp.minimum(first_below, size - 1))
    at_low, at_high = (
        entry(sampled, first_below - 1),
        entry(sampled, jnp.minimum(first_below, size - 1)),
    )
    # of the minima the one that comes nearest to zero, before any negative margin
    depth = attempt.depths
    inner_order = jnp.arange(1, size - 1)[:, None, None]
    depth = jnp.where(inner_order < first_below[None, None], depth, 1)
    min_depth = jnp.min(depth, axis=(0, 1))
    dips = (min_depth <= 0.5) & accepted
    which = (depth == min_depth[None, None]) & dips[None, None]  # (L - 2, K, B)
    middle = jnp.min(jnp.where(jnp.any(which, axis=1), inner_order[:, 0], size), axis=0)
    owner = jnp.any(which & (inner_order == middle[None, None]), axis=0)  # (K, B)

    def lowest(margins):
        return jnp.min(jnp.where(owner, margins, jnp.inf), axis=0)

    triple = tuple(entry(spots, middle + k) for k in (-1, 0, 1))
    around = [entry(sampled, middle + k) for k in (-1, 0, 1)]
    values = tuple(lowest(margins) for margins in around)
    start_margins = jnp.maximum(
        around[0], 0
    )  # enough for the first secant, though the low end moves
    busy = accepted & jnp.any(below, axis=0)
    # a margin after the end is that of the state itself, those between are of stages
    is_at_end = busy & (first_below == size - 1)
    bracket = jnp.where(is_at_end, ROOT, jnp.where(busy, FIRST, DONE))
    mode = jnp.where(dips, MINIMUM, bracket)
    end = sampled[-1]
    zero = jnp.zeros_like(attempt.h)
    # Far from zero, margins of the time are constant between representable times (``grain`` eps of
    # the step). The search ends on the far side of the root: switches located to no more than that
    # would all turn late, and the jumps of a torque do work on the body.
    moment = jnp.maximum(progress.elapsed, jnp.abs(t))
    grain = moment / jnp.where(zero != attempt.h, abs(attempt.h), 1)
    tolerance = 4 * eps * jnp.maximum(1, grain / 16)
    if not motion.events:  # an event is located to rounding, a change of the rates is not
        rtol = options.rtol.astype(tolerance.dtype)
        kink = jnp.minimum(LOCATED_KINK * rtol, LOCATED_ROOT * jnp.sqrt(rtol))
        located = LOCATED_JUMP * rtol if motion.jumps else kink
        tolerance = jnp.maximum(tolerance, located)

    def margins_at(x, constants=stopped_constants):
        coefficients, progress, attempt, t = constants
        y = dense_state(progress.y, attempt.dense, x)
        _, margins, new_levels = motion.rates(coefficients, progress.levels, t + x * attempt.h, y)
        return margins, new_levels

    def root_share(at_low, at_high):
        """Fraction of the bracket at which the first secant vanishes."""
        begin, falls = jnp.maximum(at_low, 0), at_high < 0
        share = begin / jnp.where(falls, begin - at_high, 1)
        return jnp.min(jnp.where(falls, share, 1), axis=0)

    def secant(search):
        gap, room = search.high - search.low, tolerance / 2
        # margins that are zero over a part of the bracket defeat secants, not bisection
        halve = (search.count % 8 == 7) | (search.count >= _SECANTS)
        share = jnp.where(halve, 0.5, root_share(search.at_low, search.at_high))
        # nearer to an end than half the tolerance it could not move that end
        x = jnp.maximum(search.low + gap * share, search.low) + room
        return jnp.minimum(x, search.high - room)

    def iterate(search: _RootSearch) -> _RootSearch:
        in_minimum, in_upper_end = search.mode == MINIMUM, search.mode == UPPER_END
        in_first, in_root = search.mode == FIRST, search.mode == ROOT
        (xa, xb, xc), (fa, fb, fc) = search.triple, search.values
        vertex, _ = vertex_of(search.triple, search.values)
        room = 0.05 * (xc - xa)
        vertex = jnp.clip(vertex, xa + room, xc - room)
        vertex = jnp.where(jnp.abs(vertex - xb) < 0.2 * room, xb + 0.3 * room, vertex)
        x = jnp.where(in_minimum, vertex, jnp.where(in_upper_end, search.high, secant(search)))
        margins, new_levels = margins_at(x)
        under = jnp.any(margins < 0, axis=0)
        f = lowest(margins)

        # minimum
        is_left = vertex < xb
        is_lower = f < fb
        ta = jnp.where(is_lower, jnp.where(is_left, xa, xb), jnp.where(is_left, vertex, xa))
        tb = jnp.where(is_lower, vertex, xb)
        tc = jnp.where(is_lower, jnp.where(is_left, xb, xc), jnp.where(is_left, xc, vertex))
        va = jnp.where(is_lower, jnp.where(is_left, fa, fb), jnp.where(is_left, f, fa))
        vb = jnp.where(is_lower, f, fb)
        vc = jnp.where(is_lower, jnp.where(is_left, fb, fc), jnp.where(is_left, fc, f))
        _, bottom = vertex_of((ta, tb, tc), (va, vb, vc))
        over = (bottom > 0.7 * vb) | (search.count > 12)
        dipped = in_minimum & under
        flat = in_minimum & ~under & over  # no switch here: go on to the bracket of a later stage

        # a negative margin of a stage may be positive on dense output
        is_false = in_upper_end & ~under
        has_later_root = is_false & jnp.any(end < 0, axis=0) & (search.high < 1)
        retry_mode = jnp.where(search.count < _TRIES, FIRST, UPPER_END)
        mode = jnp.where(in_first, jnp.where(under, ROOT, retry_mode), search.mode)
        mode = jnp.where(in_upper_end, jnp.where(under | has_later_root, ROOT, DONE), mode)
        mode = jnp.where(dipped, ROOT, jnp.where(flat, bracket, mode))

        # between low and high
        down = (in_root | in_first | in_upper_end | dipped) & under
        up = (in_root | in_first) & ~under
        twice = search.side == jnp.where(under, 1, -1)
        start_low = jnp.where(dipped, xa, jnp.where(flat, low, search.low))
        m_low = pick(flat, at_low, search.at_low)
        m_low = pick(dipped, start_margins, m_low)
        new_low = jnp.where(up, x, jnp.where(has_later_root, search.high, start_low))
        new_high = jnp.where(
            down, x, jnp.where(has_later_root, 1, jnp.where(flat, high, search.high))
        )
        half = jnp.where((in_root | in_first) & twice, 0.5, 1)
        new_at_low = pick(up | has_later_root, margins, m_low * jnp.where(down, half, 1)[None])
        high_margins = pick(has_later_root, end, pick(flat, at_high, search.at_high))
        new_at_high = pick(down, margins, high_margins * jnp.where(up, half, 1)[None])
        left_over = (new_high - new_low) * (1 - root_share(new_at_low, new_at_high))
        tight = (mode == ROOT) & (left_over <= tolerance) & (down | (in_root & up))
        stop = tight | (search.count >= _EVALUATIONS)
        hit = search.hit | ((mode == ROOT) & stop)
        starts_bracket = dipped | flat
        return _RootSearch(
            jnp.where(stop, DONE, mode),
            new_low,
            new_high,
            new_at_low,
            new_at_high,
            pick(down, new_levels, search.new_levels) if motion.jumps else None,
            jnp.where(
                in_root | in_first,
                jnp.where(under, 1, -1),
                jnp.where(starts_bracket, 0, search.side),
            ),
            (ta, tb, tc),
            (va, vb, vc),
            jnp.where(starts_bracket, 0, search.count + 1),
            hit,
        )

    zero_counts = jnp.zeros(zero.shape, jnp.int32)
    search = _RootSearch(
        mode,
        low,
        high,
        at_low,
        at_high,
        progress.levels if motion.jumps else None,
        zero_counts,
        triple,
        values,
        zero_counts,
        jnp.zeros_like(accepted),
    )
    search = jax.lax.while_loop(lambda c: any_of(jnp.where(c.mode > 0, 1.0, 0.0)), iterate, search)
    # halved margins keep their signs
    flips = first_of_jumps(motion, search.at_high < 0)
    part = search.high
    if options.differentiable:
        margins = partial(margins_at, constants=traced_constants)
        part = _differentiable_part(search.hit, flips, part, margins)
    is_lost = search.hit & ~jnp.any(flips, axis=0)
    start_fraction = jnp.maximum(1e-3, 16 * eps * grain)
    # kinks and events have the levels 0 and 1
    levels = 1 - progress.levels if search.new_levels is None else search.new_levels
    return SwitchPoint(search.hit & ~is_lost, part, levels, flips, start_fraction)


def is_unresolved(motion, margins: Array, rule: Tableau) -> Array:
    """Whether a margin of a jump, of an event or of the time turns back more than once within the
    step (B,), or once by most of its size: its next turn may then lie between two stages.

    The field with its levels held may hardly change where they do: a body that the Sun lights turns
    so slowly that one step could lead from sunlight to sunlight, several shadows between. Margins
    of kinks that move with the state are not looked at: they are as smooth as the state, networks
    have many, and where one is rounding alone steps would become short for nothing."""
    sampled = jnp.stack([margin_samples(margins, rule)[:, k] for k in motion.swift], axis=1)
    size = jnp.max(jnp.abs(sampled), axis=0)
    least, deep = control.MARGIN_TURN * size, control.DEEP_TURN * size
    # extremes since the last turn: smaller turns than the least are rounding, or errors of stages
    low = high = sampled[0]
    rises = falls = turns = jnp.zeros_like(low)
    for margin in sampled[1:]:
        up = (margin - low > least) & (rises == 0)
        down = (high - margin > least) & (falls == 0) & ~up
        turns = turns + jnp.where((up & (falls > 0)) | (down & (rises > 0)), 1, 0)
        rises = jnp.where(up, 1, jnp.where(down, 0, rises))
        falls = jnp.where(down, 1, jnp.where(up, 0, falls))
        low = jnp.where(down, margin, jnp.minimum(low, margin))
        high = jnp.where(up, margin, jnp.maximum(high, margin))
    top, bottom = jnp.max(sampled, axis=0), jnp.min(sampled, axis=0)
    ends = jnp.maximum(sampled[0], sampled[-1]), jnp.minimum(sampled[0], sampled[-1])
    is_deep = (top - ends[0] > deep) | (ends[1] - bottom > deep)
    return jnp.any((turns > 1) | is_deep, axis=0)


def first_of_jumps(motion, flips: Array) -> Array:
    """Of switches (K, B) that would turn together, among which the rates jump at some, the first of
    these, and events. The other ones may depend on it, as comparisons do in a search in a table:
    whether they turn too is seen at the start of the next step."""
    if not motion.jumps:
        return flips
    order = jnp.arange(motion.switches)[:, None]
    is_jump = jnp.asarray(motion.jumps)[:, None]
    first = jnp.min(jnp.where(flips & is_jump, order, motion.switches), axis=0)[None]
    is_event = order >= motion.switches - motion.events
    return flips & ((first == motion.switches) | (order == first) | is_event)


DONE, ROOT, UPPER_END, MINIMUM, FIRST = range(5)
"""What the search in a step does next: nothing; close the bracket between ``low`` and ``high``, of
which ``high`` has a negative margin; see whether it has; go down to a minimum; or try the root
before ``high`` has been seen."""


class _RootSearch(NamedTuple):
    """Carry of the search: see ``DONE``. ``at_low``, ``at_high`` (K, B): margins at the ends of the
    bracket; ``side`` (B,): the end that moved last; ``triple``, ``values``: places around a minimum
    and the least margin there; ``count`` of evaluations."""

    mode: Array
    low: Array
    high: Array
    at_low: Array
    at_high: Array
    new_levels: Array | None
    side: Array
    triple: tuple[Array, ...]
    values: tuple[Array, ...]
    count: Array
    hit: Array


def _differentiable_part(hit: Array, flips: Array, part: Array, margins_at) -> Array:
    """The place of a switch with first and second derivatives: two steps of Newton's rule with one
    derivative for both."""
    stop_gradient = jax.lax.stop_gradient
    share = jnp.where(flips, 1, 0).astype(part.dtype)
    share = share / jnp.maximum(jnp.sum(share, axis=0, keepdims=True), 1)

    def value(x):
        return jnp.sum(jnp.where(flips, share * margins_at(x)[0], 0), axis=0)

    _, slope = jax.jvp(value, (part,), (jnp.ones_like(part),))
    slope = stop_gradient(jnp.where(hit & (slope != 0), slope, 1))
    for _ in range(2):
        change = jnp.where(hit, -value(part) / slope, 0)
        part = part + (change - stop_gradient(change))
    return part


def pick(where: Array, a: Array, b: Array) -> Array:
    """Select for each body between (K, B) arrays."""
    return jnp.where(where[None], a, b)


class Undefined(NamedTuple):
    """Steps during which the field is undefined on the side that is assumed, as that of ``where(x >
    0, sqrt(x), 0)`` with ``x > 0`` held: ``is_undefined`` (B,); ``flips`` (K, B): switches that
    were passed; ``snaps`` (B,): whether the start is so near that they turn there."""

    is_undefined: Array
    flips: Array
    snaps: Array


def undefined_side(
    attempt: Attempt, ratio: Array, is_running: Array, rule: Tableau
) -> tuple[Undefined, Array]:
    """Such steps, and the fraction of each up to the first switch."""
    margins, nodes = attempt.margins[: rule.stages], rule.nodes[: rule.stages]
    below = margins < 0
    order = jnp.arange(rule.stages)[:, None]
    stage = jnp.min(jnp.where(jnp.any(below, axis=1), order, rule.stages), axis=0)
    pick = order == stage[None]
    stage_margins = jnp.sum(jnp.where(pick[:, None], jnp.where(below, margins, 0), 0), axis=0)
    node = jnp.sum(jnp.where(pick, jnp.asarray(nodes, ratio.dtype)[:, None], 0), axis=0)
    begin = jnp.maximum(margins[0], 0)
    flips = stage_margins < 0
    share = jnp.min(jnp.where(flips, begin / jnp.where(flips, begin - stage_margins, 1), 1), axis=0)
    is_undefined = is_running & ~jnp.isfinite(ratio) & jnp.any(flips, axis=0)
    return Undefined(is_undefined, flips, is_undefined), jax.lax.stop_gradient(node * share)
