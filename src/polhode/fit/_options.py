"""``FitOptions``, and the sensor model and loss function that they contain."""

import dataclasses
import math
from numbers import Real

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from polhode._checks import ArrayLike, as_float_array, is_concrete, require
from polhode.fit._model import AbstractInertiaUnknown, AbstractMotion, SteppedMotion
from polhode.fit._numerics import inverse
from polhode.fit._recording import Recording, central_slope, interpolate_gaps, saturation
from polhode.inertia import Inertia

# ``Gyroscope``: one sensor model for simulated readings and for fits.

# Number of pieces of a recording in which the walk of the bias is linear.
WALK_KNOTS = 16


class Gyroscope(eqx.Module):
    """Sensor model of a gyroscope: ``reading(t) = gain omega(t - delay) + bias + walk + noise``.

    **Fields:**

    - ``gain`` (3, 3): identity plus scale-factor errors (diagonal) and misalignments [rad] (the
      other entries), as calibrated; None: the identity.
    - ``bias`` (3,) [rad/s], as calibrated; None: zero.
    - ``noise_density`` [rad/s/sqrt(Hz)]: white noise (angle random walk): a sample has the standard
      deviation ``noise_density / sqrt(step)``, in fits with the median step of the recording.
    - ``bias_walk`` [rad/s/sqrt(s)]: random walk of the bias (rate random walk).
    - ``max_rate`` [rad/s]: readings saturate at plus and minus this rate; None: no limit is known.
    - ``delay`` [s] of the readings relative to their time stamps; in fits only with attitudes or a
      wheel, without which rates do not determine it.
    - ``jitter`` [s]: standard deviation of independent errors of the time stamps.
    - ``scale_std``, ``misalignment_std`` [rad], ``bias_std`` [rad/s], ``delay_std`` [s]: standard
      deviations of the calibration. A fit estimates the errors whose deviation is not zero, with a
      normal prior. The defaults are 1 % for ``scale_std`` and ``misalignment_std``, as in data
      sheets of MEMS gyroscopes, and zero for the others. Misalignments include rotations of the
      sensor. Errors of the gain are relative to the calibrated one, ``gain (1 + errors)``.

    The terms are those of IEEE Std 952-1997, annex C. ``read`` simulates readings;
    ``FitOptions(gyroscope=...)`` uses the model in a fit.

    Raises ValueError for numbers that are negative or not finite, and a singular ``gain``.
    """

    gain: Float[Array, "3 3"] | None = None
    bias: Float[Array, " 3"] | None = None
    noise_density: float = eqx.field(static=True, default=0.0)
    bias_walk: float = eqx.field(static=True, default=0.0)
    max_rate: float | None = eqx.field(static=True, default=None)
    delay: float = eqx.field(static=True, default=0.0)
    jitter: float = eqx.field(static=True, default=0.0)
    scale_std: float = eqx.field(static=True, default=0.01)
    misalignment_std: float = eqx.field(static=True, default=0.01)
    bias_std: float = eqx.field(static=True, default=0.0)
    delay_std: float = eqx.field(static=True, default=0.0)

    def __init__(
        self,
        gain: ArrayLike | None = None,
        bias: ArrayLike | None = None,
        *,
        noise_density: float = 0.0,
        bias_walk: float = 0.0,
        max_rate: float | None = None,
        delay: float = 0.0,
        jitter: float = 0.0,
        scale_std: float = 0.01,
        misalignment_std: float = 0.01,
        bias_std: float = 0.0,
        delay_std: float = 0.0,
    ):
        self.gain = None if gain is None else as_float_array("gain", gain, (3, 3))
        self.bias = None if bias is None else as_float_array("bias", bias, (3,))
        self.noise_density = _check_not_negative("noise_density", noise_density)
        self.bias_walk = _check_not_negative("bias_walk", bias_walk)
        self.max_rate = None if max_rate is None else _check_not_negative("max_rate", max_rate)
        require(self.max_rate != 0, "max_rate of Gyroscope must be positive; None: no limit.")
        require(
            math.isfinite(delay), f"delay of Gyroscope must be a finite number of s, got {delay}."
        )
        self.delay = float(delay)
        self.jitter = _check_not_negative("jitter", jitter)
        self.scale_std = _check_not_negative("scale_std", scale_std)
        self.misalignment_std = _check_not_negative("misalignment_std", misalignment_std)
        self.bias_std = _check_not_negative("bias_std", bias_std)
        self.delay_std = _check_not_negative("delay_std", delay_std)

    @classmethod
    def ideal(cls) -> "Gyroscope":
        """A gyroscope whose scale factors and axes are exactly known."""
        return cls(scale_std=0.0, misalignment_std=0.0)

    def read(self, key: Array, times: ArrayLike, omega_body: ArrayLike) -> Float[Array, "*b t 3"]:
        """Simulated readings (..., T, 3) [rad/s] of the rates ``omega_body`` (..., T, 3) [rad/s].

        ``key``: of ``jax.random``; ``times`` (T,) [s], increasing. Between the samples the rates
        are interpolated by cubics; with ``noise_density`` the noise of a sample is that of the
        mean over the step before it.
        """
        times, omega = as_float_array("times", times, (None,)), jnp.asarray(omega_body)
        require(times.ndim == 1, f"times must have one axis, got the shape {times.shape}.")
        count = times.shape[0]
        require(
            omega.ndim >= 2 and omega.shape[-2:] == (count, 3),
            f"omega_body must have the shape (..., {count}, 3), got {omega.shape}.",
        )
        omega = omega.astype(jnp.result_type(float))
        times = jnp.asarray(times, omega.dtype)
        step = jnp.diff(times)
        step = jnp.broadcast_to(jnp.concatenate([step[:1], step])[:, None], omega.shape)
        shaken, white, walking = jax.random.split(key, 3)
        if self.delay or self.jitter:
            errors = self.jitter * jax.random.normal(shaken, omega.shape[:-1], omega.dtype)
            omega = _at(omega, times, jnp.broadcast_to(times, errors.shape) - self.delay + errors)
        if self.gain is not None:
            omega = jnp.einsum("ij,...j->...i", self.gain.astype(omega.dtype), omega)
        if self.bias is not None:
            omega = omega + jnp.broadcast_to(self.bias.astype(omega.dtype), omega.shape)
        if self.bias_walk:
            steps = jax.random.normal(walking, omega.shape, omega.dtype) * step**0.5
            walk = jnp.cumsum(steps.at[..., 0, :].set(0), axis=-2)
            omega = omega + self.bias_walk * walk
        if self.noise_density:
            noise = jax.random.normal(white, omega.shape, omega.dtype)
            omega = omega + self.noise_density * noise / step**0.5
        if self.max_rate is not None:
            omega = jnp.clip(omega, -self.max_rate, self.max_rate)
        return omega

    @property
    def gain_std(self) -> np.ndarray:
        """Standard deviations (3, 3) of the errors of ``gain``, relative to it."""
        unit = np.eye(3)
        return self.scale_std * unit + self.misalignment_std * (1 - unit)


