"""Location of the first switch of the field, or of the first event, within a step."""

from collections.abc import Callable
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

_MAX_POSITIVE_EVALUATIONS = 2
"""Evaluations with positive margins after which the upper end of the bracket is checked."""

_MAX_EVALUATIONS = 80
"""Maximum number of evaluations of the margins in the search for one switch."""

_MAX_SECANTS = 24
"""Number of evaluations after which brackets are bisected: 56 more reduce them to rounding."""


class SwitchPoint(NamedTuple):
    """First switch within a step: ``hit`` (B,), whether there is one; ``fraction`` (B,), its
    fraction of the step; ``flips`` (K, B), the switches that flip there; ``levels`` (K, B), their
    new levels. Fractions up to ``start_fraction`` (B,) count as the start of the step."""

    hit: Array
    fraction: Array
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
    # iteration. `_differentiable_fraction` adds the derivatives of the root afterwards.
    traced_constants = motion.coefficients, progress, attempt, t
    stopped_constants = jax.lax.stop_gradient(traced_constants)
    _, progress, attempt, t = stopped_constants
    start = _search_start(motion.rule, attempt, accepted)
    tolerance, time_spacing = _tolerance(motion, options, progress, attempt, t, eps)

    def margins_at(x, constants=stopped_constants):
        coefficients, progress, attempt, t = constants
        y = dense_state(progress.y, attempt.dense, x)
        _, margins, new_levels = motion.rates(coefficients, progress.levels, t + x * attempt.h, y)
        return margins, new_levels

    zero_counts = jnp.zeros(attempt.h.shape, jnp.int32)
    search = _RootSearch(
        jnp.where(start.has_minimum, MINIMUM, start.mode),
        start.low,
        start.high,
        start.at_low,
        start.at_high,
        progress.levels if motion.jumps else None,
        zero_counts,
        start.triple,
        start.values,
        zero_counts,
        jnp.zeros_like(accepted),
    )
    search = jax.lax.while_loop(
        lambda c: any_of(jnp.where(c.mode > 0, 1.0, 0.0)),
        partial(_next_search, start, tolerance, margins_at),
        search,
    )
    # halved margins keep their signs
    flips = first_of_jumps(motion, search.at_high < 0)
    fraction = search.high
    if options.differentiable:
        margins = partial(margins_at, constants=traced_constants)
        fraction = _differentiable_fraction(search.hit, flips, fraction, margins)
    is_lost = search.hit & ~jnp.any(flips, axis=0)
    start_fraction = jnp.maximum(1e-3, 16 * eps * time_spacing)
    # kinks and events have the levels 0 and 1
    levels = 1 - progress.levels if search.new_levels is None else search.new_levels
    return SwitchPoint(search.hit & ~is_lost, fraction, levels, flips, start_fraction)


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


class _SearchStart(NamedTuple):
    """The start of a search, from the margins at the stages.

    ``mode``, ``low``, ``high``, ``at_low``, ``at_high``: the bracket before the first stage with a
    negative margin, as in ``_RootSearch``; ``has_minimum`` (B,): whether a minimum before it is
    close to zero; ``triple``, ``values``: three points around that minimum and the lowest margin at
    each, of the switches ``minimum_switches`` (K, B); ``minimum_start`` (K, B): margins at the
    first of the three points; ``end_margins`` (K, B): at the end of the step."""

    mode: Array
    low: Array
    high: Array
    at_low: Array
    at_high: Array
    has_minimum: Array
    triple: tuple[Array, ...]
    values: tuple[Array, ...]
    minimum_switches: Array
    minimum_start: Array
    end_margins: Array


