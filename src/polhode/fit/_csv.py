"""Recordings from CSV files, with messages that say which row or column is wrong."""

import csv
import math
import re
from collections.abc import Mapping
from os import PathLike
from typing import NamedTuple

import numpy as np

from polhode.fit._recording import Recording


class MissingColumnsError(ValueError):
    """Columns that a file does not have; ``roles``: what they are needed for."""

    roles: tuple[str, ...] = ()


class LoadedCsv(NamedTuple):
    """A recording, the names of its columns by role, and the units that these names state (role ->
    unit, only for columns with a unit).
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
    brackets, or at its end), or 1. The speeds of ``wheel`` are always scaled by the unit in their
    column's name. ``noise``, rad/s: standard deviation of the rates. An empty or
    NaN cell makes its row a gap; a missing ``wheel`` speed alone is interpolated linearly. Cells
    are separated by commas, or, where the header has none, by semicolons or tabs, and may then have
    a decimal comma. Lines before the header that are empty or start with # are skipped.

    Raises FileNotFoundError, and ValueError for a file that is not text, missing, ambiguous or
    repeated columns, a ``scale`` of another unit than the columns state, cells without a number,
    unsorted or repeated times (each with its line) and rates that appear to be in deg/s.
    """
    return load_recording(path, columns, scale=scale, time_scale=time_scale, noise=noise).recording


