"""A wheel aboard in ``fit_inertia`` and ``fit_recordings``: the likelihood of the readings."""

from collections.abc import Sequence

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
    spread = _ratios_std(entries_of(tensor), covariance)
    rest, known = fit.residuals, jnp.any(fit.residuals != 0, axis=-1).astype(moments.dtype)
    read = 3 * jnp.maximum(jnp.sum(known), 1)
    whiteness = whiteness_of(rest, known)
    trace = jnp.trace(tensor)
    finite = jnp.all(jnp.isfinite(tensor)) & jnp.all(jnp.isfinite(covariance))
    finding = flagged({
        Finding.STEP_LIMIT: ~fit.converged,
        Finding.NOT_FINITE: ~finite,
        Finding.NEARLY_FLAT: trace / 2 - moments[2] < 1e-4 * trace,
        Finding.NOT_WHITE: whiteness < 1e-4,
        Finding.WEAK: jnp.any(spread[:2] > 0.05),
    })  # fmt: skip
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
        moments / moments[2], fit.moments_std[0], spread, fit.axes_std[0], inverse(covariance),
        covariance, jnp.asarray(0), jnp.sqrt(jnp.sum(rest**2) / read), whiteness,
        jnp.sqrt(jnp.sum((rest * fit.residuals_std) ** 2) / read),
        finding, fit.steps, jnp.asarray(1),
        parameters, model, {"omega": rest, "omega_std": fit.residuals_std}, True, True,
    )  # fmt: skip


@jax.jit
def _ratios_std(entries: Array, covariance: Array) -> Array:
    def ratios(entries):
        values, *_ = principal(whole_of(entries))
        return values / values[2]

    slope = jax.jacfwd(ratios)(entries)
    return jnp.sqrt(jnp.maximum(jnp.diagonal(slope @ covariance @ slope.T), 0)).at[2].set(0)
