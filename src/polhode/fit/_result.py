"""What a fit found, how well it is known, and what the data cannot say."""

import enum
from collections.abc import Iterable, Mapping
from functools import partial
from statistics import NormalDist
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from polhode._checks import require
from polhode.fit._linear import Linear
from polhode.fit._matrices import eigh, inverse, svd
from polhode.fit._parameters import Parameters, entries_of, whole_of
from polhode.fit._recording import Recording, needed, turn_between
from polhode.fit._residuals import Model
from polhode.fit._solve import FitOptions, Solution, misfit_of
from polhode.inertia import Inertia, principal


class Finding(enum.IntFlag):
    """What to know about a fit before using it (per body; 0: nothing to remark)."""

    NONE = 0
    STEP_LIMIT = 1
    NOT_FINITE = 2
    NEARLY_FLAT = 4
    UNDETERMINED = 8
    AXES_DISAGREE = 16
    NOT_WHITE = 32
    WEAK = 64
    POOR = 128


CURES = {
    Finding.STEP_LIMIT: "the optimiser stopped at its step limit: raise max_steps, try more "
    "starts, or shorten the recording into windows",
    Finding.NOT_FINITE: "the fit is not finite: look for outliers (robust=Huber()), wrong units or "
    "a recording with too little rotation",
    Finding.NEARLY_FLAT: "the best body is flat (one moment is the sum of the two others): the "
    "limit of what is physical; intervals are one-sided there, and drag or bias left out of the "
    "model may have pushed it there",
    Finding.UNDETERMINED: "some of the tensor does not show in this motion (an axis hardly "
    "excited, or a symmetric body): their intervals are infinite; add a recording of another spin",
    Finding.AXES_DISAGREE: "the rates do not turn the attitudes as right-handed axes would: one "
    "axis is inverted, or axes are exchanged; mend the columns (sensor_axes shows how)",
    Finding.NOT_WHITE: "the residuals are correlated in time: the model lacks something (drag, "
    "bias, a moving part) and the intervals are too narrow",
    Finding.WEAK: "a ratio is known to no better than 5 % (a nearly symmetric body, a spin near a "
    "principal axis, a short record): the interval is a rough one, since the valley of good fits "
    "is longer than the linear theory of it holds",
    Finding.POOR: "the residuals are more than twice as large as the noise: a wrong model, wrong "
    "axes or units, outliers (robust=Huber()), or a valley that is not the best",
}

UNUSABLE = Finding.STEP_LIMIT | Finding.NOT_FINITE | Finding.AXES_DISAGREE
"""Findings that raise an error unless ``throw=False``."""


class FitError(RuntimeError):
    """A fit that must not be used as it is; the message says why and what helps."""


