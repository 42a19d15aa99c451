"""Building blocks of the tables of a scene file: base classes, values, values over time, units.

pydantic validates them. The module needs neither NumPy nor JAX.
"""

import datetime
import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

MAX_SAMPLES = 10_000_000
MAX_CLONES = 10_000_000
MAX_SEED = 2**63 - 1  # NetCDF stores it as a 64-bit number

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Lengths = Annotated[list[Positive], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Vector], Field(min_length=3, max_length=3)]
Numbers = Annotated[list[Number], Field(min_length=1, max_length=10_000)]


def _not_all_zero(values: list[float]) -> list[float]:
    if not any(values):
        raise ValueError("the numbers must not all be zero")
    return values


Direction = Annotated[Vector, AfterValidator(_not_all_zero)]
Quaternion = Annotated[
    list[Number], Field(min_length=4, max_length=4), AfterValidator(_not_all_zero)
]


def _three(value: Any) -> Any:
    """A single number as that of all three axes."""
    return [value] * 3 if isinstance(value, int | float) and not isinstance(value, bool) else value


_Axes = Annotated[list[NotNegative], Field(min_length=3, max_length=3)]
Gains = Annotated[_Axes, BeforeValidator(_three, json_schema_input_type=NotNegative | _Axes)]
Spread = Annotated[Gains, AfterValidator(_not_all_zero)]


def _in_order(values: list[float]) -> list[float]:
    rising = values[0] < values[-1]
    for index, (a, b) in enumerate(itertools.pairwise(values)):
        if a == b or (a < b) != rising:
            raise ValueError(
                "the times must be strictly increasing or strictly decreasing: sort them and remove"
                f" repeated ones (entry {index + 2} is {b} after {a})"
            )
    return values


Times = Annotated[
    list[Number], Field(min_length=2, max_length=MAX_SAMPLES), AfterValidator(_in_order)
]


def _about_body_axes(value: Any) -> Any:
    if isinstance(value, str) and value.islower():
        raise ValueError(
            f'angles of a scene are about body axes, written in upper case: "{value.upper()}". In'
            f' SciPy and in Trajectory.euler "{value}" is about space axes; for these reverse'
            f' letters and angles: "{value.upper()[::-1]}"'
        )
    return value


Sequence = Annotated[
    Literal["XYX", "XYZ", "XZX", "XZY", "YXY", "YXZ", "YZX", "YZY", "ZXY", "ZXZ", "ZYX", "ZYZ"],
    BeforeValidator(_about_body_axes),
]


def _with_zone(value: datetime.datetime) -> datetime.datetime:
    return value.replace(tzinfo=datetime.UTC) if value.tzinfo is None else value


Date = Annotated[datetime.datetime, AfterValidator(_with_zone)]


def _below(text: str) -> str:
    parts = text.replace("\\", "/").split("/")
    if not text.isprintable() or not text or parts[0] == "" or ".." in parts or ":" in parts[0]:
        raise ValueError(
            "the path leaves the folder: name a file in it or below, without .. and without a"
            " leading /; -o on the command line may name any place"
        )
    return text


BelowFolder = Annotated[str, AfterValidator(_below)]


# Units that a scene file may name, with their factors to SI
Seconds = Literal["s", "ms", "min", "h", "day", "year"]
Angle = Literal["rad", "deg", "turn"]
Rate = Literal["rad/s", "deg/s", "deg/h", "deg/day", "rpm", "rev/s", "rev/day"]
Moment = Literal["kg m^2", "g cm^2", "g mm^2", "slug ft^2", "relative"]
Momentum = Literal["kg m^2/s"]

DEGREE = math.pi / 180
SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0, "day": 86400.0, "year": 31557600.0}
ANGLES = {"rad": 1.0, "deg": DEGREE, "turn": 2 * math.pi}
ANGULAR_RATES = {
    "rad/s": 1.0,
    "deg/s": DEGREE,
    "deg/h": DEGREE / 3600,
    "deg/day": DEGREE / 86400,
    "rpm": 2 * math.pi / 60,
    "rev/s": 2 * math.pi,
    "rev/day": 2 * math.pi / 86400,
}
# 1 slug = 1 lbf s^2/ft exactly, 1 lbf = 4.4482216152605 N, 1 ft = 0.3048 m
MOMENTS = {
    "kg m^2": 1.0,
    "g cm^2": 1e-7,
    "g mm^2": 1e-9,
    "slug ft^2": 4.4482216152605 * 0.3048,
    "relative": 1.0,
}
SI = SECONDS | ANGLES | ANGULAR_RATES | MOMENTS | {"kg m^2/s": 1.0, "N m": 1.0}


