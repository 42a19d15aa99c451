"""Euler's equation of the rigid body in body axes (docs/equations.md, 003: 29).

A formula for those who have rates at hand: no motion is computed by it, and a test derives it from
the one Hamiltonian.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.inertia._inertia import Inertia


def angular_acceleration(
    inertia: Inertia,
    omega_body: Float[Array | np.ndarray, "*#b 3"],
    torque_body: Float[Array | np.ndarray, "*#b 3"] | None = None,
) -> Float[Array, "*b 3"]:
    """``domega/dt`` (..., 3), rad/s^2, of ``I domega/dt + omega x (I omega) = N``.

    ``omega_body`` rad/s and ``torque_body`` N m (None: free) in body axes; constant inertia, any
    axes. Without ``omega x (I omega)``, as often printed, it is right only when that vanishes,
    i.e. when omega is along a principal axis.
    """
    drive = _cross(inertia.momentum(omega_body), omega_body)
    if torque_body is not None:
        drive = jnp.add(*jnp.broadcast_arrays(drive, torque_body))
    return inertia.rates(drive)


def required_torque(
    inertia: Inertia,
    omega_body: Float[Array | np.ndarray, "*#b 3"],
    omega_dot_body: Float[Array | np.ndarray, "*#b 3"],
) -> Float[Array, "*b 3"]:
    """The torque ``I domega/dt + omega x (I omega)`` (..., 3), N m, that a given motion needs."""
    gyroscopic = _cross(omega_body, inertia.momentum(omega_body))
    return jnp.add(*jnp.broadcast_arrays(inertia.momentum(omega_dot_body), gyroscopic))


def _cross(left: Array | np.ndarray, right: Array | np.ndarray) -> Array:
    return jnp.cross(*jnp.broadcast_arrays(left, right))
