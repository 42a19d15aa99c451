"""Derivatives of the exact flow: variational equations in forward, adjoint equations in reverse
mode.

Both are integrated by the extrapolated midpoint rule, with their own error control. The *costate*
is the derivative of a result with respect to the state, the cotangent of reverse mode. A *pairing*
is its scalar product with the rates.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial, reduce
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree

from polhode import _policy
from polhode._checks import is_concrete
from polhode._hamiltonian import Dynamics, LiePoissonUnits, relative
from polhode._integrate._columns import table
from polhode._integrate._extrapolation import order_for, units_of
from polhode._integrate._field import REVERSE_ONCE, BoundTerm, uses
from polhode._integrate._midpoint import Field, Limits, initial_progress, integrate
from polhode._kernels import (
    Distinct,
    Specialised,
    dependent_results,
    is_nonzero_tangent,
    kernel,
    linear,
    specialise,
    with_derivative_rule,
    zeros,
)


@runtime_checkable
class Costate(Protocol):
    """Adjoint equations for states of a special form, such as momentum and quaternion.

    - ``begin(y, costate)``: the variables z, integrated backwards from the state ``y`` and the
      ``costate`` at the end;
    - ``rates(t, z, args)``: dz/dt, and K (n,), whose derivative by any of ``args`` is the
      contribution of that argument per unit time;
    - ``finish(z, start, end, costate)``: the costate at the start, for ``costate`` at the end;
    - ``units(state_units, z, rates)``: weights of the components of z and the natural rate;
      ``state_units`` returns those of the state.

    These functions may close over traced values only if the field does, too.
    """

    def begin(self, y: PyTree, costate: PyTree) -> PyTree: ...

    def rates(self, t: Array, z: PyTree, args: PyTree) -> tuple[PyTree, Array]: ...

    def finish(self, z: PyTree, start: PyTree, end: PyTree, costate: PyTree) -> PyTree: ...

    def units(
        self, state_units: Any, z: list[Array], rates: list[Array]
    ) -> tuple[list[Array], Array]: ...


class AnyCostate(NamedTuple):
    """Adjoint equations of any field f(c, t, y): z = (y, a), K = a . f, da/dt = -dK/dy."""

    field: Callable[..., list[Any]]

    def begin(self, end, costate):
        return [*end, *costate]

    def rates(self, c, t, z):
        y, costate = z[: len(z) // 2], z[len(z) // 2 :]

        def pairing(y):
            rate = self.field(c, t, y)
            k = sum(a * f for a, f in zip(costate, rate))
            return jnp.sum(k), (rate, k)

        # The state is integrated backwards with the costate: to store the solution would take
        # memory for every step, and its interpolation would limit the accuracy.
        change, (rate, k) = jax.grad(pairing, has_aux=True)(list(y))
        return [*rate, *(-x for x in change)], k

    def finish(self, z, start, end, costate):
        return z[len(z) // 2 :]

    def units(self, state_units, z, rates):
        half = len(z) // 2
        # The unit of a component of the costate is the inverse of that of the state's component.
        # The costate may grow by orders of magnitude, so that errors are relative to its current
        # size.
        weights, rate = state_units(z[:half], rates[:half])
        dual = [jnp.where(w > 0, 1 / jnp.where(w > 0, w, 1), 0) for w in weights]
        return [*weights, *relative(dual, z[half:], rates[half:], rate)], rate


class FlatCostate:
    """A ``Costate`` on flat lists of arrays.

    ``direction_and_args(arrays)``: the direction of time, 1 or -1, and the arguments of the field.
    ``closes`` (static): whether the functions of the costate may close over traced values. If so,
    the rates are traced here rather than in a derivative, and these values are ``consts``."""

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

    def begin(self, end, end_costate):
        return jax.tree.leaves(self.costate.begin(*map(self._y, (end, end_costate))))

    def at(self, consts: Sequence[Any], arrays: Sequence[Any], t, z):
        if self.jaxpr is None:
            return self._rates(arrays, t, z)
        *rates, k = jaxpr_as_fun(ClosedJaxpr(self.jaxpr, list(consts)))(t, *z, *arrays)
        return rates, k

    def finish(self, z, start, end, end_costate):
        z = jax.tree.unflatten(self.z_tree, z)
        return jax.tree.leaves(self.costate.finish(z, *map(self._y, (start, end, end_costate))))

    def units(self, state_units, z, rates):
        return self.costate.units(
            state_units, *(jax.tree.unflatten(self.z_tree, x) for x in (z, rates))
        )

    def _y(self, leaves):
        return jax.tree.unflatten(self.tree, leaves)


_MAX_BACKWARD_ERROR = 1000
"""[rtol] Maximum error of the initial state that the backward integration reaches; with a larger
one derivatives are NaN."""

_MAX_BACKWARD_ERROR_OF_OTHERS = 1e-3
"""[1] The same for solutions of other solvers, whose error is not known."""

_STATE_AT_REST = 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5
"""Momentum and quaternion of a body at rest, in place of the state of a body that failed."""

_ANGLES_AT_REST = 0.5, 0.5, 0.5
"""The same in Euler angles, away from their poles; the momenta that follow are zero."""

_STEPS = 2**20
"""Maximum number of steps of a derivative between two saved times."""


def equations_of(
    terms: Any,
    args: PyTree,
    y0: PyTree[Array],
    t: Array,
    rtol: Array,
    compensated: bool,
    keeps_rtol: bool = True,
) -> tuple["Equations", list[Array]]:
    """The field on flat lists of arrays, and the list c of all arrays on which it depends.

    It includes arrays over which functions in ``args`` close, since these may be differentiated.
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
    make_costate = args.costate if isinstance(args, Dynamics) else None
    costate = None if make_costate is None else make_costate(args, y0, t)
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

    ``attach_derivatives(c, y, t0, t1, horizon, end)`` attaches these derivatives to ``end``, the
    state at t1 of the solution from ``y`` at t0, which was computed elsewhere; ``horizon``:
    duration of the whole motion [s].
    """

    def __init__(self, jaxpr, counts, size, costate, control_tree, compensated, keeps_rtol):
        self.jaxpr, self.counts, self.size = jaxpr, counts, size
        self.control_tree, self.compensated, self.keeps_rtol = control_tree, compensated, keeps_rtol
        self.costate = AnyCostate(self.field) if costate is None else costate
        self.depends_on_time = uses(jaxpr, 0)

    def _parts(self, c: Sequence[Any]):
        """The four parts of c: the closed-over values of the field, those of the costate, the
        arguments of both, and ``rtol`` with the natural units."""
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

    def adjoint_rates(self, c: Sequence[Any], t, z: Sequence[Any]) -> tuple[list[Any], Any]:
        """Rates of state and costate, and the pairing K, whose derivative by ``c`` is
        integrated."""
        if isinstance(self.costate, AnyCostate):
            return self.costate.rates(c, t, z)
        return self.costate.at(*self._parts(c)[1:3], t, z)

    def attach_derivatives(self, c, y, t0, t1, horizon, end):
        return with_derivative_rule(self._end_tangents, [t0, t1, horizon, *y, *c], end)

    def _end_tangents(self, operands, tangents, end):
        """Tangent of the end for tangents of the start, of both times and of the arguments."""
        # Derivatives by the times need no integration: the end moves along its rates with t1; a
        # change of t0 is equivalent to a change of the initial state against the rates.
        (t0, t1, _), inputs = operands[:3], operands[3:]
        dt0, dt1, _ = tangents[:3]
        y, c = inputs[: self.size], inputs[self.size :]
        dy, dc = tangents[3 : 3 + self.size], tangents[3 + self.size :]
        at = tuple(i for i, x in enumerate(dc) if is_nonzero_tangent(x))
        dy = [x if is_nonzero_tangent(x) else zeros(x) for x in dy]
        if is_nonzero_tangent(dt0):
            dy = [a - dt0 * f for a, f in zip(dy, self.field(c, t0, y))]
        maps = (partial(self._tangent, at), partial(self._cotangent, at))
        primals = [*operands[:3], *y, *end, *c]
        # for few bodies one unit contains the integration and everything around it
        is_few = end[0].size <= _policy.KERNEL_BODIES
        compiled = partial(kernel, of_units=True) if is_few else None
        input_tangents = [*dy, *(dc[i] for i in at)]
        end_tangents = linear(*maps, primals, input_tangents, end, compiled, REVERSE_ONCE)
        if is_nonzero_tangent(dt1):
            end_tangents = [a + dt1 * f for a, f in zip(end_tangents, self.field(c, t1, end))]
        return end_tangents

    def _split(self, primals):
        t0, t1, horizon, *remaining = primals
        y, remaining = remaining[: self.size], remaining[self.size :]
        return (t0, t1), horizon, y, remaining[: self.size], remaining[self.size :]

    def _tangent(self, at, primals, tangents):
        """Tangent of the end for tangents of the start and of ``c[i]``, i in ``at``."""
        span, horizon, y, _, c = self._split(primals)
        dy, dc = tangents[: self.size], tangents[self.size :]
        constants, size = [*c, *dc], self.size

        def rates_and_tangents(*leaves):
            values, dc = leaves[: len(c)], leaves[len(c) : len(constants)]
            t, z = leaves[len(constants)], leaves[len(constants) + 1 :]
            y, dy = z[:size], z[size:]

            def f(y, parameters):
                return self.field(_with_entries(values, at, parameters), t, y)

            rate, change = jax.jvp(f, (list(y), [values[i] for i in at]), (list(dy), list(dc)))
            return [*rate, *change]

        z = [*y, *dy]
        coefficients, run, _, by_entry = specialise(
            jax.make_jaxpr(rates_and_tangents)(*constants, span[0], *z), constants
        )

        def rates(coefficients, t, z, with_integrands):
            return run(coefficients, t, *z), []

        def units(state_units, z, f):
            weights, rate = state_units(z[:size], f[:size])
            return [*weights, *relative(weights, z[size:], f[size:], rate)], rate

        return self._solve(c, rates, coefficients, z, [], span, horizon, units, by_entry)[0][size:]

    def _cotangent(self, at, primals, end_costate):
        """The transpose: cotangents of the start and of ``c[i]``, from those of the end."""
        span, horizon, start, end, c = self._split(primals)
        rtol, natural_units = jax.tree.unflatten(self.control_tree, self._parts(c)[3])
        is_lie_poisson = isinstance(natural_units, LiePoissonUnits)
        # A body that failed is integrated from rest, because NaN would be added to cotangents that
        # are common to all bodies. Its own contribution is zero, or NaN where its cotangents are
        # NaN, as they are if no body finished.
        is_finite = reduce(jnp.logical_and, map(jnp.isfinite, (*start, *end)))
        zero_or_nan = 0 * reduce(jnp.add, end_costate)
        state_at_rest = [
            *(_STATE_AT_REST if is_lie_poisson else _ANGLES_AT_REST),
            *[0.0] * self.size,
        ]
        end = [jnp.where(is_finite, x, r) for x, r in zip(end, state_at_rest)]
        z, size = self.costate.begin(end, end_costate), len(c)

        def rates_and_pairing(*operands):
            rates, k = self.adjoint_rates(operands[:size], operands[size], operands[size + 1 :])
            return [*rates, k]

        closed_jaxpr = jax.make_jaxpr(rates_and_pairing)(*c, span[0], *z)
        adjoint = _specialised_adjoint(closed_jaxpr, c, at, end[0].shape)
        mu = [
            jnp.zeros(s, adjoint.coefficients[i].dtype)
            for i, s in zip(adjoint.dependent, adjoint.shapes)
        ]
        # The midpoint rule needs the integrands at every other point only (`Rates`). A second field
        # without them, for the other points, halves the work of the integrals.
        with_integrals, without_integrals = (
            _adjoint_field(adjoint, span[0], z, with_integrands=b) for b in (True, False)
        )

        def rates(loop_coefficients, t, z, with_integrands):
            if not with_integrands:
                return without_integrals.run(loop_coefficients[1], t, *z), []
            all_rates = with_integrals.run(loop_coefficients[0], t, *z)
            return all_rates[: len(z)], all_rates[len(z) :]

        loop_coefficients, individual_steps = (
            (with_integrals.coefficients, without_integrals.coefficients),
            all(adjoint.is_lane),
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
        # Backwards, solutions that damping has drawn together diverge. If the backward integration
        # does not reach the initial state, the costate is wrong as well, and becomes NaN.
        min_square = natural_units.min_momentum**2 if is_lie_poisson else 0
        square_error = sum((a - b) ** 2 for a, b in zip(z[:3], start[:3]))
        unit = sum((a * a + b * b for a, b in zip(start[:3], end[:3])), start=min_square)
        max_error = _MAX_BACKWARD_ERROR * rtol if self.keeps_rtol else _MAX_BACKWARD_ERROR_OF_OTHERS
        is_inaccurate = jnp.asarray(square_error > max_error**2 * unit) & is_finite
        z = [jnp.where(is_inaccurate, jnp.nan, x) for x in z]
        mu = [
            jnp.where(is_inaccurate if of_lane else jnp.any(is_inaccurate), jnp.nan, m)
            + (zero_or_nan if of_lane else jnp.sum(zero_or_nan))
            for m, of_lane in zip(mu, adjoint.is_lane)
        ]
        coefficients = [adjoint.coefficients[i] for i in adjoint.dependent]
        mu = [_summed(m, jnp.shape(x)) for m, x in zip(mu, coefficients)]
        start_costate = self.costate.finish(z, start, end, end_costate)
        return [
            *(jnp.where(is_finite, x, 0) + zero_or_nan for x in start_costate),
            *adjoint.pullback(mu),
        ]

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
        integrated variables; ``state_units`` returns those of the state."""
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


