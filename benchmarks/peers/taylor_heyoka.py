"""heyoka's adaptive Taylor integrator: one body, or one body per lane of the vector unit."""

import time

import heyoka
import numpy as np

from benchmarks.peers import Program, rigid_body
from benchmarks.problems import Problem

NAME = "heyoka"
PACKAGES = ("heyoka",)


def programs(problem: Problem, n, dtype, tolerances, quick) -> list[Program]:
    if dtype != np.float64:
        return []
    if problem.horizon > 1e4:  # seconds per body: only the first body, at two tolerances
        tolerances, n = (tolerances[-1:] if quick else (1e-9, 1e-15)), 1
    else:
        tolerances = [*(t for t in tolerances if t > 1e-14), 1e-15]
    width = 1 if n == 1 else heyoka.recommended_simd_size()
    few = 3 if n == 1 else min(n - n % width, 5 * width if quick else 25 * width)
    wxyz, omega = problem.states(few)
    start = np.concatenate([wxyz, omega], axis=1)
    names = heyoka.make_vars("q0", "q1", "q2", "q3", "x", "y", "z")
    system = list(zip(names, rigid_body(problem, names[:4], names[4:], 0 * names[0])))
    label = "Taylor" + (f", batches of {width}" if width > 1 else "")
    found = []
    for tolerance in tolerances:
        begin = time.perf_counter()
        if width == 1:
            made = heyoka.taylor_adaptive(system, [0.0] * 7, tol=tolerance)
        else:
            made = heyoka.taylor_adaptive_batch(system, np.zeros((7, width)), tol=tolerance)
        spent = time.perf_counter() - begin
        runs = (_one if width == 1 else _many)(made, problem, start, width)
        found.append(Program(label, f"{tolerance:.0e}", runs, few, spent))
    return found


def _one(made, problem, start, width):
    times = problem.times

    def call():
        out = []
        for y in start:
            made.time = 0.0
            made.state[:] = y
            if problem.saves == 1:
                made.propagate_until(problem.horizon)
                out.append(made.state[None].copy())
            else:
                out.append(made.propagate_grid(times)[-1][1:])
        ys = np.stack(out)
        return ys[..., :4], ys[..., 4:]

    return call


def _many(made, problem, start, width):
    blocks = start.reshape(-1, width, 7).transpose(0, 2, 1).copy()
    grid = np.repeat(problem.times[:, None], width, axis=1)

    def call():
        out = []
        for block in blocks:
            made.set_time(0.0)
            made.state[:] = block
            if problem.saves == 1:
                made.propagate_until(problem.horizon)
                out.append(made.state.T[:, None].copy())
            else:
                got = made.propagate_grid(grid)
                path = got[-1] if isinstance(got, tuple) else got
                out.append(np.moveaxis(path[1:], 2, 0))
        ys = np.concatenate(out)
        return ys[..., :4], ys[..., 4:]

    return call
