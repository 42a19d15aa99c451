"""What acts between a wheel and the body about the wheel's axis: motors, friction, dampers.

The wheel takes the torque, the body its reaction; the wheel's momentum is then part of the state.
"""

import abc
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from polhode._checks import as_number, is_concrete, require
from polhode.hamiltonian import Attitude
from polhode.parts import AbstractPart, shaped


class AbstractCoupling(AbstractPart):
    """Base of what acts between a wheel and its body; couplings add with ``+``.

    ``torque(t, speed, attitude, omega)`` returns the torque [N m] on the wheel about its axis;
    ``speed``: that of the wheel relative to the body [rad/s].
    """

    @abc.abstractmethod
    def torque(
        self, t: Array | float, speed: Array, attitude: Attitude, omega: Sequence[Array]
    ) -> Array:
        """Torque on the wheel about its axis [N m]."""

    def __add__(self, other: "AbstractCoupling") -> "CouplingSum":
        if not isinstance(other, AbstractCoupling):
            raise TypeError(f"a coupling adds to another coupling, not to {type(other).__name__}")
        return CouplingSum((*_terms(self), *_terms(other)))


def _terms(coupling: AbstractCoupling) -> tuple[AbstractCoupling, ...]:
    return coupling.terms if isinstance(coupling, CouplingSum) else (coupling,)


class CouplingSum(AbstractCoupling):
    """Sum of couplings of one wheel."""

    terms: tuple[AbstractCoupling, ...]

    def torque(self, t, speed, attitude, omega):
        first, *rest = (term.torque(t, speed, attitude, omega) for term in self.terms)
        return sum(rest, start=first)


class Couplings(AbstractPart):
    """Those of several wheels, one each."""

    terms: tuple[AbstractCoupling, ...]


def _not_negative(name: str, value) -> Array:
    number = as_number(name, value)
    if is_concrete(number):
        require(
            np.asarray(number) >= 0,
            f"{name} must not be negative, got {value}: friction takes energy away.",
        )
    return number


class ViscousCoupling(AbstractCoupling):
    """Friction -c Omega on a wheel: a bearing, or a ring or wheel in a fluid that damps nutation.

    ``c`` (...) [N m s], not negative. A wheel with nothing else damps the motion of its body at
    constant angular momentum:

        ring = ph.ViscousCoupling(0.01)
        damper = ph.Rotor([0.0, 1.0, 0.0], inertia=0.02, speed=0.0, coupling=ring)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]), rotors=damper)

    Raises ValueError for a negative c.
    """

    c: Float[Array, "*#b"] = shaped()

    def __init__(self, c):
        self.c = _not_negative("ViscousCoupling c", c)

    def torque(self, t, speed, attitude, omega):
        return -self.c * speed