def load_recording(
    path: str | PathLike[str],
    columns: Mapping[str, str] | None = None,
    *,
    scale: float | None = None,
    time_scale: float | None = None,
    noise: float = 1.0,
) -> LoadedCsv:
    """As ``read_recording``, with the columns and units that were recognised."""
    lines = _lines(path)
    header_line = next(
        (k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")),
        None,
    )
    if header_line is None:
        raise ValueError(f"{path} is empty; expected a header line and rows of times and rates.")
    separator = next((mark for mark in ",;\t" if mark in lines[header_line]), ",")
    (header,) = csv.reader([lines[header_line]], delimiter=separator, skipinitialspace=True)
    names = [name.strip() for name in header]
    header_names = _required_columns(path, names, {} if columns is None else columns)
    factors = {"t": time_scale, "wx": scale, "wy": scale, "wz": scale}
    units = {
        role: unit
        for role, name in header_names.items()
        if (unit := unit_of(role, name, is_scaled=factors.get(role) is not None))
    }
    scale = _factor(path, "rates", [units.get(role) for role in ("wx", "wy", "wz")], _RATES, scale)
    time_scale = _factor(path, "times", [units.get("t")], _TIMES, time_scale)
    wheel_scale = _factor(path, "wheel speeds", [units.get("wheel")], _RATES, None)
    table, numbers = _rows(path, lines, header_line, separator, names, header_names)
    data = np.array(table)
    times = data[:, 0]
    not_ascending = np.flatnonzero(~(np.diff(times) > 0))
    if not_ascending.size:
        k = int(not_ascending[0])
        raise ValueError(
            f"{path}: times must increase, but line {numbers[k + 1]} ({times[k + 1]:g}) does not "
            f"follow line {numbers[k]} ({times[k]:g}); sort the rows, drop repeated or empty "
            f"ones ({not_ascending.size} such places)."
        )
    wheel = data[:, 4] * wheel_scale if "wheel" in header_names else None
    try:
        recording = Recording.of(
            times * time_scale, data[:, 1:4] * scale, wheel_speed=wheel, omega_noise=noise
        )
    except ValueError as error:
        raise type(error)(f"{path}: {error}") from None
    return LoadedCsv(recording, header_names, units)


def _required_columns(path, names: list[str], columns: Mapping[str, str]) -> dict[str, str]:
    """The column name of each role: from ``columns``, or else recognised as a usual name."""
    if unknown := sorted(set(columns) - {"t", "wx", "wy", "wz", "wheel"}):
        raise ValueError(
            f"columns names those of t, wx, wy, wz and wheel, got the keys {', '.join(unknown)}."
        )
    header_names = {
        role: columns.get(role) or usual_column(path, role, names) or role
        for role in ("t", "wx", "wy", "wz")
    }
    if columns.get("wheel"):
        header_names["wheel"] = columns["wheel"]
    missing = {role: name for role, name in header_names.items() if name not in names}
    if missing:
        missing_columns = ", ".join(f"{role} -> {name}" for role, name in missing.items())
        error = MissingColumnsError(
            f"{path} does not have the requested columns, missing: {missing_columns};"
            f" its columns are: {', '.join(names) or 'none'}{_headless(names)}."
        )
        error.roles = tuple(missing)
        raise error
    shared = [name for name in header_names.values() if [*header_names.values()].count(name) > 1]
    if shared:
        roles = [role for role, name in header_names.items() if name == shared[0]]
        raise ValueError(
            f"{path}: the column {shared[0]} is to be {' and '.join(roles)}; each needs a column of"
            " its own."
        )
    twice = [name for name in header_names.values() if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"{path} has {names.count(twice[0])} columns named {twice[0]}; rename all but one of "
            "them."
        )
    return header_names


def _rows(path, lines, header_line, separator, names, header_names) -> tuple[list, list[int]]:
    """The numbers of the needed columns, and the line number of each row."""
    places = [names.index(name) for name in header_names.values()]
    table, numbers = [], []
    reader = csv.reader(lines[header_line + 1 :], delimiter=separator, skipinitialspace=True)
    try:
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            numbers.append(header_line + 1 + reader.line_num)
            if any(cell.strip() for cell in row[len(names) :]):
                raise ValueError(
                    f"{path}: line {numbers[-1]} has {len(row)} cells, its header {len(names)}; of"
                    " numbers with decimal commas separate the cells by semicolons."
                )
            cells = [row[k] if k < len(row) else "" for k in places]
            pairs = zip(header_names.values(), cells, strict=True)
            table.append([_number(path, numbers[-1], *pair, separator != ",") for pair in pairs])
    except csv.Error as error:
        raise ValueError(f"{path}: line {header_line + 1 + reader.line_num}: {error}.") from None
    if len(table) < 4:
        raise ValueError(f"{path} must hold at least 4 rows of data, got {len(table)}.")
    return table, numbers


_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": 86400.0}
_DEGREE = math.pi / 180
_RATES = {
    "rad/s": 1.0,
    "mrad/s": 1e-3,
    "deg/s": _DEGREE,
    "mdeg/s": _DEGREE / 1000,
    "deg/h": _DEGREE / 3600,
    "rpm": math.pi / 30,
    "rev/s": 2 * math.pi,
}
_SPELLINGS = {
    "sec": "s",
    "secs": "s",
    "second": "s",
    "seconds": "s",
    "msec": "ms",
    "millis": "ms",
    "milliseconds": "ms",
    "usec": "us",
    "µs": "us",
    "μs": "us",
    "microseconds": "us",
    "nsec": "ns",
    "nanoseconds": "ns",
    "minutes": "min",
    "hour": "h",
    "hours": "h",
    "days": "day",
    "rad_s": "rad/s",
    "rads": "rad/s",
    "rad_per_s": "rad/s",
    "radps": "rad/s",
    "rad/sec": "rad/s",
    "rad s-1": "rad/s",
    "rad*s^-1": "rad/s",
    "rad s^-1": "rad/s",
    "deg_s": "deg/s",
    "degs": "deg/s",
    "dps": "deg/s",
    "deg_per_s": "deg/s",
    "degps": "deg/s",
    "deg/sec": "deg/s",
    "°/s": "deg/s",
    "deg s-1": "deg/s",
    "mdps": "mdeg/s",
    "deg/hr": "deg/h",
    "°/h": "deg/h",
    "rev/min": "rpm",
    "r/min": "rpm",
}
_AMBIGUOUS = ("rps",)
_TIME = re.compile(r"t|time|times|timestamp|seconds[_ ]?elapsed|elapsed([_ ]?time)?|clock")
_RATE = (
    r"(?:gyro(?:scope)?|w|omega|omega[_. ]?body|ang(?:ular)?[_. ]?vel(?:ocity)?|"
    r"(?:ang(?:ular)?|body|rotation)[_. ]?rate|rate|rot[_. ]?rate|imu[_. ]gyro(?:scope)?)"
    r"[_. ]?AXIS"
)


def _split_unit(name: str) -> tuple[str, str]:
    """A column's name in lower case without its unit, and the unit as written."""
    text = name.strip().lower()
    if match := re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]", text):
        return match[1], match[2]
    for unit in sorted((*_TIMES, *_RATES, *_SPELLINGS, *_AMBIGUOUS), key=len, reverse=True):
        if text.endswith(f"_{unit}"):
            return text[: -len(unit) - 1], unit
    return text, ""


