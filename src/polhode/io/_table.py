"""One table of a TOML file, read strictly: every wrong key, type, shape or number has a message."""

import difflib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polhode.io._error import SceneFileError, shorten

REQUIRED = object()


def suggestion(word: str, known: Sequence[str]) -> str:
    """ "did you mean ...?" for a word that is close to a known one, or nothing."""
    close = difflib.get_close_matches(word.lower(), [k.lower() for k in known], n=1, cutoff=0.6)
    match = [k for k in known if close and k.lower() == close[0]]
    return f'did you mean "{match[0]}"?' if match else ""


class Table:
    """A TOML table whose keys must be among `known`; `where` is its name in messages."""

    def __init__(self, file: Path | str, where: str, data: object, known: Sequence[str]):
        self.file, self.where = file, where
        if not isinstance(data, Mapping):
            raise self.wrong("", "not a table", data, f"a table with the keys {', '.join(known)}")
        self.data = data
        for key in data:
            if key not in known:
                mend = suggestion(key, known) or "remove it or correct its name"
                raise SceneFileError(
                    file, self.name(key), "unknown key", key, f"one of {', '.join(known)}", mend
                )

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def name(self, key: str) -> str:
        if not self.where:
            return key
        return f"[{self.where}] {key}".rstrip()

    def wrong(
        self, key: str, problem: str, given: object, expected: str, mend: str = ""
    ) -> SceneFileError:
        """The error for one key; the caller raises it."""
        return SceneFileError(self.file, self.name(key), problem, shorten(given), expected, mend)

    def raw(self, key: str, expected: str, default: Any = REQUIRED) -> Any:
        if key in self.data:
            return self.data[key]
        if default is not REQUIRED:
            return default
        have = ", ".join(self.data) or "nothing"
        raise SceneFileError(
            self.file, self.name(key), "missing key", f"only {have}", expected, f"add `{key} = ...`"
        )

    def one_of(self, *keys: str) -> str:
        """The one key of `keys` that is present; exactly one must be."""
        present = [key for key in keys if key in self.data]
        if len(present) != 1:
            given = " and ".join(present) or "none of them"
            raise SceneFileError(
                self.file,
                self.name(""),
                "too many choices" if present else "missing key",
                given,
                f"exactly one of {', '.join(keys)}",
                "keep one of them" if present else f"add for example `{keys[0]} = ...`",
            )
        return present[0]

    def text(self, key: str, default: Any = REQUIRED) -> Any:
        value = self.raw(key, "a text in quotation marks", default)
        if key in self.data and not isinstance(value, str):
            raise self.wrong(key, "not a text", value, "a text in quotation marks")
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self.raw(key, "true or false", default)
        if not isinstance(value, bool):
            raise self.wrong(key, "not a yes or no", value, "true or false")
        return value

    def choice(self, key: str, options: Sequence[str], default: Any = REQUIRED) -> Any:
        value = self.raw(key, f"one of {', '.join(options)}", default)
        if key in self.data and value not in options:
            mend = suggestion(value, options) if isinstance(value, str) else ""
            raise self.wrong(key, "unknown choice", value, f"one of {', '.join(options)}", mend)
        return value

    def integer(self, key: str, least: int, most: int, default: Any = REQUIRED) -> Any:
        expected = f"a whole number from {least} to {most}"
        value = self.raw(key, expected, default)
        if key not in self.data:
            return value
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise self.wrong(key, "not a fitting whole number", value, expected)
        return value

    def number(self, key: str, default: Any = REQUIRED, positive: bool = False) -> Any:
        expected = "a positive number" if positive else "a finite number"
        value = self.raw(key, expected, default)
        if key not in self.data:
            return value
        result = _real(value)
        if result is None or (positive and result <= 0):
            raise self.wrong(key, f"not {expected}", value, expected)
        return result

    def array(self, key: str, shape: tuple[int, ...], scalar: bool = False):
        """A float64 array of the given shape; `scalar` also admits one number for all entries."""
        size = " x ".join(str(n) for n in shape)
        expected = f"{size} finite numbers in brackets" + (" or one number" if scalar else "")
        value = self.raw(key, expected)
        if scalar and (single := _real(value)) is not None:
            return np.full(shape, single)
        if not _has_shape(value, shape):
            raise self.wrong(key, "wrong shape or type", value, expected)
        return np.array(_floats(value), dtype=np.float64)

    def vectors(self, key: str, expected: str) -> np.ndarray:
        """A list of numbers of any length >= 1."""
        value = self.raw(key, expected)
        if not isinstance(value, list) or not value or any(_real(v) is None for v in value):
            raise self.wrong(key, "not a list of finite numbers", value, expected)
        return np.array(_floats(value), dtype=np.float64)

    def quantity(
        self, key: str, shape: tuple[int, ...], units: Mapping[str, float], more: Sequence[str] = ()
    ) -> tuple[np.ndarray, str, "Table"]:
        """`key = [..]` in the SI unit, or `key = { value = [..], unit = ".." }`; value in SI."""
        default_unit = next(iter(units))
        if not isinstance(self.data.get(key), Mapping):
            return self.array(key, shape), default_unit, self
        inner = self.table(key, ("value", "unit", *more))
        unit = inner.choice("unit", tuple(units), default_unit)
        return inner.array("value", shape) * units[unit], unit, inner

    def table(self, key: str, known: Sequence[str]) -> "Table":
        data = self.raw(key, f"a table with the keys {', '.join(known)}")
        where = f"{self.where}.{key}" if self.where else key
        return Table(self.file, where, data, known)

    def rows(self, key: str) -> list:
        """An array of tables; empty when the key is absent."""
        value = self.data.get(key, [])
        if not isinstance(value, list) or not all(isinstance(row, Mapping) for row in value):
            raise self.wrong(key, "not a list of tables", value, f"tables written as [[{key}]]")
        return value


def _real(value: object) -> float | None:
    """The finite float of a TOML number, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        result = float(value)
    except OverflowError:
        return None
    return result if math.isfinite(result) else None


def _has_shape(value: object, shape: tuple[int, ...]) -> bool:
    if not shape:
        return _real(value) is not None
    return (
        isinstance(value, list)
        and len(value) == shape[0]
        and all(_has_shape(entry, shape[1:]) for entry in value)
    )


def _floats(value):
    return [_floats(v) for v in value] if isinstance(value, list) else float(value)
