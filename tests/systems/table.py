# ruff: noqa: E501 (one system, one line)
"""The systems on which every method is tested; README.md derives them.

One entry is one set of numbers: inertia, initial state, times, potentials, torques and wheels.
``truth.json`` contains the exact final state and its exact gradient with respect to the principal
moments, computed by ``python tests/systems/make_truth.py`` with 50 digits, independently of the
package.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpmath import mpf

SIMPLE = {"gravity", "gradient", "body", "damping", "fading", "space", "sink"}

TRUTH = Path(__file__).with_name("truth.json")


@dataclass(frozen=True)
class System:
    """A body in exactly representable numbers, with its potentials, torques and wheels."""

    name: str
    moments: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    omega: tuple[float, float, float]
    span: tuple[float, float]
    acts: dict[str, Any] = field(default_factory=dict)
    steps: int = 40
    cuts: tuple[float, ...] = ()
    """Times between the ends at which what acts jumps; the reference ends a step there."""
    unstable: float = 1.0
    """How much rounding at the start grows, for the bars in single precision: next to the separatrix
    the end has a derivative of 252 s by the initial rates, so that one rounding of 0.5 rad/s becomes
    7.5e-6; the bar of 4e-6 times this allows 16 of them."""

    @property
    def is_simple(self) -> bool:
        """Whether ``torque`` describes everything; otherwise the rest is in ``parts.py``."""
        return SIMPLE.issuperset(self.acts)

    def torque(self, moments):
        """Torque in body axes for the reference integrator, from Newton's law."""
        acts = self.acts
        if not acts:
            return None

        def torque(t, omega, rows):
            total = [omega[0] * mpf(0)] * 3
            if "gravity" in acts:
                weight, centre = acts["gravity"]
                up = rows[2]
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    turn = up[j] * mpf(centre[k]) - up[k] * mpf(centre[j])
                    total[i] = total[i] + turn * mpf(weight)
            if "gradient" in acts:
                strength, along_space = acts["gradient"]
                n = [sum(rows[j][i] * mpf(along_space[j]) for j in range(3)) for i in range(3)]
                turned = [x * mpf(m) for x, m in zip(n, moments)]
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    total[i] = total[i] + (n[j] * turned[k] - n[k] * turned[j]) * mpf(strength)
            if "body" in acts:
                total = [x + mpf(n) for x, n in zip(total, acts["body"])]
            if "damping" in acts:
                total = [x - w * mpf(c) for x, w, c in zip(total, omega, acts["damping"])]
            if "fading" in acts:
                rate = mpf(acts["fading"])
                total = [x - w * mpf(m) * rate for x, w, m in zip(total, omega, moments)]
            if "space" in acts:
                push = acts["space"]
                turn = [sum(rows[j][i] * mpf(push[j]) for j in range(3)) for i in range(3)]
                total = [x + n for x, n in zip(total, turn)]
            return total

        return torque

    @property
    def sink(self) -> float:
        """k of the slip k (L x omega) of a body with internal dissipation."""
        return self.acts.get("sink", 0.0)


MOMENTS, Q = (1.0, 1.5, 2.0), (0.75, 0.5, -0.25, 0.3535533905932738)
CURVE = ((0.25, 0.0, -0.125), (0.0, 0.125, 0.25), (-0.0625, 0.0625, 0.0), (0.0, -0.03125, 0.015625))
"""Torque in body axes as a polynomial of t: the cubic table through its ends is the polynomial."""
PLATES = (
    (1.0, (1.0, 0.0, 0.0), (-0.5, 0.125, -0.25)),
    (0.5, (0.0, 0.0, 1.0), (0.25, 0.0, -0.125)),
)
"""Area, normal and centre; both are exposed all the time."""
SUN = (0.75, 0.0, 0.6614378277661477)
SHADOW = ((-1.5, 2.0, -1.3228756555322954), (-1.5, -2.0, -1.3228756555322954), 1.0)
"""Places at both ends, in a straight line between, and the radius: dark from t = 1 to t = 3."""
CORNERS = ((1, 1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, 1))
DUMPING = (0.125, (0.25, -0.5, 1.0))
"""k, and the field in space axes."""

