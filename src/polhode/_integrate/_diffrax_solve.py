"""Arguments of ``diffrax.diffeqsolve``; solutions in segments between the edges of pulses, and in a
single step of diffrax."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from polhode._kernels import is_differentiated
from polhode._method import Status, StepCounts
from polhode._scene import AbstractTorque


class Stepping(NamedTuple):
    """Arguments of ``diffrax.diffeqsolve``."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    saveat: diffrax.SaveAt
    max_steps: int
    dt0: Any


class Request(NamedTuple):
    """Requirements of a solution: times, error at the last of them, first or longest step, maximum
    number of steps; whether only the last state is saved, and whether the rates may jump."""

    ts: Array
    rtol: Array
    dt0: Any
    max_steps: int
    final_only: bool
    jumps: bool

    def by_controller(self, solver, controller) -> Stepping:
        """Steps of a controller that the user chose."""
        saveat = self._saveat(diffrax.SubSaveAt(ts=self.ts))
        return Stepping(solver, controller, saveat, self.max_steps, self.dt0)

    def in_one_call(self, solver) -> Stepping:
        """One step of diffrax from each time to the next, which the solver subdivides."""
        times = self.ts[jnp.array([0, -1])] if self.final_only else self.ts
        saveat = self._saveat(diffrax.SubSaveAt(t0=True, steps=1))
        saveat = eqx.tree_at(lambda s: s.solver_state, saveat, True)
        return Stepping(solver, StepToTimes(times), saveat, times.shape[0] - 1, None)

    def by_error_estimate(self, solver, y0, term, dynamics) -> Stepping:
        """Steps of any solver with an error estimate, by diffrax's PID controller."""
        leaves = jax.tree.leaves(y0)
        weights, rate = dynamics.units(leaves, jax.tree.leaves(term.vf(self.ts[0], y0, dynamics)))
        angle = jnp.maximum(1, jnp.max(rate) * jnp.abs(self.ts[-1] - self.ts[0]))
        weights = [*weights, *[jnp.zeros_like(x) for x in leaves[len(weights) :]]]
        weights, angle = jax.lax.stop_gradient((weights, angle))
        atol = jnp.maximum(self.rtol / (2 * angle), 8 * jnp.finfo(self.rtol.dtype).eps)
        controller = diffrax.PIDController(rtol=0.0, atol=atol, norm=LaneNorm(tuple(weights)))
        if (
            not self.final_only
        ):  # samples at the ends of steps are more accurate than the interpolant
            controller = diffrax.ClipStepSizeController(controller, step_ts=self.ts)
        return self.by_controller(solver, controller)

    def _saveat(self, samples) -> diffrax.SaveAt:
        end = diffrax.SubSaveAt(t1=True)
        return diffrax.SaveAt(subs=[end if self.final_only else samples, end])


class LaneNorm(eqx.Module):
    """Error of the worst body: root mean square over its components, each times its weight.

    A batch with shared steps thus satisfies the tolerance of every body.
    """

    weights: tuple[Array, ...]

    def __call__(self, y: PyTree[Array]) -> Array:
        leaves = jax.tree.leaves(y)
        square = sum((w * x) ** 2 for w, x in zip(self.weights, leaves))
        worst = jnp.max(square) / len(leaves)
        positive = worst > 0  # the derivative of the root at zero is infinite
        return jnp.where(positive, jnp.sqrt(jnp.where(positive, worst, 1)), 0)


class Solution(NamedTuple):
    """Solution of N bodies: states at the samples (T, N) and at the end (1, N), steps, status and,
    where the method estimates it, the sum of the errors (N,)."""

    samples: PyTree[Array]
    end_state: PyTree[Array]
    steps: StepCounts
    status: Array
    error: Array | None


