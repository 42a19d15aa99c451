"""The schema of scene files: one pydantic model per table. `polhode schema` prints it as JSON.

Numbers are in SI units after validation. The module imports neither NumPy nor JAX, so that mistakes
in a file are reported quickly; properties that return arrays import NumPy when they are called.
"""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, PrivateAttr, model_validator

from polhode.files import _values
from polhode.files._tables import (
    Attitudes,
    Clusters,
    ConstantTorque,
    Event,
    Inertia,
    Orbit,
    Potentials,
    Rotors,
    State,
    Torques,
)
from polhode.files._values import (
    MAX_SAMPLES,
    BelowFolder,
    Date,
    Measured,
    Number,
    Positive,
    Quaternion,
    Sequence,
    Spread,
    Table,
    TimeTable,
    Vector,
    check_columns,
    scale,
)

if TYPE_CHECKING:
    import numpy as np


class Times(Table):
    """`stop` and `number` or `step` of equidistant samples from `start`, or `values`."""

    start: Number | None = Field(None, description="0 if left out")
    stop: Number | None = None
    number: Annotated[int, Field(ge=2, le=MAX_SAMPLES)] | None = None
    step: Positive | None = Field(None, description="between samples, instead of their number")
    values: _values.Times | None = None
    unit: _values.Seconds = "s"

    @model_validator(mode="after")
    def _values_or_span(self) -> "Times":
        others = [key for key in dict(self.entries()) if key in ("start", "stop", "number", "step")]
        if self.values is not None:
            if others:
                raise ValueError(f"exactly one of values, {others[0]} is needed, got both")
            ends = [self.values[0], self.values[-1]]
        else:
            if self.stop is None:
                raise ValueError("stop is missing: add `stop = ...`, or values")
            if (self.number is None) == (self.step is None):
                found = "none of them: add `number = ...`"
                found = found if self.step is None else "both: remove one of them"
                raise ValueError(f"exactly one of number, step is needed, got {found}")
            ends = [self.first, self.stop]
            span = self.stop - self.first
            if self.step is not None and not 1 <= abs(span / self.step) <= MAX_SAMPLES - 1:
                raise ValueError(f"step must give 2 to {MAX_SAMPLES} samples, got {self.step}")
            if not math.isfinite(span):
                raise ValueError("the times are beyond what numbers hold")
            step = span / (self.samples - 1)
            if step == 0 or ends[0] + step == ends[0] or ends[1] - step == ends[1]:
                raise ValueError(
                    f"stop must be other than start = {self.first}, far enough for the samples"
                )
        if not all(math.isfinite(end * self.unit_seconds) for end in ends):
            raise ValueError("the times are beyond what numbers hold: less than 1e308 s")
        return self

    @property
    def first(self) -> float:
        """The first time, in the unit: `start`, or 0, or the first of `values`."""
        if self.values is not None:
            return self.values[0]
        return 0.0 if self.start is None else self.start

    @property
    def samples(self) -> int:
        """The number of equidistant samples."""
        if self.number is not None:
            return self.number
        assert self.stop is not None
        assert self.step is not None
        # the factor keeps the last sample at stop if rounding makes the quotient a little smaller
        return math.floor(abs(self.stop - self.first) / self.step * (1 + 1e-12)) + 1

    @property
    def unit_seconds(self) -> float:
        """The unit of these times, which tables and figures use as well, in s."""
        return _values.SECONDS[self.unit]

    @property
    def seconds(self) -> "np.ndarray":
        """Sample times, s."""
        import numpy as np

        if self.values is not None:
            return np.array(self.values) * self.unit_seconds
        return np.linspace(self.first, self.last, self.samples) * self.unit_seconds

    @property
    def last(self) -> float:
        """The last time, in the unit."""
        if self.values is not None:
            return self.values[-1]
        assert self.stop is not None  # the model requires it
        if self.step is None:
            return self.stop
        return self.first + math.copysign(self.step, self.stop - self.first) * (self.samples - 1)


class Method(Table):
    kind: Literal["auto", "closed-form", "lie-poisson", "euler-angles"] = "auto"
    solver: str | None = Field(default=None, description="a solver of diffrax or polhode")
    rtol: Annotated[float, Field(gt=0, lt=1)] | None = None
    step: Positive | None = Field(default=None, description="constant step [s]")

    @model_validator(mode="after")
    def _options_of_kind(self) -> "Method":
        if self.solver is not None and self.kind in ("auto", "closed-form"):
            raise ValueError(
                f"solver is not used by kind = {self.kind!r}: set kind = 'lie-poisson' or"
                " 'euler-angles', or remove the solver"
            )
        if self.step is not None and self.solver is None:
            raise ValueError("step needs a solver: add `solver = ...`, or remove the step")
        return self


