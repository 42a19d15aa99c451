"""What scenes are made of: modules whose array fields say what shape one body's numbers have."""

import dataclasses
import functools
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


def shaped(*core: int | None, **options: Any) -> Any:
    """A field for an array of shape ``(..., *core)``, batch axes first; None: of any length."""
    return eqx.field(metadata={"core": core}, **options)


@functools.cache
def _cores(kind: type) -> dict[str, tuple[int | None, ...]]:
    fields = dataclasses.fields(kind)
    return {field.name: field.metadata["core"] for field in fields if "core" in field.metadata}


class AbstractPart(eqx.Module):
    """Base of all that may carry batch axes: the state, and what a scene is made of.

    Array fields that bodies may differ in are declared by ``shaped``; what stands in any other
    field is shared by all bodies.

    ``smooth``: whether what the part contributes is a smooth function of state and time between
    the edges that it declares. Steps are searched for jumps of parts that are not.
    """

    smooth: ClassVar[bool] = True

    @property
    def core_ranks(self) -> dict[str, int]:
        """The array fields by name, each with its rank without batch axes."""
        return {name: len(core) for name, core in _cores(type(self)).items()}


def check_fields(part: AbstractPart, name: str) -> None:
    """TypeError unless the array fields of a part, and of what it is made of, hold arrays.

    ``eqx.tree_at`` may put a number or a list there, or an array of another shape (ValueError).
    Nothing is checked while a part is unflattened: ``jax.tree.map``, ``in_axes`` and the masks of
    optax put other things than arrays into these places. ``name``: what the part is called in the
    message.
    """
    # A function, and not a method: Equinox builds an object for every method that is looked up,
    # which takes longer than the check.
    for i, term in enumerate(getattr(part, "terms", ())):
        check_fields(term, f"{name}.terms[{i}]")
    for field, core in _cores(type(part)).items():
        value = getattr(part, field)
        if value is None:
            continue
        if isinstance(value, AbstractPart):
            check_fields(value, f"{name}.{field}")
        elif not (callable(value) or _fits(value, core)):
            _refuse(value, f"{name}.{field}", core)


def _refuse(value: Any, name: str, core: tuple[int | None, ...]) -> None:
    """The error for what is no array of floats (..., *core)."""
    shape = ", ".join(["...", *("n" if size is None else str(size) for size in core)])
    if isinstance(value, _ARRAYS) and jnp.issubdtype(value.dtype, jnp.floating):
        raise ValueError(f"{name} must have shape ({shape}), got {value.shape}.")
    given = f"{value.dtype} array" if isinstance(value, _ARRAYS) else f"{type(value).__name__}"
    raise TypeError(
        f"{name} must be a floating-point array ({shape}), got {given}: {value!r:.60}. Put"
        " jnp.asarray(...) there, or build the part anew."
    )


def terms_of(name: str, kind: type, total: type, one: Any, other: Any) -> tuple[Any, ...]:
    """The terms of ``one + other``, either of which may be a ``total`` of several already.

    TypeError unless ``other`` is of the same ``kind``, called ``name``.
    """
    if not isinstance(other, kind):
        raise TypeError(f"a {name} adds to another {name}, not to {type(other).__name__}")
    several = (part.terms if isinstance(part, total) else (part,) for part in (one, other))
    return tuple(term for terms in several for term in terms)


def _fits(value: Any, core: tuple[int | None, ...]) -> bool:
    """Whether a value is an array of floats (..., *core)."""
    if not isinstance(value, _ARRAYS) or value.dtype not in _FLOATS:
        return False
    tail = value.shape[max(0, value.ndim - len(core)) :]
    return len(tail) == len(core) and all(a in (None, b) for a, b in zip(core, tail))


_ARRAYS = (jax.Array, np.ndarray, np.generic)
_FLOATS = tuple(np.dtype(x) for x in (np.float64, np.float32, np.float16, jnp.bfloat16))