def _check_not_negative(name: str, value: float) -> float:
    number = float(value) if np.ndim(value) == 0 else math.nan
    require(
        math.isfinite(number) and number >= 0,
        f"{name} of Gyroscope must be one finite number that is not negative, got {value}.",
    )
    return number


def _at(
    omega: Float[Array, "*b t 3"], times: Float[Array, " t"], new_times: Float[Array, "*b t"]
) -> Float[Array, "*b t 3"]:
    """Rates at other times, by cubic Hermite interpolation; beyond the ends by the last cubic."""

    def interpolate(omega, new_times):
        slope = central_slope(omega, times)
        k = jnp.clip(jnp.searchsorted(times, new_times, side="right") - 1, 0, times.shape[0] - 2)
        width = (times[k + 1] - times[k])[:, None]
        s = (new_times - times[k])[:, None] / width
        end_weight = s * s * (3 - 2 * s)
        start_slope_weight, end_slope_weight = s * (1 - s) ** 2, s * s * (s - 1)
        return (
            (1 - end_weight) * omega[k]
            + end_weight * omega[k + 1]
            + width * (start_slope_weight * slope[k] + end_slope_weight * slope[k + 1])
        )

    flat = [omega.reshape(-1, *omega.shape[-2:]), new_times.reshape(-1, new_times.shape[-1])]
    return jax.vmap(interpolate)(*flat).reshape(omega.shape)


