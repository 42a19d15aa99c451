"""Lie-Poisson coordinates: unit quaternion and body angular momentum, free of singularities.

dL/dt = L x w + sum_j r_j x dH/dr_j + N,   dq/dt = q (0, w) / 2,   w = dH/dL + s,

r_j the rows of R (body components of the space axes). Both derivatives of H come from one
``jax.grad``; for V = 0 this is Euler's equation in body axes. The slip s is that of a body which
loses energy inside (``ph.EnergySink``), else absent.
"""

from collections.abc import Callable, Sequence
from operator import add
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._hamiltonian._energy import (
    Attitude,
    Hamiltonian,
    Vector,
    cross,
    dot,
    from_quaternion,
    from_rows,
    triple,
)
from polhode.rotation._quaternion import quaternion_rate as quaternion_rate


def rates_and_torque(
    hamiltonian: Hamiltonian,
    momentum: Sequence[Array],
    attitude: Attitude | None,
    t: Array | float,
) -> tuple[Vector, Vector | None]:
    """Body rates dH/dL [rad/s] and the potential's torque in body axes [N m] (None without one)."""
    rows = {}
    if attitude is not None:
        rows = {i: attitude.row(i) for i in hamiltonian.rows_used(attitude, t)}

    def total(momentum, rows):
        return jnp.sum(hamiltonian(momentum, from_rows(rows), t))

    omega, by_row = jax.grad(total, argnums=(0, 1))(tuple(momentum), rows)
    if not rows:
        return omega, None
    torques = [cross(rows[i], by_row[i]) for i in rows]
    return omega, triple(sum(parts[1:], start=parts[0]) for parts in zip(*torques))


def external_power(
    t: Array | float, momentum: Sequence[Array], attitude: Attitude, dynamics: "Dynamics"
) -> Array:
    """Power [W] that the energy of body and wheels grows by, on component arrays.

    N . omega of the external torque, and the change of H with time itself: a potential that
    depends on time, an orbit, a wheel turned by its motor (whose power is torque times speed). Less
    what is lost inside: omega . (L x s), and the potential's torque times the slip s.
    """
    hamiltonian = dynamics.hamiltonian
    power = jnp.zeros_like(momentum[0])
    if dynamics.torque is not None:
        omega, potential_torque = rates_and_torque(hamiltonian, momentum, attitude, t)
        power = power + dot(dynamics.torque.body_components(t, attitude, omega), omega)
        slip = dynamics.torque.slip(t, momentum, omega)
        if slip is not None:
            power = power + dot(omega, cross(momentum, slip))
            power = power if potential_torque is None else power - dot(potential_torque, slip)
    if dynamics.coupled:
        power = power + sum(motor_powers(t, momentum, attitude, dynamics, dynamics.coupled))
    if hamiltonian.potential is None and hamiltonian.wheel_energy is None:
        return power
    rows = {i: attitude.row(i) for i in hamiltonian.rows_used(attitude, t)}
    t = jnp.asarray(t, power.dtype)
    # forwards: one time may be shared by many bodies
    _, slope = jax.jvp(
        lambda t: hamiltonian.total(momentum, from_rows(rows), t), (t,), (jnp.ones_like(t),)
    )
    return power + slope


class Dynamics(eqx.Module):
    """What moves a body: the Hamiltonian and the external torque (``AbstractTorque`` or None).

    ``wheels``: those that are not all held, or None; the momenta of the ``coupled`` ones are part
    of the state.

    For solvers that use them: ``units``, natural units of the states, and
    ``costate(dynamics, y, t)`` (static), the adjoint equations; None: those of any field.
    """

    hamiltonian: Hamiltonian
    torque: Any = None
    units: Any = None
    costate: Callable[..., Any] | None = eqx.field(static=True, default=None)
    wheels: Any = None

    @property
    def coupled(self) -> tuple[int, ...]:
        """Which wheels have momenta that are part of the state (static)."""
        return () if self.wheels is None else self.wheels.coupled

    def at(self, spins: Sequence[Array] = ()) -> "Dynamics":
        """The dynamics at a moment when the coupled wheels have these momenta [kg m^2/s]."""
        if not spins:
            return self
        wheels, energy = self.wheels.at(spins), self.hamiltonian
        energy = Hamiltonian(
            energy.inverse, energy.inertia, energy.potential, wheels.body_momentum, wheels.energy
        )
        return Dynamics(energy, self.torque, self.units, self.costate, wheels)


def motor_powers(
    t: Array | float,
    momentum: Sequence[Array],
    attitude: Attitude,
    dynamics: Dynamics,
    which: Sequence[int],
) -> list[Array]:
    """Power [W] that the motors and the friction of these wheels give to the motion."""
    omega, _ = rates_and_torque(dynamics.hamiltonian, momentum, attitude, t)
    powers = dynamics.wheels.motor_power(t, attitude, omega)
    return [powers[i] for i in which]


