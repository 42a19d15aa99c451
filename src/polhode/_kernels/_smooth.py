"""Functions that are smooth although they compare."""

from collections.abc import Callable

import jax

SMOOTH = "smooth_function"
"""Name of the calls of such functions, in which no kink is looked for."""


def smooth(fn: Callable) -> Callable:
    """``fn``, which chooses between formulas of the same value: its comparisons make no kink."""

    def smooth_function(*args):
        return fn(*args)

    return jax.jit(smooth_function)
