"""Checks of what users hand in: shapes always, values only when they are concrete."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import as_float_array, is_concrete, require


def as_floats(**given: tuple[Any, tuple[int | None, ...]]) -> tuple[Array, ...]:
    """Arrays ``name=(value, suffix)`` of one floating dtype and with common batch axes.

    Python numbers and lists follow the dtype of the arrays among them; alone, they take the
    default one. A mixture of array dtypes takes the wider one.
    """
    kinds = [
        value.dtype
        for value, _ in given.values()
        if hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jnp.floating)
    ]
    arrays = [as_float_array(name, value, suffix) for name, (value, suffix) in given.items()]
    if kinds:
        common = kinds[0]
        for kind in kinds[1:]:
            common = jnp.promote_types(common, kind)
        arrays = [array.astype(common) for array in arrays]
    tails = [len(suffix) for _, suffix in given.values()]
    leading = [array.shape[: array.ndim - tail] for array, tail in zip(arrays, tails)]
    try:
        batch = jnp.broadcast_shapes(*leading)
    except ValueError as error:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in zip(given, arrays))
        raise ValueError(f"the batch axes must broadcast together, got {shapes}.") from error
    return tuple(
        jnp.broadcast_to(array, (*batch, *array.shape[array.ndim - tail :]))
        for array, tail in zip(arrays, tails)
    )


def tolerance(array: Array) -> float:
    """Relative tolerance of consistency checks: the square root of the dtype's rounding."""
    return float(np.sqrt(jnp.finfo(array.dtype).eps))


def require_positive(name: str, array: Array, *, zero: bool = False) -> None:
    """ValueError if a concrete array holds negative values (or zeros, unless ``zero``)."""
    if not is_concrete(array) or array.size == 0:
        return
    least = float(np.min(np.asarray(array)))
    wanted = "zero or positive" if zero else "positive"
    require(
        least > 0 or (zero and least == 0),
        f"{name} must be {wanted}, got {least:g}; check its sign and its units.",
    )


def require_below(small_name: str, small: Array, large_name: str, large: Array) -> None:
    """ValueError if a concrete ``small`` exceeds ``large`` anywhere."""
    if is_concrete(small, large):
        small, large = np.asarray(small), np.asarray(large)
        require(
            small <= large,
            f"{small_name} must not exceed {large_name}, got {small.max():g} against "
            f"{large.min():g}; exchange them?",
        )


def check_moments(name: str, seen: np.ndarray, slack: float, least: float = 0.0) -> None:
    """ValueError unless rows of principal moments are positive and obey the triangle inequality.

    ``slack`` is the relative tolerance of the inequality (flat bodies), ``least`` the fraction of
    the largest moment that counts as zero.
    """
    if seen.size == 0:
        return
    largest = seen.max(axis=-1)
    require(
        seen.min(axis=-1) > least * largest,
        f"{name} must be positive (kg m^2), got {_worst(seen, seen.min(axis=-1))}; a moment is "
        "zero only for a point or a thin line, which cannot turn about itself: give it a width.",
    )
    excess = 2 - (seen / largest[..., None]).sum(axis=-1)  # of any size: nothing overflows
    require(
        excess <= slack,
        f"{name} must satisfy the triangle inequality (each at most the sum of the two others), "
        f"got {_worst(seen, -excess)}; check the units, and that these are moments of inertia, "
        "not second moments or a gyration tensor. Inertia(diagonal=...) takes what no body has.",
    )


def check_tensor(name: str, array: Array) -> None:
    """ValueError unless a concrete tensor is symmetric with moments that a body can have."""
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
    check_moments(f"the principal moments of {name}", moments, tolerance(array), least)


def _worst(seen: np.ndarray, badness: np.ndarray) -> str:
    return np.array2string(seen.reshape(-1, seen.shape[-1])[int(np.argmin(badness))])
