"""Location of the first switch of the field, or of the first event, within a step."""

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
"""Widths of the bracket within which a switch is located, relative to the step: ``LOCATED_JUMP *
rtol`` at a jump, and ``min(LOCATED_KINK * rtol, LOCATED_ROOT * sqrt(rtol))`` at a kink.

The error of a step that ends beyond a jump is the change of the rates times this width; beyond a
kink it is proportional to the square of the width. Both are far below the tolerance of a step.
Derivatives through a kink, however, have an error of the width itself. The square root alone, which
is sufficient for ``rtol`` of 1e-2 or larger, would leave errors of 100 ``rtol`` at 1e-10. For
gradients through networks of relu, 10 ``rtol`` takes as long as ``rtol`` and 0.1 ``rtol`` a tenth
more time; their errors are the same."""

_TRIES = 2
"""Evaluations with positive margins after which the upper end of the bracket is checked."""

_EVALUATIONS = 80
"""Maximum number of evaluations of the margins in the search for one switch."""

_SECANTS = 24
"""Number of evaluations after which brackets are bisected: 56 more reduce them to rounding."""


class SwitchPoint(NamedTuple):
    """First switch within a step: ``hit`` (B,), whether there is one; ``part`` (B,), its fraction
    of the step; ``flips`` (K, B), the switches that turn there; ``levels`` (K, B), their new
    levels. Fractions up to ``start_fraction`` (B,) count as the start of the step."""

    hit: Array
    part: Array
    levels: Array
    flips: Array
    start_fraction: Array


def first_switch(
    motion, options, progress: Progress, attempt: Attempt, t, accepted, eps
) -> SwitchPoint:
    """The first point within each step at which a margin falls below zero.

    Margins are available at a few stages. The first stage with a negative margin gives a bracket.
    A margin may fall below zero and return between two stages; therefore, if the parabola through
    three neighbouring margins has a minimum close to zero, this minimum is examined first. Brackets
    are closed by the Illinois method (secants, with the value at the retained end halved); each
    switch has a secant of its own, and the earliest root is used. The search aims half the
    tolerance beyond the root, and ends when by the secant the upper end is within the tolerance of
    the root. This takes 3 evaluations for a typical switch. It would take 5 if the upper end were
    checked first and both ends had to be that close."""
    # The search is not differentiated: a loop over traced tangents would carry them through every
    # iteration. `_differentiable_part` adds the derivatives of the root afterwards.
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
        """Entry ``k`` (B,) along the first axis, as a sum, which a fused kernel can contain."""
        pick = order == k[None]
        pick = pick.reshape(size, *[1] * (storage.ndim - 2), -1)
        return jnp.sum(jnp.where(pick, storage, 0), axis=0)

    spots = jnp.broadcast_to(places, below.shape)
    low, high = entry(spots, first_below - 1), entry(spots, jnp.minimum(first_below, size - 1))
    at_low, at_high = (
        entry(sampled, first_below - 1),
        entry(sampled, jnp.minimum(first_below, size - 1)),
    )
    # the minimum closest to zero among those before the first negative margin
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
    )  # sufficient for the first secant, although the lower end moves
    busy = accepted & jnp.any(below, axis=0)
    # A negative margin at the last node is that of the state at the end of the step, and is
    # certain. Those at other nodes belong to stages, which are less accurate than dense output.
    is_at_end = busy & (first_below == size - 1)
    bracket = jnp.where(is_at_end, ROOT, jnp.where(busy, FIRST, DONE))
    mode = jnp.where(dips, MINIMUM, bracket)
    end = sampled[-1]
    zero = jnp.zeros_like(attempt.h)
    # At large times, margins that depend on the time are constant between representable times,
    # which are ``grain`` eps of the step apart. The search ends beyond the root, so that switches
    # located to one such interval would all turn late, and jumps of a torque would do false work.
    moment = jnp.maximum(progress.elapsed, jnp.abs(t))
    grain = moment / jnp.where(zero != attempt.h, abs(attempt.h), 1)
    tolerance = 4 * eps * jnp.maximum(1, grain / 16)
    if not motion.events:  # events are located to rounding, switches of the rates to ``rtol``
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
        # secants do not converge if margins are zero in a part of the bracket; bisection does
        halve = (search.count % 8 == 7) | (search.count >= _SECANTS)
        share = jnp.where(halve, 0.5, root_share(search.at_low, search.at_high))
        # points closer than half the tolerance to an end would hardly shorten the bracket
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
        flat = in_minimum & ~under & over  # no root here: continue with the bracket of a stage

        # a margin that is negative at a stage may be positive on dense output
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
    """Whether (B,) a margin of a jump, of an event or of the time has more than one turning point
    within the step, or one by most of its size: a further one may then lie between two stages.

    The error control does not see this, because the field with fixed levels may hardly change: a
    body in sunlight may rotate so slowly that one step leads from sunlight to sunlight, with
    several shadows in between. Margins of kinks that vary with the state are not examined: they are
    as smooth as the state, networks have many of them, and one that is rounding alone would shorten
    the steps for no reason."""
    sampled = jnp.stack([margin_samples(margins, rule)[:, k] for k in motion.swift], axis=1)
    size = jnp.max(jnp.abs(sampled), axis=0)
    least, deep = control.MARGIN_TURN * size, control.DEEP_TURN * size
    # ``low`` and ``high``: extremes since the last turning point. Changes smaller than ``least``
    # are rounding or errors of the stages.
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
    """``flips`` (K, B) without those switches that may depend on another one that turns.

    If the rates jump at several switches that would turn together, only the first of these, and
    events, turn. The others may depend on the first one, as comparisons in a search in a table do;
    whether they turn as well is decided at the start of the next step."""
    if not motion.jumps:
        return flips
    order = jnp.arange(motion.switches)[:, None]
    is_jump = jnp.asarray(motion.jumps)[:, None]
    first = jnp.min(jnp.where(flips & is_jump, order, motion.switches), axis=0)[None]
    is_event = order >= motion.switches - motion.events
    return flips & ((first == motion.switches) | (order == first) | is_event)


DONE, ROOT, UPPER_END, MINIMUM, FIRST = range(5)
"""Next action of the search in a step. DONE: nothing. ROOT: close the bracket between ``low`` and
``high``, whose margin at ``high`` is negative. UPPER_END: check whether it is. MINIMUM: approach a
minimum. FIRST: evaluate the secant's root before ``high`` has been checked."""


class _RootSearch(NamedTuple):
    """Carry of the search. ``mode``: see ``DONE``; ``at_low``, ``at_high`` (K, B): margins at the
    ends of the bracket; ``side`` (B,): which end moved last; ``triple``, ``values``: three points
    around a minimum and the lowest margin at each; ``count`` of evaluations."""

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
    """The fraction at which a switch turns, with first and second derivatives: two steps of
    Newton's method with the same derivative of the margin."""
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
    """Steps in which the field with fixed levels becomes undefined, as ``where(x > 0, sqrt(x), 0)``
    does with ``x > 0`` fixed: ``is_undefined`` (B,); ``flips`` (K, B): the switches crossed;
    ``snaps`` (B,): whether the start is so close to them that they turn there."""

    is_undefined: Array
    flips: Array
    snaps: Array


def undefined_side(
    attempt: Attempt, ratio: Array, is_running: Array, rule: Tableau
) -> tuple[Undefined, Array]:
    """Steps in which the field becomes undefined, and the fraction of each up to the switch."""
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
