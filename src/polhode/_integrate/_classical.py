"""The classical Runge-Kutta rule as a diffrax solver: for short given steps that must be cheap."""

from typing import ClassVar

import diffrax
import jax


class ClassicalRungeKutta(diffrax.AbstractSolver):
    """Runge and Kutta's rule of order 4: four evaluations a step, written out.

    No error estimate; conserves nothing exactly. Forward and reverse mode pass through its steps.
    diffrax's own tables keep their stages in an array, which for a body's seven numbers costs more
    than the stages do. Source: W. Kutta, Z. Math. Phys. 46 (1901) 435.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 4

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        h, middle = t1 - t0, (t0 + t1) / 2

        def ahead(slope, by):
            return jax.tree.map(lambda y, k: y + by * k, y0, slope)

        first = terms.vf(t0, y0, args)
        second = terms.vf(middle, ahead(first, h / 2), args)
        third = terms.vf(middle, ahead(second, h / 2), args)
        last = terms.vf(t1, ahead(third, h), args)
        y1 = jax.tree.map(
            lambda y, a, b, c, d: y + h / 6 * (a + 2 * b + 2 * c + d),
            y0,
            first,
            second,
            third,
            last,
        )
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful
