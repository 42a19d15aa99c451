"""Batches of lanes through diffrax: the norm of their errors, and their samples."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from polhode import solvers


class LaneNorm(eqx.Module):
    """Error of the worst lane: root mean square over its components, each times its weight.

    A batch that shares its steps so keeps every body's own tolerance.
    """

    weights: Array

    def __call__(self, y: PyTree[Array]) -> Array:
        y = jnp.stack(y) if len(y := jax.tree.leaves(y)) > 1 else y[0]
        worst = jnp.max(jnp.mean((y * self.weights) ** 2, axis=0))
        positive = worst > 0  # the root's slope at zero is infinite: keep it out of gradients
        return jnp.where(positive, jnp.sqrt(jnp.where(positive, worst, 1)), 0)


def sampled(solve, controller, ts, y0, width, final_only):
    """Samples (components, N, T), last state, result and steps of one solve."""
    samples = diffrax.SubSaveAt(t1=True) if final_only else diffrax.SubSaveAt(ts=ts)
    saveat = diffrax.SaveAt(subs=[samples, diffrax.SubSaveAt(t1=True)])
    solution = solve(
        t0=ts[0], t1=ts[-1], dt0=width, y0=y0, saveat=saveat, stepsize_controller=controller
    )
    samples, last = (jnp.moveaxis(y, 0, -1) for y in solution.ys)
    return samples, last, solution.result, solution.stats["num_steps"]


def through(solve, field, args, controller, ts, y0, width, final_only):
    """The same of a state in components, in one solve from each time to the next.

    ``solve`` takes the term and its arguments as well.
    """
    times = ts[jnp.array([0, -1])] if final_only else ts
    solve = partial(solve, diffrax.ODETerm(field), args=args)
    path, _, (result, steps) = _across(solve, controller, times, y0, width)
    return *_stacked(path, final_only), result, steps


def followed(solve, field, args, controller, ts, y0, width, final_only):
    """The same with the derivatives of the exact flow (see ``solvers.path``)."""
    times = ts[jnp.array([0, -1])] if final_only else ts

    def steps(given, field, args, y0, times):
        controller, width = given
        solve_it = partial(solve, diffrax.ODETerm(field), args=args)
        return _across(solve_it, controller, times, y0, width)

    order = solve.keywords["solver"].formal_order
    path, _, (result, steps) = solvers.path(
        steps, (controller, width), field, args, y0, times, order, _PARTS
    )
    return *_stacked(path, final_only), result, steps


_PARTS = 8
"""Parts of the time simulated whose starts are kept for a gradient: on the way back from states
that a torque has drawn together an error grows no longer than through one of them."""


def _across(solve, controller, times, y0, width):
    """States at the times (in front), steps taken in each interval, result and all steps tried.

    A step starts as wide as those of the interval before; after a failure nothing moves.
    """
    good = diffrax.RESULTS.successful

    def across(carry, interval):
        y, width, result, steps = carry
        start, end = interval
        end = jnp.where(result == good, end, start)
        solution = solve(t0=start, t1=end, dt0=width, y0=y, stepsize_controller=controller)
        result = diffrax.RESULTS.where(result == good, solution.result, result)
        new = jax.tree.map(lambda x: jnp.where(result == good, x[-1], jnp.nan), solution.ys)
        count = jnp.maximum(solution.stats["num_accepted_steps"], 1)
        width = jnp.where(end == start, width, jax.lax.stop_gradient(end - start) / count)
        return (new, width, result, steps + solution.stats["num_steps"]), (new, count)

    start = (y0, jnp.asarray(width, times.dtype), good, jnp.array(0))
    (_, _, result, steps), (path, counts) = jax.lax.scan(across, start, (times[:-1], times[1:]))
    path = jax.tree.map(lambda first, x: jnp.concatenate([first[None], x]), y0, path)
    return path, counts, (result, steps)


def _stacked(path, final_only):
    """Samples and last state (components, N, T) of states with the times in front."""
    path = jnp.moveaxis(jnp.stack(jax.tree.leaves(path)), 1, -1)
    return path[..., -1:] if final_only else path, path[..., -1:]
