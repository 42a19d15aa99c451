"""``Recording``: gyroscope rates, attitudes, accelerometer readings, and their noise."""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    is_concrete,
    numbers,
    require,
    require_digits,
    require_positive,
)
from polhode.rotation import conjugate, multiply, normalise, wxyz_to_rotation_vector


class RateUnitError(ValueError):
    """Rates or times that are probably not in rad/s or s."""


# rotation angle between samples [rad] above which a recording under-samples the motion
_TURN_PER_SAMPLE = np.pi
# relative distance from ``max_rate`` within which a reading counts as saturated
_AT_LIMIT = 1e-9


class Recording(eqx.Module):
    """One recording of a tumbling body, or a batch of them with leading axes.

    **Fields:** ``times`` (..., T), s, strictly increasing; any of ``omega`` (..., T, 3), rad/s, the
    gyroscope; ``wxyz`` (..., T, 4), attitudes body -> space; ``force`` (..., T, 3), m/s^2, the
    accelerometer (specific force); each with its standard deviation ``omega_noise``,
    ``attitude_noise`` (rad), ``force_noise``, broadcast against it (1 where unknown: a fit then
    estimates its level from the residuals); ``present`` (..., T): 1 for a sample, 0 for a gap;
    ``wheel`` (..., T), rad/s: speed of a wheel relative to the body, if there is one, interpolated
    in gaps; ``wheel_known`` (..., T): 1 where it was measured; ``saturated`` (..., T, 3):
    1 and -1 where an axis of the gyroscope is at its upper or lower limit, else 0; None: fits
    search for limits by themselves.
    """

    times: Float[Array, "*b t"]
    present: Float[Array, "*b t"]
    omega: Float[Array, "*b t 3"] | None = None
    wxyz: Float[Array, "*b t 4"] | None = None
    force: Float[Array, "*b t 3"] | None = None
    wheel: Float[Array, "*b t"] | None = None
    omega_noise: Float[Array, "*b t 3"] | None = None
    attitude_noise: Float[Array, "*b t"] | None = None
    force_noise: Float[Array, "*b t 3"] | None = None
    wheel_known: Float[Array, "*b t"] | None = None
    saturated: Float[Array, "*b t 3"] | None = None

    @classmethod
    def of(
        cls,
        times: ArrayLike,
        omega_body: ArrayLike | None = None,
        *,
        wxyz: ArrayLike | None = None,
        force_body: ArrayLike | None = None,
        wheel_speed: ArrayLike | None = None,
        omega_noise: ArrayLike = 1.0,
        attitude_noise: ArrayLike = 1.0,
        force_noise: ArrayLike = 1.0,
    ) -> Self:
        """A validated recording. A sample with NaN in its row is a gap and is left out.

        If only its ``wheel_speed`` is NaN, the sample is used with an interpolated speed. Noises
        are numbers, or arrays of one for each axis (3,), sample (T,), or both (T, 3).

        Times must increase; they are shared or carry the same leading axes as the data. All arrays
        become float64, which fits need, if JAX has it (``jax_enable_x64``), else float32. Raises
        ValueError for unsorted or repeated times, fewer than four samples, shapes that do not fit,
        infinite values, noise that is not positive, and rates that turn the body by more than
        half a turn between samples (often degrees in place of radians).
        """
        input_times, times = times, as_float_array("times", times, (None,))
        times = times.astype(jnp.result_type(float))  # of float32 logs too
        require(
            times.shape[-1] >= 4, f"a recording needs at least 4 samples, got {times.shape[-1]}."
        )
        if is_concrete(times):
            require_digits("times", np.asarray(input_times, float), np.asarray(times))
            step = np.diff(np.asarray(times), axis=-1)
            place = int(np.argmin(step.reshape(-1, step.shape[-1]).min(axis=0)))
            require(
                step > 0,
                f"times must be strictly increasing, got a step of {step.min():g} s after sample "
                f"{place}; sort the rows and drop repeated ones.",
            )
        count, dtype = times.shape[-1], times.dtype
        channels = {
            "omega_body": (omega_body, (count, 3)),
            "wxyz": (wxyz, (count, 4)),
            "force_body": (force_body, (count, 3)),
            "wheel_speed": (wheel_speed, (count,)),
        }
        require(
            omega_body is not None or wxyz is not None,
            "a recording needs rates (omega_body), attitudes (wxyz) or both, got neither.",
        )
        arrays = {
            name: _with_gaps(name, value, suffix, dtype)
            for name, (value, suffix) in channels.items()
            if value is not None
        }
        tails = {name: channels[name][1] for name in arrays}
        batches = {n: a.shape[: a.ndim - len(tails[n])] for n, a in arrays.items()}
        batches = {"times": times.shape[:-1]} | batches
        try:
            batch = jnp.broadcast_shapes(*batches.values())
        except ValueError:
            raise ValueError(
                f"the leading axes of a recording must agree, got {batches}."
            ) from None
        require(0 not in batch, f"a recording needs at least one body, got the axes {batch}.")
        # NumPy for concrete arrays: its overhead per operation is a hundredth of JAX's
        xp = numbers(times, *arrays.values())
        arrays = {name: xp.broadcast_to(a, (*batch, *tails[name])) for name, a in arrays.items()}
        times = xp.broadcast_to(times, (*batch, count))
        is_complete = {name: xp.isfinite(a) for name, a in arrays.items()}
        values = {
            name: xp.where(is_complete[name], a, _blank(name, a)) for name, a in arrays.items()
        }
        wheel, wheel_present = values.pop("wheel_speed", None), None
        present = xp.ones_like(times)
        for name in values:
            present = present * xp.all(is_complete[name], axis=-1).astype(dtype)
        if wheel is not None:
            wheel_present = is_complete["wheel_speed"].astype(dtype)
            if is_concrete(wheel_present):
                min_count = int(np.min(np.sum(wheel_present, axis=-1)))
                require(min_count >= 2, f"wheel_speed needs at least 2 numbers, got {min_count}.")
            wheel = interpolate_gaps(*map(jnp.asarray, (times, wheel_present, wheel)))
        if is_concrete(present):
            min_count = int(np.min(np.sum(present, axis=-1)))
            require(
                min_count >= 4,
                f"a recording needs at least 4 samples without NaN, got {min_count}.",
            )
        omega, attitude, force = (values.get(n) for n in ("omega_body", "wxyz", "force_body"))
        if omega is not None and is_concrete(omega, times):
            _check_rates(omega, times)
        noises = (
            None if of is None else _noise(name, value, (*batch, count, *tail), dtype)
            for name, value, of, tail in (
                ("omega_noise", omega_noise, omega, (3,)),
                ("attitude_noise", attitude_noise, attitude, ()),
                ("force_noise", force_noise, force, (3,)),
            )
        )
        attitude = None if attitude is None else normalise(jnp.asarray(attitude))
        parts = (times, present, omega, attitude, force, wheel, *noises, wheel_present)
        return cls(*jax.tree.map(jnp.asarray, parts))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.times.shape[:-1]


