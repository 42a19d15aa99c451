"""Conclusions from the solution of a fit: covariance, observability and diagnostics."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from polhode._scene import State
from polhode.fit._determination import Determination, determination_of
from polhode.fit._findings import Finding
from polhode.fit._model import AbstractMotion, Parameters, entries_of, is_nearly_flat, whole_of
from polhode.fit._numerics import inverse, svd
from polhode.fit._options import FitOptions, Gyroscope, Huber, noise_is_trusted
from polhode.fit._recording import (
    Recording,
    is_measured,
    require_channel,
    size_of_data,
    turns_between_samples,
    turns_of_rates,
)
from polhode.fit._residuals import Linear, prior_of
from polhode.fit._result import Fit, InertiaEstimate
from polhode.fit._solve import Solution, misfit_of
from polhode.inertia import Inertia, principal
from polhode.rotation import multiply, rotation_vector_to_wxyz


def combine_flags(conditions: Mapping[Finding, Array]) -> Array:
    """Sum of the flags whose conditions are true (under jit and vmap)."""
    return sum((jnp.where(x, int(flag), 0) for flag, x in conditions.items()), start=jnp.asarray(0))


class _Split(NamedTuple):
    """Standard deviations of the shared unknowns: tensor entries, sensor and motion."""

    entries: Array
    sensor: dict[str, Array]
    motion: list[Array]


def _sort_by_kind(shared: Any, count: int, parameters: Parameters) -> _Split:
    """``shared`` (s,), ordered as ``Unknowns.shared``, split after its ``count`` tensor entries."""
    position = count
    sensor, motion = {}, []

    def part(like):
        nonlocal position
        position += like.size
        return shared[position - like.size : position].reshape(like.shape)

    for name in ("bias", "mounting", "lever"):
        if (value := getattr(parameters, name)) is not None:
            sensor[name] = part(value)
    for leaf in jax.tree.leaves(parameters.motion):
        motion.append(part(leaf))
    if parameters.gain is not None:
        sensor["gain"] = part(parameters.gain).reshape(3, 3)
    if parameters.delay is not None:
        sensor["delay"] = part(parameters.delay)
    return _Split(shared[:count], sensor, motion)


def _count_after_motion(parameters: Parameters) -> int:
    """How many of the shared unknowns follow those of the motion."""
    return sum(x.size for x in (parameters.gain, parameters.delay) if x is not None)


def _sensor(parameters: Parameters, gyroscope: Gyroscope) -> dict[str, Array]:
    """The fitted sensor unknowns by name; gain, bias and delay include the calibrated values."""
    names = ("bias", "mounting", "lever", "gain", "delay")
    parts = {name: getattr(parameters, name) for name in names}
    parts = {name: part for name, part in parts.items() if part is not None}
    gain = None if gyroscope.gain is None else gyroscope.gain.astype(parameters.omega.dtype)
    if "gain" in parts:
        parts["gain"] = jnp.eye(3, dtype=parts["gain"].dtype) + parts["gain"].reshape(3, 3)
        if gain is not None:
            parts["gain"] = gain @ parts["gain"]
    if "bias" in parts and gyroscope.bias is not None:
        parts["bias"] = parts["bias"] + gyroscope.bias.astype(parts["bias"].dtype)
    if "delay" in parts:
        parts["delay"] = parts["delay"] + gyroscope.delay
    return parts


def _deviations(determination: Determination, count: int) -> Array:
    """Standard deviations of the first ``count`` unknowns; infinite for undetermined ones."""
    std = jnp.sqrt(jnp.maximum(jnp.diagonal(determination.covariance), 0))
    each = jnp.eye(std.size, dtype=std.dtype)
    return jnp.where(determination.null.undetermines(each), jnp.inf, std)[:count]


def _deviations_by_kind(determination: Determination, solution: Solution, count: int) -> _Split:
    """Standard deviations of the shared unknowns; for the gain, of the matrix in ``_sensor``."""
    parameters, gain = solution.parameters, solution.model.gyroscope.gain
    std = _deviations(determination, solution.linear.shared.shape[-1])
    split = _sort_by_kind(std, count, parameters)
    if gain is None or parameters.gain is None:
        return split
    place = np.ravel(_sort_by_kind(np.arange(std.size), count, parameters).sensor["gain"])
    # derivative of ``gain @ errors`` by ``errors``, both row by row
    jacobian = jnp.kron(gain, jnp.eye(3)).astype(std.dtype)
    covariance = jacobian @ determination.covariance[np.ix_(place, place)] @ jacobian.T
    is_unknown = jnp.any((jnp.abs(jacobian) > 0) & jnp.isinf(std[place])[None], axis=1)
    gain_std = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), 0))
    split.sensor["gain"] = jnp.where(is_unknown, jnp.inf, gain_std).reshape(3, 3)
    return split


def _initial(parameters: Parameters, recording: Recording, attitude: Array | None) -> State:
    """States at the first time of each recording; ``attitude``: used where none is recorded."""
    if recording.wxyz is not None:
        turn = rotation_vector_to_wxyz(require_channel("attitude", parameters.attitude))
        return State(multiply(recording.wxyz[:, 0], turn), parameters.omega)
    first_attitude = jnp.asarray([1, 0, 0, 0]) if attitude is None else attitude
    first_attitude = first_attitude.astype(parameters.omega.dtype)
    return State(
        jnp.broadcast_to(first_attitude, (*parameters.omega.shape[:-1], 4)), parameters.omega
    )


def _rms(parts: dict[str, Array], recording: Recording) -> Array:
    """Root mean square of the residual rates, rad/s; NaN without rates."""
    if recording.omega is None:
        return jnp.asarray(jnp.nan, recording.times.dtype)
    square = (parts["omega"] * require_channel("omega_noise", recording.omega_noise)) ** 2
    return jnp.sqrt(jnp.sum(square) / jnp.sum(recording.present) / 3)


def conclude(solution: Solution, recording: Recording, options: FitOptions) -> Fit:
    """Uncertainty and diagnostics of one body's inertia (under jit and vmap)."""
    tensor, model, linear = solution.tensor, solution.model, solution.linear
    parameters = solution.parameters
    dtype = tensor.dtype
    count = model.entries
    entries = entries_of(tensor, count)

    def derived(vector):
        values, axes, products = principal(whole_of(vector, count))
        # the ratio of the largest moment to itself is exactly 1, with zero derivative
        ratios = (values / values[2]).at[2].set(1)
        return jnp.concatenate([values, ratios, products]), (values, axes)

    slope, (moments, axes) = jax.jacfwd(derived, has_aux=True)(entries)
    motion = parameters.motion
    if not model.scale_known and model.motion.scales:
        # The data do not determine the size: scale tensor, unknowns and Jacobian to a largest
        # moment of 1.
        size, motion = moments[2], model.motion.over(motion, moments[2])
        tensor, moments = tensor / size, moments / size
        slope = slope * jnp.where(jnp.arange(9) // 3 == 1, size, 1)[:, None]
        factors = model.motion.over(jax.tree.map(jnp.ones_like, motion), size)
        factors = jnp.concatenate([jnp.ones(0, dtype), *map(jnp.ravel, jax.tree.leaves(factors))])
        first = linear.shared.shape[-1] - _count_after_motion(parameters) - factors.size
        sizes = jnp.ones(linear.shared.shape[-1], dtype).at[:count].set(size)
        sizes = sizes.at[first : first + factors.size].divide(factors)
        solution = dataclasses.replace(solution, linear=linear.scaled(sizes))
    determination = determination_of(solution, recording, noise_is_trusted(options))
    covariance, null = determination.covariance, determination.null

    full_derivative = jnp.concatenate(
        [slope, jnp.zeros((9, covariance.shape[0] - count), dtype)], axis=1
    )
    spread = jnp.sqrt(
        jnp.maximum(jnp.sum((full_derivative @ covariance) * full_derivative, axis=1), 0)
    )
    # a quantity with a component along a null direction is undetermined
    size = null.size_of(full_derivative)
    size = jnp.concatenate([size[:3], size[:3] / moments[2], size[6:]])
    spread = jnp.where(null.undetermines(full_derivative, size), jnp.inf, spread)
    axes_std = turn_std(moments, spread[6:])
    spread = _with_repulsion(moments, spread)

    std = _deviations_by_kind(determination, solution, count)
    findings = {
        Finding.NOT_FINITE: ~(jnp.isfinite(solution.cost) & jnp.all(jnp.isfinite(tensor))),
        Finding.NEARLY_FLAT: is_nearly_flat(tensor, moments),
        Finding.UNDETERMINED: jnp.any(~jnp.isfinite(spread[3:6])),
        Finding.WEAK: is_weak(moments / moments[2], spread[3:6]),
        Finding.AXES_DISAGREE: _axes_disagree(recording, options),
    }
    inertia = InertiaEstimate(
        inertia=Inertia(full=tensor),
        moments=moments,
        axes=axes,
        ratios=moments / moments[2],
        moments_std=spread[:3],
        ratios_std=spread[3:6],
        axes_std=axes_std,
        scale_known=model.scale_known,
        handedness_known=recording.wxyz is not None,
    )
    return _fit_of(
        solution,
        recording,
        options,
        determination,
        findings,
        values=[tensor, *jax.tree.leaves(motion)],
        values_std=[symmetric_std(std.entries), *std.motion],
        sensor_std=std.sensor,
        inertia=inertia,
    )


def is_weak(ratios: Float[Array, " 3"], std: Float[Array, " 3"]) -> Array:
    """Whether the standard deviation of a ratio exceeds 0.05, or half of the ratio (for ratios near
    zero): the misfit is not quadratic over such a range."""
    return jnp.any((std > 0.05) | (2 * std > ratios))


def conclude_scene(solution: Solution, recording: Recording, options: FitOptions) -> Fit:
    """Values, uncertainty and diagnostics of one body's scene (under jit and vmap)."""
    linear, parameters, motion = solution.linear, solution.parameters, solution.model.motion
    determination = determination_of(solution, recording, noise_is_trusted(options))
    spread = _deviations(determination, linear.shared.shape[-1])
    std = _deviations_by_kind(determination, solution, 0)
    findings = {
        Finding.NOT_FINITE: ~(jnp.isfinite(solution.cost) & jnp.all(jnp.isfinite(linear.at))),
        Finding.UNDETERMINED: jnp.any(~jnp.isfinite(spread)),
        Finding.AT_BOUND: motion.at_bound(parameters.motion),
        Finding.PRIOR_DISAGREES: _prior_disagrees(motion, parameters.motion, std.motion),
    }
    return _fit_of(
        solution,
        recording,
        options,
        determination,
        findings,
        values=motion.arrays_of(parameters.motion),
        values_std=motion.arrays_of(std.motion),
        sensor_std=std.sensor,
        attitude=getattr(options.motion, "attitude", None),
    )


def _fit_of(
    solution: Solution,
    recording: Recording,
    options: FitOptions,
    determination: Determination,
    findings: dict[Finding, Array],
    *,
    values: list[Array],
    values_std: list[Array],
    sensor_std: dict[str, Array],
    attitude: Any = None,
    inertia: InertiaEstimate | None = None,
) -> Fit:
    """The ``Fit``: with the ``findings`` of its kind of fit and those common to all fits."""
    linear, parameters, model = solution.linear, solution.parameters, solution.model
    parts = residuals_by_channel(linear, recording, options.robust)
    size = size_of_data(recording, linear.residuals.shape[-1])
    whiteness = whiteness_of(
        linear.residuals, recording.present, determination.count / jnp.maximum(size, 1)
    )
    findings = findings | {
        Finding.STEP_LIMIT: ~solution.stopped,
        Finding.NOT_WHITE: whiteness < 1e-4,
        Finding.POOR: misfit_of(linear, options.robust) > 4 * solution.expected,
        Finding.SATURATED: is_saturated(recording),
        Finding.CALIBRATION: _calibration_strained(solution, recording),
        Finding.OUTLIERS: has_outliers(linear.residuals, recording, options.robust),
    }
    return Fit(
        values=values,
        std=values_std,
        sensor=_sensor(parameters, model.gyroscope),
        sensor_std=sensor_std,
        initial=_initial(parameters, recording, attitude),
        information=determination.information,
        covariance=determination.covariance,
        null_count=determination.null_count,
        noise=determination.noise,
        whiteness=whiteness,
        rms=_rms(parts, recording),
        diagnostics=combine_flags(findings),
        steps=solution.steps,
        attempts=solution.attempts,
        residuals=parts,
        parameters=parameters,
        model=model,
        _null=determination.null,
        _inertia=inertia,
    )


def symmetric_std(entries: Float[Array, " e"]) -> Float[Array, "3 3"]:
    """Standard deviations of a tensor from those of its entries; zero for absent products."""
    return whole_of(entries, entries.shape[0])


def turn_std(moments: Float[Array, "3"], products_std: Float[Array, "3"]) -> Float[Array, "3"]:
    """Standard deviations [rad] of rotations about the principal axes, from those of the products
    of inertia in these axes: products over the differences of the moments."""
    gaps = jnp.stack([moments[2] - moments[1], moments[2] - moments[0], moments[1] - moments[0]])
    return jnp.where(gaps > 0, products_std / jnp.where(gaps > 0, gaps, 1), jnp.inf)


def _with_repulsion(moments: Float[Array, "3"], std: Float[Array, "9"]) -> Float[Array, "9"]:
    """Standard deviations of moments, ratios and products, including eigenvalue repulsion.

    The error p of a product of inertia drives two eigenvalues apart: half of their gap, h, grows by
    p^2 / (2 h), of which the root mean square is 0.87 std^2 / h. This term is of second order, so
    the (linear) covariance lacks it, but where std is as large as h it is as large as the error
    itself. It is limited to h, since the whole gap may be an effect of the error.
    """
    pairs = (1, 2), (0, 2), (0, 1)
    variance = std * std
    for k, (i, j) in enumerate(pairs):
        half = (moments[j] - moments[i]) / 2
        product_std = jnp.where(jnp.isfinite(std[6 + k]), std[6 + k], 0)
        shift = jnp.minimum(half, product_std**2 / jnp.where(half > 0, half, 1))
        moved = jnp.zeros_like(moments).at[i].set(-shift).at[j].set(shift)
        ratio_change = (moved - moments / moments[2] * moved[2]) / moments[2]
        variance = variance.at[:6].add(jnp.concatenate([moved, ratio_change]) ** 2)
    return jnp.sqrt(variance)


def sensor_axes(recording: Recording) -> Float[Array, "*b 3 3"]:
    """Matrix M (..., 3, 3) with ``rates = M (rates of the attitudes)``, by linear regression.

    The identity for a gyroscope aligned with the attitudes' body axes; near -1 in place of 1 on the
    diagonal for an inverted axis, a permutation for exchanged ones, a rotation for a mounting.
    """
    measured, from_attitudes = _turns(recording, centred=False)
    product = jnp.einsum("...ti,...tj->...ij", measured, from_attitudes)
    square = jnp.einsum("...ti,...tj->...ij", from_attitudes, from_attitudes)
    return product @ inverse(square)


def is_saturated(recording: Recording) -> Array:
    """Whether readings of the gyroscope are at its limits."""
    if recording.saturated is None:
        return jnp.asarray(False)
    return jnp.any((recording.saturated != 0) & (recording.present[..., None] > 0))


def _calibration_strained(solution: Solution, recording: Recording) -> Array:
    """Whether a calibration unknown is more than 3.5 standard deviations from its prior mean."""
    is_far = jnp.asarray(False)
    for name, precision in (
        prior_of(solution.parameters, recording, solution.model)._asdict().items()
    ):
        if name != "motion" and precision is not None:
            value = getattr(solution.parameters, name)
            is_far = is_far | jnp.any(value**2 * precision > 3.5**2)
    return is_far


def _prior_disagrees(motion: AbstractMotion, values: list[Array], std: list[Array]) -> Array:
    """Whether a value is farther from its prior mean than prior and data explain.

    With the prior's variance v and that of the fit, p, the variance of the difference is v - p.
    """
    is_far = jnp.asarray(False)
    for value, mean, spread, prior in zip(values, motion.start(), std, motion.prior_std()):
        if prior is not None:
            # at least a tenth of the prior's, below which the linear theory of the fit is not exact
            explained = jnp.sqrt(jnp.maximum(prior**2 - spread**2, 1e-2 * prior**2))
            is_far = is_far | jnp.any(jnp.abs(value - mean) > 3.5 * explained)
    return is_far


def has_outliers(residuals: Array, recording: Recording, robust: Any) -> Array:
    """Whether isolated residuals (r, t, c) are outliers; False for fits with a robust loss.

    An outlier is beyond five sigma (from the median of the absolute values, of each channel) and
    its two neighbours are within three: an incomplete model leaves runs of large residuals, not
    single ones. True for at least three outliers that are 0.3 % of all residuals.
    """
    if robust is not None:
        return jnp.asarray(False)
    # without saturated readings, whose one-sided residuals may be zero
    measured = is_measured(recording, residuals.shape[-1])
    size = jnp.where(measured, jnp.abs(residuals), jnp.nan)
    # that of few samples may be small by chance: at least the one of all recordings
    scale = jnp.maximum(*(jnp.nanmedian(size, axis=k, keepdims=True) for k in (1, (0, 1))))
    scale = 1.4826 * scale
    deviation = jnp.nan_to_num(size / jnp.where(scale > 0, scale, jnp.inf))
    padded_deviation = jnp.pad(deviation, ((0, 0), (1, 1), (0, 0)))
    is_isolated = (deviation > 5) & (padded_deviation[:, :-2] < 3) & (padded_deviation[:, 2:] < 3)
    count, total = (jnp.sum(x.astype(residuals.dtype)) for x in (is_isolated, measured))
    return (count >= 3) & (count >= 0.003 * total)


def _axes_disagree(recording: Recording, options: FitOptions) -> Array:
    """Whether gyroscope and attitudes contradict each other beyond any mounting rotation."""
    if recording.omega is None or recording.wxyz is None:
        return jnp.asarray(False)
    measured, from_attitudes = _turns(recording, centred=options.bias)
    # the orthogonal matrix nearest to the correlation of both; hand is -1 for a reflection
    left_vectors, sizes, right_vectors = svd(jnp.einsum("rti,rtj->ij", measured, from_attitudes))
    hand = jnp.sign(jnp.linalg.det(left_vectors) * jnp.linalg.det(right_vectors))
    power = jnp.sum((measured @ left_vectors) ** 2, axis=(0, 1))
    power = power * jnp.sum((from_attitudes @ right_vectors.T) ** 2, axis=(0, 1))
    # Directions count only if both are correlated along them: elsewhere noise alone sets the
    # singular vectors, as for the two transverse axes of a rotation about a fixed axis.
    shown = sizes > 0.5 * jnp.sqrt(power)
    shows_turn = shown[1] & (sizes[1] > 0.02 * sizes[0])
    inverted = shows_turn & shown[2] & (hand < 0) & (sizes[2] > 0.1 * sizes[1])
    if options.mounting:
        return inverted
    signs = jnp.stack([jnp.ones_like(hand), jnp.ones_like(hand), hand])
    turn = left_vectors @ (signs[:, None] * right_vectors)
    turned = jnp.where(
        shows_turn,
        turn[0, 0] + turn[1, 1] + turn[2, 2] < 2,  # by more than 60 degrees
        shown[0] & (jnp.dot(left_vectors[:, 0], right_vectors[0]) < 0.5),
    )
    return inverted | turned


def _turns(recording: Recording, centred: bool) -> tuple[Array, Array]:
    """Rotation vectors between samples (..., T-1, 3) by the rates and by the attitudes.

    ``centred``: minus their means, whose difference may be the gyroscope's bias.
    """
    weight = (recording.present[..., 1:] * recording.present[..., :-1])[..., None]
    measured, recorded = turns_of_rates(recording), turns_between_samples(recording)
    if centred:
        total = jnp.sum(weight, axis=-2, keepdims=True)
        measured, recorded = (
            x - jnp.sum(weight * x, axis=-2, keepdims=True) / total for x in (measured, recorded)
        )
    return weight * measured, weight * recorded


def residuals_by_channel(
    linear: Linear, recording: Recording, robust: Huber | None
) -> dict[str, Array]:
    """Residuals of rates, attitudes and forces, each (r, t, 3), over their noise, before the
    ``robust`` loss."""
    residuals = linear.residuals if robust is None else robust.inverse(linear.residuals)
    parts, channel = {}, 0
    kinds = {"omega": recording.omega, "attitude": recording.wxyz, "force": recording.force}
    for name, measured in kinds.items():
        if measured is not None:
            parts[name] = residuals[..., channel : channel + 3]
            channel += 3
    return parts


@partial(jax.jit, static_argnames="lags")  # outside jit too, one program for all operations
def whiteness_of(
    residuals: Array, present: Array, unknown_part: Array | float = 0.0, lags: int = 5
) -> Array:
    """Ljung-Box probability of the first autocorrelations of all channels together.

    ``unknown_part``: number of fitted unknowns over that of the residuals. Lags up to a quarter of
    the samples count. Means and variances of the autocorrelations of few independent samples are
    those of J.-M. Dufour and R. Roy, Biometrika 72 (1985) 649. The unknowns fit part of the noise,
    which correlates the residuals: by as much as a low-pass filter of ``unknown_part`` of the band
    would that was subtracted. Its sign depends on the motion, so that it is a shift of unknown sign
    (noncentral chi-square). In 1e5 draws of 8 to 200 samples with 0 to 11 unknowns, at most 0.04 %
    had a probability below 0.01 %.
    """
    dtype = residuals.dtype
    total = jnp.sum(present, axis=-1)[:, None]
    is_used = total > 3
    # other recordings, such as those that only pad a batch, do not contribute
    total = jnp.where(is_used, total, 4)
    residuals = (residuals - (jnp.sum(residuals, axis=1) / total)[:, None]) * present[..., None]
    power = jnp.sum(residuals**2, axis=1)
    safe = jnp.where(power > 0, power, 1)
    later = jnp.pad(residuals, ((0, 0), (0, lags), (0, 0)))
    later_present = jnp.pad(present, ((0, 0), (0, lags)))
    unknown_part = jnp.minimum(jnp.asarray(unknown_part, dtype), 0.9)

    def statistic_at(lag):
        lagged, present_too = (
            jax.lax.dynamic_slice_in_dim(x, lag, residuals.shape[1], axis=1)
            for x in (later, later_present)
        )
        # pairs of samples that are both present: without gaps the number of samples minus the lag
        pairs = jnp.sum(present * present_too, axis=1)[:, None]
        k = lag.astype(dtype)
        counted = is_used & (pairs > 0) & (k <= jnp.maximum(total / 4, 1))
        correlation = jnp.sum(residuals * lagged, axis=1) / safe
        mean = -pairs / (total * (total - 1))
        variance = total**4 - (k + 3) * total**3 + 3 * k * total**2
        variance = variance + 2 * k * (k + 1) * total - 4 * k**2
        variance = variance / ((total + 1) * (total * (total - 1)) ** 2)
        variance = jnp.where(counted, variance * pairs / (total - k), jnp.inf)
        shift = unknown_part * jnp.sinc(k * unknown_part) / (1 - unknown_part) * pairs / total
        counts = jnp.sum(counted.astype(dtype))
        return jnp.sum((correlation - mean) ** 2 / variance), jnp.sum(shift**2 / variance), counts

    parts = jax.lax.map(statistic_at, jnp.arange(1, lags + 1))
    statistic, shift, counted = (jnp.sum(x) for x in parts)
    channels = residuals.shape[-1]
    degrees, shift = channels * counted, channels * shift
    has_pairs, degrees = degrees > 0, jnp.maximum(degrees, 1)
    # a chi-square variable of the same mean and variance; that of few samples is larger by 4 / T
    samples = jnp.sum(jnp.where(is_used, total, 0))
    samples = samples / jnp.maximum(jnp.sum(is_used.astype(dtype)), 1)
    factor = (degrees + 2 * shift) / (degrees + shift) * (1 + 4 / jnp.maximum(samples, 1))
    statistic, degrees = statistic / factor, (degrees + shift) / factor
    # Chi-square of many degrees by Wilson and Hilferty (PNAS 17 (1931) 684): the exact function
    # would take longer to compile than the rest of this one.
    spread = 2 / (9 * degrees)
    probability = norm.sf(((statistic / degrees) ** (1 / 3) - 1 + spread) / spread**0.5)
    return jnp.where(has_pairs, probability, 1)
