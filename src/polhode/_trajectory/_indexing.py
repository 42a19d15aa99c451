"""Keys into a trajectory, which is indexed as an array of samples: bodies first, then times."""

from typing import Any

import jax
import numpy as np

from polhode._checks import is_concrete


def is_integer(key: Any) -> bool:
    """Whether a key is one number, which takes an axis away."""
    if isinstance(key, bool | np.bool_):
        return False
    if hasattr(key, "shape"):
        return key.shape == () and np.issubdtype(key.dtype, np.integer)
    return isinstance(key, int | np.integer)


def _entry(key: Any) -> Any:
    """One entry of a key, lists as arrays."""
    if key is Ellipsis or isinstance(key, slice) or is_integer(key):
        return key
    array = key if isinstance(key, jax.Array) else np.asarray(key)
    if array.ndim and (array.dtype == np.bool_ or np.issubdtype(array.dtype, np.integer)):
        return array
    raise IndexError(
        "a trajectory is indexed by integers, slices, ... and arrays of integers or truth values,"
        f" bodies first and then times, got {key!r:.60}; for the motion at a time in seconds use"
        " traj.at(t)."
    )


def _taken(key: Any) -> int:
    """Axes that an entry stands for."""
    return key.ndim if getattr(key, "dtype", None) == np.bool_ else 1


def split_key(key: Any, rank: int) -> tuple[tuple[Any, ...], Any]:
    """Entries of the ``rank`` axes of bodies, and the entry of the times."""
    entries = [_entry(k) for k in (key if isinstance(key, tuple) else (key,))]
    dots = [i for i, k in enumerate(entries) if k is Ellipsis]
    used = sum(_taken(k) for k in entries if k is not Ellipsis)
    if len(dots) > 1 or used > rank + 1:
        raise IndexError(
            f"this trajectory has {rank + 1} axes to index, {rank} of bodies and one of times, got"
            f" {len(entries)} entries."
        )
    place = dots[0] if dots else len(entries)
    filled = entries[:place] + [slice(None)] * (rank + 1 - used) + entries[place + 1 :]
    *bodies, times = filled
    if _taken(times) != 1:
        raise IndexError("truth values that choose samples must have one axis, that of the times.")
    return tuple(bodies), times


def check_key(key: Any, shape: tuple[int, ...], what: str) -> None:
    """IndexError for a known key outside the shape, where JAX would take the nearest entry."""
    if not is_concrete(key):
        return
    known = key if isinstance(key, tuple) else (key,)
    known = tuple(k if isinstance(k, slice) else np.asarray(k) for k in known)
    try:
        np.broadcast_to(np.int8(0), shape)[known]
    except IndexError as error:
        raise IndexError(f"there are {what} of shape {shape}, got {key!r:.60}: {error}.") from None