def _search_start(rule: Tableau, attempt: Attempt, accepted: Array) -> _SearchStart:
    """Bracket and minimum from which the search starts."""
    nodes = rule.margin_nodes
    sampled = margin_samples(attempt.margins, rule)
    node_column = jnp.asarray(nodes, sampled.dtype)[:, None]
    size = len(nodes)
    below = jnp.any(sampled < 0, axis=1)  # (L, B)
    order = jnp.arange(size)[:, None]
    first_below = jnp.min(jnp.where(below, order, size), axis=0)

    def entry(storage, k):
        """Entry ``k`` (B,) along the first axis, as a sum, which a fused kernel can contain."""
        is_entry = order == k[None]
        is_entry = is_entry.reshape(size, *[1] * (storage.ndim - 2), -1)
        return jnp.sum(jnp.where(is_entry, storage, 0), axis=0)

    node_grid = jnp.broadcast_to(node_column, below.shape)
    low, high = (
        entry(node_grid, first_below - 1),
        entry(node_grid, jnp.minimum(first_below, size - 1)),
    )
    at_low, at_high = (
        entry(sampled, first_below - 1),
        entry(sampled, jnp.minimum(first_below, size - 1)),
    )
    # the minimum closest to zero among those before the first negative margin
    depth = attempt.depths
    inner_order = jnp.arange(1, size - 1)[:, None, None]
    depth = jnp.where(inner_order < first_below[None, None], depth, 1)
    min_depth = jnp.min(depth, axis=(0, 1))
    has_minimum = (min_depth <= 0.5) & accepted
    is_lowest = (depth == min_depth[None, None]) & has_minimum[None, None]  # (L - 2, K, B)
    lowest_node = jnp.min(jnp.where(jnp.any(is_lowest, axis=1), inner_order[:, 0], size), axis=0)
    minimum_switches = jnp.any(is_lowest & (inner_order == lowest_node[None, None]), axis=0)
    triple = tuple(entry(node_grid, lowest_node + k) for k in (-1, 0, 1))
    neighbours = [entry(sampled, lowest_node + k) for k in (-1, 0, 1)]
    values = tuple(_lowest(minimum_switches, margins) for margins in neighbours)
    # sufficient for the first secant, although the lower end moves
    minimum_start = jnp.maximum(neighbours[0], 0)
    has_bracket = accepted & jnp.any(below, axis=0)
    # A negative margin at the last node is that of the state at the end of the step, and is
    # certain. Those at other nodes belong to stages, which are less accurate than dense output.
    is_at_end = has_bracket & (first_below == size - 1)
    return _SearchStart(
        jnp.where(is_at_end, ROOT, jnp.where(has_bracket, FIRST, DONE)),
        low,
        high,
        at_low,
        at_high,
        has_minimum,
        triple,
        values,
        minimum_switches,
        minimum_start,
        sampled[-1],
    )


def _lowest(switches: Array, margins: Array) -> Array:
    """The lowest of ``margins`` (K, B) of the given ``switches`` (K, B)."""
    return jnp.min(jnp.where(switches, margins, jnp.inf), axis=0)


def _tolerance(
    motion, options, progress: Progress, attempt: Attempt, t: Array, eps: float
) -> tuple[Array, Array]:
    """Width of the bracket within which a switch is located, as a fraction of the step, and the
    spacing of representable times [eps of the step]."""
    # At large times, margins that depend on the time are constant between representable times. The
    # search ends beyond the root, so that switches located to one such interval would all flip
    # late, and jumps of a torque would do false work.
    latest_time = jnp.maximum(progress.elapsed, jnp.abs(t))
    time_spacing = latest_time / jnp.where(attempt.h != 0, abs(attempt.h), 1)
    tolerance = 4 * eps * jnp.maximum(1, time_spacing / 16)
    if not motion.events:  # events are located to rounding, switches of the rates to ``rtol``
        rtol = options.rtol.astype(tolerance.dtype)
        kink = jnp.minimum(LOCATED_KINK * rtol, LOCATED_ROOT * jnp.sqrt(rtol))
        located = LOCATED_JUMP * rtol if motion.jumps else kink
        tolerance = jnp.maximum(tolerance, located)
    return tolerance, time_spacing


