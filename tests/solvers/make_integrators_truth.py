"""Writes integrators_truth.json: ``python tests/solvers/make_integrators_truth.py``.

Three bodies under one weight, by Taylor series in 40-digit arithmetic: states at some times, and
the derivatives of a weighted sum of the last state with respect to the first moment of inertia and
to the strength of the field, by central differences.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import mpmath

from benchmarks.problems import PROBLEMS
from benchmarks.truth import motion

FILE = Path(__file__).with_name("integrators_truth.json")
MOMENTS = (1.0, 1.5, 2.0)
STRENGTH = 1.0
WXYZ = ((0.5, 0.5, -0.5, 0.5), (0.8, 0.0, 0.6, 0.0), (0.28, 0.96, 0.0, 0.0))
OMEGA = ((1.25, -0.5, 0.75), (0.25, 1.5, -0.5), (-1.0, 0.5, 1.0))
TIMES = (0.1, 0.75, 1.0, 1.3, 2.95, 3.0)
WEIGHTS = range(1, 8)  # of wxyz and momentum_body at the last time, in this order


def states(moments, strength, wxyz, omega, times):
    """States (wxyz, omega) of a heavy top at the times; the numbers are treated as exact."""
    top = replace(PROBLEMS["heavy_top"], weight=strength)
    return motion(top, wxyz, omega, times, 36, moments)


def momenta(state, moments):
    return [*state[:4], *(m * w for m, w in zip(moments, state[4:]))]


def weighted(moments, strength):
    """Weighted sum of the last states of the bodies; the initial momenta are constant."""
    total = mpmath.mpf(0)
    for q, w in zip(WXYZ, OMEGA):
        omega = [mpmath.mpf(m * r) / mpmath.mpf(i) for m, r, i in zip(MOMENTS, w, moments)]
        (state,) = states(moments, strength, q, omega, TIMES[-1:])
        scale = [mpmath.mpf(m) for m in moments]
        total += sum(c * v for c, v in zip(WEIGHTS, momenta(state, scale)))
    return total


def main():
    h = 2.0**-40
    with mpmath.workdps(40):
        found = [
            [[mpmath.nstr(x, 25) for x in momenta(at, MOMENTS)] for at in body]
            for body in (states(MOMENTS, STRENGTH, q, w, TIMES) for q, w in zip(WXYZ, OMEGA))
        ]
        first = [weighted((MOMENTS[0] + s * h, *MOMENTS[1:]), STRENGTH) for s in (1, -1)]
        field = [weighted(MOMENTS, STRENGTH + s * h) for s in (1, -1)]
        slopes = [mpmath.nstr((up - down) / (2 * mpmath.mpf(h)), 20) for up, down in (first, field)]
    FILE.write_text(
        json.dumps({"times": TIMES, "states": found, "slopes": slopes}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
