"""Euler's equation of the rigid body in body axes (document 003 display 29, corrected)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.inertia._inertia import Inertia


def angular_acceleration(
    inertia: Inertia,
    omega_body: Float[Array, "*#b 3"],
    torque_body: Float[Array, "*#b 3"] | None = None,
) -> Float[Array, "*b 3"]:
    """``domega/dt`` (..., 3), rad/s^2, of ``I domega/dt + omega x (I omega) = N`` (theory 7).

    ``omega_body`` rad/s and ``torque_body`` N m (None: free) in body axes; constant inertia, any
    axes. Document 003 display 29 leaves out ``omega x (I omega)``: right only when that vanishes,
    i.e. when omega is along a principal axis.
    """
    drive = _cross(inertia.momentum(omega_body), omega_body)
    if torque_body is not None:
        drive = jnp.add(*jnp.broadcast_arrays(drive, torque_body))
    return inertia.rates(drive)


def required_torque(
    inertia: Inertia, omega_body: Float[Array, "*#b 3"], omega_dot_body: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """The torque ``I domega/dt + omega x (I omega)`` (..., 3), N m, that a given motion needs."""
    gyroscopic = _cross(omega_body, inertia.momentum(omega_body))
    return jnp.add(*jnp.broadcast_arrays(inertia.momentum(omega_dot_body), gyroscopic))


def _cross(left: Array, right: Array) -> Array:
    return jnp.cross(*jnp.broadcast_arrays(left, right))
