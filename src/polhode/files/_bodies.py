"""Tables of a scene file that say what the body is, how it starts and what acts on it."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, model_validator

from polhode.files import _unit
from polhode.files._table import Angle, Measured, MomentumUnit, Rate, Table, Vector, Words
from polhode.files._values import MATRIX, NUMBER, POSITIVE, SEQUENCE, WXYZ, array, choice, wrong


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
    sequence: Annotated[str, SEQUENCE] = "zyz"
    angles: Vector
    unit: Angle = "rad"

    @property
    def attitude(self) -> Attitudes:
        return Attitudes(self.angles, self.sequence)


class Axisymmetric(Table):
    """A symmetric top, symmetry axis body z."""

    transverse: Annotated[float, POSITIVE]
    axial: Annotated[float, POSITIVE]


Length = Annotated[float, POSITIVE]
Lengths = Annotated[list[float], array(3, positive=True)]


class Solid(Table):
    """A homogeneous solid: kg, m."""

    mass: Annotated[float, POSITIVE]
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
    radius: Length
    inner_radius: Length | None = None


class Cylinder(Solid):
    shape: Literal["cylinder"]
    radius: Length
    length: Length
    inner_radius: Length | None = None


class Cone(Solid):
    shape: Literal["cone"]
    radius: Length
    height: Length


class Torus(Solid):
    shape: Literal["torus"]
    ring_radius: Length
    tube_radius: Length


AnySolid = Annotated[
    Box | Ellipsoid | Sphere | Cylinder | Cone | Torus, Field(discriminator="shape")
]


class Inertia(Measured):
    """Exactly one way to say it; about the centre of mass, or the fixed point under gravity."""

    measures = ("moments", "tensor", "axisymmetric", "spherical")
    one_of = ((*measures, "parts"),)
    moments: Vector | None = Field(None, description="principal moments along body x, y, z")
    tensor: Annotated[list[list[float]], MATRIX] | None = Field(
        None, description="symmetric tensor in body axes"
    )
    axisymmetric: Axisymmetric | None = None
    spherical: Annotated[float, NUMBER] | None = Field(None, description="all moments equal")
    parts: list[AnySolid] | None = Field(None, min_length=1)
    unit: Annotated[str, choice(tuple(_unit.MOMENTS))] = "kg m^2"

    @model_validator(mode="after")
    def _no_unit_of_parts(self) -> "Inertia":
        if self.parts is not None and "unit" in self.model_fields_set:
            raise wrong("not used with parts", self.unit, "no unit: parts are in kg and m",
                        "remove the unit", "unit")  # fmt: skip
        return self


class Rates(Measured):
    value: Vector
    unit: Rate = "rad/s"


class Momentum(Measured):
    value: Vector
    unit: MomentumUnit = "kg m^2/s"


def _bare(value: Any) -> Any:
    """Plain numbers are those in the SI unit."""
    return value if isinstance(value, Mapping) else {"value": value}


AnyRates = Annotated[Rates, BeforeValidator(_bare, json_schema_input_type=Vector | Rates)]
AnyMomentum = Annotated[Momentum, BeforeValidator(_bare, json_schema_input_type=Vector | Momentum)]


class State(Table):
    """Attitude, body -> space (default: not turned), and motion at the first time."""

    one_of = (("omega_body", "momentum_body"),)
    wxyz: Annotated[list[float], WXYZ] | None = Field(None, description="scalar first")
    euler: Euler | None = None
    omega_body: AnyRates | None = None
    momentum_body: AnyMomentum | None = None

    @model_validator(mode="after")
    def _one_attitude(self) -> "State":
        if self.wxyz is not None and self.euler is not None:
            raise wrong("too many choices", Words("wxyz and euler"), "exactly one of wxyz, euler",
                        "keep one of them", "")  # fmt: skip
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


class UniformGravity(Table):
    kind: Literal["uniform-gravity"]
    mass: Annotated[float, NUMBER]
    centre_body: Vector
    gravity_space: Vector | None = None


class GravityGradient(Table):
    kind: Literal["gravity-gradient"]
    mu: Annotated[float, NUMBER]
    position_space: Vector


class ConstantTorque(Table):
    kind: Literal["body", "space"]
    n: Vector


class LinearDamping(Table):
    kind: Literal["linear-damping"]
    c: Vector


class Rotor(Table):
    """A wheel: its momentum or speed is relative to the body."""

    one_of = (("momentum", "speed"),)
    axis_body: Vector
    inertia: Annotated[float, NUMBER] | None = None
    momentum: Annotated[float, NUMBER] | None = None
    speed: Annotated[float, NUMBER] | None = None
    torque: Annotated[float, NUMBER] | None = None


def _rows(value: Any) -> Any:
    """One table counts as a list of one."""
    return [value] if isinstance(value, Mapping) else value


Potential = Annotated[UniformGravity | GravityGradient, Field(discriminator="kind")]
Torque = Annotated[ConstantTorque | LinearDamping, Field(discriminator="kind")]
Potentials = Annotated[
    list[Potential], BeforeValidator(_rows, json_schema_input_type=Potential | list[Potential])
]
Torques = Annotated[
    list[Torque], BeforeValidator(_rows, json_schema_input_type=Torque | list[Torque])
]
Rotors = Annotated[list[Rotor], BeforeValidator(_rows, json_schema_input_type=Rotor | list[Rotor])]