def rotation_vector_between(
    first: Float[Array, "*t 4"], second: Float[Array, "*t 4"]
) -> Float[Array, "*t 3"]:
    """Rotation vectors (body axes) between nearby attitudes: twice the quaternion's vector part."""
    turn = multiply(conjugate(first), second)
    sign = jnp.where(turn[..., :1] < 0, -1, 1).astype(turn.dtype)
    return 2 * sign * turn[..., 1:]


def turns_between_samples(recording: "Recording") -> Float[Array, "*b t-1 3"]:
    """Rotation vectors (body axes) from each attitude to the next, of up to half a turn."""
    wxyz = require_channel("wxyz", recording.wxyz)
    return wxyz_to_rotation_vector(multiply(conjugate(wxyz[..., :-1, :]), wxyz[..., 1:, :]))


def turns_of_rates(recording: "Recording") -> Float[Array, "*b t-1 3"]:
    """Rotation vectors (body axes) between samples, from the mean of the rates at both."""
    omega = require_channel("omega_body", recording.omega)
    step = jnp.diff(recording.times, axis=-1)[..., None]
    return step * (omega[..., 1:, :] + omega[..., :-1, :]) / 2


def require_channel(name: str, array: Array | None) -> Array:
    """The field ``name`` of a recording; ValueError where it is None."""
    if array is None:
        raise ValueError(f"the recording has no {name}: make it by Recording.of, which sets it.")
    return array


