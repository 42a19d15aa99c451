"""A derivative rule for functions whose closed-form derivative is 0/0 somewhere in the domain."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

Direction = tuple[tuple[int, float], ...]


def with_forward_partials(core: Callable, directions: tuple[Direction, ...]) -> Callable:
    """`core` with a rule that carries the partial derivatives forward through its recursion.

    A direction lists (argument, weight) pairs that move together; the tangent of its first
    argument leads. The partials share one pass of the recursion and are themselves a function with
    such a rule, so any order works, and reverse mode stores the partials only, nothing of the
    recursion. All arguments share one shape; the result may have axes in front of it.
    """
    function = jax.custom_jvp(core)

    def slopes(active: tuple[Direction, ...]) -> Callable:
        moving = sorted({i for direction in active for i, _ in direction})

        def partials(*arguments):
            def restricted(*some):
                everything = list(arguments)
                for i, value in zip(moving, some, strict=True):
                    everything[i] = value
                return core(*everything)

            primals = tuple(arguments[i] for i in moving)
            units = tuple(
                jnp.stack([jnp.full_like(x, dict(d).get(i, 0.0)) for d in active])
                for i, x in zip(moving, primals, strict=True)
            )
            return jax.vmap(lambda *unit: jax.jvp(restricted, primals, unit)[1])(*units)

        return with_forward_partials(partials, directions)

    def rule(primals, tangents):
        value = function(*primals)
        active = tuple(d for d in directions if not isinstance(tangents[d[0][0]], SymbolicZero))
        total = jnp.zeros_like(value)
        if active:
            for slope, direction in zip(slopes(active)(*primals), active, strict=True):
                leading = tangents[direction[0][0]]
                total = total + slope * leading[(None,) * (value.ndim - leading.ndim)]
        return value, total

    function.defjvp(rule, symbolic_zeros=True)
    return function
