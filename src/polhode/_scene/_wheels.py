"""Rotors (wheels) whose axes are fixed in the body: gyrostats.

The inertia of the scene is that of the whole body with its wheels locked, including their moments
about their own axes (as Basilisk's hub inertia; some texts exclude the wheels). A wheel of moment J
about the unit axis a, at the speed Omega relative to the body, adds J Omega a to L = I omega. If
that speed is prescribed, L = I omega + J Omega a. If a motor exerts the torque tau about its axis
(0: it spins freely), its momentum c = J (a . omega + Omega) obeys dc/dt = tau, and
L = (I - J a a^T) omega + c a. In both cases the Hamiltonian is the same function of L - h(t), with
a wheel momentum h(t) (Hughes, Spacecraft Attitude Dynamics, 1986, section 3.4, 6). If tau depends
on the state (a coupling: friction, a motor with its limits), c is part of the state.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_number,
    as_positive,
    is_concrete,
    on_host,
    require,
    require_positive,
)
from polhode._hamiltonian import Attitude, Vector, dot, triple
from polhode._parts import AbstractPart, AbstractSum, Signature, shaped, terms_of
from polhode.inertia import Inertia, Symmetry

# Couplings between a wheel and the body about the wheel's axis: motors, friction, dampers. The
# torque acts on the wheel, its reaction on the body; the wheel's momentum is then part of the
# state.


class AbstractCoupling(AbstractPart):
    """Base of couplings between a wheel and its body; couplings add with ``+``.

    ``torque(t, speed, attitude, omega)`` returns the torque [N m] on the wheel about its axis;
    ``speed``: that of the wheel relative to the body [rad/s].
    """

    @abc.abstractmethod
    def torque(
        self, t: Array | float, speed: Array, attitude: Attitude, omega: Sequence[Array]
    ) -> Array:
        """Torque on the wheel about its axis [N m]."""

    def torque_among(
        self,
        t: Array | float,
        i: int,
        speed_of: Callable[[int], Array],
        attitude: Attitude,
        omega: Sequence[Array],
    ) -> Array:
        """``torque`` on wheel ``i``, for couplings that depend on the speeds of all wheels."""
        return self.torque(t, speed_of(i), attitude, omega)

    def __add__(self, other: "AbstractCoupling") -> "CouplingSum":
        return CouplingSum(terms_of("coupling", AbstractCoupling, self, other))


class CouplingSum(AbstractCoupling, AbstractSum):
    """Sum of couplings of one wheel."""

    terms: tuple[AbstractCoupling, ...]

    def torque(self, t, speed, attitude, omega):
        first, *rest = (term.torque(t, speed, attitude, omega) for term in self.terms)
        return sum(rest, start=first)

    def torque_among(self, t, i, speed_of, attitude, omega):
        arguments = t, i, speed_of, attitude, omega
        first, *rest = (term.torque_among(*arguments) for term in self.terms)
        return sum(rest, start=first)


class Couplings(AbstractSum):
    """The couplings of several wheels, one for each."""

    terms: tuple[AbstractCoupling, ...]


def _not_negative(name: str, value) -> Array:
    return as_positive(name, value, zero=True, hint="friction takes energy away")


class ViscousCoupling(AbstractCoupling):
    """Viscous friction -c Omega on a wheel: a bearing, or a ring of fluid that damps nutation.

    ``c`` (...) [N m s], not negative. A wheel with this coupling alone damps the motion of its body
    at constant angular momentum:

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

    ``torque`` (...) [N m], not negative; ``speed`` (...) [rad/s], positive: below it the torque
    falls to zero. Without smoothing the torque jumps at rest, which an explicit integrator cannot
    resolve; here a wheel comes to rest as with viscous friction of coefficient torque / speed.
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


# All wheels of a scene.

IMPULSE = Signature("Rotor impulse", {"t": ()})