def size_of_data(recording: Recording, channels: int) -> Array:
    """Number of measured values, not counting saturated readings."""
    count = jnp.sum(recording.present) * channels
    if recording.saturated is None:
        return count
    return count - jnp.sum(jnp.abs(recording.saturated) * recording.present[..., None])


def is_measured(recording: Recording, channels: int) -> Array:
    """Whether each value (..., T, channels) is measured: neither a gap nor a saturated reading."""
    present = recording.present[..., None] > 0
    if recording.saturated is None:
        return jnp.repeat(present, channels, axis=-1)
    # the rates are the first three channels
    others = jnp.repeat(present, channels - 3, axis=-1)
    return jnp.concatenate([present & (recording.saturated == 0), others], axis=-1)


def saturation(recording: Recording, max_rate: float | None = None) -> Float[Array, "*b t 3"]:
    """1 for readings at an upper limit of their axis, -1 at a lower one, else 0.

    With ``max_rate`` these are the readings of that magnitude. Without it an axis counts as
    saturated if at least four samples and 1 % of all equal its extreme value, and five times as
    many as equal the next value (coarse digitisation repeats both). An upper limit is positive and
    a lower one negative; an axis that varies by less than four digitisation steps has no limit.
    """
    omega = recording.omega
    if omega is None:
        return jnp.zeros((*recording.times.shape, 3), recording.times.dtype)
    present = recording.present[..., None] > 0
    dtype = omega.dtype
    if max_rate is not None:
        beyond = (jnp.abs(omega) >= max_rate * (1 - _AT_LIMIT)) & present
        return jnp.sign(omega) * beyond.astype(dtype)
    samples = jnp.sum(present.astype(dtype), axis=-2)
    size = jnp.max(jnp.where(present, jnp.abs(omega), 0), axis=(-2, -1))[..., None]

    def at_upper_limit(values):
        values = jnp.where(present, values, -jnp.inf)
        greatest = jnp.max(values, axis=-2, keepdims=True)
        equal = values == greatest
        below = jnp.where(equal, -jnp.inf, values)
        second_greatest = jnp.max(below, axis=-2, keepdims=True)
        count = jnp.sum(equal.astype(dtype), axis=-2)
        others = jnp.sum(((below == second_greatest) & jnp.isfinite(below)).astype(dtype), axis=-2)
        is_enough = (count >= 4) & (count >= 0.01 * samples)
        # a constant rate has no second value, or one that differs by rounding error only
        top, second = greatest[..., 0, :], second_greatest[..., 0, :]
        extent = top - jnp.min(jnp.where(present, values, jnp.inf), axis=-2)
        varies = jnp.isfinite(second) & (extent > 1e-6 * size) & (extent >= 4 * (top - second))
        clipped = is_enough & (count >= 5 * others) & varies & (top > 0)
        return (equal & present & clipped[..., None, :]).astype(dtype)

    return at_upper_limit(omega) - at_upper_limit(-omega)


