"""The attitude between samples of a motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array
from polhode._hamiltonian import components
from polhode._kernels import smooth
from polhode._scene import Scene
from polhode._trajectory import Trajectory
from polhode.rotation import (
    conjugate,
    multiply,
    rotation_vector_to_wxyz,
    wxyz_to_rotation_vector,
)
from polhode.rotation._quaternion import wxyz_rate


def _axes_rate(scene: Scene, omega: Array, t: Array, spins: tuple[Array, ...]) -> Array:
    """Angular velocity (..., 3) [rad/s] of the body axes: the body rate, and with an energy sink
    the slip."""
    if scene.torque is None:
        return omega
    momentum = scene.with_spins(spins).momentum(omega, t)
    slip = scene.torque.slip(t, components(momentum), components(omega))
    if slip is None:
        return omega
    return omega + jnp.stack(jnp.broadcast_arrays(*slip), axis=-1)


@eqx.filter_jit
def rates_of_axes(trajectory: Trajectory) -> Array:
    """Angular velocities (..., T, 3) [rad/s] of the body axes, slip of an energy sink included."""
    scene = trajectory._scene
    spins = scene.dynamics.wheels.spins if scene.dynamics.coupled else ()
    return _axes_rate(scene, trajectory.omega_body, trajectory._t, spins)


@eqx.filter_jit
def motion_of_axes(trajectory: Trajectory) -> tuple[Array, Array]:
    """``rates_of_axes``, and their derivatives by time (..., T, 3) [rad/s^2]."""
    scene, omega, t = trajectory._scene, trajectory.omega_body, trajectory._t
    wxyz = None if trajectory.scene.is_free else trajectory.wxyz
    acceleration, spin_rates = scene.changes(wxyz, omega, t)
    if scene.torque is None:
        return omega, acceleration
    spins = scene.dynamics.wheels.spins if spin_rates else ()
    tangents = acceleration, jnp.ones_like(t), spin_rates
    return jax.jvp(lambda *at: _axes_rate(scene, *at), (omega, t, spins), tangents)


@jax.jit
def _rotations_with_derivatives(ts, wxyz, omega_body, angular_acceleration) -> tuple[Array, Array]:
    """Rotation vector of each interval, with its first two derivatives by s = (t - start)/h, at its
    start and its end: two arrays (t-1, 3, 3)."""
    start, end = slice(None, -1), slice(1, None)
    origin = conjugate(wxyz[start])
    rate = wxyz_rate(wxyz, omega_body)
    acceleration = wxyz_rate(rate, omega_body) + wxyz_rate(wxyz, angular_acceleration)

    def vector(h):
        path = wxyz[end] + h * rate[end] + h * h / 2 * acceleration[end]
        return wxyz_to_rotation_vector(multiply(origin, path))

    def derivative(h):
        return jax.jvp(vector, (h,), (jnp.ones_like(h),))[1]

    zero = jnp.zeros((), ts.dtype)
    first_derivative, second_derivative = jax.jvp(derivative, (zero,), (jnp.ones_like(zero),))
    step = (ts[end] - ts[start])[:, None]
    start_values = [
        jnp.zeros_like(first_derivative),
        step * omega_body[start],
        step**2 * angular_acceleration[start],
    ]
    end_values = [vector(zero), step * first_derivative, step**2 * second_derivative]
    return jnp.stack(start_values, axis=1), jnp.stack(end_values, axis=1)


@smooth  # second derivatives are continuous at the samples, so no step has to end there
def _interval(times: Array, t: Array) -> Array:
    """Index k of the interval from ``times[k]`` to ``times[k + 1]`` that contains ``t``; beyond the
    samples, the nearest one.

    After an event that ends a simulation the last time is repeated; these intervals of zero width
    are left out.
    """
    place = jnp.searchsorted(times, t, side="right") - 1
    widths = jnp.sum(times[1:] > times[:-1], dtype=place.dtype)
    return jnp.clip(place, 0, jnp.maximum(widths - 1, 0))


class SampledAttitude(eqx.Module):
    """Attitude interpolated through samples with angular velocities and angular accelerations.

    Between two samples the rotation vector from the earlier one is the polynomial of degree five
    that matches attitude, rate and acceleration at both. For samples h apart the error of the
    attitude is O(h^6), of the angular velocity O(h^5), of the angular acceleration O(h^4); at the
    samples all three are exact. Beyond the samples the nearest polynomial is extrapolated.
    """

    ts: Float[Array, " t"]
    wxyz: Float[Array, "t 4"]
    interval_starts: Float[Array, "t-1 3 3"]
    interval_ends: Float[Array, "t-1 3 3"]

    def __init__(
        self, ts: ArrayLike, wxyz: ArrayLike, omega_body: ArrayLike, angular_acceleration: ArrayLike
    ):
        """Samples (T,), (T, 4), (T, 3), (T, 3); less than half a turn between two of them."""
        self.ts = as_float_array("ts", ts, (None,))
        self.wxyz = as_float_array("wxyz", wxyz, (None, 4))
        rates = as_float_array("omega_body", omega_body, (None, 3))
        acceleration = as_float_array("angular_acceleration", angular_acceleration, (None, 3))
        ends = _rotations_with_derivatives(self.ts, self.wxyz, rates, acceleration)
        self.interval_starts, self.interval_ends = ends

    def __call__(self, t: Float[Array, ""]) -> Float[Array, "4"]:
        backwards = self.ts[-1] < self.ts[0]
        times, ascending_time = jnp.where(backwards, -self.ts, self.ts), jnp.where(backwards, -t, t)
        k = _interval(times, ascending_time)
        s = (t - self.ts[k]) / (self.ts[k + 1] - self.ts[k])
        (_, v0, a0), (p1, v1, a1) = self.interval_starts[k], self.interval_ends[k]
        # Taylor polynomial at the start, plus three terms that match value, first and second
        # derivative at the end
        value, first, second = p1 - v0 - a0 / 2, v1 - v0 - a0, a1 - a0
        cubic = 10 * value - 4 * first + second / 2
        quartic = -15 * value + 7 * first - second
        quintic = 6 * value - 3 * first + second / 2
        vector = s * (v0 + s * (a0 / 2 + s * (cubic + s * (quartic + s * quintic))))
        return multiply(self.wxyz[k], rotation_vector_to_wxyz(vector))
