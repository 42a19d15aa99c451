"""A term with its arguments, as one pytree that can be cut into blocks and handed to kernels."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from diffrax import AbstractTerm
from jax.interpreters import partial_eval
from jaxtyping import PyTree

from polhode._kernels import formula, specialise


class BoundTerm(eqx.Module):
    """Term and arguments: their arrays, and everything else as static structure."""

    arrays: Any
    static: Any = eqx.field(static=True)

    @classmethod
    def of(cls, terms: AbstractTerm, args: PyTree) -> "BoundTerm":
        return cls(*eqx.partition((terms, args), eqx.is_array))

    def control(self, t0, t1, dtype):
        """The increment of the term's control, for an ODE the (signed) time step."""
        terms, _ = eqx.combine(self.arrays, self.static)
        return jax.tree.map(lambda c: jnp.asarray(c, dtype), terms.contr(t0, t1))

    def forward(self, dtype):
        """The control of one second, for an ODE one: minus one where diffrax turns the time."""
        return self.control(np.zeros(()), np.ones(()), dtype)

    def increment(self, t, y, control):
        """Vector field times control."""
        terms, args = eqx.combine(self.arrays, self.static)
        return terms.vf_prod(t, y, args, control)

    def prepared(self, t, y, dtype) -> "Prepared":
        """Rates of states like ``y``, with all that rests on the arguments worked out."""
        arrays, tree = jax.tree.flatten(self.arrays)
        leaves, state_tree = jax.tree.flatten(y)

        def rates(*given):
            known, t, y = given[: len(arrays)], given[len(arrays)], given[len(arrays) + 1 :]
            problem = BoundTerm(jax.tree.unflatten(tree, known), self.static)
            found = problem.increment(t, jax.tree.unflatten(state_tree, y), problem.forward(dtype))
            return jax.tree.leaves(found)

        closed = formula(rates, *arrays, t, *leaves)
        held, run, _, by_entry = specialise(closed, arrays)
        return Prepared(held, run, uses(closed.jaxpr, len(arrays)), by_entry)


def uses(jaxpr, place: int) -> bool:
    """Whether the results of a program depend on its operand at ``place``."""
    _, used = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return used[place]


class Prepared(NamedTuple):
    """``held``: arrays that the rates rest on; ``run(held, t, *y)``: the rates; ``asks_time``:
    whether these depend on the time; ``by_entry``: see ``xla.Specialised``."""

    held: tuple[Any, ...]
    run: Callable[..., list[Any]]
    asks_time: bool
    by_entry: bool

    def rates(self, held, t, y) -> list[Any]:
        """The rates, on lists of arrays; ``held`` is handed in again so that a compiled unit may
        take it as its operand."""
        return self.run(held, t, *y)
