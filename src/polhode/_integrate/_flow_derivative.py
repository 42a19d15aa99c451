"""Derivatives of the exact flow: variational equations forward, adjoint equations backward.

Both are integrated by the extrapolated midpoint rule, with an error control of their own.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array, PyTree

from polhode._checks import is_concrete
from polhode._hamiltonian import Dynamics, LiePoissonUnits, relative
from polhode._integrate._columns import table
from polhode._integrate._extrapolation import order_for, units_of
from polhode._integrate._field import BoundTerm, uses
from polhode._integrate._midpoint import Field, Limits, initial_progress, integrate
from polhode._kernels import Distinct, attached, is_slope, kernel, linear, specialise, zeros


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


_LOST = 1000
"""By how many ``rtol`` the way back may miss the state at its start."""

_LOST_BY_OTHERS = 1e-3
"""The same of states found by other solvers, whose error is not known."""

_STEPS = 2**20
"""Most steps of a derivative between two saved times."""


def equations_of(
    terms: Any,
    args: PyTree,
    y0: PyTree[Array],
    t: Array,
    rtol: Array,
    compensated: bool,
    own: bool = True,
) -> tuple["Equations", list[Array]]:
    """The field on lists of arrays, and all arrays that it rests on.

    What the functions in ``args`` close over is among them: it may be differentiated. ``own``:
    whether the states that are saved keep ``rtol``.
    """
    leaves, tree = jax.tree.flatten(y0)
    problem = BoundTerm.of(terms, args)
    arrays, args_tree = jax.tree.flatten(Distinct(problem.arrays))
    dtype, time_dtype, static = jnp.result_type(*leaves), t.dtype, problem.static

    def opened(given):
        return BoundTerm(jax.tree.unflatten(args_tree, given).value(), static)

    def directed(given):
        problem = opened(given)
        _, args = eqx.combine(problem.arrays, problem.static)
        return problem.forward(time_dtype), args

    def plain(t, *given):
        y, now = jax.tree.unflatten(tree, given[: len(leaves)]), opened(given[len(leaves) :])
        return jax.tree.leaves(now.increment(t, y, now.forward(dtype)))

    closed = jax.make_jaxpr(plain)(t, *leaves, *arrays)
    make = args.costate if isinstance(args, Dynamics) else None
    special = None if make is None else make(args, y0, t)
    closes = not is_concrete(closed.consts, special)
    flat = None if special is None else FlatCostate(special, y0, t, arrays, directed, closes)
    how, told = jax.tree.flatten((rtol, units_of(args, y0, jnp.ones_like(t))))
    counts = len(closed.consts), 0 if flat is None else len(flat.consts), len(arrays)
    c = [*closed.consts, *([] if flat is None else flat.consts), *arrays, *how]
    return Equations(closed.jaxpr, counts, len(leaves), flat, told, compensated, own), c


class Equations:
    """A field f(c, t, y), and the derivatives of its solutions.

    ``follow(c, y, t0, t1, horizon, end, parts)``: ``end``, the solution at t1 found by other
    means, with its derivatives; the whole way takes ``horizon``.
    """

    def __init__(self, jaxpr, counts, size, costate, told, compensated, own):
        self.jaxpr, self.counts, self.size = jaxpr, counts, size
        self.told, self.compensated, self.own = told, compensated, own
        self.costate = AnyCostate(self.field) if costate is None else costate
        self.asks_time = uses(jaxpr, 0)

    def _parts(self, c: Sequence[Any]):
        """What the field closes over, what the costate does, arguments of both, and how accurately
        and in which units derivatives are integrated."""
        ends = np.cumsum(self.counts)
        return [list(c[i:j]) for i, j in zip((0, *ends), (*ends, len(c)))]

    def field(self, c: Sequence[Any], t, y: Sequence[Any]) -> list[Any]:
        consts, _, arrays, _ = self._parts(c)
        return jaxpr_as_fun(ClosedJaxpr(self.jaxpr, consts))(t, *y, *arrays)

    def prepared(self, c: Sequence[Any], t, y: Sequence[Any], stage: bool = False):
        """Arrays held, rates ``run(held, t, *y)`` and ``by_entry``: see ``xla.Specialised``."""
        size = len(c)
        closed = jax.make_jaxpr(lambda *x: self.field(x[:size], x[size], x[size + 1 :]))(*c, t, *y)
        held, run, _, by_entry = specialise(closed, c, stage=stage)
        return held, run, by_entry

    def back(self, c: Sequence[Any], t, z: Sequence[Any]) -> tuple[list[Any], Any]:
        """Rates of state and costate, and the scalar whose slope by ``c`` is integrated."""
        if isinstance(self.costate, AnyCostate):
            return self.costate.rates(c, t, z)
        return self.costate.at(*self._parts(c)[1:3], t, z)

    def follow(self, c, y, t0, t1, horizon, end, parts: int):
        if parts == 1:
            return self._pinned(c, y, t0, t1, horizon, end)
        still = jax.lax.stop_gradient
        shares = jnp.arange(parts + 1, dtype=t0.dtype) / parts
        times = t0 + (t1 - t0) * shares
        times = times.at[-1].set(t1)
        fixed = jax.tree.map(still, (list(c), list(y), times))

        def onward(y, span):
            y = self._solution(fixed[0], y, span, still(horizon))
            return y, y

        _, nodes = jax.lax.scan(onward, fixed[1], (fixed[2][:-2], fixed[2][1:-1]))
        nodes = [jnp.concatenate([x, e[None]]) for x, e in zip(nodes, end)]

        def across(y, part):
            start, stop, reached = part
            return self._pinned(c, y, start, stop, horizon, reached), None

        y, _ = jax.lax.scan(across, list(y), (times[:-1], times[1:], nodes))
        return y

    def _solution(self, c, y, span, horizon):
        """The solution itself."""
        held, run, by_entry = self.prepared(c, span[0], y, stage=True)

        def rates(held, t, y, along):
            return run(held, t, *y), []

        return self._solve(c, rates, held, y, [], span, horizon, _plainly, by_entry)[0]

    def _pinned(self, c, y, t0, t1, horizon, end):
        return attached(self._moved, [t0, t1, horizon, *y, *c], end)

    def _moved(self, operands, tangents, end):
        """Change of the end for changes of the start, of both times and of the arguments."""
        (t0, t1, _), rest = operands[:3], operands[3:]
        dt0, dt1, _ = tangents[:3]
        y, c = rest[: self.size], rest[self.size :]
        dy, dc = tangents[3 : 3 + self.size], tangents[3 + self.size :]
        at = tuple(i for i, x in enumerate(dc) if is_slope(x))
        dy = [x if is_slope(x) else zeros(x) for x in dy]
        if is_slope(dt0):
            dy = [a - dt0 * f for a, f in zip(dy, self.field(c, t0, y))]
        maps = (partial(self._tangent, at), partial(self._cotangent, at))
        given = [*operands[:3], *y, *end, *c]
        moved = linear(*maps, given, [*dy, *(dc[i] for i in at)], end)
        if is_slope(dt1):
            moved = [a + dt1 * f for a, f in zip(moved, self.field(c, t1, end))]
        return moved

    def _split(self, given):
        t0, t1, horizon, *rest = given
        y, rest = rest[: self.size], rest[self.size :]
        return (t0, t1), horizon, y, rest[: self.size], rest[self.size :]

    def _tangent(self, at, given, operands):
        """Change of the end for changes of the start and of ``c[i]``, i in ``at``."""
        span, horizon, y, _, c = self._split(given)
        dy, dc = operands[: self.size], operands[self.size :]
        known, size = [*c, *dc], self.size

        def both(*leaves):
            now, dc = leaves[: len(c)], leaves[len(c) : len(known)]
            t, z = leaves[len(known)], leaves[len(known) + 1 :]
            y, dy = z[:size], z[size:]

            def f(y, some):
                return self.field(_put(now, at, some), t, y)

            rate, change = jax.jvp(f, (list(y), [now[i] for i in at]), (list(dy), list(dc)))
            return [*rate, *change]

        z = [*y, *dy]
        held, run, _, by_entry = specialise(jax.make_jaxpr(both)(*known, span[0], *z), known)

        def rates(held, t, z, along):
            return run(held, t, *z), []

        def units(own, z, f):
            weights, rate = own(z[:size], f[:size])
            return [*weights, *relative(weights, z[size:], f[size:], rate)], rate

        return self._solve(c, rates, held, z, [], span, horizon, units, by_entry)[0][size:]

    def _cotangent(self, at, given, slopes):
        """The transpose: slopes with respect to the start and to ``c[i]``."""
        span, horizon, start, end, c = self._split(given)
        z, size = self.costate.begin(end, slopes), len(c)

        def paired(*given):
            rates, k = self.back(given[:size], given[size], given[size + 1 :])
            return [*rates, k]

        closed = jax.make_jaxpr(paired)(*c, span[0], *z)

        def coefficients(fold, *some):
            return list(specialise(closed, _put(c, at, some), fold=fold, stage=False).held)

        # components of what is differentiated are fewer than what folding makes of them
        some, lane = [c[i] for i in at], end[0].shape
        for fold in (False, True):
            made, run, seen, _ = specialise(closed, c, fold=fold, stage=False)
            which = _moving(partial(coefficients, fold), some)
            if all(seen[i] == {lane} for i in which):
                break
        held, pull = jax.vjp(lambda *some: [coefficients(fold, *some)[i] for i in which], *some)
        del held
        # a number that all bodies share gets a slope in each: no sum in the loop
        shapes = [lane if seen[i] == {lane} else jnp.shape(made[i]) for i in which]
        mu = [jnp.zeros(s, made[i].dtype) for i, s in zip(which, shapes)]

        def adjoint(*leaves, along=True):
            h, (t, *z) = leaves[: len(made)], leaves[len(made) :]

            def pairing(*some):
                *rates, k = run(_put(h, which, some), t, *z)
                return jnp.sum(k), rates

            wide = [jnp.broadcast_to(h[i], s) for i, s in zip(which, shapes)]
            if not along or not which:
                return pairing(*wide)[1]
            moving = tuple(range(len(which)))
            slopes, rates = jax.grad(pairing, argnums=moving, has_aux=True)(*wide)
            return [*rates, *(-x for x in slopes)]

        full, bare = (
            specialise(jax.make_jaxpr(partial(adjoint, along=b))(*made, span[0], *z), made)
            for b in (True, False)
        )

        def rates(held, t, z, along):
            if not along:
                return bare.run(held[1], t, *z), []
            found = full.run(held[0], t, *z)
            return found[: len(z)], found[len(z) :]

        held, own = (full.held, bare.held), all(s == lane for s in shapes)
        by_entry, units = full.by_entry and bare.by_entry, self.costate.units
        z, mu = self._solve(c, rates, held, z, mu, span[::-1], horizon, units, by_entry, own)
        # Backwards, what damping has drawn together runs apart: where the state found on the way
        # has missed the start, the slopes found beside it mean nothing.
        rtol, told = jax.tree.unflatten(self.told, self._parts(c)[3])
        rest = told.least**2 if isinstance(told, LiePoissonUnits) else 0
        apart = sum((a - b) ** 2 for a, b in zip(z[:3], start[:3]))
        unit = sum((a * a + b * b for a, b in zip(start[:3], end[:3])), start=rest)
        most = _LOST * rtol if self.own else _LOST_BY_OTHERS
        lost = jnp.asarray(apart > most**2 * unit)
        z = [jnp.where(lost, jnp.nan, x) for x in z]
        mu = [jnp.where(lost if m.shape == lost.shape else jnp.any(lost), jnp.nan, m) for m in mu]
        mu = [_summed(m, jnp.shape(made[i])) for m, i in zip(mu, which)]
        return [*self.costate.finish(z, start, end, slopes), *pull(mu)]

    def _solve(self, c, rates, held, y, integrals, span, horizon, units, by_entry, own=True):
        """States and integrals at the end. ``units(own, y, rates)``: natural units of the states,
        ``own`` those of the solution's."""
        rtol, told = jax.tree.unflatten(self.told, self._parts(c)[3])
        own = own and not self.asks_time

        def run(held, told, rtol, horizon, span, y, integrals):
            def table_for(rate):
                return table(order_for(rtol), y[0].dtype)

            limits = Limits(rtol, horizon, _STEPS, False)
            progress = initial_progress(y, self.compensated, span[0])
            field = Field(rates, units, (held, told), own, by_entry)
            y, sums, _ = integrate(field, table_for, limits, span, y, integrals, progress)
            return y, sums

        return kernel(run)(held, told, rtol, horizon, span, list(y), list(integrals))


def _plainly(own, y, rates):
    return own(y, rates)


def _put(values: Sequence[Any], at: Sequence[int], some: Sequence[Any]) -> list[Any]:
    new = list(values)
    for i, x in zip(at, some):
        new[i] = x
    return new


def _moving(fn: Callable[..., list[Any]], inputs: list[Any]) -> list[int]:
    """Which inexact results of ``fn`` depend on its inputs."""
    jaxpr = jax.make_jaxpr(fn)(*inputs).jaxpr
    seen = set(jaxpr.invars)
    for eqn in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in seen for v in eqn.invars):
            seen.update(eqn.outvars)
    return [
        i
        for i, v in enumerate(jaxpr.outvars)
        if not isinstance(v, Literal) and v in seen and jnp.issubdtype(v.aval.dtype, jnp.inexact)
    ]


def _summed(array: Array, shape: tuple[int, ...]) -> Array:
    """``array`` summed over the axes that broadcasting ``shape`` has added."""
    array = jnp.sum(array, axis=tuple(range(array.ndim - len(shape))))
    ones = tuple(i for i, n in enumerate(shape) if n == 1 and array.shape[i] != 1)
    return jnp.sum(array, axis=ones, keepdims=True)
