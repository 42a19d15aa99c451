"""Batches of lanes through diffrax, and their samples."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp

from polhode import solvers
from polhode._tolerance import EndTolerance
from polhode.solvers._problem import Problem


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


def followed(solve, field, args, controller, ts, y0, width, final_only, costate=None):
    """The same with the derivatives of the exact flow (see ``solvers.path``)."""
    times = ts[jnp.array([0, -1])] if final_only else ts

    def steps(given, field, args, y0, times):
        controller, width = given
        return _across(solve, field, args, controller, times, y0, width)

    order = solve.keywords["solver"].formal_order
    path, _, (result, steps) = solvers.path(
        steps, (controller, width), field, args, y0, times, order, _PARTS, costate
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
    term = diffrax.ODETerm(field)
    solve = partial(solve, term, args=args)
    renewed, turned = isinstance(controller, EndTolerance), None
    if renewed:
        unit = jnp.ones((), jnp.result_type(*jax.tree.leaves(y0)))
        prepared = Problem.of(term, args).prepared(times[0], y0, unit)
        controller = controller.following(jax.tree_util.Partial(_slope, prepared, unit))
        turned = controller.turned
    saved = diffrax.SaveAt(t1=True, controller_state=renewed)

    def across(carry, interval):
        y, width, result, steps, turned = carry
        start, end = interval
        end = jnp.where(result == good, end, start)
        now = controller.after(turned) if renewed else controller
        solution = solve(t0=start, t1=end, dt0=width, y0=y, stepsize_controller=now, saveat=saved)
        if renewed:
            turned = solution.controller_state[1]
        result = diffrax.RESULTS.where(result == good, solution.result, result)
        new = jax.tree.map(lambda x: jnp.where(result == good, x[-1], jnp.nan), solution.ys)
        count = jnp.where(end == start, 0, solution.stats["num_accepted_steps"])
        mean = jax.lax.stop_gradient(end - start) / jnp.maximum(count, 1)
        width = jnp.where(end == start, width, mean)
        steps = steps + solution.stats["num_steps"]
        return (new, width, result, steps, turned), (new, count)

    start = (y0, jnp.asarray(width, times.dtype), good, jnp.array(0), turned)
    (_, _, result, steps, _), (path, counts) = jax.lax.scan(across, start, (times[:-1], times[1:]))
    path = jax.tree.map(lambda first, x: jnp.concatenate([first[None], x]), y0, path)
    return path, jnp.maximum(counts, 1), (result, steps)


def _slope(problem, unit, t, y):
    return problem.increment(t, y, unit)


def _stacked(path, final_only):
    """Samples and last state (components, N, T) of states with the times in front."""
    path = jnp.moveaxis(jnp.stack(jax.tree.leaves(path)), 1, -1)
    return path[..., -1:] if final_only else path, path[..., -1:]
