"""A diffrax term bound to its arguments, and the natural units in which errors are measured."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval
from jaxtyping import Array, PyTree

from polhode._kernels import formula, specialise


class BoundTerm(eqx.Module):
    """A diffrax term with its arguments, divided into arrays and static structure."""

    arrays: Any
    static: Any = eqx.field(static=True)

    @classmethod
    def of(cls, terms: Any, args: PyTree) -> "BoundTerm":
        return cls(*eqx.partition((terms, args), eqx.is_array))

    def control(self, t0, t1, dtype):
        """The increment of the term's control, for an ODE the (signed) time step."""
        terms, _ = eqx.combine(self.arrays, self.static)
        return jax.tree.map(lambda c: jnp.asarray(c, dtype), terms.contr(t0, t1))

    def forward(self, dtype):
        """The control over one second: for an ODE 1, or -1 where diffrax reverses the time."""
        return self.control(np.zeros(()), np.ones(()), dtype)

    def increment(self, t, y, control):
        """Vector field times control."""
        terms, args = eqx.combine(self.arrays, self.static)
        return terms.vf_prod(t, y, args, control)

    def prepare(self, t, y, dtype) -> "Prepared":
        """Rates of states like ``y``, with everything that depends on the arguments alone
        computed."""
        arrays, tree = jax.tree.flatten(self.arrays)
        leaves, state_tree = jax.tree.flatten(y)

        def rates(*operands):
            values, t, y = (
                operands[: len(arrays)],
                operands[len(arrays)],
                operands[len(arrays) + 1 :],
            )
            problem = BoundTerm(jax.tree.unflatten(tree, values), self.static)
            increments = problem.increment(
                t, jax.tree.unflatten(state_tree, y), problem.forward(dtype)
            )
            return jax.tree.leaves(increments)

        closed_jaxpr = formula(rates, *arrays, t, *leaves)
        coefficients, run, _, by_entry = specialise(closed_jaxpr, arrays)
        return Prepared(coefficients, run, uses(closed_jaxpr.jaxpr, len(arrays)), by_entry)


REVERSE_ONCE = (
    "an integrated motion, a loop of unknown length, has one derivative in reverse mode, the"
    " innermost: for second derivatives take jax.hessian(f) or jax.jacfwd(jax.grad(f)), not"
    " jax.grad(jax.grad(f)) or jax.jacrev(jax.jacfwd(f))."
)


class FixedArguments(eqx.Module):
    """The ``arrays`` on which a field depends, instead of its arguments; ``units``: the natural
    units of its states, or None."""

    arrays: tuple[Array, ...]
    units: Any


def uses(jaxpr, index: int) -> bool:
    """Whether the results of a program depend on its operand at ``index``."""
    _, is_used = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return is_used[index]


class Prepared(NamedTuple):
    """Rates after partial evaluation. ``coefficients``: arrays on which they depend;
    ``run(coefficients, t, *y)``: the rates; ``depends_on_time``: whether they depend explicitly on
    the time; ``by_entry``: see ``_kernels._fold.Specialised``."""

    coefficients: tuple[Any, ...]
    run: Callable[..., list[Any]]
    depends_on_time: bool
    by_entry: bool

    def rates(self, coefficients, t, y) -> list[Any]:
        """The rates, as lists of arrays; ``coefficients`` are an argument so that they can be
        operands of a fused kernel."""
        return self.run(coefficients, t, *y)


def weighted_length(weights: list[Array], error: list[Array]) -> Array:
    """Length of a vector whose components have ``weights``."""
    square = sum((w * e) ** 2 for w, e in zip(weights, error))
    return jnp.sqrt(jax.lax.stop_gradient(square))


class GroupUnits(eqx.Module):
    """Natural units of any state: each top-level subtree is a vector, whose unit is its length.

    The unit of a vector that is zero is its rate times a thousandth of ``span`` [s].
    """

    groups: tuple[int, ...] = eqx.field(static=True)
    span: Array

    @classmethod
    def of(cls, y: Any, span: Array) -> "GroupUnits":
        """Units for states like ``y``."""
        parts = [y] if eqx.is_array(y) else jax.tree.leaves(y, is_leaf=lambda x: x is not y)
        return cls(tuple(len(jax.tree.leaves(part)) for part in parts), span)

    def __call__(self, y: list[Array], rates: list[Array]) -> tuple[list[Array], Array]:
        weights, square, start = [], jnp.zeros_like(y[0]), 0
        for count in self.groups:
            group = slice(start, start + count)
            size = sum(x * x for x in y[group])
            size = size + 1e-6 * sum((self.span.astype(x.dtype) * x) ** 2 for x in rates[group])
            weight = 1 / jnp.sqrt(jnp.where(size > 0, size, 1))
            square = square + sum((weight * x) ** 2 for x in rates[group])
            weights += [weight] * count
            start += count
        return weights, jnp.sqrt(square)
