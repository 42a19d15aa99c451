"""The equations that carry slopes back along a motion, on lists of arrays."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree


class Costate(Protocol):
    """Equations of the slopes of a result, for states of special form.

    ``begin(y, slopes)``: the state z to integrate backwards from the end ``y``; ``rates(t, z,
    args)``: dz/dt, and K (n,), whose slope by any of ``args`` is that of the result per unit time;
    ``finish(z, start, end, slopes)``: the slopes by the start, ``slopes`` those at the end.
    ``finer``: steps over those that the state alone needs; ``lower``: how much lower their order.
    """

    @property
    def finer(self) -> float: ...

    @property
    def lower(self) -> int: ...

    def begin(self, y: PyTree, slopes: PyTree) -> PyTree: ...

    def rates(self, t: Array, z: PyTree, args: PyTree) -> tuple[PyTree, Array]: ...

    def finish(self, z: PyTree, start: PyTree, end: PyTree, slopes: PyTree) -> PyTree: ...


FINER = 1.15
"""Steps of the derivatives' equations over those asked for the state alone."""


class AnyCostate(NamedTuple):
    """Of any field f(c, t, y): z = (y, a), K = a . f, da/dt = -dK/dy."""

    field: Callable[..., list[Any]]
    finer: float = FINER
    lower: int = 0

    def begin(self, end, slopes):
        return [*end, *slopes]

    def rates(self, c, t, z):
        y, slopes = z[: len(z) // 2], z[len(z) // 2 :]

        def pairing(y):
            rate = self.field(c, t, y)
            k = sum(a * f for a, f in zip(slopes, rate))
            return jnp.sum(k), (rate, k)

        change, (rate, k) = jax.grad(pairing, has_aux=True)(list(y))
        return [*rate, *(-x for x in change)], k

    def finish(self, z, start, end, slopes):
        return z[len(z) // 2 :]


class FlatCostate:
    """A costate on lists of arrays; ``consts``: what its functions close over."""

    def __init__(self, costate: Costate, y0: PyTree, t: Array, arrays: list[Array], opened):
        self.costate, self.tree = costate, jax.tree.structure(y0)
        self.finer, self.lower = costate.finer, costate.lower
        z = jax.eval_shape(costate.begin, y0, y0)
        leaves, tree = jax.tree.flatten(z)

        def rates(t, *given):
            z = jax.tree.unflatten(tree, given[: len(leaves)])
            found, k = costate.rates(t, z, opened(given[len(leaves) :]))
            return [*jax.tree.leaves(found), k]

        closed = jax.make_jaxpr(rates)(t, *leaves, *arrays)
        self.jaxpr, self.consts, self.z_tree = closed.jaxpr, list(closed.consts), tree

    def begin(self, end, slopes):
        return jax.tree.leaves(self.costate.begin(*map(self._y, (end, slopes))))

    def at(self, consts: Sequence[Any], arrays: Sequence[Any], t, z):
        *rates, k = jaxpr_as_fun(ClosedJaxpr(self.jaxpr, list(consts)))(t, *z, *arrays)
        return rates, k

    def finish(self, z, start, end, slopes):
        z = jax.tree.unflatten(self.z_tree, z)
        return jax.tree.leaves(self.costate.finish(z, *map(self._y, (start, end, slopes))))

    def _y(self, leaves):
        return jax.tree.unflatten(self.tree, leaves)
