"""The two sensors that recordings come from: gyroscope and accelerometer, fixed in the body."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array
from polhode._trajectory import Trajectory
from polhode.rotation import conjugate, rotate


def _recorded(trajectory: Trajectory, name: str) -> Array:
    value = getattr(trajectory, name)
    if value is None:
        raise ValueError(
            f"this trajectory holds no {name}: simulate with"
            " record=ph.Record(attitude=True, rates=True)"
        )
    return value


@eqx.filter_jit
def angular_acceleration(trajectory: Trajectory) -> Float[Array, "*b t 3"]:
    """Derivative of the body rates at every sample [rad/s^2], from the equations of motion."""
    scene, t = trajectory._scene, trajectory._t
    omega = _recorded(trajectory, "omega_body")
    wxyz = None if trajectory.scene.is_free else _recorded(trajectory, "wxyz")
    return scene.acceleration(wxyz, omega, t)


def gyroscope(trajectory: Trajectory) -> Float[Array, "*b t 3"]:
    """Reading of a gyroscope along the body axes [rad/s]: the body rates, wherever mounted."""
    return _recorded(trajectory, "omega_body")


def accelerometer(
    trajectory: Trajectory,
    position_body: Float[ArrayLike, "*#b 3"],
    gravity_space: Float[ArrayLike, "3"] | None = None,
) -> Float[Array, "*b t 3"]:
    """Reading of an accelerometer along the body axes [m/s^2], mounted at ``position_body`` [m].

    The reading is acceleration minus gravity:
    ``omega x (omega x r) + d(omega)/dt x r - R^T gravity`` (docs/equations.md, 003: 17-21), with
    the lever arm r from the point about which the body rotates. ``gravity_space`` (3,) [m/s^2] is
    for a body that rotates about a point fixed in space; leave it None for a body in free fall,
    where gravity and the acceleration of the mass centre cancel.

    Raises ValueError if the trajectory has no rates (or no attitude where it is needed).
    """
    omega = _recorded(trajectory, "omega_body")
    lever = as_float_array("position_body", position_body, (3,)).astype(omega.dtype)
    lever = jnp.broadcast_to(lever[..., None, :], omega.shape)
    reading = jnp.cross(omega, jnp.cross(omega, lever))
    reading = reading + jnp.cross(angular_acceleration(trajectory), lever)
    if gravity_space is None:
        return reading
    gravity = as_float_array("gravity_space", gravity_space, (3,)).astype(omega.dtype)
    down = jnp.broadcast_to(gravity, omega.shape)
    return reading - rotate(conjugate(_recorded(trajectory, "wxyz")), down)