def unit_of(role: str, name: str, is_scaled: bool = False) -> str:
    """The unit that a column's name states, or an empty string. ValueError for a unit of another
    quantity, and for an unknown unit in brackets unless a factor is given (``is_scaled``)."""
    unit = _split_unit(name)[1]
    unit = _SPELLINGS.get(unit, unit)
    factors = _TIMES if role == "t" else _RATES
    if unit in factors or (unit in _AMBIGUOUS and role != "t"):
        return unit
    is_known = unit in _TIMES or unit in _RATES
    if is_known or (name.rstrip()[-1:] in ("]", ")") and unit and not is_scaled):
        raise ValueError(
            f"column {name} is to be {role}, but states the unit {unit}; expected one of"
            f" {', '.join(factors)}. Rename the column, or state the factor."
        )
    return ""


def usual_column(path, role: str, names: list[str]) -> str | None:
    """The column whose name is usual for a role; None without one, ValueError for several."""
    if role in names:
        return role
    pattern = _TIME if role == "t" else re.compile(_RATE.replace("AXIS", role[-1]))
    fitting = [name for name in names if pattern.fullmatch(_split_unit(name)[0])]
    aviation = dict(zip(("wx", "wy", "wz"), "pqr"))
    names_without_unit = {_split_unit(name)[0]: name for name in names}
    if not fitting and role in aviation and set("pqr") <= names_without_unit.keys():
        fitting = [names_without_unit[aviation[role]]]
    if len(set(fitting)) > 1:
        raise ValueError(
            f"{path}: the columns {', '.join(fitting)} could all be {role}; say which is"
            f" (--columns {role}={fitting[0]} on the command line)."
        )
    return fitting[0] if fitting else None


def _factor(
    path, what: str, units: list, factors: Mapping[str, float], given: float | None
) -> float:
    """The factor ``given`` by the caller, or else that of the unit in the column names, or 1.

    ValueError where these contradict each other or the unit is ambiguous.
    """
    stated = sorted({str(unit) for unit in units if unit})
    if given is not None:
        meant = next((unit for unit, factor in factors.items() if factor == given), None)
        if meant and given != 1 and stated and stated != [meant]:
            raise ValueError(
                f"{path}: the {what} are in {', '.join(stated)} by the names of their columns, but"
                f" are to be read as {meant}; leave that out, or rename the columns."
            )
        return given
    if len(stated) > 1:
        raise ValueError(f"{path}: the {what} are in different units: {', '.join(stated)}.")
    if stated and stated[0] in _AMBIGUOUS:
        raise ValueError(
            f"{path}: the {what} are in {stated[0]} by the names of their columns, which may mean"
            " rad/s or revolutions per second; rename the columns, to rad/s or rpm for example."
        )
    return factors[stated[0]] if stated else 1.0


def _lines(path) -> list[str]:
    """The text, line by line."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            begin = file.read(65536)  # a NUL here ends the reading: binary streams may be endless
            lines = (begin if "\0" in begin else begin + file.read()).splitlines(keepends=True)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not text in UTF-8 (byte {error.start}); save the recording as CSV, UTF-8."
        ) from None
    if any("\0" in line for line in lines):
        raise ValueError(f"{path} is not text in UTF-8; save the recording as CSV, UTF-8.")
    return lines


def _headless(names: list[str]) -> str:
    """A hint for an error message, where all column names are numbers."""
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
