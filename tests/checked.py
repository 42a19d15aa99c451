"""Run-time type checks of the package's annotations; conftest.py enables them in tests only."""

from collections.abc import Callable, Sequence
from types import UnionType
from typing import Any, Self, Union, get_args, get_origin

import jax
import numpy as np
from beartype import BeartypeConf, beartype

CHECKED: set[str] = set()
"""Functions whose annotations are checked: ``module.qualified_name``."""

# An int is accepted for a float, as in PEP 484.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(function: Callable) -> Callable:
    """``function`` with run-time checks of its annotations.

    Two kinds of annotations are not checked: ``Self``, which has a meaning in classes only, and
    unions with NumPy arrays for user input, since the package itself converts or rejects lists and
    numbers. A hint for an array without a shape also accepts NumPy arrays.
    """
    CHECKED.add(f"{function.__module__}.{function.__qualname__}")
    hints = getattr(function, "__annotations__", {})
    for name, hint in hints.items():
        hints[name] = Any if _mentions_self(hint) or _is_users(hint) else _of_any_kind(hint)
    return _beartype(function)


def _of_any_kind(hint):
    """The hint, with ``Any`` in place of arrays without a shape."""
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
