"""Batches: leading axes of every array are broadcast, flattened to one axis of N lanes, and
put back. A part (inertia, state, potential, ...) tells the rank that each of its array fields
has without batch axes in ``core_ranks``; parts made of other parts keep them in ``terms``.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

PARTS = ("inertia", "potential", "torque", "rotors")
"""The parts of a scene that may carry batch axes."""


def _fields(part: Any) -> list[tuple[str, int]]:
    return [
        (name, rank) for name, rank in part.core_ranks.items() if eqx.is_array(getattr(part, name))
    ]


def _inner(part: Any) -> list[str]:
    """Fields that are parts themselves, such as an orbit."""
    return [name for name in part.core_ranks if hasattr(getattr(part, name), "core_ranks")]


def _lead(array, rank: int) -> tuple[int, ...]:
    return array.shape[: array.ndim - rank]


def map_arrays(part: Any, fn: Callable[[Any, int], Any]) -> Any:
    """The part with ``fn(array, core_rank)`` in place of each of its batched array fields."""
    if part is None:
        return None
    terms = getattr(part, "terms", None)
    if terms is not None:
        return eqx.tree_at(lambda p: p.terms, part, tuple(map_arrays(t, fn) for t in terms))
    for name in _inner(part):
        inner = map_arrays(getattr(part, name), fn)
        part = eqx.tree_at(lambda p, name=name: getattr(p, name), part, inner)
    fields = _fields(part)
    if not fields:
        return part
    new = [fn(getattr(part, name), rank) for name, rank in fields]
    return eqx.tree_at(lambda p: [getattr(p, name) for name, _ in fields], part, new)


def batch_shapes(part: Any) -> list[tuple[int, ...]]:
    """Leading axes of every array of a part."""
    found: list[tuple[int, ...]] = []
    map_arrays(part, lambda x, rank: (found.append(_lead(x, rank)), x)[1])
    return found


def common_batch(*parts: Any, extra: tuple[tuple[int, ...], ...] = ()) -> tuple[int, ...]:
    """The batch shape that all parts broadcast to; ValueError names the shapes otherwise."""
    shapes = [shape for part in parts for shape in batch_shapes(part)] + list(extra)
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError as error:
        given = ", ".join(
            f"{type(part).__name__}: {sorted(set(batch_shapes(part)))}"
            for part in parts
            if part is not None
        )
        raise ValueError(
            f"the batch axes do not broadcast together ({given}; ts: {list(extra)}): give every"
            " array the same leading axes, or 1 where it is shared."
        ) from error


def flatten(part: Any, batch: tuple[int, ...], *, shared: bool = True) -> Any:
    """Arrays as (N, ...) lanes; with ``shared``, arrays of one body stay without batch axis."""

    def to_lanes(x, rank):
        core = x.shape[x.ndim - rank :]
        if shared and x.size == int(np.prod(core, dtype=int)):
            return x.reshape(core)
        return jnp.broadcast_to(x.reshape(_lead(x, rank) + core), batch + core).reshape(-1, *core)

    def full_rank(x, rank):
        missing = len(batch) - (x.ndim - rank)
        return x.reshape((1,) * missing + x.shape)

    return map_arrays(map_arrays(part, full_rank), to_lanes)


def is_lane_tree(parts: Any) -> Any:
    """Mask of the leaves that carry the lane axis, for ``eqx.partition`` of (scene, state)."""
    mask = jax.tree.map(lambda _: False, parts)

    def mark(target, source):
        if source is None or not hasattr(source, "core_ranks"):
            return target
        terms = getattr(source, "terms", None)
        if terms is not None:
            new = tuple(mark(t, s) for t, s in zip(target.terms, terms))
            return eqx.tree_at(lambda p: p.terms, target, new)
        for name in _inner(source):
            inner = mark(getattr(target, name), getattr(source, name))
            target = eqx.tree_at(lambda p, name=name: getattr(p, name), target, inner)
        names = [name for name, rank in _fields(source) if getattr(source, name).ndim > rank]
        if not names:
            return target
        return eqx.tree_at(lambda p: [getattr(p, n) for n in names], target, [True] * len(names))

    scene, state = mask
    whole, bodies = parts
    for name in PARTS:
        if getattr(whole, name, None) is not None:
            new = mark(getattr(scene, name), getattr(whole, name))
            scene = eqx.tree_at(lambda s, name=name: getattr(s, name), scene, new)
    return scene, mark(state, bodies)


def along_time(part: Any, batch_rank: int) -> Any:
    """Arrays as (batch..., 1, core...): ready to broadcast against samples (batch..., T, core)."""

    def expand(x, rank):
        lead, core = _lead(x, rank), x.shape[x.ndim - rank :]
        return x.reshape((1,) * (batch_rank - len(lead)) + lead + (1, *core))

    return map_arrays(part, expand)


def map_chunks(fn: Callable[[Any], Any], lanes: Any, n: int, size: int) -> Any:
    """``fn`` over chunks of at most ``size`` of the ``n`` lanes, one after the other.

    Memory stays bounded by a chunk and its arrays stay in the cache. The last chunk is filled up
    with copies of the last lane, which are dropped again.
    """
    if n <= size:
        return fn(lanes)
    count = -(-n // size)

    def split(x):
        fill = jnp.broadcast_to(x[-1:], (count * size - n, *x.shape[1:]))
        return jnp.concatenate([x, fill]).reshape(count, size, *x.shape[1:])

    chunks = jax.lax.map(fn, jax.tree.map(split, lanes))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], chunks)