class Table(BaseModel):
    """A table; exactly one key of each group in `one_of` is required."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, defer_build=True)
    one_of: ClassVar[tuple[tuple[str, ...], ...]] = ()

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        for group in self.one_of:
            present = [key for key in group if getattr(self, key) is not None]
            if len(present) != 1:
                keys = " and ".join(present) or "none of them"
                raise ValueError(f"exactly one of {', '.join(group)} is needed, got {keys}")
        return self

    def entries(self) -> Iterator[tuple[str, Any]]:
        """Names and values of the keys that are not None."""
        return ((name, value) for name, value in self if value is not None)


class Measured(Table):
    """A table with a `unit`; validation converts the numbers in `measures` to SI."""

    measures: ClassVar[tuple[str, ...]] = ("value",)

    @model_validator(mode="after")
    def _in_si(self) -> Self:
        factor = SI[dict(self)["unit"]]
        numbers = {n: scale(x, factor) for n, x in self.entries() if n in self.measures}
        return self.model_copy(update=numbers)


def scale(value: Any, factor: float) -> Any:
    """A number, a list of them or a table of them, times the factor."""
    if isinstance(value, list):
        return [scale(x, factor) for x in value]
    if isinstance(value, Table):
        return value.model_copy(update={name: scale(x, factor) for name, x in value.entries()})
    return value * factor


# Values that may be constants or tables over time.


class TimeTable(Table):
    """Values over time: `times` and `values`, or the columns of a CSV `file` beside the scene.

    The first column of the file is the time. All but the times are in SI units.
    """

    widths: ClassVar[tuple[int, ...]]
    one_of = (("values", "file"),)
    times: list[Number] | None = Field(None, min_length=2, max_length=MAX_SAMPLES)
    values: list[Any] | None = None
    file: BelowFolder | None = Field(None, description="CSV: time and values in its columns")
    order: Literal[1, 3] = Field(3, description="3: cubic interpolation, 1: linear")
    unit: Seconds = Field("s", description="of the times")

    @model_validator(mode="after")
    def _rows(self) -> Self:
        if (self.times is None) != (self.values is None):
            raise ValueError("times and values are given together, or the file in their place")
        if self.times is None or self.values is None:
            return self
        if len(self.times) != len(self.values):
            raise ValueError(f"{len(self.times)} times and {len(self.values)} values are no pairs")
        check_columns(self.times, self.values, self.widths)
        return self

    @property
    def unit_seconds(self) -> float:
        """The unit of the times, s."""
        return SECONDS[self.unit]


def check_columns(times: list[float], values: list[Any], widths: tuple[int, ...]) -> None:
    """ValueError unless times increase and all values have the same width, one of ``widths``."""
    for index, (a, b) in enumerate(itertools.pairwise(times)):
        if not a < b:
            raise ValueError(f"the times must ascend (entry {index + 2} is {b} after {a})")
    widths_of_values = {len(x) if isinstance(x, list) else 1 for x in values}
    if len(widths_of_values) != 1 or not widths_of_values <= set(widths):
        expected = " or ".join(map(str, widths))
        raise ValueError(
            f"each value must have {expected} number{'s' if expected != '1' else ''}, got"
            f" {', '.join(map(str, sorted(widths_of_values)))}"
        )


class NumberTable(TimeTable):
    widths = (1,)
    values: list[Number] | None = Field(None, max_length=MAX_SAMPLES)


class VectorTable(TimeTable):
    widths = (3,)
    values: list[Vector] | None = Field(None, max_length=MAX_SAMPLES)


class InertiaTable(TimeTable):
    """Moments (3 numbers), or tensors (9 numbers, row by row), in the unit of the inertia."""

    widths = (3, 9)
    values: list[Annotated[list[Number], Field(min_length=3, max_length=9)]] | None = Field(
        None, max_length=MAX_SAMPLES
    )


def _kind_of(value: Any) -> str:
    """The alternative that a value stands for, so that pydantic reports its errors only."""
    if isinstance(value, str):
        return "word"
    return "table" if isinstance(value, Mapping | TimeTable) else "constant"


_Constant, _Series, _Word = Tag("constant"), Tag("table"), Tag("word")
_BY_KIND = Discriminator(_kind_of)
NumberOverTime = Annotated[
    Annotated[NotNegative, _Constant] | Annotated[NumberTable, _Series], _BY_KIND
]
VectorOverTime = Annotated[Annotated[Vector, _Constant] | Annotated[VectorTable, _Series], _BY_KIND]
Velocity = Annotated[
    Annotated[Vector, _Constant]
    | Annotated[VectorTable, _Series]
    | Annotated[Literal["orbit"], _Word],
    _BY_KIND,
]
