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

    - ``axis_body`` (..., 3): its axis in body axes (normalised).
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
    along: int | None = eqx.field(static=True)
    axis_body: Float[Array, "*#b 3"] = shaped(3)
    inertia: Float[Array, "*#b"] | None = shaped()
    momentum: Float[Array, "*#b"] | None = shaped()
    speed: Float[Array, "*#b"] | None = shaped()
    torque: Float[Array, "*#b"] | None = shaped()
    coupling: AbstractCoupling | None = shaped()

    def __init__(
        self,
        axis_body: ArrayLike,
        inertia: ArrayLike | None = None,
        momentum: ArrayLike | None = None,
        speed: ArrayLike | None = None,
        torque: ArrayLike | None = None,
        impulse: Callable | None = None,
        coupling: AbstractCoupling | None = None,
    ):
        axis = as_float_array("axis_body", axis_body, (3,))
        self.along = None
        if is_concrete(axis):
            require(
                np.any(np.asarray(axis) != 0, axis=-1),
                lambda: (
                    f"axis_body must not be zero, got {axis_body}: give the wheel's axis in body"
                    " axes."
                ),
            )
            self.along = _body_axis(np.asarray(axis))
        self.axis_body = _unit(axis)
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

    @property
    def is_held(self) -> bool:
        """Whether the speed relative to the body is prescribed (static)."""
        return self.torque is None and self.impulse is None and self.coupling is None

    @property
    def wheels(self) -> tuple["Rotor", ...]:
        return (self,)

    def declared_anew(self) -> "Rotor":
        return Rotor(
            self.axis_body, self.inertia, self.momentum, self.speed, self.torque, self.impulse,
            self.coupling,
        )  # fmt: skip

    def column(
        self, omega_body: Array, start: Array, wheel_speed: Array | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """Axis, its momentum at the start (relative if held, else absolute), J, motor torque.

        ``wheel_speed`` (...) [rad/s]: at the start, of a wheel that is not held; None: its own.
        """
        parts = (self.axis_body, self.inertia, self.momentum, self.speed, self.torque)
        shapes = [x.shape[:-1] if x is self.axis_body else x.shape for x in parts if x is not None]
        if not self.is_held:
            shapes += [omega_body.shape[:-1], start.shape]
            shapes += [] if wheel_speed is None else [wheel_speed.shape]
        lead = np.broadcast_shapes(*shapes)
        zero = jnp.zeros(lead, self.axis_body.dtype)
        axis = jnp.broadcast_to(_unit(self.axis_body), (*lead, 3))
        inertia, momentum, speed, torque = (zero if x is None else x + zero for x in parts[1:])
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


def _body_axis(axis: np.ndarray) -> int | None:
    """Which body axis all of the axes lie on, or None."""
    used = [i for i in range(3) if np.any(axis[..., i] != 0)]
    return used[0] if len(used) == 1 else None
