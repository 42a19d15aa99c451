"""A wheel aboard in ``fit_inertia`` and ``fit_recordings``: the likelihood of the readings."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode.fit._fit_balance import BalanceFit, fit_balance
from polhode.fit._instrument import Instrument
from polhode.fit._matrices import inverse
from polhode.fit._motion import Drag, SteppedMotion
from polhode.fit._parameters import Parameters, base_of, entries_of, whole_of
from polhode.fit._recording import Recording, needed, stack
from polhode.fit._residuals import Model
from polhode.fit._result import Finding, InertiaFit, flagged, whiteness_of
from polhode.inertia import Inertia, principal, second_moments


def fit_wheel(recording: Recording, instrument: Instrument, block: int) -> InertiaFit:
    """Bodies (leading axes), each from its one recording of rates and wheel; ``fit_balance``."""
    batch = recording.batch_shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(batch) :]), recording)
    found = []
    for k in range(flat.times.shape[0]):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], flat)
        found.append(fit_wheels([one], instrument, block))
    joined = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), joined)


def fit_wheels(recordings: Sequence[Recording], instrument: Instrument, block: int) -> InertiaFit:
    """One body from its recordings of rates and wheel; ``fit_balance``."""
    fit = fit_balance(recordings, instrument, block=block, throw=False)
    return _told(fit, stack(recordings), instrument)


def _told(fit: BalanceFit, recording: Recording, given: Instrument) -> InertiaFit:
    """One body's balance as the result that every motion gives."""
    tensor, moments = fit.inertia.tensor[0], fit.moments[0]
    covariance = fit.covariance[0]
    told = _judged(tensor, moments, covariance, fit.residuals, fit.residuals_std, fit.converged)
    device = fit.instrument
    x, y, z = (float(part) for part in np.asarray(device.axis))
    flight = SteppedMotion(
        device.spin_inertia, (x, y, z), device.delay, Drag(*jnp.zeros(2, moments.dtype)), True
    )
    model = Model(
        flight,
        base_of(second_moments(tensor), True),
        columns=tuple(map(tuple, np.eye(6).tolist())),
        scale_known=True,
    )
    begin = device.rates(needed("omega", recording.omega)[:, 0])
    parameters = Parameters(
        jnp.zeros(6, moments.dtype), begin, bias=None if given.bias is None else device.bias,
        motion={"drag": Drag(*fit.drag[0]), "delay": None},
    )  # fmt: skip
    return InertiaFit(
        Inertia(full=tensor), moments, fit.axes[0],
        told.ratios, fit.moments_std[0], told.spread, fit.axes_std[0], told.information,
        covariance, jnp.asarray(0), told.noise, told.whiteness, told.rms,
        told.finding, fit.steps, jnp.asarray(1), parameters, model,
        {"omega": fit.residuals, "omega_std": fit.residuals_std}, True, True,
    )  # fmt: skip


class _Judged(NamedTuple):
    ratios: Array
    spread: Array  # of the ratios
    information: Array
    noise: Array
    whiteness: Array
    rms: Array
    finding: Array


@jax.jit  # one program, not one for each operation
def _judged(tensor, moments, covariance, rest, expected, converged) -> _Judged:
    """What the residuals ``rest``, over those ``expected``, and the covariance say of one body."""

    def ratios(entries):
        values, *_ = principal(whole_of(entries))
        return values / values[2]

    slope = jax.jacfwd(ratios)(entries_of(tensor))
    variance = jnp.diagonal(slope @ covariance @ slope.T)
    spread = jnp.sqrt(jnp.maximum(variance, 0)).at[2].set(0)
    known = jnp.any(rest != 0, axis=-1).astype(moments.dtype)
    read = 3 * jnp.maximum(jnp.sum(known), 1)
    whiteness, trace = whiteness_of(rest, known), jnp.trace(tensor)
    finite = jnp.all(jnp.isfinite(tensor)) & jnp.all(jnp.isfinite(covariance))
    finding = flagged({
        Finding.STEP_LIMIT: ~converged,
        Finding.NOT_FINITE: ~finite,
        Finding.NEARLY_FLAT: trace / 2 - moments[2] < 1e-4 * trace,
        Finding.NOT_WHITE: whiteness < 1e-4,
        Finding.WEAK: jnp.any(spread[:2] > 0.05),
    })  # fmt: skip
    noise, rms = (jnp.sqrt(jnp.sum(x**2) / read) for x in (rest, rest * expected))
    return _Judged(
        moments / moments[2], spread, inverse(covariance), noise, whiteness, rms, finding
    )
