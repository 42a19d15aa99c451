"""The [ensemble] of a scene file: any number of bodies, streamed into a store."""

from polhode.io import _unit
from polhode.io._specification import Draw, EnsemblePlan, InitialState, Kept
from polhode.io._table import Table

QUANTITIES = ("moments", "euler", "attitude", "omega_body", "momentum_body")
STATISTICS = ("rate", "tilt", "energy", "momentum")


def read_ensemble(top: Table, inertia: str, state: InitialState) -> EnsemblePlan | None:
    """The plan, checked against the rest of the scene; None without the table."""
    if "ensemble" not in top:
        return None
    table = top.table(
        "ensemble", ("bodies", "seed", "trajectories", "statistics", "source", *QUANTITIES)
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
    return EnsemblePlan(
        table.integer("bodies", 1, 2**32 - 1),
        table.integer("seed", 0, 2**32 - 1),
        trajectories,
        tuple(_draw(table, name) for name in QUANTITIES if name in table),
        kept,
    )


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
