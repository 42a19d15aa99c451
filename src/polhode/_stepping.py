"""Batches of lanes through diffrax, and their samples."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp

from polhode import solvers
from polhode._tolerance import EndTolerance


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

    ``solve`` takes the term and its arguments as well; ``controller``: of diffrax, or tolerances
    that are renewed on the way.
    """
    times = ts[jnp.array([0, -1])] if final_only else ts
    path, _, (result, steps) = _across(solve, field, args, controller, times, y0, width)
    return *_stacked(path, final_only), result, steps


def followed(solve, field, args, controller, ts, y0, width, final_only):
    """The same with the derivatives of the exact flow (see ``solvers.path``)."""
    times = ts[jnp.array([0, -1])] if final_only else ts

    def steps(given, field, args, y0, times):
        controller, width = given
        return _across(solve, field, args, controller, times, y0, width)

    order = solve.keywords["solver"].formal_order
    path, _, (result, steps) = solvers.path(
        steps, (controller, width), field, args, y0, times, order, _PARTS
    )
    return *_stacked(path, final_only), result, steps


_PARTS = 8
"""Parts of the time simulated whose starts are kept for a gradient: on the way back from states
that a torque has drawn together an error grows no longer than through one of them."""


def _across(solve, field, args, controller, times, y0, width):
    """States at the times (in front), steps taken in each interval, result and all steps tried.

    A step starts as wide as those of the interval before; after a failure nothing moves.
    """
    good = diffrax.RESULTS.successful
    solve = partial(solve, diffrax.ODETerm(field), args=args)
    renewed, parts = isinstance(controller, EndTolerance), 1
    if renewed:
        rate, _ = controller.rates(y0, field(times[0], y0, args))
        times, parts = controller.nodes(times, rate)

    def across(carry, interval):
        y, width, result, steps, turned = carry
        start, end = interval
        end = jnp.where(result == good, end, start)
        now = controller
        if renewed:
            now, rate = controller.at(start, y, field(start, y, args), turned)
            turned = turned + rate * jnp.abs(end - start)
        solution = solve(t0=start, t1=end, dt0=width, y0=y, stepsize_controller=now)
        result = diffrax.RESULTS.where(result == good, solution.result, result)
        new = jax.tree.map(lambda x: jnp.where(result == good, x[-1], jnp.nan), solution.ys)
        count = jnp.where(end == start, 0, solution.stats["num_accepted_steps"])
        mean = jax.lax.stop_gradient(end - start) / jnp.maximum(count, 1)
        width = jnp.where(end == start, width, mean)
        steps = steps + solution.stats["num_steps"]
        return (new, width, result, steps, turned), (new, count)

    start = (y0, jnp.asarray(width, times.dtype), good, jnp.array(0), 0 * times[0])
    (_, _, result, steps, _), (path, counts) = jax.lax.scan(across, start, (times[:-1], times[1:]))
    counts = jnp.maximum(jnp.sum(counts.reshape(-1, parts), axis=1), 1)
    path = jax.tree.map(
        lambda first, x: jnp.concatenate([first[None], x[parts - 1 :: parts]]), y0, path
    )
    return path, counts, (result, steps)


def _stacked(path, final_only):
    """Samples and last state (components, N, T) of states with the times in front."""
    path = jnp.moveaxis(jnp.stack(jax.tree.leaves(path)), 1, -1)
    return path[..., -1:] if final_only else path, path[..., -1:]
