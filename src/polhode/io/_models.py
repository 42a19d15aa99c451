"""What a scene file may say: one pydantic model a table. `polhode schema` prints their JSON Schema.

Values are as in the file, units not yet applied; `_convert` makes SI numbers of them. Nothing here
needs numpy or JAX, so that a mistake in a file is told at once.
"""

import datetime
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, model_validator

from polhode.io._batches import Ensemble, MonteCarlo
from polhode.io._bodies import (
    ConstantTorque,
    Inertia,
    Potentials,
    Rotors,
    State,
    Torques,
)
from polhode.io._table import Angle, Rate, Seconds, Table, Text, Vector, Words
from polhode.io._values import (
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
        return self


class Method(Table):
    kind: Annotated[str, choice(("auto", "closed-form", "lie-poisson", "euler-angles"))] = "auto"
    solver: Text | None = Field(default=None, description="a solver of diffrax or polhode.solvers")
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


class Published(Table):
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


class Output(Table):
    file: Annotated[str, PATH] | None = None
    figure: Annotated[bool, FLAG] = True


class SceneText(Table):
    """A scene of a rotating rigid body."""

    title: Text | None = None
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

    @model_validator(mode="after")
    def _spreads_fit(self) -> "SceneText":
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
    def _epoch_of_rows(self) -> "SceneText":
        seen = self.observations
        for row in [] if seen is None or self.epoch is not None else seen.rows:
            if row.utc is not None:
                raise wrong("missing key", Words(f"utc = {row.utc.isoformat()} in a row"),
                            "the epoch that utc is counted from",
                            "add `epoch = 1992-11-09T17:49:47Z`", "epoch")  # fmt: skip
        return self