def in_segments(
    solve: Callable[..., Solution],
    rates: Callable[..., PyTree[Array]],
    y: PyTree[Array],
    ts: Array,
    torque: AbstractTorque,
    final_only: bool,
) -> Solution:
    """The solution in segments between the edges of ``torque``.

    ``solve(acting, y, times, parts)`` solves one segment from ``times[0]`` to ``times[-1]`` under
    the torque ``acting`` there, with one of ``parts`` equal shares of the error; the first entry of
    ``times`` may occur several times. ``rates(acting, t, y)``: of the state. Derivatives by the
    edges are those by the ends of the segments.
    """
    start, end = ts[0], ts[-1]
    sign = jnp.where(end < start, -1, 1).astype(ts.dtype)
    # An edge outside of the span is placed at its end, and has the derivative of that end.
    within = jnp.clip(torque.edges, jnp.minimum(start, end), jnp.maximum(start, end))
    order = jnp.argsort(sign * within)
    bounds = jnp.concatenate([start[None], within[order], end[None]])
    parts = bounds.shape[0] - 1
    # Edges are replaced by their ordinal numbers, so that the torque between two edges is defined
    # even if they are at the same time.
    numbers = jnp.arange(parts - 1, dtype=within.dtype)
    numbered = _with_edges(torque, sign * jnp.zeros_like(within).at[order].set(numbers))
    has_edge_derivatives = is_differentiated([ts, within])

    def solve_segment(carry, segment):
        y, out, steps, status, error = carry
        a, b, number = segment
        is_empty = a == b
        acting = numbered.during(sign * (number - 0.5))
        # An empty segment is solved over another length and the result discarded, so that no
        # derivative is NaN.
        segment_end = jnp.where(is_empty, a + (end - start) / 16, b)
        is_in_segment = (sign * (ts - a) >= 0) & (sign * (b - ts) > 0) & ~is_empty
        if final_only:
            times = jnp.stack([a, segment_end])
        else:
            times = sign * jnp.sort(sign * jnp.where(is_in_segment, ts, a))
            times = jnp.concatenate([times, segment_end[None]])
        solution = solve(acting, y, times, parts)
        successful = status == Status.SUCCESSFUL
        status = jnp.where(is_empty | ~successful, status, solution.status)
        steps = jax.tree.map(lambda a, b: a + jnp.where(is_empty, 0, b), steps, solution.steps)
        if error is not None:
            error = error + jnp.where(is_empty, 0, solution.error)
        if not final_only:
            passed_count = jnp.sum(jnp.where(sign * (ts - b) >= 0, 1, 0))
            rows = jnp.minimum(jnp.arange(ts.shape[0]) + passed_count, ts.shape[0])
            out = jax.tree.map(
                lambda old, new: jnp.where(is_in_segment[:, None], new[rows], old),
                out,
                solution.samples,
            )
        # An empty segment changes nothing, but has derivatives by both of its ends.
        step = jnp.where(is_empty, b - a - jax.lax.stop_gradient(b - a), 0)
        y = jax.lax.cond(
            has_edge_derivatives,
            lambda y: jax.tree.map(lambda x, f: x + step * f, y, rates(acting, a, y)),
            lambda y: y,
            y,
        )
        # the last sample, not ``end_state``: only samples have derivatives
        y = jax.tree.map(lambda old, new: jnp.where(is_empty, old, new[-1]), y, solution.samples)
        return (y, out, steps, status, error), None

    acting = numbered.during(-0.5)
    shape = jax.eval_shape(lambda y: solve(acting, y, jnp.stack([start, end]), parts), y)
    lane = jax.tree.leaves(y)[0].shape
    out = None
    if not final_only:
        out = jax.tree.map(lambda x: jnp.zeros((ts.shape[0], *x.shape), x.dtype), y)
    initial_error = None if shape.error is None else jnp.zeros(lane, shape.error.dtype)
    zero_counts = jnp.zeros(lane, shape.steps.accepted.dtype)
    initial_carry = (
        y,
        out,
        StepCounts.of(zero_counts),
        jnp.zeros(lane, shape.status.dtype),
        initial_error,
    )
    (y, out, steps, status, error), _ = jax.lax.scan(
        solve_segment,
        initial_carry,
        (bounds[:-1], bounds[1:], jnp.arange(parts, dtype=bounds.dtype)),
    )
    end_state = jax.tree.map(lambda x: x[None], y)
    if final_only:
        return Solution(end_state, end_state, steps, status, error)
    out = jax.tree.map(lambda rows, x: rows.at[-1].set(x), out, y)
    return Solution(out, end_state, steps, status, error)


def _with_edges(torque: AbstractTorque, edges: Array) -> AbstractTorque:
    """The torque with other edges, in the order of ``AbstractTorque.edges``."""
    arrays, static = eqx.partition(torque, eqx.is_inexact_array)
    # Each edge is one entry of one array, so that the transpose of ``edges`` writes numbers to
    # these entries.
    _, transpose_of_edges = jax.vjp(lambda arrays: eqx.combine(arrays, static).edges, arrays)
    (positions,), (values,) = transpose_of_edges(jnp.ones_like(edges)), transpose_of_edges(edges)
    arrays = jax.tree.map(lambda x, at, new: jnp.where(at != 0, new, x), arrays, positions, values)
    return eqx.combine(arrays, static)


