"""One step of an explicit Runge-Kutta method, for several bodies at a time.

The stages are computed in a loop, so that the compiled program contains the field once. The
coefficients are in ``_tableau.py``.
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

    - ``rates(coefficients, levels, t, y)``: rates (D, B), margins (K, B) and new levels (K, B) of
      switches that flip, for levels (K, B), times (B,) and states (D, B);
    - ``levels(arguments, t, y)``: the levels at a point;
    - ``units(unit_data, y, rates)``: weights of the components of an error, for the root of the sum
      of squares, and natural rates [rad/s] (B,);
    - ``switches``: their number K, of which the last ``events`` are events;
    - ``jumps``: for each switch, whether the rates may jump there; empty if they jump at none;
    - ``resolved_switches``: switches whose margins the steps must resolve (see ``is_unresolved``);
    - ``rule``: the Runge-Kutta method;
    - ``is_fusible``: whether a unit can contain the field, and thereby the whole loop."""

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
    resolved_switches: tuple[int, ...] = ()
    is_fusible: bool = True


class Progress(NamedTuple):
    """Carry of the loop; the last axis of every array is the bodies.

    ``elapsed``: time since the start [s]; ``y``, ``rate``: state and its rates; ``levels``,
    ``margin``: of the switches at ``y``; ``just_flipped``: switches that flipped at the start of
    the step; ``needs_rates``: whether ``rate`` is outdated; ``width``: of the next step [s];
    ``last_error``: logarithm of the last error over its tolerance; ``angle`` so far [rad];
    ``error``: sum of estimated errors; ``steps`` accepted and ``attempts``; ``at_switches``: steps
    that ended at a switch; ``unstable``: steps limited by stability; ``reversals``: consecutive
    switches that flipped back at once; ``place``: index of the next sample; ``count``: of events;
    ``outcome``."""

    elapsed: Array
    y: Array
    rate: Array
    levels: Array
    margin: Array
    just_flipped: Array
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
    """An attempted step.

    ``h`` (B,): signed width; ``stages`` (S, D, B): rates; ``margins`` (S, K, B); ``new_levels``
    (K, B): levels of switches that flip at the start; ``depths`` (M, K, B): minima of the margins
    between stages (see ``_depths``); ``dense`` (7 or 4, D, B): coefficients of dense output, valid
    where requested."""

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
    are skipped unless a body ``needs_dense`` (B,) or a switch of it may flip in the step.

    Both phases, the stages of the step and those of dense output, are iterations of one loop, so
    that the program contains the field once."""
    dtype, rule = progress.y.dtype, motion.rule
    table, nodes = in_parts(rule.weights, dtype), jnp.asarray(rule.nodes, dtype)
    stages = _stage_buffer(progress.rate, rule)
    margins = _stage_buffer(progress.margin, rule)
    has_switches = motion.switches > 0

    def stage(i, carry):
        stages, margins, new_levels = carry
        y = progress.y + h[None] * weighted([part[i] for part in table], stages)
        rate, margin, flipped_levels = motion.rates(
            motion.coefficients, progress.levels, t + nodes[i] * h, y
        )
        stages = jax.lax.dynamic_update_index_in_dim(stages, rate, i, 0)
        if has_switches:
            margins = jax.lax.dynamic_update_index_in_dim(margins, margin, i, 0)
            new_levels = jnp.where(i == 0, flipped_levels, new_levels)
        return stages, margins, new_levels

    # The bounds of the inner loop skip the second phase where it is not needed, and the first stage
    # where the previous step has computed it. A `cond` with a second loop would put the field into
    # the program twice.
    def phase(number, carry):
        *stage_carry, depths, is_dense_needed = carry
        dense_end = jnp.where(is_dense_needed, rule.dense_stages, rule.stages)
        first_stage = jnp.where(any_of(jnp.where(progress.needs_rates, 1.0, 0.0)), 0, 1)
        begin = jnp.where(number == 0, first_stage, rule.stages)
        end = jnp.where(number == 0, rule.stages, dense_end)
        stage_carry = jax.lax.fori_loop(begin, end, stage, tuple(stage_carry))
        # The margins at the stages show whether dense output is needed to locate a switch.
        if has_switches:
            depths = jnp.where(
                number == 0, _depths(margin_samples(stage_carry[1], rule), rule), depths
            )
            is_dense_needed = is_dense_needed | any_of(_may_flip(stage_carry[1], depths, rule))
        return *stage_carry, depths, is_dense_needed

    is_dense_needed = (
        any_of(jnp.where(needs_dense, 1.0, 0.0)) if not motion.events else jnp.ones((), bool)
    )
    depths = (
        jnp.ones((len(rule.margin_stages) - 2, *progress.levels.shape), dtype)
        if has_switches
        else progress.levels
    )
    carry = jax.lax.fori_loop(
        0, 2, phase, (stages, margins, progress.levels, depths, is_dense_needed)
    )
    stages, margins, new_levels, depths, is_dense_needed = carry
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
    # Nested as x (a + (1 - x) (b + x (c + ...))): exact at both ends, where all further terms
    # vanish. In powers of x the end would contain the rounding errors of all terms.
    total, x = jnp.zeros_like(y), x[None]
    complement = 1 - x
    for k in range(dense.shape[0] - 1, -1, -1):
        total = (total + dense[k]) * (x if k % 2 == 0 else complement)
    return y + total


def margin_samples(margins: Array, rule: Tableau) -> Array:
    """Margins (M, K, B) in order of time; a switch that has just flipped starts at zero."""
    # The stages are not in order of time, and some are too close to each other, or too far from
    # the solution, to be of use: the tableau lists those that are used.
    sampled = jnp.stack([margins[k] for k in rule.margin_stages])
    return jnp.concatenate([jnp.maximum(sampled[:1], 0), sampled[1:]])


def _depths(sampled: Array, rule: Tableau) -> Array:
    """Minimum of the parabola through three neighbouring margins (M - 2, K, B), relative to the
    smallest of the three; 1 if the minimum is not between them."""
    # A margin that falls below zero and returns between two stages can only be recognised from the
    # parabola through its neighbours. More samples would cost an evaluation each; the parabolas
    # cost none, and the search verifies every minimum.
    x = np.array(rule.margin_nodes)
    inverse = 1 / np.diff(x)

    def column(values):
        return jnp.asarray(values, sampled.dtype)[:, None, None]

    chords = (sampled[1:] - sampled[:-1]) * column(inverse)
    left, curvature = chords[:-1], (chords[1:] - chords[:-1]) * column(1 / (x[2:] - x[:-2]))
    # The derivatives at both ends show whether the minimum is between them; only then is a division
    # needed.
    falls = left - curvature * column(x[1:-1] - x[:-2])
    rises = left + curvature * column(2 * x[2:] - x[:-2] - x[1:-1])
    a = sampled[:-2]
    min_margin = jnp.minimum(jnp.minimum(a, sampled[1:-1]), sampled[2:])
    has_minimum = (falls < 0) & (rises > 0) & (curvature > 0) & (min_margin >= 0)
    scale = jnp.where(has_minimum & (min_margin > 0), 4 * curvature * min_margin, 1)
    return jnp.where(has_minimum, (4 * curvature * a - falls * falls) / scale, 1)


def vertex_of(x, f):
    """Position and value of the minimum of the parabola through three points; the position is
    beyond the step if there is no minimum."""
    (x0, x1, x2), (a, b, c) = x, f
    left, right = (b - a) / (x1 - x0), (c - b) / (x2 - x1)
    curvature = (right - left) / (x2 - x0)
    is_convex = curvature > 0
    positive_curvature = jnp.where(is_convex, curvature, 1)
    position = jnp.where(is_convex, (x0 + x1) / 2 - left / (2 * positive_curvature), 2.0)
    value = a + (position - x0) * (left + curvature * (position - x1))
    return position, value


def _may_flip(margins: Array, depths: Array, rule: Tableau) -> Array:
    """Whether (B,) a switch may flip within the step."""
    may_flip = jnp.any(margin_samples(margins, rule) < 0, axis=(0, 1))
    may_flip = may_flip | jnp.any(depths <= 0.5, axis=(0, 1))
    return jnp.where(may_flip, 1.0, 0.0)


def column(storage: Array, k: Array) -> Array:
    """Entry ``k`` (B,) of each body along the first axis."""
    k = jnp.clip(k, 0, storage.shape[0] - 1)
    k = jnp.broadcast_to(k.reshape(*[1] * (storage.ndim - 1), -1), (1, *storage.shape[1:]))
    return jnp.take_along_axis(storage, k, axis=0)[0]


def in_parts(weights: np.ndarray, dtype: np.dtype) -> list[Array]:
    """Weights as a sum of arrays of ``dtype``: two in single precision, one in double.

    A rounded weight has the same error in every step. In single precision, errors of the momentum
    would therefore grow in proportion to the number of steps, and those of the attitude to its
    square: after some hundred radians they are up to 30 times as large as those by rounding within
    the steps, which has random sign."""
    rounded = np.asarray(weights, dtype)
    remainder = np.asarray(weights - rounded, dtype)
    return [jnp.asarray(part) for part in ([rounded, remainder] if remainder.any() else [rounded])]


def weighted(weights: np.ndarray | list[Array], stages: Array) -> Array:
    """Sum (D, B) of ``stages`` (S, D, B) with ``weights`` (S,), or with the sum of several arrays
    of weights. A sum of terms becomes one fused loop; a fused kernel cannot contain a matrix
    product."""
    parts = in_parts(weights, stages.dtype) if isinstance(weights, np.ndarray) else weights
    sums = [
        jnp.sum(part[:, None, None] * stages[: part.shape[0]], axis=0) for part in reversed(parts)
    ]
    return functools.reduce(jnp.add, sums)


def _stage_buffer(first_stage: Array, rule: Tableau) -> Array:
    """An array for all stages, with the first one set and zeros for the others."""
    zeros = jnp.zeros((rule.dense_stages - 1, *first_stage.shape), first_stage.dtype)
    return jnp.concatenate([first_stage[None], zeros])
