"""From the checked model of a scene file to SI numbers: a `SceneFile`."""

from pathlib import Path
from typing import Any

import numpy as np

from polhode.io import _unit
from polhode.io._arrays import read_arrays
from polhode.io._batches import QUANTITIES, Ensemble, MonteCarlo as MonteCarloTable
from polhode.io._bodies import Euler, Inertia, State
from polhode.io._error import SceneFileError, shorten, visible
from polhode.io._models import SceneText, Times as TimesTable
from polhode.io._specification import (
    Attitudes,
    Draw,
    EnsemblePlan,
    InitialState,
    MonteCarlo,
    Observations,
    Part,
    PublishedValue,
    SceneFile,
    Spread,
    Times,
)

_FACTORS = _unit.ANGLES | _unit.ANGULAR_RATES | {"kg m^2/s": 1.0, "N m": 1.0}


def in_si(checked: SceneText, text: str, path: Path) -> SceneFile:
    """The scene in SI units, with the text it was read from; reads [ensemble.arrays]."""
    plan = checked.ensemble
    return SceneFile(
        path=path,
        text=text,
        title=visible(path.stem) if checked.title is None else checked.title,
        source=checked.source,
        epoch=checked.epoch,
        frame=checked.frame,
        axis_names=checked.axis_names,
        inertia=_inertia(checked.inertia),
        relative_moments=checked.inertia.unit == "relative",
        state=_state(checked.state),
        times=_times(checked.times, path),
        potentials=_parts(checked.potential, "potential"),
        torques=_parts(checked.torque, "torque"),
        rotors=_parts(checked.rotors, "rotors"),
        method=checked.method,
        monte_carlo=None if checked.monte_carlo is None else _monte_carlo(checked.monte_carlo),
        published=tuple(_published(checked)),
        observations=_observations(checked, path),
        output=checked.output,
        ensemble=None if plan is None else _ensemble(plan, path),
    )


def _inertia(table: Inertia) -> Part:
    factor = _unit.MOMENTS[table.unit or "kg m^2"]
    kind, value = next(pair for pair in table.given() if pair[0] != "unit")
    values: dict[str, Any] = {kind: value}
    if kind == "parts":
        solids = (_solid(solid, k) for k, solid in enumerate(value))
        values = {"parts": tuple(solids)}
    elif kind == "axisymmetric":
        values = {name: number * factor for name, number in value}
    else:
        values = {kind: np.array(value) * factor}
    return Part(kind, values, f"[inertia] {kind}")


def _solid(solid: Any, index: int) -> tuple[Part, dict[str, Any]]:
    values = {name: np.array(value) for name, value in solid.given()
              if name not in ("shape", "centre", "euler")}  # fmt: skip
    place = {"centre": solid.centre, "euler": None if solid.euler is None else _euler(solid.euler)}
    return Part(solid.shape, values, f"[inertia.parts {index + 1}]"), place


def _euler(table: Euler) -> Attitudes:
    return Attitudes(np.array(table.angles) * _unit.ANGLES[table.unit], table.sequence)


def _state(table: State) -> InitialState:
    attitude = Attitudes(np.array(table.wxyz or [1.0, 0.0, 0.0, 0.0]))
    if table.euler is not None:
        attitude = _euler(table.euler)
    rate = "momentum_body" if table.omega_body is None else "omega_body"
    given: Any = table.momentum_body if table.omega_body is None else table.omega_body
    return InitialState(attitude, rate, np.array(given.value) * _FACTORS[given.unit])


def _times(table: TimesTable, path: Path) -> Times:
    factor = _unit.SECONDS[table.unit]
    if table.values is not None:
        values = np.array(table.values)
    else:
        assert table.stop is not None  # the model asks for both
        assert table.number is not None
        values = np.linspace(table.start, table.stop, table.number)
    with np.errstate(over="ignore"):
        seconds = values * factor
    if not np.isfinite(seconds).all():
        raise SceneFileError(path, "[times] unit", "times beyond what numbers hold", table.unit,
                             "times of less than 1e308 s")  # fmt: skip
    return Times(seconds, table.unit, factor)


def _parts(tables: list, key: str) -> tuple[Part, ...]:
    parts = []
    for index, table in enumerate(tables):
        values = {name: np.array(value) for name, value in table.given() if name != "kind"}
        where = f"[{key}]" if len(tables) == 1 else f"[{key} {index + 1}]"
        parts.append(Part(getattr(table, "kind", "rotor"), values, where))
    return tuple(parts)


def _monte_carlo(table: MonteCarloTable) -> MonteCarlo:
    spreads = []
    for name in QUANTITIES:
        spread: Any = getattr(table, name)
        if spread is not None:
            sigma = spread.relative_sigma if name == "moments" else spread.sigma
            factor = _FACTORS[getattr(spread, "unit", "rad")]
            spreads.append(Spread(name, np.array(sigma) * factor, spread.source))
    return MonteCarlo(table.clones, table.seed, tuple(spreads))


def _published(checked: SceneText):
    for row in checked.published:
        factor = _unit.SECONDS[row.unit]
        width = None if row.uncertainty is None else row.uncertainty * factor
        yield PublishedValue(row.name, row.value * factor, width, row.source)


def _observations(checked: SceneText, path: Path) -> Observations | None:
    table = checked.observations
    if table is None:
        return None
    angle, rate = _unit.ANGLES[table.angle_unit], _unit.ANGULAR_RATES[table.rate_unit]
    second = _unit.SECONDS[table.time_unit]
    by_angles = any(row.angles is not None for row in table.rows)
    seconds, attitudes, omega = [], [], []
    for row in table.rows:
        if row.utc is not None and checked.epoch is not None:
            seconds.append((row.utc - checked.epoch).total_seconds())
        else:
            seconds.append((row.time or 0.0) * second)
        seen = np.full(3 if by_angles else 4, np.nan)
        if row.angles is not None or row.wxyz is not None:
            seen = np.array(row.angles) * angle if by_angles else np.array(row.wxyz)
        attitudes.append(seen)
        omega.append(np.full(3, np.nan) if row.omega_body is None else np.array(row.omega_body))
    if not np.isfinite(seconds).all() or np.any(np.diff(seconds) <= 0):
        late = int(np.argmax(np.diff(seconds) <= 0)) + 2
        raise SceneFileError(
            path, "[observations] rows", f"unsorted or repeated times (row {late})",
            shorten(dict(table.rows[late - 1].given())), "rows in the order of time",
            "sort the rows",
        )  # fmt: skip
    return Observations(
        np.array(seconds),
        Attitudes(np.array(attitudes), table.sequence if by_angles else None),
        np.array(omega) * rate,
        table.source,
    )


def _ensemble(table: Ensemble, path: Path) -> EnsemblePlan:
    draws = []
    for name in (*QUANTITIES, "torque"):
        draw: Any = getattr(table, name)
        if draw is None:
            continue
        if getattr(draw, "any", None):
            draws.append(Draw(name, None, True))
            continue
        lead = "relative_" if name == "moments" else ""
        sigma, half = getattr(draw, f"{lead}sigma"), getattr(draw, f"{lead}half_width")
        factor = _FACTORS[getattr(draw, "unit", "rad")]
        draws.append(Draw(name, np.array(half if sigma is None else sigma) * factor, sigma is None))
    rows = {} if table.arrays is None else dict(table.arrays.given())
    return EnsemblePlan(
        table.bodies, table.seed, table.trajectories, tuple(draws), tuple(table.statistics),
        read_arrays(rows, table.bodies, path),
    )  # fmt: skip
