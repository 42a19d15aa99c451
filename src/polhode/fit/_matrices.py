"""LAPACK one matrix at a time.

The jaxlib of jax 0.10 hands the matrices of a batch to the threads that run the program and waits
for them on one of these threads. As many such calls at a time as there are threads, two on a
machine of two cores, wait for each other for ever. A single matrix is never handed on.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

# The jaxlib of jax 0.12 works through a batch where it is.
_AFFECTED = jax.__version_info__ < (0, 12)


def _singly(signature: str) -> Callable:
    """``function`` of single matrices for batches of them too, one after the other."""

    def decorate(function: Callable) -> Callable:
        looped = jax.custom_batching.sequential_vmap(function)

        def call(*operands):
            affected = _AFFECTED and jax.default_backend() == "cpu"
            chosen = looped if affected else function
            return jnp.vectorize(chosen, signature=signature)(*operands)

        return call

    return decorate


@_singly("(n,n)->(n),(n,n)")
def eigh(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues in ascending order and eigenvectors of symmetric matrices (..., n, n)."""
    return tuple(jnp.linalg.eigh(matrix))


@_singly("(n,n),(n)->(n)")
def solve(matrix: Array, right: Array) -> Array:
    """``matrix^-1 right`` for matrices (..., n, n)."""
    return jnp.linalg.solve(matrix, right)


@_singly("(n,n)->(n,n)")
def _inverse(matrix: Array) -> Array:
    return jnp.linalg.inv(matrix)


def inverse(matrix: Array) -> Array:
    """Inverses of matrices (..., n, n), with derivatives in both modes."""
    fixed = jax.lax.stop_gradient(matrix)
    found = _inverse(fixed)
    return found - found @ (matrix - fixed) @ found  # loops of single matrices have none


@_singly("(n,n)->(n,n),(n),(n,n)")
def svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition of square matrices (..., n, n)."""
    return tuple(jnp.linalg.svd(matrix))


@_singly("(m,n)->(k,n)")
def triangle(matrix: Array) -> Array:
    """The triangular factors R (..., min(m, n), n) of ``matrix = Q R``."""
    return jnp.linalg.qr(matrix, mode="r")


@_singly("(m,n),(m)->(n)")
def least_squares(matrix: Array, right: Array) -> Array:
    """The x (..., n) that makes ``matrix x - right`` smallest; columns independent, m > n."""
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
