"""Tables of a scene file for many bodies: [monte_carlo] and [ensemble]."""

from typing import Annotated, Any

from pydantic import Field, model_validator

from polhode.files._table import Angle, Measured, MomentumUnit, Rate, Spread, Table, Text, Words
from polhode.files._values import FLAG, NUMBER, PATH, choice, whole, wrong

QUANTITIES = ("moments", "euler", "attitude", "omega_body", "momentum_body", "torque")


class Drawn(Table):
    """Bodies around the nominal one."""

    @property
    def spreads(self) -> dict[str, Any]:
        """The quantities that are drawn, with their tables."""
        return {name: table for name, table in self.given() if name in QUANTITIES}


class MomentsSigma(Table):
    relative_sigma: Spread
    source: Text

    @property
    def sigma(self) -> list[float]:
        return self.relative_sigma


class Sigma(Measured):
    measures = ("sigma",)
    sigma: Spread
    source: Text


class AngleSigma(Sigma):
    unit: Angle = "rad"


class RatesSigma(Sigma):
    unit: Rate = "rad/s"


class MomentumSigma(Sigma):
    unit: MomentumUnit = "kg m^2/s"


class MonteCarlo(Drawn):
    """Clones around the nominal body, each quantity drawn from a normal distribution."""

    clones: Annotated[int, whole(1, 10_000_000)]
    seed: Annotated[int, whole(0, 2**63 - 1)]
    moments: MomentsSigma | None = None
    euler: AngleSigma | None = None
    attitude: AngleSigma | None = None
    omega_body: RatesSigma | None = None
    momentum_body: MomentumSigma | None = None

    @model_validator(mode="after")
    def _some(self) -> "MonteCarlo":
        if not self.spreads:
            expected = f"one or more of {', '.join(QUANTITIES[:-1])}"
            mend = "add for example `moments = { relative_sigma = ..., source = .. }`"
            raise wrong("missing key", Words("none of them"), expected, mend, "")
        return self


class MomentsDraw(Table):
    one_of = (("relative_sigma", "relative_half_width"),)
    relative_sigma: Spread | None = None
    relative_half_width: Spread | None = None
    source: Text = ""

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
    source: Text = ""


class AngleDraw(Draw):
    unit: Angle = "rad"


class AttitudeDraw(AngleDraw):
    one_of = (("sigma", "half_width", "any"),)
    any: Annotated[bool, FLAG] | None = Field(None, description="true: every attitude alike")

    @model_validator(mode="after")
    def _used(self) -> "AttitudeDraw":
        if self.any is False:
            raise wrong("not used", False, "true, or sigma, or half_width", key="any")
        return self


class RatesDraw(Draw):
    unit: Rate = "rad/s"


class MomentumDraw(Draw):
    unit: MomentumUnit = "kg m^2/s"


class TorqueDraw(Draw):
    unit: Annotated[str, choice(("N m",))] = "N m"


class Arrays(Table):
    """Files of NumPy (.npy) below the scene's folder with a row for each body, SI."""

    moments: Annotated[str, PATH] | None = None
    wxyz: Annotated[str, PATH] | None = None
    omega_body: Annotated[str, PATH] | None = None
    momentum_body: Annotated[str, PATH] | None = None
    torque: Annotated[str, PATH] | None = None


class Statistic(Table):
    quantity: Annotated[str, choice(("rate", "tilt", "energy", "momentum"))]
    low: Annotated[float, NUMBER] | None = None
    high: Annotated[float, NUMBER] | None = None
    bins: Annotated[int, whole(1, 100_000)] = 100

    @model_validator(mode="after")
    def _range(self) -> "Statistic":
        if (self.low is None) != (self.high is None):
            raise wrong("half a range", dict(self.given()), "both low and high, or neither", key="")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise wrong("not above low", self.high, f"a number above {self.low}", key="high")
        return self


class Ensemble(Drawn):
    """Any number of bodies, streamed into a Zarr store."""

    bodies: Annotated[int, whole(1, 2**32 - 1)]
    seed: Annotated[int, whole(0, 2**32 - 1)]
    trajectories: Annotated[bool, FLAG] = True
    statistics: list[Statistic] = Field(default_factory=list)
    source: Text = ""
    arrays: Arrays | None = None
    moments: MomentsDraw | None = None
    euler: AngleDraw | None = None
    attitude: AttitudeDraw | None = None
    omega_body: RatesDraw | None = None
    momentum_body: MomentumDraw | None = None
    torque: TorqueDraw | None = None

    @model_validator(mode="after")
    def _keeps(self) -> "Ensemble":
        names = [s.quantity for s in self.statistics]
        if not self.trajectories and not names:
            raise wrong("nothing would be kept", False, "true, or [[ensemble.statistics]]",
                        key="trajectories")  # fmt: skip
        if len(set(names)) < len(names):
            raise wrong("a quantity named twice", names, "each quantity once", key="statistics")
        rows = self.arrays
        if rows is None:
            return self
        clashes = {
            "wxyz": self.euler is not None or (self.attitude is not None and self.attitude.any),
            "momentum_body": self.momentum_body is not None,
            "omega_body": rows.momentum_body is not None,
        }
        for name, clash in clashes.items():
            if getattr(rows, name) is not None and clash:
                given = Words(f"{name} in arrays, and a table or rows that replace it")
                raise wrong("given twice", given, "one of them", key=f"arrays.{name}")
        return self