@jax.jit
def interpolate_gaps(
    times: Float[Array, "*b t"], present: Float[Array, "*b t"], values: Array
) -> Array:
    """Values with those that are not ``present`` interpolated linearly between their neighbours.

    ``values`` (..., t), or (..., t, c) for channels with the same gaps. Before the first present
    value and after the last they are constant.
    """
    count = times.shape[-1]

    def interpolate(times, present, values):
        place = jnp.arange(count)
        is_present = present > 0
        previous_place = jnp.where(is_present, place, jnp.maximum(place - 1, 0))
        next_place = jnp.where(is_present, place, jnp.minimum(place + 1, count - 1))

        # pointer jumping: each round doubles the distance searched
        def farther(_, neighbours):
            previous_place, next_place = neighbours
            return previous_place[previous_place], next_place[next_place]

        rounds = max(count - 1, 1).bit_length()
        previous_place, next_place = jax.lax.fori_loop(
            0, rounds, farther, (previous_place, next_place)
        )
        previous_place, next_place = (
            jnp.where(is_present[previous_place], previous_place, next_place),
            jnp.where(is_present[next_place], next_place, previous_place),
        )
        span = times[next_place] - times[previous_place]
        part = jnp.where(
            span > 0, (times - times[previous_place]) / jnp.where(span > 0, span, 1), 0
        )
        part = part.reshape(-1, *[1] * (values.ndim - 1))
        return values[previous_place] + part * (values[next_place] - values[previous_place])

    batch = times.shape[:-1]
    flat = [x.reshape(-1, *x.shape[len(batch) :]) for x in (times, present, values)]
    return jax.vmap(interpolate)(*flat).reshape(values.shape)


def stack(recordings: Sequence[Recording]) -> Recording:
    """One recording with a leading axis from several; shorter ones are padded with gaps.

    The gaps of a recording together last one interval between samples (more than a thousand gaps: a
    thousandth of it each), since a torque may not be known later. Raises ValueError for recordings
    that have batch axes or different kinds of data.
    """
    if isinstance(recordings, Recording) or not all(isinstance(r, Recording) for r in recordings):
        raise TypeError("recordings must be a list of Recording objects: [Recording.of(...), ...].")
    require(len(recordings) > 0, "at least one recording is needed, got none.")
    for recording in recordings:
        require(
            not recording.batch_shape,
            f"recordings of one body have no batch axes, got {recording.batch_shape}.",
        )
    longest = max(r.times.shape[-1] for r in recordings)

    def pad(r):
        missing_count = longest - r.times.shape[-1]
        if missing_count == 0:
            return r
        steps = jnp.maximum(jnp.arange(longest) - (longest - missing_count - 1), 0).astype(
            r.times.dtype
        )
        last_interval = r.times[-1] - r.times[-2]
        # of which large times have digits, and differences of the motion
        digits = 64 * jnp.finfo(r.times.dtype).eps * jnp.abs(r.times[-1])
        smallest = jnp.maximum(digits, 1e-3 * last_interval)
        interval = jnp.clip(last_interval / missing_count, smallest, last_interval)
        longer = jax.tree.map(
            lambda array: jnp.concatenate([array, jnp.repeat(array[-1:], missing_count, axis=0)]), r
        )
        return dataclasses.replace(
            longer,
            times=longer.times + steps * interval,
            present=jnp.where(steps > 0, 0, longer.present),
        )

    if any(r.saturated is not None for r in recordings):
        recordings = [
            dataclasses.replace(r, saturated=saturation(r)) if r.saturated is None else r
            for r in recordings
        ]
    kinds = {jax.tree.structure(r) for r in recordings}
    require(len(kinds) == 1, "the recordings must hold the same kinds of data, got a mixture.")
    return jax.tree.map(lambda *parts: jnp.stack(parts), *map(pad, recordings))


