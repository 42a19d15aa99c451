"""Families of bodies that all compared programs simulate, and the errors of their results.

A problem consists of an inertia, potentials and torques, a horizon and saved times. Its bodies are
drawn from a seed; the first bodies are the same for any number of bodies. References:
benchmarks/truth.py.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

DIRECTION = (0.6, 0.0, 0.8)
"""Space direction of the attracting centre in the gravity gradient."""


@dataclass(frozen=True)
class Problem:
    """A family of bodies.

    ``weight``: mass times gravity times the distance of the centre of mass, which lies on body z,
    from the fixed point [N m]; gravity is along -z of space. ``gradient``: 3 mu / r^3 [1/s^2].
    Attitudes are uniform on SO(3), rates isotropic of size uniform in [1, 2) rad/s plus ``spin``
    about body z. ``flip``: instead, rates near the intermediate axis with relative offsets of 1e-6
    to 1e-2. ``damping`` is the coefficient of a torque opposite to the rates [N m s], and ``push``
    a constant torque in body axes [N m]. The state is saved at ``saves`` equally spaced times up to
    ``horizon`` [s].
    """

    name: str
    title: str
    moments: tuple[float, float, float]
    seed: int
    horizon: float = 100.0
    saves: int = 1
    spin: float = 0.0
    weight: float = 0.0
    gradient: float = 0.0
    flip: bool = False
    damping: float = 0.0
    push: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def times(self) -> np.ndarray:
        """Start and saved times [s]."""
        return np.linspace(0.0, self.horizon, self.saves + 1)

    @property
    def free(self) -> bool:
        return not (self.weight or self.gradient or self.damping or any(self.push))

    def states(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Attitudes (n, 4) and body rates (n, 3)."""
        draws = np.random.Generator(np.random.PCG64(self.seed)).standard_normal((n, 8))
        wxyz = draws[:, :4] / np.linalg.norm(draws[:, :4], axis=1, keepdims=True)
        share = (1 + np.vectorize(math.erf)(draws[:, 7] / math.sqrt(2))) / 2  # uniform in [0, 1)
        if self.flip:
            off = 10 ** (-6 + 4 * share[:, None]) * draws[:, 4:7] * np.array([1.0, 0.0, 1.0])
            return wxyz, np.array([0.0, 1.5, 0.0]) + off
        axis = draws[:, 4:7] / np.linalg.norm(draws[:, 4:7], axis=1, keepdims=True)
        return wxyz, axis * (1 + share[:, None]) + np.array([0, 0, self.spin])


PROBLEMS = {
    problem.name: problem
    for problem in (
        Problem("free", "free body (1, 2, 3)", (1.0, 2.0, 3.0), 11),
        Problem("near_symmetric", "free, near-symmetric (1, 1.001, 1.5)", (1.0, 1.001, 1.5), 12),
        Problem("extreme", "free, needle (0.01, 1, 1.0005)", (0.01, 1.0, 1.0005), 13),
        Problem("separatrix", "free, near the separatrix", (1.0, 2.0, 3.0), 15, flip=True),
        Problem("lagrange", "Lagrange's top", (1.0, 1.0, 0.5), 21, spin=5.0, weight=1.0),
        Problem("heavy_top", "asymmetric heavy top", (1.0, 1.5, 2.0), 22, weight=1.0),
        Problem("gradient", "gravity gradient", (1.0, 1.5, 2.0), 23, gradient=0.75),
        Problem("dense", "free body, 100 saved times", (1.0, 2.0, 3.0), 11, saves=100),
        Problem(
            "dense_top", "heavy top, 100 saved times", (1.0, 1.5, 2.0), 22, saves=100, weight=1.0
        ),
        Problem("long", "free body, to t = 1e5", (1.0, 2.0, 3.0), 11, horizon=1e5),
    )
}
SATELLITE = Problem(
    "satellite",
    "satellite: gravity gradient, drag, thruster",
    (1.0, 1.5, 2.0),
    25,
    horizon=50.0,
    saves=10,
    gradient=0.75,
    damping=0.05,
    push=(0.02, -0.01, 0.03),
)
"""The problem of the benchmark on accelerators, with torques that have no closed form."""


def errors(
    exact: dict[str, np.ndarray], wxyz: np.ndarray, omega: np.ndarray | None
) -> dict[str, Any]:
    """Errors of the scored bodies against the reference: median and largest error.

    ``exact``: see ``truth.truth``; ``wxyz`` (n, saves, 4) and ``omega`` (n, saves, 3) at the saved
    times. Attitude errors are angles [rad], rate errors are relative to the size of the rates; the
    error of a body is the largest over the scored times. A value that is not finite counts as an
    error of pi, and in ``failed``.
    """
    at = exact["index"]
    n = min(len(wxyz), len(exact["wxyz"]))
    q, true = np.asarray(wxyz, float)[:n][:, at], exact["wxyz"][:n]
    with np.errstate(invalid="ignore", divide="ignore"):
        q = q / np.linalg.norm(q, axis=-1, keepdims=True)
        sign = np.where(np.sum(q * true, axis=-1, keepdims=True) < 0, -1, 1)
        half = np.linalg.norm(sign * q - true, axis=-1) / 2
        angle = 4 * np.arcsin(np.minimum(half, math.sqrt(0.5)))  # accurate near zero
        angle = np.where(np.isfinite(angle), angle, math.pi).max(axis=1)
    found = {
        "scored": n,
        "attitude_median": float(np.median(angle)),
        "attitude_worst": float(angle.max()),
        "failed": int(np.sum(~np.isfinite(q).all(axis=(1, 2)))),
    }
    if omega is not None:
        w, true = np.asarray(omega, float)[:n][:, at], exact["omega"][:n]
        off = np.linalg.norm(w - true, axis=-1) / np.linalg.norm(true, axis=-1)
        off = np.where(np.isfinite(off), off, np.inf).max(axis=1)
        found |= {"rate_median": float(np.median(off)), "rate_worst": float(off.max())}
    return found
