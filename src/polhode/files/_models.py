"""What a scene file may say: one pydantic model a table. `polhode schema` prints their JSON Schema.

Numbers are in SI once a table is checked. Nothing here needs numpy or JAX, so that a mistake in a
file is told at once; what gives arrays imports numpy when it is asked.
"""

import datetime
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, PrivateAttr, model_validator

from polhode.files import _unit
from polhode.files._batches import Ensemble, MonteCarlo
from polhode.files._bodies import (
    Attitudes,
    ConstantTorque,
    Inertia,
    Potentials,
    Rotors,
    State,
    Torques,
)
from polhode.files._table import Angle, Measured, Rate, Seconds, Table, Text, Vector, Words, scaled
from polhode.files._values import (
    DATE,
    FLAG,
    NAMES,
    NUMBER,
    PATH,
    POSITIVE,
    SEQUENCE,
    TIMES,
    TOLERANCE,
    WXYZ,
    choice,
    whole,
    wrong,
)

if TYPE_CHECKING:
    import numpy as np

MOST_SAMPLES = 10_000_000
PERIODS = ("P_psi", "P_phi")


class Times(Table):
    """`stop` and `number` of equidistant samples from `start`, or `values`."""

    start: Annotated[float, NUMBER] = 0.0
    stop: Annotated[float, NUMBER] | None = None
    number: Annotated[int, whole(2, MOST_SAMPLES)] | None = None
    values: Annotated[list[float], TIMES] | None = None
    unit: Seconds = "s"

    @model_validator(mode="before")
    @classmethod
    def _one_way(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        both = [key for key in ("start", "stop", "number") if key in data]
        if "values" in data and both:
            raise wrong("too many choices", Words(f"values and {both[0]}"),
                        f"exactly one of values, {both[0]}", "keep one of them", "")  # fmt: skip
        for key, words in (("stop", NUMBER.expected), ("number", whole(2, MOST_SAMPLES).expected)):
            if "values" not in data and key not in data:
                have = Words(f"only {', '.join(map(str, data)) or 'nothing'}")
                raise wrong("missing key", have, words, f"add `{key} = ...`", key)
        return data

    @model_validator(mode="after")
    def _passes(self) -> "Times":
        if self.stop is not None and self.number is not None:
            step = (self.stop - self.start) / (self.number - 1)
            if step == 0 or self.start + step == self.start or self.stop - step == self.stop:
                expected = f"a number other than start = {self.start}, far enough for the samples"
                raise wrong("no time passes", self.stop, expected, key="stop")
        ends = self.values or [self.start, self.stop or 0.0, (self.stop or 0.0) - self.start]
        if not all(math.isfinite(end * self.unit_seconds) for end in ends):
            raise wrong("times beyond what numbers hold", self.unit, "times of less than 1e308 s",
                        key="unit")  # fmt: skip
        return self

    @property
    def unit_seconds(self) -> float:
        """The unit of tables and figures, s."""
        return _unit.SECONDS[self.unit]

    @property
    def seconds(self) -> "np.ndarray":
        """Sample times, s."""
        import numpy as np

        if self.values is not None:
            return np.array(self.values) * self.unit_seconds
        assert self.stop is not None  # the model asks for both
        assert self.number is not None
        return np.linspace(self.start, self.stop, self.number) * self.unit_seconds


class Method(Table):
    kind: Annotated[str, choice(("auto", "closed-form", "lie-poisson", "euler-angles"))] = "auto"
    solver: Text | None = Field(default=None, description="a solver of diffrax or polhode")
    rtol: Annotated[float, TOLERANCE] | None = None
    step: Annotated[float, POSITIVE] | None = Field(default=None, description="constant step [s]")

    @model_validator(mode="after")
    def _fits(self) -> "Method":
        if self.solver is not None and self.kind in ("auto", "closed-form"):
            raise wrong(f"not used by kind = {self.kind!r}", self.solver, "a method that steps",
                        'set kind = "lie-poisson" or "euler-angles", or remove the solver',
                        "solver")  # fmt: skip
        if self.step is not None and self.solver is None:
            raise wrong("a step without a solver", self.step, "a solver that takes this step",
                        "add `solver = ...`, or remove the step", "step")  # fmt: skip
        return self


class Published(Measured):
    measures = ("value", "uncertainty")
    name: Annotated[str, choice(PERIODS)]
    value: Annotated[float, NUMBER]
    uncertainty: Annotated[float, POSITIVE] | None = None
    unit: Seconds = "s"
    source: Text


class Observation(Table):
    one_of = (("utc", "time"),)
    utc: Annotated[datetime.datetime, DATE] | None = None
    time: Annotated[float, NUMBER] | None = None
    angles: Vector | None = None
    wxyz: Annotated[list[float], WXYZ] | None = None
    omega_body: Vector | None = None

    @model_validator(mode="after")
    def _something(self) -> "Observation":
        if self.angles is None and self.wxyz is None and self.omega_body is None:
            raise wrong("missing key", Words("none of them"),
                        "angles or wxyz, omega_body, or both", key="")  # fmt: skip
        return self


class Observations(Table):
    """Attitudes and body rates that were observed."""

    source: Text = ""
    sequence: Annotated[str, SEQUENCE] = "zyz"
    angle_unit: Angle = "rad"
    rate_unit: Rate = "rad/s"
    time_unit: Seconds = "s"
    rows: list[Observation] = Field(min_length=1, description="one or more rows { time = .., .. }")

    @model_validator(mode="after")
    def _one_kind(self) -> "Observations":
        if any(row.angles is not None for row in self.rows):
            for index, row in enumerate(self.rows):
                if row.wxyz is not None:
                    place, expected = f"rows {index + 1}.wxyz", "angles in every row, or wxyz"
                    raise wrong("mixed kinds of attitude", row.wxyz, expected, key=place)
        return self

    @model_validator(mode="after")
    def _in_si(self) -> "Observations":
        factors = {"time": _unit.SI[self.time_unit], "angles": _unit.SI[self.angle_unit],
                   "omega_body": _unit.SI[self.rate_unit]}  # fmt: skip
        rows = [
            row.model_copy(update={name: scaled(value, factors[name])
                                   for name, value in row.given() if name in factors})
            for row in self.rows
        ]  # fmt: skip
        return self.model_copy(update={"rows": rows})

    @property
    def seconds(self) -> "np.ndarray":
        """Times of the rows (n,), s."""
        import numpy as np

        return np.array([row.time for row in self.rows])

    @property
    def attitudes(self) -> Attitudes:
        """Those of the rows, NaN where a row has none."""
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
    file: Annotated[str, PATH] | None = None
    figure: Annotated[bool, FLAG] = True


class SceneFile(Table):
    """A scene of a rotating rigid body."""

    title: Text = Field("", description="the name of the file if left out")
    source: Text = Field("", description="where the numbers come from")
    epoch: Annotated[datetime.datetime, DATE] | None = Field(None, description="of time 0")
    frame: Text = Field("an inertial frame", description="name of the inertial frame")
    axis_names: Annotated[tuple[str, str, str], NAMES] = ("x", "y", "z")
    inertia: Inertia
    state: State
    times: Times
    potential: Potentials = Field(default_factory=list)
    torque: Torques = Field(default_factory=list)
    rotors: Rotors = Field(default_factory=list)
    method: Method = Method()
    monte_carlo: MonteCarlo | None = None
    published: list[Published] = Field(default_factory=list)
    observations: Observations | None = None
    output: Output = Output()
    ensemble: Ensemble | None = None

    _path: Path = PrivateAttr(Path("<text>"))
    _text: str = PrivateAttr("")
    _rows: "Mapping[str, np.ndarray]" = PrivateAttr(default_factory=dict)

    @property
    def path(self) -> Path:
        return self._path

    @property
    def text(self) -> str:
        """What was read."""
        return self._text

    @property
    def rows(self) -> "Mapping[str, np.ndarray]":
        """Of [ensemble.arrays], left on the disk."""
        return self._rows

    @model_validator(mode="after")
    def _spreads_fit(self) -> "SceneFile":
        if self.monte_carlo is not None and self.ensemble is not None:
            raise wrong("two batches", Words("[monte_carlo] and [ensemble]"), "one of them",
                        "keep [monte_carlo] for a file with a figure, [ensemble] for a store of any"
                        " size", "ensemble")  # fmt: skip
        constant = len(self.torque) == 1 and isinstance(self.torque[0], ConstantTorque)
        needs = {
            "moments": (self.inertia.moments, "only for an [inertia] given by its moments"),
            "euler": (self.state.euler, "only for a [state] given by Euler angles"),
            "omega_body": (self.state.omega_body, "only for a [state] with omega_body"),
            "momentum_body": (self.state.momentum_body, "only for a [state] with momentum_body"),
            "torque": (constant or None, "only for one [torque] of kind body or space"),
        }  # fmt: skip
        rows = None if self.ensemble is None else self.ensemble.arrays
        for lead, table in (("monte_carlo", self.monte_carlo), ("ensemble", self.ensemble),
                            ("ensemble.arrays", rows)):  # fmt: skip
            for name, (fits, expected) in needs.items():
                if fits is None and getattr(table, name, None) is not None:
                    given = Words(f"[{lead}] {name}")
                    raise wrong("does not fit this scene", given, expected, key=f"{lead}.{name}")
        return self

    @model_validator(mode="after")
    def _rows_since_epoch(self) -> "SceneFile":
        seen = self.observations
        if seen is None:
            return self
        rows, last = [], -math.inf
        for index, row in enumerate(seen.rows):
            time = row.time
            if row.utc is not None:
                if self.epoch is None:
                    raise wrong("missing key", Words(f"utc = {row.utc.isoformat()} in a row"),
                                "the epoch that utc is counted from",
                                "add `epoch = 1992-11-09T17:49:47Z`", "epoch")  # fmt: skip
                time = (row.utc - self.epoch).total_seconds()
            assert time is not None  # a row has one of both
            if not last < time < math.inf:
                raise wrong(f"unsorted or repeated times (row {index + 1})",
                            Words(f"{time} s after {last} s"), "rows in the order of time",
                            "sort the rows", "observations.rows")  # fmt: skip
            rows.append(row.model_copy(update={"time": time}))
            last = time
        return self.model_copy(update={"observations": seen.model_copy(update={"rows": rows})})
