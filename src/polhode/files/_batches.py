"""Tables of a scene file for many bodies: [monte_carlo] and [ensemble]."""

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from polhode.files import _values
from polhode.files._table import Measured, Table
from polhode.files._values import BelowFolder, Number, Spread

QUANTITIES = ("moments", "euler", "attitude", "omega_body", "momentum_body", "torque")


class Drawn(Table):
    """Bodies around the nominal one."""

    @property
    def spreads(self) -> dict[str, Any]:
        """The quantities that are drawn, with their tables."""
        return {name: table for name, table in self.given() if name in QUANTITIES}


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


class MonteCarlo(Drawn):
    """Clones around the nominal body, each quantity drawn from a normal distribution."""

    clones: Annotated[int, Field(ge=1, le=10_000_000)]
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)]
    moments: MomentsSigma | None = None
    euler: AngleSigma | None = None
    attitude: AngleSigma | None = None
    omega_body: RatesSigma | None = None
    momentum_body: MomentumSigma | None = None

    @model_validator(mode="after")
    def _some(self) -> "MonteCarlo":
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
    any: Literal[True] | None = Field(None, description="true: every attitude alike")


class RatesDraw(Draw):
    unit: _values.Rate = "rad/s"


class MomentumDraw(Draw):
    unit: _values.Momentum = "kg m^2/s"


class TorqueDraw(Draw):
    unit: Literal["N m"] = "N m"


class Arrays(Table):
    """Files of NumPy (.npy) below the scene's folder with a row for each body, SI."""

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


class Ensemble(Drawn):
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
    def _stores(self) -> "Ensemble":
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
            if getattr(rows, name) is not None and clash:
                raise ValueError(
                    f"{name} is given twice: in arrays, and by a table or rows that replace it"
                )
        return self
