"""Fits of the inertia of free bodies: errors against the Cramer-Rao bound, times against SciPy.

Designs: 400 bodies each, with several lengths and noise levels. The rows contain the error of all
entries of the tensor in the metric of the information matrix (1 is the bound), the coverage of the
95 % intervals with its standard error (the two ratios of a body count as one draw), and the number
of fits that did not converge; for each design and for all of them together. Speed: one recording of
1,000 samples from raw rates to covariance, compared with SciPy's ``least_squares`` over
``solve_ivp`` (DOP853, log-Cholesky unknowns, the same start), with the errors of both; and 1,000
bodies in one call. Data are simulated by DOP853 at 1e-11. Single thread, one core.

    python -m benchmarks.identification [--quick] [--part designs | speed] [--output FILE]

If one part is run, the other part of an existing file is retained.
"""

import argparse
import json
import sys
import time
from pathlib import Path

from benchmarks._report import OUT, commit, one_thread, read, today, write

if __name__ == "__main__":
    one_thread()

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from benchmarks import truth
from benchmarks.problems import PROBLEMS
from polhode.fit import (
    Finding,
    FitOptions,
    FreeMotion,
    Gyroscope,
    Model,
    MomentsOnly,
    Parameters,
    Recording,
    fit_inertia,
    residuals,
    stack,
)
from polhode.fit._model import base_of, free_columns
from polhode.fit._start import regression

jax.config.update("jax_enable_x64", True)
RATE = 6.0
# the simulated sensors have no errors of scale or alignment
EXACT = FitOptions(gyroscope=Gyroscope.ideal())
# seed, revolutions, samples, noise over rate, smallest over largest second moment
DESIGNS = (
    (1, 4, 80, 0.002, 0.2),
    (2, 4, 80, 0.01, 0.2),
    (3, 10, 200, 0.01, 0.2),
    (4, 10, 200, 0.03, 0.02),
    (5, 30, 400, 0.02, 0.02),
)


def tumble(tensors, starts, times, tolerance=1e-11):
    """Rates (n, t, 3) of free bodies."""
    inverse = np.linalg.inv(tensors)

    def field(_, flat):
        w = flat.reshape(-1, 3)
        spin = np.einsum("nij,nj->ni", tensors, w)
        return np.einsum("nij,nj->ni", inverse, np.cross(spin, w)).ravel()

    path = solve_ivp(
        field, times[[0, -1]], starts.ravel(), "DOP853", times, rtol=tolerance, atol=tolerance
    )
    return np.moveaxis(path.y.reshape(-1, 3, len(times)), -1, 1)


def bodies(seed, count, least):
    """Random tensors and rates."""
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(least, 1, (count, 3))
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    second = np.einsum("nij,nj,nkj->nik", axes, sigma, axes)
    tensors = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    starts = rng.normal(size=(count, 3))
    starts *= RATE / np.linalg.norm(starts, axis=-1, keepdims=True)
    return rng, tensors, starts


def entries(tensors):
    return np.stack(
        [tensors[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))], axis=-1
    )


def design(seed, turns, samples, noise, least, count):
    """One row of the accuracy table."""
    rng, tensors, starts = bodies(seed, count, least)
    times = np.linspace(0, turns * 2 * np.pi / RATE, samples)
    clean = tumble(tensors, starts, times)
    sigma = noise * RATE
    rates = clean + sigma * rng.normal(size=clean.shape)
    fit = fit_inertia(times, rates, omega_noise=sigma, throw=False, options=EXACT)
    code = np.asarray(fit.diagnostics)
    information = np.asarray(fit.information)
    inner = np.linalg.solve(information[:, 6:, 6:], information[:, 6:, :6])
    marginal = information[:, :6, :6] - information[:, :6, 6:] @ inner
    moments = np.linalg.eigvalsh(tensors)
    error = entries(np.asarray(fit.inertia.tensor)) - entries(tensors / moments[:, 2, None, None])
    square = np.einsum("ni,nij,nj->n", error, marginal, error)
    weak = code & int(Finding.WEAK | Finding.NEARLY_FLAT | Finding.UNDETERMINED) != 0
    missed = (code & int(Finding.STEP_LIMIT | Finding.POOR) != 0) & ~weak
    told = ~weak & ~missed
    low, high = (np.asarray(end)[:, :2] for end in fit.interval(0.95))
    ratios = (moments / moments[:, 2:])[:, :2]
    inside = ((low <= ratios) & (ratios <= high))[told]
    return (
        square[told],
        inside,
        {
            "turns": turns,
            "samples": samples,
            "noise_over_rate": noise,
            "bodies": count,
            "flagged_weak_or_flat": int(weak.sum()),
            "flagged_not_converged": int(missed.sum()),
            **summary(square[told], inside),
            "chi_largest": float(np.asarray(fit.noise)[told].max()),
        },
    )