class _SpecialisedAdjoint(NamedTuple):
    """Rates of the adjoint equations, and the pairing, after partial evaluation.

    ``coefficients``, ``run``: see ``Specialised``; ``dependent``: indices of the coefficients that
    depend on differentiated inputs, each of which takes one integral; for each of these
    ``is_lane``: whether it has an entry for each body, and the shape of the integral in ``shapes``;
    ``pullback``: from the cotangents of these coefficients to those of the inputs."""

    coefficients: tuple[Any, ...]
    run: Callable[..., list[Any]]
    dependent: list[int]
    is_lane: list[bool]
    shapes: list[tuple[int, ...]]
    pullback: Callable[..., Any]


def _specialised_adjoint(
    closed_jaxpr: ClosedJaxpr, c: Sequence[Any], at: Sequence[int], lane: tuple[int, ...]
) -> _SpecialisedAdjoint:
    """``closed_jaxpr``: rates and pairing as a function of ``c``, the time and the variables;
    ``c[i]``, i in ``at``: the differentiated inputs; ``lane``: shape of the components."""

    def coefficients_of(fold, *parameters):
        return list(
            specialise(
                closed_jaxpr, _with_entries(c, at, parameters), fold=fold, stage=False
            ).coefficients
        )

    # Each coefficient of the loop that depends on differentiated inputs takes one more integral.
    # Folding replaces parameters by their products, which are more numerous; the field is therefore
    # first specialised without arithmetic. It is folded only if some of the coefficients then do
    # not have the shape of the lanes.
    parameters = [c[i] for i in at]
    for fold in (False, True):
        coefficients, run, broadcast_shapes, _ = specialise(closed_jaxpr, c, fold=fold, stage=False)
        dependent = _dependent_floats(partial(coefficients_of, fold), parameters)
        if all(broadcast_shapes[i] == {lane} for i in dependent):
            break
    _, pullback = jax.vjp(
        lambda *parameters: [coefficients_of(fold, *parameters)[i] for i in dependent],
        *parameters,
    )
    # a coefficient common to all bodies has a cotangent for each body, so that the loop contains no
    # sum
    is_lane = [broadcast_shapes[i] == {lane} for i in dependent]
    shapes = [
        lane if of_lane else jnp.shape(coefficients[i]) for i, of_lane in zip(dependent, is_lane)
    ]
    return _SpecialisedAdjoint(coefficients, run, dependent, is_lane, shapes, pullback)