def averaged(recording: Recording, count: int) -> Recording:
    """Recording of means over blocks of ``count`` samples; a block with a gap is a gap.

    For sampling much faster than the motion. The mean of a block with a saturated reading is a
    bound of its mean rate, as the reading is (``Recording.saturated``). Raises ValueError for fewer
    than four blocks, and for recordings with attitudes.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"count must be an integer, at least 1, got {count!r}.")
    length = recording.times.shape[-1] // count
    require(
        length >= 4,
        f"blocks of {count} leave {length} of {recording.times.shape[-1]} samples, 4 are needed.",
    )

    require(recording.wxyz is None, "attitudes cannot be averaged; leave them out.")
    place = len(recording.batch_shape)

    def mean(array):
        blocks = jax.lax.slice_in_dim(array, 0, length * count, axis=place)
        shape = (*array.shape[:place], length, count, *array.shape[place + 1 :])
        return jnp.mean(blocks.reshape(shape), axis=place + 1)

    means, noise_of_mean = jax.tree.map(mean, recording), lambda noise: noise / count**0.5
    limits, present = None, jnp.floor(means.present)
    if recording.omega is not None:
        limits = saturation(recording) if recording.saturated is None else recording.saturated
        ends = (mean((side * limits > 0).astype(present.dtype)) > 0 for side in (1, -1))
        upper, lower = (end.astype(present.dtype) for end in ends)
        limits = upper - lower
        present = present * (1 - jnp.max(upper * lower, axis=-1))  # a block at both limits: a gap
    return dataclasses.replace(
        means,
        saturated=limits,
        present=present,
        wheel_known=jax.tree.map(jnp.floor, means.wheel_known),
        omega_noise=jax.tree.map(noise_of_mean, means.omega_noise),
        force_noise=jax.tree.map(noise_of_mean, means.force_noise),
    )


def _with_gaps(name, value, suffix, dtype):
    """Like ``as_float_array``, but with NaN allowed, which marks a gap."""
    raw = np.asarray(value) if is_concrete(value) else value
    holes = np.isnan(raw) if is_concrete(raw) and raw.dtype.kind == "f" else None
    clean = raw if holes is None else np.where(holes, np.zeros((), raw.dtype), raw)
    array = as_float_array(name, clean, suffix).astype(dtype)
    return array if holes is None else np.where(holes, np.asarray(np.nan, dtype), array)


def _blank(name, array):
    """Values in place of NaN at gaps: identity quaternions, or zero."""
    if name == "wxyz":
        return np.broadcast_to(np.asarray([1, 0, 0, 0], array.dtype), array.shape)
    return np.zeros((), array.dtype)


def _check_rates(omega, times):
    """ValueError for rates that turn the body by more than half a turn between samples."""
    turn = np.linalg.norm(np.asarray(omega), axis=-1)[..., 1:] * np.diff(np.asarray(times), axis=-1)
    flat = turn.reshape(-1, turn.shape[-1])
    worst = flat.max(axis=0)
    # few intervals: a gap in an otherwise dense recording, or an outlier
    if 0 < np.sum(worst > _TURN_PER_SAMPLE) <= 0.1 * worst.size:
        place = int(np.argmax(worst))
        intervals = np.abs(np.diff(np.asarray(times), axis=-1)).reshape(-1, worst.size)
        if intervals[:, place].max() > 1.5 * np.median(intervals):
            raise ValueError(
                f"times leave a gap after sample {place}, in which the body turns by some "
                f"{worst[place]:.3g} rad: cut the recording there and give the pieces as "
                "recordings of one body (fit_recordings)."
            )
        raise ValueError(
            f"omega_body of sample {place + 1} would turn the body by {worst[place]:.3g} rad within"
            " one interval between samples, more than half a turn: an outlier? Set its row to NaN."
        )
    if np.any(turn > _TURN_PER_SAMPLE):
        raise RateUnitError(
            f"omega_body turns the body by up to {turn.max():.3g} rad between samples, more than "
            "half a turn; are the rates in deg/s (multiply by pi/180) or the times in ms (divide by"
            " 1000)?"
        )


def _noise(name, value, shape, dtype):
    array = as_float_array(name, value).astype(dtype)
    require_positive(name, array, hint="it is a standard deviation")
    # broadcast as it is, or as one number for the three axes of each sample
    for fitting in (array, array[..., None]) if shape[-1] == 3 else (array,):
        with contextlib.suppress(ValueError):
            return numbers(array).broadcast_to(fitting, shape)
    raise ValueError(
        f"{name} must be a number, or numbers of each sample or axis that broadcast to {shape}, got"
        f" the shape {array.shape}."
    )


def central_slope(omega, times):
    """Derivatives of ``omega`` (t, 3) by central differences, one-sided at the ends."""
    step = jnp.diff(times)[:, None]
    between = jnp.diff(omega, axis=0) / step
    inner_slopes = (between[1:] * step[:-1] + between[:-1] * step[1:]) / (step[1:] + step[:-1])
    return jnp.concatenate([between[:1], inner_slopes, between[-1:]])
