"""The other programs of the comparison: one module each, same inputs, own code.

A module has ``NAME``, ``PACKAGES`` (distributions whose versions are recorded) and

    programs(problem, n, dtype, tolerances, quick) -> list[Program]

which is empty where it has nothing to offer for the problem. Whatever compiles is compiled there,
apart from the run.
"""

import importlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

MODULES = (
    "stock_diffrax",
    "scipy_ivp",
    "scipy_closed_form",
    "taylor_heyoka",
    "numba_dopri8",
    "mujoco_rk4",
)


class Program(NamedTuple):
    """A way to move the bodies of a problem.

    ``label``: what it is; ``setting``: tolerance or steps; ``call()``: (wxyz, omega) at the saved
    times, (bodies, saves, 4) and (bodies, saves, 3), done when it returns; ``bodies``: how many
    bodies a call moves (the first of the problem: less than asked for where the cost per body does
    not depend on their number); ``compile_s``: seconds to compile; None: nothing is compiled.
    """

    label: str
    setting: str
    call: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    bodies: int
    compile_s: float | None = None


def load() -> tuple[dict, dict[str, str]]:
    """Modules of the peers that are installed, and why the others are missing."""
    found, missing = {}, {}
    for name in MODULES:
        try:
            module = importlib.import_module(f"benchmarks.peers.{name}")
        except ImportError as error:
            missing[name] = f"{error.name or name} is not installed"
        else:
            found[module.NAME] = module
    return found, missing


def rigid_body(problem, q, w, sums):
    """Rates of (wxyz, omega) of a problem from components: plain arithmetic for any peer.

    ``sums``: unused zero of the peer's kind of number, so that constant rates keep that kind.
    """
    q0, q1, q2, q3 = q
    x, y, z = w
    a, b, c = problem.moments
    turn = [
        -0.5 * (q1 * x + q2 * y + q3 * z),
        0.5 * (q0 * x + q2 * z - q3 * y),
        0.5 * (q0 * y + q3 * x - q1 * z),
        0.5 * (q0 * z + q1 * y - q2 * x),
    ]
    rate = [
        (b - c) / a * y * z + sums,
        (c - a) / b * z * x + sums,
        (a - b) / c * x * y + sums,
    ]
    if problem.weight:
        rate[0] = rate[0] + 2 * problem.weight / a * (q2 * q3 + q0 * q1)
        rate[1] = rate[1] - 2 * problem.weight / b * (q1 * q3 - q0 * q2)
    if problem.gradient:
        from benchmarks.problems import DIRECTION

        u, _, v = DIRECTION  # seen from the body; lies in the xz plane of space
        n = (
            u * (q0 * q0 + q1 * q1 - q2 * q2 - q3 * q3) + 2 * v * (q1 * q3 - q0 * q2),
            2 * u * (q1 * q2 - q0 * q3) + 2 * v * (q2 * q3 + q0 * q1),
            2 * u * (q1 * q3 + q0 * q2) + v * (q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3),
        )
        g = problem.gradient
        rate[0] = rate[0] + g * (c - b) / a * n[1] * n[2]
        rate[1] = rate[1] + g * (a - c) / b * n[2] * n[0]
        rate[2] = rate[2] + g * (b - a) / c * n[0] * n[1]
    if problem.damping or any(problem.push):
        acts = [p - problem.damping * v for p, v in zip(problem.push, w)]
        rate = [r + n / m for r, n, m in zip(rate, acts, problem.moments)]
    return turn + rate
