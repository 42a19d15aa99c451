"""Calls of compiled programs.

``jit_distinct`` calls a compiled program with arrays as operands and all else as static arguments.
An array that occurs several times in a pytree, such as an orbit in several parts of a scene, is one
operand of the program. ``jax.jit`` would make an operand of every leaf, and values that depend on
the array would be computed several times.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np


class Distinct(eqx.Module):
    """A pytree flattened to its distinct leaves; ``places[k]`` (static) is the index of leaf k."""

    leaves: list[Any]
    places: tuple[int, ...] = eqx.field(static=True)
    tree: Any = eqx.field(static=True)

    def __init__(self, tree: Any):
        leaves, self.tree = jax.tree.flatten(tree)
        numbers: dict[int, int] = {}
        self.places = tuple(numbers.setdefault(id(x), len(numbers)) for x in leaves)
        self.leaves = list({id(x): x for x in leaves}.values())

    def value(self) -> Any:
        """The pytree, in which leaves that were the same array are the same array again."""
        return jax.tree.unflatten(self.tree, [self.leaves[i] for i in self.places])


class _Static(NamedTuple):
    """A pytree without its arrays, hashable. ``sources`` contains, for each leaf, the number of its
    array, or a tuple with the leaf itself."""

    tree: Any
    sources: tuple[int | tuple[Any], ...]

    def with_arrays(self, arrays: list[Any]) -> Any:
        leaves = (arrays[s] if isinstance(s, int) else s[0] for s in self.sources)
        return jax.tree.unflatten(self.tree, leaves)


def _split(value: Any) -> tuple[_Static, list[Any]]:
    """The static part of a pytree, and its arrays, each once."""
    # One loop over the leaves. ``eqx.filter_jit`` partitions and combines trees instead, which
    # makes a call take three times as long.
    leaves, tree = jax.tree.flatten(value)
    arrays: list[Any] = []
    numbers: dict[int, int] = {}
    sources: list[int | tuple[Any]] = []
    for leaf in leaves:
        if not isinstance(leaf, _ARRAYS):
            sources.append((leaf,))
            continue
        number = numbers.setdefault(id(leaf), len(arrays))
        if number == len(arrays):
            arrays.append(leaf)
        sources.append(number)
    return _Static(tree, tuple(sources)), arrays


_ARRAYS = (jax.Array, np.ndarray, np.generic)


@jax.tree_util.register_static
class _StaticResult:
    """A static value returned by a compiled program, which JAX stores in the output's tree."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _StaticResult) and self.value == other.value

    def __hash__(self) -> int:
        return hash(self.value)


def jit_distinct(fn: Callable) -> Callable:
    """``jax.jit`` for functions of pytrees that contain more than arrays, such as scenes.

    ``jax.jit`` caches one compiled program for each structure of the arguments; scenes that differ
    in numbers share it. Unlike with ``eqx.filter_jit``, an array that occurs several times is one
    operand, and a call takes a third of the time.
    """

    @functools.partial(jax.jit, static_argnums=0)
    def program(static: _Static, arrays: list[Any]):
        args, kwargs = static.with_arrays(arrays)
        static, results = _split(fn(*args, **kwargs))
        return _StaticResult(static), results

    @functools.wraps(fn)
    def call(*args, **kwargs):
        static, results = program(*_split((args, kwargs)))
        return static.value.with_arrays(results)

    call.program = program  # type: ignore[attr-defined]
    return call
