"""Inertia ratios of a tossed racquet from 120 recordings of a phone's gyroscope.

Recordings: University of British Columbia (doi:10.14288/1.0448943), 100 Hz, 0.4 to 1.2 s each; not
part of the project, expected in ``../shared/data/ubc_racquet_toss`` or the folder ``--data``.

Every trial is fitted alone, all in one call. The trials of a round (one mounting of the phone) are
also fitted together. For the third round, the largest, there are further joint fits: without the
fast trials (more than 15 rad/s, where drag matters), of the fast trials alone, and with a fitted
drag. The likelihood of the readings (``fit_balance``, without a wheel) is applied to slow and fast
trials of the third round, as recorded and without the first and last 0.1 s, during which hands may
touch the racquet; the fit with drag is applied to the same parts.

Published: 0.067(13) : 0.909(320) : 1 by pendulum; 0.0660 : 0.9348 : 1 from 63 trials together at
0.32 rad/s rms, with period errors of 16.9 %; 54 of 117 unconstrained single fits fail.

The flip period is the mean time between sign changes of the rate about the intermediate axis, of
the fitted motion and of the data.

    python -m benchmarks.racquet [--data FOLDER] [--output out/benchmarks/racquet.json]
"""

import csv
import sys
from pathlib import Path

from benchmarks._report import one_thread, recordings, write

if __name__ == "__main__":
    one_thread()

import jax
import numpy as np

from benchmarks.throws import Instrument, fit_balance
from polhode.fit import (
    Drag,
    Finding,
    FitOptions,
    Gyroscope,
    Recording,
    SteppedMotion,
    fit_inertia,
    fit_recordings,
)
from polhode.rotation import wxyz_to_matrix

FAST = 15.0
UNUSABLE = Finding.STEP_LIMIT | Finding.NOT_FINITE | Finding.AXES_DISAGREE
DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "ubc_racquet_toss"


