"""The equations that carry slopes back along a motion, on lists of arrays."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree

from polhode._hamiltonian import relative


@runtime_checkable
class Costate(Protocol):
    """Equations of the slopes of a result, for states of special form.

    ``begin(y, slopes)``: the state z to integrate backwards from the end ``y``; ``rates(t, z,
    args)``: dz/dt, and K (n,), whose slope by any of ``args`` is that of the result per unit time;
    ``finish(z, start, end, slopes)``: the slopes by the start, ``slopes`` those at the end.
    ``units(own, z, rates)``: weights of the components of z and the natural rate, ``own`` those of
    the state. What these functions close over is traced only where the field closes over traced
    values, too.
    """

    def begin(self, y: PyTree, slopes: PyTree) -> PyTree: ...

    def rates(self, t: Array, z: PyTree, args: PyTree) -> tuple[PyTree, Array]: ...

    def finish(self, z: PyTree, start: PyTree, end: PyTree, slopes: PyTree) -> PyTree: ...

    def units(self, own: Any, z: list[Array], rates: list[Array]) -> tuple[list[Array], Array]: ...


class AnyCostate(NamedTuple):
    """Of any field f(c, t, y): z = (y, a), K = a . f, da/dt = -dK/dy."""

    field: Callable[..., list[Any]]

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

    def units(self, own, z, rates):
        half = len(z) // 2
        weights, rate = own(z[:half], rates[:half])
        dual = [jnp.where(w > 0, 1 / jnp.where(w > 0, w, 1), 0) for w in weights]
        return [*weights, *relative(dual, z[half:], rates[half:], rate)], rate


class FlatCostate:
    """A costate on lists of arrays. ``opened(arrays)``: the direction of time, 1 or -1, and the
    arguments. ``closes`` (static): whether its functions may close over traced values; these are
    ``consts``, and the rates are traced at once, not where a derivative asks for them."""

    def __init__(self, costate: Costate, y0: PyTree, t: Array, arrays: list[Array], opened, closes):
        self.costate, self.opened = costate, opened
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), y0)
        self.shapes, self.tree = shapes, jax.tree.structure(y0)
        self.jaxpr, self.consts = None, []
        if closes:
            z = jax.tree.leaves(jax.eval_shape(costate.begin, shapes, shapes))

            def rates(t, *given):
                found, k = self._rates(given[len(z) :], t, given[: len(z)])
                return [*found, k]

            closed = jax.make_jaxpr(rates)(t, *z, *arrays)
            self.jaxpr, self.consts = closed.jaxpr, list(closed.consts)

    @cached_property
    def z_tree(self):
        return jax.tree.structure(jax.eval_shape(self.costate.begin, self.shapes, self.shapes))

    def _rates(self, arrays, t, z):
        sign, args = self.opened(arrays)
        found, k = self.costate.rates(sign * t, jax.tree.unflatten(self.z_tree, z), args)
        *found, k = (sign.astype(x.dtype) * x for x in (*jax.tree.leaves(found), k))
        return found, k

    def begin(self, end, slopes):
        return jax.tree.leaves(self.costate.begin(*map(self._y, (end, slopes))))

    def at(self, consts: Sequence[Any], arrays: Sequence[Any], t, z):
        if self.jaxpr is None:
            return self._rates(arrays, t, z)
        *rates, k = jaxpr_as_fun(ClosedJaxpr(self.jaxpr, list(consts)))(t, *z, *arrays)
        return rates, k

    def finish(self, z, start, end, slopes):
        z = jax.tree.unflatten(self.z_tree, z)
        return jax.tree.leaves(self.costate.finish(z, *map(self._y, (start, end, slopes))))

    def units(self, own, z, rates):
        return self.costate.units(own, *(jax.tree.unflatten(self.z_tree, x) for x in (z, rates)))

    def _y(self, leaves):
        return jax.tree.unflatten(self.tree, leaves)
