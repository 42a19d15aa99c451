"""Many bodies through few lanes: one that has arrived makes room for the next.

Bodies that march side by side as the entries of arrays all wait for the last of them. Of bodies
with moments, weights and rates spread over decades, 64 side by side take 2.5 times the steps that
they need, and tops of one shape 1.2 times. So all of them stand in a queue; the lanes hold those
under way, and when a few of them have arrived, what became of these is stored and the next ones
take their lanes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode._kernels import any_of, put

LANES = 64
"""Bodies side by side: their arrays fit into the innermost cache. With 32 a top takes 1.4 times as
long, with 128 1.15 times."""

QUEUE = 1024
"""Bodies in a queue, which bounds the memory."""

TOGETHER = 8
"""Lanes that are filled at once. With 4 or 16 tops and gravity gradients take as long to 4 %."""


def in_lanes(
    step: Callable[..., Any],
    able: Callable[..., Array],
    finished: Callable[..., Any],
    fixed: Any,
    walk: Any,
    rows: Any,
) -> tuple[Any, Any]:
    """``finished(fixed, walk)`` of every body after all the steps that it is able to take, and
    the ``rows``.

    ``step(fixed, walk, rows)``: the new ``walk`` and ``rows`` after one step of some bodies.
    ``able(fixed, walk)`` (n,): whether a body goes on; one whose ``walk`` is all zero must not.
    ``walk``: arrays (n,); ``fixed``: such arrays and numbers, which no step changes, among them
    ``fixed.body`` (n,), the place of each body among all; ``rows``: anything that belongs to all.
    """
    n = fixed.body.size
    wide = -(-n // -(-n // LANES))  # no wider than where each lane leads as many bodies
    wide += -wide % 8
    parts, tree = jax.tree.flatten(fixed)
    held = [x for x in parts if x.shape == (n,)]
    changing, form = jax.tree.flatten(walk)
    ends, shape = jax.tree.flatten(finished(fixed, walk))
    queue = _stacked(held), _stacked(changing)

    def opened(held_rows):
        """What is fixed of the bodies in the lanes."""
        some = iter(_as(held, held_rows))
        return jax.tree.unflatten(tree, [next(some) if x.shape == (n,) else x for x in parts])

    def settle(carry):
        """What became of the bodies that have arrived is stored, and others take their lanes."""
        held_rows, walk, found, coming, _ = carry
        fixed = opened(held_rows)
        done = ~able(fixed, walk)
        ends = _stacked(jax.tree.leaves(finished(fixed, walk)))
        found = put(found, fixed.body, ends.T)
        lane = jnp.arange(wide)
        before = jnp.sum(jnp.where((lane[:, None] > lane[None]) & done[None], 1, 0), axis=1)
        index = coming + before
        new = done & (index < n)
        others, start = (x.at[:, index].get(mode="clip") for x in queue)
        start = jax.tree.unflatten(form, _as(changing, start))
        walk = jax.tree.map(lambda a, b: jnp.where(new, a, b), start, walk)
        count = jnp.sum(jnp.where(done, 1, 0))
        # n: none is waiting; n + 1: all have been stored, and stay so while others of a batch go on
        last = (count == wide) & (coming >= n)
        coming = jnp.where(last, n + 1, jnp.minimum(coming + count, n))
        return jnp.where(new, others, held_rows), walk, found, coming, False

    def turn(carry):
        held_rows, walk, found, coming, rows = carry
        idle = jnp.sum(jnp.where(able(opened(held_rows), walk), 0, 1))
        due = (idle >= TOGETHER) & (coming < n) | (idle == wide)
        # once or not at all: a branch would copy all that it may change
        start = held_rows, walk, found, coming, any_of(jnp.where(due, 1.0, 0.0))
        held_rows, walk, found, coming, _ = jax.lax.while_loop(lambda c: c[4], settle, start)
        walk, rows = step(opened(held_rows), walk, rows)
        return held_rows, walk, found, coming, rows

    # at first every lane is done with a body of zeros, whose end is overwritten
    held_rows, start = (jnp.zeros((len(x), wide), x.dtype) for x in queue)
    walk = jax.tree.unflatten(form, _as(changing, start))
    found = jnp.zeros_like(_stacked(ends).T)
    start = held_rows, walk, found, jnp.zeros((), int), rows
    *_, found, _, rows = jax.lax.while_loop(
        lambda carry: any_of(jnp.where(carry[3] <= n, 1.0, 0.0)), turn, start
    )
    return jax.tree.unflatten(shape, _as(ends, found.T)), rows


def _stacked(arrays: list[Array]) -> Array:
    """Arrays as the rows of a matrix: it is looked up in one loop, which compiles faster than one
    for each. Integers, numbers of bodies and small ones, are exact as floats."""
    floats = [x.dtype for x in arrays if jnp.issubdtype(x.dtype, jnp.floating)]
    widest = max(floats, key=lambda dtype: dtype.itemsize)
    return jnp.stack([x.astype(widest) for x in arrays])


def _as(like: list[Array], rows: Array) -> list[Array]:
    """The rows of a matrix as what was stacked, which may have been integers."""
    return [row.astype(x.dtype) for x, row in zip(like, rows)]