def _root_share(at_low: Array, at_high: Array) -> Array:
    """Fraction of the bracket at which the first secant vanishes."""
    low_margins, falls = jnp.maximum(at_low, 0), at_high < 0
    share = low_margins / jnp.where(falls, low_margins - at_high, 1)
    return jnp.min(jnp.where(falls, share, 1), axis=0)


def _secant(search: _RootSearch, tolerance: Array) -> Array:
    """The next point within a bracket."""
    bracket_width, min_distance = search.high - search.low, tolerance / 2
    # secants do not converge if margins are zero in a part of the bracket; bisection does
    halve = (search.count % 8 == 7) | (search.count >= _MAX_SECANTS)
    share = jnp.where(halve, 0.5, _root_share(search.at_low, search.at_high))
    # points closer than half the tolerance to an end would hardly shorten the bracket
    x = jnp.maximum(search.low + bracket_width * share, search.low) + min_distance
    return jnp.minimum(x, search.high - min_distance)


def _point_towards_minimum(search: _RootSearch) -> Array:
    """The next point in the search for a minimum: the vertex of the parabola, but neither close to
    one of the three points nor beyond them."""
    xa, xb, xc = search.triple
    vertex, _ = vertex_of(search.triple, search.values)
    min_distance = 0.05 * (xc - xa)
    vertex = jnp.clip(vertex, xa + min_distance, xc - min_distance)
    return jnp.where(jnp.abs(vertex - xb) < 0.2 * min_distance, xb + 0.3 * min_distance, vertex)


def _next_triple(search: _RootSearch, x: Array, f: Array) -> tuple[tuple, tuple, Array]:
    """Three points closer to a minimum and the values there, after an evaluation ``f`` at ``x``;
    and the minimum of their parabola."""
    (xa, xb, xc), (fa, fb, fc) = search.triple, search.values
    is_left = x < xb
    is_lower = f < fb
    ta = jnp.where(is_lower, jnp.where(is_left, xa, xb), jnp.where(is_left, x, xa))
    tb = jnp.where(is_lower, x, xb)
    tc = jnp.where(is_lower, jnp.where(is_left, xb, xc), jnp.where(is_left, xc, x))
    va = jnp.where(is_lower, jnp.where(is_left, fa, fb), jnp.where(is_left, f, fa))
    vb = jnp.where(is_lower, f, fb)
    vc = jnp.where(is_lower, jnp.where(is_left, fb, fc), jnp.where(is_left, fc, f))
    _, min_value = vertex_of((ta, tb, tc), (va, vb, vc))
    return (ta, tb, tc), (va, vb, vc), min_value


