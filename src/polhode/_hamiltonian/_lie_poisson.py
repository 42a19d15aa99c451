"""Lie-Poisson coordinates: unit quaternion and body angular momentum, free of singularities.

dL/dt = L x w + sum_j r_j x dH/dr_j + N,   dq/dt = q (0, w) / 2,   w = dH/dL + s,

where r_j are the rows of R (body components of the space axes). Both derivatives of H come from one
``jax.grad``; for V = 0 this is Euler's equation in body axes. The slip s is that of a body with
internal dissipation (``ph.EnergySink``), and zero for all others.
"""

from collections.abc import Callable, Sequence
from operator import add
from typing import Any, NamedTuple

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
    """Rate of change [W] of the energy of body and wheels, on component arrays.

    The power N . omega of the external torque, and the partial derivative of H by time: of a
    potential that depends on time, an orbit, or a wheel driven by its motor (torque times speed).
    With internal dissipation also omega . (L x s), and minus the potential's torque times the slip
    s.
    """
    hamiltonian = dynamics.hamiltonian
    power = jnp.zeros_like(momentum[0])
    if dynamics.torque is not None:
        omega, potential_torque = rates_and_torque(hamiltonian, momentum, attitude, t)
        torque = dynamics.torque_at(t).body_components(t, attitude, omega)
        power = power + dot(torque, omega)
        slip = dynamics.torque.slip(t, momentum, omega)
        if slip is not None:
            power = power + dot(omega, cross(momentum, slip))
            power = power if potential_torque is None else power - dot(potential_torque, slip)
    if dynamics.coupled:
        power = power + sum(motor_powers(t, momentum, attitude, dynamics, dynamics.coupled))
    constant = not callable(hamiltonian.inverse)
    if constant and hamiltonian.potential is None and hamiltonian.wheel_energy is None:
        return power
    rows = {i: attitude.row(i) for i in hamiltonian.rows_used(attitude, t)}
    t = jnp.asarray(t, power.dtype)
    # forward mode, because many bodies may have the same time
    _, slope = jax.jvp(
        lambda t: hamiltonian.total(momentum, from_rows(rows), t), (t,), (jnp.ones_like(t),)
    )
    return power + slope


class Dynamics(eqx.Module):
    """The Hamiltonian of a body and the external torque on it (``AbstractTorque`` or None).

    ``wheels``: the wheels, or None if all are held; the momenta of the ``coupled`` ones are part of
    the state. ``units(y, rates)``: natural units of the states; None: ``GroupUnits``.
    ``costate(dynamics, y, t)`` (static): the adjoint equations; None: those of any field.
    """

    hamiltonian: Hamiltonian
    torque: Any = None
    units: Any = None
    costate: Callable[..., Any] | None = eqx.field(static=True, default=None)
    wheels: Any = None

    @property
    def coupled(self) -> tuple[int, ...]:
        """Indices of the wheels whose momenta are part of the state (static)."""
        return () if self.wheels is None else self.wheels.coupled

    def torque_at(self, t: Array | float) -> Any:
        """The torque, which may depend on the momentum of the wheels."""
        carried = self.hamiltonian.rotor_momentum
        return self.torque if carried is None else self.torque.with_wheels(carried(t))

    def at(self, spins: Sequence[Array] = ()) -> "Dynamics":
        """The dynamics at an instant, for these momenta of the coupled wheels [kg m^2/s]."""
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
    """Power [W] of the motors and the friction of these wheels."""
    omega, _ = rates_and_torque(dynamics.hamiltonian, momentum, attitude, t)
    powers = dynamics.wheels.motor_power(t, attitude, omega)
    return [powers[i] for i in which]


def momentum_rate(
    t: Array | float,
    momentum: Sequence[Array],
    attitude: Attitude | None,
    dynamics: "Dynamics | Any",
) -> tuple[Vector, Vector]:
    """dL/dt [N m] in body axes and the angular velocity [rad/s] of these axes; ``attitude``: None
    if nothing depends on it."""
    return _motion(t, momentum, attitude, dynamics)[:2]