def calibrate(recording: Recording, gyroscope: Gyroscope) -> Recording:
    """The recording in rates instead of readings, with the noise that the sensor model implies.

    Readings at the limit are marked in ``Recording.saturated``; a fit treats them as bounds.
    Works on recordings with any leading axes, under jit and vmap.
    """
    if recording.omega is None:
        return recording
    omega, noise, dtype = recording.omega, recording.omega_noise, recording.omega.dtype
    limits = recording.saturated
    if limits is None or gyroscope.max_rate is not None:
        of_readings = saturation(recording, gyroscope.max_rate)
        limits = of_readings if limits is None else jnp.where(limits != 0, limits, of_readings)
    if gyroscope.bias is not None:
        omega = omega - jnp.broadcast_to(gyroscope.bias.astype(dtype), omega.shape)
    if gyroscope.noise_density:
        step = median_step(recording)[..., None, None]
        noise = jnp.broadcast_to(gyroscope.noise_density / step**0.5, omega.shape)
    present = recording.present
    if gyroscope.gain is not None:
        back = inverse(gyroscope.gain).astype(dtype)
        omega = jnp.einsum("ij,...j->...i", back, omega)
        if noise is not None:
            noise = jnp.sqrt(jnp.einsum("ij,...j->...i", back**2, noise**2))
        limits, present = _limits_of_rates(limits, present, back)
    if gyroscope.jitter and noise is not None:
        flat = [
            x.reshape(-1, *x.shape[len(recording.batch_shape) :])
            for x in (interpolate_gaps(recording.times, recording.present, omega), recording.times)
        ]
        slope = jax.vmap(central_slope)(*flat).reshape(omega.shape)
        noise = jnp.sqrt(noise**2 + (gyroscope.jitter * slope) ** 2)
    return dataclasses.replace(
        recording, omega=omega, omega_noise=noise, saturated=limits, present=present
    )


def median_step(recording: Recording) -> Float[Array, "*b"]:
    """Median interval that ends at a sample: others may end at gaps that fill a recording up."""
    steps, is_sample = jnp.diff(recording.times, axis=-1), recording.present[..., 1:] > 0
    is_sample = is_sample | ~jnp.any(is_sample, axis=-1, keepdims=True)
    return jnp.nanmedian(jnp.where(is_sample, steps, jnp.nan), axis=-1)


def _limits_of_rates(limits: Array, present: Array, back: Array) -> tuple[Array, Array]:
    """``saturated`` for the rates ``back @ readings``, and ``present`` of the remaining samples.

    If one reading dominates each rate (the other weights sum to less than a tenth of its weight),
    the rate inherits the limits of that reading. Otherwise a saturated reading bounds no single
    rate, and its sample becomes a gap.
    """
    size = jnp.abs(back)
    is_dominant = size == jnp.max(size, axis=1, keepdims=True)
    of_rates = jnp.einsum("ij,...j->...i", jnp.where(is_dominant, jnp.sign(back), 0), limits)
    has_own_bounds = jnp.all(jnp.sum(size, axis=1) < 1.1 * jnp.max(size, axis=1))
    is_bound = jnp.any(limits != 0, axis=-1)
    remaining = jnp.where(is_bound & ~has_own_bounds, jnp.zeros_like(present), present)
    return jnp.where(has_own_bounds, of_rates, jnp.zeros_like(of_rates)), remaining


