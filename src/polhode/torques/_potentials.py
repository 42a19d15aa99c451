"""Potentials: energy as a function of attitude and time; torques follow from the one H."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import as_float_array, as_number, is_concrete, require
from polhode.hamiltonian import Attitude, components, dot
from polhode.inertia import Inertia


class AbstractPotential(eqx.Module):
    """Base of all potentials; they add with ``+``.

    ``energy(attitude, t, inertia)`` returns joules from component arrays: use
    ``attitude.row(i)``, ``to_body``, ``to_space`` (only the rows looked at are computed and
    differentiated). ``core_ranks`` names the array fields with their ranks without batch axes.
    """

    core_ranks: eqx.AbstractClassVar[dict[str, int]]

    @abc.abstractmethod
    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        """Potential energy [J]."""

    def __add__(self, other: "AbstractPotential") -> "PotentialSum":
        if not isinstance(other, AbstractPotential):
            raise TypeError(f"a potential adds to another potential, not to {type(other).__name__}")
        return PotentialSum((*_terms(self), *_terms(other)))


def _terms(potential: AbstractPotential) -> tuple[AbstractPotential, ...]:
    return potential.terms if isinstance(potential, PotentialSum) else (potential,)


class PotentialSum(AbstractPotential):
    """Sum of potentials."""

    terms: tuple[AbstractPotential, ...]

    core_ranks = {}  # noqa: RUF012

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        first, *rest = (term.energy(attitude, t, inertia) for term in self.terms)
        return sum(rest, start=first)


class UniformGravity(AbstractPotential):
    """Weight of a body turning about a fixed point: V = -mass g_space . (R centre_body).

    **Arguments:** ``mass`` (...) [kg]; ``centre_body`` (..., 3) from the fixed point to the centre
    of mass [m], body axes; ``gravity_space`` (..., 3) [m/s^2], space axes. The inertia of the
    scene is then the one about the fixed point.

    ``on_axis`` (static): whether the centre is known to lie on body z; see ``axial``. ``vertical``
    (static): whether gravity is known to be along space z; then its other components are not used.

    Raises ValueError for a negative mass, NaN, or wrong shapes.
    """

    mass: Float[Array, "*#b"]
    centre_body: Float[Array, "*#b 3"]
    gravity_space: Float[Array, "*#b 3"]
    on_axis: bool = eqx.field(static=True, default=False)
    vertical: bool = eqx.field(static=True, default=False)

    core_ranks = {"mass": 0, "centre_body": 1, "gravity_space": 1}  # noqa: RUF012

    def __init__(
        self,
        mass,
        centre_body,
        gravity_space=(0.0, 0.0, -9.80665),
        on_axis=False,
        vertical=False,
    ):
        self.mass = as_number("mass", mass)
        self.centre_body = as_float_array("centre_body", centre_body, (3,))
        self.gravity_space = as_float_array("gravity_space", gravity_space, (3,))
        if is_concrete(self.mass):
            require(
                np.asarray(self.mass) >= 0, f"mass must not be negative, got {mass}: give it in kg."
            )
        self.on_axis, self.vertical = bool(on_axis), bool(vertical)
        if self.vertical and is_concrete(self.gravity_space):
            require(
                np.asarray(self.gravity_space)[..., :2] == 0,
                f"vertical says that gravity is along space z, got {gravity_space}: leave it out.",
            )
        if self.on_axis and is_concrete(self.centre_body):
            require(
                np.asarray(self.centre_body)[..., :2] == 0,
                f"on_axis says that the centre lies on body z, got {centre_body}: leave it out.",
            )

    @classmethod
    def axial(cls, mass, distance, gravity_space=(0.0, 0.0, -9.80665)) -> "UniformGravity":
        """A centre of mass on body z, ``distance`` (...) [m] from the fixed point.

        With ``Inertia.axisymmetric`` this is Lagrange's top by construction: the exact motion is
        found under ``jit`` and ``grad`` too.
        """
        distance = as_number("distance", distance)
        zero = jnp.zeros_like(distance)
        return cls(mass, jnp.stack([zero, zero, distance], axis=-1), gravity_space, True)

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        centre, gravity = components(self.centre_body), components(self.gravity_space)

        def along(i):
            row = attitude.row(i)
            return gravity[i] * (row[2] * centre[2] if self.on_axis else dot(row, centre))

        work = along(2) if self.vertical else along(0) + along(1) + along(2)
        return -self.mass * work


def value_at(vector, t):
    """Components of a vector that is constant or a function ``fn(t) -> (3,)`` of one time.

    ``t`` may be an array of times; the function is mapped over it.
    """
    if not callable(vector):
        return components(vector)
    if hasattr(vector, "core_ranks"):  # carries the batch axes itself, such as KeplerOrbit
        return components(vector(t))
    return components(jnp.vectorize(vector, signature="()->(3)")(t))


class GravityGradient(AbstractPotential):
    """Gravity gradient of a point mass to second order: V = -mu (tr I - 3 n . I n) / (2 r^3).

    The torque is ``3 mu/r^3 n x (I n)``. **Arguments:** ``mu`` (...) [m^3/s^2]; ``position_space``:
    the body relative to the attracting centre, space axes [m], constant (..., 3) or a function of
    time [s] returning (3,). ``vertical`` (static): whether a constant position is known to be along
    space z; then its other components are not used.

    Raises ValueError for mu < 0, a position at the centre, or one that ``vertical`` denies.
    """

    mu: Float[Array, "*#b"]
    position_space: Float[Array, "*#b 3"] | Callable
    vertical: bool = eqx.field(static=True, default=False)

    core_ranks = {"mu": 0, "position_space": 1}  # noqa: RUF012

    def __init__(self, mu, position_space, vertical=False):
        self.mu = as_number("mu", mu)
        self.vertical = bool(vertical)
        if is_concrete(self.mu):
            require(
                np.asarray(self.mu) >= 0, f"mu must not be negative, got {mu}: give it in m^3/s^2."
            )
        if callable(position_space):
            require(not vertical, "vertical is for a constant position: leave it out.")
            self.position_space = position_space
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
                    f"vertical says that the position is along space z, got {position_space}:"
                    " leave it out.",
                )

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        place = value_at(self.position_space, t)
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


class Potential(AbstractPotential):
    """Any potential of the attitude: ``fn(R, t)`` in joules, R (3, 3) body -> space, t in s.

    ``fn`` sees one body; batches are mapped over it. Its torque comes from ``jax.grad`` of H.
    """

    fn: Callable

    core_ranks = {}  # noqa: RUF012

    def __init__(self, fn: Callable):
        if not callable(fn):
            raise TypeError(f"Potential takes a function fn(R, t), got {type(fn).__name__}.")
        self.fn = fn

    def energy(self, attitude: Attitude, t: Array | float, inertia: Inertia) -> Array:
        return jnp.vectorize(self.fn, signature="(3,3),()->()")(attitude.matrix, t)
