"""Inertia from throws of bodies with a gyroscope and a reaction wheel (TU Delft, arXiv:2503.13137).

A maximum-likelihood estimator for the recordings of one laboratory. It uses ``Recording``,
``stack``, ``averaged``, ``SteppedMotion`` and ``FitError`` of the public module ``polhode.fit``;
the likelihood, its optimiser and its result are implemented here. ``python -m benchmarks.throws``
applies it to the recordings.
"""

from benchmarks.throws.design import throw_information as throw_information
from benchmarks.throws.estimator import (
    ThrowFit as ThrowFit,
    fit_balance as fit_balance,
    fit_each as fit_each,
)
from benchmarks.throws.instrument import (
    Instrument as Instrument,
    Tolerance as Tolerance,
    lever_arm as lever_arm,
)
from benchmarks.throws.likelihood import Noise as Noise
