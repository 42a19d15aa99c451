"""Rotors (wheels) whose axes are fixed in the body: gyrostats.

The inertia of the scene is that of the whole body with its wheels locked, their moments about
their own axes included (Basilisk's hub inertia has the same meaning there; some texts leave the
wheels out). A wheel of moment J about the unit axis a, at the speed Omega relative to the body,
adds J Omega a to L = I omega. Held at that speed: L = I omega + J Omega a. Turned by a motor of
torque tau about its axis (0: it spins freely) its momentum c = J (a . omega + Omega) obeys
dc/dt = tau, and L = (I - J a a^T) omega + c a: in both cases the one Hamiltonian with a momentum
h(t) subtracted from L (Hughes, Spacecraft Attitude Dynamics, 1986, section 3.4, 6). Where tau
depends on the state (a coupling: friction, a motor with its limits), c is part of the state.
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

from polhode._checks import require
from polhode._hamiltonian import Attitude, Vector, dot, triple
from polhode._parts import AbstractPart, Signature, shaped
from polhode._scene._couplings import Couplings
from polhode.inertia import Inertia, Symmetry

IMPULSE = Signature("Rotor impulse", {"t": ()})


class AbstractRotor(AbstractPart):
    """Base of rotors; they add with ``+``."""

    @property
    @abc.abstractmethod
    def wheels(self) -> tuple[Any, ...]:
        """One by one."""

    def __add__(self, other: "AbstractRotor") -> "RotorSum":
        if not isinstance(other, AbstractRotor):
            raise TypeError(f"a rotor adds to another rotor, not to {type(other).__name__}")
        return RotorSum((*self.wheels, *other.wheels))

    def check_within(self, inertia: Inertia) -> None:
        """ValueError for a wheel whose moment is not part of the body's about its axis."""
        for wheel in self.wheels:
            if wheel.inertia is None:
                continue
            axis = wheel.direction
            with jax.ensure_compile_time_eval():  # the numbers are known, also under jit
                turned = inertia.momentum(axis)
                about = jnp.sum(jnp.broadcast_to(axis, turned.shape) * turned, axis=-1)
            require(
                np.asarray(wheel.inertia) < np.asarray(about),
                f"a rotor's inertia ({wheel.inertia} kg m^2) must be less than the body's about the"
                f" same axis ({about}): the scene's inertia is that of the whole body, its wheels"
                " locked and included. Add the wheels to it.",
            )

    def settle(
        self, omega_body: Float[Array, "*#b 3"], start: Array, wheel_speed: Array | None = None
    ) -> "Wheels":
        """The wheels of bodies with rates ``omega_body`` at the time ``start`` (...).

        ``wheel_speed`` (..., m) [rad/s]: relative to the body; None: what the rotors were given.
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
            held=tuple(wheel.is_held for wheel in self.wheels),
            along=tuple(wheel.axis for wheel in self.wheels),
            coupled=tuple(i for i, wheel in enumerate(self.wheels) if wheel.coupling is not None),
            axes=axes,
            momentum=momentum,
            inertia=inertia,
            torque=torque,
            start=start,
            couplings=Couplings(couplings) if couplings else None,
        )


class RotorSum(AbstractRotor):
    """Several rotors."""

    terms: tuple[AbstractRotor, ...]

    @property
    def wheels(self):
        return self.terms


def _speeds_of(wheel_speed: Array | None, count: int) -> Sequence[Array | None]:
    """The speed (...) of each of ``count`` wheels, None where it is not given."""
    if wheel_speed is None:
        return [None] * count
    if wheel_speed.shape[-1] != count:
        raise ValueError(
            f"the state has the speeds of {wheel_speed.shape[-1]} wheels, the scene {count}: give"
            " wheel_speed one entry for each rotor, or leave it out."
        )
    return [wheel_speed[..., i] for i in range(count)]


class Wheels(AbstractRotor):
    """Rotors whose motion is known: what ``Rotor`` becomes once the state of the body is.

    ``axes`` (..., m, 3); ``momentum`` (..., m) at the time ``start`` (...), relative to the body
    where ``held``, else absolute; ``inertia`` (..., m), 0 where not known; ``torque`` (..., m).
    ``coupled`` (static): the wheels whose momenta are part of the state, the initial ones standing
    in ``momentum``; ``spins``: their momenta of the moment, see ``at``.
    """

    impulses: tuple[Callable | None, ...]
    held: tuple[bool, ...] = eqx.field(static=True)
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
        """Nothing: the rotors were checked before they were settled."""

    @property
    def is_possible(self) -> Array:
        """Whether (...) each wheel that is not held has a positive moment."""
        return jnp.all(self.inertia[..., np.array(self.loose, int)] > 0, axis=-1)

    @property
    def is_constant(self) -> bool:
        """Whether every wheel is held (static); the momentum may be constant all the same."""
        return all(self.held)

    @property
    def loose(self) -> tuple[int, ...]:
        """Which wheels are not held (static)."""
        return tuple(i for i, held in enumerate(self.held) if not held)

    def settle(self, omega_body, start, wheel_speed=None):
        if wheel_speed is None:
            return self
        _speeds_of(wheel_speed, len(self.held))
        loose = ~np.array(self.held)
        axes, omega = jnp.broadcast_arrays(self.axes, omega_body[..., None, :])
        speeds, turning, inertia, momentum, loose = jnp.broadcast_arrays(
            wheel_speed, jnp.sum(axes * omega, axis=-1), self.inertia, self.momentum, loose
        )
        momentum = jnp.where(loose, inertia * (jnp.where(loose, speeds, 0) + turning), momentum)
        return dataclasses.replace(self, momentum=momentum, start=start)

    def at(self, spins: Sequence[Array]) -> "Wheels":
        """The wheels at a moment when those that are coupled have these momenta [kg m^2/s]."""
        return dataclasses.replace(self, spins=tuple(spins))

    def begun(self, spins: Array) -> "Wheels":
        """The wheels with these initial momenta (..., k) of those that are coupled."""
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
        known = inertia > 0
        own = jnp.where(known, momentum / jnp.where(known, inertia, 1), jnp.nan)
        if self.held[i]:
            return own
        return own - dot(tuple(self.axes[..., i, k] for k in range(3)), omega)

    def motor_torques(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> list[Array]:
        """Torque [N m] on each wheel about its axis from the body; zero where it is held."""
        found, couplings = [], iter(() if self.couplings is None else self.couplings.terms)
        for i, held in enumerate(self.held):
            if i in self.coupled:
                speed = self.speed(i, t, omega)
                found.append(next(couplings).torque(t, speed, attitude, omega))
            elif held:
                found.append(jnp.zeros_like(omega[0]))
            else:
                t = jnp.asarray(t, self.momentum.dtype)
                change = partial(self.axial_momentum, i)
                found.append(jax.jvp(change, (t,), (jnp.ones_like(t),))[1])
        return found

    def motor_power(
        self, t: Array | float, attitude: Attitude, omega: Sequence[Array]
    ) -> list[Array]:
        """Power [W] that motor and friction of each wheel give to the motion; zero where held."""
        torques = self.motor_torques(t, attitude, omega)
        return [
            torque if held else torque * self.speed(i, t, omega)
            for i, (held, torque) in enumerate(zip(self.held, torques))
        ]

    def axial_momentum(self, i: int, t: Array | float) -> Array:
        """Momentum of wheel i along its axis (see the class) at time t [kg m^2/s]."""
        if i in self.coupled and self.spins:
            return self.spins[self.coupled.index(i)]
        momentum, impulse = self.momentum[..., i], self.impulses[i]
        if self.held[i] or i in self.coupled:
            return momentum
        if impulse is None:
            return momentum + self.torque[..., i] * (t - self.start)

        def given(t):
            return IMPULSE.mapped(impulse, t)

        return momentum + (given(t) - given(self.start))

    def body_momentum(self, t: Array | float) -> Vector:
        """h(t): what L is more than the momentum of the body [kg m^2/s], body components."""
        parts = [
            tuple(self.axial_momentum(i, t) * self.axes[..., i, k] for k in range(3))
            for i in range(len(self.held))
        ]
        return triple(sum(column[1:], start=column[0]) for column in zip(*parts))

    def energy(self, t: Array | float) -> Array | None:
        """c^2/(2J) of the wheels that are not held [J]; None without such."""
        parts = [self.axial_momentum(i, t) ** 2 / (2 * self.inertia[..., i]) for i in self.loose]
        return sum(parts[1:], start=parts[0]) if parts else None

    def carrier(self, inertia: Inertia) -> Inertia:
        """The inertia that turns with the body: less that of wheels free about their axes."""
        loose = self.loose
        if not loose:
            return inertia
        along = [k for i in loose if (k := self.along[i]) is not None]
        if inertia.is_principal and len(along) == len(loose):
            less = jnp.zeros((3,), inertia.dtype)
            for i, k in zip(loose, along):
                column = [jnp.zeros_like(self.inertia[..., i])] * 3
                column[k] = self.inertia[..., i]
                less = jnp.add(*jnp.broadcast_arrays(less, jnp.stack(column, axis=-1)))
            axial = all(k == 2 for k in along)
            symmetric = axial and inertia.symmetry is not Symmetry.NONE
            kind = Symmetry.AXISYMMETRIC if symmetric else Symmetry.NONE
            left = jnp.subtract(*jnp.broadcast_arrays(inertia.moments, less))
            return Inertia.of_symmetry(left, kind, physical=False)
        tensor = inertia.tensor
        for i in loose:
            axis = self.axes[..., i, :]
            wheel = self.inertia[..., i, None, None] * (axis[..., :, None] * axis[..., None, :])
            tensor = jnp.subtract(*jnp.broadcast_arrays(tensor, wheel))
        return Inertia(full=tensor)