class InertiaFit(eqx.Module):
    """Result of ``fit_inertia``; leading axes are those of the bodies.

    **Fields:** ``inertia``: full tensor in sensor axes; where ``scale_known`` (static) is false the
    data show only its shape, and it is given with a largest moment of 1. ``moments`` (..., 3),
    ascending; ``axes`` (..., 4), ``wxyz`` principal -> sensor axes; ``ratios`` (..., 3) to the
    largest moment. ``moments_std``, ``ratios_std``: standard deviations (infinite for what the data
    cannot say); ``axes_std`` (..., 3), rad, about each principal axis. ``covariance`` (..., p, p)
    of the tensor's entries (xx, yy, zz, yz, zx, xy) followed by the other ``parameters``, by
    the pseudo-inverse of ``information``; ``null_directions`` (..., p) how many directions of that
    space are not determined (one for the unknown scale). ``noise``: standard deviation of the
    residuals over that assumed (reduced chi); ``whiteness``: probability of correlations as large
    as those seen, were the residuals independent. ``finding`` (...): ``Finding`` flags.
    """

    inertia: Inertia
    moments: Float[Array, "*b 3"]
    axes: Float[Array, "*b 4"]
    ratios: Float[Array, "*b 3"]
    moments_std: Float[Array, "*b 3"]
    ratios_std: Float[Array, "*b 3"]
    axes_std: Float[Array, "*b 3"]
    information: Float[Array, "*b p p"]
    covariance: Float[Array, "*b p p"]
    null_count: Array
    noise: Float[Array, "*b"]
    whiteness: Float[Array, "*b"]
    rms: Float[Array, "*b"]
    finding: Array
    steps: Array
    attempts: Array
    parameters: Parameters
    model: Model
    residuals: dict[str, Array]
    scale_known: bool = eqx.field(static=True)
    free_rates: bool = eqx.field(static=True)

    @property
    def mirrored(self) -> Inertia:
        """The body that the same rates mean if the sensor axes are left-handed, largest moment 1.

        Reversing one rate (or exchanging two) changes the sign of ``omega x I omega`` and nothing
        else, which is the free motion of the body ``I Sigma`` with ``Sigma = tr(I)/2 - I``: the
        ratios ``I_k (I_i + I_j - I_k)``. It is as physical as the first, so free rates alone cannot
        tell the handedness; attitudes, a wheel or knowledge of the body can.
        """
        return Inertia(diagonal=other_hand(self.moments)).turned(self.axes)

    @property
    def determined(self) -> tuple[Array, Array]:
        """The moments if the scale is known, else the ratios (..., 3), and their deviations."""
        if self.scale_known:
            return self.moments, self.moments_std
        return self.ratios, self.ratios_std

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Ends (..., 3) of the intervals of ``ratios``, or of ``moments`` if the scale is known."""
        require(0 < level < 1, f"level must lie between 0 and 1, got {level!r}: 0.95 for 95 %.")
        value, spread = self.determined
        reach = NormalDist().inv_cdf(0.5 + float(level) / 2) * spread
        return value - reach, value + reach

    def findings(self, body: int = 0) -> list[str]:
        """Names of the remarks on one body, in plain words."""
        return [plainly(flag) for flag in found_of(self, body, Finding)]

    def report(self) -> str:
        """A short text per body: moments, uncertainty, remarks with cause and cure."""
        count = np.asarray(self.finding).size
        lines = [_SCALE] if not self.scale_known else []
        ratios, spread, moments = (
            np.asarray(x).reshape(-1, 3) for x in (self.ratios, self.ratios_std, self.moments)
        )
        rms, noise = np.asarray(self.rms).reshape(-1), np.asarray(self.noise).reshape(-1)
        for k in range(count):
            shown = " : ".join(f"{r:.4f}({s:.1g})" for r, s in zip(ratios[k], spread[k]))
            size = "" if not self.scale_known else f"; moments {moments[k]} kg m^2"
            lines.append(f"body {k}: {shown}{size}; rms {rms[k]:.3g} rad/s, chi {noise[k]:.3g}")
            lines += [f"  - {text}" for text in remarks(self, k) if text != _SCALE]
        return "\n".join(lines)


_SCALE = (
    "Only ratios of moments are determined: free motion does not depend on the size of the inertia "
    "(null direction of the information matrix). A known wheel, torque or moment would fix it."
)


def found_of(fit: Any, body: int, among: Iterable[Finding]) -> list[Finding]:
    """The flags of one body of a fit, in this order."""
    code = int(np.asarray(fit.finding).reshape(-1)[body])
    return [flag for flag in among if code & flag]


def plainly(flag: Finding) -> str:
    """The name of a flag in plain words."""
    return str(flag.name).lower().replace("_", " ")


def flagged(seen: Mapping[Finding, Array]) -> Array:
    """The ``Finding`` of those that are seen (under jit and vmap)."""
    return sum((jnp.where(x, int(flag), 0) for flag, x in seen.items()), start=jnp.asarray(0))


def other_hand(moments: Any) -> Any:
    """Moments (..., 3) of ``InertiaFit.mirrored``, in the order of those given."""
    other = moments * (moments.sum(axis=-1, keepdims=True) - 2 * moments)
    return other / other.max(axis=-1, keepdims=True)


def remarks(fit: InertiaFit, body: int = 0) -> list[str]:
    """What to know before using a fit, with cause and cure, in sentences."""
    found = []
    if not fit.scale_known:
        found.append(_SCALE)
        if fit.free_rates:
            twin = np.sort(other_hand(np.asarray(fit.moments).reshape(-1, 3)[body]))
            found.append(
                "free rates do not show the handedness of the axes: with one axis inverted the "
                f"same data mean {twin[0]:.4f} : {twin[1]:.4f} : 1; compare with what you know of "
                "the body"
            )
    return found + [CURES[flag] for flag in found_of(fit, body, CURES)]


def is_unusable(fit: InertiaFit) -> bool:
    """Whether some body's result must not be used: stopped early, not finite, axes contradict."""
    return bool((np.asarray(fit.finding) & int(UNUSABLE)).any())


class Shown(NamedTuple):
    """What the data show of p unknowns: ``information`` and ``covariance`` (p, p), directions
    ``null`` (p, p) that they do not show (zero columns for the others), natural sizes ``safe`` (p,)
    of 1 over an unknown, how many are not shown, ``noise`` of the residuals over that assumed."""

    information: Array
    covariance: Array
    null: Array
    safe: Array
    null_count: Array
    noise: Array