class Huber(eqx.Module):
    """Robust loss: residuals beyond ``threshold`` standard deviations count linearly."""

    threshold: float = 3.0

    def __check_init__(self) -> None:
        if not (isinstance(self.threshold, Real | np.ndarray | Array) and self.threshold > 0):
            raise ValueError(f"the threshold of Huber must be positive, got {self.threshold!r}.")

    def __call__(self, residual: Array) -> Array:
        size = jnp.abs(residual)
        inside = size <= self.threshold
        large_size = jnp.where(inside, self.threshold, size)
        outside = jnp.sqrt(2 * self.threshold * large_size - self.threshold**2)
        return jnp.where(inside, residual, jnp.sign(residual) * outside)

    @property
    def inner_variance(self) -> Array:
        """Variance of standard normal deviates within the threshold."""
        k = jnp.asarray(self.threshold, float)
        return 1 - 2 * k * norm.pdf(k) / (2 * norm.cdf(k) - 1)

    def inverse(self, reduced: Array) -> Array:
        """The residual that the loss maps to ``reduced``."""
        size = jnp.abs(reduced)
        outside = (size**2 + self.threshold**2) / (2 * self.threshold)
        return jnp.where(size <= self.threshold, reduced, jnp.sign(reduced) * outside)


# Options of a fit, and checks that they apply to a function and a recording.


class FitOptions(eqx.Module):
    """Options of ``fit_inertia``, ``fit_recordings`` and ``fit_scene``.

    **Arguments:**

    - ``motion``: model of the motion; None: ``FreeMotion()``, torque-free. ``SteppedMotion`` adds
      drag and a reaction wheel, ``SceneMotion`` the forces of any scene.
    - ``unknown``: ``FullTensor()`` (None) or ``MomentsOnly()``, where the sensor axes are principal
      axes.
    - ``initial_inertia``: ``ph.Inertia`` from which the search starts; None: from a linear
      regression on the data.
    - ``robust``: ``Huber(threshold)``, the loss of residuals beyond ``threshold`` standard
      deviations of the noise; None: least squares.
    - ``gyroscope``: ``Gyroscope``, the sensor model and how well it is calibrated; None:
      ``Gyroscope()``, scale factors and misalignment to 1 %. ``Gyroscope.ideal()`` treats them as
      exact, which suits simulated rates; with a real sensor the intervals are then far too narrow.
    - ``bias``: whether a constant bias of the gyroscope is fitted, with no prior.
    - ``mounting``: whether a rotation between the axes of the gyroscope and those of the attitudes
      is fitted.
    - ``trust_noise``: whether the standard deviations of the recording are absolute (True), or only
      their ratios are used and their level is estimated from the residuals (False). None: True if
      ``fit_inertia`` is given a noise or ``gyroscope`` has a ``noise_density``, else False.
    - ``max_starts``: maximum number of starting points. 1: the regression only. Further ones are
      used where the residuals exceed the noise: a second regression, growing parts of the
      recording, other bodies.
    - ``solver``: a Gauss-Newton solver of optimistix; None: Levenberg-Marquardt that stops at a
      small fraction of the standard deviations.
    - ``max_steps``: maximum number of steps of the solver for each starting point.

    A function raises ValueError for an option that it cannot use: ``fit_scene`` for ``motion``,
    ``unknown``, ``initial_inertia`` and ``mounting``.
    """

    motion: AbstractMotion | None = None
    unknown: AbstractInertiaUnknown | None = None
    initial_inertia: Inertia | None = None
    robust: Huber | None = None
    gyroscope: Gyroscope | None = None
    bias: bool = eqx.field(static=True, default=False)
    mounting: bool = eqx.field(static=True, default=False)
    trust_noise: bool | None = eqx.field(static=True, default=None)
    max_starts: int = eqx.field(static=True, default=6)
    solver: optx.AbstractGaussNewton | None = None
    max_steps: int = eqx.field(static=True, default=100)

    def __check_init__(self) -> None:
        kinds = {
            "motion": (AbstractMotion, "a motion such as FreeMotion() or None"),
            "unknown": (AbstractInertiaUnknown, "FullTensor(), MomentsOnly() or None"),
            "initial_inertia": (Inertia, "a ph.Inertia or None"),
            "gyroscope": (Gyroscope, "a Gyroscope or None"),
            "robust": (Huber, "Huber(threshold) or None"),
            "solver": (optx.AbstractGaussNewton, "a Gauss-Newton solver of optimistix or None"),
            "trust_noise": (bool, "True, False or None"),
        }
        for name, (kind, expected) in kinds.items():
            value = getattr(self, name)
            # a traced or mapped option has other leaves, but the same class
            if value is not None and not isinstance(value, kind):
                raise TypeError(
                    f"{name} of FitOptions must be {expected}, got {type(value).__name__}."
                )
        for name in ("bias", "mounting"):
            value = getattr(self, name)
            if not isinstance(value, bool):
                raise TypeError(
                    f"{name} of FitOptions must be True or False, got {type(value).__name__}; the"
                    " fitted value is in Fit.sensor."
                )
        for name in ("max_starts", "max_steps"):
            value = getattr(self, name)
            is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
            if not is_integer or value < 1:
                raise ValueError(
                    f"{name} of FitOptions must be an integer, at least 1, got {value!r}."
                )