def summary(square, inside):
    """Error over bound, and coverage, each with its standard error over independent bodies."""
    error = np.sqrt(square.mean() / 5)
    covered = inside.mean(axis=1)
    root = np.sqrt(len(square))
    return {
        "error_over_bound": float(error),
        "error_over_bound_std": float(square.std() / root / 10 / error),
        "interval_cover_95": float(covered.mean()),
        "interval_cover_std": float(covered.std() / root),
    }


def best(call, repeats):
    """Minimum time of several runs [s], and the last result."""
    shortest = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        result = call()
        shortest = min(shortest, time.perf_counter() - begin)
    return shortest, result


def start_of(times, rates):
    """Common start of both fits: a triangular factor of the regression's second moments, and the
    rates.
    """
    sigma = np.asarray(regression(rates[None], times[None], np.ones((1, len(times))))[0])
    turned = np.linalg.cholesky(sigma[::-1, ::-1])[::-1, ::-1]
    _, b, c = np.diagonal(turned) / turned[0, 0]
    above = turned[0, 1], turned[0, 2], turned[1, 2]
    return np.array([np.log(b), np.log(c), *(np.array(above) / turned[0, 0]), *rates[0]])


def with_scipy(times, rates, start):
    """A typical SciPy fit: triangular factor of the second moments, solver within the residuals."""

    def tensor(y):
        factor = np.array([[1, y[2], y[3]], [0, np.exp(y[0]), y[4]], [0, 0, np.exp(y[1])]])
        sigma = factor @ factor.T
        return np.trace(sigma) * np.eye(3) - sigma

    def misfit(y):
        path = tumble(tensor(y)[None], y[None, 5:], times, tolerance=1e-9)[0]
        return (path - rates).ravel()

    found = least_squares(misfit, start, method="lm")
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    return tensor(found.x), covariance


def speed(count, quick):
    """One recording of 1,000 samples, then a batch of them."""
    rng, tensors, starts = bodies(7, count, 0.2)
    times = np.linspace(0, 8 * np.pi / RATE, 1000)
    clean = tumble(tensors, starts, times)
    rates = clean + 0.05 * rng.normal(size=clean.shape)
    begin = time.perf_counter()
    jax.block_until_ready(fit_inertia(times, rates[0], omega_noise=0.05, options=EXACT).covariance)
    first = time.perf_counter() - begin

    def single(k):
        return jax.block_until_ready(
            fit_inertia(times, rates[k], omega_noise=0.05, throw=False, options=EXACT)
        )

    ours, peers, errors, steps = [], [], [], []
    for k in range(2 if quick else 5):
        seconds, fit = best(lambda k=k: single(k), 5)
        ours.append(seconds)
        steps.append(int(fit.steps))
        start = start_of(times, rates[k])
        seconds, (found, _) = best(lambda k=k, s=start: with_scipy(times, rates[k], s), 1)
        peers.append(seconds)
        print(k, ours[-1], peers[-1], flush=True)
        true = tensors[k] / np.linalg.eigvalsh(tensors[k])[2]
        found = found / np.linalg.eigvalsh(found)[2]
        errors.append(
            [
                float(np.abs(np.asarray(fit.inertia.tensor) - true).max()),
                float(np.abs(found - true).max()),
            ]
        )
    begin = time.perf_counter()
    jax.block_until_ready(
        fit_inertia(times, rates, omega_noise=0.05, throw=False, options=EXACT).covariance
    )
    batch_first = time.perf_counter() - begin
    batch, fits = best(
        lambda: jax.block_until_ready(
            fit_inertia(times, rates, omega_noise=0.05, throw=False, options=EXACT)
        ),
        2,
    )
    cases = [
        {
            "ours_s": a,
            "steps": n,
            "scipy_s": b,
            "faster": b / a,
            "error_ours": e[0],
            "error_scipy": e[1],
        }
        for a, n, b, e in zip(ours, steps, peers, errors, strict=True)
    ]
    return {
        "samples": 1000,
        "cases": cases,
        "faster_least": min(case["faster"] for case in cases),
        "faster_median": float(np.median([case["faster"] for case in cases])),
        "compile_and_trace_s": first - min(ours),
        "batch_bodies": count,
        "batch_s": batch,
        "batch_compile_and_trace_s": batch_first - batch,
        "batch_per_body_over_best_single": batch / count / min(ours),
        "batch_flagged_not_converged": int((np.asarray(fits.diagnostics) & 1).sum()),
        "residual_gradient_error": gradient(),
    }


