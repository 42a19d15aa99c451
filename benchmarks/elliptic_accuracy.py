"""Worst errors of polhode._closed_forms.elliptic against mpmath, per function, dtype and region.

    python -m benchmarks.elliptic_accuracy [--quick] [--points N] [--only NAME ...] [--output FILE]

Unit: ulps of the result's scale (scale 1 for sn and cn, the result itself for everything else);
for functions of u or phi only what exceeds one ulp of that argument counts. Arguments are exact.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

from benchmarks import _report

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "elliptic"))

from elliptic_points import FUNCTIONS, points, regions
from elliptic_scores import (
    allowances,
    labels,
    library_values,
    scales,
    true_values,
    ulps,
)

CELL = 250
"""Points per region and dtype of a full run: 1,000 a function and dtype in about five minutes."""

ALLOWED = {
    "Principia": {
        "sn": 12507, "cn": 7648, "dn": 85, "am": 22074,
        "ellipf": 6, "ellipe_inc": 6, "ellippi_inc": 3934,
    },
    "Fukushima": {"ellipf": 5, "associate_b": 3, "associate_d": 3},
}  # fmt: skip
"""Ulps allowed elsewhere: by the tests of Principia (mockingbirdnest/Principia, numerics,
elliptic_functions_test.cpp and elliptic_integrals_test.cpp, against 20 digits or more of
Mathematica; the rounding of 1 - m and of the argument is within); largest errors stated by
Fukushima in Numer. Math. 116, 687 (2010) and, of the complete integrals, in Math. Comp. 80, 1725
(2011)."""


def score(name, region, count, dtype, rng):
    """Per result: (worst, 99th percentile, arguments of the worst)."""
    arguments = points(name, region, count, dtype, rng)
    found = library_values(name, arguments)
    eps = float(np.finfo(dtype).eps)
    errors = np.zeros((len(found), count))
    for i in range(count):
        at = tuple(float(argument[i]) for argument in arguments)
        values = true_values(name, at)
        limits = zip(values, scales(name, values), allowances(name, at, values), strict=True)
        for k, (value, scale, allowance) in enumerate(limits):
            errors[k, i] = ulps(found[k][i], value, scale, allowance, eps)
    for label, row in zip(labels(name), errors, strict=True):
        worst = int(np.argmax(row))
        at = ", ".join(f"{argument[worst]:.9g}" for argument in arguments)
        yield label, row[worst], np.quantile(row, 0.99, method="lower"), at


def measure(names, cell: int, seed: int = 20240229):
    """One row per result, dtype and region; ``cell`` points in each of four regions."""
    for name in names:
        for dtype in (np.float64, np.float32):
            for region in regions(name):
                count = cell * (4 // len(regions(name)))
                rng = np.random.default_rng(seed)
                for label, worst, most, at in score(name, region, count, dtype, rng):
                    yield {
                        "function": label, "dtype": np.dtype(dtype).name, "region": region,
                        "points": count, "worst": worst, "most": most, "worst_at": at,
                    }  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="30 points per cell, under a minute")
    parser.add_argument("--points", type=int, default=CELL, help="per region and dtype")
    parser.add_argument("--only", nargs="*", default=FUNCTIONS, help="names of functions")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    start, rows = time.perf_counter(), []
    cell = 30 if options.quick else options.points
    print(f"{'function':20} {'dtype':8} {'region':18} {'worst':>9} {'99 %':>7}  worst at")
    for row in measure(options.only, cell):
        rows.append(row)
        print(
            f"{row['function']:20} {row['dtype']:8} {row['region']:18} {row['worst']:9.2f}"
            f" {row['most']:7.2f}  {row['worst_at']}", flush=True,
        )  # fmt: skip
    numbers = {
        "points_per_function_and_dtype": 4 * cell,
        "seconds": time.perf_counter() - start,
        "allowed_elsewhere": ALLOWED,
        "rows": rows,
    }
    print(f"{4 * cell} points per function and dtype, {numbers['seconds']:.0f} s")
    print(_report.write("elliptic_accuracy", numbers, path=options.output, packages=("mpmath",)))


if __name__ == "__main__":
    main()
