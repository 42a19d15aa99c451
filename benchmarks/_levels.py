"""From rows of work and error to the time that an error costs."""

import itertools
import math
from collections.abc import Iterable

LEVELS = (1e-3, 1e-6, 1e-9, 1e-12)
OURS = "polhode"


def curves(rows: Iterable[dict]) -> dict[tuple[str, str], list[dict]]:
    """(peer, program) -> its rows, in the order found."""
    found: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        found.setdefault((row["peer"], row["program"]), []).append(row)
    return found


def time_at(rows: list[dict], level: float, error: str = "attitude_median") -> float | None:
    """Time [ns per body] of one program to reach an error; None where it never does.

    Interpolated between neighbouring settings on logarithmic scales, never extrapolated: where all
    settings are better than asked for, the cheapest one counts.
    """
    points = [
        (max(row[error], 1e-17), row["ns_per_body"])
        for row in rows
        if row[error] is not None and not row["failed"]
    ]
    good = [time for off, time in points if off <= level]
    if not good:
        return None
    best = min(good)
    for left, right in itertools.pairwise(points):
        (high, cheap), (low, dear) = sorted((left, right), key=lambda p: -p[0])
        if low <= level < high and cheap < dear:
            share = math.log(level / high) / math.log(low / high)
            best = min(best, cheap * (dear / cheap) ** share)
    return best


def ours(row: dict) -> bool:
    """Whether a row is what the planner chooses by default."""
    return row["peer"] == OURS and row["program"].startswith("default")


def standing(table: dict, error: str = "attitude_median") -> list[dict]:
    """Per level: our default's time, the best peer, its time, and peer over ours.

    ``ratio`` above 1: the default is faster than every peer; None where one of the two never
    reaches the level.
    """
    mine = [row for row in table["rows"] if ours(row)]
    others = curves(row for row in table["rows"] if row["peer"] != OURS)
    # the planner changes its method with the tolerance: its settings are one curve
    found = []
    for level in LEVELS:
        times = {key: time_at(rows, level, error) for key, rows in others.items()}
        times = {key: time for key, time in times.items() if time is not None}
        best = min(times, key=times.__getitem__, default=None)
        own = time_at(mine, level, error)
        found.append({
            "level": level, "ours": own, "peer": best and best[0], "program": best and best[1],
            "peer_time": times.get(best), "ratio": times[best] / own if best and own else None,
        })  # fmt: skip
    return found
