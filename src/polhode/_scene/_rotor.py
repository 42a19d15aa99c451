"""A wheel as the user gives it."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_number,
    is_concrete,
    require,
    require_positive,
)
from polhode._parts import shaped
from polhode._scene._couplings import AbstractCoupling
from polhode._scene._rotors import IMPULSE, AbstractRotor


class Rotor(AbstractRotor):
    """A wheel on an axis fixed in the body.

    **Arguments:**

    - ``axis_body`` (..., 3): its axis in body axes (normalised). A wheel on body x, y or z:
      ``Rotor.axial``.
    - ``inertia`` (...): its moment J about that axis [kg m^2]; already part of the body's inertia.
      May be left out when ``momentum`` is given and no ``torque``, ``impulse`` or ``coupling``.
    - exactly one of ``momentum`` (...) = J Omega [kg m^2/s] and ``speed`` (...) = Omega [rad/s],
      both relative to the body, at the first time. A state with a ``wheel_speed`` replaces them,
      except for a prescribed speed.
    - ``torque`` (...) [N m]: torque of the motor on the wheel about its axis, with the reaction on
      the body; 0: the wheel spins freely. None: the speed is prescribed.
    - ``impulse``: instead of ``torque``, an antiderivative of a motor torque that varies: a
      function of time [s] returning N m s.
    - ``coupling``: instead of both, what acts between wheel and body by the wheel's speed, the time
      and the state: ``ph.ViscousCoupling`` or a sum of such. Exact methods have no such wheels.

    Raises ValueError for a zero axis, J <= 0, or more or less than one of momentum and speed.
    """

    impulse: Callable | None
    axis: int | None = eqx.field(static=True)
    axis_body: Float[Array, "*#b 3"] | None = shaped(3)
    inertia: Float[Array, "*#b"] | None = shaped()
    momentum: Float[Array, "*#b"] | None = shaped()
    speed: Float[Array, "*#b"] | None = shaped()
    torque: Float[Array, "*#b"] | None = shaped()
    coupling: AbstractCoupling | None = shaped()

    def __init__(
        self,
        axis_body: ArrayLike | None = None,
        inertia: ArrayLike | None = None,
        momentum: ArrayLike | None = None,
        speed: ArrayLike | None = None,
        torque: ArrayLike | None = None,
        impulse: Callable | None = None,
        coupling: AbstractCoupling | None = None,
        *,
        axis: int | None = None,
    ):
        require(
            axis in (None, 0, 1, 2) and (axis is None) != (axis_body is None),
            "Rotor takes an axis_body (..., 3), or of a wheel on a body axis its number 0, 1 or 2"
            " (Rotor.axial).",
        )
        self.axis, self.axis_body = axis, None
        if axis_body is not None:
            vector = as_float_array("axis_body", axis_body, (3,))
            if is_concrete(vector):
                require(
                    np.any(np.asarray(vector) != 0, axis=-1),
                    lambda: (
                        f"axis_body must not be zero, got {axis_body}: give the wheel's axis in"
                        " body axes."
                    ),
                )
            self.axis_body = _unit(vector)
        if (momentum is None) == (speed is None):
            raise ValueError(
                "Rotor takes exactly one of momentum (J Omega relative to the body, kg m^2/s) and"
                " speed (Omega relative to the body, rad/s)."
            )
        if sum(x is not None for x in (torque, impulse, coupling)) > 1:
            raise ValueError(
                "Rotor takes torque (a constant motor torque, N m), impulse (a function of time,"
                " N m s: the antiderivative of a varying one) or coupling, not both."
            )
        if not isinstance(coupling, AbstractCoupling | None):
            raise TypeError(
                "Rotor coupling must be a coupling such as ph.ViscousCoupling(0.01), got"
                f" {type(coupling).__name__}."
            )
        self.coupling = coupling
        if callable(torque):
            raise TypeError(
                "Rotor torque must be a number; for a motor torque that varies with time give its"
                " antiderivative: impulse=lambda t: ... [N m s], so that the wheel's momentum is"
                " exact."
            )
        if impulse is not None:
            impulse = IMPULSE.checked(impulse)
        given = {"inertia": inertia, "momentum": momentum, "speed": speed, "torque": torque}
        for name, value in given.items():
            setattr(self, name, None if value is None else as_number(name, value))
        self.impulse = impulse
        if inertia is None and (speed is not None or not self.is_held):
            raise ValueError(
                "Rotor needs inertia, the wheel's moment about its axis in kg m^2, unless it is"
                " held at a given momentum."
            )
        if self.inertia is not None:
            require_positive("the rotor's inertia", self.inertia, hint="give it in kg m^2")

    @classmethod
    def axial(
        cls,
        inertia: ArrayLike | None = None,
        momentum: ArrayLike | None = None,
        speed: ArrayLike | None = None,
        torque: ArrayLike | None = None,
        impulse: Callable | None = None,
        coupling: AbstractCoupling | None = None,
        *,
        axis: int = 2,
    ) -> "Rotor":
        """A wheel on a body axis: ``axis`` 0, 1 or 2 for body x, y or z.

        The other arguments are those of ``Rotor``. A symmetric body with wheels on body z that are
        held at their speed has closed-form solutions, and with wheels on its axes it keeps them as
        principal axes.
        """
        return cls(None, inertia, momentum, speed, torque, impulse, coupling, axis=axis)

    @property
    def direction(self) -> Float[Array, "*b 3"]:
        """Unit vector (..., 3) of the axis in the body."""
        if self.axis_body is not None:
            return _unit(self.axis_body)
        number = self.speed if self.momentum is None else self.momentum
        return jnp.eye(3, dtype=jnp.asarray(number).dtype)[self.axis]

    @property
    def is_held(self) -> bool:
        """Whether the speed relative to the body is prescribed (static)."""
        return self.torque is None and self.impulse is None and self.coupling is None

    @property
    def wheels(self) -> tuple["Rotor", ...]:
        return (self,)

    def column(
        self, omega_body: Array, start: Array, wheel_speed: Array | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """Axis, its momentum at the start (relative if held, else absolute), J, motor torque.

        ``wheel_speed`` (...) [rad/s]: at the start, of a wheel that is not held; None: its own.
        """
        direction = self.direction
        parts = (self.inertia, self.momentum, self.speed, self.torque)
        shapes = [direction.shape[:-1], *(x.shape for x in parts if x is not None)]
        if not self.is_held:
            shapes += [omega_body.shape[:-1], start.shape]
            shapes += [] if wheel_speed is None else [wheel_speed.shape]
        lead = np.broadcast_shapes(*shapes)
        zero = jnp.zeros(lead, direction.dtype)
        axis = jnp.broadcast_to(direction, (*lead, 3))
        inertia, momentum, speed, torque = (zero if x is None else x + zero for x in parts)
        if self.momentum is None:
            momentum = inertia * speed
        if self.is_held:
            return axis, momentum, inertia, zero
        if wheel_speed is not None:
            momentum = inertia * jnp.broadcast_to(wheel_speed, lead)
        turning = jnp.sum(axis * jnp.broadcast_to(omega_body, (*lead, 3)), axis=-1)
        return axis, momentum + inertia * turning, inertia, torque


def _unit(axis: Array) -> Array:
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(axis), axis=-1, keepdims=True))
    axis = axis / largest  # of any size: nothing overflows
    return axis / jnp.sqrt(jnp.sum(axis**2, axis=-1, keepdims=True))
