"""Batches of lanes through diffrax: the norm of their errors, and their samples."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


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


def through(solve, controller, ts, y0, width, final_only):
    """The same of a state in components, in one solve from each time to the next.

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
        return (new, width, result, steps + solution.stats["num_steps"]), new

    times = (ts[:1], ts[-1:]) if final_only else (ts[:-1], ts[1:])
    start = (y0, jnp.asarray(width, ts.dtype), good, jnp.array(0))
    (last, _, result, steps), path = jax.lax.scan(across, start, times)
    if not final_only:
        path = jax.tree.map(lambda first, x: jnp.concatenate([first[None], x]), y0, path)
    path, last = (jnp.stack(jax.tree.leaves(x)) for x in (path, last))
    return jnp.moveaxis(path, 1, -1), last[..., None], result, steps
