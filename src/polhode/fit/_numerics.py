"""Linear algebra, least-squares steps, bounds, a Runge-Kutta rule and compiler options of fits."""

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.core import Tracer
from jax.errors import JaxRuntimeError
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from polhode import _policy

# Compiler options that shorten the compilation of fits.

# XLA's older loop emitters: programs of fits run as fast and compile in half the time. The jaxlib
# of jax 0.10 has the option, that of 0.12 no longer.
_OLDER_LOOPS = {"xla_cpu_use_fusion_emitters": False}
# Without LLVM's optimisations the first fit of a recording takes 12 s of processor time instead of
# 18, and every later one of 400 samples 34 ms instead of 8.
_BRIEF = {"xla_backend_optimization_level": 0}


def compiled(is_brief: Callable[..., bool]) -> Callable[[Callable], Callable]:
    """``eqx.filter_jit`` that compiles faster on CPUs, where this is the outermost jit.

    ``is_brief``: whether a call with these arguments takes so little time that the program need not
    be optimised.
    """

    def decorate(function: Callable) -> Callable:
        nested_jit = eqx.filter_jit(function)

        @functools.cache
        def outermost_jit(brief: bool) -> Callable:
            candidates = _OLDER_LOOPS | (_BRIEF if brief else {})
            supported = {k: value for k, value in candidates.items() if _is_supported(k, value)}
            options: dict[str, Any] = {"compiler_options": supported}
            return eqx.filter_jit(function, **options)

        @functools.wraps(function)
        def call(*args):
            traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(args))
            if traced or not _policy.is_cpu() or _policy.is_plain():
                return nested_jit(*args)
            return outermost_jit(is_brief(*args))(*args)

        return call

    return decorate


@functools.cache
def _is_supported(name: str, value: Any) -> bool:
    """Whether this jaxlib accepts a compiler option."""
    try:
        jax.jit(lambda x: -x, compiler_options={name: value})(1.0)
    except (JaxRuntimeError, ValueError):
        return False
    return True


# LAPACK calls for one matrix at a time: batched calls can deadlock.
#
# The jaxlib of jax 0.10 distributes the matrices of a batch over the thread pool that runs the
# program, and blocks one of these threads until they are done. When as many calls run at a time as
# there are threads (two on a machine of two cores), all threads are blocked and no call returns.
# Single matrices are computed on the calling thread.

# The jaxlib of jax 0.12 computes a batch on the calling thread.
_AFFECTED = jax.__version_info__ < (0, 12)


def _one_matrix_at_a_time(signature: str) -> Callable:
    """Decorator that extends a function of single matrices to batches, one after the other."""

    def decorate(function: Callable) -> Callable:
        looped = jax.custom_batching.sequential_vmap(function)

        def call(*operands):
            affected = _AFFECTED and _policy.is_cpu()
            implementation = looped if affected else function
            return jnp.vectorize(implementation, signature=signature)(*operands)

        return call

    return decorate


