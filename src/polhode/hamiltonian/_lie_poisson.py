"""The Lie-Poisson chart: unit quaternion and body angular momentum, free of singularities.

dL/dt = L x dH/dL + sum_j r_j x dH/dr_j + N,   dq/dt = q (0, dH/dL) / 2,

r_j the rows of R (body components of the space axes). Both derivatives of H come from one
``jax.grad``; for V = 0 this is Euler's equation in body axes.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from polhode.hamiltonian._attitude import Attitude, Vector, cross, dot, from_quaternion, from_rows
from polhode.hamiltonian._energy import Hamiltonian
from polhode.rotation import quaternion_rate as quaternion_rate


def rates_and_torque(
    hamiltonian: Hamiltonian,
    momentum: Sequence[Array],
    attitude: Attitude | None,
    t: Array | float,
) -> tuple[Vector, Vector | None]:
    """Body rates dH/dL [rad/s] and the potential's torque in body axes [N m] (None without one)."""
    used = () if hamiltonian.potential is None else hamiltonian.rows_used(attitude, t)
    rows = {i: attitude.row(i) for i in used}

    def total(momentum, rows):
        return jnp.sum(hamiltonian(momentum, from_rows(rows), t))

    omega, slopes = jax.grad(total, argnums=(0, 1))(tuple(momentum), rows)
    if not rows:
        return omega, None
    turns = [cross(rows[i], slopes[i]) for i in rows]
    return omega, tuple(sum(parts[1:], start=parts[0]) for parts in zip(*turns))


def external_power(
    t: Array | float, momentum: Sequence[Array], attitude: Attitude, dynamics: "Dynamics"
) -> Array:
    """Power [W] that the energy of body and wheels grows by, on component arrays.

    N . omega of the external torque, and the change of H with time itself: a potential that
    depends on time, an orbit, a wheel turned by its motor (whose power is torque times speed).
    """
    hamiltonian = dynamics.hamiltonian
    power = jnp.zeros_like(momentum[0])
    if dynamics.torque is not None:
        omega, _ = rates_and_torque(hamiltonian, momentum, attitude, t)
        power = power + dot(dynamics.torque.body_components(t, attitude, omega), omega)
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

    For solvers that ask: ``units``, natural units of its states, and ``costate(dynamics, y, t)``
    (static), the equations that carry slopes back along its motion; None: those of any field.
    """

    hamiltonian: Hamiltonian
    torque: Any = None
    units: Any = None
    costate: Callable[..., Any] | None = eqx.field(static=True, default=None)


def momentum_rate(
    t: Array | float,
    momentum: Sequence[Array],
    attitude: Attitude | None,
    dynamics: "Dynamics | Any",
) -> tuple[Vector, Vector]:
    """dL/dt [N m] and the rates [rad/s] in body axes; no attitude where nothing asks for one."""
    omega, turn = rates_and_torque(dynamics.hamiltonian, momentum, attitude, t)
    rate = cross(momentum, omega)
    if turn is not None:
        rate = tuple(a + b for a, b in zip(rate, turn))
    if dynamics.torque is not None:
        push = dynamics.torque.body_components(t, attitude, omega)
        rate = tuple(a + b for a, b in zip(rate, push))
    return rate, omega


def lie_poisson_field(t, y, dynamics: "Dynamics | Any"):
    """The vector field on component arrays, with the call signature of a diffrax term.

    ``y = (momentum, wxyz)``: three arrays [kg m^2/s] and four arrays of one shape. The result
    has the structure of the state.
    """
    momentum, wxyz = y
    rate, omega = momentum_rate(t, momentum, from_quaternion(wxyz), dynamics)
    return rate, quaternion_rate(wxyz, omega)
