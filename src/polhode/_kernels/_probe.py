"""Run in a process of its own: marked calls of which XLA folds this or that away.

Ends badly where this version of XLA cannot compile them, or changes what they compute.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from polhode._kernels._single_call import kernel


def _leap(a, b, n, t):
    """A loop whose body needs less than it seems to."""
    push = jnp.where(t < 1, 0.0, 0.0) * b + 0 * n.astype(b.dtype)

    def one(i, c):
        return c + push + t * a / jnp.asarray(i + 1, a.dtype)

    return jax.lax.fori_loop(0, 3, one, a), jnp.zeros_like(b), b, n * 0


def main() -> int:
    try:  # an abort is an answer, not something to keep
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (ImportError, ValueError, OSError):
        pass
    a, b = np.linspace(0, 1, 7, dtype=np.float32), np.ones(7, np.float32)
    n, t = np.arange(7), np.float32(0.5)
    nothing = kernel(lambda x: jnp.where(x < 1, 0.0, 0.0))

    def value(a, b, n, t):
        return kernel(_leap)(a, b, n, t), nothing(a), kernel(_leap)(jnp.ones_like(a), b, n, t)

    def slope(a, b, n, t):
        ways = kernel(_leap, linearised=True), kernel(_leap, repeated=True)
        total = jax.grad(lambda t: sum(jnp.sum(leap(a, b, n, t)[0]) for leap in ways))
        return jax.vmap(total)(t + jnp.zeros(2, a.dtype))

    marked = [jax.jit(fn)(a, b, n, t) for fn in (value, slope)]
    with jax.disable_jit():
        plain = [fn(a, b, n, t) for fn in (value, slope)]
    pairs = zip(*map(jax.tree.leaves, (marked, plain)), strict=True)
    return 0 if all(np.allclose(x, y, rtol=1e-5, atol=1e-6) for x, y in pairs) else 1


if __name__ == "__main__":
    sys.exit(main())
