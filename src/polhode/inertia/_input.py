"""Checks of what users hand in: shapes always, values only when they are concrete."""

from functools import reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import is_concrete, require


def tolerance(array: Array) -> float:
    """Relative tolerance of consistency checks: the square root of the dtype's rounding."""
    return float(np.sqrt(jnp.finfo(array.dtype).eps))


def require_below(small_name: str, small: Array, large_name: str, large: Array) -> None:
    """ValueError if a concrete ``small`` exceeds ``large`` anywhere."""
    if is_concrete(small, large):
        least, most = np.asarray(small), np.asarray(large)
        require(
            least <= most,
            f"{small_name} must not exceed {large_name}, got {least.max():g} against "
            f"{most.min():g}; exchange them?",
        )


def check_moments(name: str, seen: np.ndarray, slack: float, least: float = 0.0) -> None:
    """ValueError unless rows of principal moments are positive and obey the triangle inequality.

    ``slack`` is the relative tolerance of the inequality (flat bodies), ``least`` the fraction of
    the largest moment that counts as zero.
    """
    if seen.size == 0:
        return
    columns = tuple(seen[..., i] for i in range(seen.shape[-1]))  # NumPy reduces long axes faster
    largest, smallest = reduce(np.maximum, columns), reduce(np.minimum, columns)
    require(
        smallest > least * largest,
        lambda: (
            f"{name} must be positive (kg m^2), got {_worst(seen, smallest)}; a moment is zero"
            " only for a point or a thin line, which cannot turn about itself: give it a width."
        ),
    )
    excess = 2 - sum(x / largest for x in columns)  # of any size: nothing overflows
    require(
        excess <= slack,
        lambda: (
            f"{name} must satisfy the triangle inequality (each at most the sum of the two"
            f" others), got {_worst(seen, -excess)}; check the units, and that these are moments of"
            " inertia, not second moments or a gyration tensor. Published numbers that no body has"
            " pass with Inertia.from_moments(..., physical=False)."
        ),
    )


def check_tensor(name: str, array: Array, *, triangle: bool = True) -> None:
    """ValueError unless a concrete tensor is symmetric with moments that a body can have.

    ``triangle``: whether these must obey the triangle inequality.
    """
    if not is_concrete(array) or array.size == 0:
        return
    seen = np.asarray(array, np.float64)
    mirrored = np.swapaxes(seen, -1, -2)
    skew = np.abs(seen - mirrored)
    require(
        skew <= tolerance(array) * np.abs(seen).max(axis=(-2, -1), keepdims=True),
        f"{name} must be symmetric, got entries that differ by up to {skew.max():g} from their "
        "transposed ones; pass (A + A.T) / 2 if that is what is meant.",
    )
    # moments within the rounding of the largest cannot be told from zero
    least = 64 * float(jnp.finfo(array.dtype).eps)
    moments = np.linalg.eigvalsh((seen + mirrored) / 2)
    slack = tolerance(array) if triangle else np.inf
    check_moments(f"the principal moments of {name}", moments, slack, least)


def _worst(seen: np.ndarray, badness: np.ndarray | np.floating) -> str:
    return np.array2string(seen.reshape(-1, seen.shape[-1])[int(np.argmin(badness))])
