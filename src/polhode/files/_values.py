"""Types of single values of a scene file, checked by pydantic. Nothing here needs numpy."""

import datetime
import itertools
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

MAX_SAMPLES = 10_000_000

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
    """One number is that of all three axes."""
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


def _lower(value: Any) -> Any:
    return value.lower() if isinstance(value, str) else value


Sequence = Annotated[
    Literal["xyx", "xyz", "xzx", "xzy", "yxy", "yxz", "yzx", "yzy", "zxy", "zxz", "zyx", "zyz"],
    BeforeValidator(_lower),
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

Seconds = Literal["s", "ms", "min", "h", "day", "year"]
Angle = Literal["rad", "deg", "turn"]
Rate = Literal["rad/s", "deg/s", "deg/h", "deg/day", "rpm", "rev/s", "rev/day"]
Moment = Literal["kg m^2", "g cm^2", "g mm^2", "slug ft^2", "relative"]
Momentum = Literal["kg m^2/s"]
