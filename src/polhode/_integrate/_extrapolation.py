"""The extrapolated midpoint rule as a diffrax solver."""

import dataclasses
from functools import cache
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from numpy.polynomial import chebyshev

from polhode import _policy
from polhode._hamiltonian import Dynamics
from polhode._integrate._columns import (
    CHOSEN,
    SEQUENCES,
    add_compensated,
    evaluations,
    extrapolated,
    table,
)
from polhode._integrate._diffrax_solve import StepToTimes
from polhode._integrate._field import BoundTerm, FixedArguments, GroupUnits
from polhode._integrate._midpoint import (
    Field,
    Limits,
    Progress,
    initial_progress,
    integrate,
)
from polhode._integrate._tableau import DOP853, TSIT5, Tableau
from polhode._kernels import kernel, opaque_ones, staged


@cache
def _tables(nodes: int) -> tuple[np.ndarray, ...]:
    """Chebyshev nodes on [0, 1], integrals of their cardinal functions up to each node, and the
    Chebyshev coefficients of those functions."""
    x = (1 - np.cos(np.pi * np.arange(nodes) / (nodes - 1))) / 2
    series = np.linalg.inv(chebyshev.chebvander(2 * x - 1, nodes - 1))
    integrals = chebyshev.chebint(series, lbnd=-1) / 2
    return x, chebyshev.chebvander(2 * x - 1, nodes) @ integrals, series


def collocate(terms, t0, t1, nodes, y1, args, order: int) -> dict:
    """Chebyshev series of the solution on each substep, of the method's own accuracy.

    ``nodes`` contains the states at the start of each substep along a leading axis, ``y1`` the
    state at the end. Each series starts from the Hermite cubic of the end values and their rates;
    each of the ``order`` Picard sweeps y <- y0 + int f(y) dt on ``order + 2`` nodes gains one
    order. End values do not change.
    """
    # The midpoint rule has no stages from which the solution between the substeps could be
    # interpolated in its order. Picard iteration evaluates the field at new points instead. The
    # compiler removes it unless states within a step are requested.
    x, matrix, series = _tables(order + 2)
    count = jax.tree.leaves(nodes)[0].shape[0]
    ends = jax.tree.map(lambda y, end: jnp.concatenate([y[1:], end[None]]), nodes, y1)
    precision = jnp.result_type(*jax.tree.leaves(y1))
    control = jax.tree.map(lambda c: jnp.asarray(c / count, precision), terms.contr(t0, t1))
    width = (t1 - t0) / count
    dtype = jnp.result_type(width)

    def column(values, leaf):
        return jnp.asarray(values, leaf.dtype).reshape(-1, *(1,) * leaf.ndim)

    def contract(table, leaf):
        return jnp.tensordot(jnp.asarray(table, leaf.dtype), leaf, 1)

    def on_substep(start, y0, y1):
        times = start + width * jnp.asarray(x, dtype)
        rates_at = jax.vmap(lambda t, y: terms.vf_prod(t, y, args, control))
        ends = jax.tree.map(lambda a, b: jnp.stack([a, b]), y0, y1)
        end_rates = rates_at(jnp.stack([start, start + width]), ends)

        def cubic(y0, y1, f):
            s, jump = column(x, y0), (y1 - y0)[None]
            bend = 3 * jump - 2 * f[:1] - f[1:]
            return y0[None] + s * f[:1] + s**2 * bend + s**3 * (f[:1] + f[1:] - 2 * jump)

        def sweep(_, ys):
            def integrate(y0, y1, node_rates):
                integral = contract(matrix, node_rates)
                return y0[None] + integral + column(x, y0) * ((y1 - y0)[None] - integral[-1:])

            return jax.tree.map(integrate, y0, y1, rates_at(times, ys))

        ys = jax.lax.fori_loop(0, order, sweep, jax.tree.map(cubic, y0, y1, end_rates))
        return jax.tree.map(lambda y: contract(series, y), ys)

    starts = t0 + width * jnp.arange(count, dtype=dtype)
    return {"series": jax.vmap(on_substep)(starts, nodes, ends)}


