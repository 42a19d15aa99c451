"""A table of a scene file: known keys, needed keys, and choices among keys."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, model_validator

from polhode.files import _unit
from polhode.files._values import SPREAD, TEXT, VECTOR, Checked, choice, suggestion, wrong

Text = Annotated[str, TEXT]
Vector = Annotated[list[float], VECTOR]
Spread = Annotated[list[float], SPREAD]
Seconds = Annotated[str, choice(tuple(_unit.SECONDS))]
Angle = Annotated[str, choice(tuple(_unit.ANGLES))]
Rate = Annotated[str, choice(tuple(_unit.ANGULAR_RATES))]
MomentumUnit = Annotated[str, choice(("kg m^2/s",))]


class Table(BaseModel):
    """A table whose keys are its fields; of each group in `one_of` exactly one must be there."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)
    one_of: ClassVar[tuple[tuple[str, ...], ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _keys(cls, data: Any) -> Any:
        known = tuple(cls.model_fields)
        if not isinstance(data, Mapping):
            raise wrong("not a table", data, f"a table with the keys {', '.join(known)}")
        for key in data:
            if key not in known:
                mend = suggestion(key, known) or "remove it or correct its name"
                raise wrong("unknown key", key, f"one of {', '.join(known)}", mend, key)
        for group in cls.one_of:
            present = [key for key in group if key in data]
            if len(present) != 1:
                problem = "too many choices" if present else "missing key"
                mend = "keep one of them" if present else f"add for example `{group[0]} = ...`"
                given = Words(" and ".join(present) or "none of them")
                raise wrong(problem, given, f"exactly one of {', '.join(group)}", mend, "")
        return data

    @classmethod
    def needs(cls, name: str) -> str:
        """What a key that must be there is expected to hold, in words."""
        field = cls.model_fields[name]
        told = [m.expected for m in field.metadata if isinstance(m, Checked)]
        return (told or [field.description or "a table"])[0]

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


class Words(str):
    """Words of ours among what is given, shown without quotation marks."""

    def __repr__(self) -> str:
        return str(self)
