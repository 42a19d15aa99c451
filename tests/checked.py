"""Run-time checks of the package's annotations, switched on by conftest.py for tests alone."""

from collections.abc import Callable, Sequence
from types import UnionType
from typing import Any, Self, Union, get_args, get_origin

import jax
import numpy as np
from beartype import BeartypeConf, beartype

CHECKED: set[str] = set()
"""Functions whose annotations are checked: ``module.qualified_name``."""

# An int is a float here, as for every other tool that reads annotations (PEP 484).
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(function: Callable) -> Callable:
    """``function`` with its annotations checked.

    Left out: ``Self``, which has a meaning in classes only, and what a user writes (unions with
    NumPy arrays): lists and numbers of all kinds, which the package itself converts or refuses.
    An array of any kind is one of NumPy too, where trajectories are looked at.
    """
    CHECKED.add(f"{function.__module__}.{function.__qualname__}")
    hints = getattr(function, "__annotations__", {})
    for name, hint in hints.items():
        hints[name] = Any if _mentions_self(hint) or _is_users(hint) else _of_any_kind(hint)
    return _beartype(function)


def _of_any_kind(hint):
    """The hint with anything in place of an array without a shape."""
    if hint is jax.Array:
        return Any
    if getattr(hint, "array_type", None) is jax.Array:
        return hint | hint.dtype[np.ndarray, hint.dim_str] | np.number
    if get_origin(hint) in (Union, UnionType):
        return Union[tuple(_of_any_kind(part) for part in get_args(hint))]  # noqa: UP007
    if get_origin(hint) in (tuple, list, Sequence):
        return get_origin(hint)[tuple(_of_any_kind(part) for part in get_args(hint))]
    return hint


def _mentions_self(hint) -> bool:
    return hint is Self or any(_mentions_self(part) for part in get_args(hint))


def _is_users(hint) -> bool:
    if get_origin(hint) not in (Union, UnionType):
        return False
    kinds = (getattr(part, "array_type", part) for part in get_args(hint))
    return np.ndarray in kinds or any(_is_users(part) for part in get_args(hint))