def _motion(t, momentum, attitude, dynamics) -> tuple[Vector, Vector, Vector]:
    """``momentum_rate``, and dH/dL [rad/s]."""
    omega, potential_torque = rates_and_torque(dynamics.hamiltonian, momentum, attitude, t)
    slip = None if dynamics.torque is None else dynamics.torque.slip(t, momentum, omega)
    axes_rate = omega if slip is None else triple(map(add, omega, slip))
    rate = cross(momentum, axes_rate)
    if potential_torque is not None:
        rate = triple(map(add, rate, potential_torque))
    if dynamics.torque is not None:
        torque = dynamics.torque_at(t).body_components(t, attitude, omega)
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

    ``size`` (N,): mean moment of each inertia [kg m^2]; ``min_momentum`` (N,): unit of momentum
    [kg m^2/s] of a body at rest, which a torque may accelerate later; ``wheels`` (static): number
    of wheels whose momenta are part of the state.
    """

    size: Float[Array, "*n"]
    min_momentum: Float[Array, "*n"]
    wheels: int = eqx.field(static=True, default=0)

    def __call__(self, y: Sequence[Array], rates: Sequence[Array]) -> tuple[list[Array], Array]:
        """Weights of the components, for the root of the sum of squares [rad], and the natural rate
        [rad/s]."""
        torque = jnp.sqrt(sum(x * x for x in rates[:3]))
        carried = [*y[:3], *y[7 : 7 + self.wheels]]
        unit = jnp.sqrt(sum(x * x for x in carried) + self.min_momentum**2 + 3 * self.size * torque)
        axes_rate = 4 * sum(x * x for x in rates[3:7])  # the square of the body rates
        others = [jnp.zeros_like(unit)] * (
            len(y) - 7 - self.wheels
        )  # the work has no weight: its error follows from those of the others
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
        )  # the work, if it is recorded
        return [*self.weights, *others], rate


def relative(
    weights: Sequence[Array], change: Sequence[Array], rates: Sequence[Array], rate: Array
) -> list[Array]:
    """Weights that scale errors of a variation by its size and its growth within one radian."""
    square = sum((w * x) ** 2 for w, x in zip(weights, change))
    rate_square = sum((w * x) ** 2 for w, x in zip(weights, rates))
    square = square + rate_square / jnp.where(rate > 0, rate, 1) ** 2
    size = jnp.sqrt(jnp.where(square > 0, square, 1))
    return [w / size for w in weights]


# The adjoint equations of the Lie-Poisson coordinates: cotangents integrated backwards.
#
# A variation of the state is dL with a rotation vector eta in body axes, dR = R [eta]x. The costate
# (a, m), with a . dL + m . eta the variation of the result, follows from one scalar,
#
# K = a . (L x dH/dL + sum_j r_j x dH/dr_j + N) + m . dH/dL,
# da/dt = -dK/dL,   dm/dt = m x dH/dL - (derivative of K by a rotation eta),
#
# and the derivative of the result by a parameter p is the integral of dK/dp. If H and N depend on
# one row of R only, this row is integrated instead of the quaternion. L. S. Pontryagin et al., The
# Mathematical Theory of Optimal Processes (1962), chapter 1; on the group: A. A. Agrachev, Y. L.
# Sachkov, Control Theory from the Geometric Viewpoint (2004), section 18.2.


_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class LiePoissonCostate(NamedTuple):
    """The equations for ``ph.FlowAdjoint``; ``row``: the only row of R on which the motion depends,
    or None.

    The motion conserves the norm of the quaternion: a cotangent along it is returned unchanged.
    """

    row: int | None

    @classmethod
    def of(cls, dynamics: Dynamics, y, t) -> "LiePoissonCostate":
        """The smallest equations for these dynamics."""
        rows = dynamics.hamiltonian.rows_used(from_quaternion(y[1]), t)
        one_row = dynamics.torque is None and len(rows) == 1
        return cls(rows[0] if one_row else None)

    def begin(self, y, cotangents):
        """The variables (L, attitude, a, m) at the end, from its state and cotangents."""
        momentum, wxyz = y
        turn = tuple(dot(cotangents[1], quaternion_rate(wxyz, axis)) for axis in _AXES)
        place = wxyz if self.row is None else from_quaternion(wxyz).row(self.row)
        return tuple(momentum), tuple(place), tuple(cotangents[0]), turn

    def rates(self, t, z, dynamics):
        """Rates of these variables, and K."""
        momentum, place, by_momentum, turn = z

        def pairing(momentum, place):
            rate, omega = momentum_rate(t, momentum, self._attitude(place), dynamics)
            k = dot(by_momentum, rate) + dot(turn, omega)
            return jnp.sum(k), (rate, omega, k)

        cotangents = jax.grad(pairing, argnums=(0, 1), has_aux=True)
        (by_L, by_place), (rate, omega, k) = cotangents(momentum, place)
        if self.row is None:
            place_rate = quaternion_rate(place, omega)
            energy_by_turn = tuple(dot(by_place, quaternion_rate(place, axis)) for axis in _AXES)
        else:
            place_rate, energy_by_turn = cross(place, omega), cross(by_place, place)
        turn_rate = tuple(a - b for a, b in zip(cross(turn, omega), energy_by_turn))
        return (rate, place_rate, tuple(-x for x in by_L), turn_rate), k

    def finish(self, z, start, end, cotangents):
        """Cotangents of the initial state; ``cotangents``: those of the state at its ``end``."""
        _, place, by_momentum, turn = z
        wxyz = place if self.row is None else start[1]  # the quaternion itself is not integrated
        along_wxyz = dot(cotangents[1], end[1])
        by_wxyz = quaternion_rate(wxyz, tuple(4 * x for x in turn))
        return by_momentum, tuple(a + along_wxyz * q for a, q in zip(by_wxyz, wxyz))

    def units(self, weights_of_state, z, rates):
        """Weights of the variables integrated backwards, and the natural rate."""
        (momentum, place, by_momentum, turn), (momentum_rates, place_rate, *cotangents) = z, rates
        padding = (place[0],) * (4 - len(place))
        if padding:  # a row rotates by the full angle, a quaternion by half of it
            place_rate = tuple(x / 2 for x in place_rate)
        y = (*momentum, *place, *padding)
        state_rates = (*momentum_rates, *place_rate, *(jnp.zeros_like(x) for x in padding))
        weights, rate = weights_of_state(y, state_rates)
        if padding:  # one row does not change by a rotation about itself
            rate = rate + jnp.sqrt(dot(momentum, momentum)) / weights_of_state.size
        scale = weights[3] / 2
        place_weights = [scale if padding else weights[3]] * len(place)
        dual = [*(1 / w for w in weights[:3]), *[jnp.ones_like(rate)] * 3]
        dual_weights = relative(dual, (*by_momentum, *turn), (*cotangents[0], *cotangents[1]), rate)
        return [*weights[:3], *place_weights, *dual_weights], rate

    def _attitude(self, place):
        return from_quaternion(place) if self.row is None else from_rows({self.row: place})