class CollocationInterpolation(diffrax.AbstractLocalInterpolation):
    """Chebyshev series on each substep of a step; leaves (substeps, coefficients, ...)."""

    t0: Array
    t1: Array
    series: PyTree[Array]

    def evaluate(self, t0, t1=None, left: bool = True) -> PyTree[Array]:
        del left
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        count = jax.tree.leaves(self.series)[0].shape[0]
        width = self.t1 - self.t0
        is_empty = width == 0
        position = jnp.where(is_empty, 0, (t0 - self.t0) / jnp.where(is_empty, 1, width)) * count
        index = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, count - 1)
        s = 2 * (position - index.astype(position.dtype)) - 1

        def clenshaw(series):
            coefficients = series[index]
            z = s.astype(series.dtype)
            b1 = b2 = jnp.zeros_like(coefficients[0])
            for c in coefficients[:0:-1]:
                b1, b2 = c + 2 * z * b1 - b2, b1
            return coefficients[0] + z * b1 - b2

        return jax.tree.map(clenshaw, self.series)


class Accuracy(eqx.Module):
    """The error requested at the last time, and the duration of the motion.

    **Arguments:** ``rtol``: sum of errors, relative to the natural units of the state (for a body:
    attitude in radians, momentum over its size); ``horizon``: from the first to the last time [s];
    ``times`` (T,): see ``Extrapolation.spanning``.
    """

    rtol: Array
    horizon: Array
    times: Array | None = None