def load(folder):
    """Tables (t, x, y, z) of the trials, by round."""
    table = np.genfromtxt(folder / "trials.csv", delimiter=",", names=True)
    columns = np.stack([table[name] for name in ("t_s", "wx", "wy", "wz")], axis=-1)
    with open(folder / "index.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = {}
    for row in rows:
        found.setdefault(row["round"], []).append(columns[table["trial"] == int(row["trial"])])
    return found


def padded(trials):
    """Times and rates of trials of different length, padded with NaN."""
    longest = max(map(len, trials))
    times = np.zeros((len(trials), longest))
    rates = np.full((len(trials), longest, 3), np.nan)
    for k, trial in enumerate(trials):
        count = len(trial)
        times[k, :count], rates[k, :count] = trial[:, 0], trial[:, 1:]
        times[k, count:] = trial[-1, 0] + 0.01 * np.arange(1, longest - count + 1)
    return times, rates


def alone(trials):
    """Results of fits of single trials."""
    times, rates = padded(trials)
    options = FitOptions(gyroscope=Gyroscope.ideal())
    fit = fit_inertia(times, rates, throw=False, options=options)
    codes, moments = np.asarray(fit.diagnostics), np.asarray(fit.moments)
    tensors = np.asarray(fit.inertia.tensor)
    least = np.trace(tensors, axis1=1, axis2=2) / 2 - moments[:, 2]
    usable = codes & int(UNUSABLE) == 0
    silent = (codes == 0) & ~np.isfinite(np.asarray(fit.ratios_std)).all(axis=1)
    return {
        "trials": len(trials),
        "physical": int((np.isfinite(moments).all(axis=1) & (least > -1e-12)).sum()),
        "converged": int(usable.sum()),
        "neither_converged_nor_flagged": int(silent.sum()),
        "findings": {
            str(flag.name).lower(): int((codes & int(flag) != 0).sum()) for flag in Finding
        },
        "rms_median_rad_s": float(np.median(np.asarray(fit.rms)[usable])),
        "ratios_median": np.median(np.asarray(fit.ratios)[usable], axis=0).tolist(),
    }


def crossings(times, x):
    """Times of the sign changes of x."""
    k = np.flatnonzero(x[1:] * x[:-1] < 0)
    return times[k] - x[k] * (times[k + 1] - times[k]) / (x[k + 1] - x[k])


def together(trials, motion=None):
    """Result of a joint fit of one body to the trials of a round."""
    given = [Recording.of(trial[:, 0], trial[:, 1:]) for trial in trials]
    options = FitOptions(motion=motion, max_starts=2, gyroscope=Gyroscope.ideal())
    fit = fit_recordings(given, options=options, throw=False)
    middle = np.asarray(wxyz_to_matrix(fit.axes))[:, 1]
    rest = np.asarray(fit.residuals["omega"])
    errors, fewer = [], 0
    for k, trial in enumerate(trials):
        model = trial[:, 1:] - rest[k, : len(trial)]
        data, made = (np.diff(crossings(trial[:, 0], x @ middle)) for x in (trial[:, 1:], model))
        if len(data) == 0:
            continue
        if len(data) != len(made):
            fewer += 1
            continue
        errors.append(made.mean() / data.mean() - 1)
    size = np.abs(errors)
    return {
        "trials": len(trials),
        "ratios": np.asarray(fit.ratios).tolist(),
        "ratios_std": np.asarray(fit.ratios_std).tolist(),
        "rms_rad_s": float(fit.rms),
        "findings": fit.findings(),
        "steps": int(fit.steps),
        "flips_compared": len(errors),
        "flips_of_another_number": fewer,
        "flip_period_error_mean": float(size.mean()) if len(size) else None,
        "flip_period_error_largest": float(size.max()) if len(size) else None,
    }


def readings(trials, cut):
    """Result of the likelihood of the readings, without ``cut`` samples at both ends of a trial."""
    trials = [one[cut : len(one) - cut] for one in trials if len(one) > 2 * cut + 20]
    given = [Recording.of(one[:, 0], one[:, 1:]) for one in trials]
    fit = fit_balance(given, Instrument(None), throw=False)
    rest = np.asarray(fit.residuals["omega"]) * np.asarray(fit.residuals["omega_std"])
    drag = together(trials, SteppedMotion(drag=Drag(), fit_drag=True, steps=2))
    return {
        "trials": len(trials),
        "ratios": np.asarray(fit.ratios[0]).tolist(),
        "ratios_std": np.asarray(fit.ratios_std[0]).tolist(),
        "rms_one_sample_ahead_rad_s": float(np.sqrt(np.mean(rest[rest != 0] ** 2))),
        "slow_torque_rad_s2": float(fit.noise_levels.slow[0] / np.trace(fit.inertia.tensor[0]) * 2),
        "converged": bool(np.all(fit.converged)),
        "drag_fitted_ratios": drag["ratios"],
        "drag_fitted_ratios_std": drag["ratios_std"],
        "drag_fitted_rms_rad_s": drag["rms_rad_s"],
    }


def main() -> int:
    """Run, print and write."""
    options = recordings(__doc__, DATA)
    jax.config.update("jax_enable_x64", True)
    rounds = load(options.data)
    numbers = {"alone": alone([trial for trials in rounds.values() for trial in trials])}
    print(numbers["alone"], flush=True)
    slow = [one for one in rounds["round3"] if np.linalg.norm(one[:, 1:], axis=1).max() < FAST]
    fast = [one for one in rounds["round3"] if np.linalg.norm(one[:, 1:], axis=1).max() >= FAST]
    drag = SteppedMotion(drag=Drag(), fit_drag=True, steps=2)
    cases = {name: (trials,) for name, trials in rounds.items()}
    cases["round3, up to 15 rad/s"] = (slow,)
    cases["round3, over 15 rad/s"] = (fast,)
    cases["round3, over 15 rad/s, drag fitted"] = (fast, drag)
    cases["round3, drag fitted"] = (rounds["round3"], drag)
    numbers["together"] = {}
    for name in sorted(cases):
        numbers["together"][name] = together(*cases[name])
        print(name, numbers["together"][name], flush=True)
    numbers["likelihood_of_the_readings"] = {}
    for name, trials in (("up to 15 rad/s", slow), ("over 15 rad/s", fast)):
        for cut in (0, 10):
            found = readings(trials, cut)
            numbers["likelihood_of_the_readings"][f"{name}, {cut} samples cut"] = found
            print(name, cut, found, flush=True)
    print(f"written: {write('racquet', numbers, path=options.output, packages=('optimistix',))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
