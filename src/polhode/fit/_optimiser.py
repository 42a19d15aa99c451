"""Optimistix's Levenberg-Marquardt steps, ended by a criterion that knows what noise is."""

from collections.abc import Callable

import jax.numpy as jnp
import optimistix as optx

from polhode.fit._matrices import LeastSquares, solve

# Squared derivatives (of a data vector of norm ten by unknowns of order one) that count as none.
_FAINT = 1e-6


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt that stops when the optimum is near beside its own uncertainty.

    A step is not worth making when the part of the residuals that the linear model can still
    remove is ``offset`` of what it cannot, each per degree of freedom (the relative offset of Bates
    and Watts, Technometrics 23 (1981) 179): the estimate is then within about ``offset`` standard
    deviations of the optimum, in every direction, however long the valley. ``floor`` is the part of
    the residuals, relative to a data vector of norm ten, that counts as rounding.
    """

    offset: float
    floor: float
    rtol: float
    atol: float
    norm: Callable
    descent: optx.DampedNewtonDescent
    search: optx.ClassicalTrustRegion
    verbose: Callable[..., None]

    def __init__(self, offset: float, floor: float):
        self.offset = offset
        self.floor = floor
        # the usual criterion stays as the other way to end
        self.rtol = self.atol = floor
        self.norm = optx.max_norm
        self.descent = optx.DampedNewtonDescent(linear_solver=LeastSquares())
        # For long valleys: enlarged as soon as the linear model is a fair guide
        self.search = optx.ClassicalTrustRegion(0.75, 0.1, 4.0, 0.25)
        self.verbose = _silent

    def terminate(self, fn, y, args, options, state, tags):
        ended, result = super().terminate(fn, y, args, options, state, tags)
        jacobian, rest = state.f_info.jac.as_matrix(), state.f_info.residual
        square, slope = jacobian.T @ jacobian, jacobian.T @ rest
        size = jnp.sqrt(jnp.diagonal(square))
        size = jnp.where(size > 0, size, 1)
        # A direction that the data hardly show, as towards a flat body, is not waited for.
        ridge = 30 * jnp.finfo(rest.dtype).eps * size.shape[0] + _FAINT / size**2
        square = square / size[:, None] / size[None] + jnp.diag(ridge)
        slope = slope / size
        gain = slope @ solve(square, slope)
        freedom = max(rest.shape[0] - size.shape[0], 1)
        bound = self.offset**2 * jnp.sum(rest**2) / freedom * size.shape[0] + self.floor**2
        return ended | (~state.first_step & (gain < bound)), result


def _silent(**_):
    """No output while it runs."""
