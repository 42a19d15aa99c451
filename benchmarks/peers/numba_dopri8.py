"""Hand-written loops compiled by Numba: Dormand-Prince 8(7), adaptive steps for each body."""

import time

import diffrax
import numba
import numpy as np

from benchmarks.peers import Program
from benchmarks.problems import DIRECTION, Problem

NAME = "Numba"
PACKAGES = ("numba", "llvmlite")

_TABLE = diffrax.Dopri8.tableau
_STAGES = len(_TABLE.b_sol)
_A = np.zeros((_STAGES, _STAGES))
for _i, _row in enumerate(_TABLE.a_lower, start=1):
    _A[_i, :_i] = _row
_B, _E = np.asarray(_TABLE.b_sol, float), np.asarray(_TABLE.b_error, float)


def programs(problem: Problem, n, dtype, tolerances, quick) -> list[Program]:
    if dtype != np.float64 or problem.horizon > 1e4:
        return []
    few = 3 if n == 1 else min(n, 50 if quick else 200)
    wxyz, omega = problem.states(few)
    start = np.concatenate([wxyz, omega], axis=1)
    a, b, c = problem.moments
    constants = np.array(
        [
            (b - c) / a,
            (c - a) / b,
            (a - b) / c,
            2 * problem.weight / a,
            2 * problem.weight / b,
            problem.gradient * (c - b) / a,
            problem.gradient * (a - c) / b,
            problem.gradient * (b - a) / c,
            DIRECTION[0],
            DIRECTION[2],
        ]
    )
    begin = time.perf_counter()
    _run(start[:1], constants, np.array([0.0, 0.01]), 1e-3, _A, _B, _E)
    spent = time.perf_counter() - begin
    spent = None if spent < 0.01 else spent  # compiled by an earlier table

    def call(tolerance):
        ys = _run(start, constants, problem.times, tolerance, _A, _B, _E)
        return ys[..., :4], ys[..., 4:]

    return [
        Program("Dopri8, body by body", f"{t:.0e}", lambda t=t: call(t), few, spent)
        for t in tolerances
        if t > 1e-14
    ]


@numba.njit(inline="always")
def _field(y, k, out):
    q0, q1, q2, q3, a, b, c = y[0], y[1], y[2], y[3], y[4], y[5], y[6]
    out[0] = -0.5 * (q1 * a + q2 * b + q3 * c)
    out[1] = 0.5 * (q0 * a + q2 * c - q3 * b)
    out[2] = 0.5 * (q0 * b + q3 * a - q1 * c)
    out[3] = 0.5 * (q0 * c + q1 * b - q2 * a)
    out[4] = k[0] * b * c + k[3] * (q2 * q3 + q0 * q1)
    out[5] = k[1] * c * a - k[4] * (q1 * q3 - q0 * q2)
    out[6] = k[2] * a * b
    if k[5] != 0 or k[6] != 0 or k[7] != 0:
        u, v = k[8], k[9]
        x = u * (q0 * q0 + q1 * q1 - q2 * q2 - q3 * q3) + 2 * v * (q1 * q3 - q0 * q2)
        y_ = 2 * u * (q1 * q2 - q0 * q3) + 2 * v * (q2 * q3 + q0 * q1)
        z = 2 * u * (q1 * q3 + q0 * q2) + v * (q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3)
        out[4] += k[5] * y_ * z
        out[5] += k[6] * z * x
        out[6] += k[7] * x * y_


@numba.njit(fastmath=True)
def _run(start, k, times, tolerance, A, B, E):
    n, saves, stages = start.shape[0], len(times) - 1, len(B)
    out = np.empty((n, saves, 7))
    slopes, y, trial = np.empty((stages, 7)), np.empty(7), np.empty(7)
    for body in range(n):
        y[:] = start[body]
        t, step = times[0], 0.05
        for save in range(saves):
            while t < times[save + 1]:
                h = min(step, times[save + 1] - t)
                for s in range(stages):
                    for j in range(7):
                        total = 0.0
                        for r in range(s):
                            total += A[s, r] * slopes[r, j]
                        trial[j] = y[j] + h * total
                    _field(trial, k, slopes[s])
                square = 0.0
                for j in range(7):
                    total, wrong = 0.0, 0.0
                    for s in range(stages):
                        total += B[s] * slopes[s, j]
                        wrong += E[s] * slopes[s, j]
                    trial[j] = y[j] + h * total
                    size = tolerance * (1 + max(abs(y[j]), abs(trial[j])))
                    square += (h * wrong / size) ** 2
                error = np.sqrt(square / 7)
                if error <= 1:
                    t += h
                    y[:] = trial
                factor = 5.0 if error == 0 else min(5.0, max(0.2, 0.9 * error ** (-1 / 8)))
                if error > 1 or h == step:
                    step = h * factor
            out[body, save] = y
    return out