MIN_ADJOINT_INTERVALS = 8
"""Minimum number of intervals of the adjoint integration if torques act: it restarts from the saved
state at the end of each."""


def with_restarts(ts: Array, final_only: bool, inputs: PyTree) -> tuple[Array, Array]:
    """``ts`` with additional times at which the adjoint integration restarts, and the rows of
    ``ts`` (of its last time if ``final_only``) among them.

    Backwards through damping, errors grow by exp(rate of damping * time). The additional times are
    used in programs with derivatives by ``ts`` or ``inputs`` only. Otherwise, and if they are not
    distinct in this dtype, they are equal to the first time, which costs no step. The first entry
    of ``ts`` may occur several times.
    """
    arrays = [x for x in jax.tree.leaves((ts, inputs)) if eqx.is_inexact_array(x)]
    intervals = ts.shape[0] - 1
    parts = -(-MIN_ADJOINT_INTERVALS // intervals)
    inner = jnp.asarray(np.arange(1, parts) / parts, ts.dtype)
    between = ts[:-1, None] + (ts[1:] - ts[:-1])[:, None] * inner[None]
    spread = jnp.concatenate([between, ts[1:, None]], axis=1).reshape(-1)
    at_start = jnp.concatenate([jnp.broadcast_to(ts[0], between.size), ts[1:]])
    steps = jnp.diff(spread, prepend=ts[:1])
    is_apart = jnp.all((steps * jnp.sign(ts[-1] - ts[0]) > 0) | (spread == ts[0]))
    goes_back, number = is_differentiated(arrays) & is_apart, np.arange(intervals + 1)
    times = jnp.concatenate([ts[:1], jnp.where(goes_back, spread, at_start)])
    rows = jnp.where(goes_back, number * parts, number + (number > 0) * between.size)
    return times, rows[-1:] if final_only else rows


class StepToTimes(diffrax.StepTo):
    """``diffrax.StepTo`` without checks, for sorted times whose ends are those of the solution.

    The checks of ``diffrax.StepTo`` raise errors inside the program by callbacks of the host.
    Programs with callbacks cannot be stored in JAX's persistent cache, nor exported for other
    platforms. ``ph.simulate`` checks concrete times before, and reports traced ones in the status.
    """

    def wrap(self, direction):
        return StepToTimes(self.ts * direction)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        del terms, t0, t1, y0, dt0, args, func, error_order
        return self.ts[1], 2


def is_one_step(controller: Any, saveat: diffrax.SaveAt, event: Any, meter: Any) -> bool:
    """Whether a solution consists of one step, of which only states are saved."""
    subs = jax.tree.leaves(saveat.subs, is_leaf=_is_sub)
    return (
        isinstance(controller, diffrax.StepTo)
        and controller.ts.shape[0] == 2
        and event is None
        and isinstance(meter, diffrax.NoProgressMeter)
        and not saveat.dense
        and all(sub.ts is None and sub.steps in (0, 1) for sub in subs)
    )


def one_step(terms, args, solver, saveat: diffrax.SaveAt, state: Any) -> Any:
    """diffrax's ``state`` after the step from its ``tprev`` to its ``tnext``, without the loop.

    A loop of one iteration would copy all arrays of its carry, and would be compiled as a loop.
    """
    end = state.tnext
    y, _, _, solver_state, result = solver.step(
        terms, state.tprev, end, state.y, args, state.solver_state, state.made_jump
    )

    def save(sub, save_state):
        points = [(state.tprev, state.y)] * sub.t0 + [(end, y)] * (sub.steps == 1 or sub.t1)
        rows = [(t, sub.fn(t, point_state, args)) for t, point_state in points]
        ts, ys = (jax.tree.map(lambda *x: jnp.stack(x), *column) for column in zip(*rows))
        count = len(rows)  # rows for further steps are not changed
        ts, ys = jax.tree.map(
            lambda new, storage: jnp.concatenate([new, storage[count:]]),
            (ts, ys),
            (save_state.ts, save_state.ys),
        )
        return dataclasses.replace(save_state, ts=ts, ys=ys, save_index=count)

    return dataclasses.replace(
        state,
        y=y,
        tprev=end,
        solver_state=solver_state,
        result=result,
        num_steps=1,
        num_accepted_steps=1,
        save_state=jax.tree.map(save, saveat.subs, state.save_state, is_leaf=_is_sub),
    )


def _is_sub(x: Any) -> bool:
    return isinstance(x, diffrax.SubSaveAt)
