"""Air drag and solar radiation pressure on a spacecraft modelled by flat plates."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array, as_positive, is_concrete, require
from polhode._hamiltonian import Attitude, Vector, cross, dot, triple
from polhode._parts import AbstractPart, Signature, above_zero, shaped
from polhode._scene._tables import check_kind
from polhode._scene._torques import AbstractTorque, value_at, vector_of_time


class Plates(AbstractPart):
    """Flat plates of a body, each exposed on the side of its normal.

    **Arguments:** ``area`` (..., p) [m^2]; ``normal`` (..., p, 3): outward, body axes, normalised;
    ``centre`` (..., p, 3): from the centre of mass [m], body axes. A panel with two sides is two
    plates of opposite normals. Plates do not shade one another.

        faces = ph.Plates([1.0, 1.0], [[1.0, 0, 0], [-1.0, 0, 0]], [[0.5, 0, 0], [-0.5, 0, 0]])

    Raises ValueError for a negative area, a zero normal or other shapes.
    """

    area: Float[Array, "*#b p"] = shaped(None)
    normal: Float[Array, "*#b p 3"] = shaped(None, 3)
    centre: Float[Array, "*#b p 3"] = shaped(None, 3)

    def __init__(self, area: ArrayLike, normal: ArrayLike, centre: ArrayLike):
        self.area = as_float_array("Plates area", area, (None,))
        self.centre = as_float_array("Plates centre", centre, (None, 3))
        direction = as_float_array("Plates normal", normal, (None, 3))
        if is_concrete(self.area):
            require(np.asarray(self.area) >= 0, f"Plates area must not be negative, got {area}.")
        if is_concrete(direction):
            nonzero = np.any(np.asarray(direction) != 0, axis=-1)
            require(nonzero, f"Plates normal must not be zero, got {normal}.")
        size = jnp.sqrt(jnp.sum(direction**2, axis=-1, keepdims=True))
        self.normal = direction / size
        counts = self.area.shape[-1], direction.shape[-2], self.centre.shape[-2]
        require(
            len(set(counts)) == 1,
            f"Plates need one area, normal and centre each, got {counts[0]}, {counts[1]} and"
            f" {counts[2]}.",
        )
        require(counts[0] > 0, "Plates needs one plate at least.")

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        return (jnp.all(jnp.isfinite(self.normal), axis=(-2, -1)),)

    def torque(self, force: Callable[[int, Vector], Vector]) -> Vector:
        """Sum of centre x force(i, normal) over the plates, as components [N m]."""
        parts = []
        for i in range(self.area.shape[-1]):
            normal, centre = (
                triple(x[..., i, k] for k in range(3)) for x in (self.normal, self.centre)
            )
            parts.append(cross(centre, force(i, normal)))
        return triple(sum(column[1:], start=column[0]) for column in zip(*parts))


def number_of_time(name: str, value: Any) -> Array | Callable:
    """A number (...) that is not negative, or a function fn(t) -> () checked by one call."""
    if not callable(value):
        return as_positive(name, value, zero=True)
    if isinstance(value, AbstractPart) and callable(value):
        check_kind(name, value, None)
        return value
    return Signature(name, {"t": ()}).checked(value)


def _direction_of_time(name: str, value: Any) -> Array | Callable:
    """``vector_of_time``; ValueError for a constant vector that is zero."""
    direction = vector_of_time(name, value)
    if not callable(direction) and is_concrete(direction):
        nonzero = np.any(np.asarray(direction) != 0, axis=-1)
        require(nonzero, f"{name} must not be zero, got {value}.")
    return direction


def number_at(name: str, value: Any, t: Array | float) -> Array:
    """Value of a ``number_of_time`` at the times ``t``."""
    if not callable(value):
        return value
    if isinstance(value, AbstractPart) and callable(value):
        return value(t)
    return Signature(name, {"t": ()}).mapped(value, t)


def _for_each(name: str, value: ArrayLike, plates: Plates) -> Array:
    """A coefficient (..., p) from one number for all plates, or one each."""
    array = as_positive(name, value, zero=True)
    if array.ndim == 0:
        return jnp.broadcast_to(array, plates.area.shape[-1:])
    return as_float_array(name, array, (plates.area.shape[-1],))


def _check_plates(name: str, plates: Any) -> Plates:
    if not isinstance(plates, Plates):
        raise TypeError(f"{name} takes ph.Plates, got {type(plates).__name__}.")
    return plates


class Drag(AbstractTorque):
    """Torque of the air on plates in free-molecular flow: F = -rho Cd A max(n . v, 0) v / 2.

    **Arguments:** ``plates``: ``ph.Plates``; ``density`` [kg/m^3]: a number (...), a function of
    time [s] or a ``ph.Table``; ``velocity`` [m/s]: of the body relative to the air, space axes,
    (..., 3), a function of time -> (3,) or a ``ph.Table``; ``coefficient`` Cd: (p,) or one number,
    2.2 by default. Velocities due to the rotation of the body are neglected. The torque has a kink
    where a plate turns away from the flow; steps end there.

        air = ph.Drag(faces, density=1e-11, velocity=[7.6e3, 0.0, 0.0])

    F. L. Markley and J. L. Crassidis, Fundamentals of Spacecraft Attitude Determination and
    Control, 2014, section 3.3.6.3. Raises TypeError or ValueError for other arguments.
    """

    smooth: ClassVar[bool] = False  # kinks where plates turn away from the flow

    plates: Plates = shaped()
    density: Float[Array, "*#b"] | Callable = shaped()
    velocity: Float[Array, "*#b 3"] | Callable = shaped(3)
    coefficient: Float[Array, "*#b p"] = shaped(None)

    def __init__(
        self,
        plates: Plates,
        density: ArrayLike | Callable,
        velocity: ArrayLike | Callable,
        coefficient: ArrayLike = 2.2,
    ):
        self.plates = _check_plates("Drag", plates)
        self.density = number_of_time("Drag density", density)
        self.velocity = vector_of_time("Drag velocity", velocity)
        self.coefficient = _for_each("Drag coefficient", coefficient, plates)

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        v = attitude.to_body(value_at("Drag velocity", self.velocity, t))
        half = number_at("Drag density", self.density, t) / 2

        def force(i, normal):
            flow = jnp.maximum(dot(normal, v), 0)
            size = -half * self.coefficient[..., i] * self.plates.area[..., i] * flow
            return triple(size * x for x in v)

        return self.plates.torque(force)


class SolarPressure(AbstractTorque):
    """Torque of sunlight on plates that absorb, reflect and scatter.

    With the unit vector s to the Sun and c = max(n . s, 0) the force on a plate is

        F = -p A c ((1 - specular) s + 2 (specular c + diffuse/3) n).

    **Arguments:** ``plates``: ``ph.Plates``; ``direction``: s in space axes, (..., 3), a function
    of time [s] -> (3,) or a ``ph.Table``, normalised; ``lit``: the visible part of the Sun, from 0
    to 1: a number, a function of time, a ``ph.Table`` or a ``ph.Eclipse``; ``specular`` and
    ``diffuse``: reflected fractions, (p,) or one number, the rest is absorbed; ``pressure`` (...)
    [N/m^2], by default 4.54e-6, that at 1 au. Steps end where a plate turns away from the Sun and
    at the edges of the shadow.

        light = ph.SolarPressure(faces, [1.0, 0.0, 0.0], specular=0.2, diffuse=0.3)

    F. L. Markley and J. L. Crassidis, Fundamentals of Spacecraft Attitude Determination and
    Control, 2014, section 3.3.6.4. Raises TypeError or ValueError for other arguments.
    """

    smooth: ClassVar[bool] = False  # kinks where plates turn away from the Sun

    plates: Plates = shaped()
    direction: Float[Array, "*#b 3"] | Callable = shaped(3)
    lit: Float[Array, "*#b"] | Callable = shaped()
    specular: Float[Array, "*#b p"] = shaped(None)
    diffuse: Float[Array, "*#b p"] = shaped(None)
    pressure: Float[Array, "*#b"] = shaped()

    def __init__(
        self,
        plates: Plates,
        direction: ArrayLike | Callable,
        lit: ArrayLike | Callable = 1.0,
        specular: ArrayLike = 0.0,
        diffuse: ArrayLike = 0.0,
        pressure: ArrayLike = 4.54e-6,
    ):
        self.plates = _check_plates("SolarPressure", plates)
        self.direction = _direction_of_time("SolarPressure direction", direction)
        self.lit = number_of_time("SolarPressure lit", lit)
        self.specular = _for_each("SolarPressure specular", specular, plates)
        self.diffuse = _for_each("SolarPressure diffuse", diffuse, plates)
        self.pressure = as_positive("SolarPressure pressure", pressure, zero=True)
        if is_concrete(self.specular, self.diffuse):
            require(
                np.asarray(self.specular) + np.asarray(self.diffuse) <= 1,
                f"specular + diffuse must not exceed 1, got {specular} and {diffuse}.",
            )

    def body_components(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        s = value_at("SolarPressure direction", self.direction, t)
        size = jnp.sqrt(dot(s, s))
        s = attitude.to_body(triple(x / size for x in s))
        pressure = self.pressure * number_at("SolarPressure lit", self.lit, t)

        def force(i, normal):
            specular, diffuse = self.specular[..., i], self.diffuse[..., i]
            c = jnp.maximum(dot(normal, s), 0)
            push = -pressure * self.plates.area[..., i] * c
            across = 2 * (specular * c + diffuse / 3)
            return triple(push * ((1 - specular) * a + across * b) for a, b in zip(s, normal))

        return self.plates.torque(force)


class Eclipse(AbstractPart):
    """The cylindrical shadow of a planet, a function of time [s]: 1 in sunlight, 0 in the shadow.

    **Arguments:** ``position`` [m]: of the body from the centre of the planet, space axes: an
    orbit, a function of time -> (3,), a ``ph.Table`` or (..., 3); ``direction``: to the Sun, space
    axes, of the same kinds; ``radius`` (...) of the planet [m], by default that of the Earth. For
    ``ph.SolarPressure(lit=...)``. Steps of the integrator end at the edges of the shadow.

        shadow = ph.Eclipse(ph.KeplerOrbit(3.986e14, 6.9e6), [1.0, 0.0, 0.0])

    Raises TypeError or ValueError for other arguments.
    """

    smooth: ClassVar[bool] = False  # jumps at the edges of the shadow

    position: Float[Array, "*#b 3"] | Callable = shaped(3)
    direction: Float[Array, "*#b 3"] | Callable = shaped(3)
    radius: Float[Array, "*#b"] = shaped()

    def __init__(
        self,
        position: ArrayLike | Callable,
        direction: ArrayLike | Callable,
        radius: ArrayLike = 6.378137e6,
    ):
        self.position = vector_of_time("Eclipse position", position)
        self.direction = _direction_of_time("Eclipse direction", direction)
        self.radius = as_positive("Eclipse radius", radius)

    @property
    def input_conditions(self) -> tuple[Array, ...]:
        conditions = above_zero(self.radius)
        if not callable(self.direction):
            conditions += (jnp.all(jnp.isfinite(self.direction), axis=-1),)
        return conditions

    def __call__(self, t: Array | float) -> Array:
        r = value_at("Eclipse position", self.position, t)
        s = value_at("Eclipse direction", self.direction, t)
        along, square = dot(r, s), dot(s, s)
        across = cross(r, s)
        outside = dot(across, across) > self.radius**2 * square
        return jnp.where((along > 0) | outside, 1, 0).astype(along.dtype)