@_one_matrix_at_a_time("(n,n)->(n),(n,n)")
def eigh(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues in ascending order and eigenvectors of symmetric matrices (..., n, n)."""
    return tuple(jnp.linalg.eigh(matrix))


@_one_matrix_at_a_time("(n,n),(n)->(n)")
def solve(matrix: Array, right: Array) -> Array:
    """``matrix^-1 right`` for matrices (..., n, n)."""
    return jnp.linalg.solve(matrix, right)


@_one_matrix_at_a_time("(n,n)->(n,n)")
def _inverse(matrix: Array) -> Array:
    return jnp.linalg.inv(matrix)


def inverse(matrix: Array) -> Array:
    """Inverses of matrices (..., n, n), with derivatives in both modes."""
    constant_matrix = jax.lax.stop_gradient(matrix)
    result = _inverse(constant_matrix)
    # The correction is zero and has the derivative of the inverse: ``sequential_vmap`` does not
    # support reverse mode.
    return result - result @ (matrix - constant_matrix) @ result


@_one_matrix_at_a_time("(n,n)->(n,n),(n),(n,n)")
def svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition of square matrices (..., n, n)."""
    return tuple(jnp.linalg.svd(matrix))


@_one_matrix_at_a_time("(m,n)->(k,n)")
def triangle(matrix: Array) -> Array:
    """The triangular factors R (..., min(m, n), n) of ``matrix = Q R``."""
    return jnp.linalg.qr(matrix, mode="r")


@_one_matrix_at_a_time("(m,n),(m)->(n)")
def least_squares(matrix: Array, right: Array) -> Array:
    """The x (..., n) that minimises ``|matrix x - right|``; columns independent, m > n."""
    count = matrix.shape[1]
    factor = jnp.linalg.qr(jnp.concatenate([matrix, right[:, None]], axis=1), mode="r")
    return jax.scipy.linalg.solve_triangular(factor[:count, :count], factor[:count, count])


class LeastSquares(lx.AbstractLinearSolver):
    """``least_squares`` as a solver of lineax: what ``lineax.QR`` does, one matrix at a time."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        return operator

    def compute(self, state: lx.AbstractLinearOperator, vector, options: dict[str, Any]):
        right, _ = ravel_pytree(vector)
        unknown = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.in_structure())
        _, unravel = ravel_pytree(unknown)
        return unravel(least_squares(state.as_matrix(), right)), lx.RESULTS.successful, {}

    def transpose(self, state: lx.AbstractLinearOperator, options: dict[str, Any]):
        raise NotImplementedError("steps of the optimiser are not differentiated in reverse mode.")

    def conj(self, state: lx.AbstractLinearOperator, options: dict[str, Any]):
        return state, {}

    def assume_full_rank(self):
        return True


# Levenberg-Marquardt steps of Optimistix with a termination criterion in units of the noise.

# Squared derivatives (of a data vector of norm ten by unknowns of order one) that count as zero.
_NEGLIGIBLE = 1e-6


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt that stops within a fraction of the standard deviations of the optimum.

    It stops when the part of the residuals that the linear model can still remove is ``offset``
    times the part that it cannot, each per degree of freedom (the relative offset of Bates and
    Watts, Technometrics 23 (1981) 179). The estimate is then within about ``offset`` standard
    deviations of the optimum in every direction, also along a narrow valley of the misfit. A
    removable part of a norm below ``floor`` counts as rounding error (the data have norm ten).
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
        # the criterion of Optimistix, which ``terminate`` applies as well
        self.rtol = self.atol = floor
        self.norm = optx.max_norm
        self.descent = optx.DampedNewtonDescent(linear_solver=LeastSquares())
        # Faster along narrow valleys: the trust region grows fourfold as soon as a step achieves
        # 0.75 of the predicted decrease (by default 3.5-fold at 0.99).
        self.search = optx.ClassicalTrustRegion(0.75, 0.1, 4.0, 0.25)
        self.verbose = _silent

    def terminate(self, fn, y, args, options, state, tags):
        stop, result = super().terminate(fn, y, args, options, state, tags)
        jacobian, residual = state.f_info.jac.as_matrix(), state.f_info.residual
        square, slope = jacobian.T @ jacobian, jacobian.T @ residual
        size = jnp.sqrt(jnp.diagonal(square))
        size = jnp.where(size > 0, size, 1)
        # The ridge excludes directions that the data hardly determine, such as towards a flat body.
        ridge = 30 * jnp.finfo(residual.dtype).eps * size.shape[0] + _NEGLIGIBLE / size**2
        square = square / size[:, None] / size[None] + jnp.diag(ridge)
        slope = slope / size
        gain = slope @ solve(square, slope)
        freedom = max(residual.shape[0] - size.shape[0], 1)
        bound = self.offset**2 * jnp.sum(residual**2) / freedom * size.shape[0] + self.floor**2
        return stop | (~state.first_step & (gain < bound)), result


def _silent(**_):
    """``verbose`` of Optimistix without output."""


class ClassicalRungeKutta(diffrax.AbstractSolver):
    """The classical Runge-Kutta method of order 4, with its four stages written out.

    No error estimate; conserves nothing exactly. Its steps are differentiable in both modes.
    diffrax's own Runge-Kutta solvers store the stages in an array, which for a body's seven numbers
    costs more than the stages do. Source: W. Kutta, Z. Math. Phys. 46 (1901) 435.
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

        def advance(slope, by):
            return jax.tree.map(lambda y, k: y + by * k, y0, slope)

        first = terms.vf(t0, y0, args)
        second = terms.vf(middle, advance(first, h / 2), args)
        third = terms.vf(middle, advance(second, h / 2), args)
        last = terms.vf(t1, advance(third, h), args)
        y1 = jax.tree.map(
            lambda y, a, b, c, d: y + h / 6 * (a + 2 * b + 2 * c + d),
            y0,
            first,
            second,
            third,
            last,
        )
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


# Bounds of unknowns: maps from unconstrained numbers, and their curvature in a fit.

_CURVED_PART = 0.02
"""Distance from a bound within which its map is curved, over the distance of the start from it."""


def to_bounded(number: Array, start: Array, low: Array, high: Array) -> Array:
    """A value between its bounds, from any real number.

    With one bound a hyperbola, ``low + sqrt(s^2 + number^2) - s``: a straight line away from the
    bound and a parabola near it, so that steps may reach the bound from either side. A smooth
    maximum, which is flat beyond the bound and curved as far from it as the start is, needs
    hundreds of steps: of 24 fits of drag to recordings of a body without one of its two kinds, 3
    converged within the step limit, with the hyperbola all. With two bounds a sigmoid.
    """
    side, end, soft, has_bound = _one_sided(start, low, high)
    half, middle, has_both = _two_sided(low, high)
    y = (number - middle) / half
    between = middle + half * y / jnp.sqrt(1 + y**2)
    distance = number**2 / (soft + jnp.sqrt(soft**2 + number**2))
    return jnp.where(has_both, between, jnp.where(has_bound, end + side * distance, number))


def to_unbounded(value: Array, start: Array, low: Array, high: Array) -> Array:
    """The inverse of ``to_bounded``."""
    side, end, soft, has_bound = _one_sided(start, low, high)
    half, middle, has_both = _two_sided(low, high)
    y = jnp.where(has_both, (value - middle) / half, 0)
    between = middle + half * y / jnp.sqrt(1 - y**2)
    distance = jnp.where(has_bound, side * (value - end), 1)
    inside = jnp.sqrt(distance * (distance + 2 * soft))
    return jnp.where(has_both, between, jnp.where(has_bound, inside, value))


def _two_sided(low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Half the width between two bounds, their middle, and whether there are two."""
    half, middle = (high - low) / 2, (high + low) / 2
    has_both = jnp.isfinite(half)
    return jnp.where(has_both, half, 1), jnp.where(has_both, middle, 0), has_both


def _one_sided(start: Array, low: Array, high: Array) -> tuple[Array, Array, Array, Array]:
    """For one bound: the sign of the permitted side, the bound, the distance within which the map
    is curved, and whether there is a bound."""
    side = jnp.where(jnp.isfinite(low), 1, -1)
    has_bound = jnp.isfinite(low) | jnp.isfinite(high)
    end = jnp.where(jnp.isfinite(low), low, jnp.where(jnp.isfinite(high), high, 0))
    # without a bound any positive number: derivatives must be finite in the branch not selected too
    return side, end, jnp.where(has_bound, _CURVED_PART * jnp.abs(start - end), 1), has_bound


def curvature_rows(bounded: Callable, scaled: Any, scale: Any, cost_at: Callable) -> list[Array]:
    """Residuals of value zero that add the curvature of the bounds to Gauss-Newton steps.

    A cost C(x(n)), x the bounded value of a number n, has the second derivative x'^2 C'' + x'' C'.
    Gauss-Newton steps contain the first term only. Where C' drives x towards its bound, x is a
    parabola in n and that term vanishes with n, so that steps would alternate between both sides of
    the bound (8 of the 24 fits of ``to_bounded`` reached the step limit). ``bounded``: the map
    x(n), elementwise; ``scaled`` times ``scale``: the present n; ``cost_at``: C as a function of x.
    """
    numbers = jax.tree.map(lambda a, b: a.astype(b.dtype) * b, scaled, scale)
    numbers = jax.lax.stop_gradient(numbers)

    def slope(step):
        moved = jax.tree.map(lambda n, b: n + step * b, numbers, scale)
        return jax.jvp(bounded, (moved,), (scale,))[1]

    zero = jnp.zeros((), jax.tree.leaves(numbers)[0].dtype)
    bends = jax.jvp(slope, (zero,), (jnp.ones_like(zero),))[1]
    slopes = jax.grad(cost_at)(jax.lax.stop_gradient(bounded(numbers)))
    rows = []
    for x, bend, by_value in zip(*map(jax.tree.leaves, (scaled, bends, slopes))):
        size = jax.lax.stop_gradient(jnp.sqrt(jnp.maximum(bend * by_value, 0)))
        rows.append(jnp.ravel(size * (x - jax.lax.stop_gradient(x)).astype(size.dtype)))
    return rows
