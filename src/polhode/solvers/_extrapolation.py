"""Extrapolated midpoint rule (Gragg, Bulirsch, Stoer): any even order from one table."""

from fractions import Fraction
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from polhode._kernel import apart, kernel
from polhode.solvers._blocks import check_layout, map_blocks
from polhode.solvers._dense import CollocationInterpolation, collocate
from polhode.solvers._problem import Prepared, Problem

SEQUENCES = {
    4: (2, 4),
    6: (2, 4, 8),
    8: (2, 4, 6, 12),
    10: (2, 4, 6, 8, 14),
    12: (2, 4, 6, 8, 10, 18),
    14: (2, 4, 6, 8, 10, 14, 22),
    16: (2, 4, 6, 8, 10, 12, 16, 30),
    18: (2, 4, 6, 8, 10, 12, 14, 20, 32),
    20: (2, 4, 6, 8, 10, 12, 14, 16, 24, 36),
}
"""Substeps of the columns of each order.

Found by search over even numbers: within 15 % of the least work (evaluations per step over the
step length that the error constant prod n_j^2 allows), the least amplification of rounding,
sqrt(sum w_j^2 n_j). The harmonic sequence 2, 4, 6, ... amplifies it 3 (order 10) to 30 (order 20)
times more.
"""


def extrapolation_weights(sequence: tuple[int, ...]) -> tuple[Fraction, ...]:
    """Weights of the columns in the value at zero step width, for an expansion in h^2.

    w_j = prod_(i != j) n_j^2 / (n_j^2 - n_i^2): Hairer, Norsett, Wanner, Solving Ordinary
    Differential Equations I, section II.9, equations (9.5) and (9.13).
    """
    weights = []
    for j, n in enumerate(sequence):
        weight = Fraction(1)
        for i, m in enumerate(sequence):
            if i != j:
                weight *= Fraction(n * n, n * n - m * m)
        weights.append(weight)
    return tuple(weights)


class Extrapolation(diffrax.AbstractAdaptiveSolver):
    r"""Extrapolated explicit midpoint rule of even order ``order`` (4 to 20).

    Columns of $n_j = 2, 4, \dots, p$ leapfrog substeps are combined so that the error terms in
    $h^2, h^4, \dots, h^{p-2}$ cancel. A substep is one evaluation and one addition, so the few
    live arrays stay in the cache and no stage is kept.

    - Order $p$; error estimate: difference to the order $p - 2$ of the columns without $n = 2$,
      for every body. One-step: the step may change at will.
    - ``evaluations`` of the field per step (order 8: 21, order 12: 43, order 16: 81).
    - Conserves nothing exactly; $|q|$, energy and momenta to the accuracy of the step.
    - ``substeps``: equal steps of the method inside one diffrax step, whose own cost (microseconds)
      is then shared; the error estimate is the sum of their absolute values.
    - Dense output: collocation polynomials of the same accuracy on the substeps. They cost some
      times the step itself, and nothing unless interpolated: to record at given times, step to
      them (``diffrax.StepTo`` with ``diffrax.SaveAt(t0=True, steps=True)``).
    - ``block``: bodies handled together inside a step, so that large batches stay in the cache.
      Needs a vector field that treats bodies separately, with bodies on the last axis of every
      array of the state, and of every array of the term and of ``args`` that differs from body
      to body. None: all at once. About 128 is best where the first cache holds 32 KiB.
    - ``compact``: the columns in one loop, so that the vector field stands in the program only a
      few times: half the time to compile, or less, at the same speed. Reverse mode cannot pass
      through such steps, forward mode can.
    - ``compensated``: sums the changes within a step, not the states, and adds what rounding took
      from the state after a step to the next one: less rounding, by a third longer.

    ??? cite "Reference"
        W. B. Gragg, SIAM J. Numer. Anal. 2 (1965) 384; R. Bulirsch, J. Stoer, Numer. Math. 8
        (1966) 1; E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
        section II.9, without Gragg's smoothing step.
    """

    formal_order: int = eqx.field(static=True, default=12)
    block: int | None = eqx.field(static=True, default=None)
    substeps: int = eqx.field(static=True, default=1)
    compact: bool = eqx.field(static=True, default=False)
    compensated: bool = eqx.field(static=True, default=False)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = CollocationInterpolation

    def __check_init__(self):
        if self.formal_order not in SEQUENCES:
            raise ValueError(
                f"Extrapolation({self.formal_order}): the order must be even and from 4 to 20."
            )
        check_layout(self.block, self.substeps)

    @property
    def evaluations(self) -> int:
        """Evaluations of the vector field in one step."""
        sequence = SEQUENCES[self.formal_order]
        return sum(sequence) - len(sequence) + 1

    def order(self, terms) -> int:
        return self.formal_order

    def error_order(self, terms) -> int:
        return self.formal_order - 1

    def init(self, terms, t0, t1, y0, args) -> PyTree:
        return jax.tree.map(jnp.zeros_like, y0) if self.compensated else None

    def func(self, terms, t0, y0, args) -> PyTree:
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del made_jump

        def advance(given, rest):
            y, low = given
            problem, (t, width), control = rest
            prepared = problem.prepared(t, y, control)
            step = _compact_step if self.compact else _step

            def run(*operands):
                return _steps(step, self.formal_order, self.substeps, *operands)

            run = kernel(run)
            return run(prepared, (t, width), control, y, low)

        problem = Problem.of(terms, args)
        rest = (problem, (t0, t1 - t0), problem.control(t0, t1, y0))
        y1, low, error, nodes = map_blocks(advance, self.block, (y0, solver_state), rest)
        dense = collocate(terms, t0, t1, nodes, y1, args, self.formal_order)
        return y1, error, dense, low, diffrax.RESULTS.successful