class Published(Measured):
    measures = ("value", "uncertainty")
    name: Literal["P_psi", "P_phi"]
    value: Number
    uncertainty: Positive | None = None
    unit: _values.Seconds = "s"
    source: str


class Observation(Table):
    one_of = (("utc", "time"),)
    utc: Date | None = None
    time: Number | None = None
    angles: Vector | None = None
    wxyz: Quaternion | None = None
    omega_body: Vector | None = None

    @model_validator(mode="after")
    def _observed(self) -> "Observation":
        if self.angles is None and self.wxyz is None and self.omega_body is None:
            raise ValueError("angles or wxyz, omega_body, or both are needed")
        return self


class Observations(Table):
    """Attitudes and body rates that were observed."""

    source: str = ""
    sequence: Sequence = "ZYZ"
    angle_unit: _values.Angle = "rad"
    rate_unit: _values.Rate = "rad/s"
    time_unit: _values.Seconds = "s"
    rows: list[Observation] = Field(
        min_length=1, max_length=1_000_000, description="one or more rows { time = .., .. }"
    )

    @model_validator(mode="after")
    def _one_kind(self) -> "Observations":
        if any(row.angles is not None for row in self.rows):
            for index, row in enumerate(self.rows):
                if row.wxyz is not None:
                    raise ValueError(
                        f"mixed kinds of attitude: angles in every row, or wxyz in every row (row"
                        f" {index + 1} has wxyz)"
                    )
        return self

    @model_validator(mode="after")
    def _in_si(self) -> "Observations":
        units = {"time": self.time_unit, "angles": self.angle_unit, "omega_body": self.rate_unit}
        rows = []
        for row in self.rows:
            numbers = ((name, value) for name, value in row.entries() if name in units)
            numbers = {name: scale(value, _values.SI[units[name]]) for name, value in numbers}
            rows.append(row.model_copy(update=numbers))
        return self.model_copy(update={"rows": rows})

    @property
    def seconds(self) -> "np.ndarray":
        """Times of the rows (n,), s."""
        import numpy as np

        return np.array([row.time for row in self.rows])

    @property
    def attitudes(self) -> Attitudes:
        """Attitudes of the rows, NaN where a row has none."""
        if any(row.angles is not None for row in self.rows):
            return Attitudes(_columns([row.angles for row in self.rows], 3), self.sequence)
        return Attitudes(_columns([row.wxyz for row in self.rows], 4))

    @property
    def omega_body(self) -> "np.ndarray":
        """Body rates of the rows (n, 3), rad/s, NaN where a row has none."""
        return _columns([row.omega_body for row in self.rows], 3)


def _columns(rows: list[list[float] | None], width: int) -> "np.ndarray":
    import numpy as np

    return np.array([[math.nan] * width if row is None else row for row in rows])


class Output(Table):
    file: BelowFolder | None = None
    figure: bool = True


def _tables_of(place: str, table: Table) -> Iterator[tuple[str, TimeTable]]:
    for name, value in table.entries():
        if isinstance(value, TimeTable):
            yield f"[{place}.{name}]", value


QUANTITIES = ("moments", "euler", "attitude", "omega_body", "momentum_body", "torque")


class Spreads(Table):
    """Quantities that are drawn at random around the nominal ones."""

    @property
    def spreads(self) -> dict[str, Any]:
        """The quantities that are drawn, with their tables."""
        return {name: table for name, table in self.entries() if name in QUANTITIES}


class MomentsSigma(Table):
    relative_sigma: Spread
    source: str

    @property
    def sigma(self) -> list[float]:
        return self.relative_sigma


class Sigma(Measured):
    measures = ("sigma",)
    sigma: Spread
    source: str


class AngleSigma(Sigma):
    unit: _values.Angle = "rad"


class RatesSigma(Sigma):
    unit: _values.Rate = "rad/s"


class MomentumSigma(Sigma):
    unit: _values.Momentum = "kg m^2/s"


class MonteCarlo(Spreads):
    """Clones around the nominal body, each quantity drawn from a normal distribution."""

    clones: Annotated[int, Field(ge=1, le=_values.MAX_CLONES)]
    seed: Annotated[int, Field(ge=0, le=_values.MAX_SEED)]
    moments: MomentsSigma | None = None
    euler: AngleSigma | None = None
    attitude: AngleSigma | None = None
    omega_body: RatesSigma | None = None
    momentum_body: MomentumSigma | None = None

    @model_validator(mode="after")
    def _one_or_more(self) -> "MonteCarlo":
        if not self.spreads:
            raise ValueError(
                f"one or more of {', '.join(QUANTITIES[:-1])} are needed: add for example"
                " `moments = { relative_sigma = ..., source = .. }`"
            )
        return self


