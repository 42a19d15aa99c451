"""Potentials: energy as a function of attitude and time; torques follow from the one H."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_number,
    as_positive,
    is_concrete,
    numbers,
    require,
    together,
)
from polhode._hamiltonian import Attitude, components, dot
from polhode._parts import AbstractPart, Signature, shaped, terms_of
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

    @property
    def is_as_declared(self) -> Any:
        """Whether (...) the numbers are such as static fields say; None where these say nothing."""
        return None

    def declared_anew(self) -> "AbstractPotential":
        """The same numbers with static fields that agree with them."""
        return self

    def __add__(self, other: "AbstractPotential") -> "PotentialSum":
        return PotentialSum(terms_of("potential", AbstractPotential, PotentialSum, self, other))


class PotentialSum(AbstractPotential):
    """Sum of potentials."""

    terms: tuple[AbstractPotential, ...]

    @property
    def is_as_declared(self):
        found = [x for term in self.terms if (x := term.is_as_declared) is not None]
        return together(found)

    def declared_anew(self):
        return PotentialSum(tuple(term.declared_anew() for term in self.terms))

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        first, *rest = (term.energy(attitude, t, inertia) for term in self.terms)
        return sum(rest, start=first)


class UniformGravity(AbstractPotential):
    """Weight of a body that rotates about a fixed point: V = -mass g_space . (R centre_body).

    **Arguments:** ``mass`` (...) [kg]; ``centre_body`` (..., 3) from the fixed point to the centre
    of mass [m], body axes; ``gravity_space`` (..., 3) [m/s^2], space axes. The inertia of the
    scene is then the one about the fixed point.

    ``on_axis`` (static): whether the centre is known to lie on body z; see ``axial``. ``vertical``
    (static): whether gravity is known to be along space z; then its other components are not used.

    Raises ValueError for a negative mass, NaN, or wrong shapes.
    """

    mass: Float[Array, "*#b"] = shaped()
    centre_body: Float[Array, "*#b 3"] = shaped(3)
    gravity_space: Float[Array, "*#b 3"] = shaped(3)
    on_axis: bool = eqx.field(static=True, default=False)
    vertical: bool = eqx.field(static=True, default=False)

    def __init__(
        self,
        mass: ArrayLike,
        centre_body: ArrayLike,
        gravity_space: ArrayLike = (0.0, 0.0, -9.80665),
        on_axis: bool = False,
        vertical: bool = False,
    ):
        self.mass = as_positive("mass", mass, zero=True, hint="give it in kg")
        self.centre_body = as_float_array("centre_body", centre_body, (3,))
        self.gravity_space = as_float_array("gravity_space", gravity_space, (3,))
        self.on_axis, self.vertical = bool(on_axis), bool(vertical)
        if self.vertical and is_concrete(self.gravity_space):
            require(
                np.asarray(self.gravity_space)[..., :2] == 0,
                lambda: (
                    f"vertical says that gravity is along space z, got {gravity_space}: leave it"
                    " out."
                ),
            )
        if self.on_axis and is_concrete(self.centre_body):
            require(
                np.asarray(self.centre_body)[..., :2] == 0,
                lambda: (
                    f"on_axis says that the centre lies on body z, got {centre_body}: leave it out."
                ),
            )

    @classmethod
    def axial(
        cls, mass: ArrayLike, distance: ArrayLike, gravity_space: ArrayLike = (0.0, 0.0, -9.80665)
    ) -> "UniformGravity":
        """A centre of mass on body z, ``distance`` (...) [m] from the fixed point.

        With ``Inertia.axisymmetric`` this is Lagrange's top by construction: the exact motion is
        found under ``jit`` and ``grad`` too.
        """
        distance = as_number("distance", distance)
        zero = jnp.zeros_like(distance)
        return cls(mass, jnp.stack([zero, zero, distance], axis=-1), gravity_space, True)

    @property
    def is_as_declared(self) -> Any:
        return _on_z(
            self.centre_body if self.on_axis else None,
            self.gravity_space if self.vertical else None,
        )

    def declared_anew(self) -> "UniformGravity":
        return UniformGravity(self.mass, self.centre_body, self.gravity_space)

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        centre, gravity = components(self.centre_body), components(self.gravity_space)

        def along(i):
            row = attitude.row(i)
            return gravity[i] * (row[2] * centre[2] if self.on_axis else dot(row, centre))

        work = along(2) if self.vertical else along(0) + along(1) + along(2)
        return -self.mass * work


def _on_z(*vectors: Array | None) -> Any:
    """Whether (...) all of the vectors lie on the third axis; None for no vectors."""
    given = [v for v in vectors if v is not None]
    xp = numbers(*given)
    found = [xp.all(xp.asarray(v)[..., :2] == 0, axis=-1) for v in given]
    return together(found)


class GravityGradient(AbstractPotential):
    """Gravity gradient of a point mass to second order: V = -mu (tr I - 3 n . I n) / (2 r^3).

    The torque is ``3 mu/r^3 n x (I n)``. **Arguments:** ``mu`` (...) [m^3/s^2]; ``position_space``:
    the body relative to the attracting centre, space axes [m], constant (..., 3) or a function of
    time [s] returning (3,). ``vertical`` (static): whether a constant position is known to be along
    space z; then its other components are not used.

    Raises ValueError for mu < 0, a position at the centre, or one that ``vertical`` denies.
    """

    mu: Float[Array, "*#b"] = shaped()
    position_space: Float[Array, "*#b 3"] | Callable = shaped(3)
    vertical: bool = eqx.field(static=True, default=False)

    def __init__(self, mu: ArrayLike, position_space: ArrayLike | Callable, vertical: bool = False):
        self.mu = as_positive("mu", mu, zero=True, hint="give it in m^3/s^2")
        self.vertical = bool(vertical)
        if callable(position_space):
            require(not vertical, "vertical is for a constant position: leave it out.")
            self.position_space = vector_of_time("GravityGradient", position_space)
        else:
            self.position_space = as_float_array("position_space", position_space, (3,))
            if is_concrete(self.position_space):
                require(
                    np.any(np.asarray(self.position_space) != 0, axis=-1),
                    "position_space must not be zero: it is the body's position relative to the"
                    " attracting centre, in metres.",
                )
                require(
                    not vertical or np.all(np.asarray(self.position_space)[..., :2] == 0),
                    lambda: (
                        f"vertical says that the position is along space z, got {position_space}:"
                        " leave it out."
                    ),
                )

    @property
    def is_as_declared(self) -> Any:
        return _on_z(self.position_space if self.vertical else None)

    def declared_anew(self) -> "GravityGradient":
        return GravityGradient(self.mu, self.position_space)

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        place = value_at("GravityGradient", self.position_space, t)
        if self.vertical:
            distance = jnp.abs(place[2])
            square, along = distance * distance, attitude.row(2)  # of either sign: a square
        else:
            square = dot(place, place)
            distance = jnp.sqrt(square)
            along = attitude.to_body(tuple(x / distance for x in place))
        if inertia.is_principal:
            moments = components(inertia.moments)
            trace = moments[0] + moments[1] + moments[2]
            project = sum(moment * x * x for moment, x in zip(moments, along))
        else:
            tensor = inertia.tensor
            trace = jnp.trace(tensor, axis1=-2, axis2=-1)
            turned = tuple(dot(components(tensor[..., i, :]), along) for i in range(3))
            project = dot(along, turned)
        return -self.mu / (2 * square * distance) * (trace - 3 * project)


_FUNCTION = Signature("Potential", {"R": (3, 3), "t": ()})


class Potential(AbstractPotential):
    """Any potential of the attitude: ``fn(R, t)`` in joules, R (3, 3) body -> space, t in s.

    ``fn`` sees one body; batches are mapped over it. Its torque comes from ``jax.grad`` of H. A
    plain function is static data of the scene, not a leaf of it; an ``eqx.Module`` keeps its arrays
    as leaves, shared by all bodies.

    Raises TypeError or ValueError for a function that takes or returns something else.
    """

    fn: Callable

    def __init__(self, fn: Callable):
        self.fn = _FUNCTION.checked(fn)

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        return _FUNCTION.mapped(self.fn, attitude.matrix, t)
