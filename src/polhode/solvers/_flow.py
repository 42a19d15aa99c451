"""The state at a later time by the extrapolated midpoint rule, differentiable as the exact flow.

The derivative is not that of the steps: forward mode integrates the variational equations along
with the state, reverse mode the adjoint equations from the end back to the start, by the same rule
in as many steps. Neither keeps the path.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree

from polhode._kernel import apart, kernel
from polhode.solvers._costates import FINER, AnyCostate, Costate, FlatCostate
from polhode.solvers._extrapolation import SEQUENCES, carried_on, extrapolation_weights
from polhode.solvers._linear import linear
from polhode.solvers._specialise import specialise


def flow(
    field: Callable[..., PyTree],
    args: PyTree,
    y0: PyTree[Array],
    span: tuple[Array, Array],
    count: Array,
    order: int,
    compensated: bool = False,
    costate: Costate | None = None,
) -> PyTree[Array]:
    r"""State at the time ``span[1]``, by ``count`` equal steps of ``Extrapolation(order)``.

    ``field(t, y, args)`` treats the bodies, the entries of the arrays of ``y``, separately; all
    these arrays have one shape (n,). No derivative with respect to ``count``. ``compensated``: the
    midpoint rule sums changes within a step, not states, and what rounding takes from the state
    after a step is added to the next: less rounding, by a third longer. ``costate``: equations of
    the slopes for states of special form, in place of those above.

    Reverse mode solves $y' = f$, $\lambda' = -\lambda\,\partial f/\partial y$,
    $\mu' = -\lambda\,\partial f/\partial c$ backwards, $c$ the coefficients that ``field`` is made
    of, as far as they depend on what is differentiated; it has the accuracy of the solution.
    Memory does not grow with the steps. A field that draws its bodies together strongly loses
    digits on the way back, exp(rate of contraction * time) of them.

    ??? cite "Reference"
        L. S. Pontryagin et al., The Mathematical Theory of Optimal Processes (1962), chapter 1;
        E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
        section I.14, on the variational equations.
    """
    equations, c = equations_of(field, args, y0, span[0], order, compensated, costate)
    leaves, tree = jax.tree.flatten(y0)
    return jax.tree.unflatten(tree, equations.end(c, leaves, *span, count))


def equations_of(
    field: Callable[..., PyTree],
    args: PyTree,
    y0: PyTree[Array],
    t: Array,
    order: int,
    compensated: bool = False,
    costate: Costate | None = None,
) -> tuple["Equations", list[Array]]:
    """The field on lists of arrays, and all arrays that it rests on.

    What the functions in ``args`` close over is among them: it may be differentiated.
    """
    leaves, tree = jax.tree.flatten(y0)
    arrays, static = eqx.partition(args, eqx.is_array)
    arrays, args_tree = jax.tree.flatten(arrays)

    def opened(given):
        return eqx.combine(jax.tree.unflatten(args_tree, given), static)

    def plain(t, *given):
        y = jax.tree.unflatten(tree, given[: len(leaves)])
        return jax.tree.leaves(field(t, y, opened(given[len(leaves) :])))

    closed = jax.make_jaxpr(plain)(t, *leaves, *arrays)
    flat = None if costate is None else FlatCostate(costate, y0, t, arrays, opened)
    c = [*closed.consts, *([] if flat is None else flat.consts), *arrays]
    return Equations(closed.jaxpr, len(closed.consts), len(leaves), order, compensated, flat), c


class Equations:
    """A field on lists of arrays, f(t, y, c), its solutions and their derivatives.

    ``end(c, y, t0, t1, count)``: the state at t1. ``pinned(c, y, t0, t1, count, end)``: ``end``,
    the same found by other means, with the derivatives of the solution.
    """

    def __init__(self, jaxpr, closed_over, size, order, compensated, costate):
        self.jaxpr, self.closed_over, self.size = jaxpr, closed_over, size
        self.order, self.compensated = order, compensated
        self.costate = AnyCostate(self.field) if costate is None else costate
        self.end = jax.custom_jvp(self._end)
        self.end.defjvp(self._end_jvp, symbolic_zeros=True)
        self.pinned = jax.custom_jvp(lambda c, y, t0, t1, count, end: list(end))
        self.pinned.defjvp(self._pinned_jvp, symbolic_zeros=True)

    def _parts(self, c: Sequence[Any]):
        """What the field closes over, what the costate does, arguments of both."""
        known = len(getattr(self.costate, "consts", ()))
        first, second = self.closed_over, self.closed_over + known
        return list(c[:first]), list(c[first:second]), list(c[second:])

    def field(self, c: Sequence[Any], t, y: Sequence[Any]) -> list[Any]:
        consts, _, arrays = self._parts(c)
        return jaxpr_as_fun(ClosedJaxpr(self.jaxpr, consts))(t, *y, *arrays)

    def back(self, c: Sequence[Any], t, z: Sequence[Any]) -> tuple[list[Any], Any]:
        """Rates of state and costate, and the scalar whose slope by ``c`` is integrated."""
        if isinstance(self.costate, AnyCostate):
            return self.costate.rates(c, t, z)
        return self.costate.at(*self._parts(c)[1:], t, z)

    def folded(self, c, t, y):
        """Coefficients that the field rests on, and what does the rest."""
        closed = jax.make_jaxpr(lambda *x: self.field(x[: len(c)], x[len(c)], x[len(c) + 1 :]))(
            *c, t, *y
        )
        return specialise(closed, c)

    def _end(self, c, y, t0, t1, count):
        def rates(held, t, y, along):
            return run(held, t, *y), []

        run = self.folded(c, t0, y).run
        return self._solve(rates, self.folded(c, t0, y).held, y, [], (t0, t1), count)[0]

    def _end_jvp(self, primals, tangents):
        end = self.end(*primals[:-1], primals[-1] * _FORWARD)
        return end, self._moved(primals, tangents, end)

    def _pinned_jvp(self, primals, tangents):
        end = self.pinned(*primals)
        return end, self._moved(primals[:-1], tangents[:-1], end)

    def _moved(self, primals, tangents, end):
        c, y, t0, t1, count = primals
        dc, dy, dt0, dt1, _ = tangents
        at = tuple(i for i, x in enumerate(dc) if is_slope(x))
        dy = [_full(x) for x in dy]
        if is_slope(dt0):
            dy = [a - dt0 * f for a, f in zip(dy, self.field(c, t0, y))]
        maps = (partial(self._tangent, at), partial(self._cotangent, at))
        given = [t0, t1, count, *y, *end, *c]
        moved = linear(*maps, given, [*dy, *(dc[i] for i in at)], end)
        if is_slope(dt1):
            moved = [a + dt1 * f for a, f in zip(moved, self.field(c, t1, end))]
        return moved

    def _split(self, given):
        t0, t1, count, *rest = given
        y, rest = rest[: self.size], rest[self.size :]
        return (t0, t1), count, y, rest[: self.size], rest[self.size :]

    def _tangent(self, at, given, operands):
        """Change of the end for changes of the start and of ``c[i]``, i in ``at``."""
        span, count, y, _, c = self._split(given)
        dy, dc = operands[: self.size], operands[self.size :]
        known = [*c, *dc]

        def both(*leaves):
            c, dc = leaves[: len(c_)], leaves[len(c_) : len(known)]
            t, z = leaves[len(known)], leaves[len(known) + 1 :]
            y, dy = z[: self.size], z[self.size :]

            def f(y, some):
                return self.field(_put(c, at, some), t, y)

            rate, change = jax.jvp(f, (list(y), [c[i] for i in at]), (list(dy), list(dc)))
            return [*rate, *change]

        c_ = c
        z = [*y, *dy]
        held, run, _ = specialise(jax.make_jaxpr(both)(*known, span[0], *z), known)
        z, _ = self._solve(
            lambda h, t, z, along: (run(h, t, *z), []), held, z, [], span, count, FINER
        )
        return z[self.size :]

    def _cotangent(self, at, given, slopes):
        """The transpose: slopes with respect to the start and to ``c[i]``."""
        span, count, start, end, c = self._split(given)
        z, size = self.costate.begin(end, slopes), len(c)

        def paired(*given):
            rates, k = self.back(given[:size], given[size], given[size + 1 :])
            return [*rates, k]

        closed = jax.make_jaxpr(paired)(*c, span[0], *z)

        def coefficients(fold, *some):
            return list(specialise(closed, _put(c, at, some), fold=fold).held)

        # components of what is differentiated are fewer than what folding makes of them
        some, lane = [c[i] for i in at], end[0].shape
        for fold in (False, True):
            made, run, seen = specialise(closed, c, fold=fold)
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

        pace = self.costate.finer, self.costate.lower
        z, mu = self._solve(rates, (full.held, bare.held), z, mu, span[::-1], count, *pace)
        mu = [_summed(m, jnp.shape(made[i])) for m, i in zip(mu, which)]
        return [*self.costate.finish(z, start, end, slopes), *pull(mu)]

    def _solve(self, rates, held, y, quadratures, span, count, finer=1.0, lower=0):
        """States and integrals at the end of equal steps."""
        t0, t1 = span
        order = max(self.order - lower, min(SEQUENCES))
        dtype = jnp.result_type(*y)
        count = jnp.ceil(jnp.asarray(count, jnp.result_type(t0)) * finer)
        whole = count.astype(jnp.int32)

        def march(held, t0, width, whole, y, quadratures):
            def one(i, found):
                y, low, sums = found
                t = t0 + i.astype(width.dtype) * width
                change, more = _step(order, self.compensated, rates, held, t, width, dtype, y, sums)
                y, low = carried_on(y, low, change) if self.compensated else (change, low)
                return y, low, more

            low = [jnp.zeros_like(x) for x in y] if self.compensated else []
            y, _, sums = jax.lax.fori_loop(0, whole, one, (y, low, quadratures))
            return y, sums

        width = (t1 - t0) / count
        return kernel(march)(held, t0, width, whole, list(y), list(quadratures))


_FORWARD = 1.25
"""Steps of a state that is differentiated over those asked for: its slope is more sensitive."""


def _step(order: int, compensated: bool, rates, held, t0, width, dtype, y, quadratures):
    """State after one extrapolated step, or its change where steps are ``compensated``; integrals.

    Integrals of functions of the state need every other point only.
    """
    sequence = SEQUENCES[order]
    weights = extrapolation_weights(sequence)

    @kernel
    def whole(held, a, b, sums, t, step):
        f, g = rates(held, t, b, True)
        return _plus(a, step, f), _plus(sums, step, g)

    @kernel
    def between(held, a, b, t, step):
        return _plus(a, step, rates(held, t, b, False)[0])

    def place(a):
        return apart(_sums, list(y), a, when=jnp.isfinite(width)) if compensated else a

    first = kernel(lambda held, t, y: rates(held, t, y, False)[0])(held, t0, y)
    origin = [jnp.zeros_like(x) for x in y] if compensated else y

    def column(n):
        h = width / n
        step = (2 * h).astype(dtype)

        def pair(i, found):
            a, b, sums = found
            t = t0 + (2 * i + 1).astype(h.dtype) * h
            a, sums = whole(held, a, place(b), sums, t, step)
            return a, between(held, b, place(a), t + h, step), sums

        start = origin, _plus(origin, h.astype(dtype), first), [0 * x for x in quadratures]
        a, b, sums = jax.lax.fori_loop(0, n.astype(jnp.int32) // 2 - 1, pair, start)
        return whole(held, a, place(b), sums, t0 + (width - h), step)

    # one loop over the columns, the longest first, is compiled once
    counts = jnp.asarray((sequence[-1], *sequence[:-1]), jnp.result_type(width))
    shares = jnp.asarray((0.0, *map(float, weights[:-1])), dtype)

    def add(j, found):
        longest, new = found
        this = column(counts[j])
        longest = jax.tree.map(lambda x, b: jnp.where(j == 0, x, b), this, longest)
        share = shares[j]

        def combine(s, x, b):
            return jnp.where(j == 0, x, s + share.astype(x.dtype) * (x - b))

        return longest, jax.tree.map(combine, new, this, longest)

    empty = (list(y), [jnp.zeros_like(x) for x in quadratures])
    _, (y, sums) = jax.lax.fori_loop(0, len(sequence), add, (empty, empty))
    return y, [q + s for q, s in zip(quadratures, sums)]


def _sums(y, a):
    return [b + c for b, c in zip(y, a)]


def _plus(y, step, f):
    return [a + step.astype(a.dtype) * b for a, b in zip(y, f)]


def _put(values: Sequence[Any], at: Sequence[int], some: Sequence[Any]) -> list[Any]:
    new = list(values)
    for i, x in zip(at, some):
        new[i] = x
    return new


def is_slope(x: Any) -> bool:
    """Whether a tangent is there at all."""
    return not isinstance(x, SymbolicZero) and x.dtype != jax.dtypes.float0


def _full(x: Any) -> Array:
    return jnp.zeros(x.shape, x.dtype) if isinstance(x, SymbolicZero) else x


def _moving(fn: Callable[..., list[Any]], inputs: list[Any]) -> list[int]:
    """Which inexact results of ``fn`` depend on its inputs."""
    jaxpr = jax.make_jaxpr(fn)(*inputs).jaxpr
    seen = set(jaxpr.invars)
    for eqn in jaxpr.eqns:
        if any(not hasattr(v, "val") and v in seen for v in eqn.invars):
            seen.update(eqn.outvars)
    return [
        i
        for i, v in enumerate(jaxpr.outvars)
        if not hasattr(v, "val") and v in seen and jnp.issubdtype(v.aval.dtype, jnp.inexact)
    ]


def _summed(array: Array, shape: tuple[int, ...]) -> Array:
    """``array`` summed over the axes that broadcasting ``shape`` has added."""
    array = jnp.sum(array, axis=tuple(range(array.ndim - len(shape))))
    ones = tuple(i for i, n in enumerate(shape) if n == 1 and array.shape[i] != 1)
    return jnp.sum(array, axis=ones, keepdims=True)
