"""Findings of a fit: flags, their messages, and what a recording shows of each quantity."""

import enum
from typing import NamedTuple

import numpy as np


class Finding(enum.IntFlag):
    """Diagnostics of a fit, as flags (per body; 0: none)."""

    NONE = 0
    STEP_LIMIT = 1
    NOT_FINITE = 2
    NEARLY_FLAT = 4
    UNDETERMINED = 8
    AXES_DISAGREE = 16
    NOT_WHITE = 32
    WEAK = 64
    POOR = 128
    SATURATED = 256
    OUTLIERS = 512
    CALIBRATION = 1024
    AT_BOUND = 2048
    PRIOR_DISAGREES = 4096


WARNINGS = {
    Finding.STEP_LIMIT: "the optimiser stopped at its step limit: raise max_steps or max_starts, "
    "or shorten the recording into windows",
    Finding.NOT_FINITE: "the fit is not finite: look for outliers (robust=Huber()), wrong units or "
    "a recording with too little rotation",
    Finding.NEARLY_FLAT: "the best body is flat (one moment is the sum of the two others): the "
    "limit of what is physical; intervals are one-sided there, and drag or bias left out of the "
    "model may have pushed it there",
    Finding.UNDETERMINED: "some of the tensor does not show in this motion (an axis hardly "
    "excited, or a symmetric body): their intervals are infinite; add a recording of another spin",
    Finding.AXES_DISAGREE: "rates and attitudes contradict each other for right-handed axes: one "
    "axis is inverted, axes are exchanged, or the attitudes are not wxyz, body -> space (xyzw, or "
    "inverse); correct the columns (sensor_axes shows how)",
    Finding.NOT_WHITE: "the residuals are correlated in time: the model lacks something (drag, "
    "bias, a moving part) and the intervals are too narrow",
    Finding.WEAK: "a ratio is known to no better than 5 %, or than half of itself (a nearly "
    "symmetric body, a spin near a principal axis, a short record): the interval is approximate, "
    "since the misfit is no longer quadratic over such a range",
    Finding.POOR: "the residuals are more than twice as large as the noise: a wrong model, wrong "
    "axes or units, attitudes that are not wxyz, body -> space (xyzw, or inverse), outliers "
    "(robust=Huber()), or a local minimum that is not the best",
    Finding.SATURATED: "a gyroscope axis is saturated: readings at its limit count as bounds only;"
    " state the limit, Gyroscope(max_rate=...), where an axis is beyond it throughout",
    Finding.OUTLIERS: "single samples are more than five times as far off as others: fit with"
    " robust=Huber(); intervals are wider than they need to be",
    Finding.CALIBRATION: "scale factors, misalignment or bias of the gyroscope are more than 3.5"
    " standard deviations from its calibration: state a wider one, Gyroscope(scale_std=...,"
    " misalignment_std=...), or the model lacks something that they make up for",
    Finding.AT_BOUND: "a value is at its bound: its interval is one-sided, and the data may fit a"
    " value beyond better",
    Finding.PRIOR_DISAGREES: "a value is more than 3.5 standard deviations from its prior, of the"
    " prior and the data together: state a wider prior_std, or the model lacks something that this"
    " value makes up for",
}
SCENE_WARNINGS = WARNINGS | {
    Finding.UNDETERMINED: "some of the numbers do not show in this motion, alone or against each"
    " other: their standard deviations are infinite; free fewer of them, or add a recording that"
    " shows them",
    Finding.POOR: "the residuals are more than twice as large as the noise: a wrong model, wrong"
    " units, outliers (robust=Huber()), a start too far away, or, where something acts that depends"
    " on it, no initial attitude (attitude=, or wxyz in the recording)",
}
SCALE_UNKNOWN = (
    "Only ratios of moments are determined: free motion does not depend on the size of the inertia "
    "(null direction of the information matrix). A known wheel, torque or moment would fix it."
)
"""Warning of every fit to torque-free rates."""
UNUSABLE = Finding.STEP_LIMIT | Finding.NOT_FINITE | Finding.AXES_DISAGREE
"""Findings that raise an error unless ``throw=False``."""
MODEL_FLAWS = (
    UNUSABLE
    | Finding.POOR
    | Finding.OUTLIERS
    | Finding.NOT_WHITE
    | Finding.CALIBRATION
    | Finding.PRIOR_DISAGREES
)
"""Findings by which the model does not explain the readings."""


class Observability(NamedTuple):
    """A row of ``Fit.observability``: a quantity and the source of its estimate.

    **Fields:** ``quantity``, with the number of its components in brackets; ``count`` of them, of
    which the data show ``shown``; ``source``: ``"data"``, ``"prior"``, ``"calibration"``, several
    of them joined by "and", or ``"nothing"``; ``remedy``: a recording that would show it, or empty.
    """

    quantity: str
    count: int
    shown: int
    source: str
    remedy: str


def shown_beside_prior(covariance: np.ndarray, std: np.ndarray) -> int:
    """Number of directions of a value in which the data at least halve the variance of its prior;
    ``covariance`` (n, n) of the fit, ``std`` (n,) of the prior."""
    return int(np.sum(np.linalg.eigvalsh(covariance / std[:, None] / std) < 0.5))


def shown_of_gain(covariance: np.ndarray, std: np.ndarray) -> list[tuple[str, int, int]]:
    """Observability of the errors of a gain matrix: name, number of directions, and how many of
    them the data show. ``covariance`` (9, 9), row by row; ``std`` (3, 3) of the calibration."""
    # symmetric and antisymmetric combinations of opposite entries
    stretch, turn = [], []
    for i in range(3):
        unit = np.zeros((3, 3))
        unit[i, i] = 1
        stretch.append(unit)
        for j in range(i):
            even, odd = np.zeros((3, 3)), np.zeros((3, 3))
            even[i, j] = even[j, i] = odd[i, j] = 0.5
            odd[j, i] = -0.5
            stretch.append(even)
            turn.append(odd)
    rows = []
    for name, directions in (
        ("scale factors and non-orthogonality of the gyroscope", stretch),
        ("rotation of the gyroscope", turn),
    ):
        basis = np.array([part.ravel() for part in directions])
        prior = np.sqrt(np.sum((basis * std.ravel()) ** 2, axis=1))
        basis = basis[prior > 0] / prior[prior > 0, None]
        if basis.shape[0]:
            remaining = np.linalg.eigvalsh(basis @ covariance @ basis.T)
            rows.append((name, basis.shape[0], int(np.sum(remaining < 0.5))))
    return rows


class FitError(RuntimeError):
    """Raised for an unusable fit; the message states the cause and a remedy."""
