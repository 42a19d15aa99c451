"""Recordings from CSV files, with messages that say which row or column is wrong."""

import csv
import math
import re
from collections.abc import Mapping
from os import PathLike
from typing import NamedTuple

import numpy as np

from polhode.fit._recording import Recording


class Loaded(NamedTuple):
    """A recording, the columns it was read from by role, and the units that their names state
    (role -> unit; empty where no name does).
    """

    recording: Recording
    columns: dict[str, str]
    units: dict[str, str]


def read_recording(
    path: str | PathLike[str],
    columns: Mapping[str, str] | None = None,
    *,
    scale: float | None = None,
    time_scale: float | None = None,
    noise: float = 1.0,
) -> Recording:
    """A recording of rates from a CSV file with a header line.

    ``columns`` names the file's columns for ``t``, ``wx``, ``wy``, ``wz`` and optionally ``wheel``;
    those it leaves out are recognised by their usual names (``t``, ``time_s``, ``wx``, ``gyro_x``,
    ``omega_x``, ``angular_velocity.x``, ...). ``scale`` multiplies the rates (pi/180 for deg/s),
    ``time_scale`` the times (1e-3 for ms); None: by the unit that the column's name states (in
    brackets, or at its end), or 1. ``noise``, rad/s: standard deviation of the rates. An empty or
    NaN cell makes its row a gap; one of ``wheel`` alone is interpolated linearly. Cells are
    separated by commas, or, where the header has none, by semicolons or tabs, and may then have a
    decimal comma. Lines before the header that are empty or start with # are skipped.

    Raises FileNotFoundError, and ValueError for a file that is not text, missing, ambiguous or
    repeated columns, cells that are no numbers, unsorted or repeated times (each with its line) and
    rates that appear to be in deg/s.
    """
    return load_recording(path, columns, scale=scale, time_scale=time_scale, noise=noise).recording


def load_recording(
    path: str | PathLike[str],
    columns: Mapping[str, str] | None = None,
    *,
    scale: float | None = None,
    time_scale: float | None = None,
    noise: float = 1.0,
) -> Loaded:
    """As ``read_recording``, with the columns and units that were recognised."""
    lines = _lines(path)
    first = next(
        (k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")),
        None,
    )
    if first is None:
        raise ValueError(f"{path} is empty; expected a header line and rows of times and rates.")
    separator = next((mark for mark in ",;\t" if mark in lines[first]), ",")
    (header,) = csv.reader([lines[first]], delimiter=separator, skipinitialspace=True)
    names = [name.strip() for name in header]
    needed = _needed(path, names, {} if columns is None else columns)
    units = {role: unit for role, name in needed.items() if (unit := unit_of(role, name))}
    if scale is None:
        scale = _common(path, "rates", [units.get(role) for role in ("wx", "wy", "wz")], _RATES)
    if time_scale is None:
        time_scale = _common(path, "times", [units.get("t")], _TIMES)
    table, numbers = _rows(path, lines, first, separator, names, needed)
    data = np.array(table)
    times = data[:, 0]
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    if wrong.size:
        k = int(wrong[0])
        raise ValueError(
            f"{path}: times must increase, but line {numbers[k + 1]} ({times[k + 1]:g}) does not "
            f"follow line {numbers[k]} ({times[k]:g}); sort the rows, drop repeated or empty "
            f"ones ({wrong.size} such places)."
        )
    wheel = data[:, 4] if "wheel" in needed else None
    try:
        recording = Recording.of(
            times * time_scale, data[:, 1:4] * scale, wheel_speed=wheel, omega_noise=noise
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return Loaded(recording, needed, units)


def _needed(path, names: list[str], columns: Mapping[str, str]) -> dict[str, str]:
    """The column of each role: the one given, or the one whose name is usual for it."""
    found = {role: columns.get(role) or usual_column(path, role, names) or role
             for role in ("t", "wx", "wy", "wz")}  # fmt: skip
    if columns.get("wheel"):
        found["wheel"] = columns["wheel"]
    missing = [f"{role} -> {name}" for role, name in found.items() if name not in names]
    if missing:
        raise ValueError(
            f"{path} must have the columns asked for, missing: {', '.join(missing)}; its "
            f"columns are: {', '.join(names) or 'none'}{_headless(names)}."
        )
    twice = [name for name in found.values() if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"{path} has {names.count(twice[0])} columns named {twice[0]}; rename all but one of "
            "them."
        )
    return found


def _rows(path, lines, first, separator, names, needed) -> tuple[list, list[int]]:
    """The numbers of the needed columns, and the line that each row stands in."""
    places = [names.index(name) for name in needed.values()]
    table, numbers = [], []
    reader = csv.reader(lines[first + 1 :], delimiter=separator, skipinitialspace=True)
    try:
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            numbers.append(first + 1 + reader.line_num)
            cells = [row[k] if k < len(row) else "" for k in places]
            pairs = zip(needed.values(), cells, strict=True)
            table.append([_number(path, numbers[-1], *pair, separator != ",") for pair in pairs])
    except csv.Error as error:
        raise ValueError(f"{path}: line {first + 1 + reader.line_num}: {error}.") from None
    if len(table) < 4:
        raise ValueError(f"{path} must hold at least 4 rows of data, got {len(table)}.")
    return table, numbers


_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
_RATES = {"rad/s": 1.0, "deg/s": math.pi / 180, "mdeg/s": math.pi / 180e3, "rpm": math.pi / 30}
_SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms",
    "milliseconds": "ms", "usec": "us", "µs": "us", "μs": "us", "microseconds": "us",
    "nsec": "ns", "nanoseconds": "ns", "minutes": "min",
    "rad_s": "rad/s", "rads": "rad/s", "rad_per_s": "rad/s", "radps": "rad/s", "rps": "rad/s",
    "rad/sec": "rad/s", "rad s-1": "rad/s", "rad*s^-1": "rad/s", "rad s^-1": "rad/s",
    "deg_s": "deg/s", "degs": "deg/s", "dps": "deg/s", "deg_per_s": "deg/s", "degps": "deg/s",
    "deg/sec": "deg/s", "°/s": "deg/s", "deg s-1": "deg/s", "mdps": "mdeg/s",
}  # fmt: skip
_TIME = re.compile(r"t|time|times|timestamp|seconds[_ ]?elapsed|elapsed([_ ]?time)?|clock")
_RATE = (
    r"(?:gyro(?:scope)?|w|omega|omega[_. ]?body|ang(?:ular)?[_. ]?vel(?:ocity)?|"
    r"(?:ang(?:ular)?|body|rotation)[_. ]?rate|rate|rot[_. ]?rate|imu[_. ]gyro(?:scope)?)"
    r"[_. ]?AXIS"
)


def _split(name: str) -> tuple[str, str]:
    """A column's name in lower case without its unit, and the unit as written."""
    text = name.strip().lower()
    if found := re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]", text):
        return found[1], found[2]
    for unit in sorted((*_TIMES, *_SPELLINGS), key=len, reverse=True):
        if unit.isidentifier() and text.endswith(f"_{unit}"):
            return text[: -len(unit) - 1], unit
    return text, ""