class Extrapolation(diffrax.AbstractAdaptiveSolver):
    r"""Extrapolated explicit midpoint rule of even order (4 to 20).

    Columns of $n_j = 2, 4, \dots, p$ leapfrog substeps are combined so that the error terms in
    $h^2, h^4, \dots, h^{p-2}$ cancel. A substep is one evaluation and one addition, and no stages
    are stored, so that the few arrays stay in the cache.

    - ``formal_order``: order $p$. None: chosen from ``accuracy`` in the program (8 to 16; 10 in
      float32).
    - No quantity is conserved exactly; $|q|$, energy and momenta to the accuracy of the step.
    - ``evaluations`` of the field per step (order 8: 21, order 12: 43, order 16: 81).
    - ``compensated``: sums the changes within a step, not the states, and carries the rounding
      error of the state to the next step: less rounding, at a third more time.
    - ``accuracy``: None: each step of diffrax is one step of the method, with an error estimate
      (the difference to order $p - 2$) for any of its controllers. With an ``Accuracy`` one step of
      diffrax consists of as many steps of the method as the tolerance requires, so that the
      overhead of diffrax arises once for each saved time; use ``diffrax.StepTo(ts)`` with it. All
      arrays of the state then have one shape, and their entries are independent bodies.
      ``max_steps``: maximum number of steps of a body; a body that needs more ends as NaN.
      ``jumps``: search for jumps of the field near the ends of a step.
    - Its steps can be differentiated in forward mode only: ``FlowAdjoint`` permits both modes.
    - Dense output: without ``accuracy``, collocation polynomials as accurate as the step. They take
      several times as long as the step itself, and are computed only if the solution is
      interpolated. With ``accuracy`` there is none (NaN).

    ??? cite "Reference"
        W. B. Gragg, SIAM J. Numer. Anal. 2 (1965) 384; R. Bulirsch, J. Stoer, Numer. Math. 8
        (1966) 1; E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
        section II.9, without Gragg's smoothing step. The error control: ``docs/design_notes.md``.
    """

    formal_order: int | None = eqx.field(static=True, default=12)
    compensated: bool = eqx.field(static=True, default=False)
    accuracy: Accuracy | None = None
    max_steps: int = eqx.field(static=True, default=2**16)
    jumps: bool = eqx.field(static=True, default=False)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = CollocationInterpolation

    def __check_init__(self):
        if self.formal_order not in (None, *SEQUENCES):
            raise ValueError(
                f"Extrapolation({self.formal_order}): the order must be even and from 4 to 20, or"
                " None."
            )

    @property
    def evaluations(self) -> int:
        """Evaluations of the vector field in one step."""
        return evaluations(self._fixed_order)

    @property
    def _fixed_order(self) -> int:
        return 12 if self.formal_order is None else self.formal_order

    def stepping(self, request: Any) -> Any:
        """Arguments of ``diffrax.diffeqsolve`` for ``ph.LiePoisson`` and ``ph.EulerAngles``."""
        horizon = jnp.abs(request.ts[-1] - request.ts[0])
        accuracy = Accuracy(*jax.lax.stop_gradient((request.rtol, horizon)))
        solver = Extrapolation(
            self.formal_order, self.compensated, accuracy, request.max_steps, request.jumps
        )
        return request.in_one_call(solver)

    def bodies_at_once(self, terms: PyTree, t: Array, y: PyTree, args: PyTree) -> int:
        """Number of bodies in one solution: a whole work queue if bodies can be exchanged in their
        lanes (``by_entry``), otherwise as many as there are lanes."""
        dtype = jnp.result_type(*jax.tree.leaves(y))
        rates = BoundTerm.of(terms, args).prepare(t, y, dtype)
        return _policy.QUEUE if rates.by_entry else _policy.LANES

    def order(self, terms: PyTree) -> int:
        return self._fixed_order

    def error_order(self, terms: PyTree) -> int:
        return self._fixed_order - 1

    def init(self, terms: PyTree, t0: Any, t1: Any, y0: PyTree, args: PyTree) -> PyTree:
        leaves = jax.tree.leaves(y0)
        if self.accuracy is not None:
            return initial_progress(leaves, self.compensated, jnp.zeros_like(t0))
        return [jnp.zeros_like(x) for x in leaves] if self.compensated else []

    def func(self, terms: PyTree, t0: Any, y0: PyTree, args: PyTree) -> PyTree:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: PyTree,
        t0: Any,
        t1: Any,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: Any,
    ) -> tuple:
        del made_jump
        if self.accuracy is None:
            return self._take_one_step(terms, t0, t1, y0, args, solver_state)
        return self._take_many_steps(self.accuracy, terms, t0, t1, y0, args, solver_state)

    def _take_one_step(self, terms, t0, t1, y0, args, compensation):
        """One step of the method."""
        y, tree = jax.tree.flatten(y0)
        dtype = jnp.result_type(*y)
        problem = BoundTerm.of(terms, args).prepare(t0, y0, dtype)

        def run(coefficients, t, width, y, compensation):
            def rates(t, y, with_integrands):
                return problem.rates(coefficients, t, y), []

            columns = table(self._fixed_order, dtype)
            start_rates, _ = rates(t, y, False)
            result = extrapolated(rates, columns, t, width, y, start_rates, [], self.compensated)
            if not self.compensated:
                return result.change, compensation, result.difference
            return *add_compensated(y, compensation, result.change), result.difference

        y1, compensation, error = kernel(run)(problem.coefficients, t0, t1 - t0, y, compensation)
        y1, error = (jax.tree.unflatten(tree, x) for x in (y1, error))
        nodes = jax.tree.map(lambda x: x[None], y0)
        dense = collocate(terms, t0, t1, nodes, y1, args, self._fixed_order)
        return y1, error, dense, compensation, diffrax.RESULTS.successful

    def spanning(self, controller: diffrax.StepTo, state: Any) -> tuple["Extrapolation", Any, Any]:
        """The solver, the controller and the ``state`` of diffrax for a solution in one step.

        The step leads from the first of the controller's times to the last, and stores the states
        at all of them: C components of n bodies as ``rows`` (n, T + 1, C) of the solver's state."""
        leaves, times = jax.tree.leaves(state.y), controller.ts
        # With a step of diffrax for each saved time, all bodies would wait for the last one at each
        # time. In one step for all times a body continues when it has reached a saved time.
        if self.accuracy is None or jnp.ndim(leaves[0]) != 1 or times.shape[0] == 2:
            return self, controller, state
        dtype = jnp.result_type(*leaves)
        rows = jnp.full((leaves[0].size, times.shape[0] + 1, len(leaves)), jnp.nan, dtype)
        accuracy = Accuracy(self.accuracy.rtol, self.accuracy.horizon, times)
        solver = dataclasses.replace(self, accuracy=accuracy)
        progress = state.solver_state._replace(rows=rows)
        state = eqx.tree_at(lambda s: (s.solver_state, s.tnext), state, (progress, times[-1]))
        return solver, StepToTimes(times[np.array([0, -1])]), state

    def _take_many_steps(self, accuracy: Accuracy, terms, t0, t1, y0, args, progress: Progress):
        """As many steps of the method as ``accuracy`` requires."""
        y, tree = jax.tree.flatten(y0)
        dtype = jnp.result_type(*y)
        # traced once, and divided into coefficients, computed before the steps, and the field
        problem = BoundTerm.of(terms, args).prepare(t0, y0, dtype)
        rtol = jnp.asarray(accuracy.rtol, dtype)
        elapsed = None if accuracy.times is None else accuracy.times - t0
        horizon = jnp.asarray(accuracy.horizon, t0.dtype)
        units = units_of(args, y0, horizon)

        def run(coefficients, units, rtol, horizon, span, y, progress, elapsed):
            def rates(coefficients, t, y, with_integrands):
                return problem.rates(coefficients, t, y), []

            def table_for(rate):
                if self.formal_order is not None:
                    return table(self.formal_order, dtype)
                gap = jnp.abs(span[1] - span[0])
                if elapsed is not None:  # mean interval between saved times
                    gap = gap / jnp.sum(jnp.where(elapsed > 0, 1, 0)).astype(gap.dtype)
                return table(order_for(rtol, jnp.max(rate, initial=0) * gap.astype(dtype)), dtype)

            limits = Limits(rtol, horizon, self.max_steps, self.jumps)
            individual_steps, field_data = not problem.depends_on_time, (coefficients, units)
            field = Field(rates, _apply_units, field_data, individual_steps, problem.by_entry)
            y, _, progress_after = integrate(
                field, table_for, limits, span, y, [], progress, elapsed
            )
            return y, progress_after

        y1, progress = kernel(run)(
            problem.coefficients, units, rtol, horizon, (t0, t1), y, progress, elapsed
        )
        y1 = jax.tree.unflatten(tree, y1)
        no_series = jax.tree.map(lambda x: jnp.full((1, 1, *x.shape), jnp.nan, x.dtype), y1)
        return y1, None, {"series": no_series}, progress, diffrax.RESULTS.successful


