"""One step of the extrapolated midpoint rule, for states, integrals and derivatives.

Columns of n = 2, 4, ... leapfrog substeps are combined so that the error terms in h^2, h^4, ...
cancel (W. B. Gragg, SIAM J. Numer. Anal. 2 (1965) 384; E. Hairer, S. P. Norsett, G. Wanner, Solving
Ordinary Differential Equations I, section II.9). The columns are computed in a loop over a table
that is data of the program, so that the same program computes steps of every order.
"""

from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

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

They are the result of a search over even numbers: among sequences within 15 % of the least work
(evaluations per step over the step length that the error constant prod n_j^2 allows), those with
the least amplification of rounding, sqrt(sum w_j^2 n_j). The harmonic sequence 2, 4, 6, ...
amplifies it 3 (order 10) to 30 (order 20) times more.
"""

CHOSEN = (6, 8, 10, 12, 14, 16)
"""Orders between which a compiled program may choose."""


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


class Table(NamedTuple):
    """Columns of one order, the one with most substeps first, padded with zeros to K columns.

    ``counts`` (K,): substeps; ``weights``: three arrays (K,), for the result and for the
    differences of the results of orders p and p - 2, and of orders p - 2 and p - 4; ``length``:
    number of columns; ``order``: p.
    """

    counts: Array
    weights: tuple[Array, ...]
    length: Array
    order: Array


def _row(order: int, length: int) -> list[np.ndarray]:
    sequence = SEQUENCES[order]
    column_order = [len(sequence) - 1, *range(len(sequence) - 1)]
    sums = [
        [Fraction(0)] * drop + list(extrapolation_weights(sequence[drop:])) for drop in range(3)
    ]
    if len(sequence) == 2:
        sums[2] = [Fraction(0)] * 2
    result, lower_result, lowest_result = sums
    weights = np.zeros((3, length))
    counts = np.zeros(length, np.int32)
    for k, j in enumerate(column_order):
        counts[k] = sequence[j]
        if k:  # the others contribute small differences from the base, whose weight is one
            weights[:, k] = [
                float(x)
                for x in (
                    result[j],
                    result[j] - lower_result[j],
                    lower_result[j] - lowest_result[j],
                )
            ]
    return [counts, *weights]


def table(order: int | Array, dtype: Any) -> Table:
    """The columns of an order; a traced one must be among ``CHOSEN``."""
    orders = (order,) if isinstance(order, int) else CHOSEN
    lengths = np.array([len(SEQUENCES[o]) for o in orders], np.int32)
    index = 0 if isinstance(order, int) else (order.astype(jnp.int32) - orders[0]) >> 1
    rows = zip(*(_row(o, int(max(lengths))) for o in orders))
    # Four small arrays instead of one: XLA distributes a program with arrays of more than 512 bytes
    # outside of units over several threads, which takes longer than the whole motion of one body.
    counts, *weights = (np.stack(x) for x in rows)
    return Table(
        jnp.asarray(counts)[index],
        tuple(jnp.asarray(x, dtype)[index] for x in weights),
        jnp.asarray(lengths)[index],
        jnp.asarray(order, dtype),
    )


Rates = Callable[[Array, list[Array], bool], tuple[list[Array], list[Array]]]


def evaluations(order: int) -> int:
    """Evaluations of the rates in one step."""
    return sum(SEQUENCES[order]) - len(SEQUENCES[order]) + 1


class Columns(NamedTuple):
    """Results of one step: ``change``, of the state in a compensated step, otherwise the new state;
    ``sums``: the integrals after the step; ``difference``: of the results of orders p and p - 2;
    ``lower_difference``: of those of orders p - 2 and p - 4."""

    change: list[Array]
    sums: list[Array]
    difference: list[Array]
    lower_difference: list[Array]


def extrapolated(
    rates: Rates,
    columns: Table,
    t: Array,
    width: Array,
    y: list[Array],
    start_rates: list[Array],
    integrals: list[Array],
    compensated: bool = False,
) -> Columns:
    """One step of the extrapolated midpoint rule.

    ``rates(t, y, with_integrands)``: rates of the state and, if ``with_integrands``, of the
    ``integrals`` along the solution, whose integrands are needed at every other point only.
    ``start_rates``: rates of ``y``. ``t`` and ``width`` are scalars, or arrays with one entry for
    every body. ``compensated``: changes of the state are summed instead of states.
    """
    # Rounding errors of changes are relative to the change in one step, not to the state. This
    # costs an addition in every substep, and is only used if `rtol` is close to rounding.
    origin = [jnp.zeros_like(x) for x in y] if compensated else y

    def state_of(a):
        return [b + c for b, c in zip(y, a)] if compensated else a

    def column(n):
        h = width / n
        step = [2 * h.astype(x.dtype) for x in y]

        def pair(i, carry):
            a, b, sums = carry
            time = t + (2 * i + 1).astype(h.dtype) * h
            f, g = rates(time, state_of(b), True)
            a, sums = _plus(a, step, f), _plus(sums, [step[0]] * len(g), g)
            f, _ = rates(time + h, state_of(a), False)
            return a, _plus(b, step, f), sums

        # Leapfrog steps of a and b alternately, started by an Euler step. Gragg's smoothing at the
        # end is omitted: the columns end at an even point, where the error has an expansion in even
        # powers without it.
        b = _plus(origin, [x / 2 for x in step], start_rates)
        start = origin, b, [jnp.zeros_like(x) for x in integrals]
        a, b, sums = jax.lax.fori_loop(0, n.astype(jnp.int32) // 2 - 1, pair, start)
        f, g = rates(t + (width - h), state_of(b), True)
        return _plus(a, step, f), _plus(sums, [step[0]] * len(g), g)

    # The column with most substeps is the base, and the others contribute their differences from
    # it: large weights then multiply small numbers, and amplify rounding less.
    def add(j, carry):
        base, (result, sums), difference, lower_difference = carry
        count, *shares = (
            jax.lax.dynamic_index_in_dim(x, j, keepdims=False)
            for x in (columns.counts, *columns.weights)
        )
        column_result = column(count.astype(jnp.result_type(width)))
        base = jax.tree.map(lambda x, b: jnp.where(j == 0, x, b), column_result, base)
        gap = jax.tree.map(jnp.subtract, column_result, base)

        def combine(x, s, d):
            return jnp.where(j == 0, x, s + shares[0].astype(d.dtype) * d)

        result, sums = jax.tree.map(combine, column_result, (result, sums), gap)
        difference = [e + shares[1].astype(d.dtype) * d for e, d in zip(difference, gap[0])]
        lower_difference = [
            e + shares[2].astype(d.dtype) * d for e, d in zip(lower_difference, gap[0])
        ]
        return base, (result, sums), difference, lower_difference

    zeros = [jnp.zeros_like(x) for x in y], [jnp.zeros_like(x) for x in integrals]
    start = zeros, zeros, zeros[0], zeros[0]
    _, (result, sums), difference, lower_difference = jax.lax.fori_loop(
        0, columns.length, add, start
    )
    return Columns(result, [q + s for q, s in zip(integrals, sums)], difference, lower_difference)


def _plus(y, step, f):
    return [a + h * b for a, h, b in zip(y, step, f)]


def add_compensated(
    y: list[Array], compensation: list[Array], change: list[Array]
) -> tuple[list[Array], list[Array]]:
    """``y + compensation + change`` as a rounded sum, and its rounding error.

    D. E. Knuth, The Art of Computer Programming 2, section 4.2.2, theorem B.
    """
    change = [a + b for a, b in zip(compensation, change)]
    total = [a + b for a, b in zip(y, change)]
    rounding_error = [(a - (s - (s - a))) + (c - (s - a)) for a, c, s in zip(y, change, total)]
    return total, rounding_error