def _adjoint_field(
    adjoint: _SpecialisedAdjoint, t: Array, z: Sequence[Any], with_integrands: bool
) -> Specialised:
    """Rates of the variables ``z`` and, if ``with_integrands``, the integrands of the cotangents of
    the dependent coefficients."""
    coefficients, run, dependent, _, shapes, _ = adjoint

    def rates_and_integrands(*leaves):
        loop_values, (t, *z) = leaves[: len(coefficients)], leaves[len(coefficients) :]

        def pairing(*parameters):
            *rates, k = run(_with_entries(loop_values, dependent, parameters), t, *z)
            return jnp.sum(k), rates

        broadcast_parameters = [
            jnp.broadcast_to(loop_values[i], s) for i, s in zip(dependent, shapes)
        ]
        if not with_integrands or not dependent:
            return pairing(*broadcast_parameters)[1]
        argnums = tuple(range(len(dependent)))
        integrands, rates = jax.grad(pairing, argnums=argnums, has_aux=True)(*broadcast_parameters)
        return [*rates, *(-x for x in integrands)]

    return specialise(jax.make_jaxpr(rates_and_integrands)(*coefficients, t, *z), coefficients)


def _with_entries(values: Sequence[Any], at: Sequence[int], entries: Sequence[Any]) -> list[Any]:
    new = list(values)
    for i, x in zip(at, entries):
        new[i] = x
    return new


def _dependent_floats(fn: Callable[..., list[Any]], inputs: list[Any]) -> list[int]:
    """Which inexact results of ``fn`` depend on its inputs."""
    jaxpr = jax.make_jaxpr(fn)(*inputs).jaxpr
    dependent = dependent_results(jaxpr, [True] * len(inputs))
    return [
        i
        for i, v in enumerate(jaxpr.outvars)
        if dependent[i] and jnp.issubdtype(v.aval.dtype, jnp.inexact)
    ]


def _summed(array: Array, shape: tuple[int, ...]) -> Array:
    """``array`` summed over the axes that broadcasting ``shape`` has added."""
    array = jnp.sum(array, axis=tuple(range(array.ndim - len(shape))))
    ones = tuple(i for i, n in enumerate(shape) if n == 1 and array.shape[i] != 1)
    return jnp.sum(array, axis=ones, keepdims=True)
