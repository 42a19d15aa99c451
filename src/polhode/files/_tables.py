"""Tables of a scene file for the body, its initial state and its torques, in SI units."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import BeforeValidator, Field, model_validator

from polhode.files import _values
from polhode.files._values import (
    Direction,
    Gains,
    InertiaTable,
    Lengths,
    Matrix,
    Measured,
    NotNegative,
    Number,
    NumberOverTime,
    Numbers,
    NumberTable,
    Positive,
    Quaternion,
    Sequence,
    Table,
    Vector,
    VectorOverTime,
    Velocity,
)


class Attitudes(NamedTuple):
    """Attitudes as a file gives them: quaternions (..., 4), or Euler angles (..., 3) in rad.

    R = R_a(angle 1) R_b(angle 2) R_c(angle 3) for the letters abc of `sequence` (None: quaternions
    `wxyz`, not yet normalised), body -> space.
    """

    values: Any
    sequence: str | None = None


class Euler(Measured):
    """Rotations about body axes, in the order of the letters: R = R_a(1) R_b(2) R_c(3)."""

    measures = ("angles",)
    sequence: Sequence = "ZYZ"
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
    """Inertia, given in exactly one form; about the centre of mass, or the fixed point of a top."""

    measures = ("moments", "tensor", "axisymmetric", "spherical")
    one_of = ((*measures, "parts", "table"),)
    moments: Vector | None = Field(None, description="principal moments along body x, y, z")
    tensor: Matrix | None = Field(None, description="symmetric tensor in body axes")
    axisymmetric: Axisymmetric | None = None
    spherical: Number | None = Field(None, description="all moments equal")
    parts: list[AnySolid] | None = Field(None, min_length=1, max_length=1000)
    table: InertiaTable | None = Field(None, description="inertia that changes with time")
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


def _as_table(value: Any) -> Any:
    """Plain numbers as a table in SI units."""
    return value if isinstance(value, Mapping) else {"value": value}


AnyRates = Annotated[Rates, BeforeValidator(_as_table, json_schema_input_type=Vector | Rates)]
AnyMomentum = Annotated[
    Momentum, BeforeValidator(_as_table, json_schema_input_type=Vector | Momentum)
]


class Oriented(Table):
    """A table with an attitude, body -> space; the identity if it is left out."""

    wxyz: Quaternion | None = Field(None, description="scalar first")
    euler: Euler | None = None

    @model_validator(mode="after")
    def _one_attitude(self) -> Self:
        if self.wxyz is not None and self.euler is not None:
            raise ValueError("at most one of wxyz, euler is possible: remove one of them")
        return self

    @property
    def attitude(self) -> Attitudes:
        return Attitudes(self.wxyz or [1, 0, 0, 0]) if self.euler is None else self.euler.attitude


class State(Oriented):
    """Attitude and motion at the first time."""

    one_of = (("omega_body", "momentum_body"),)
    frame: Literal["inertial", "lvlh"] = Field(
        "inertial", description="lvlh: attitude and rates against the frame of the [orbit]"
    )
    omega_body: AnyRates | None = None
    momentum_body: AnyMomentum | None = None

    @model_validator(mode="after")
    def _rates_of_frame(self) -> "State":
        if self.frame == "lvlh" and self.omega_body is None:
            raise ValueError('frame = "lvlh" needs omega_body')
        return self

    @property
    def rate(self) -> str:
        """The key of the initial rates or momentum."""
        return "momentum_body" if self.omega_body is None else "omega_body"

    @property
    def value(self) -> list[float]:
        """The rates, rad/s, or the momentum, kg m^2/s, in body axes."""
        return getattr(self, self.rate).value


class Orbit(Measured):
    """A Kepler orbit: its elements, or position and velocity at the epoch, space axes."""

    measures = ("inclination", "node", "periapsis", "mean_anomaly")
    one_of = (("semi_major_axis", "position"),)
    mu: Positive = Field(description="m^3/s^2")
    semi_major_axis: Number | None = Field(None, description="m; of a hyperbola negative")
    eccentricity: NotNegative | None = Field(None, description="left out: a circle")
    inclination: Number | None = None
    node: Number | None = Field(None, description="longitude of the ascending node")
    periapsis: Number | None = Field(None, description="argument of periapsis")
    mean_anomaly: Number | None = Field(None, description="at the epoch")
    position: Vector | None = Field(None, description="m")
    velocity: Vector | None = Field(None, description="m/s")
    epoch: Number = Field(0.0, description="s")
    unit: _values.Angle = Field("rad", description="of the angles")

    @model_validator(mode="after")
    def _one_kind(self) -> "Orbit":
        if (self.position is None) != (self.velocity is None):
            raise ValueError("position and velocity are given together")
        elements = [n for n in ("eccentricity", *self.measures) if getattr(self, n) is not None]
        if self.position is not None and elements:
            raise ValueError(f"{elements[0]} is not used with position and velocity: remove it")
        return self

    @property
    def is_hyperbolic(self) -> bool:
        """Whether the orbit is a hyperbola."""
        if self.position is None or self.velocity is None:
            return self.eccentricity is not None and self.eccentricity > 1
        return math.hypot(*self.velocity) ** 2 * math.hypot(*self.position) > 2 * self.mu


class Action(Table):
    """A potential or a torque."""

    @property
    def needs_orbit(self) -> bool:
        return False


class UniformGravity(Action):
    kind: Literal["uniform-gravity"]
    mass: Number
    centre_body: Vector
    gravity_space: Vector | None = None


class GravityGradient(Action):
    """Gravity gradient of a fixed centre (`mu`, `position_space`), or on the [orbit] (neither)."""

    kind: Literal["gravity-gradient"]
    mu: Number | None = None
    position_space: Vector | None = None

    @model_validator(mode="after")
    def _centre_or_orbit(self) -> "GravityGradient":
        if (self.mu is None) != (self.position_space is None):
            raise ValueError("give both mu and position_space, or neither to follow the [orbit]")
        return self

    @property
    def needs_orbit(self) -> bool:
        return self.mu is None


class Torque(Action):
    frame: Literal["inertial", "lvlh"] = Field(
        "inertial", description="lvlh: the torque sees attitude and rates against the [orbit]"
    )

    @property
    def needs_orbit(self) -> bool:
        return self.frame == "lvlh"


class ConstantTorque(Torque):
    kind: Literal["body", "space"]
    n: VectorOverTime


class LinearDamping(Torque):
    kind: Literal["linear-damping"]
    c: Gains


class QuadraticDamping(Torque):
    kind: Literal["quadratic-damping"]
    c: Gains


class EnergySink(Torque):
    kind: Literal["energy-sink"]
    k: NotNegative


class RateDamping(Torque):
    kind: Literal["rate-damping"]
    c: Gains
    rates: Vector | None = None


class Pointing(Torque, Oriented):
    """N = -2 kp e - kd omega towards an attitude."""

    kind: Literal["pointing"]
    kp: Gains
    kd: Gains


class BDot(Table):
    """m = k omega x B, each component limited to `max_moment`."""

    k: Number
    max_moment: Positive | None = None


class Magnetorquer(Torque):
    """N = m x B, with a constant moment or the B-dot law, in a constant field or that of a dipole
    at the centre of the [orbit].
    """

    kind: Literal["magnetorquer"]
    one_of = (("moment_body", "b_dot"), ("field_space", "dipole_space"))
    frame: Literal["inertial"] = "inertial"
    moment_body: Vector | None = Field(None, description="A m^2")
    b_dot: BDot | None = None
    field_space: Vector | None = Field(None, description="T")
    dipole_space: Vector | None = Field(None, description="A m^2")

    @property
    def needs_orbit(self) -> bool:
        return self.dipole_space is not None


class MomentumDumping(Torque):
    """Magnetorquers that unload the wheels: m = k h x B / |B|^2."""

    kind: Literal["momentum-dumping"]
    one_of = (("field_space", "dipole_space"),)
    frame: Literal["inertial"] = "inertial"
    k: NotNegative = Field(description="1/s")
    field_space: Vector | None = Field(None, description="T")
    dipole_space: Vector | None = Field(None, description="A m^2")
    max_moment: Positive | None = Field(None, description="A m^2")

    @property
    def needs_orbit(self) -> bool:
        return self.dipole_space is not None


class Plate(Table):
    """A flat plate, exposed on the side of its normal."""

    area: NotNegative = Field(description="m^2")
    normal: Direction
    centre: Vector = Field(description="from the centre of mass, m")


_ALONG = '{} is known in space axes, and frame = "lvlh" reads vectors along its own: remove frame'


class Plated(Torque):
    plates: Annotated[list[Plate], Field(min_length=1, max_length=1000)]

    def coefficients_of_plates(self, *names: str) -> None:
        """ValueError unless each of these is one number or a list of one number per plate."""
        for name in names:
            value = getattr(self, name)
            if isinstance(value, list) and len(value) != len(self.plates):
                raise ValueError(
                    f"{name} has {len(value)} numbers for {len(self.plates)} plates: give one"
                    " number, or one for each plate"
                )


class Drag(Plated):
    """Air drag on plates: F = -rho Cd A max(n . v, 0) v / 2."""

    kind: Literal["drag"]
    density: NumberOverTime = Field(description="kg/m^3")
    velocity: Velocity = Field(description="relative to the air, m/s; orbit: that of the [orbit]")
    coefficient: NotNegative | list[NotNegative] = 2.2

    @model_validator(mode="after")
    def _one_for_each_plate(self) -> Self:
        self.coefficients_of_plates("coefficient")
        if self.frame == "lvlh" and self.velocity == "orbit":
            raise ValueError(_ALONG.format('velocity = "orbit"'))
        return self

    @property
    def needs_orbit(self) -> bool:
        return self.frame == "lvlh" or self.velocity == "orbit"


class Shadow(Table):
    """The cylindrical shadow of the central body of the [orbit]."""

    radius: Positive = Field(6.378137e6, description="m")


class SolarPressure(Plated):
    """Sunlight on plates that absorb, reflect and scatter."""

    kind: Literal["solar-pressure"]
    direction: VectorOverTime = Field(description="to the Sun")
    lit: NumberOverTime = Field(1.0, description="visible part of the Sun")
    eclipse: Shadow | None = None
    specular: NotNegative | list[NotNegative] = 0.0
    diffuse: NotNegative | list[NotNegative] = 0.0
    pressure: NotNegative = Field(4.54e-6, description="N/m^2")

    @model_validator(mode="after")
    def _fractions(self) -> Self:
        self.coefficients_of_plates("specular", "diffuse")
        if self.eclipse is not None and "lit" in self.model_fields_set:
            raise ValueError("at most one of lit, eclipse is possible: remove one of them")
        if self.frame == "lvlh" and self.eclipse is not None:
            raise ValueError(_ALONG.format("eclipse"))
        if isinstance(self.direction, list) and not any(self.direction):
            raise ValueError("direction must not be zero")
        return self

    @property
    def needs_orbit(self) -> bool:
        return self.frame == "lvlh" or self.eclipse is not None


class ControlMomentGyro(Torque):
    """A wheel of constant momentum on a gimbal with a prescribed `angle`."""

    kind: Literal["control-moment-gyro"]
    frame: Literal["inertial"] = "inertial"
    momentum: Number = Field(description="kg m^2/s")
    gimbal: Direction
    spin: Direction
    angle: NumberTable = Field(description="of the gimbal over time, rad")


class Pulses(Torque):
    """A constant torque that acts from each of `starts` to the corresponding entry of `ends`."""

    kind: Literal["pulses"]
    n: Vector
    axes: Literal["body", "space"] = "body"
    starts: Numbers
    ends: Numbers

    @model_validator(mode="after")
    def _pairs(self) -> "Pulses":
        if len(self.starts) != len(self.ends):
            raise ValueError(f"{len(self.starts)} starts and {len(self.ends)} ends are no pairs")
        for a, b in zip(self.starts, self.ends, strict=True):
            if not a < b:
                raise ValueError(f"a pulse ends after its start, got {a} to {b}")
        return self


class Coulomb(Table):
    """-torque tanh(Omega / speed) on the wheel."""

    torque: NotNegative
    speed: Positive


class Motor(Table):
    """A constant torque on the wheel within the limits of its motor."""

    command: Number
    max_torque: Positive | None = None
    max_speed: Positive | None = None


class Rotor(Table):
    """A wheel, with its momentum or speed relative to the body."""

    one_of = (("momentum", "speed"),)
    axis_body: Direction
    inertia: Number | None = None
    momentum: Number | None = None
    speed: Number | None = None
    torque: Number | None = None
    viscous: NotNegative | None = Field(None, description="friction of the bearing [N m s]")
    coulomb: Coulomb | None = None
    motor: Motor | None = None


class Cluster(Oriented):
    """Reaction wheels that together exert N = -2 kp e - kd omega towards an attitude."""

    axes: Annotated[list[Direction], Field(min_length=3, max_length=100)]
    inertia: Positive = Field(description="of each wheel about its axis, kg m^2")
    kp: Gains
    kd: Gains
    speed: Number | list[Number] = Field(0.0, description="at the first time, rad/s")
    max_torque: Positive | None = Field(None, description="of each motor, N m")
    viscous: NotNegative | None = Field(None, description="friction of each bearing [N m s]")
    null_gain: NotNegative = Field(0.0, description="1/s")
    bias: Number | list[Number] = Field(0.0, description="speeds of null motion, rad/s")

    @model_validator(mode="after")
    def _one_for_each_wheel(self) -> Self:
        for name in ("speed", "bias"):
            value = getattr(self, name)
            if isinstance(value, list) and len(value) != len(self.axes):
                raise ValueError(f"{name} has {len(value)} numbers for {len(self.axes)} wheels")
        return self


class Event(Measured):
    """A body axis crosses a given angle from a direction in space, or the rate crosses a limit."""

    one_of = (("angle", "rate"),)
    measures = ("angle", "rate")
    name: Annotated[str, Field(pattern=r"^[A-Za-z]\w{0,30}$", max_length=31)]
    axis_body: Direction | None = None
    direction_space: Direction | None = None
    angle: Positive | None = None
    rate: Positive | None = None
    unit: _values.Angle | _values.Rate | None = None
    crossing: Literal["rising", "falling", "both"] = "both"

    @model_validator(mode="before")
    @classmethod
    def _unit(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and "unit" not in data:
            return {**data, "unit": "rad" if "angle" in data else "rad/s"}
        return data

    @model_validator(mode="after")
    def _limit(self) -> "Event":
        axes = [self.axis_body, self.direction_space]
        if self.angle is not None and None in axes:
            raise ValueError("angle needs axis_body and direction_space")
        if self.rate is not None and axes != [None, None]:
            raise ValueError("rate has neither axis_body nor direction_space: remove them")
        if ("/" in str(self.unit) or self.unit == "rpm") != (self.rate is not None):
            raise ValueError(f"the unit {self.unit!r} does not fit")
        if self.angle is not None and not self.angle < 3.1415926535:
            raise ValueError("angle must lie between 0 and 180 degrees, both excluded")
        return self


def _as_list(value: Any) -> Any:
    """A single table as a list of one."""
    return [value] if isinstance(value, Mapping) else value


Potential = Annotated[UniformGravity | GravityGradient, Field(discriminator="kind")]
AnyTorque = Annotated[
    ConstantTorque
    | LinearDamping
    | QuadraticDamping
    | EnergySink
    | RateDamping
    | Pointing
    | Magnetorquer
    | MomentumDumping
    | Drag
    | SolarPressure
    | ControlMomentGyro
    | Pulses,
    Field(discriminator="kind"),
]
_Potentials = Annotated[list[Potential], Field(max_length=100)]
_Torques = Annotated[list[AnyTorque], Field(max_length=100)]
_Rotors = Annotated[list[Rotor], Field(max_length=100)]
Potentials = Annotated[
    _Potentials, BeforeValidator(_as_list, json_schema_input_type=Potential | _Potentials)
]
Torques = Annotated[
    _Torques, BeforeValidator(_as_list, json_schema_input_type=AnyTorque | _Torques)
]
Rotors = Annotated[_Rotors, BeforeValidator(_as_list, json_schema_input_type=Rotor | _Rotors)]
_Clusters = Annotated[list[Cluster], Field(max_length=10)]
Clusters = Annotated[
    _Clusters, BeforeValidator(_as_list, json_schema_input_type=Cluster | _Clusters)
]
