"""``fit_balance``: inertia from throws in air, in absolute size with a reaction wheel aboard."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from benchmarks.throws.instrument import Instrument, Tolerance
from benchmarks.throws.likelihood import Noise, readings_of
from benchmarks.throws.scoring import Known, solve_balance, start_of
from polhode._checks import is_concrete, require
from polhode._scene import State
from polhode.fit._conclude import combine_flags, symmetric_std, turn_std, whiteness_of
from polhode.fit._findings import Finding
from polhode.fit._model import (
    Base,
    Drag,
    FullTensor,
    Parameters,
    SteppedMotion,
    base_of,
    entries_of,
    free_columns,
    whole_of,
)
from polhode.fit._numerics import compiled, eigh
from polhode.fit._recording import Recording, require_channel, stack
from polhode.fit._residuals import Model
from polhode.fit._result import Fit, InertiaEstimate, checked_fit
from polhode.inertia import Inertia, principal, second_moments


class ThrowFit(eqx.Module):
    """A ``polhode.fit.Fit``, whose attributes this object has, and the instrument that was found.

    **Fields:** ``fit``; ``instrument``, as estimated where a ``tolerance`` was given;
    ``noise_levels``: standard deviations of readings and disturbing torques;
    ``negative_log_likelihood`` (n,): of all readings together, up to a constant; ``block``.
    """

    fit: Fit
    instrument: Instrument
    noise_levels: Noise
    negative_log_likelihood: Float[Array, " n"]
    block: int = eqx.field(static=True)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "fit":
            raise AttributeError(name)
        return getattr(self.fit, name)


def fit_balance(
    recordings: Sequence[Recording],
    instrument: Instrument,
    *,
    bodies: Sequence[int] | None = None,
    tolerance: Tolerance | None = None,
    block: int = 1,
    throw: bool = True,
) -> ThrowFit:
    """Inertia tensors of thrown bodies by maximum likelihood of the readings of a gyroscope.

    For throws in air, with a reaction wheel of measured speed or without one (``Instrument(None)``:
    then the ratios of the moments show, not their size). The gyroscope turns the frame in which the
    momentum ``I omega + h`` is followed by a Kalman filter; drag, white torques and a torque with
    memory change it, with levels that are estimated. The rates read are compared with those
    expected: their noise does not bias the moments, not even of a single short throw that hardly
    shows them.

    **Arguments:**

    - ``recordings``: with rates and, for a wheel, ``wheel_speed``, of free flight only; NaN where a
      reading is doubtful, such as the speed of a motor that was just switched on.
    - ``instrument``: as in its data sheet; ``tolerance``: standard deviations of it, with which it
      is fitted to all recordings together (None: it is taken as given).
    - ``bodies``: number of the body that each recording shows, from 0 on (None: one body).
    - ``block``: how many samples give one residual: so many that their noise is white. Readings
      much faster than the motion are best ``averaged`` first.
    - ``throw``: whether a fit that is not finite or did not converge raises FitError.

    Returns a ``ThrowFit`` whose leading axis n are the bodies. A body with fewer recordings than
    another has zeros as residuals and initial rates of those that it lacks. Every tensor is
    physical.

    Raises ValueError for recordings without rates or the wheel's speed, and FitError.
    """
    given = stack(recordings)
    wheel = instrument.spin_inertia is not None
    require(given.omega is not None, "a balance needs omega_body in every recording.")
    require(
        (given.wheel is not None) == wheel,
        "an instrument with a wheel needs wheel_speed in every recording."
        if wheel
        else "recordings with wheel_speed need the wheel's spin_inertia in the instrument.",
    )
    numbers = np.zeros(len(recordings), int) if bodies is None else np.asarray(bodies)
    count = int(numbers.max()) + 1
    require(
        numbers.shape == (len(recordings),) and set(numbers.tolist()) == set(range(count)),
        f"bodies must number the body of each of {len(recordings)} recordings from 0 on without "
        f"leaving one out, got {numbers.tolist()}.",
    )
    require(is_concrete(given.times), "fit_balance takes arrays, not traced values.")
    present = np.asarray(given.present) > 0
    if wheel:
        present = present & (np.asarray(require_channel("wheel_known", given.wheel_known)) > 0)
    require(
        present.sum(axis=1) >= 8,
        "each recording needs at least 8 samples with rates and wheel, got "
        f"{present.sum(axis=1).min()}.",
    )
    places, used = _by_body(numbers, count)
    estimate = _together(given, jnp.asarray(numbers), places, used, instrument, tolerance, block)
    found = _fit_of(estimate, block)
    checked_fit(found.fit, throw)
    return found


def fit_each(fit: ThrowFit, recordings: Sequence[Recording], body: int = 0) -> ThrowFit:
    """Every recording of a body by itself, with the instrument and the noise of a joint fit.

    **Arguments:** ``fit``: of ``fit_balance``; ``recordings`` of one of its bodies, ``body``.
    Returns a ``ThrowFit`` whose leading axis are the recordings.
    """
    instrument, noise, tensor = jax.tree.map(
        lambda x: x[body], (fit.instrument, fit.noise_levels, fit.inertia.tensor)
    )
    given, block = stack(recordings), fit.block
    fits = [
        _fit_of(
            _alone(
                jax.tree.map(lambda x, k=k: x[k : k + 1], given), instrument, noise, tensor, block
            ),
            block,
        )
        for k in range(len(recordings))
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *fits)


def _by_body(numbers: np.ndarray, count: int) -> tuple[Array, Array]:
    """Places (n, m) of the recordings of each body among all, and 1 where there is one, else 0."""
    each = [np.flatnonzero(numbers == k) for k in range(count)]
    most = max(map(len, each))
    places, used = np.zeros((count, most), int), np.zeros((count, most))
    for k, one in enumerate(each):
        places[k, : len(one)], used[k, : len(one)] = one, 1
    return jnp.asarray(places), jnp.asarray(used)


class _Estimate(NamedTuple):
    """Arrays of the ``Fit`` of a balance; all have the leading axis n."""

    body: InertiaEstimate
    values: list[Array]  # tensor (n, 3, 3), linear and quadratic drag (n,)
    std: list[Array]
    information: Float[Array, "n 8 8"]
    covariance: Float[Array, "n 8 8"]
    null_count: Int[Array, " n"]
    noise: Float[Array, " n"]
    whiteness: Float[Array, " n"]
    rms: Float[Array, " n"]
    diagnostics: Int[Array, " n"]
    residuals: dict[str, Array]
    rates: Float[Array, "n m 3"]
    base: Base
    instrument: Instrument
    noise_levels: Noise
    negative_log_likelihood: Float[Array, " n"]
    steps: Int[Array, " n"]


@compiled
def _together(recording, numbers, places, used, instrument, tolerance, block) -> _Estimate:
    data = readings_of(recording, numbers, block)
    sigma, noise = start_of(data, instrument, places.shape[0])
    known = Known(sigma, instrument, tolerance or Tolerance(), noise)
    solution = solve_balance(data, known, "instrument" if tolerance else "noise")
    return _concluded(solution, recording, places, used)


@compiled
def _alone(recording, instrument, noise, tensor, block) -> _Estimate:
    sigma = (jnp.trace(tensor) / 2 * jnp.eye(3, dtype=tensor.dtype) - tensor)[None]
    data = readings_of(recording, jnp.zeros(1, int), block)
    noise = Noise(*(x[None] for x in noise[:5]), *noise[5:])
    known = Known(sigma, instrument, Tolerance(), noise)
    one = jnp.zeros((1, 1), int), jnp.ones((1, 1))
    return _concluded(solve_balance(data, known, "tensor"), recording, *one)


def _concluded(found, recording: Recording, places: Array, used: Array) -> _Estimate:
    """Uncertainty and diagnostics of every body, its recordings at ``places`` (n, m)."""
    sized = found.instrument.spin_inertia is not None
    dtype = found.tensors.dtype
    used = used.astype(dtype)

    def one(tensor, drag, covariance, rest, spread, first, used, levels):
        moments, axes, _ = principal(tensor)

        def derived(vector):
            values, _, products = principal(whole_of(vector[:6]))
            every = jnp.concatenate([values, products, vector])
            every = every if sized else every / values[2]
            return jnp.concatenate([every, (values / values[2]).at[2].set(1)])

        # moments, products, entries, drag and ratios begin at 0, 3, 6, 12, 14
        slope = jax.jacfwd(derived)(jnp.concatenate([entries_of(tensor), drag]))
        covariance = slope @ covariance @ slope.T
        std = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), 0))
        covariance = covariance[6:14, 6:14]
        size = jnp.ones_like(moments[2]) if sized else moments[2]
        tensor, moments = tensor / size, moments / size
        # without a wheel the data do not show the size
        moments_std, entries_std = std[:3], std[6:12]
        if not sized:
            moments_std, entries_std = (
                jnp.full_like(x, jnp.inf) for x in (moments_std, entries_std)
            )
        rest, spread = (x * used[:, None, None] for x in (rest, spread))
        read = jnp.any(rest != 0, axis=-1).astype(dtype)
        samples = 3 * jnp.maximum(jnp.sum(read), 1)
        noise, rms = (jnp.sqrt(jnp.sum(x**2) / samples) for x in (rest, rest * spread))
        whiteness, trace = whiteness_of(rest, read), jnp.trace(tensor)
        finite = jnp.all(jnp.isfinite(tensor)) & jnp.all(jnp.isfinite(covariance))
        diagnostics = combine_flags(
            {
                Finding.STEP_LIMIT: ~found.converged,
                Finding.NOT_FINITE: ~finite,
                Finding.NEARLY_FLAT: trace / 2 - moments[2] < 1e-4 * trace,
                Finding.NOT_WHITE: whiteness < 1e-4,
                Finding.WEAK: jnp.any(std[14:16] > 0.05),
            }
        )
        information, null_count = _pseudo_inverse(covariance)
        body = InertiaEstimate(
            inertia=Inertia(full=tensor),
            moments=moments,
            axes=axes,
            ratios=moments / moments[2],
            moments_std=moments_std,
            ratios_std=std[14:],
            axes_std=turn_std(moments, std[3:6]),
            scale_known=sized,
            handedness_known=False,
        )
        return _Estimate(
            body=body,
            values=[tensor, *(drag / size)],
            std=[symmetric_std(entries_std), *std[12:14]],
            information=information,
            covariance=covariance,
            null_count=null_count,
            noise=noise,
            whiteness=whiteness,
            rms=rms,
            diagnostics=diagnostics,
            residuals={"omega": rest, "omega_std": spread},
            rates=first * used[:, None],
            base=base_of(second_moments(tensor), sized),
            instrument=found.instrument,
            noise_levels=levels.grown(1 / size),
            negative_log_likelihood=found.negative_log_likelihood,
            steps=found.steps,
        )

    # those that all bodies share as well
    shared = (jnp.broadcast_to(x, used.shape[:1]) for x in found.noise[5:])
    levels = Noise(*found.noise[:5], *shared)
    first = found.instrument.rates(require_channel("omega", recording.omega)[:, 0])
    return jax.vmap(one)(
        found.tensors,
        found.drag,
        found.covariance,
        found.rest[places],
        found.spread[places],
        first[places],
        used,
        levels,
    )


def _pseudo_inverse(matrix: Float[Array, "p p"]) -> tuple[Float[Array, "p p"], Int[Array, ""]]:
    """Pseudo-inverse of a covariance in units of its own, and how many directions it lacks."""
    size = jnp.sqrt(jnp.diagonal(matrix))
    safe = jnp.where(size > 0, size, 1)
    values, vectors = eigh(matrix / safe[:, None] / safe[None])
    shown = values > 1e3 * float(jnp.finfo(matrix.dtype).eps) * values[-1]
    inverted = jnp.where(shown, 1 / jnp.where(shown, values, 1), 0)
    return (vectors * inverted[None]) @ vectors.T / safe[:, None] / safe[None], jnp.sum(~shown)


def _fit_of(estimate: _Estimate, block: int) -> ThrowFit:
    """The arrays as a ``ThrowFit``; outside of jit, for the wheel's axis is a static number."""
    device, rates = estimate.instrument, estimate.rates
    sized = estimate.body.scale_known
    _, linear, quadratic = estimate.values
    columns = free_columns(FullTensor(), sized)
    x, y, z = (float(part) for part in np.asarray(device.axis)[0])
    zero = jnp.zeros_like(linear)
    motion = SteppedMotion(
        device.spin_inertia, (x, y, z), device.delay, Drag(zero, zero), fit_drag=True
    )
    parameters = Parameters(
        jnp.zeros((*linear.shape, columns.shape[1]), linear.dtype),
        rates,
        bias=device.bias,
        motion={"drag": Drag(linear, quadratic), "delay": None},
    )
    unit = jnp.asarray([1, 0, 0, 0], rates.dtype)
    fit = Fit(
        values=estimate.values,
        std=estimate.std,
        sensor={},
        sensor_std={},
        initial=State(jnp.broadcast_to(unit, (*rates.shape[:-1], 4)), rates),
        information=estimate.information,
        covariance=estimate.covariance,
        null_count=estimate.null_count,
        noise=estimate.noise,
        whiteness=estimate.whiteness,
        rms=estimate.rms,
        diagnostics=estimate.diagnostics,
        steps=estimate.steps,
        attempts=jnp.ones_like(estimate.steps),
        residuals=estimate.residuals,
        parameters=parameters,
        model=Model(
            motion, estimate.base, columns=tuple(map(tuple, columns.tolist())), scale_known=sized
        ),
        _inertia=estimate.body,
    )
    return ThrowFit(fit, device, estimate.noise_levels, estimate.negative_log_likelihood, block)
