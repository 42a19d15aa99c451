"""Motions of Lagrange's top in every regime: moments A, C, torque constant M, rates, quaternion,
time.

V = M u . e3 with u = space z. ``tops_truth.json`` contains the state after TIME and its gradient
with respect to all ten numbers, computed by ``make_tops_truth.py`` with 50 digits, without the
package.
"""

import json
import math
from pathlib import Path

TRUTH = Path(__file__).with_name("tops_truth.json")
TIME = 3.0

_TILTED = (0.75, 0.5, -0.25, 0.3535533905932738)
_UP, _DOWN, _LYING = (0.6, 0.0, 0.0, 0.8), (0.0, 0.6, 0.8, 0.0), (0.8, 0.6, 0.0, 0.0)


def _steady():
    """Regular precession at 60 degrees: A W^2 cos - b W + M = 0 for the slow rate W."""
    theta, b = math.pi / 3, 3.0
    rate = b - math.sqrt(b * b - 2)
    return (
        1.0,
        0.5,
        1.0,
        -rate * math.sin(theta),
        0.0,
        2 * b,
        math.cos(theta / 2),
        0.0,
        math.sin(theta / 2),
        0.0,
    )


def _separatrix():
    """p = b = 0.8 and the energy of the upright top, at cos(theta) = 0.3."""
    g, b = 0.3, 0.8
    s = math.sqrt(1 - g * g)
    first = -b * (1 - g) / s
    second = math.sqrt(2 * (1 - g) - first**2)
    half = math.acos(g) / 2
    return (1.0, 0.5, 1.0, first, second, 2 * b, math.cos(half), 0.0, math.sin(half), 0.0)


CASES = {
    "fast": (1.0, 0.5, 1.0, 0.25, -0.5, 5.0, *_TILTED),
    "slow": (1.0, 0.5, 1.0, 0.25, -0.5, 0.3, *_TILTED),
    "negative_pull": (1.0, 0.5, -1.0, 0.25, -0.5, 1.0, *_TILTED),
    "spherical": (1.0, 1.0, 1.0, 0.25, -0.5, 1.0, *_TILTED),
    "steady": _steady(),
    "cuspidal": (1.0, 0.5, 1.0, 0.0, 0.0, 6.0, *_LYING),
    "sleeping_fast": (1.0, 0.5, 1.0, 0.0, 0.0, 5.0, *_UP),
    "sleeping_slow": (1.0, 0.5, 1.0, 0.0, 0.0, 1.0, *_UP),
    "almost_sleeping_fast": (1.0, 0.5, 1.0, 1e-8, 0.0, 5.0, *_UP),
    "almost_sleeping_slow": (1.0, 0.5, 1.0, 1e-8, 0.0, 1.0, *_UP),
    "hanging": (1.0, 0.5, 1.0, 0.0, 0.0, 2.0, *_DOWN),
    "hanging_still": (1.0, 0.5, 1.0, 0.0, 0.0, 0.0, *_DOWN),
    "through_zenith": (1.0, 0.5, 1.0, 1.5, 0.5, 3.0, 1.0, 0.0, 0.0, 0.0),
    "through_nadir": (1.0, 0.5, 1.0, 1.5, 0.5, 3.0, 0.0, 1.0, 0.0, 0.0),
    "separatrix": _separatrix(),
    "pendulum": (1.0, 0.5, 1.0, 1.0, 0.0, 0.0, *_LYING),
    "pendulum_over_the_top": (1.0, 0.5, 1.0, 2.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
    "pendulum_separatrix": (1.0, 0.5, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
    "released": (1.0, 0.5, 1.0, 0.0, 0.0, 0.0, *_LYING),
    "no_gravity": (1.0, 0.5, 0.0, 0.3, 0.2, 6.0, 0.8, 0.6, 0.1, 0.0),
    "marginal_sleeping": (1.0, 0.5, 1.0, 0.0, 0.0, 4.0, *_UP),
}


def truth(name: str) -> dict[str, list]:
    """Exact ``state`` (omega, q) after TIME and ``gradient`` (7 x 10), as floats."""
    entry = json.loads(TRUTH.read_text())[name]
    return {
        "state": [float(x) for x in entry["state"]],
        "gradient": [[float(x) for x in row] for row in entry["gradient"]],
    }
