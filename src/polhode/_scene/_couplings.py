"""What acts between a wheel and the body about the wheel's axis: motors, friction, dampers.

The wheel takes the torque, the body its reaction; the wheel's momentum is then part of the state.
"""

import abc
from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_number, as_positive
from polhode._hamiltonian import Attitude
from polhode._parts import AbstractPart, Signature, shaped, terms_of
from polhode._scene._torques import stacked


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
        return CouplingSum(terms_of("coupling", AbstractCoupling, CouplingSum, self, other))


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
    return as_positive(name, value, zero=True, hint="friction takes energy away")


class ViscousCoupling(AbstractCoupling):
    """Viscous friction -c Omega on a wheel: a bearing, or a ring in a fluid that damps nutation.

    ``c`` (...) [N m s], not negative. A wheel with nothing else damps the motion of its body at
    constant angular momentum:

        ring = ph.ViscousCoupling(0.01)
        damper = ph.Rotor([0.0, 1.0, 0.0], inertia=0.02, speed=0.0, coupling=ring)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]), rotors=damper)

    Raises ValueError for a negative c.
    """

    c: Float[Array, "*#b"] = shaped()

    def __init__(self, c: ArrayLike):
        self.c = _not_negative("ViscousCoupling c", c)

    def torque(
        self, t: Array | float, speed: Array, attitude: Attitude, omega: Sequence[Array]
    ) -> Array:
        return -self.c * speed


class CoulombFriction(AbstractCoupling):
    """Dry friction of a bearing, smoothed: -torque tanh(Omega / speed) on the wheel.

    ``torque`` (...) [N m] and ``speed`` (...) [rad/s] below which it falls to zero, both not
    negative, the speed positive. The step of dry friction itself has no solution that an explicit
    integrator can follow at rest; here a wheel creeps to rest as if viscous, with torque / speed.
    Raises ValueError for other numbers.
    """

    size: Float[Array, "*#b"] = shaped()
    speed: Float[Array, "*#b"] = shaped()

    def __init__(self, torque: ArrayLike, speed: ArrayLike):
        self.size = _not_negative("CoulombFriction torque", torque)
        self.speed = as_positive("CoulombFriction speed", speed, hint="it smooths the step")

    def torque(
        self, t: Array | float, speed: Array, attitude: Attitude, omega: Sequence[Array]
    ) -> Array:
        return -self.size * jnp.tanh(speed / self.speed)


_COMMAND = Signature("Motor", {"t": (), "wxyz": (4,), "omega_body": (3,), "speed": ()})


class Motor(AbstractCoupling):
    """A motor between body and wheel, with limits of torque and speed.

    **Arguments:** ``command``: torque on the wheel about its axis [N m], a number (...) or a
    function ``fn(t, wxyz, omega_body, speed)`` of one body, the wheel's speed [rad/s] relative to
    it; ``max_torque`` (...) [N m], positive: it gives no more than that; ``max_speed`` (...)
    [rad/s], positive: the accelerating torque falls linearly to zero there (the line of a DC
    motor); the braking torque does not. The speed needs the torque.

    A wheel that controls the attitude, with friction in its bearing:

        def hold(t, wxyz, omega_body, speed):       # the body takes the reaction
            return 0.4 * wxyz[1] * jnp.sign(wxyz[0]) + 0.5 * omega_body[0]

        motor = ph.Motor(hold, max_torque=0.1, max_speed=600.0) + ph.ViscousCoupling(1e-5)
        wheel = ph.Rotor([1.0, 0.0, 0.0], inertia=1e-3, speed=0.0, coupling=motor)

    Raises TypeError or ValueError for other numbers, or a function that takes or returns something
    else.
    """

    command: Float[Array, "*#b"] | Callable = shaped()
    max_torque: Float[Array, "*#b"] | None = shaped()
    max_speed: Float[Array, "*#b"] | None = shaped()

    def __init__(
        self,
        command: ArrayLike | Callable,
        max_torque: ArrayLike | None = None,
        max_speed: ArrayLike | None = None,
    ):
        if callable(command):
            self.command = _COMMAND.checked(command)
        else:
            self.command = as_number("Motor command", command)
        for name, value in (("max_torque", max_torque), ("max_speed", max_speed)):
            setattr(self, name, None if value is None else as_positive(f"Motor {name}", value))
        if max_speed is not None and max_torque is None:
            raise ValueError("Motor max_speed needs max_torque, the torque that falls with it.")

    def torque(
        self, t: Array | float, speed: Array, attitude: Attitude, omega: Sequence[Array]
    ) -> Array:
        wanted = self.command
        if callable(wanted):
            given = t, stacked(attitude.wxyz), stacked(omega), speed
            wanted = _COMMAND.mapped(wanted, *given)
        if self.max_torque is None:
            return wanted
        low, high = -self.max_torque, self.max_torque
        if self.max_speed is not None:
            share = speed / self.max_speed
            high = self.max_torque * jnp.clip(1 - share, 0, 1)
            low = -self.max_torque * jnp.clip(1 + share, 0, 1)
        return jnp.clip(wanted, low, high)