class MomentsDraw(Table):
    one_of = (("relative_sigma", "relative_half_width"),)
    relative_sigma: Spread | None = None
    relative_half_width: Spread | None = None
    source: str = ""

    @property
    def sigma(self) -> list[float] | None:
        return self.relative_sigma

    @property
    def half_width(self) -> list[float] | None:
        return self.relative_half_width


class Draw(Measured):
    """`sigma`: normal; `half_width`: uniform."""

    measures = ("sigma", "half_width")
    one_of = (("sigma", "half_width"),)
    sigma: Spread | None = None
    half_width: Spread | None = None
    source: str = ""


class AngleDraw(Draw):
    unit: _values.Angle = "rad"


class AttitudeDraw(AngleDraw):
    one_of = (("sigma", "half_width", "any"),)
    any: Literal[True] | None = Field(None, description="true: all attitudes equally probable")


class RatesDraw(Draw):
    unit: _values.Rate = "rad/s"


class MomentumDraw(Draw):
    unit: _values.Momentum = "kg m^2/s"


class TorqueDraw(Draw):
    unit: Literal["N m"] = "N m"


class Arrays(Table):
    """NumPy files (.npy) in the scene's folder or below, with one row per body, in SI units."""

    moments: BelowFolder | None = None
    wxyz: BelowFolder | None = None
    omega_body: BelowFolder | None = None
    momentum_body: BelowFolder | None = None
    torque: BelowFolder | None = None


class Statistic(Table):
    quantity: Literal["rate", "tilt", "energy", "momentum"]
    low: Number | None = None
    high: Number | None = None
    bins: Annotated[int, Field(ge=1, le=100_000)] = 100

    @model_validator(mode="after")
    def _range(self) -> "Statistic":
        if (self.low is None) != (self.high is None):
            raise ValueError("a range has both low and high, or neither")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"high must be above low = {self.low}, got {self.high}")
        return self


class Ensemble(Spreads):
    """Any number of bodies, computed into a Zarr store."""

    bodies: Annotated[int, Field(ge=1, le=2**32 - 1)]
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)]
    trajectories: bool = True
    statistics: Annotated[list[Statistic], Field(max_length=100)] = Field(default_factory=list)
    source: str = ""
    arrays: Arrays | None = None
    moments: MomentsDraw | None = None
    euler: AngleDraw | None = None
    attitude: AttitudeDraw | None = None
    omega_body: RatesDraw | None = None
    momentum_body: MomentumDraw | None = None
    torque: TorqueDraw | None = None

    @model_validator(mode="after")
    def _something_stored(self) -> "Ensemble":
        names = [s.quantity for s in self.statistics]
        if not self.trajectories and not names:
            raise ValueError(
                "nothing would be stored: set trajectories = true, or add [[ensemble.statistics]]"
            )
        if len(set(names)) < len(names):
            raise ValueError(f"statistics name a quantity twice: {', '.join(names)}")
        rows = self.arrays
        if rows is None:
            return self
        clashes = {
            "wxyz": self.euler is not None or (self.attitude is not None and self.attitude.any),
            "momentum_body": self.momentum_body is not None,
            "omega_body": rows.momentum_body is not None,
        }
        for name, clash in clashes.items():
            if clash and name in dict(rows.entries()):
                raise ValueError(
                    f"{name} is given twice: in arrays, and by a table or rows that replace it"
                )
        return self


