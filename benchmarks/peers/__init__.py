"""The compared programs: one module each, with the same inputs and independent code.

A module has ``NAME``, ``PACKAGES`` (distributions whose versions are recorded) and

    programs(problem, n, dtype, tolerances, quick) -> list[Program]

which is empty if the program does not support the problem. Compilation happens there, not in the
timed call.
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
    """A method of one program that simulates the bodies of a problem.

    ``label``: name; ``setting``: tolerance or number of steps; ``call()``: (wxyz, omega) at the
    saved times, (bodies, saves, 4) and (bodies, saves, 3), blocking until they are computed;
    ``bodies``: the number of bodies of a call (the first of the problem; fewer than requested if
    the cost per body does not depend on their number); ``compile_s``: seconds to compile, None if
    nothing is compiled.
    """

    label: str
    setting: str
    call: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    bodies: int
    compile_s: float | None = None


def load() -> tuple[dict, dict[str, str]]:
    """Modules of the programs that are installed, and why the others are missing."""
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
    """Rates of (wxyz, omega) of a problem by components, in plain arithmetic for any program.

    ``sums``: a zero of the program's number type, so that constant rates have this type too.
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

        u, _, v = DIRECTION  # in the xz plane of space; n: its components in the body
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
