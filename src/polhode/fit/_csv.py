"""Recordings from CSV files, with messages that say which row or column is wrong."""

import csv
from collections.abc import Mapping
from os import PathLike

import numpy as np

from polhode.fit._recording import Recording


def read_recording(
    path: str | PathLike[str],
    columns: Mapping[str, str],
    *,
    scale: float = 1.0,
    time_scale: float = 1.0,
    noise: float = 1.0,
) -> Recording:
    """A recording of rates from a CSV file with a header line.

    ``columns`` names the file's columns for ``t``, ``wx``, ``wy``, ``wz`` and optionally ``wheel``;
    ``scale`` multiplies the rates (pi/180 for deg/s), ``time_scale`` the times (1e-3 for ms);
    ``noise``, rad/s: standard deviation of the rates. An empty or NaN cell makes its row a gap
    (one of ``wheel`` alone is bridged linearly). Cells are separated by commas, or, where the
    header has none, by semicolons or tabs, and may then have a decimal comma; lines before the
    header that are empty or start with # are passed over.
    Raises FileNotFoundError, and ValueError for a file that is not text, missing or repeated
    columns, cells that are no numbers, unsorted or repeated times (each with its line) and rates
    that look like deg/s.
    """
    lines = _lines(path)
    first = next((k for k, line in enumerate(lines) if _is_content(line)), None)
    if first is None:
        raise ValueError(f"{path} is empty; expected a header line and rows of times and rates.")
    separator = _separator(lines[first])
    names = [
        name.strip()
        for name in next(csv.reader([lines[first]], delimiter=separator, skipinitialspace=True))
    ]
    needed = {key: columns.get(key) for key in ("t", "wx", "wy", "wz")}
    if columns.get("wheel"):
        needed["wheel"] = columns["wheel"]
    missing = [f"{key} -> {name}" for key, name in needed.items() if name not in names]
    if missing:
        raise ValueError(
            f"{path} must have the columns asked for, missing: {', '.join(missing)}; its "
            f"columns are: {', '.join(names) or 'none'}{_headless(names)}."
        )
    twice = [name for name in needed.values() if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"{path} has {names.count(twice[0])} columns named {twice[0]}; rename all but one of "
            "them."
        )
    places = [names.index(name) for name in needed.values()]
    table, numbers = [], []
    reader = csv.reader(lines[first + 1 :], delimiter=separator, skipinitialspace=True)
    for row in reader:
        if not any(cell.strip() for cell in row):
            continue
        line = first + 1 + reader.line_num
        cells = [row[k] if k < len(row) else "" for k in places]
        table.append(
            [
                _number(path, line, name, cell, separator != ",")
                for name, cell in zip(needed.values(), cells, strict=True)
            ]
        )
        numbers.append(line)
    if len(table) < 4:
        raise ValueError(f"{path} must hold at least 4 rows of data, got {len(table)}.")
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
        return Recording.of(
            times * time_scale, data[:, 1:4] * scale, wheel_speed=wheel, omega_noise=noise
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _lines(path) -> list[str]:
    """The text, line by line."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = file.read().splitlines(keepends=True)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not text in UTF-8 (byte {error.start}); save the recording as CSV, UTF-8."
        ) from None
    if any("\0" in line for line in lines[:10]):
        raise ValueError(f"{path} is not text in UTF-8; save the recording as CSV, UTF-8.")
    return lines


def _is_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _separator(header: str) -> str:
    """Comma, or what stands in its place."""
    return next((mark for mark in ",;\t" if mark in header), ",")


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
