"""A term with its arguments, as one pytree that can be cut into blocks and handed to kernels."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from diffrax import AbstractTerm
from jaxtyping import PyTree

from polhode.solvers._specialise import specialise


class Problem(eqx.Module):
    """Term and arguments: their arrays, and everything else as static structure."""

    arrays: Any
    static: Any = eqx.field(static=True)

    @classmethod
    def of(cls, terms: AbstractTerm, args: PyTree) -> "Problem":
        return cls(*eqx.partition((terms, args), eqx.is_array))

    def control(self, t0, t1, y):
        """The increment of the term's control, for an ODE the (signed) time step, in the
        precision of the state."""
        terms, _ = eqx.combine(self.arrays, self.static)
        dtype = jnp.result_type(*jax.tree.leaves(y))
        return jax.tree.map(lambda c: jnp.asarray(c, dtype), terms.contr(t0, t1))

    def field(self, t, y):
        """The vector field."""
        terms, args = eqx.combine(self.arrays, self.static)
        return terms.vf(t, y, args)

    def increment(self, t, y, control):
        """Vector field times control."""
        terms, args = eqx.combine(self.arrays, self.static)
        return terms.vf_prod(t, y, args, control)

    def prepared(self, t, y, control) -> "Prepared":
        """The increment, for states like ``y``, with all that rests on the arguments done."""
        arrays, tree = jax.tree.flatten(self.arrays)
        state, state_tree = jax.tree.flatten((t, y, control))

        def increment(*leaves):
            problem = Problem(jax.tree.unflatten(tree, leaves[: len(arrays)]), self.static)
            return problem.increment(*jax.tree.unflatten(state_tree, leaves[len(arrays) :]))

        closed, shape = jax.make_jaxpr(increment, return_shape=True)(*arrays, *state)
        held, run, _ = specialise(closed, arrays)
        return Prepared(held, (run, jax.tree.structure(shape)))


class Prepared(eqx.Module):
    """A problem's increment with the arrays that it rests on; see ``Problem.prepared``."""

    held: Any
    static: Any = eqx.field(static=True)

    def increment(self, t, y, control):
        """Vector field times control."""
        run, tree = self.static
        return jax.tree.unflatten(tree, run(self.held, *jax.tree.leaves((t, y, control))))