def carried_on(y: PyTree, low: PyTree, change: PyTree) -> tuple[PyTree, PyTree]:
    """``y + low + change`` as a rounded sum and what rounding took from it.

    D. E. Knuth, The Art of Computer Programming 2, section 4.2.2, theorem B.
    """
    change = _add(low, change)
    new = _add(y, change)

    def lost(a, c, s):
        b = s - a
        return (a - (s - b)) + (c - b)

    return new, jax.tree.map(lost, y, change, new)


def _add(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.add, a, b)


def _add_share(a: PyTree, share: float, b: PyTree) -> PyTree:
    return jax.tree.map(lambda x, y: x + share * y, a, b)


def _steps(step, order: int, count: int, problem: Prepared, times, control, y, low):
    """State after ``count`` equal steps, what rounding took from it (None: not followed), summed
    size of their errors, states they started from."""
    t0, width = times
    share = jax.tree.map(lambda c: c / count, control)

    def one(carry, i):
        y, low, total = carry
        times = t0 + i * (width / count), width / count
        new, error = step(order, problem, times, share, y, low is not None)
        if low is not None:
            new, low = carried_on(y, low, new)
        return (new, low, jax.tree.map(lambda s, e: s + jnp.abs(e), total, error)), y

    start = (y, low, jax.tree.map(jnp.zeros_like, y))
    steps = jnp.arange(count, dtype=jnp.result_type(width))
    (y, low, error), nodes = jax.lax.scan(one, start, steps)
    return y, low, error, nodes


def _columns(problem: Prepared, times, control, y, compensated: bool):
    """The midpoint rule in ``n`` substeps, a column of the table, for numbers ``n`` that may be
    traced integers: the state after them, or its change where they are ``compensated``."""
    t0, width = times
    start = kernel(lambda y, t, control, p: p.increment(t, y, control))(y, t0, control, problem)
    origin = jax.tree.map(jnp.zeros_like, y) if compensated else y

    def place(a):
        return apart(_add, y, a, when=jnp.isfinite(width)) if compensated else a

    @kernel
    def leap(a, b, t, control, p):
        return _add(a, p.increment(t, b, control))

    def column(n):
        def share(x, n):
            return x / jnp.asarray(n, jnp.result_type(x))

        h = share(width, n)
        # a share of the whole control: differences of two late times would be rounded
        twice = jax.tree.map(lambda c: share(c, n // 2), control)
        a, b = origin, jax.tree.map(lambda y, f: y + share(f, n), origin, start)

        def pair(i, ab):
            a, b = ab
            t = t0 + jnp.asarray(2 * i + 1, jnp.result_type(h)) * h
            a = leap(a, place(b), t, twice, problem)
            return a, leap(b, place(a), t + h, twice, problem)

        a, b = jax.lax.fori_loop(0, n // 2 - 1, pair, (a, b))
        return leap(a, place(b), t0 + (width - h), twice, problem)

    return column


def _shares(order: int) -> list[tuple[int, float, float]]:
    """Substeps of each column but the last, its weight, and that of its part in the error."""
    sequence = SEQUENCES[order]
    weights = extrapolation_weights(sequence)
    lower = (Fraction(0), *extrapolation_weights(sequence[1:]))
    return [(n, float(w), float(w - v)) for n, w, v in zip(sequence[:-1], weights, lower)]


def _step(order: int, problem: Prepared, times, control, y, compensated: bool):
    """New state (or the change to it) and error estimate.

    The column with most substeps is the base of both sums; the others enter by their small
    differences to it, so that rounded weights cannot rescale the state.
    """
    column = _columns(problem, times, control, y, compensated)
    base = column(SEQUENCES[order][-1])
    new, error = base, jax.tree.map(jnp.zeros_like, base)
    for n, weight, share in _shares(order):
        difference = jax.tree.map(jnp.subtract, column(n), base)
        new = _add_share(new, weight, difference)
        error = _add_share(error, share, difference)
    return new, error


def _compact_step(order: int, problem: Prepared, times, control, y, compensated: bool):
    """The same in a loop over the columns, the base first."""
    column = _columns(problem, times, control, y, compensated)
    counts, *weights = zip((SEQUENCES[order][-1], 0.0, 0.0), *_shares(order))
    dtype = jnp.result_type(*jax.tree.leaves(y))

    def one(carry, entry):
        base, new, error = carry
        n, weight, share, is_base = entry
        got = column(n)

        def pick(a, b):
            return jax.tree.map(lambda a, b: jnp.where(is_base, a, b), a, b)

        base = pick(got, base)
        difference = jax.tree.map(jnp.subtract, got, base)
        new = pick(got, _add_share(new, weight, difference))
        return (base, new, _add_share(error, share, difference)), None

    none = jax.tree.map(jnp.zeros_like, y)
    entries = (jnp.array(counts), *(jnp.array(x, dtype) for x in weights))
    is_base = jnp.arange(len(counts)) == 0
    (_, new, error), _ = jax.lax.scan(one, (none, none, none), (*entries, is_base))
    return new, error
