"""Tables of a scene file that say what the body is and how it starts."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, model_validator

from polhode.files import _values
from polhode.files._table import Measured, Table
from polhode.files._values import Lengths, Matrix, Number, Positive, Quaternion, Sequence, Vector


class Attitudes(NamedTuple):
    """Attitudes as a file gives them: quaternions (..., 4), or Euler angles (..., 3) in rad.

    R = R_a(angle 1) R_b(angle 2) R_c(angle 3) for the letters abc of `sequence` (None: quaternions
    `wxyz`, not yet normalised), body -> space.
    """

    values: Any
    sequence: str | None = None


class Euler(Measured):
    """Turns about the body's own axes, first letter first: R = R_a(1) R_b(2) R_c(3)."""

    measures = ("angles",)
    sequence: Sequence = "zyz"
    angles: Vector
    unit: _values.Angle = "rad"

    @property
    def attitude(self) -> Attitudes:
        return Attitudes(self.angles, self.sequence)


class Axisymmetric(Table):
    """A symmetric top, symmetry axis body z."""

    transverse: Positive
    axial: Positive


class Solid(Table):
    """A homogeneous solid: kg, m."""

    mass: Positive
    centre: Vector = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    euler: Euler | None = None


class Box(Solid):
    shape: Literal["box"]
    sides: Lengths
    inner_sides: Lengths | None = None


class Ellipsoid(Solid):
    shape: Literal["ellipsoid"]
    semi_axes: Lengths


class Sphere(Solid):
    shape: Literal["sphere"]
    radius: Positive
    inner_radius: Positive | None = None


class Cylinder(Solid):
    shape: Literal["cylinder"]
    radius: Positive
    length: Positive
    inner_radius: Positive | None = None


class Cone(Solid):
    shape: Literal["cone"]
    radius: Positive
    height: Positive


class Torus(Solid):
    shape: Literal["torus"]
    ring_radius: Positive
    tube_radius: Positive


AnySolid = Annotated[
    Box | Ellipsoid | Sphere | Cylinder | Cone | Torus, Field(discriminator="shape")
]


class Inertia(Measured):
    """Exactly one way to say it; about the centre of mass, or the fixed point under gravity."""

    measures = ("moments", "tensor", "axisymmetric", "spherical")
    one_of = ((*measures, "parts"),)
    moments: Vector | None = Field(None, description="principal moments along body x, y, z")
    tensor: Matrix | None = Field(None, description="symmetric tensor in body axes")
    axisymmetric: Axisymmetric | None = None
    spherical: Number | None = Field(None, description="all moments equal")
    parts: list[AnySolid] | None = Field(None, min_length=1, max_length=1000)
    unit: _values.Moment = "kg m^2"

    @model_validator(mode="after")
    def _no_unit_of_parts(self) -> "Inertia":
        if self.parts is not None and "unit" in self.model_fields_set:
            raise ValueError("parts have no unit: they are in kg and m; remove the unit")
        return self


class Rates(Measured):
    value: Vector
    unit: _values.Rate = "rad/s"


class Momentum(Measured):
    value: Vector
    unit: _values.Momentum = "kg m^2/s"


def _bare(value: Any) -> Any:
    """Plain numbers are those in the SI unit."""
    return value if isinstance(value, Mapping) else {"value": value}


AnyRates = Annotated[Rates, BeforeValidator(_bare, json_schema_input_type=Vector | Rates)]
AnyMomentum = Annotated[Momentum, BeforeValidator(_bare, json_schema_input_type=Vector | Momentum)]


class State(Table):
    """Attitude, body -> space (default: not turned), and motion at the first time."""

    one_of = (("omega_body", "momentum_body"),)
    frame: Literal["inertial", "lvlh"] = Field(
        "inertial", description="lvlh: attitude and rates against the frame of the [orbit]"
    )
    wxyz: Quaternion | None = Field(None, description="scalar first")
    euler: Euler | None = None
    omega_body: AnyRates | None = None
    momentum_body: AnyMomentum | None = None

    @model_validator(mode="after")
    def _fits(self) -> "State":
        if self.wxyz is not None and self.euler is not None:
            raise ValueError("at most one of wxyz, euler is possible: remove one of them")
        if self.frame == "lvlh" and self.omega_body is None:
            raise ValueError('frame = "lvlh" needs omega_body')
        return self

    @property
    def attitude(self) -> Attitudes:
        """The one attitude at the first time."""
        return Attitudes(self.wxyz or [1, 0, 0, 0]) if self.euler is None else self.euler.attitude

    @property
    def rate(self) -> str:
        """Which of rates and momentum is given."""
        return "momentum_body" if self.omega_body is None else "omega_body"

    @property
    def value(self) -> list[float]:
        """The rates, rad/s, or the momentum, kg m^2/s, in body axes."""
        return getattr(self, self.rate).value
