"""``fit_balance``: inertia from throws in air, with a reaction wheel in absolute size."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from benchmarks.throws.instrument import Instrument, Tolerance
from benchmarks.throws.likelihood import Noise, readings_of
from benchmarks.throws.numerics import entries_of, symmetric_matrix, whiteness_of
from benchmarks.throws.scoring import Known, solve_balance, start_of
from polhode.fit import FitError, Recording, stack
from polhode.inertia import Inertia, principal

# compiles in two thirds of the time
_OPTIONS: dict[str, Any] = {"compiler_options": {"xla_cpu_use_fusion_emitters": False}}


class ThrowFit(eqx.Module):
    """Inertia, drag, instrument and noise by maximum likelihood; the leading axis n: bodies.

    **Fields:** ``inertia`` (without a wheel scaled to a largest moment of 1), ``moments``,
    ``axes``, ``ratios`` and their standard deviations, as in ``polhode.fit.Fit``; ``drag`` (n, 2):
    linear and quadratic; ``covariance`` (n, 8, 8) of the entries xx, yy, zz, yz, zx, xy and
    ``drag``; ``residuals``: ``"omega"`` (n, m, b, 3) over their standard deviations
    ``"omega_std"``, rad/s; ``whiteness`` (n,): probability of autocorrelations of at least this
    size; ``instrument``: estimated if a ``tolerance`` was passed; ``noise_levels``: standard
    deviations of readings and disturbing torques; ``negative_log_likelihood`` (n,): of all readings
    together, up to a constant; ``steps``, ``converged`` (n,): of the optimiser; ``scale_known``,
    ``block``.
    """

    inertia: Inertia
    moments: Float[Array, "n 3"]
    axes: Float[Array, "n 4"]
    ratios: Float[Array, "n 3"]
    moments_std: Float[Array, "n 3"]
    ratios_std: Float[Array, "n 3"]
    drag: Float[Array, "n 2"]
    covariance: Float[Array, "n 8 8"]
    residuals: dict[str, Array]
    whiteness: Float[Array, " n"]
    instrument: Instrument
    noise_levels: Noise
    negative_log_likelihood: Float[Array, " n"]
    steps: Int[Array, " n"]
    converged: Bool[Array, " n"]
    scale_known: bool = eqx.field(static=True)
    block: int = eqx.field(static=True)

    @property
    def is_usable(self) -> bool:
        """Whether the optimiser converged to finite numbers for every body."""
        finite = np.isfinite(self.inertia.tensor).all() and np.isfinite(self.covariance).all()
        return bool(np.all(self.converged) and finite)


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

    For throws in air with a reaction wheel whose speed is measured, or without one
    (``Instrument(None)``, which determines the ratios of the moments only). The readings of the
    gyroscope define a rotating frame, in which a Kalman filter propagates the momentum ``I omega +
    h`` with drag, white torques and a torque with a correlation time, whose levels are estimated.
    The filter compares measured with predicted rates; therefore their noise does not bias the
    moments, even for a single short throw with little information.

    **Arguments:**

    - ``recordings``: with rates and, for a wheel, ``wheel_speed``, of free flight only; NaN where a
      reading is doubtful, such as the speed of a motor that was just switched on.
    - ``instrument``: according to its data sheet; ``tolerance``: standard deviations of its fields,
      with which they are fitted to all recordings together (None: the instrument is exact).
    - ``bodies``: number of the body in each recording, from 0 (None: one body).
    - ``block``: number of samples per residual, large enough that the noise of residuals is white.
      Apply ``averaged`` first to readings that are much faster than the motion.
    - ``throw``: whether a fit that is not finite or did not converge raises FitError.

    Returns a ``ThrowFit`` whose leading axis n is that of the bodies. A body with fewer recordings
    than another has zeros as residuals and initial rates in place of the missing ones. Every tensor
    is physical.

    Raises ValueError for recordings without rates or the wheel's speed, and FitError.
    """
    given = stack(recordings)
    wheel = instrument.spin_inertia is not None
    _require(given.omega is not None, "a balance needs omega_body in every recording.")
    _require(
        (given.wheel is not None) == wheel,
        "an instrument with a wheel needs wheel_speed in every recording."
        if wheel
        else "recordings with wheel_speed need the wheel's spin_inertia in the instrument.",
    )
    numbers = np.zeros(len(recordings), int) if bodies is None else np.asarray(bodies)
    count = int(numbers.max()) + 1
    _require(
        numbers.shape == (len(recordings),) and set(numbers.tolist()) == set(range(count)),
        f"bodies must number the body of each of {len(recordings)} recordings from 0 on without "
        f"leaving one out, got {numbers.tolist()}.",
    )
    _require(not isinstance(given.times, Tracer), "fit_balance takes arrays, not traced values.")
    present = np.asarray(given.present) > 0
    if given.wheel_known is not None:
        present = present & (np.asarray(given.wheel_known) > 0)
    _require(
        present.sum(axis=1).min() >= 8,
        "each recording needs at least 8 samples with rates and wheel, got "
        f"{present.sum(axis=1).min()}.",
    )
    places, used = _by_body(numbers, count)
    fit = _together(given, jnp.asarray(numbers), places, used, instrument, tolerance, block)
    if throw and not fit.is_usable:
        raise FitError(
            f"{int(np.sum(~np.asarray(fit.converged)))} of {count} bodies did not converge, or are"
            " not finite. Pass throw=False to get the result all the same."
        )
    return fit


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def fit_each(fit: ThrowFit, recordings: Sequence[Recording], body: int = 0) -> ThrowFit:
    """Fits of single recordings of a body, with the instrument and the noise of a joint fit.

    **Arguments:** ``fit``: a result of ``fit_balance``; ``recordings`` of one of its bodies,
    ``body``. Returns a ``ThrowFit`` whose leading axis is that of the recordings.
    """
    instrument, noise, tensor = jax.tree.map(
        lambda x: x[body], (fit.instrument, fit.noise_levels, fit.inertia.tensor)
    )
    given, block = stack(recordings), fit.block
    fits = [
        _alone(jax.tree.map(lambda x, k=k: x[k : k + 1], given), instrument, noise, tensor, block)
        for k in range(len(recordings))
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *fits)


