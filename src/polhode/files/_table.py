"""A table of a scene file: its keys are the fields of a pydantic model."""

from collections.abc import Iterator
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, model_validator

from polhode.files import _unit


class Table(BaseModel):
    """A table; of each group in `one_of` exactly one key must be there."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, defer_build=True)
    one_of: ClassVar[tuple[tuple[str, ...], ...]] = ()

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        for group in self.one_of:
            present = [key for key in group if getattr(self, key) is not None]
            if len(present) != 1:
                found = " and ".join(present) or "none of them"
                raise ValueError(f"exactly one of {', '.join(group)} is needed, got {found}")
        return self

    def given(self) -> Iterator[tuple[str, Any]]:
        """Names and values of the keys that hold something."""
        return ((name, value) for name, value in self if value is not None)


class Measured(Table):
    """A table with a `unit`: once it is checked, the numbers in `measures` are in SI."""

    measures: ClassVar[tuple[str, ...]] = ("value",)

    @model_validator(mode="after")
    def _in_si(self) -> Self:
        factor = _unit.SI[dict(self)["unit"]]
        found = {name: scaled(x, factor) for name, x in self.given() if name in self.measures}
        return self.model_copy(update=found)


def scaled(value: Any, factor: float) -> Any:
    """A number, a list of them or a table of them, times the factor."""
    if isinstance(value, list):
        return [scaled(x, factor) for x in value]
    if isinstance(value, Table):
        return value.model_copy(update={name: scaled(x, factor) for name, x in value.given()})
    return value * factor
