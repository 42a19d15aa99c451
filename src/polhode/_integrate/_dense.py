"""Dense output by collocation: a polynomial through the step, polished by Picard sweeps."""

from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from numpy.polynomial import chebyshev


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

    ``nodes`` holds the states that the substeps start from along a leading axis, ``y1`` the end.
    Each series starts from the cubic of the end values and slopes; ``order`` Picard sweeps
    y <- y0 + int f(y) dt on ``order + 2`` nodes gain an order each. End values stay as given.
    """
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
        slope = jax.vmap(lambda t, y: terms.vf_prod(t, y, args, control))
        ends = jax.tree.map(lambda a, b: jnp.stack([a, b]), y0, y1)
        slopes = slope(jnp.stack([start, start + width]), ends)

        def cubic(y0, y1, f):
            s, jump = column(x, y0), (y1 - y0)[None]
            bend = 3 * jump - 2 * f[:1] - f[1:]
            return y0[None] + s * f[:1] + s**2 * bend + s**3 * (f[:1] + f[1:] - 2 * jump)

        def sweep(_, ys):
            def integrate(y0, y1, slope):
                inner = contract(matrix, slope)
                return y0[None] + inner + column(x, y0) * ((y1 - y0)[None] - inner[-1:])

            return jax.tree.map(integrate, y0, y1, slope(times, ys))

        ys = jax.lax.fori_loop(0, order, sweep, jax.tree.map(cubic, y0, y1, slopes))
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
        empty = width == 0
        place = jnp.where(empty, 0, (t0 - self.t0) / jnp.where(empty, 1, width)) * count
        index = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, count - 1)
        s = 2 * (place - index.astype(place.dtype)) - 1

        def clenshaw(series):
            coefficients = series[index]
            z = s.astype(series.dtype)
            b1 = b2 = jnp.zeros_like(coefficients[0])
            for c in coefficients[:0:-1]:
                b1, b2 = c + 2 * z * b1 - b2, b1
            return coefficients[0] + z * b1 - b2

        return jax.tree.map(clenshaw, self.series)
