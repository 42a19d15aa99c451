"""What scenes are made of: modules whose array fields say what shape one body's numbers have."""

import dataclasses
import functools
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp

from polhode._checks import as_float_array


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

    def mended(self, place: str) -> Self:
        """The part with arrays in its array fields, where an edit has left numbers or lists.

        Raises TypeError or ValueError, naming the field, for what is no array of its shape.
        ``place``: what the part is called.
        """
        part = self
        terms = getattr(self, "terms", None)
        if terms is not None:
            named = [term.mended(f"{place}.terms[{i}]") for i, term in enumerate(terms)]
            if any(a is not b for a, b in zip(named, terms)):
                part = eqx.tree_at(lambda p: p.terms, part, tuple(named))
        for name, core in _cores(type(self)).items():
            value = getattr(self, name)
            if value is None or _fits(value, core):
                continue
            if callable(value) and not isinstance(value, AbstractPart):
                continue
            if isinstance(value, AbstractPart):
                new = value.mended(f"{place}.{name}")
            else:
                new = as_float_array(f"{place}.{name}", value, core, finite=False)
            if new is not value:
                part = eqx.tree_at(
                    lambda p, n=name: getattr(p, n), part, new, is_leaf=lambda x, v=value: x is v
                )
        return part


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
    if not isinstance(value, jax.Array) or not jnp.issubdtype(value.dtype, jnp.floating):
        return False
    tail = value.shape[max(0, value.ndim - len(core)) :]
    return len(tail) == len(core) and all(a in (None, b) for a, b in zip(core, tail))