def _next_search(
    start: _SearchStart,
    tolerance: Array,
    margins_at: Callable[[Array], tuple[Array, Array]],
    search: _RootSearch,
) -> _RootSearch:
    """The search after one more evaluation; ``margins_at(x)``: margins and new levels (K, B)."""
    in_minimum, in_upper_end = search.mode == MINIMUM, search.mode == UPPER_END
    in_first, in_root = search.mode == FIRST, search.mode == ROOT
    vertex = _point_towards_minimum(search)
    x = jnp.where(in_upper_end, search.high, _secant(search, tolerance))
    x = jnp.where(in_minimum, vertex, x)
    margins, new_levels = margins_at(x)
    is_negative = jnp.any(margins < 0, axis=0)

    # minimum
    f = _lowest(start.minimum_switches, margins)
    triple, values, min_value = _next_triple(search, vertex, f)
    is_exhausted = (min_value > 0.7 * values[1]) | (search.count > 12)
    minimum_is_negative = in_minimum & is_negative
    # no root at the minimum: continue with the bracket of a stage
    has_no_root = in_minimum & ~is_negative & is_exhausted

    # a margin that is negative at a stage may be positive on dense output
    is_false = in_upper_end & ~is_negative
    has_later_root = is_false & jnp.any(start.end_margins < 0, axis=0) & (search.high < 1)
    retry_mode = jnp.where(search.count < _MAX_POSITIVE_EVALUATIONS, FIRST, UPPER_END)
    mode = jnp.where(in_first, jnp.where(is_negative, ROOT, retry_mode), search.mode)
    mode = jnp.where(in_upper_end, jnp.where(is_negative | has_later_root, ROOT, DONE), mode)
    mode = jnp.where(minimum_is_negative, ROOT, jnp.where(has_no_root, start.mode, mode))

    # between low and high
    moves_high = (in_root | in_first | in_upper_end | minimum_is_negative) & is_negative
    moves_low = (in_root | in_first) & ~is_negative
    same_end_twice = search.side == jnp.where(is_negative, 1, -1)
    start_low = jnp.where(has_no_root, start.low, search.low)
    start_low = jnp.where(minimum_is_negative, search.triple[0], start_low)
    low_margins = select_bodies(has_no_root, start.at_low, search.at_low)
    low_margins = select_bodies(minimum_is_negative, start.minimum_start, low_margins)
    new_low = jnp.where(moves_low, x, jnp.where(has_later_root, search.high, start_low))
    new_high = jnp.where(
        moves_high,
        x,
        jnp.where(has_later_root, 1, jnp.where(has_no_root, start.high, search.high)),
    )
    factor = jnp.where((in_root | in_first) & same_end_twice, 0.5, 1)
    new_at_low = select_bodies(
        moves_low | has_later_root,
        margins,
        low_margins * jnp.where(moves_high, factor, 1)[None],
    )
    high_margins = select_bodies(
        has_later_root,
        start.end_margins,
        select_bodies(has_no_root, start.at_high, search.at_high),
    )
    new_at_high = select_bodies(
        moves_high, margins, high_margins * jnp.where(moves_low, factor, 1)[None]
    )
    remaining_width = (new_high - new_low) * (1 - _root_share(new_at_low, new_at_high))
    is_converged = (
        (mode == ROOT) & (remaining_width <= tolerance) & (moves_high | (in_root & moves_low))
    )
    stop = is_converged | (search.count >= _MAX_EVALUATIONS)
    hit = search.hit | ((mode == ROOT) & stop)
    starts_bracket = minimum_is_negative | has_no_root
    return _RootSearch(
        jnp.where(stop, DONE, mode),
        new_low,
        new_high,
        new_at_low,
        new_at_high,
        select_bodies(moves_high, new_levels, search.new_levels)
        if search.new_levels is not None
        else None,
        jnp.where(
            in_root | in_first,
            jnp.where(is_negative, 1, -1),
            jnp.where(starts_bracket, 0, search.side),
        ),
        triple,
        values,
        jnp.where(starts_bracket, 0, search.count + 1),
        hit,
    )


def is_unresolved(motion, margins: Array, rule: Tableau) -> Array:
    """Whether (B,) a margin of a jump, of an event or of the time has more than one turning point
    within the step, or one by most of its size: a further one may then lie between two stages.

    The error control does not see this, because the field with fixed levels may hardly change: a
    body in sunlight may rotate so slowly that one step leads from sunlight to sunlight, with
    several shadows in between. Margins of kinks that vary with the state are not examined: they are
    as smooth as the state, networks have many of them, and one that is rounding alone would shorten
    the steps for no reason."""
    sampled = jnp.stack(
        [margin_samples(margins, rule)[:, k] for k in motion.resolved_switches], axis=1
    )
    size = jnp.max(jnp.abs(sampled), axis=0)
    min_change, deep_change = control.MARGIN_VARIATION * size, control.DEEP_EXTREMUM * size
    # ``low`` and ``high``: extremes since the last turning point. Changes smaller than
    # ``min_change`` are rounding or errors of the stages.
    low = high = sampled[0]
    rises = falls = turning_points = jnp.zeros_like(low)
    for margin in sampled[1:]:
        starts_rise = (margin - low > min_change) & (rises == 0)
        starts_fall = (high - margin > min_change) & (falls == 0) & ~starts_rise
        turning_points = turning_points + jnp.where(
            (starts_rise & (falls > 0)) | (starts_fall & (rises > 0)), 1, 0
        )
        rises = jnp.where(starts_rise, 1, jnp.where(starts_fall, 0, rises))
        falls = jnp.where(starts_fall, 1, jnp.where(starts_rise, 0, falls))
        low = jnp.where(starts_fall, margin, jnp.minimum(low, margin))
        high = jnp.where(starts_rise, margin, jnp.maximum(high, margin))
    max_margin, min_margin = jnp.max(sampled, axis=0), jnp.min(sampled, axis=0)
    end_range = jnp.maximum(sampled[0], sampled[-1]), jnp.minimum(sampled[0], sampled[-1])
    is_deep = (max_margin - end_range[0] > deep_change) | (end_range[1] - min_margin > deep_change)
    return jnp.any((turning_points > 1) | is_deep, axis=0)