def units_of(args: Any, y0: PyTree, horizon: Array) -> Any:
    """Natural units of the states: those among the arguments of the field, otherwise
    ``GroupUnits``."""
    if not isinstance(args, Dynamics | FixedArguments) or args.units is None:
        return GroupUnits.of(y0, horizon)
    return jax.lax.stop_gradient(args.units)


def _apply_units(units, y, rates):
    return units(y, rates)


def order_for(rtol: Array, angle: Array | float = jnp.inf) -> Array:
    """The order with the least work for a tolerance, as a traced number.

    It was measured on 1,000 tops: order 14 takes the least time, or up to a tenth more, down to an
    ``rtol`` of 1e-9. The order is lower at large tolerances, where the long steps of a high order
    make the error estimate less reliable (``benchmarks/error_control.py``), and in single
    precision, where a high order amplifies rounding.

    The order is also lower if steps have to end after ``angle`` [rad], at saved times: the order
    that covers this angle with the fewest evaluations. For the same tops, the mean step at order p
    from 6 to 14 is (0.27 p - 0.3) rtol^(1 / (p + 1)) rad. For 100 saved times in 10 to 30 s a
    factor of 0.9 on this length takes the least time; 0.6 takes up to a sixth more, 1.2 up to a
    third more.
    """
    # Four bounds are sufficient: a model of the work would depend on the motion, and would save a
    # tenth of the time at most.
    best = 10
    if jnp.finfo(rtol.dtype).eps < 1e-9:
        best = 8 + 2 * sum(jnp.where(rtol < bound, 1, 0) for bound in (1e-3, 1e-4, 1e-5, 1e-10))
    if isinstance(angle, float):
        return staged(jnp.asarray(best, rtol.dtype), opaque_ones(rtol))
    chosen_order, least_work, size = best, jnp.full((), jnp.inf, rtol.dtype), jnp.log(rtol)
    for order in CHOSEN:
        step = 0.9 * (0.27 * order - 0.3) * jnp.exp(size / (order + 1))
        work = (evaluations(order) + _policy.STEP_OVERHEAD) * jnp.maximum(1, angle / step)
        better = (order <= best) & (work < least_work) & (angle < step)
        chosen_order, least_work = (
            jnp.where(better, order, chosen_order),
            jnp.where(better, work, least_work),
        )
    return staged(jnp.asarray(chosen_order, rtol.dtype), opaque_ones(rtol))


class Automatic(Extrapolation):
    """The solver that ``ph.simulate`` chooses.

    Small batches of bodies under torques, and fields with kinks or jumps, are integrated by
    explicit Runge-Kutta steps that end at the kinks or jumps (``_loop.py``); all others by the
    extrapolated midpoint rule, with the arguments of ``ph.Extrapolation``.

    ``low_order``: take steps of order 5 if the field has many switches; ``located=False``: explicit
    steps of order 5 for all fields, which do not end at switches.
    """

    low_order: bool = eqx.field(static=True, default=False)
    located: bool = eqx.field(static=True, default=True)

    def rule(self, switches: int) -> Tableau:
        """The explicit Runge-Kutta method for a field with this number of switches."""
        has_many = switches >= _policy.LOW_ORDER_SWITCHES
        return TSIT5 if not self.located or (self.low_order and has_many) else DOP853