def momentum_rate(
    t: Array | float,
    momentum: Sequence[Array],
    attitude: Attitude | None,
    dynamics: "Dynamics | Any",
) -> tuple[Vector, Vector]:
    """dL/dt [N m] in body axes and the rates [rad/s] at which these axes turn; no attitude where
    nothing depends on it."""
    return _motion(t, momentum, attitude, dynamics)[:2]


def _motion(t, momentum, attitude, dynamics) -> tuple[Vector, Vector, Vector]:
    """The same, and dH/dL [rad/s]."""
    omega, potential_torque = rates_and_torque(dynamics.hamiltonian, momentum, attitude, t)
    slip = None if dynamics.torque is None else dynamics.torque.slip(t, momentum, omega)
    axes_rate = omega if slip is None else triple(map(add, omega, slip))
    rate = cross(momentum, axes_rate)
    if potential_torque is not None:
        rate = triple(map(add, rate, potential_torque))
    if dynamics.torque is not None:
        torque = dynamics.torque.body_components(t, attitude, omega)
        rate = triple(map(add, rate, torque))
    return rate, axes_rate, omega


def lie_poisson_field(t, y, dynamics: "Dynamics | Any"):
    """The vector field on component arrays, with the call signature of a diffrax term.

    ``y = (momentum, wxyz)``: three arrays [kg m^2/s] and four arrays of one shape; with coupled
    wheels a third group, their momenta. The result has the structure of the state.
    """
    momentum, wxyz, *spins = y
    attitude = from_quaternion(wxyz)
    dynamics = dynamics.at(*spins)
    rate, axes_rate, omega = _motion(t, momentum, attitude, dynamics)
    rates = rate, quaternion_rate(wxyz, axes_rate)
    return (*rates, spin_rates(t, attitude, omega, dynamics)) if spins else rates


def spin_rates(
    t: Array | float, attitude: Attitude, omega: Sequence[Array], dynamics: Dynamics
) -> tuple[Array, ...]:
    """Change [N m] of the momenta of the coupled wheels."""
    torques = dynamics.wheels.motor_torques(t, attitude, omega)
    return tuple(torques[i] + jnp.zeros_like(omega[0]) for i in dynamics.coupled)


class LiePoissonUnits(eqx.Module):
    """Natural units of body momentum and quaternion, updated with the state.

    ``size`` (N,): of each inertia [kg m^2]; ``least`` (N,): momentum [kg m^2/s] by which a body at
    rest is measured, which a torque may move later; ``wheels`` (static): how many have momenta that
    are part of the state.
    """

    size: Float[Array, "*n"]
    least: Float[Array, "*n"]
    wheels: int = eqx.field(static=True, default=0)

    def __call__(self, y: Sequence[Array], rates: Sequence[Array]) -> tuple[list[Array], Array]:
        """Weights of the components, their squares to be summed (rad), and the rate [rad/s]."""
        torque = jnp.sqrt(sum(x * x for x in rates[:3]))
        carried = [*y[:3], *y[7 : 7 + self.wheels]]
        unit = jnp.sqrt(sum(x * x for x in carried) + self.least**2 + 3 * self.size * torque)
        axes_rate = 4 * sum(x * x for x in rates[3:7])  # the square of the body rates
        others = [jnp.zeros_like(unit)] * (
            len(y) - 7 - self.wheels
        )  # the work follows from the others
        spins = [1 / unit] * self.wheels
        weights = [1 / unit] * 3 + [jnp.full_like(unit, 2)] * 4 + spins + others
        return weights, jnp.sqrt(axes_rate + torque / self.size)


class FixedUnits(eqx.Module):
    """Constant weights (N,) of the components."""

    weights: tuple[Array, ...]

    def __call__(self, y: Sequence[Array], rates: Sequence[Array]) -> tuple[list[Array], Array]:
        """As ``LiePoissonUnits``."""
        rate = jnp.sqrt(sum((w * x) ** 2 for w, x in zip(self.weights, rates)))
        others = [jnp.zeros_like(rate)] * (
            len(y) - len(self.weights)
        )  # the work, where it is recorded
        return [*self.weights, *others], rate


def relative(
    weights: Sequence[Array], change: Sequence[Array], rates: Sequence[Array], rate: Array
) -> list[Array]:
    """Weights that measure a variation by its own size, and by its growth within one radian."""
    square = sum((w * x) ** 2 for w, x in zip(weights, change))
    rate_square = sum((w * x) ** 2 for w, x in zip(weights, rates))
    square = square + rate_square / jnp.where(rate > 0, rate, 1) ** 2
    size = jnp.sqrt(jnp.where(square > 0, square, 1))
    return [w / size for w in weights]
