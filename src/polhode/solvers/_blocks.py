"""Blocks of bodies that stay in the cache."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


def check_layout(block: int | None, substeps: int) -> None:
    """Raises ValueError unless both counts, options of the solvers here, make sense."""
    if block is not None and block < 1:
        raise ValueError(f"block={block}: give the number of bodies (about 128) or None.")
    if substeps < 1:
        raise ValueError(f"substeps={substeps}: give the number of equal steps, at least 1.")


def _is_lane(leaf: Any, bodies: int) -> bool:
    return eqx.is_array(leaf) and leaf.ndim > 0 and leaf.shape[-1] == bodies


def map_blocks(fn: Callable, size: int | None, y: Any, rest: Any) -> Any:
    """``fn(y, rest)`` on blocks of at most ``size`` bodies, one block after the other.

    Bodies lie along the last axis of every array of ``y``; arrays of ``rest`` whose last axis
    has as many entries are cut likewise, all others are shared. Every output has them last.
    """
    shape = jax.tree.leaves(y)[0].shape
    bodies = shape[-1] if shape else 1
    if size is None or bodies <= size:
        return fn(y, rest)
    count = -(-bodies // size)
    size = -(-bodies // count)
    lanes, shared = eqx.partition(rest, lambda leaf: _is_lane(leaf, bodies))

    def cut(leaf):
        fill = [(0, 0)] * (leaf.ndim - 1) + [(0, count * size - bodies)]
        leaf = jnp.pad(leaf, fill, mode="edge").reshape(*leaf.shape[:-1], count, size)
        return jnp.moveaxis(leaf, -2, 0)

    def join(leaf):
        leaf = jnp.moveaxis(leaf, 0, -2)
        return leaf.reshape(*leaf.shape[:-2], count * size)[..., :bodies]

    blocks = jax.tree.map(cut, (y, lanes))
    out = jax.lax.map(lambda block: fn(block[0], eqx.combine(block[1], shared)), blocks)
    return jax.tree.map(join, out)