def unit_of(role: str, name: str) -> str:
    """The unit that a column's name states, or nothing. ValueError for one of another kind."""
    unit = _split(name)[1]
    unit = _SPELLINGS.get(unit, unit)
    known = _TIMES if role == "t" else _RATES
    if unit in known:
        return unit
    if unit in _TIMES or unit in _RATES:
        raise ValueError(
            f"column {name} is to be {role}, but states the unit {unit}; expected one of"
            f" {', '.join(known)}."
        )
    return ""


def usual_column(path, role: str, names: list[str]) -> str | None:
    """The column whose name is usual for a role; None without one, ValueError for several."""
    if role in names:
        return role
    pattern = _TIME if role == "t" else re.compile(_RATE.replace("AXIS", role[-1]))
    fitting = [name for name in names if pattern.fullmatch(_split(name)[0])]
    aviation = dict(zip(("wx", "wy", "wz"), "pqr"))
    bare = {_split(name)[0]: name for name in names}
    if not fitting and role in aviation and set("pqr") <= bare.keys():
        fitting = [bare[aviation[role]]]
    if len(set(fitting)) > 1:
        raise ValueError(
            f"{path}: the columns {', '.join(fitting)} could all be {role}; say which is"
            f" (--columns {role}={fitting[0]} on the command line)."
        )
    return fitting[0] if fitting else None


def _common(path, what: str, units: list, factors: Mapping[str, float]) -> float:
    """The factor of the one unit that columns state."""
    stated = sorted({str(unit) for unit in units if unit})
    if len(stated) > 1:
        raise ValueError(f"{path}: the {what} are in different units: {', '.join(stated)}.")
    return factors[stated[0]] if stated else 1.0


def _lines(path) -> list[str]:
    """The text, line by line."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            begin = file.read(65536)  # what is no text may have no end
            lines = (begin if "\0" in begin else begin + file.read()).splitlines(keepends=True)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not text in UTF-8 (byte {error.start}); save the recording as CSV, UTF-8."
        ) from None
    if any("\0" in line for line in lines):
        raise ValueError(f"{path} is not text in UTF-8; save the recording as CSV, UTF-8.")
    return lines


def _headless(names: list[str]) -> str:
    """A question, where the header looks like data."""
    try:
        [float(name) for name in names]
    except ValueError:
        return ""
    return " (is the header line there?)"


def _number(path, line, name, text, comma):
    if not text.strip():
        return float("nan")
    try:
        return float(text.replace(",", ".") if comma else text)
    except ValueError:
        hint = " (the header line again?)" if text.strip() == name else ""
        raise ValueError(
            f"{path}: line {line}, column {name} must be a number, got {text!r}{hint}."
        ) from None
