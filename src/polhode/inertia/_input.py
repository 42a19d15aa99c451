"""Checks of what users hand in: shapes always, values only when they are concrete."""

import jax
import jax.numpy as jnp
import numpy as np


def as_floats(name, value, suffix):
    """``value`` as a floating array whose trailing axes are ``suffix`` (None: any length)."""
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} must be a rectangular array of numbers, got {value!r}; check that all rows "
            "have the same length."
        ) from error
    if jnp.issubdtype(array.dtype, jnp.complexfloating) or array.dtype == jnp.bool_:
        raise TypeError(f"{name} must hold real numbers, got dtype {array.dtype}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    tail = array.shape[array.ndim - len(suffix) :] if array.ndim >= len(suffix) else None
    if tail is None or any(want not in (None, got) for want, got in zip(suffix, tail, strict=True)):
        wanted = ", ".join("n" if n is None else str(n) for n in suffix)
        raise ValueError(
            f"{name} must have shape (..., {wanted}), got {array.shape}; leading axes are a batch."
        )
    return array


def values(array):
    """The numbers of a concrete array as numpy float64, or None while tracing."""
    return None if isinstance(array, jax.core.Tracer) else np.asarray(array, np.float64)


def tolerance(array):
    """Relative tolerance of consistency checks: the square root of the dtype's rounding."""
    return float(np.sqrt(jnp.finfo(array.dtype).eps))


def require(condition, message):
    """ValueError with ``message`` unless ``condition`` holds."""
    if not condition:
        raise ValueError(message)


def require_finite(name, array):
    """ValueError if a concrete array holds NaN or infinity."""
    seen = values(array)
    if seen is not None and not np.isfinite(seen).all():
        bad = int((~np.isfinite(seen)).sum())
        raise ValueError(
            f"{name} must be finite, got {bad} NaN or infinite of {seen.size} values; remove or "
            "repair them."
        )


def require_positive(name, array, zero_allowed=False):
    """ValueError if a concrete array is not finite or holds negative (or zero) values."""
    require_finite(name, array)
    seen = values(array)
    if seen is None or seen.size == 0:
        return
    worst = seen.min()
    if worst < 0 or (worst == 0 and not zero_allowed):
        wanted = "zero or positive" if zero_allowed else "positive"
        raise ValueError(f"{name} must be {wanted}, got {worst:g}; check its sign and units.")