def noise_is_trusted(options: FitOptions) -> bool:
    """Whether the noise of the recordings is absolute."""
    if options.trust_noise is None:
        return options.gyroscope is not None and options.gyroscope.noise_density > 0
    return options.trust_noise


def checked_options(options: FitOptions | None) -> FitOptions:
    """The options, or the defaults for None; TypeError for anything else."""
    if options is None:
        return FitOptions()
    if not isinstance(options, FitOptions):
        raise TypeError(
            "options must be a polhode.fit.FitOptions, for example FitOptions(bias=True), got"
            f" {type(options).__name__}."
        )
    return options


def check_usable(options: FitOptions, recording: Recording) -> None:
    """ValueError for options that do not apply to a recording, RuntimeError for float32 data."""
    if recording.times.dtype != np.float64:
        raise RuntimeError(
            "fits need float64, for they compare motions that are nearly equal:"
            " jax.config.update('jax_enable_x64', True) before the recording is made."
        )
    for name in ("bias", "mounting"):
        require(
            recording.omega is not None or not getattr(options, name),
            f"{name}=True needs rates of a gyroscope (omega_body), got attitudes alone.",
        )
    noises = (recording.omega_noise, recording.attitude_noise, recording.force_noise)
    known = [np.asarray(x) for x in noises if x is not None and is_concrete(x)]
    density = options.gyroscope is not None and options.gyroscope.noise_density > 0
    require(
        options.robust is None
        or bool(options.trust_noise)
        or density
        or any(np.any(x != 1) for x in known)
        or not known,
        "robust counts residuals in standard deviations of the noise: give omega_noise (rad/s), or"
        " FitOptions(trust_noise=True) for one of 1 rad/s.",
    )
    count = recording.times.shape[-1]
    require(
        recording.wheel is None or count >= 8,
        f"a recording with wheel speeds needs at least 8 samples, got {count}.",
    )
    sensor = options.gyroscope
    if sensor is not None:
        require(
            recording.omega is not None,
            "the option gyroscope needs its rates (omega_body), got attitudes alone.",
        )
        require(
            not (options.bias and sensor.bias_std),
            "bias=True fits the bias without a prior and bias_std of the gyroscope is its prior:"
            " give one of them.",
        )
        require(
            not (sensor.delay or sensor.delay_std)
            or recording.wxyz is not None
            or recording.wheel is not None,
            "the delay of a gyroscope shows only beside attitudes (wxyz) or a wheel (wheel_speed):"
            " rates alone are those of a motion that begins later.",
        )
        require(
            not sensor.jitter or bool(options.trust_noise) or sensor.noise_density > 0,
            "jitter of the gyroscope adds to a known noise: give omega_noise (rad/s), or"
            " noise_density of the gyroscope.",
        )
    motion = options.motion
    require(
        recording.wheel is not None
        or not isinstance(motion, SteppedMotion)
        or motion.spin_inertia is None,
        "motion=SteppedMotion(spin_inertia) needs the wheel's speed: give wheel_speed.",
    )
    if options.initial_inertia is not None:
        shape = options.initial_inertia.tensor.shape[:-2]
        require(not shape, f"initial_inertia must be that of one body, got the batch axes {shape}.")