class AbstractRotor(AbstractPart):
    """Base of rotors; they add with ``+``."""

    @property
    @abc.abstractmethod
    def wheels(self) -> tuple[Any, ...]:
        """The single wheels."""

    def __add__(self, other: "AbstractRotor") -> "RotorSum":
        if not isinstance(other, AbstractRotor):
            raise TypeError(f"a rotor adds to another rotor, not to {type(other).__name__}")
        return RotorSum((*self.wheels, *other.wheels))

    def check_within(self, inertia: Inertia) -> None:
        """ValueError for a wheel whose moment is not below that of the body about its axis."""
        for wheel in self.wheels:
            if wheel.inertia is None:
                continue
            with jax.ensure_compile_time_eval():  # concrete numbers: evaluated now, even under jit
                about = _moment_about(inertia, wheel.direction)
            require(
                np.asarray(wheel.inertia) < about,
                f"a rotor's inertia ({wheel.inertia} kg m^2) must be less than the body's about the"
                f" same axis ({about}): the scene's inertia is that of the whole body, its wheels"
                " locked and included. Add the wheels to it.",
            )

    def settle(
        self, omega_body: Float[Array, "*#b 3"], start: Array, wheel_speed: Array | None = None
    ) -> "Wheels":
        """The ``Wheels`` of bodies with rates ``omega_body`` at the time ``start`` (...).

        ``wheel_speed`` (..., m) [rad/s]: relative to the body; None: speeds or momenta of the
        rotors.
        """
        speeds = _speeds_of(wheel_speed, len(self.wheels))
        columns = [
            wheel.column(omega_body, start, speed) for wheel, speed in zip(self.wheels, speeds)
        ]
        lead = np.broadcast_shapes(*(x.shape for column in columns for x in column[1:]))
        lead = np.broadcast_shapes(lead, *(column[0].shape[:-1] for column in columns))
        axes = jnp.stack([jnp.broadcast_to(c[0], (*lead, 3)) for c in columns], axis=-2)
        momentum, inertia, torque = (
            jnp.stack([jnp.broadcast_to(column[i], lead) for column in columns], axis=-1)
            for i in (1, 2, 3)
        )
        couplings = tuple(w.coupling for w in self.wheels if w.coupling is not None)
        return Wheels(
            impulses=tuple(wheel.impulse for wheel in self.wheels),
            is_held=tuple(wheel.is_held for wheel in self.wheels),
            along=tuple(wheel.axis for wheel in self.wheels),
            coupled=tuple(i for i, wheel in enumerate(self.wheels) if wheel.coupling is not None),
            axes=axes,
            momentum=momentum,
            inertia=inertia,
            torque=torque,
            start=start,
            couplings=Couplings(couplings) if couplings else None,
        )


class RotorSum(AbstractRotor, AbstractSum):
    """Several rotors."""

    terms: tuple[AbstractRotor, ...]

    @property
    def wheels(self):
        return self.terms


def _speeds_of(wheel_speed: Array | None, count: int) -> Sequence[Array | None]:
    """The speed (...) of each of ``count`` wheels; all None if ``wheel_speed`` is None."""
    if wheel_speed is None:
        return [None] * count
    if wheel_speed.shape[-1] != count:
        raise ValueError(
            f"the state has the speeds of {wheel_speed.shape[-1]} wheels, the scene {count}: give"
            " wheel_speed one entry for each rotor, or leave it out."
        )
    return list(jnp.unstack(wheel_speed, axis=-1))