def shown_by(linear: Linear, recording: Recording, noise_known: bool) -> Shown:
    """What the Jacobian of a fit says about its unknowns, in the order shared, then own."""
    information = linear.information()
    dtype = information.dtype
    # equilibrated: a direction counts as null by its own information, whatever its unit
    size = jnp.sqrt(jnp.diagonal(information))
    safe = jnp.where(size > 0, size, 1)
    values, vectors = eigh(information / safe[:, None] / safe[None])
    known = values > 1e3 * float(jnp.finfo(dtype).eps) * values[-1]
    inverted = jnp.where(known, 1 / jnp.where(known, values, 1), 0)
    data = jnp.sum(recording.present) * linear.rest.shape[-1]
    freedom = jnp.maximum(data - jnp.sum(known).astype(dtype), 1)
    noise = jnp.sqrt(jnp.sum(linear.rest**2) / freedom)
    variance = jnp.asarray(1, dtype) if noise_known else noise**2
    covariance = (vectors * inverted[None]) @ vectors.T / safe[:, None] / safe[None] * variance
    null = jnp.where(known, 0, 1)[None] * vectors / safe[:, None]
    return Shown(information, covariance, null, safe, jnp.sum(~known), noise)


def conclude(solution: Solution, recording: Recording, options: FitOptions) -> InertiaFit:
    """Uncertainty and diagnostics of one body (under jit and vmap)."""
    tensor, model, linear = solution.tensor, solution.model, solution.linear
    dtype = tensor.dtype
    count = model.entries
    entries = entries_of(tensor, count)

    def derived(vector):
        values, axes, products = principal(whole_of(vector, count))
        # the largest is one to itself, rounding aside
        ratios = (values / values[2]).at[2].set(1)
        return jnp.concatenate([values, ratios, products]), (values, axes)

    slope, (moments, axes) = jax.jacfwd(derived, has_aux=True)(entries)
    if not model.scale_known:
        # size that the data do not show: a largest moment of one
        size = moments[2]
        tensor, moments = tensor / size, moments / size
        slope = slope * jnp.where(jnp.arange(9) // 3 == 1, size, 1)[:, None]
        sizes = jnp.where(jnp.arange(linear.shared.shape[-1]) < count, size, 1)
        linear = linear._replace(shared=linear.shared * sizes[None, None])
    shown = shown_by(linear, recording, options.noise_known)
    information, covariance, null, safe = shown[:4]

    full = jnp.concatenate([slope, jnp.zeros((9, information.shape[0] - count), dtype)], axis=1)
    spread = jnp.sqrt(jnp.maximum(jnp.sum((full @ covariance) * full, axis=1), 0))
    # what leans on a null direction is not known at all
    leaning = jnp.sqrt(jnp.sum((full @ null) ** 2, axis=1))
    reach = jnp.sqrt(jnp.sum((full / safe[None]) ** 2, axis=1))
    reach = jnp.concatenate([reach[:3], reach[:3] / moments[2], reach[6:]])
    spread = jnp.where(leaning > 1e-3 * reach, jnp.inf, spread)
    axes_std = turn_std(moments, spread[6:])

    parts = by_kind(linear, recording)
    whiteness = whiteness_of(linear.rest, recording.present)
    rates: Any = parts.get("omega")
    if rates is None:
        rms = jnp.asarray(jnp.nan, dtype)
    else:
        mean = jnp.sum((rates * recording.omega_noise) ** 2) / jnp.sum(recording.present) / 3
        rms = jnp.sqrt(mean)
    trace = tensor[0, 0] + tensor[1, 1] + tensor[2, 2]
    finite = jnp.isfinite(solution.cost) & jnp.all(jnp.isfinite(tensor))
    finding = flagged({
        Finding.STEP_LIMIT: ~solution.stopped,
        Finding.NOT_FINITE: ~finite,
        # the least of the second moments
        Finding.NEARLY_FLAT: trace / 2 - moments[2] < 1e-4 * trace,
        Finding.UNDETERMINED: jnp.any(~jnp.isfinite(spread[3:6])),
        Finding.NOT_WHITE: whiteness < 1e-4,
        Finding.WEAK: jnp.any(spread[3:6] > 0.05),
        Finding.POOR: misfit_of(linear, options.robust) > 4 * solution.expected,
        Finding.AXES_DISAGREE: _axes_disagree(recording, options),
    })  # fmt: skip
    return InertiaFit(
        Inertia(full=tensor), moments, axes, moments / moments[2],
        spread[:3], spread[3:6], axes_std, information, covariance, shown.null_count,
        shown.noise, whiteness, rms, finding, solution.steps,
        solution.attempts, solution.parameters, model,
        parts, model.scale_known, recording.wxyz is None,
    )  # fmt: skip


def turn_std(moments: Float[Array, "3"], products_std: Float[Array, "3"]) -> Float[Array, "3"]:
    """Standard deviations [rad] about the principal axes of those of the products of inertia."""
    gaps = jnp.stack([moments[2] - moments[1], moments[2] - moments[0], moments[1] - moments[0]])
    return jnp.where(gaps > 0, products_std / jnp.where(gaps > 0, gaps, 1), jnp.inf)


def sensor_axes(recording: Recording) -> Float[Array, "*b 3 3"]:
    """Matrix M (..., 3, 3) with ``rates = M (rates of the attitudes)``, by linear regression.

    The identity for a gyroscope aligned with the attitudes' body axes; near -1 in place of 1 on the
    diagonal for an inverted axis, a permutation for exchanged ones, a rotation for a mounting.
    """
    measured, seen = _turns(recording, centred=False)
    mixed = jnp.einsum("...ti,...tj->...ij", measured, seen)
    square = jnp.einsum("...ti,...tj->...ij", seen, seen)
    return mixed @ inverse(square)


def _axes_disagree(recording: Recording, options: FitOptions) -> Array:
    """Whether gyroscope and attitudes contradict each other beyond any mounting rotation."""
    if recording.omega is None or recording.wxyz is None:
        return jnp.asarray(False)
    measured, seen = _turns(recording, centred=options.bias)
    # the proper rotation nearest to the correlation of both, and how much its mirror image gains
    left, sizes, right = svd(jnp.einsum("rti,rtj->ij", measured, seen))
    hand = jnp.sign(jnp.linalg.det(left) * jnp.linalg.det(right))
    inverted = (hand < 0) & (sizes[2] > 0.1 * sizes[1])
    if options.mounting:
        return inverted
    signs = jnp.stack([jnp.ones_like(hand), jnp.ones_like(hand), hand])
    turn = left @ (signs[:, None] * right)
    # less than this is a turn of more than 60 degrees between the axes
    return inverted | (turn[0, 0] + turn[1, 1] + turn[2, 2] < 2)


def _turns(recording: Recording, centred: bool) -> tuple[Array, Array]:
    """Turns between samples by the rates and by the attitudes (..., T-1, 3).

    ``centred``: less their means, whose difference may be the gyroscope's bias.
    """
    wxyz, omega = needed("wxyz", recording.wxyz), needed("omega", recording.omega)
    weight = (recording.present[..., 1:] * recording.present[..., :-1])[..., None]
    step = jnp.diff(recording.times, axis=-1)[..., None]
    measured = step * (omega[..., 1:, :] + omega[..., :-1, :]) / 2
    turned = turn_between(wxyz[..., :-1, :], wxyz[..., 1:, :])
    if centred:
        total = jnp.sum(weight, axis=-2, keepdims=True)
        measured, turned = (
            x - jnp.sum(weight * x, axis=-2, keepdims=True) / total for x in (measured, turned)
        )
    return weight * measured, weight * turned


def by_kind(linear: Linear, recording: Recording) -> dict[str, Array]:
    """Residuals of rates, attitudes and forces, each (r, t, 3), over their noise."""
    parts, channel = {}, 0
    kinds = {"omega": recording.omega, "attitude": recording.wxyz, "force": recording.force}
    for name, measured in kinds.items():
        if measured is not None:
            parts[name] = linear.rest[..., channel : channel + 3]
            channel += 3
    return parts


@partial(jax.jit, static_argnames="lags")  # one program, not one for each operation
def whiteness_of(rest: Array, present: Array, lags: int = 5) -> Array:
    """Ljung-Box probability of the first autocorrelations of all channels together."""
    total = jnp.sum(present, axis=-1)[:, None]
    rest = (rest - (jnp.sum(rest, axis=1) / total)[:, None]) * present[..., None]
    power = jnp.sum(rest**2, axis=1)
    safe = jnp.where(power > 0, power, 1)
    later = jnp.pad(rest, ((0, 0), (0, lags), (0, 0)))

    def one(lag):
        moved = jax.lax.dynamic_slice_in_dim(later, lag, rest.shape[1], axis=1)
        correlation = jnp.sum(rest * moved, axis=1) / safe
        return jnp.sum(correlation**2 / (total - lag.astype(total.dtype)) * total * (total + 2))

    statistic = jnp.sum(jax.lax.map(one, jnp.arange(1, lags + 1)))
    # Chi-square of many degrees by Wilson and Hilferty (PNAS 17 (1931) 684): the exact one would
    # take longer to compile than all else here.
    degrees = lags * power.size
    spread = 2 / (9 * degrees)
    return norm.sf(((statistic / degrees) ** (1 / 3) - 1 + spread) / spread**0.5)
