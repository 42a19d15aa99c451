"""Dense output by collocation: a polynomial through the step, polished by Picard sweeps."""

from collections.abc import Callable
from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


@cache
def _tables(nodes: int) -> tuple[np.ndarray, ...]:
    """Chebyshev nodes of the second kind on [0, 1], integrals of their cardinals, barycentrics."""
    angles = np.pi * np.arange(nodes) / (nodes - 1)
    x = (1 - np.cos(angles)) / 2
    # cardinal functions as Chebyshev series, integrated term by term
    from numpy.polynomial import chebyshev

    vandermonde = chebyshev.chebvander(2 * x - 1, nodes - 1)
    series = np.linalg.inv(vandermonde)
    integral = np.stack([chebyshev.chebint(series[:, j], lbnd=-1) / 2 for j in range(nodes)], 1)
    matrix = chebyshev.chebvander(2 * x - 1, nodes) @ integral
    return x, matrix, series


def collocate(terms, t0, t1, y0, y1, args, order: int) -> dict:
    """Chebyshev coefficients of the solution on the step, of the step's own accuracy.

    Starts from the cubic of the end values and slopes and applies y <- y0 + int f(y) dt on
    ``order + 2`` nodes, each sweep gaining an order; the end value stays the step's own.
    """
    x, matrix, series = _tables(order + 2)
    control = terms.contr(t0, t1)
    f0 = terms.vf_prod(t0, y0, args, control)
    f1 = terms.vf_prod(t1, y1, args, control)
    times = t0 + (t1 - t0) * jnp.asarray(x, dtype=jnp.result_type(t0))

    def shape(coefficients, leaf):
        return jnp.asarray(coefficients, leaf.dtype).reshape(-1, *(1,) * leaf.ndim)

    def hermite(y0, y1, f0, f1):
        s = shape(x, y0)
        jump = (y1 - y0)[None]
        return (
            y0[None]
            + s * f0[None]
            + s**2 * (3 * jump - 2 * f0[None] - f1[None])
            + s**3 * (f0[None] + f1[None] - 2 * jump)
        )

    def sweep(_, ys):
        slopes = jax.vmap(lambda t, y: terms.vf_prod(t, y, args, control))(times, ys)

        def integrate(y0, y1, slope):
            inner = jnp.tensordot(jnp.asarray(matrix, slope.dtype), slope, 1)
            drift = (y1 - y0)[None] - inner[-1:]
            return y0[None] + inner + shape(x, y0) * drift

        return jax.tree.map(integrate, y0, y1, slopes)

    ys = jax.tree.map(hermite, y0, y1, f0, f1)
    ys = jax.lax.fori_loop(0, order, sweep, ys)
    return {"series": jax.tree.map(lambda y: jnp.tensordot(jnp.asarray(series, y.dtype), y, 1), ys)}


class CollocationInterpolation(diffrax.AbstractLocalInterpolation):
    """Chebyshev series on one step."""

    t0: jax.Array
    t1: jax.Array
    series: PyTree

    def evaluate(self, t0, t1=None, left: bool = True) -> PyTree:
        del left
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        width = self.t1 - self.t0
        safe = jnp.where(width == 0, 1, width)
        s = jnp.where(width == 0, 0, (t0 - self.t0) / safe) * 2 - 1

        def clenshaw(series):
            z = s.astype(series.dtype)
            b1 = b2 = jnp.zeros_like(series[0])
            for c in series[:0:-1]:
                b1, b2 = c + 2 * z * b1 - b2, b1
            return series[0] + z * b1 - b2

        return jax.tree.map(clenshaw, self.series)
