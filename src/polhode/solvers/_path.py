"""A path found by any solver in steps of its own choice, differentiable as the exact flow."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from polhode.solvers._costates import Costate
from polhode.solvers._flow import equations_of, is_slope

Found = tuple[PyTree[Array], Array, PyTree[Array]]


def path(
    solve: Callable[..., Found],
    given: PyTree,
    field: Callable[..., PyTree],
    args: PyTree,
    y0: PyTree[Array],
    ts: Array,
    order: int,
    parts: int,
    costate: Costate | None = None,
) -> Found:
    """States at ``ts`` by ``solve``, with the derivatives that ``flow`` of ``order`` has.

    ``solve(given, field, args, y0, times)`` returns states at the times (times in front), how many
    steps each interval took, and other arrays; it is not differentiated, and closes over no traced
    value: those that it needs are in ``given``. A derivative keeps the states at ``ts`` and at the
    starts of at least ``parts`` equal parts of the time, and integrates its own equations between
    them, forwards or backwards, in as many steps as the solver took there.
    """
    leaves, tree = jax.tree.flatten(y0)
    equations, c = equations_of(field, args, y0, ts[0], order, costate=costate)
    known, static = eqx.partition(given, eqx.is_array)
    split = -(-parts // (ts.shape[0] - 1))

    def flat(t, y, c):
        return equations.field(c, t, y)

    def solved(known, c, leaves, times):
        stopped = jax.lax.stop_gradient((known, c, leaves, times))
        known, c, leaves, times = stopped
        return solve(eqx.combine(known, static), flat, c, leaves, times)

    @jax.custom_jvp
    def run(known, c, leaves, ts):
        return solved(known, c, leaves, ts)

    @partial(run.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        known, *moving = primals
        nodes, counts, rest = solved(known, *moving[:-1], _refined(moving[-1], split))
        ends = [x[1:] for x in nodes]
        moving, shape = jax.tree.flatten(moving)
        changes = jax.tree.leaves(tangents[1:], is_leaf=lambda x: isinstance(x, SymbolicZero))
        at = [i for i, x in enumerate(changes) if is_slope(x)]

        def followed(*some):
            full = list(moving)
            for i, x in zip(at, some):
                full[i] = x
            c, start, ts = jax.tree.unflatten(shape, full)
            times = _refined(ts, split)

            def across(y, part):
                t0, t1, count, end = part
                y = equations.pinned(c, y, t0, t1, _PACE * count.astype(ts.dtype), end)
                return y, y

            _, later = jax.lax.scan(across, start, (times[:-1], times[1:], counts, ends))
            return [jnp.concatenate([a[None], b[split - 1 :: split]]) for a, b in zip(start, later)]

        some = [moving[i] for i in at], [changes[i] for i in at]
        states, slopes = jax.jvp(followed, *some)
        steps = jnp.sum(counts.reshape(-1, split), axis=1)
        return (states, steps, rest), (slopes, _still(steps), jax.tree.map(_still, rest))

    states, counts, rest = run(known, c, leaves, ts)
    return jax.tree.unflatten(tree, states), counts, rest


_PACE = 0.8
"""Steps of the derivatives over those of the solver, whose error estimate is of a lower order."""


def _refined(ts: Array, split: int) -> Array:
    """The times with ``split - 1`` more between any two."""
    shares = jnp.arange(split, dtype=ts.dtype) / split
    between = ts[:-1, None] + shares[None] * (ts[1:] - ts[:-1])[:, None]
    return jnp.concatenate([between.ravel(), ts[-1:]])


def _still(x: Array) -> Any:
    if jnp.issubdtype(x.dtype, jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)
