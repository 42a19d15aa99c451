"""A derivative rule for functions whose closed-form derivative is 0/0 somewhere in the domain."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

Direction = tuple[tuple[int, float], ...]


def with_forward_partials(core: Callable, directions: tuple[Direction, ...]) -> Callable:
    """`core` with a rule that carries the partial derivatives forward through its recursion.

    A direction lists (argument, weight) pairs that move together; the tangent of its first
    argument leads. Every partial is itself a function with such a rule, so any order works, and
    reverse mode stores the partials only, nothing of the recursion. All arguments share a shape.
    """
    function = jax.custom_jvp(core)

    def slope(direction: Direction) -> Callable:
        weights = dict(direction)

        def partial(*arguments):
            units = tuple(
                jnp.full_like(argument, weights.get(i, 0.0)) for i, argument in enumerate(arguments)
            )
            return jax.jvp(core, arguments, units)[1]

        return with_forward_partials(partial, directions)

    def rule(primals, tangents):
        value = function(*primals)
        total = jnp.zeros_like(value)
        for direction in directions:
            leading = tangents[direction[0][0]]
            if not isinstance(leading, SymbolicZero):
                total = total + slope(direction)(*primals) * leading
        return value, total

    function.defjvp(rule, symbolic_zeros=True)
    return function