class SceneFile(Table):
    """A scene of a rotating rigid body."""

    title: str = Field("", description="the name of the file if left out")
    source: str = Field("", description="where the numbers come from")
    epoch: Date | None = Field(None, description="of time 0")
    frame: str = Field("an inertial frame", description="name of the inertial frame")
    axis_names: Annotated[tuple[str, str, str], Field(strict=False)] = ("x", "y", "z")
    inertia: Inertia
    state: State
    times: Times
    orbit: Orbit | None = None
    potential: Potentials = Field(default_factory=list)
    torque: Torques = Field(default_factory=list)
    rotors: Rotors = Field(default_factory=list)
    clusters: Clusters = Field(default_factory=list)
    events: Annotated[list[Event], Field(max_length=20)] = Field(default_factory=list)
    method: Method = Method()
    monte_carlo: MonteCarlo | None = None
    published: Annotated[list[Published], Field(max_length=1000)] = Field(default_factory=list)
    observations: Observations | None = None
    output: Output = Output()
    ensemble: Ensemble | None = None

    _path: Path = PrivateAttr(Path("<text>"))
    _text: str = PrivateAttr("")
    _rows: "Mapping[str, np.ndarray]" = PrivateAttr(default_factory=dict)
    _columns: "Mapping[str, list[list[float]]]" = PrivateAttr(default_factory=dict)

    @property
    def path(self) -> Path:
        return self._path

    @property
    def text(self) -> str:
        """The text of the file."""
        return self._text

    @property
    def rows(self) -> "Mapping[str, np.ndarray]":
        """The arrays of [ensemble.arrays], memory-mapped."""
        return self._rows

    @property
    def tables(self) -> Iterator[tuple[str, TimeTable]]:
        """The tables over time, each with its place in the file."""
        yield from _tables_of("inertia", self.inertia)
        for index, torque in enumerate(self.torque):
            place = "torque" if len(self.torque) == 1 else f"torque {index + 1}"
            yield from _tables_of(place, torque)

    def columns(self, table: TimeTable) -> tuple[list[float], list[Any]]:
        """Times [s] and values of a table; those of a CSV file were read with the scene."""
        if table.file is None:
            assert table.times is not None
            assert table.values is not None
            times, values = table.times, table.values
        else:
            rows = self._columns[table.file]
            times = [row[0] for row in rows]
            values = [row[1] if len(row) == 2 else row[1:] for row in rows]
            check_columns(times, values, table.widths)
        return [t * table.unit_seconds for t in times], values

    @model_validator(mode="after")
    def _spreads_fit(self) -> "SceneFile":
        if self.monte_carlo is not None and self.ensemble is not None:
            raise ValueError(
                "[monte_carlo] and [ensemble] exclude each other: keep [monte_carlo] for a file"
                " with a figure, [ensemble] for a store of any size"
            )
        constant = len(self.torque) == 1 and all(
            isinstance(x, ConstantTorque) and isinstance(x.n, list) and not x.needs_orbit
            for x in self.torque
        )
        needs = {
            "moments": (self.inertia.moments, "an [inertia] given by its moments"),
            "euler": (self.state.euler, "a [state] given by Euler angles"),
            "omega_body": (self.state.omega_body, "a [state] with omega_body"),
            "momentum_body": (self.state.momentum_body, "a [state] with momentum_body"),
            "torque": (
                constant or None,
                "one [torque] of kind body or space, constant and inertial",
            ),
        }
        tables = {}
        if self.monte_carlo is not None:
            tables["monte_carlo"] = self.monte_carlo.spreads
        if self.ensemble is not None:
            tables["ensemble"] = self.ensemble.spreads
            if self.ensemble.arrays is not None:
                tables["ensemble.arrays"] = dict(self.ensemble.arrays.entries())
        for lead, quantities in tables.items():
            for name, (nominal, need) in needs.items():
                if nominal is None and name in quantities:
                    raise ValueError(f"[{lead}] {name} does not fit this scene: it needs {need}")
        return self

    @model_validator(mode="after")
    def _orbit_is_there(self) -> "SceneFile":
        for name, tables in (("potential", self.potential), ("torque", self.torque)):
            for index, table in enumerate(tables):
                if self.orbit is None and table.needs_orbit:
                    raise ValueError(f"[{name} {index + 1}] needs an [orbit]: add one")
        if self.state.frame == "lvlh":
            if self.orbit is None:
                raise ValueError('[state] frame = "lvlh" needs an [orbit]: add one')
            if self.monte_carlo is not None or self.ensemble is not None:
                raise ValueError(
                    '[state] frame = "lvlh" is that of one body: remove [monte_carlo] or [ensemble]'
                )
        if self.inertia.table is not None and self.ensemble is not None:
            raise ValueError(
                "[inertia] table is that of one body or of clones: remove the [ensemble]"
            )
        if self.ensemble is not None:
            unused = {
                "[[events]]": self.events,
                "[observations]": self.observations,
                "[[published]]": self.published,
            }
            for name, table in unused.items():
                if table:
                    raise ValueError(f"{name} has no use in an [ensemble]: remove one of them")
        names = [event.name for event in self.events]
        if len(set(names)) < len(names):
            raise ValueError(f"[[events]] have a name twice: {', '.join(names)}")
        return self

    @model_validator(mode="after")
    def _rows_since_epoch(self) -> "SceneFile":
        observations = self.observations
        if observations is None:
            return self
        rows, last = [], -math.inf
        for index, row in enumerate(observations.rows):
            time = row.time
            if row.utc is not None:
                if self.epoch is None:
                    raise ValueError(
                        "epoch is missing, which utc in the rows of [observations] is counted from:"
                        " add `epoch = 1992-11-09T17:49:47Z`"
                    )
                time = (row.utc - self.epoch).total_seconds()
            assert time is not None  # a row has either utc or time
            if not last < time < math.inf:
                raise ValueError(
                    "[observations] rows must be in the order of time: sort the rows (row"
                    f" {index + 1} is at {time} s after {last} s)"
                )
            rows.append(row.model_copy(update={"time": time}))
            last = time
        observations = observations.model_copy(update={"rows": rows})
        return self.model_copy(update={"observations": observations})
