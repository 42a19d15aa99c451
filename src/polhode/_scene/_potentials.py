"""Potentials: energies as functions of attitude and time; torques follow from the Hamiltonian."""

import abc
from collections.abc import Callable, Sequence
from typing import Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_number,
    as_positive,
    default_array,
    is_concrete,
    require,
)
from polhode._hamiltonian import Attitude, components, dot
from polhode._parts import AbstractPart, AbstractSum, Signature, shaped, terms_of
from polhode._scene._torques import value_at, vector_of_time
from polhode.inertia import Inertia


class AbstractPotential(AbstractPart):
    """Base of all potentials; they add with ``+``.

    ``energy(attitude, t, inertia)`` returns joules from component arrays: use
    ``attitude.row(i)``, ``to_body``, ``to_space`` (only the rows that are used are computed and
    differentiated).
    """

    @abc.abstractmethod
    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        """Potential energy [J]."""

    def __add__(self, other: "AbstractPotential") -> "PotentialSum":
        return PotentialSum(terms_of("potential", AbstractPotential, self, other))


class PotentialSum(AbstractPotential, AbstractSum):
    """Sum of potentials."""

    terms: tuple[AbstractPotential, ...]

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        first, *rest = (term.energy(attitude, t, inertia) for term in self.terms)
        return sum(rest, start=first)


_STANDARD = (0.0, 0.0, -9.80665)


class UniformGravity(AbstractPotential):
    """Weight of a body that rotates about a fixed point: V = -mass g_space . (R centre_body).

    **Arguments:** ``mass`` (...) [kg]; ``centre_body`` (..., 3) from the fixed point to the centre
    of mass [m], body axes; ``gravity_space`` (..., 3) [m/s^2], space axes. The inertia of the
    scene must be the one about the fixed point. For a centre of mass on body z use ``axial``, with
    its ``distance`` (...) [m] in place of ``centre_body``.

    Raises ValueError for a negative mass, NaN, wrong shapes, or not exactly one of centre_body and
    distance.
    """

    mass: Float[Array, "*#b"] = shaped()
    centre_body: Float[Array, "*#b 3"] | None = shaped(3)
    gravity_space: Float[Array, "*#b 3"] = shaped(3)
    distance: Float[Array, "*#b"] | None = shaped()

    def __init__(
        self,
        mass: ArrayLike,
        centre_body: ArrayLike | None = None,
        gravity_space: ArrayLike = _STANDARD,
        *,
        distance: ArrayLike | None = None,
    ):
        self.mass = as_positive("mass", mass, zero=True, hint="give it in kg")
        require(
            (centre_body is None) != (distance is None),
            "UniformGravity takes a centre_body (..., 3), or of a centre of mass on body z its"
            " distance (UniformGravity.axial).",
        )
        self.centre_body = self.distance = None
        if centre_body is not None:
            hint = "for a distance along body z use UniformGravity.axial(mass, distance)"
            self.centre_body = as_float_array("centre_body", centre_body, (3,), hint=hint)
        else:
            self.distance = as_number("distance", distance)
        gravity = default_array(_STANDARD) if gravity_space is _STANDARD else gravity_space
        self.gravity_space = as_float_array("gravity_space", gravity, (3,))

    @classmethod
    def axial(
        cls, mass: ArrayLike, distance: ArrayLike, gravity_space: ArrayLike = _STANDARD
    ) -> Self:
        """A centre of mass on body z, ``distance`` (...) [m] from the fixed point.

        With ``Inertia.axisymmetric`` this is Lagrange's top, which has a closed-form solution.
        """
        return cls(mass, None, gravity_space, distance=distance)

    @property
    def centre(self) -> Float[Array, "*b 3"]:
        """From the fixed point to the centre of mass (..., 3) [m], body axes."""
        if self.centre_body is not None:
            return self.centre_body
        zero = jnp.zeros_like(self.distance)
        return jnp.stack([zero, zero, self.distance], axis=-1)

    def height(self, row: Sequence[Array]) -> Array:
        """Component (...) [m] of the centre along a space axis, whose ``row`` of R is given."""
        if self.distance is not None:
            return row[2] * self.distance
        return dot(row, components(self.centre))

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        gravity = components(self.gravity_space)
        first, *rest = (gravity[i] * self.height(attitude.row(i)) for i in range(3))
        return -self.mass * sum(rest, start=first)


