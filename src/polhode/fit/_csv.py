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
    (one of ``wheel`` alone is bridged linearly).
    Raises FileNotFoundError, and ValueError for missing columns, cells that are no numbers,
    unsorted or repeated times (each with its line) and rates that look like deg/s.
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        names = [name.strip() for name in rows.fieldnames or []]
        rows.fieldnames = names
        needed = {key: columns.get(key) for key in ("t", "wx", "wy", "wz")}
        if columns.get("wheel"):
            needed["wheel"] = columns["wheel"]
        missing = [f"{key} -> {name}" for key, name in needed.items() if name not in names]
        if missing:
            raise ValueError(
                f"{path} must have the columns asked for, missing: {', '.join(missing)}; its "
                f"columns are: {', '.join(names) or 'none (is the header line there?)'}."
            )
        table = [
            [_number(path, rows.line_num, name, row[name]) for name in needed.values()]
            for row in rows
        ]
    if len(table) < 4:
        raise ValueError(f"{path} must hold at least 4 rows of data, got {len(table)}.")
    data = np.array(table)
    times = data[:, 0]
    wrong = np.flatnonzero(~(np.diff(times) > 0))
    if wrong.size:
        first = int(wrong[0])
        raise ValueError(
            f"{path}: times must increase, but line {first + 3} ({times[first + 1]:g}) does not "
            f"follow line {first + 2} ({times[first]:g}); sort the rows, drop repeated or empty "
            f"ones ({wrong.size} such places)."
        )
    wheel = data[:, 4] if "wheel" in needed else None
    return Recording.of(
        times * time_scale, data[:, 1:4] * scale, wheel_speed=wheel, omega_noise=noise
    )


def _number(path, line, name, text):
    if text is None or not text.strip():
        return float("nan")
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"{path}: line {line}, column {name} must be a number, got {text!r}."
        ) from None
