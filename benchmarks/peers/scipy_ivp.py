"""SciPy's solve_ivp: one body after another, and all bodies as one system."""

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.peers import Program, rigid_body
from benchmarks.problems import Problem

NAME = "SciPy solve_ivp"
PACKAGES = ("scipy",)


def programs(problem: Problem, n, dtype, tolerances, quick) -> list[Program]:
    if problem.horizon > 1e4 or dtype != np.float64 or n > 1000:
        return []
    wxyz, omega = problem.states(max(n, 3))
    start = np.concatenate([wxyz, omega], axis=1)
    tolerances = [t for t in tolerances if t >= 1e-13]
    found = []
    for tolerance in tolerances[:: 2 if quick else 1]:
        call = _loop(problem, start[:3], tolerance)
        found.append(Program("DOP853, body by body", f"{tolerance:.0e}", call, 3))
    if n > 1:
        for tolerance in tolerances:
            call = _together(problem, start, tolerance)
            found.append(Program("DOP853, one system", f"{tolerance:.0e}", call, n))
    return found


def _loop(problem, start, tolerance):
    def field(t, y):
        return rigid_body(problem, y[:4], y[4:], 0.0)

    def call():
        ys = [
            solve_ivp(
                field,
                (0.0, problem.horizon),
                y,
                "DOP853",
                problem.times[1:],
                rtol=max(tolerance, 2.3e-14),
                atol=tolerance,
            ).y.T
            for y in start
        ]
        ys = np.stack(ys)
        return ys[..., :4], ys[..., 4:]

    return call


def _together(problem, start, tolerance):
    n = len(start)

    def field(t, y):
        y = y.reshape(7, n)
        return np.concatenate(rigid_body(problem, y[:4], y[4:], 0.0))

    def call():
        ys = solve_ivp(
            field,
            (0.0, problem.horizon),
            start.T.reshape(-1),
            "DOP853",
            problem.times[1:],
            rtol=max(tolerance, 2.3e-14),
            atol=tolerance,
        ).y
        ys = ys.reshape(7, n, -1).transpose(1, 2, 0)
        return ys[..., :4], ys[..., 4:]

    return call