def gradient():
    """Largest error of the derivatives of the residuals with respect to moments and rates, relative
    to each column.

    The reference is central differences (step 2^-26) of residuals computed with 50 digits.
    """
    moments, omega = np.array([1.1, 1.5, 1.8]), np.array([0.8125, 2.0, -1.125])
    times = np.array([0.0, 0.4, 1.1, 2.5])
    recording = stack([Recording.of(times, np.ones((4, 3)), omega_noise=0.1)])
    sigma = np.diag(moments.sum() / 2 - moments)
    columns = tuple(map(tuple, free_columns(MomentsOnly(), True).tolist()))
    base = base_of(jnp.asarray(sigma), True)
    model = Model(FreeMotion(), base, None, None, columns, True)

    def flat(shape, omega):
        return residuals(Parameters(shape, omega[None]), recording, model)["omega"].ravel()

    slopes = jax.jit(jax.jacfwd(flat, argnums=(0, 1)))(jnp.zeros(3), jnp.asarray(omega))
    found = np.concatenate([np.asarray(slope) for slope in slopes], axis=1)
    worst = 0.0
    with mp.workdps(50):
        soft, unit = mp.mpf(float(base.soft)), mp.mpf(float(base.soft)) / mp.mpf(5e-3)

        def exact(y):
            second = []
            for start, by in zip(base.entries[:3], y[:3], strict=True):
                value = mp.mpf(float(start)) + unit * by
                second.append((value + mp.sqrt(value**2 + soft**2)) / 2)
            inertia = [sum(second) - value for value in second]
            unit_wxyz = [1.0, 0.0, 0.0, 0.0]
            rows = truth.motion(PROBLEMS["free"], unit_wxyz, y[3:], times[1:], 50, inertia)
            rates = [y[3:], *(row[4:] for row in rows)]
            return [(1 - w) / mp.mpf(0.1) for row in rates for w in row]

        step = mp.mpf(2) ** -26
        at = [mp.mpf(0)] * 3 + [mp.mpf(float(w)) for w in omega]
        for k in range(6):
            ends = [
                exact([y + sign * step * (j == k) for j, y in enumerate(at)]) for sign in (1, -1)
            ]
            column = np.array([float((x - y) / (2 * step)) for x, y in zip(*ends, strict=True)])
            worst = max(worst, np.abs(found[:, k] - column).max() / np.abs(column).max())
    return float(worst)


def main() -> int:
    """Run, print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--part", choices=("designs", "speed"))
    parser.add_argument("--output", type=Path, default=OUT / "identification.json")
    options = parser.parse_args()
    numbers = read(options.output)["numbers"] if options.part and options.output.exists() else {}
    origin = numbers.setdefault("origin", {})
    if options.part != "speed":
        squares, covers, rows = [], [], []
        for row in DESIGNS[: 2 if options.quick else None]:
            square, inside, found = design(*row, 40 if options.quick else 400)
            squares.append(square)
            covers.append(inside)
            rows.append(found)
            print(json.dumps(found), flush=True)
        numbers["designs"] = rows
        numbers["designs_pooled"] = summary(np.concatenate(squares), np.concatenate(covers))
        origin["designs"] = {"date": today(), "commit": commit()}
        print(json.dumps(numbers["designs_pooled"], indent=1))
    if options.part != "designs":
        numbers["speed"] = speed(50 if options.quick else 1000, options.quick)
        origin["speed"] = {"date": today(), "commit": commit()}
        print(json.dumps(numbers["speed"], indent=1))
    path = write(
        "identification", numbers, path=options.output, packages=("scipy", "optimistix", "lineax")
    )
    print(f"written: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