def first_of_jumps(motion, flips: Array) -> Array:
    """``flips`` (K, B) without those switches that may depend on another one that flips.

    If the rates jump at several switches that would flip together, only the first of these, and
    events, flip. The others may depend on the first one, as comparisons in a search in a table do;
    whether they flip as well is decided at the start of the next step."""
    if not motion.jumps:
        return flips
    order = jnp.arange(motion.switches)[:, None]
    is_jump = jnp.asarray(motion.jumps)[:, None]
    first_jump = jnp.min(jnp.where(flips & is_jump, order, motion.switches), axis=0)[None]
    is_event = order >= motion.switches - motion.events
    return flips & ((first_jump == motion.switches) | (order == first_jump) | is_event)


def _differentiable_fraction(hit: Array, flips: Array, fraction: Array, margins_at) -> Array:
    """The fraction at which a switch flips, with first and second derivatives: two steps of
    Newton's method with the same derivative of the margin."""
    stop_gradient = jax.lax.stop_gradient
    weights = jnp.where(flips, 1, 0).astype(fraction.dtype)
    weights = weights / jnp.maximum(jnp.sum(weights, axis=0, keepdims=True), 1)

    def value(x):
        return jnp.sum(jnp.where(flips, weights * margins_at(x)[0], 0), axis=0)

    _, margin_rate = jax.jvp(value, (fraction,), (jnp.ones_like(fraction),))
    margin_rate = stop_gradient(jnp.where(hit & (margin_rate != 0), margin_rate, 1))
    for _ in range(2):
        change = jnp.where(hit, -value(fraction) / margin_rate, 0)
        fraction = fraction + (change - stop_gradient(change))
    return fraction


def select_bodies(where: Array, a: Array, b: Array) -> Array:
    """Select for each body between (K, B) arrays."""
    return jnp.where(where[None], a, b)


class Undefined(NamedTuple):
    """Steps in which the field with fixed levels becomes undefined, as ``where(x > 0, sqrt(x), 0)``
    does with ``x > 0`` fixed: ``is_undefined`` (B,); ``flips`` (K, B): the switches crossed;
    ``snaps`` (B,): whether the start is so close to them that they flip there."""

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
    is_stage = order == stage[None]
    stage_margins = jnp.sum(jnp.where(is_stage[:, None], jnp.where(below, margins, 0), 0), axis=0)
    node = jnp.sum(jnp.where(is_stage, jnp.asarray(nodes, ratio.dtype)[:, None], 0), axis=0)
    start_margins = jnp.maximum(margins[0], 0)
    flips = stage_margins < 0
    share = jnp.min(
        jnp.where(flips, start_margins / jnp.where(flips, start_margins - stage_margins, 1), 1),
        axis=0,
    )
    is_undefined = is_running & ~jnp.isfinite(ratio) & jnp.any(flips, axis=0)
    return Undefined(is_undefined, flips, is_undefined), jax.lax.stop_gradient(node * share)
