"""Derivatives of the exact flow: variational equations forward, adjoint equations backward.

Both are integrated by the extrapolated midpoint rule, with an error control of their own.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial, reduce
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array, PyTree

from polhode import _policy
from polhode._checks import is_concrete
from polhode._hamiltonian import Dynamics, LiePoissonUnits, relative
from polhode._integrate._columns import table
from polhode._integrate._extrapolation import order_for, units_of
from polhode._integrate._field import REVERSE_ONCE, BoundTerm, uses
from polhode._integrate._midpoint import Field, Limits, initial_progress, integrate
from polhode._kernels import Distinct, attached, is_slope, kernel, linear, specialise, zeros


@runtime_checkable
class Costate(Protocol):
    """Equations of the slopes of a result, for states of special form.

    ``begin(y, slopes)``: the state z to integrate backwards from the end ``y``; ``rates(t, z,
    args)``: dz/dt, and K (n,), whose slope by any of ``args`` is that of the result per unit time;
    ``finish(z, start, end, slopes)``: the slopes by the start, ``slopes`` those at the end.
    ``units(state_units, z, rates)``: weights of the components of z and the natural rate;
    ``state_units`` gives those of the state. What these functions close over is traced only where
    the field closes over traced values, too.
    """

    def begin(self, y: PyTree, slopes: PyTree) -> PyTree: ...

    def rates(self, t: Array, z: PyTree, args: PyTree) -> tuple[PyTree, Array]: ...

    def finish(self, z: PyTree, start: PyTree, end: PyTree, slopes: PyTree) -> PyTree: ...

    def units(
        self, state_units: Any, z: list[Array], rates: list[Array]
    ) -> tuple[list[Array], Array]: ...


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

        # the state goes back with its slopes: a stored path would need memory for every step, and
        # its interpolation would limit the accuracy
        change, (rate, k) = jax.grad(pairing, has_aux=True)(list(y))
        return [*rate, *(-x for x in change)], k

    def finish(self, z, start, end, slopes):
        return z[len(z) // 2 :]

    def units(self, state_units, z, rates):
        half = len(z) // 2
        # Slopes are measured in the inverse units of what they belong to. They may grow by orders
        # of magnitude on the way, so that their errors are relative to their present size.
        weights, rate = state_units(z[:half], rates[:half])
        dual = [jnp.where(w > 0, 1 / jnp.where(w > 0, w, 1), 0) for w in weights]
        return [*weights, *relative(dual, z[half:], rates[half:], rate)], rate


class FlatCostate:
    """A costate on lists of arrays. ``direction_and_args(arrays)``: the direction of time, 1 or -1,
    and the arguments. ``closes`` (static): whether its functions may close over traced values;
    these are ``consts``, and the rates are traced at once, not where a derivative asks for them."""

    def __init__(
        self,
        costate: Costate,
        y0: PyTree,
        t: Array,
        arrays: list[Array],
        direction_and_args,
        closes,
    ):
        self.costate, self.direction_and_args = costate, direction_and_args
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), y0)
        self.shapes, self.tree = shapes, jax.tree.structure(y0)
        self.jaxpr, self.consts = None, []
        if closes:
            z = jax.tree.leaves(jax.eval_shape(costate.begin, shapes, shapes))

            def rates(t, *operands):
                z_rates, k = self._rates(operands[len(z) :], t, operands[: len(z)])
                return [*z_rates, k]

            closed_jaxpr = jax.make_jaxpr(rates)(t, *z, *arrays)
            self.jaxpr, self.consts = closed_jaxpr.jaxpr, list(closed_jaxpr.consts)

    @cached_property
    def z_tree(self):
        return jax.tree.structure(jax.eval_shape(self.costate.begin, self.shapes, self.shapes))

    def _rates(self, arrays, t, z):
        sign, args = self.direction_and_args(arrays)
        z_rates, k = self.costate.rates(sign * t, jax.tree.unflatten(self.z_tree, z), args)
        *z_rates, k = (sign.astype(x.dtype) * x for x in (*jax.tree.leaves(z_rates), k))
        return z_rates, k

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

    def units(self, state_units, z, rates):
        return self.costate.units(
            state_units, *(jax.tree.unflatten(self.z_tree, x) for x in (z, rates))
        )

    def _y(self, leaves):
        return jax.tree.unflatten(self.tree, leaves)


_LOST = 1000
"""By how many ``rtol`` the way back may miss the state at its start."""

_LOST_BY_OTHERS = 1e-3
"""The same of states found by other solvers, whose error is not known."""

_RESTING = 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5
"""Momentum and quaternion of a body at rest."""

_RESTING_ANGLES = 0.5, 0.5, 0.5
"""Euler angles of a body at rest, away from their poles; the momenta that follow are zero."""

_STEPS = 2**20
"""Most steps of a derivative between two saved times."""


def equations_of(
    terms: Any,
    args: PyTree,
    y0: PyTree[Array],
    t: Array,
    rtol: Array,
    compensated: bool,
    keeps_rtol: bool = True,
) -> tuple["Equations", list[Array]]:
    """The field on lists of arrays, and all arrays that it rests on.

    What the functions in ``args`` close over is among them: it may be differentiated.
    ``keeps_rtol``: whether the error of the saved states is below ``rtol``.
    """
    leaves, tree = jax.tree.flatten(y0)
    problem = BoundTerm.of(terms, args)
    arrays, args_tree = jax.tree.flatten(Distinct(problem.arrays))
    dtype, time_dtype, static = jnp.result_type(*leaves), t.dtype, problem.static

    def problem_of(values):
        return BoundTerm(jax.tree.unflatten(args_tree, values).value(), static)

    def direction_and_args(values):
        problem = problem_of(values)
        _, args = eqx.combine(problem.arrays, problem.static)
        return problem.forward(time_dtype), args

    def flat_field(t, *operands):
        y, problem = (
            jax.tree.unflatten(tree, operands[: len(leaves)]),
            problem_of(operands[len(leaves) :]),
        )
        return jax.tree.leaves(problem.increment(t, y, problem.forward(dtype)))

    closed_jaxpr = jax.make_jaxpr(flat_field)(t, *leaves, *arrays)
    make = args.costate if isinstance(args, Dynamics) else None
    costate = None if make is None else make(args, y0, t)
    closes = not is_concrete(closed_jaxpr.consts, costate)
    flat_costate = (
        None if costate is None else FlatCostate(costate, y0, t, arrays, direction_and_args, closes)
    )
    control, control_tree = jax.tree.flatten((rtol, units_of(args, y0, jnp.ones_like(t))))
    counts = (
        len(closed_jaxpr.consts),
        0 if flat_costate is None else len(flat_costate.consts),
        len(arrays),
    )
    c = [
        *closed_jaxpr.consts,
        *([] if flat_costate is None else flat_costate.consts),
        *arrays,
        *control,
    ]
    return Equations(
        closed_jaxpr.jaxpr, counts, len(leaves), flat_costate, control_tree, compensated, keeps_rtol
    ), c


class Equations:
    """A field f(c, t, y), and the derivatives of its solutions.

    ``follow(c, y, t0, t1, horizon, end)``: ``end``, the solution at t1 found by other means, with
    its derivatives; the whole way takes ``horizon``.
    """

    def __init__(self, jaxpr, counts, size, costate, control_tree, compensated, keeps_rtol):
        self.jaxpr, self.counts, self.size = jaxpr, counts, size
        self.control_tree, self.compensated, self.keeps_rtol = control_tree, compensated, keeps_rtol
        self.costate = AnyCostate(self.field) if costate is None else costate
        self.depends_on_time = uses(jaxpr, 0)

    def _parts(self, c: Sequence[Any]):
        """What the field closes over, what the costate does, arguments of both, and how accurately
        and in which units derivatives are integrated."""
        ends = np.cumsum(self.counts)
        return [list(c[i:j]) for i, j in zip((0, *ends), (*ends, len(c)))]

    def field(self, c: Sequence[Any], t, y: Sequence[Any]) -> list[Any]:
        consts, _, arrays, _ = self._parts(c)
        return jaxpr_as_fun(ClosedJaxpr(self.jaxpr, consts))(t, *y, *arrays)

    def prepare(self, c: Sequence[Any], t, y: Sequence[Any]):
        """Coefficients, rates ``run(coefficients, t, *y)`` and ``by_entry``: see
        ``Specialised``."""
        size = len(c)
        closed_jaxpr = jax.make_jaxpr(lambda *x: self.field(x[:size], x[size], x[size + 1 :]))(
            *c, t, *y
        )
        coefficients, run, _, by_entry = specialise(closed_jaxpr, c, stage=False)
        return coefficients, run, by_entry

    def back(self, c: Sequence[Any], t, z: Sequence[Any]) -> tuple[list[Any], Any]:
        """Rates of state and costate, and the scalar whose slope by ``c`` is integrated."""
        if isinstance(self.costate, AnyCostate):
            return self.costate.rates(c, t, z)
        return self.costate.at(*self._parts(c)[1:3], t, z)

    def follow(self, c, y, t0, t1, horizon, end):
        return attached(self._end_tangents, [t0, t1, horizon, *y, *c], end)

    def _end_tangents(self, operands, tangents, end):
        """Change of the end for changes of the start, of both times and of the arguments."""
        # Times need no integration: the end moves along its rates with t1, and against those of
        # the start with t0.
        (t0, t1, _), inputs = operands[:3], operands[3:]
        dt0, dt1, _ = tangents[:3]
        y, c = inputs[: self.size], inputs[self.size :]
        dy, dc = tangents[3 : 3 + self.size], tangents[3 + self.size :]
        at = tuple(i for i, x in enumerate(dc) if is_slope(x))
        dy = [x if is_slope(x) else zeros(x) for x in dy]
        if is_slope(dt0):
            dy = [a - dt0 * f for a, f in zip(dy, self.field(c, t0, y))]
        maps = (partial(self._tangent, at), partial(self._cotangent, at))
        primals = [*operands[:3], *y, *end, *c]
        # one unit of the steps and of what comes before and after them
        few = end[0].size <= _policy.KERNEL_BODIES
        compiled = partial(kernel, of_units=True) if few else None
        slopes = [*dy, *(dc[i] for i in at)]
        end_tangents = linear(*maps, primals, slopes, end, compiled, REVERSE_ONCE)
        if is_slope(dt1):
            end_tangents = [a + dt1 * f for a, f in zip(end_tangents, self.field(c, t1, end))]
        return end_tangents

    def _split(self, primals):
        t0, t1, horizon, *rest = primals
        y, rest = rest[: self.size], rest[self.size :]
        return (t0, t1), horizon, y, rest[: self.size], rest[self.size :]

    def _tangent(self, at, primals, tangents):
        """Change of the end for changes of the start and of ``c[i]``, i in ``at``."""
        span, horizon, y, _, c = self._split(primals)
        dy, dc = tangents[: self.size], tangents[self.size :]
        constants, size = [*c, *dc], self.size

        def rates_and_tangents(*leaves):
            values, dc = leaves[: len(c)], leaves[len(c) : len(constants)]
            t, z = leaves[len(constants)], leaves[len(constants) + 1 :]
            y, dy = z[:size], z[size:]

            def f(y, parameters):
                return self.field(_put(values, at, parameters), t, y)

            rate, change = jax.jvp(f, (list(y), [values[i] for i in at]), (list(dy), list(dc)))
            return [*rate, *change]

        z = [*y, *dy]
        coefficients, run, _, by_entry = specialise(
            jax.make_jaxpr(rates_and_tangents)(*constants, span[0], *z), constants
        )

        def rates(coefficients, t, z, along):
            return run(coefficients, t, *z), []

        def units(state_units, z, f):
            weights, rate = state_units(z[:size], f[:size])
            return [*weights, *relative(weights, z[size:], f[size:], rate)], rate

        return self._solve(c, rates, coefficients, z, [], span, horizon, units, by_entry)[0][size:]

    def _cotangent(self, at, primals, slopes):
        """The transpose: slopes with respect to the start and to ``c[i]``."""
        span, horizon, start, end, c = self._split(primals)
        rtol, natural_units = jax.tree.unflatten(self.control_tree, self._parts(c)[3])
        is_lie_poisson = isinstance(natural_units, LiePoissonUnits)
        # A body that failed is followed from rest, as NaN would reach what all bodies share, and
        # adds nothing: zero, or NaN where its slopes are NaN, as they are if no body finished.
        is_known = reduce(jnp.logical_and, map(jnp.isfinite, (*start, *end)))
        nothing = 0 * reduce(jnp.add, slopes)
        rest = [*(_RESTING if is_lie_poisson else _RESTING_ANGLES), *[0.0] * self.size]
        end = [jnp.where(is_known, x, r) for x, r in zip(end, rest)]
        z, size = self.costate.begin(end, slopes), len(c)

        def rates_and_pairing(*operands):
            rates, k = self.back(operands[:size], operands[size], operands[size + 1 :])
            return [*rates, k]

        closed_jaxpr = jax.make_jaxpr(rates_and_pairing)(*c, span[0], *z)

        def coefficients_of(fold, *parameters):
            return list(
                specialise(
                    closed_jaxpr, _put(c, at, parameters), fold=fold, stage=False
                ).coefficients
            )

        # Each coefficient of the loop that depends on what is differentiated is one more integral
        # to carry along. Folding makes products of them, which are more numerous than the numbers
        # themselves, so the field is first taken apart without arithmetic. Only if some of these
        # are not of the shape of the lanes is it folded after all.
        parameters, lane = [c[i] for i in at], end[0].shape
        for fold in (False, True):
            coefficients, run, broadcast_shapes, _ = specialise(
                closed_jaxpr, c, fold=fold, stage=False
            )
            which = _dependent_results(partial(coefficients_of, fold), parameters)
            if all(broadcast_shapes[i] == {lane} for i in which):
                break
        loop_coefficients, pull = jax.vjp(
            lambda *parameters: [coefficients_of(fold, *parameters)[i] for i in which], *parameters
        )
        del loop_coefficients
        # a number that all bodies share gets a slope in each: no sum in the loop
        is_lane = [broadcast_shapes[i] == {lane} for i in which]
        shapes = [
            lane if of_lane else jnp.shape(coefficients[i]) for i, of_lane in zip(which, is_lane)
        ]
        mu = [jnp.zeros(s, coefficients[i].dtype) for i, s in zip(which, shapes)]

        def adjoint(*leaves, along=True):
            h, (t, *z) = leaves[: len(coefficients)], leaves[len(coefficients) :]

            def pairing(*parameters):
                *rates, k = run(_put(h, which, parameters), t, *z)
                return jnp.sum(k), rates

            wide = [jnp.broadcast_to(h[i], s) for i, s in zip(which, shapes)]
            if not along or not which:
                return pairing(*wide)[1]
            argnums = tuple(range(len(which)))
            slopes, rates = jax.grad(pairing, argnums=argnums, has_aux=True)(*wide)
            return [*rates, *(-x for x in slopes)]

        # The midpoint rule needs the integrands at every other point only (`Rates`): a field that
        # leaves them out is a second program in the loop, and half the work of the integrals.
        with_integrals, without_integrals = (
            specialise(
                jax.make_jaxpr(partial(adjoint, along=b))(*coefficients, span[0], *z), coefficients
            )
            for b in (True, False)
        )

        def rates(loop_coefficients, t, z, along):
            if not along:
                return without_integrals.run(loop_coefficients[1], t, *z), []
            all_rates = with_integrals.run(loop_coefficients[0], t, *z)
            return all_rates[: len(z)], all_rates[len(z) :]

        loop_coefficients, individual_steps = (
            (with_integrals.coefficients, without_integrals.coefficients),
            all(is_lane),
        )
        by_entry, units = with_integrals.by_entry and without_integrals.by_entry, self.costate.units
        z, mu = self._solve(
            c,
            rates,
            loop_coefficients,
            z,
            mu,
            span[::-1],
            horizon,
            units,
            by_entry,
            individual_steps,
        )
        # Backwards, what damping has drawn together runs apart: where the state found on the way
        # has missed the start, the slopes found beside it mean nothing.
        floor = natural_units.min_momentum**2 if is_lie_poisson else 0
        square_miss = sum((a - b) ** 2 for a, b in zip(z[:3], start[:3]))
        unit = sum((a * a + b * b for a, b in zip(start[:3], end[:3])), start=floor)
        max_miss = _LOST * rtol if self.keeps_rtol else _LOST_BY_OTHERS
        has_missed = jnp.asarray(square_miss > max_miss**2 * unit) & is_known
        z = [jnp.where(has_missed, jnp.nan, x) for x in z]
        mu = [
            jnp.where(has_missed if of_lane else jnp.any(has_missed), jnp.nan, m)
            + (nothing if of_lane else jnp.sum(nothing))
            for m, of_lane in zip(mu, is_lane)
        ]
        mu = [_summed(m, jnp.shape(coefficients[i])) for m, i in zip(mu, which)]
        start_slopes = self.costate.finish(z, start, end, slopes)
        return [*(jnp.where(is_known, x, 0) + nothing for x in start_slopes), *pull(mu)]

    def _solve(
        self,
        c,
        rates,
        coefficients,
        y,
        integrals,
        span,
        horizon,
        units,
        by_entry,
        individual_steps=True,
    ):
        """States and integrals at the end. ``units(state_units, y, rates)``: natural units of the
        states; ``state_units`` gives those of the solution."""
        rtol, state_units = jax.tree.unflatten(self.control_tree, self._parts(c)[3])
        individual_steps = individual_steps and not self.depends_on_time

        def run(coefficients, state_units, rtol, horizon, span, y, integrals):
            def table_for(rate):
                return table(order_for(rtol), y[0].dtype)

            limits = Limits(rtol, horizon, _STEPS, False)
            progress = initial_progress(y, self.compensated, span[0])
            field = Field(rates, units, (coefficients, state_units), individual_steps, by_entry)
            y, sums, _ = integrate(field, table_for, limits, span, y, integrals, progress)
            return y, sums

        return kernel(run)(coefficients, state_units, rtol, horizon, span, list(y), list(integrals))


def _put(values: Sequence[Any], at: Sequence[int], entries: Sequence[Any]) -> list[Any]:
    new = list(values)
    for i, x in zip(at, entries):
        new[i] = x
    return new


def _dependent_results(fn: Callable[..., list[Any]], inputs: list[Any]) -> list[int]:
    """Which inexact results of ``fn`` depend on its inputs."""
    jaxpr = jax.make_jaxpr(fn)(*inputs).jaxpr
    dependent_vars = set(jaxpr.invars)
    for eqn in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in dependent_vars for v in eqn.invars):
            dependent_vars.update(eqn.outvars)
    return [
        i
        for i, v in enumerate(jaxpr.outvars)
        if not isinstance(v, Literal)
        and v in dependent_vars
        and jnp.issubdtype(v.aval.dtype, jnp.inexact)
    ]


def _summed(array: Array, shape: tuple[int, ...]) -> Array:
    """``array`` summed over the axes that broadcasting ``shape`` has added."""
    array = jnp.sum(array, axis=tuple(range(array.ndim - len(shape))))
    ones = tuple(i for i, n in enumerate(shape) if n == 1 and array.shape[i] != 1)
    return jnp.sum(array, axis=ones, keepdims=True)
