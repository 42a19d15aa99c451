"""A wheel aboard in ``fit_inertia`` and ``fit_recordings``: the likelihood of the readings."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from polhode.fit._fit_balance import fit_balance
from polhode.fit._instrument import Instrument
from polhode.fit._recording import Recording
from polhode.fit._result import Fit


def fit_wheel(recording: Recording, instrument: Instrument, block: int) -> Fit:
    """Bodies (leading axes), each from its one recording of rates and wheel; ``fit_balance``."""
    batch = recording.batch_shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(batch) :]), recording)
    fits = []
    for k in range(flat.times.shape[0]):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], flat)
        fits.append(fit_wheels([one], instrument, block))
    joined = jax.tree.map(lambda *leaves: jnp.stack(leaves), *fits)
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), joined)


def fit_wheels(recordings: Sequence[Recording], instrument: Instrument, block: int) -> Fit:
    """One body from its recordings of rates and wheel; ``fit_balance``."""
    fit = fit_balance(recordings, instrument, block=block, throw=False)
    return jax.tree.map(lambda leaf: leaf[0], fit)
