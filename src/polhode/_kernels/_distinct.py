"""Arrays that stand in several places of a pytree, such as one orbit in several parts of a scene.

A compiled program takes every leaf of its arguments as an array of its own, and works out twice
what rests on the same array twice. What is passed as ``Distinct`` keeps them one.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


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


def jit_distinct(fn: Callable) -> Callable:
    """``eqx.filter_jit``, but arrays that stand in several places stay one in the program."""

    @eqx.filter_jit
    def program(given: Distinct):
        args, kwargs = given.value()
        return fn(*args, **kwargs)

    @functools.wraps(fn)
    def call(*args, **kwargs):
        return program(Distinct((args, kwargs)))

    return call
