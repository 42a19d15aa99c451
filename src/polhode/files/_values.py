"""Single values of a scene file, as pydantic types that refuse in our own words.

``Annotated[float, NUMBER]`` is a field that must be a finite number: pydantic runs the check and
puts the schema into the JSON Schema of the file. Nothing here needs numpy.
"""

import dataclasses
import datetime
import difflib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pydantic_core import PydanticCustomError, core_schema

from polhode.files._error import shorten


def wrong(
    problem: str, given: object, expected: str, mend: str = "", key: str | None = None
) -> PydanticCustomError:
    """The error of the value at hand; of its key `key` where it is a table ("": the table)."""
    words = {"given": shorten(given), "expected": expected, "mend": mend, "key": key}
    return PydanticCustomError("scene", "{problem}", {"problem": problem, **words})


def suggestion(word: str, known: Sequence[str]) -> str:
    """ "did you mean ...?" for a word that is close to a known one, or nothing."""
    close = difflib.get_close_matches(word[:100].lower(), [k.lower() for k in known], 1, 0.6)
    match = [k for k in known if close and k.lower() == close[0]]
    return f'did you mean "{match[0]}"?' if match else ""


@dataclasses.dataclass(frozen=True, eq=False)
class Checked:
    """A check (value -> value, or raises `wrong`), what it expects in words, and as a schema."""

    check: Callable[[Any], Any]
    expected: str
    schema: Mapping[str, Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return dict(self.schema)


def real(value: object) -> float | None:
    """The finite float of a TOML number, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        result = float(value)
    except OverflowError:
        return None
    return result if math.isfinite(result) else None


def simple(
    problem: str, expected: str, schema: Mapping[str, Any], fits: Callable[[Any], bool],
    made: Callable[[Any], Any] = lambda given: given,
) -> Checked:  # fmt: skip
    """What is `made` of a value that `fits`."""

    def check(given: object) -> Any:
        if not fits(given):
            raise wrong(problem, given, expected)
        return made(given)

    return Checked(check, expected, schema)


def number(problem: str, expected: str, fits: Callable[[float], bool], **schema: Any) -> Checked:
    """A finite number that `fits`."""

    def is_fitting(given: object) -> bool:
        return (found := real(given)) is not None and fits(found)

    return simple(problem, expected, {"type": "number"} | schema, is_fitting, float)


NUMBER = number("not a finite number", "a finite number", lambda x: True)
POSITIVE = number("not a positive number", "a positive number", lambda x: x > 0, exclusiveMinimum=0)
TOLERANCE = number(
    "not a relative tolerance", "a positive number below 1", lambda x: 0 < x < 1,
    exclusiveMinimum=0, exclusiveMaximum=1,
)  # fmt: skip


def whole(least: int, most: int) -> Checked:
    """A whole number within limits."""
    return simple(
        "not a fitting whole number", f"a whole number from {least} to {most}",
        {"type": "integer", "minimum": least, "maximum": most},
        lambda x: isinstance(x, int) and not isinstance(x, bool) and least <= x <= most,
    )  # fmt: skip


TEXT = simple(
    "not a text", "a text in quotation marks", {"type": "string"}, lambda x: isinstance(x, str)
)
FLAG = simple(
    "not a yes or no", "true or false", {"type": "boolean"}, lambda x: isinstance(x, bool)
)
DATE = simple(
    "not a date with a time",
    "a date and time such as 1992-11-09T17:49:47Z, without quotation marks",
    {"type": "string", "format": "date-time"}, lambda x: isinstance(x, datetime.datetime),
    lambda x: x.replace(tzinfo=datetime.UTC) if x.tzinfo is None else x,
)  # fmt: skip
NAMES = simple(
    "not three texts", 'three texts, e.g. ["x", "y", "z"]',
    {"type": "array", "items": {"type": "string"}, "minItems": 3, "maxItems": 3},
    lambda x: isinstance(x, list) and len(x) == 3 and all(isinstance(n, str) for n in x), tuple,
)  # fmt: skip


def choice(options: Sequence[str]) -> Checked:
    """One of some texts."""
    expected = f"one of {', '.join(options)}"

    def check(value: object) -> str:
        if value not in options:
            mend = suggestion(value, options) if isinstance(value, str) else ""
            raise wrong("unknown choice", value, expected, mend)
        return str(value)

    return Checked(check, expected, {"enum": list(options)})


def array(*shape: int, scalar: bool = False, positive: bool = False) -> Checked:
    """Finite numbers of a shape; `scalar`: or one number for all of them."""
    kind = "positive" if positive else "finite"
    expected = f"{' x '.join(map(str, shape))} {kind} numbers in brackets"
    expected += " or one number" if scalar else ""
    schema: dict[str, Any] = {"type": "number"}
    for size in reversed(shape):
        schema = {"type": "array", "items": schema, "minItems": size, "maxItems": size}

    def has_shape(value: object, shape: tuple[int, ...]) -> bool:
        if not shape:
            found = real(value)
            return found is not None and (found > 0 or not positive)
        return (
            isinstance(value, list)
            and len(value) == shape[0]
            and all(has_shape(entry, shape[1:]) for entry in value)
        )

    def floats(value: Any) -> Any:
        return [floats(v) for v in value] if isinstance(value, list) else float(value)

    def check(value: object) -> list:
        if scalar and (single := real(value)) is not None:
            return [single] * shape[0]
        if not has_shape(value, shape):
            raise wrong("wrong shape or type", value, expected)
        return floats(value)

    return Checked(check, expected, {"anyOf": [schema, {"type": "number"}]} if scalar else schema)


VECTOR, MATRIX = array(3), array(3, 3)


def _quaternion(value: object) -> list[float]:
    found = array(4).check(value)
    if not any(found):
        raise wrong("zero quaternion", value, WXYZ.expected)
    return found


WXYZ = Checked(_quaternion, "four numbers, not all zero", array(4).schema)


def _spread(value: object) -> list[float]:
    found = array(3, scalar=True).check(value)
    if min(found) < 0 or not any(found):
        raise wrong("not a spread", value, "standard deviations, none negative, not all 0")
    return found


SPREAD = Checked(_spread, array(3, scalar=True).expected, array(3, scalar=True).schema)


def _times(value: object) -> list[float]:
    if not isinstance(value, list) or any(real(v) is None for v in value):
        raise wrong("not a list of finite numbers", value, TIMES.expected)
    found = [float(v) for v in value]
    steps = [b - a for a, b in itertools.pairwise(found)]
    sign = math.copysign(1.0, steps[0]) if steps else 1.0
    bad = [k for k, step in enumerate(steps) if step * sign <= 0]
    if bad or not steps:
        place = bad[0] + 2 if bad else 1
        raise wrong(
            f"unsorted, repeated or too few times (entry {place})", value, TIMES.expected,
            "sort them and remove repeated ones",
        )  # fmt: skip
    return found


TIMES = Checked(
    _times, "two or more times, strictly increasing or strictly decreasing",
    {"type": "array", "items": {"type": "number"}, "minItems": 2},
)  # fmt: skip

SEQUENCES = [a + b + c for a in "xyz" for b in "xyz" for c in "xyz" if a != b and b != c]


def _sequence(value: object) -> str:
    if TEXT.check(value).lower() not in SEQUENCES:
        raise wrong("unknown Euler sequence", value, SEQUENCE.expected)
    return str(value).lower()


SEQUENCE = Checked(_sequence, "three letters of x, y, z, neighbours different", {"enum": SEQUENCES})


def _path(value: object) -> str:
    text = TEXT.check(value)
    parts = text.replace("\\", "/").split("/")
    if not text.isprintable() or not text or parts[0] == "" or ".." in parts or ":" in parts[0]:
        raise wrong(
            "a path that leaves the folder", value, PATH.expected,
            "name a file below the folder, without .. and without a leading /; -o on the command"
            " line may name any place",
        )  # fmt: skip
    return text


PATH = Checked(_path, "the name of a file in this folder or below", {"type": "string"})
