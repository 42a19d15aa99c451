"""The state at a later time, with a reverse mode that integrates the adjoint equations back."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from polhode.solvers._problem import Problem


def flow(
    field: Callable[..., PyTree],
    args: PyTree,
    y0: PyTree[Array],
    span: tuple[Array, Array],
    steps: Array,
    solver: diffrax.AbstractSolver,
    max_steps: int,
) -> tuple[PyTree[Array], Array, Array]:
    """State at ``span[1]`` in ``steps`` equal diffrax steps, success, steps taken.

    ``field(t, y, args)`` treats the entries of the arrays of ``y``, all of one shape, separately.

    Reverse mode solves y' = f, a' = -a df/dy, g' = -a df/dc backwards with the same solver, c the
    coefficients that the field is made of; each entry gathers its own g. Memory does not grow
    with the steps, and the derivative has the accuracy of the solution; it is not the derivative
    of the steps themselves. No forward mode. Reference: L. S. Pontryagin et al., The Mathematical
    Theory of Optimal Processes (1962), chapter 1.
    """
    held, run, shapes = Problem.of(diffrax.ODETerm(field), args).coefficients(span[0], y0)

    def solve(field, y, held, t0, t1, steps):
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(field), solver, t0, t1, (t1 - t0) / steps, y, held,
            stepsize_controller=diffrax.ConstantStepSize(), max_steps=max_steps, throw=False,
        )  # fmt: skip
        y = jax.tree.map(lambda x: x[-1], found.ys)
        return y, found.result == diffrax.RESULTS.successful, found.stats["num_steps"]

    @jax.custom_vjp
    def end(y, held, t0, t1, steps):
        return solve(lambda t, y, held: run(held, t, y), y, held, t0, t1, steps)

    def forward(y, held, t0, t1, steps):
        found = end(y, held, t0, t1, steps)
        return found, (found[0], held, t0, t1, steps)

    def backward(kept, slopes):
        y1, held, t0, t1, steps = kept
        zero = jnp.zeros_like(jax.tree.leaves(y1)[0])
        smooth = [jnp.issubdtype(h.dtype, jnp.inexact) for h in held]
        # numbers that all entries share get a slope in each entry: no sum in the loop
        gathered = tuple(
            jnp.zeros(shape, h.dtype) for h, shape, s in zip(held, shapes, smooth) if s
        )

        def adjoint(t, state, held):
            y, a, _ = state

            def apart(y, *changes):
                left = iter(changes)
                return run(tuple(h + next(left) if s else h for h, s in zip(held, smooth)), t, y)

            rate, pull = jax.vjp(apart, y, *(jnp.zeros_like(g) for g in gathered))
            slope, *slopes = pull(a)
            return rate, jax.tree.map(jnp.negative, slope), tuple(-s for s in slopes)

        (y0, a0, g0), reached, _ = solve(adjoint, (y1, slopes[0], gathered), held, t1, t0, steps)
        lost = jnp.where(reached, 0, jnp.nan).astype(zero.dtype)
        left = iter(g0)
        of_held = tuple(
            _summed(next(left) + lost, h.shape) if s else np.zeros(h.shape, jax.dtypes.float0)
            for h, s in zip(held, smooth)
        )

        def along(t, y, a):
            rates = zip(jax.tree.leaves(run(held, t, y)), jax.tree.leaves(a))
            return sum(jnp.sum(f * b) for f, b in rates)

        a0 = jax.tree.map(lambda x: x + lost, a0)
        return a0, of_held, -along(t0, y0, a0), along(t1, y1, slopes[0]), jnp.zeros_like(steps)

    end.defvjp(forward, backward)
    return end(y0, held, *span, steps)


def _summed(array: Array, shape: tuple[int, ...]) -> Any:
    """``array`` summed over the axes that broadcasting ``shape`` has added."""
    extra = array.ndim - len(shape)
    array = jnp.sum(array, axis=tuple(range(extra)))
    ones = tuple(i for i, n in enumerate(shape) if n == 1 and array.shape[i] != 1)
    return jnp.sum(array, axis=ones, keepdims=True)