class Wheels(AbstractRotor):
    """Rotors with initial momenta, which the initial state of the body determines.

    ``axes`` (..., m, 3); ``momentum`` (..., m) at the time ``start`` (...), relative to the body
    for a wheel of prescribed speed (``is_held``), else absolute; ``inertia`` (..., m), 0 where not
    known; ``torque`` (..., m). ``coupled`` (static): indices of the wheels whose momenta are part
    of the state, with initial values in ``momentum``; ``spins``: their current momenta, see ``at``.
    """

    impulses: tuple[Callable | None, ...]
    is_held: tuple[bool, ...] = eqx.field(static=True)
    along: tuple[int | None, ...] = eqx.field(static=True)
    coupled: tuple[int, ...] = eqx.field(static=True)
    axes: Float[Array, "*#b m 3"] = shaped(None, 3)
    momentum: Float[Array, "*#b m"] = shaped(None)
    inertia: Float[Array, "*#b m"] = shaped(None)
    torque: Float[Array, "*#b m"] = shaped(None)
    start: Float[Array, "*#b"] = shaped()
    couplings: Couplings | None = shaped()
    spins: tuple[Array, ...] = ()

    @property
    def wheels(self):
        raise ValueError(
            "these rotors belong to a simulated scene and are settled already: build the new scene"
            " from ph.Rotor objects."
        )

    def check_within(self, inertia):
        """No check: the ``Rotor`` objects were checked before."""

    @property
    def is_possible(self) -> Array:
        """Whether (...) each wheel without a prescribed speed has a positive moment."""
        return jnp.all(self.inertia[..., np.array(self.loose, int)] > 0, axis=-1)

    @property
    def is_constant(self) -> bool:
        """Whether every wheel has a prescribed speed, so that h is constant (static)."""
        return all(self.is_held)

    @property
    def loose(self) -> tuple[int, ...]:
        """Indices of the wheels without a prescribed speed (static)."""
        return tuple(i for i, is_held in enumerate(self.is_held) if not is_held)

    def settle(self, omega_body, start, wheel_speed=None):
        if wheel_speed is None:
            return self
        _speeds_of(wheel_speed, len(self.is_held))
        loose = ~np.array(self.is_held)
        axes, omega = jnp.broadcast_arrays(self.axes, omega_body[..., None, :])
        speeds, turning, inertia, momentum, loose = jnp.broadcast_arrays(
            wheel_speed, jnp.sum(axes * omega, axis=-1), self.inertia, self.momentum, loose
        )
        momentum = jnp.where(loose, inertia * (jnp.where(loose, speeds, 0) + turning), momentum)
        return dataclasses.replace(self, momentum=momentum, start=start)

    def at(self, spins: Sequence[Array]) -> "Wheels":
        """The wheels at an instant when the coupled ones have these momenta [kg m^2/s]."""
        return dataclasses.replace(self, spins=tuple(spins))

    def with_spins_at_start(self, spins: Array) -> "Wheels":
        """The wheels with these initial momenta (..., k) of the coupled ones."""
        shape = jnp.broadcast_shapes(spins.shape[:-1], self.momentum.shape[:-1])
        momentum = jnp.broadcast_to(self.momentum, (*shape, self.momentum.shape[-1]))
        places = np.array(self.coupled, int)
        return dataclasses.replace(self, momentum=momentum.at[..., places].set(spins))

    def initial_spins(self, like: Array) -> tuple[Array, ...]:
        """Momenta of the coupled wheels at the start, of the shape of ``like``."""
        return tuple(jnp.broadcast_to(self.momentum[..., i], like.shape) for i in self.coupled)

    def speed(self, i: int, t: Array | float, omega: Sequence[Array]) -> Array:
        """Speed of wheel i relative to the body [rad/s]; NaN where its inertia is not known."""
        inertia, momentum = self.inertia[..., i], self.axial_momentum(i, t)
        is_known = inertia > 0
        spin_rate = jnp.where(is_known, momentum / jnp.where(is_known, inertia, 1), jnp.nan)
        if self.is_held[i]:
            return spin_rate
        return spin_rate - dot(tuple(self.axes[..., i, k] for k in range(3)), omega)

    def motor_torques(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> list[Array]:
        """Torque [N m] of the body on each wheel about its axis; zero for a prescribed speed."""
        torques, couplings = [], iter(() if self.couplings is None else self.couplings.terms)
        for i, is_held in enumerate(self.is_held):
            if i in self.coupled:
                speed_of = partial(self.speed, t=t, omega=omega)
                torques.append(next(couplings).torque_among(t, i, speed_of, attitude, omega))
            elif is_held:
                torques.append(jnp.zeros_like(omega[0]))
            else:
                t = jnp.asarray(t, self.momentum.dtype)
                change = partial(self.axial_momentum, i)
                torques.append(jax.jvp(change, (t,), (jnp.ones_like(t),))[1])
        return torques

    def motor_power(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> list[Array]:
        """Power [W] of motor and friction of each wheel; zero for a prescribed speed."""
        torques = self.motor_torques(t, attitude, omega)
        return [
            torque if is_held else torque * self.speed(i, t, omega)
            for i, (is_held, torque) in enumerate(zip(self.is_held, torques))
        ]

    def axial_momentum(self, i: int, t: Array | float) -> Array:
        """Momentum of wheel i along its axis (see the class) at time t [kg m^2/s]."""
        if i in self.coupled and self.spins:
            return self.spins[self.coupled.index(i)]
        momentum, impulse = self.momentum[..., i], self.impulses[i]
        if self.is_held[i] or i in self.coupled:
            return momentum
        if impulse is None:
            return momentum + self.torque[..., i] * (t - self.start)

        def impulse_at(t):
            return IMPULSE.mapped(impulse, t)

        return momentum + (impulse_at(t) - impulse_at(self.start))

    def body_momentum(self, t: Array | float) -> Vector:
        """h(t) = L - carrier omega [kg m^2/s], body components; see ``carrier``."""
        parts = [
            tuple(self.axial_momentum(i, t) * self.axes[..., i, k] for k in range(3))
            for i in range(len(self.is_held))
        ]
        return triple(sum(column[1:], start=column[0]) for column in zip(*parts))

    def energy(self, t: Array | float) -> Array | None:
        """Sum of c^2/(2J) [J] over the wheels without a prescribed speed; None without such."""
        parts = [self.axial_momentum(i, t) ** 2 / (2 * self.inertia[..., i]) for i in self.loose]
        return sum(parts[1:], start=parts[0]) if parts else None

    def carrier(self, inertia: Inertia) -> Inertia:
        """The inertia minus the axial moments J a a^T of the wheels without a prescribed speed."""
        loose = self.loose
        if not loose:
            return inertia
        along = [k for i in loose if (k := self.along[i]) is not None]
        if inertia.is_principal and len(along) == len(loose):
            wheel_inertia = jnp.zeros((3,), inertia.dtype)
            for i, k in zip(loose, along):
                column = [jnp.zeros_like(self.inertia[..., i])] * 3
                column[k] = self.inertia[..., i]
                wheel_inertia = jnp.add(
                    *jnp.broadcast_arrays(wheel_inertia, jnp.stack(column, axis=-1))
                )
            axial = all(k == 2 for k in along)
            symmetric = axial and inertia.symmetry is not Symmetry.NONE
            kind = Symmetry.AXISYMMETRIC if symmetric else Symmetry.NONE
            moments = jnp.subtract(*jnp.broadcast_arrays(inertia.moments, wheel_inertia))
            return Inertia.of_symmetry(moments, kind, physical=False)
        tensor = inertia.tensor
        for i in loose:
            axis = self.axes[..., i, :]
            wheel = self.inertia[..., i, None, None] * (axis[..., :, None] * axis[..., None, :])
            tensor = jnp.subtract(*jnp.broadcast_arrays(tensor, wheel))
        return Inertia(full=tensor)


# A single wheel, the class for users.


class Rotor(AbstractRotor):
    """A wheel on an axis fixed in the body.

    **Arguments:**

    - ``axis_body`` (..., 3): its axis in body axes (normalised). For a wheel on body x, y or z use
      ``Rotor.axial``.
    - ``inertia`` (...): its moment J about that axis [kg m^2], which the body's inertia includes.
      Optional with ``momentum`` and without ``torque``, ``impulse`` and ``coupling``.
    - exactly one of ``momentum`` (...) = J Omega [kg m^2/s] and ``speed`` (...) = Omega [rad/s],
      both relative to the body, at the first time. A state with a ``wheel_speed`` replaces them,
      except for a prescribed speed.
    - ``torque`` (...) [N m]: torque of the motor on the wheel about its axis, with the reaction on
      the body; 0: the wheel spins freely. None (and no ``impulse`` or ``coupling``): the speed is
      prescribed.
    - ``impulse``: instead of ``torque``, an antiderivative of a motor torque that varies: a
      function of time [s] returning N m s.
    - ``coupling``: instead of both, a torque between wheel and body that depends on the wheel's
      speed, time and state: ``ph.ViscousCoupling`` or a sum of couplings. Closed-form methods do
      not accept such wheels.

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
        numbers = {"inertia": inertia, "momentum": momentum, "speed": speed, "torque": torque}
        for name, value in numbers.items():
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

        The other arguments are those of ``Rotor``. A symmetric body with wheels of prescribed speed
        on body z has closed-form solutions. Wheels on principal axes leave these principal axes.
        """
        return cls(None, inertia, momentum, speed, torque, impulse, coupling, axis=axis)

    @property
    def direction(self) -> Float[Array, "*b 3"]:
        """Unit vector (..., 3) of the axis in the body."""
        if self.axis_body is not None:
            return _unit(self.axis_body)
        number = self.speed if self.momentum is None else self.momentum
        unit = np.eye(3, dtype=jnp.asarray(number).dtype)[self.axis]
        return as_float_array("axis", unit)

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
        """Axis, initial momentum (relative if ``is_held``, else absolute), J, motor torque.

        ``wheel_speed`` (...) [rad/s]: initial speed if not ``is_held``; None: that of the rotor.
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


def _moment_about(inertia: Inertia, axis: Array | np.ndarray) -> np.ndarray | np.floating:
    """The body's moment of inertia (...) about unit axes (..., 3); for concrete numbers."""
    unit = np.asarray(axis)
    if inertia.full is None:
        return np.sum(np.asarray(inertia.moments) * unit**2, axis=-1)
    return np.einsum("...i,...ij,...j", unit, np.asarray(inertia.full), unit)


def _unit(axis: Array | np.ndarray) -> Array:
    values = on_host(axis)
    if isinstance(values, np.ndarray):  # by NumPy, without compilation
        values = values / np.max(np.abs(values), axis=-1, keepdims=True)
        length = np.sqrt(np.sum(values**2, axis=-1, keepdims=True))
        return as_float_array("axis_body", values / length, finite=False)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(axis), axis=-1, keepdims=True))
    scaled = jnp.asarray(axis) / largest  # so that nothing overflows
    return scaled / jnp.sqrt(jnp.sum(scaled**2, axis=-1, keepdims=True))
