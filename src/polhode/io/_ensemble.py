"""The [ensemble] of a scene file: any number of bodies, streamed into a store."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polhode.io import _unit
from polhode.io._specification import Draw, EnsemblePlan, InitialState, Kept, Part
from polhode.io._table import Table

QUANTITIES = ("moments", "euler", "attitude", "omega_body", "momentum_body", "torque")
ROWS = {"moments": 3, "wxyz": 4, "omega_body": 3, "momentum_body": 3, "torque": 3}
STATISTICS = ("rate", "tilt", "energy", "momentum")


def read_ensemble(
    top: Table, inertia: str, state: InitialState, torques: Sequence[Part]
) -> EnsemblePlan | None:
    """The plan, checked against the rest of the scene; None without the table."""
    if "ensemble" not in top:
        return None
    table = top.table(
        "ensemble",
        ("bodies", "seed", "trajectories", "statistics", "source", "arrays", *QUANTITIES),
    )
    if "monte_carlo" in top:
        raise top.wrong(
            "ensemble", "two batches", "[monte_carlo] and [ensemble]", "one of them",
            "keep [monte_carlo] for a file with a figure, [ensemble] for a store of any size",
        )  # fmt: skip
    needs = {
        "moments": (inertia == "moments", "only for an [inertia] given by its moments"),
        "euler": (state.attitude.sequence is not None, "only for a [state] given by Euler angles"),
        "omega_body": (state.rate == "omega_body", "only for a [state] with omega_body"),
        "momentum_body": (state.rate == "momentum_body", "only for a [state] with momentum_body"),
        "torque": (
            len(torques) == 1 and torques[0].kind in ("body", "space"),
            "only for a scene with one [torque] of kind body or space",
        ),
    }
    for name in QUANTITIES:
        fits, expected = needs.get(name, (True, ""))
        if name in table and not fits:
            raise table.wrong(name, "does not fit this scene", table.data[name], expected)
    table.text("source", "")
    trajectories = table.flag("trajectories", True)
    kept = tuple(_kept(top, row, k) for k, row in enumerate(table.rows("statistics")))
    if not trajectories and not kept:
        raise table.wrong(
            "trajectories", "nothing would be kept", False, "true, or [[ensemble.statistics]]"
        )
    names = [k.quantity for k in kept]
    if len(set(names)) < len(names):
        raise table.wrong("statistics", "a quantity named twice", names, "each quantity once")
    bodies = table.integer("bodies", 1, 2**32 - 1)
    return EnsemblePlan(
        bodies,
        table.integer("seed", 0, 2**32 - 1),
        trajectories,
        tuple(_draw(table, name) for name in QUANTITIES if name in table),
        kept,
        _arrays(table, bodies, needs),
    )


_INSTEAD = {"wxyz": ("euler",), "momentum_body": ("momentum_body",)}
"""Spreads that hold a nominal value of their own, which arrays cannot take the place of."""


def _arrays(ensemble: Table, bodies: int, needs) -> dict[str, np.ndarray]:
    """[ensemble.arrays]: files of NumPy with a row for each body, left on the disk."""
    if "arrays" not in ensemble:
        return {}
    table = ensemble.table("arrays", tuple(ROWS))
    found = {}
    for name in (n for n in ROWS if n in table):
        fits, expected = needs.get(name, (True, ""))
        if not fits:
            raise table.wrong(name, "does not fit this scene", table.data[name], expected)
        clash = [n for n in _INSTEAD.get(name, ()) if n in ensemble]
        if name == "wxyz" and "any" in ensemble.data.get("attitude", {}):
            clash.append("attitude")
        if clash:
            raise table.wrong(
                name, "given twice", f"{name} in arrays and [ensemble.{clash[0]}]", "one of them"
            )
        written = table.text(name)
        wanted = f"a file of NumPy (.npy) with {bodies} x {ROWS[name]} numbers"
        try:
            rows = np.load(Path(table.file).parent / written, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise table.wrong(name, f"cannot be read: {error}", written, wanted) from error
        shape = getattr(rows, "shape", None)
        if shape != (bodies, ROWS[name]) or rows.dtype.kind not in "fiu":
            kind = getattr(rows, "dtype", type(rows).__name__)
            raise table.wrong(name, "wrong shape or type", f"{written}: {shape} of {kind}", wanted)
        bad = _first_bad(name, rows)
        if bad is not None:
            raise table.wrong(
                name, "impossible numbers", f"row {bad}: {rows[bad].tolist()}", _POSSIBLE[name]
            )
        found[name] = rows
    return found


_POSSIBLE = dict.fromkeys(ROWS, "finite numbers") | {
    "moments": "positive moments of which none exceeds the sum of the others",
    "wxyz": "finite numbers, not all 0",
}


def _first_bad(name: str, rows: np.ndarray, step: int = 2**20) -> int | None:
    """The first row that no body can have, read bit by bit."""
    for start in range(0, len(rows), step):
        part = np.asarray(rows[start : start + step], np.float64)
        good = np.isfinite(part).all(axis=1)
        if name == "moments":
            good &= (part.min(axis=1) > 0) & (2 * part.max(axis=1) <= part.sum(axis=1))
        elif name == "wxyz":
            good &= part.any(axis=1)
        if not good.all():
            return start + int(np.argmin(good))
    return None


def _draw(ensemble: Table, name: str) -> Draw:
    lead = "relative_" if name == "moments" else ""
    sizes = (f"{lead}sigma", f"{lead}half_width") + (("any",) if name == "attitude" else ())
    units = {} if name == "moments" else _UNITS[name]
    table = ensemble.table(name, (*sizes, "source", *(("unit",) if units else ())))
    table.text("source", "")
    size = table.one_of(*sizes)
    if size == "any":
        if not table.flag("any", True):
            raise table.wrong("any", "not used", False, "true, or sigma, or half_width")
        return Draw(name, None, True)
    scale = table.array(size, (3,), scalar=True)
    if scale.min() < 0 or not scale.any():
        raise table.wrong(size, "not a spread", table.data[size], "none negative, not all 0")
    if units:
        scale = scale * units[table.choice("unit", tuple(units), next(iter(units)))]
    return Draw(name, scale, size.endswith("half_width"))


_UNITS = {
    "euler": _unit.ANGLES,
    "attitude": _unit.ANGLES,
    "omega_body": _unit.ANGULAR_RATES,
    "momentum_body": {"kg m^2/s": 1.0},
    "torque": {"N m": 1.0},
}


def _kept(top: Table, row: object, index: int) -> Kept:
    table = Table(
        top.file, f"ensemble.statistics {index + 1}", row, ("quantity", "low", "high", "bins")
    )
    quantity = table.choice("quantity", STATISTICS)
    if ("low" in table) != ("high" in table):
        raise table.wrong("", "half a range", row, "both low and high, or neither")
    low, high = table.number("low", None), table.number("high", None)
    if low is not None and low >= high:
        raise table.wrong("high", "not above low", high, f"a number above {low}")
    return Kept(quantity, low, high, table.integer("bins", 1, 100_000, 100))
