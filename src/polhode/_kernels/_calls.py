"""Calls of compiled programs.

``jit_distinct`` calls a compiled program with arrays as operands and all else as static arguments.
Arrays that stand in several places of a pytree, such as one orbit in several parts of a scene, stay
one array in the program: otherwise every leaf would be an operand of its own, and what depends on
the same array would be computed twice.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np


class Distinct(eqx.Module):
    """A pytree with each of its leaves once; ``places`` (static): which leaf stands where."""

    leaves: list[Any]
    places: tuple[int, ...] = eqx.field(static=True)
    tree: Any = eqx.field(static=True)

    def __init__(self, tree: Any):
        leaves, self.tree = jax.tree.flatten(tree)
        numbers: dict[int, int] = {}
        self.places = tuple(numbers.setdefault(id(x), len(numbers)) for x in leaves)
        self.leaves = list({id(x): x for x in leaves}.values())

    def value(self) -> Any:
        """The pytree; what was one array in several places is so again."""
        return jax.tree.unflatten(self.tree, [self.leaves[i] for i in self.places])


class _Static(NamedTuple):
    """All of a pytree but its arrays, hashable: ``sources`` holds for each leaf the number of its
    array, or the leaf itself within a tuple."""

    tree: Any
    sources: tuple[int | tuple[Any], ...]

    def with_arrays(self, arrays: list[Any]) -> Any:
        leaves = (arrays[s] if isinstance(s, int) else s[0] for s in self.sources)
        return jax.tree.unflatten(self.tree, leaves)


def _split(value: Any) -> tuple[_Static, list[Any]]:
    """The static part of a pytree, and its arrays, each once."""
    # One loop over the leaves. ``eqx.filter_jit`` partitions and combines trees instead, and a call
    # takes three times as long.
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
class _Constant:
    """A static value among the results of a program."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _Constant) and self.value == other.value

    def __hash__(self) -> int:
        return hash(self.value)


def jit_distinct(fn: Callable) -> Callable:
    """``jax.jit`` for functions of pytrees that hold more than arrays, such as scenes and methods.

    One compiled program for each structure of the arguments, in the cache of ``jax.jit``: scenes
    that differ in numbers share it. Unlike with ``eqx.filter_jit`` arrays that stand in several
    places stay one in the program, and a call costs a third.
    """

    @functools.partial(jax.jit, static_argnums=0)
    def program(static: _Static, arrays: list[Any]):
        args, kwargs = static.with_arrays(arrays)
        static, results = _split(fn(*args, **kwargs))
        return _Constant(static), results

    @functools.wraps(fn)
    def call(*args, **kwargs):
        static, results = program(*_split((args, kwargs)))
        return static.value.with_arrays(results)

    call.program = program  # type: ignore[attr-defined]
    return call