class AlongZ(AbstractPotential):
    """Uniform gravity or a gravity gradient in a frame with its z axis along the field.

    The energy then depends on one row of R only. ``field``: the potential, whose direction is not
    used; ``strength`` (...): the weight [N] along z, or the distance [m] from the attracting
    centre, of either sign.
    """

    field: "UniformGravity | GravityGradient" = shaped()
    strength: Float[Array, "*#b"] = shaped()

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        row = attitude.row(2)
        if isinstance(self.field, UniformGravity):
            return -self.strength * self.field.height(row)
        distance = jnp.abs(self.strength)
        return _gradient_energy(self.field.mu, distance, row, inertia)


class GravityGradient(AbstractPotential):
    """Gravity gradient of a point mass to second order: V = -mu (tr I - 3 n . I n) / (2 r^3).

    The torque is ``3 mu/r^3 n x (I n)``. **Arguments:** ``mu`` (...) [m^3/s^2]; ``position_space``:
    the body relative to the attracting centre, space axes [m], constant (..., 3) or a function of
    time [s] returning (3,).

    Raises ValueError for mu < 0 or a position at the centre.
    """

    mu: Float[Array, "*#b"] = shaped()
    position_space: Float[Array, "*#b 3"] | Callable = shaped(3)

    def __init__(self, mu: ArrayLike, position_space: ArrayLike | Callable):
        self.mu = as_positive("mu", mu, zero=True, hint="give it in m^3/s^2")
        self.position_space = vector_of_time("GravityGradient", position_space)
        if not callable(self.position_space) and is_concrete(self.position_space):
            require(
                np.any(np.asarray(self.position_space) != 0, axis=-1),
                "position_space must not be zero: it is the body's position relative to the"
                " attracting centre, in metres.",
            )

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        place = value_at("GravityGradient", self.position_space, t)
        distance = jnp.sqrt(dot(place, place))
        direction = attitude.to_body(tuple(x / distance for x in place))
        return _gradient_energy(self.mu, distance, direction, inertia)


def _gradient_energy(mu, distance, direction, inertia: Inertia) -> Array:
    """The energy; ``direction``: body components of the unit vector to the centre, either sign."""
    if inertia.is_principal:
        moments = components(inertia.moments)
        trace = moments[0] + moments[1] + moments[2]
        project = sum(moment * x * x for moment, x in zip(moments, direction))
    else:
        tensor = inertia.tensor
        trace = jnp.trace(tensor, axis1=-2, axis2=-1)
        rows = tuple(dot(components(tensor[..., i, :]), direction) for i in range(3))
        project = dot(direction, rows)
    # separate factors: the derivative of x / distance**3 has distance**-6, subnormal in float32
    inverse = 1 / distance
    return -mu / 2 * inverse * inverse * inverse * (trace - 3 * project)


_FUNCTION = Signature("Potential", {"R": (3, 3), "t": ()})


class Potential(AbstractPotential):
    """Any potential of the attitude: ``fn(R, t)`` in joules, R (3, 3) body -> space, t in s.

    ``fn`` is called for one body; batches are mapped over it. Its torque follows by ``jax.grad`` of
    H. A plain function is static data of the scene, not a leaf of it; the arrays of an
    ``eqx.Module`` are leaves, shared by all bodies.

    Raises TypeError or ValueError for a function that takes or returns something else.
    """

    fn: Callable

    def __init__(self, fn: Callable):
        self.fn = _FUNCTION.checked(fn)

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        return _FUNCTION.mapped(self.fn, attitude.matrix, t)
