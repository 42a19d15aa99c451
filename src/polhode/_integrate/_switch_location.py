"""Where within a step the first switch of the field turns, or the first event lies."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._integrate._explicit_step import (
    Attempt,
    Progress,
    dense_state,
    margin_samples,
    vertex_of,
)
from polhode._integrate._tableau import Tableau
from polhode._kernels import any_of

LOCATED_JUMP, LOCATED_KINK = 1e-4, 0.1
"""Width of the bracket of a switch of the field, relative to the step and to ``rtol``. A step
beyond a jump adds an error of the change of the rates times this, far below the error of a step;
one beyond a kink adds its square. The gradient of 32 bodies through a network of relu has the same
error with 1 as with 1e-4, which takes a quarter more time."""

_EVALUATIONS = 60
"""Most evaluations of the margins in the search for one switch."""


class SwitchPoint(NamedTuple):
    """First switch within a step: ``hit`` (B,), the fraction ``part`` of the step, ``state`` (D, B)
    there, ``levels`` (K, B) to which the switches ``flips`` (K, B) turn; fractions up to ``near``
    (B,) count as the start itself."""

    hit: Array
    part: Array
    state: Array
    levels: Array
    flips: Array
    near: Array


def first_switch(
    motion, options, progress: Progress, attempt: Attempt, t, accepted, eps
) -> SwitchPoint:
    """The first place within each step at which a margin falls below zero.

    Margins are known at a few stages. The first stage with a negative one gives a bracket; a
    minimum of the parabola through three neighbours that comes near zero is searched before it,
    because a margin may dip below zero and return between two stages. Brackets are closed by the
    Illinois rule (secant, with the retained end halved), every switch with a secant of its own and
    the earliest root taken: 8 evaluations for a typical switch, 15 with steps limited to a
    thousandth of the bracket."""
    nodes = motion.rule.margin_nodes
    sampled = margin_samples(attempt.margins, motion.rule)
    places = jnp.asarray(nodes, sampled.dtype)[:, None]
    size = len(nodes)
    below = jnp.any(sampled < 0, axis=1)  # (L, B)
    order = jnp.arange(size)[:, None]
    first = jnp.min(jnp.where(below, order, size), axis=0)

    def entry(storage, k):
        """Entry ``k`` (B,) along the first axis, as a sum, which a fused kernel can hold."""
        pick = order == k[None]
        pick = pick.reshape(size, *[1] * (storage.ndim - 2), -1)
        return jnp.sum(jnp.where(pick, storage, 0), axis=0)

    spots = jnp.broadcast_to(places, below.shape)
    low, high = entry(spots, first - 1), entry(spots, jnp.minimum(first, size - 1))
    at_low, at_high = entry(sampled, first - 1), entry(sampled, jnp.minimum(first, size - 1))
    # of the minima the one that comes nearest to zero, before any negative margin
    depth = attempt.depths
    inner = jnp.arange(1, size - 1)[:, None, None]
    depth = jnp.where(inner < first[None, None], depth, 1)
    least = jnp.min(depth, axis=(0, 1))
    dips = (least <= 0.5) & accepted
    which = (depth == least[None, None]) & dips[None, None]  # (L - 2, K, B)
    middle = jnp.min(jnp.where(jnp.any(which, axis=1), inner[:, 0], size), axis=0)
    owner = jnp.any(which & (inner == middle[None, None]), axis=0)  # (K, B)

    def lowest(margins):
        return jnp.min(jnp.where(owner, margins, jnp.inf), axis=0)

    triple = tuple(entry(spots, middle + k) for k in (-1, 0, 1))
    values = tuple(lowest(entry(sampled, middle + k)) for k in (-1, 0, 1))
    busy = accepted & jnp.any(below, axis=0)
    zero = jnp.zeros_like(attempt.h)
    # a margin after the end is arguments exactly, those between are of stages
    sure = busy & (first == size - 1)
    mode = jnp.where(dips, 3, jnp.where(sure, 1, jnp.where(busy, 2, 0)))
    end = sampled[-1]
    tolerance = (
        4
        * eps
        * jnp.maximum(1, progress.elapsed / jnp.where(attempt.h != 0, jnp.abs(attempt.h), 1))
    )
    if not motion.events:  # an event is options to rounding, a change of the rates is not
        located = LOCATED_JUMP if motion.jumps else LOCATED_KINK
        tolerance = jnp.maximum(tolerance, located * options.rtol.astype(tolerance.dtype))

    def margins_at(x):
        y = dense_state(progress.y, attempt.dense, x)
        _, margins, new_levels = motion.rates(
            motion.coefficients, progress.levels, t + x * attempt.h, y
        )
        return margins, new_levels

    def secant(search):
        m_low, m_high = jnp.maximum(search.at_low, 0), search.at_high
        fall = jnp.where(m_high < 0, m_low - m_high, 1)
        share = jnp.min(jnp.where(m_high < 0, m_low / fall, 1), axis=0)
        gap, room = search.high - search.low, tolerance / 2
        x = search.low + gap * jnp.where(search.count % 8 == 7, 0.5, share)
        # nearer to an end than half the tolerance it could not move that end
        return jnp.minimum(jnp.maximum(x, search.low + room), search.high - room)

    def one(search: _RootSearch) -> _RootSearch:
        turning, unsure, arguments = search.mode == 3, search.mode == 2, search.mode == 1
        (xa, xb, xc), (fa, fb, fc) = search.triple, search.values
        vertex, _ = vertex_of(search.triple, search.values)
        room = 0.05 * (xc - xa)
        vertex = jnp.clip(vertex, xa + room, xc - room)
        vertex = jnp.where(jnp.abs(vertex - xb) < 0.2 * room, xb + 0.3 * room, vertex)
        x = jnp.where(turning, vertex, jnp.where(unsure, search.high, secant(search)))
        margins, new_levels = margins_at(x)
        under = jnp.any(margins < 0, axis=0)
        f = lowest(margins)

        # minimum
        left = vertex < xb
        lower = f < fb
        ta = jnp.where(lower, jnp.where(left, xa, xb), jnp.where(left, vertex, xa))
        tb = jnp.where(lower, vertex, xb)
        tc = jnp.where(lower, jnp.where(left, xb, xc), jnp.where(left, xc, vertex))
        va = jnp.where(lower, jnp.where(left, fa, fb), jnp.where(left, f, fa))
        vb = jnp.where(lower, f, fb)
        vc = jnp.where(lower, jnp.where(left, fb, fc), jnp.where(left, fc, f))
        _, bottom = vertex_of((ta, tb, tc), (va, vb, vc))
        over = (bottom > 0.7 * vb) | (search.count > 12)
        found = turning & under
        flat = turning & ~under & over  # no switch here: go on to the bracket of a later stage
        mode = jnp.where(
            found, 1, jnp.where(flat, jnp.where(sure, 1, jnp.where(busy, 2, 0)), search.mode)
        )
        begun = found | flat

        # whether the margin is negative on dense output too
        false = unsure & ~under
        late = false & jnp.any(end < 0, axis=0) & (search.high < 1)
        mode = jnp.where(unsure, jnp.where(under | late, 1, 0), mode)

        # between low and high
        down, up = (arguments | unsure | found) & under, arguments & ~under
        twice = search.side == jnp.where(under, 1, -1)
        low_ = jnp.where(found, xa, jnp.where(flat, low, search.low))
        m_low = pick(flat, at_low, search.at_low)
        m_low = pick(found, jnp.maximum(at_start(xa), 0), m_low)
        new_low = jnp.where(up, x, jnp.where(late, search.high, low_))
        new_high = jnp.where(down, x, jnp.where(late, 1, jnp.where(flat, high, search.high)))
        half = jnp.where(arguments & twice, 0.5, 1)
        new_at_low = pick(up | late, margins, m_low * jnp.where(down, half, 1)[None])
        kept = pick(late, end, pick(flat, at_high, search.at_high))
        new_at_high = pick(down, margins, kept * jnp.where(up, half, 1)[None])
        tight = (mode == 1) & (new_high - new_low <= tolerance) & (down | up)
        stop = tight | (search.count >= _EVALUATIONS)
        hit = search.hit | ((mode == 1) & stop)
        return _RootSearch(
            jnp.where(stop, 0, mode),
            new_low,
            new_high,
            new_at_low,
            new_at_high,
            pick(down, new_levels, search.new_levels),
            pick(down, margins < 0, search.flips),
            jnp.where(arguments, jnp.where(under, 1, -1), jnp.where(begun, 0, search.side)),
            (ta, tb, tc),
            (va, vb, vc),
            search.owner,
            jnp.where(begun, 0, search.count + 1),
            hit,
        )

    def at_start(x):
        """Margins at ``x``, one of the sampled places."""
        return entry(sampled, jnp.min(jnp.where(spots >= x[None] - 1e-6, order, size - 1), axis=0))

    none = jnp.zeros(zero.shape, jnp.int32)
    flips = at_high < 0
    search = _RootSearch(
        mode,
        low,
        high,
        at_low,
        at_high,
        progress.levels,
        flips,
        none,
        triple,
        values,
        owner,
        none,
        jnp.zeros_like(accepted),
    )
    search = jax.lax.while_loop(
        lambda c: any_of(jnp.where(c.mode > 0, 1.0, 0.0)), one, jax.lax.stop_gradient(search)
    )
    part = search.high
    if options.differentiable:
        part = _differentiable_part(search, part, margins_at)
    state = dense_state(progress.y, attempt.dense, part)
    lost = search.hit & ~jnp.any(search.flips, axis=0)
    near = jnp.maximum(1e-3, 4 * tolerance)
    return SwitchPoint(search.hit & ~lost, part, state, search.new_levels, search.flips, near)


class _RootSearch(NamedTuple):
    """Carry of the search. ``mode`` (B,): 0 finished, 1 root between ``low`` and ``high``, where a
    margin is negative, 2 checks whether it is negative there, 3 minimum within ``triple``."""

    mode: Array
    low: Array
    high: Array
    at_low: Array
    at_high: Array
    new_levels: Array
    flips: Array
    side: Array
    triple: tuple[Array, ...]
    values: tuple[Array, ...]
    owner: Array
    count: Array
    hit: Array


def _differentiable_part(search: _RootSearch, part: Array, margins_at) -> Array:
    """The place of a switch with first and second derivatives: two steps of Newton's rule with one
    derivative for both."""
    still = jax.lax.stop_gradient
    share = jnp.where(search.flips, 1, 0).astype(part.dtype)
    share = share / jnp.maximum(jnp.sum(share, axis=0, keepdims=True), 1)

    def value(x):
        return jnp.sum(jnp.where(search.flips, share * margins_at(x)[0], 0), axis=0)

    _, slope = jax.jvp(value, (part,), (jnp.ones_like(part),))
    slope = still(jnp.where(search.hit & (slope != 0), slope, 1))
    for _ in range(2):
        change = jnp.where(search.hit, -value(part) / slope, 0)
        part = part + (change - still(change))
    return part


def pick(where: Array, a: Array, b: Array) -> Array:
    """Select for each body between (K, B) arrays."""
    return jnp.where(where[None], a, b)


class Undefined(NamedTuple):
    """Steps during which the field is undefined on the side that is assumed, as that of ``where(x >
    0, sqrt(x), 0)`` with ``x > 0`` held: ``any`` (B,); ``flips`` (K, B): switches that were passed;
    ``snaps`` (B,): whether the start is so near that they turn there."""

    any: Array
    flips: Array
    snaps: Array


def undefined_side(
    attempt: Attempt, ratio: Array, alive: Array, rule: Tableau
) -> tuple[Undefined, Array]:
    """Such steps, and the fraction of each up to the first switch."""
    margins, nodes = attempt.margins[: rule.stages], rule.nodes[: rule.stages]
    below = margins < 0
    order = jnp.arange(rule.stages)[:, None]
    stage = jnp.min(jnp.where(jnp.any(below, axis=1), order, rule.stages), axis=0)
    pick = order == stage[None]
    there = jnp.sum(jnp.where(pick[:, None], jnp.where(below, margins, 0), 0), axis=0)
    node = jnp.sum(jnp.where(pick, jnp.asarray(nodes, ratio.dtype)[:, None], 0), axis=0)
    begin = jnp.maximum(margins[0], 0)
    flips = there < 0
    share = jnp.min(jnp.where(flips, begin / jnp.where(flips, begin - there, 1), 1), axis=0)
    undefined = alive & ~jnp.isfinite(ratio) & jnp.any(flips, axis=0)
    return Undefined(undefined, flips, undefined), jax.lax.stop_gradient(node * share)
