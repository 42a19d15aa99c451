"""One step of an explicit Runge-Kutta rule, of several bodies side by side.

The stages are a loop, so that the field stands in the compiled program once. Coefficients:
``_tableau.py``.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._integrate._tableau import Tableau
from polhode._kernels import any_of


class Motion(NamedTuple):
    """Equations of motion of B bodies.

    ``rates(coefficients, levels, t, y)``: rates (D, B), margins (K, B) and the levels (K, B) to
    which each switch would turn, for levels (K, B), times (B,) and states (D, B);
    ``levels(arguments, t, y)``: the levels at a point; ``units(unit_data, y, rates)``: weights of
    the components of an error, the squares of which are summed, and natural rates [rad/s] (B,). The
    last ``events`` of the K ``switches`` are events; ``jumps``: for each switch, whether the rates
    may jump there, empty where they do at none; ``swift``: the switches whose margins must be
    resolved by the steps (see ``is_unresolved``); ``rule``: of the steps; ``is_whole``: whether one
    unit can hold the field, and so the whole loop."""

    rates: Callable[..., tuple[Array, Array, Array]]
    levels: Callable[..., Array]
    units: Callable[..., tuple[list[Array], Array]]
    coefficients: Any
    arguments: Any
    unit_data: Any
    rule: Tableau
    switches: int
    events: int = 0
    jumps: tuple[bool, ...] = ()
    swift: tuple[int, ...] = ()
    is_whole: bool = True


class Progress(NamedTuple):
    """Carry of the loop; the last axis of every array is the bodies.

    ``elapsed``: time since the start [s]; ``y``, ``rate``: state and its rates; ``levels``,
    ``margin``: of the switches at ``y``; ``just_turned``: switches that turned at the start of the
    step; ``needs_rates``: whether ``rate`` must be evaluated anew; ``width``: of the next step [s];
    ``last_error``: logarithm of the last error over its tolerance; ``angle`` so far [rad];
    ``error``: sum of estimated errors; ``steps`` accepted and ``attempts``;
    ``at_switches``: steps that ended where a switch turned; ``unstable``: as wide as stability
    allows; ``reversals``: consecutive switches
    that turned back at once; ``place``: index of the next sample; ``count``:
    of events; ``outcome``."""

    elapsed: Array
    y: Array
    rate: Array
    levels: Array
    margin: Array
    just_turned: Array
    needs_rates: Array
    width: Array
    last_error: Array
    angle: Array
    error: Array
    steps: Array
    attempts: Array
    at_switches: Array
    unstable: Array
    reversals: Array
    place: Array
    count: Array
    outcome: Array


class Attempt(NamedTuple):
    """A step that may be refused.

    ``h`` (B,): signed width; ``stages`` (S, D, B): rates; ``margins`` (S, K, B); ``new_levels``
    (K, B): to which switches would turn at the start; ``depths`` (M, K, B): of turning points of
    the margins; ``dense`` (7 or 4, D, B): coefficients of dense output, valid where requested."""

    h: Array
    stages: Array
    margins: Array
    new_levels: Array
    depths: Array
    dense: Array


def attempt_step(
    motion: Motion, progress: Progress, t: Array, h: Array, needs_dense: Array
) -> Attempt:
    """A step of each body, of signed width ``h`` (B,) from ``t`` (B,). The stages of dense output
    are skipped unless a body ``needs_dense`` (B,) or has a switch near.

    Both phases, the stages of the step and those of dense output, are turns of one loop, so that
    the field stands in the program once."""
    dtype, rule = progress.y.dtype, motion.rule
    table, nodes = in_parts(rule.weights, dtype), jnp.asarray(rule.nodes, dtype)
    stages = _stage_buffer(progress.rate, rule)
    margins = _stage_buffer(progress.margin, rule)
    events = motion.switches > 0

    def stage(i, carry):
        stages, margins, new_levels = carry
        y = progress.y + h[None] * weighted([part[i] for part in table], stages)
        rate, margin, turn = motion.rates(motion.coefficients, progress.levels, t + nodes[i] * h, y)
        stages = jax.lax.dynamic_update_index_in_dim(stages, rate, i, 0)
        if events:
            margins = jax.lax.dynamic_update_index_in_dim(margins, margin, i, 0)
            new_levels = jnp.where(i == 0, turn, new_levels)
        return stages, margins, new_levels

    # The second phase runs only where it is needed, and the first one skips the stage that the
    # previous step has left: the bounds of the inner loop decide both. A `cond` around a second
    # loop would put the field into the program twice.
    def phase(number, carry):
        *stage_carry, depths, inside = carry
        dense_end = jnp.where(inside, rule.dense_stages, rule.stages)
        first_stage = jnp.where(any_of(jnp.where(progress.needs_rates, 1.0, 0.0)), 0, 1)
        begin = jnp.where(number == 0, first_stage, rule.stages)
        end = jnp.where(number == 0, rule.stages, dense_end)
        stage_carry = jax.lax.fori_loop(begin, end, stage, tuple(stage_carry))
        # Margins are known at the stages anyhow. Whether the dense output is needed to locate a
        # switch is seen from them, before it is paid for.
        if events:
            depths = jnp.where(
                number == 0, _depths(margin_samples(stage_carry[1], rule), rule), depths
            )
            inside = inside | any_of(_is_near(stage_carry[1], depths, rule))
        return *stage_carry, depths, inside

    inside = any_of(jnp.where(needs_dense, 1.0, 0.0)) if not motion.events else jnp.ones((), bool)
    depths = (
        jnp.ones((len(rule.margin_stages) - 2, *progress.levels.shape), dtype)
        if events
        else progress.levels
    )
    carry = jax.lax.fori_loop(0, 2, phase, (stages, margins, progress.levels, depths, inside))
    stages, margins, new_levels, depths, inside = carry
    return Attempt(h, stages, margins, new_levels, depths, dense_of(h, stages, rule))


def dense_of(h: Array, stages: Array, rule: Tableau) -> Array:
    """Coefficients (K, D, B) of dense output."""
    h_rates = h[None, None] * stages
    end = rule.stages - 1
    change = weighted(rule.weights[end], h_rates)
    first_change, last_change = h_rates[0], h_rates[end]
    return jnp.stack(
        [change, first_change - change, 2 * change - (first_change + last_change)]
        + [weighted(row, h_rates) for row in rule.dense]
    )


def dense_state(y: Array, dense: Array, x: Array) -> Array:
    """States (D, B) at the fractions ``x`` (B,) of a step from ``y``."""
    # Nested as x (a + (1 - x) (b + x (c + ...))): exact at both ends, where every factor beyond
    # the first vanishes. In powers of x the ends would carry the rounding of all terms.
    total, x = jnp.zeros_like(y), x[None]
    complement = 1 - x
    for k in range(dense.shape[0] - 1, -1, -1):
        total = (total + dense[k]) * (x if k % 2 == 0 else complement)
    return y + total


def margin_samples(margins: Array, rule: Tableau) -> Array:
    """Margins (M, K, B) in order of time; a switch that has just turned starts at zero."""
    # The stages of a rule do not stand in order of time, and some lie so close together, or so far
    # off the solution, that they tell nothing more: the tableau names those that are looked at.
    sampled = jnp.stack([margins[k] for k in rule.margin_stages])
    return jnp.concatenate([jnp.maximum(sampled[:1], 0), sampled[1:]])


def _depths(sampled: Array, rule: Tableau) -> Array:
    """Minimum of the parabola through three neighbouring margins (M - 2, K, B), relative to the
    least of the three; 1 where it does not lie between them."""
    # A margin that dips below zero and returns between two stages shows in the parabola through
    # its neighbours only. Sampling more densely instead would cost an evaluation for each sample;
    # the parabolas cost none, and the search confirms a dip before it counts.
    x = np.array(rule.margin_nodes)
    inverse = 1 / np.diff(x)

    def column(values):
        return jnp.asarray(values, sampled.dtype)[:, None, None]

    chords = (sampled[1:] - sampled[:-1]) * column(inverse)
    left, bend = chords[:-1], (chords[1:] - chords[:-1]) * column(1 / (x[2:] - x[:-2]))
    # slopes at both ends tell whether it turns between them, without a division for most
    falls = left - bend * column(x[1:-1] - x[:-2])
    rises = left + bend * column(2 * x[2:] - x[:-2] - x[1:-1])
    a = sampled[:-2]
    least_margin = jnp.minimum(jnp.minimum(a, sampled[1:-1]), sampled[2:])
    turns = (falls < 0) & (rises > 0) & (bend > 0) & (least_margin >= 0)
    scale = jnp.where(turns & (least_margin > 0), 4 * bend * least_margin, 1)
    return jnp.where(turns, (4 * bend * a - falls * falls) / scale, 1)


def vertex_of(x, f):
    """Minimum of the parabola through three points and its value; far away if there is none."""
    (x0, x1, x2), (a, b, c) = x, f
    left, right = (b - a) / (x1 - x0), (c - b) / (x2 - x1)
    bend = (right - left) / (x2 - x0)
    up = bend > 0
    safe = jnp.where(up, bend, 1)
    place = jnp.where(up, (x0 + x1) / 2 - left / (2 * safe), 2.0)
    value = a + (place - x0) * (left + bend * (place - x1))
    return place, value


def _is_near(margins: Array, depths: Array, rule: Tableau) -> Array:
    """Whether (B,) a switch may turn within the step."""
    may_turn = jnp.any(margin_samples(margins, rule) < 0, axis=(0, 1))
    may_turn = may_turn | jnp.any(depths <= 0.5, axis=(0, 1))
    return jnp.where(may_turn, 1.0, 0.0)


def column(storage: Array, k: Array) -> Array:
    """Entry ``k`` (B,) of each body along the first axis."""
    k = jnp.clip(k, 0, storage.shape[0] - 1)
    k = jnp.broadcast_to(k.reshape(*[1] * (storage.ndim - 1), -1), (1, *storage.shape[1:]))
    return jnp.take_along_axis(storage, k, axis=0)[0]


def in_parts(weights: np.ndarray, dtype: np.dtype) -> list[Array]:
    """Weights as a sum of arrays of ``dtype``: two in single precision, one in double.

    A rounded weight is off by the same amount in every step, so that in single precision momenta
    drift in proportion to the steps and attitudes to their square: after some hundred radians up to
    30 times as far as by rounding of the steps, which has either sign."""
    rounded = np.asarray(weights, dtype)
    rest = np.asarray(weights - rounded, dtype)
    return [jnp.asarray(part) for part in ([rounded, rest] if rest.any() else [rounded])]


def weighted(weights: np.ndarray | list[Array], stages: Array) -> Array:
    """Sum (D, B) of ``stages`` (S, D, B) with ``weights`` (S,), or with the sum of several arrays
    of weights. Summed term by term it is one fused loop; a matrix product would not fit into a
    fused kernel."""
    parts = in_parts(weights, stages.dtype) if isinstance(weights, np.ndarray) else weights
    sums = [
        jnp.sum(part[:, None, None] * stages[: part.shape[0]], axis=0) for part in reversed(parts)
    ]
    return functools.reduce(jnp.add, sums)


def _stage_buffer(first_stage: Array, rule: Tableau) -> Array:
    """Room for all stages, the first of them set."""
    zeros = jnp.zeros((rule.dense_stages - 1, *first_stage.shape), first_stage.dtype)
    return jnp.concatenate([first_stage[None], zeros])