SYSTEMS = [
    System("free_long_axis_mode", (1.0, 2.0, 3.0), (1, 0, 0, 0), (1.0, 0.25, -0.5), (0, 10)),
    System(
        "free_short_axis_mode", (1.0, 2.0, 3.0), (0.5, 0.5, -0.5, 0.5), (0.25, 0.25, 1.0), (0, 10)
    ),
    System(
        "free_near_separatrix",
        (4.0, 5.0, 8.0),
        (1, 0, 0, 0),
        (0.0, 0.5, 0.001953125),
        (0, 40),
        {},
        80,
        unstable=30,
    ),
    System("free_backwards", (2.0, 1.25, 1.5), (1, 0, 0, 0), (-0.5, 1.0, 0.75), (3, -5)),
    System("symmetric_prolate", (2.0, 2.0, 0.5), (0.5, -0.5, 0.5, 0.5), (0.5, 0.25, 2.0), (0, 8)),
    System("detest_b5", (0.5, 0.75, 1.0), (1, 0, 0, 0), (0.25, 1.5, -0.75), (0, 8)),
    System(
        "heavy_asymmetric_top",
        (1.0, 1.5, 2.0),
        (0.5, 0.5, 0.5, -0.5),
        (0.5, -1.0, 0.75),
        (0, 6),
        {"gravity": (2.0, (0.125, 0.0, 0.5))},
    ),
    System(
        "lagrange_top",
        (1.0, 1.0, 0.5),
        (0.75, 0.5, -0.25, 0.3535533905932738),
        (0.25, -0.5, 5.0),
        (0, 6),
        {"gravity": (2.0, (0.0, 0.0, 0.5))},
    ),
    System(
        "gravity_gradient",
        (1.0, 1.5, 2.0),
        (0.75, 0.5, -0.25, 0.3535533905932738),
        (0.1, -0.2, 0.3),
        (0, 10),
        {"gradient": (0.75, (0.6, 0.0, 0.8))},
    ),
    System(
        "driven_and_damped",
        (1.0, 1.5, 2.0),
        (1, 0, 0, 0),
        (0.5, -0.25, 1.0),
        (0, 5),
        {"body": (0.25, 0.0, -0.125), "damping": (0.25, 0.125, 0.5)},
    ),
    System(
        "pushed_in_space",
        (1.0, 1.5, 2.0),
        (1, 0, 0, 0),
        (0.5, -0.25, 1.0),
        (0, 5),
        {"space": (0.25, -0.5, 0.125)},
    ),
    System(
        "spin_about_one_axis",
        (1.0, 1.5, 2.0),
        (1, 0, 0, 0),
        (0.0, 0.0, 1.0),
        (0, 5),
        {"body": (0.0, 0.0, 0.25), "damping": (0.0, 0.0, 0.5)},
    ),
    System(
        "energy_sink",
        (1.0, 1.5, 2.0),
        (0.75, 0.5, -0.25, 0.3535533905932738),
        (1.0, -0.25, 0.5),
        (0, 6),
        {"sink": 0.125},
    ),
    System(
        "symmetric_fading",
        (1.5, 1.5, 2.0),
        (0.5, -0.5, 0.5, 0.5),
        (0.5, 0.25, -1.0),
        (0, 5),
        {"fading": 0.125},
    ),
    # one system for each part that is not a simple torque
    System("torque_from_a_table", MOMENTS, Q, (0.5, -0.25, 1.0), (0, 4), {"table": CURVE}, 28),
    System(
        "air_drag",
        MOMENTS,
        (1, 0, 0, 0),
        (0.0625, -0.03125, 0.0625),
        (0, 4),
        {"drag": (PLATES, 0.015625, (4.0, 0.5, 2.0), 2.0)},
        28,
    ),
    System(
        "sunlight",
        MOMENTS,
        (1, 0, 0, 0),
        (0.0625, -0.03125, 0.0625),
        (0, 4),
        {"light": (PLATES, SUN, 0.25, 0.375, 0.0625, None)},
        28,
    ),
    System(
        "sunlight_and_shadow",
        MOMENTS,
        (1, 0, 0, 0),
        (0.0625, -0.03125, 0.0625),
        (0, 4),
        {"light": (PLATES, SUN, 0.25, 0.375, 0.125, SHADOW)},
        cuts=(1.0, 3.0),
        steps=28,
    ),
    System(
        "booms_that_deploy",
        MOMENTS,
        Q,
        (0.5, -0.25, 1.0),
        (0, 4),
        {"growth": (0.125, 0.25, 0.0625)},
        28,
    ),
    System(
        "cluster_of_wheels",
        MOMENTS,
        Q,
        (0.5, -0.25, 1.0),
        (0, 4),
        {"wheels": (CORNERS, 0.0625, (1.0, 2.0, -1.0, 0.5), (0.25, 0.125, 0.5), None)},
        28,
    ),
    System(
        "momentum_dumping",
        MOMENTS,
        Q,
        (0.5, -0.25, 1.0),
        (0, 4),
        {"wheels": (CORNERS, 0.0625, (1.0, 2.0, -1.0, 0.5), (0.25, 0.125, 0.5), DUMPING)},
        28,
    ),
    System(
        "control_moment_gyro",
        MOMENTS,
        Q,
        (0.5, -0.25, 1.0),
        (0, 4),
        {"gyro": (0.5, 0.25)},
        28,
    ),
    System(
        "commands_held",
        MOMENTS,
        Q,
        (0.5, -0.25, 1.0),
        (0, 4),
        {"sampled": (0.25, 0.5, 0.125)},
        cuts=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5),
        steps=28,
    ),
]

BY_NAME = {system.name: system for system in SYSTEMS}


def truth(name: str) -> dict[str, Any]:
    """Exact ``state`` (omega, q) and ``gradient`` (7 x 3) at the last time, as floats."""
    entry = json.loads(TRUTH.read_text())[name]
    return {
        "state": [float(x) for x in entry["state"]],
        "gradient": [[float(x) for x in row] for row in entry["gradient"]],
    }
