"""The scene file's schema (docs/scene_files.md): from TOML to a checked `SceneFile`."""

import datetime
import os
import tomllib
from pathlib import Path

import numpy as np

from polhode.io import _unit
from polhode.io._ensemble import read_ensemble
from polhode.io._error import SceneFileError, shorten
from polhode.io._parts import read_euler, read_inertia, read_parts, read_sequence
from polhode.io._specification import (
    Attitudes,
    InitialState,
    Method,
    MonteCarlo,
    Observations,
    Output,
    PublishedValue,
    SceneFile,
    Spread,
    Times,
)
from polhode.io._table import Table

TOP = (
    "title", "source", "epoch", "frame", "axis_names", "inertia", "state", "times", "potential",
    "torque", "rotors", "method", "monte_carlo", "published", "observations", "output",
    "ensemble",
)  # fmt: skip
METHODS = ("auto", "closed-form", "lie-poisson", "euler-angles")
QUANTITIES = ("moments", "euler", "attitude", "omega_body", "momentum_body")
MOST_SAMPLES = 10_000_000


def read_scene(path: str | os.PathLike) -> SceneFile:
    """Read and check a scene file (TOML, docs/scene_files.md).

    Raises SceneFileError for a file that cannot be read, is not TOML, or breaks the schema: an
    unknown or missing key, a wrong type, shape or unit, a number that is not finite.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise SceneFileError(path, "", f"not a text file ({error})", expected="UTF-8") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise SceneFileError(
            path, "", f"cannot be read: {reason}", mend="check the path and its permissions"
        ) from None
    return parse_scene(text, path)


def parse_scene(text: str, path: str | os.PathLike = "<text>") -> SceneFile:
    """`read_scene` of a text; `path` is the name used in messages."""
    path = Path(path)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneFileError(
            path, "", f"not valid TOML: {error}", mend="see https://toml.io for the syntax"
        ) from None
    top = Table(path, "", data, TOP)
    epoch = _epoch(top)
    inertia, relative = read_inertia(top)
    state = _state(top)
    times = _times(top)
    torques = read_parts(top, "torque")
    return SceneFile(
        path=path,
        title=top.text("title", path.stem),
        source=top.text("source", ""),
        epoch=epoch,
        frame=top.text("frame", "an inertial frame"),
        axis_names=_axis_names(top),
        inertia=inertia,
        relative_moments=relative,
        state=state,
        times=times,
        potentials=read_parts(top, "potential"),
        torques=torques,
        rotors=read_parts(top, "rotors"),
        method=_method(top),
        monte_carlo=_monte_carlo(top, inertia.kind, state),
        published=tuple(_published(top)),
        observations=_observations(top, epoch),
        output=_output(top),
        ensemble=read_ensemble(top, inertia.kind, state, torques),
    )


def _utc(value: datetime.datetime) -> datetime.datetime:
    return value.replace(tzinfo=datetime.UTC) if value.tzinfo is None else value


def _moment(table: Table, key: str) -> datetime.datetime:
    expected = "a date and time such as 1992-11-09T17:49:47Z, without quotation marks"
    value = table.raw(key, expected)
    if not isinstance(value, datetime.datetime):
        raise table.wrong(key, "not a date with a time", value, expected)
    return _utc(value)


def _epoch(top: Table) -> datetime.datetime | None:
    return _moment(top, "epoch") if "epoch" in top else None


def _axis_names(top: Table) -> tuple[str, str, str]:
    names = top.raw("axis_names", "three texts", ["x", "y", "z"])
    if not isinstance(names, list) or len(names) != 3 or not all(isinstance(n, str) for n in names):
        raise top.wrong("axis_names", "not three texts", names, 'three texts, e.g. ["x", "y", "z"]')
    return tuple(names)


def _state(top: Table) -> InitialState:
    table = top.table("state", ("wxyz", "euler", "omega_body", "momentum_body"))
    attitude = Attitudes(np.array([1.0, 0.0, 0.0, 0.0]))
    if "wxyz" in table or "euler" in table:
        if table.one_of("wxyz", "euler") == "wxyz":
            attitude = Attitudes(_quaternion(table))
        else:
            attitude = read_euler(table)
    rate = table.one_of("omega_body", "momentum_body")
    units = _unit.ANGULAR_RATES if rate == "omega_body" else {"kg m^2/s": 1.0}
    return InitialState(attitude, rate, table.quantity(rate, (3,), units)[0])


def _quaternion(table: Table) -> np.ndarray:
    value = table.array("wxyz", (4,))
    if not value.any():
        raise table.wrong("wxyz", "zero quaternion", value.tolist(), "four numbers, not all zero")
    return value


def _times(top: Table) -> Times:
    table = top.table("times", ("start", "stop", "number", "values", "unit"))
    unit = table.choice("unit", tuple(_unit.SECONDS), "s")
    factor = _unit.SECONDS[unit]
    if "values" in table:
        table.one_of("values", "stop")
        for key in ("start", "number"):
            if key in table:
                table.one_of("values", key)
        values = table.vectors("values", "two or more times, strictly increasing or decreasing")
        steps = np.diff(values)
        if len(values) < 2 or not (np.all(steps > 0) or np.all(steps < 0)):
            wrong = 0 if len(values) < 2 else _first_unsorted(steps)
            raise table.wrong(
                "values",
                f"unsorted, repeated or too few times (entry {wrong + 1})",
                values.tolist(),
                "two or more times, strictly increasing or strictly decreasing",
                "sort them and remove repeated ones",
            )
        return Times(values * factor, unit, factor)
    start, stop = table.number("start", 0.0), table.number("stop")
    number = table.integer("number", 2, MOST_SAMPLES)
    values = np.linspace(start, stop, number)
    if start == stop or not np.all(np.diff(values) != 0):
        raise table.wrong("stop", "no time passes", stop, f"a number other than start = {start}")
    return Times(values * factor, unit, factor)


def _first_unsorted(steps: np.ndarray) -> int:
    direction = np.sign(steps[0]) or 1.0
    return int(np.argmax(steps * direction <= 0)) + 1


def _method(top: Table) -> Method:
    if "method" not in top:
        return Method("auto", None, None, None)
    table = top.table("method", ("kind", "solver", "rtol", "step"))
    kind = table.choice("kind", METHODS, "auto")
    solver = table.text("solver", None)
    if solver is not None and kind in ("auto", "closed-form"):
        raise table.wrong(
            "solver", f"not used by kind = {kind!r}", solver, "a method that steps",
            'set kind = "lie-poisson" or "euler-angles", or remove the solver',
        )  # fmt: skip
    step = table.number("step", None, positive=True)
    if step is not None and solver is None:
        raise table.wrong("step", "a step without a solver", step, "a solver that takes this step")
    rtol = table.number("rtol", None, positive=True)
    if rtol is not None and rtol >= 1:
        raise table.wrong("rtol", "too large a relative tolerance", rtol, "a number below 1")
    return Method(kind, solver, rtol, step)


def _monte_carlo(top: Table, inertia: str, state: InitialState) -> MonteCarlo | None:
    if "monte_carlo" not in top:
        return None
    table = top.table("monte_carlo", ("clones", "seed", *QUANTITIES))
    spreads = [_spread(table, name) for name in QUANTITIES if name in table]
    if not spreads:
        table.one_of(*QUANTITIES)
    needs = {
        "moments": (inertia == "moments", "only for an [inertia] given by its moments"),
        "euler": (state.attitude.sequence is not None, "only for a [state] given by Euler angles"),
        "omega_body": (state.rate == "omega_body", "only for a [state] with omega_body"),
        "momentum_body": (state.rate == "momentum_body", "only for a [state] with momentum_body"),
    }
    for spread in spreads:
        fits, expected = needs.get(spread.quantity, (True, ""))
        if not fits:
            given = table.data[spread.quantity]
            raise table.wrong(spread.quantity, "does not fit this scene", given, expected)
    clones = table.integer("clones", 1, 10_000_000)
    return MonteCarlo(clones, table.integer("seed", 0, 2**63 - 1), tuple(spreads))


def _spread(monte_carlo: Table, name: str) -> Spread:
    relative = name == "moments"
    size = "relative_sigma" if relative else "sigma"
    table = monte_carlo.table(name, (size, "source") + (() if relative else ("unit",)))
    sigma = table.array(size, (3,), scalar=True)
    if sigma.min() < 0 or not sigma.any():
        raise table.wrong(
            size, "not a spread", table.data[size], "standard deviations, none negative, not all 0"
        )
    if not relative:
        rates = _unit.ANGULAR_RATES if name == "omega_body" else {"kg m^2/s": 1.0}
        units = _unit.ANGLES if name in ("euler", "attitude") else rates
        sigma = sigma * units[table.choice("unit", tuple(units), next(iter(units)))]
    return Spread(name, sigma, table.text("source"))


def _published(top: Table):
    names = ("P_psi", "P_phi")
    for index, row in enumerate(top.rows("published")):
        where = f"published {index + 1}"
        table = Table(top.file, where, row, ("name", "value", "uncertainty", "unit", "source"))
        factor = _unit.SECONDS[table.choice("unit", tuple(_unit.SECONDS), "s")]
        width = table.number("uncertainty", None, positive=True)
        yield PublishedValue(
            table.choice("name", names),
            table.number("value") * factor,
            None if width is None else width * factor,
            table.text("source"),
        )


def _observations(top: Table, epoch: datetime.datetime | None) -> Observations | None:
    if "observations" not in top:
        return None
    head = ("source", "sequence", "angle_unit", "rate_unit", "time_unit", "rows")
    table = top.table("observations", head)
    sequence = read_sequence(table, "zyz")
    angle = _unit.ANGLES[table.choice("angle_unit", tuple(_unit.ANGLES), "rad")]
    rate = _unit.ANGULAR_RATES[table.choice("rate_unit", tuple(_unit.ANGULAR_RATES), "rad/s")]
    second = _unit.SECONDS[table.choice("time_unit", tuple(_unit.SECONDS), "s")]
    rows = table.rows("rows")
    if not rows:
        raise table.wrong("rows", "no observation", rows, "one or more rows { time = .., ... }")
    seconds, attitudes, omega = [], [], []
    kind = "angles" if any("angles" in row for row in rows) else "wxyz"
    for index, data in enumerate(rows):
        row = Table(
            top.file, f"observations row {index + 1}", data,
            ("utc", "time", "angles", "wxyz", "omega_body"),
        )  # fmt: skip
        if row.one_of("utc", "time") == "utc":
            if epoch is None:
                raise SceneFileError(
                    top.file, "epoch", "missing key", f"utc = {shorten(data['utc'])} in a row",
                    "the epoch that utc is counted from", "add `epoch = 1992-11-09T17:49:47Z`",
                )  # fmt: skip
            seconds.append((_moment(row, "utc") - epoch).total_seconds())
        else:
            seconds.append(row.number("time") * second)
        if kind == "angles" and "wxyz" in row:
            raise row.wrong("wxyz", "mixed kinds of attitude", data, "angles in every row, or wxyz")
        if kind not in row and "omega_body" not in row:
            row.one_of(kind, "omega_body")
        if kind not in row:
            attitudes.append([np.nan] * (3 if kind == "angles" else 4))
        else:
            attitudes.append(_quaternion(row) if kind == "wxyz" else row.array(kind, (3,)) * angle)
        rates = row.array("omega_body", (3,)) * rate if "omega_body" in row else [np.nan] * 3
        omega.append(rates)
    if np.any(np.diff(seconds) <= 0):
        late = int(np.argmax(np.diff(seconds) <= 0)) + 2
        raise table.wrong(
            "rows", f"unsorted or repeated times (row {late})", rows[late - 1],
            "rows in the order of time", "sort the rows",
        )  # fmt: skip
    return Observations(
        np.array(seconds),
        Attitudes(np.array(attitudes), sequence if kind == "angles" else None),
        np.array(omega),
        table.text("source", ""),
    )


def _output(top: Table) -> Output:
    if "output" not in top:
        return Output(None, True)
    table = top.table("output", ("file", "figure"))
    return Output(table.text("file", None), table.flag("figure", True))