def _by_body(numbers: np.ndarray, count: int) -> tuple[Array, Array]:
    """Indices (n, m) of the recordings of each body, and a mask of 1 and 0 for padding."""
    each = [np.flatnonzero(numbers == k) for k in range(count)]
    most = max(map(len, each))
    places, used = np.zeros((count, most), int), np.zeros((count, most))
    for k, one in enumerate(each):
        places[k, : len(one)], used[k, : len(one)] = one, 1
    return jnp.asarray(places), jnp.asarray(used)


@eqx.filter_jit(**_OPTIONS)
def _together(recording, numbers, places, used, instrument, tolerance, block) -> ThrowFit:
    data = readings_of(recording, numbers, block)
    sigma, noise = start_of(data, instrument, places.shape[0])
    known = Known(sigma, instrument, tolerance or Tolerance(), noise)
    solution = solve_balance(data, known, "instrument" if tolerance else "noise")
    return _fit_of(solution, places, used, block)


@eqx.filter_jit(**_OPTIONS)
def _alone(recording, instrument, noise, tensor, block) -> ThrowFit:
    sigma = (jnp.trace(tensor) / 2 * jnp.eye(3, dtype=tensor.dtype) - tensor)[None]
    data = readings_of(recording, jnp.zeros(1, int), block)
    noise = Noise(*(x[None] for x in noise[:5]), *noise[5:])
    known = Known(sigma, instrument, Tolerance(), noise)
    one = jnp.zeros((1, 1), int), jnp.ones((1, 1))
    return _fit_of(solve_balance(data, known, "tensor"), *one, block)


def _fit_of(found, places: Array, used: Array, block: int) -> ThrowFit:
    """Result of every body with its uncertainty, for its recordings at ``places`` (n, m)."""
    sized = found.instrument.spin_inertia is not None
    dtype = found.tensors.dtype
    used = used.astype(dtype)

    def one(tensor, drag, covariance, rest, spread, used, levels, instrument):
        moments, axes, _ = principal(tensor)

        def derived(vector):
            values, _, _ = principal(symmetric_matrix(vector[:6]))
            unit = jnp.ones_like(values[2]) if sized else values[2]
            return jnp.concatenate([values / unit, vector / unit, values / values[2]])

        # offsets: moments 0, entries and drag 3, ratios 11
        slope = jax.jacfwd(derived)(jnp.concatenate([entries_of(tensor), drag]))
        covariance = slope @ covariance @ slope.T
        std = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), 0))
        size = jnp.ones_like(moments[2]) if sized else moments[2]
        tensor, moments = tensor / size, moments / size
        rest, spread = (x * used[:, None, None] for x in (rest, spread))
        read = jnp.any(rest != 0, axis=-1).astype(dtype)
        return ThrowFit(
            inertia=Inertia(full=tensor),
            moments=moments,
            axes=axes,
            ratios=moments / moments[2],
            # without a wheel the size is not determined
            moments_std=std[:3] if sized else jnp.full_like(std[:3], jnp.inf),
            ratios_std=std[11:].at[2].set(0),
            drag=drag / size,
            covariance=covariance[3:11, 3:11],
            residuals={"omega": rest, "omega_std": spread},
            whiteness=whiteness_of(rest, read),
            instrument=instrument,
            noise_levels=levels.grown(1 / size),
            negative_log_likelihood=found.negative_log_likelihood,
            steps=found.steps,
            converged=found.converged,
            scale_known=sized,
            block=block,
        )

    # also the unknowns that all bodies share
    count = used.shape[0]
    shared = (jnp.broadcast_to(x, (count,)) for x in found.noise[5:])
    levels = Noise(*found.noise[:5], *shared)
    instrument = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), found.instrument
    )
    return jax.vmap(one)(
        found.tensors,
        found.drag,
        found.covariance,
        found.rest[places],
        found.spread[places],
        used,
        levels,
        instrument,
    )
