"""Inertia from throws of bodies with a gyroscope and a reaction wheel (TU Delft, arXiv:2503.13137).

An estimator for one laboratory's recordings, by maximum likelihood of the readings. It takes
``Recording``, ``stack``, ``averaged``, ``SteppedMotion`` and ``FitError`` of the public
``polhode.fit``; the likelihood, its search and its result are its own.
``python -m benchmarks.throws`` applies it to the recordings.
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
