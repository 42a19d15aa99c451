"""Worst errors of polhode.elliptic against mpmath, per function, dtype and region.

    python benchmarks/elliptic_accuracy.py [--quick] [--points N] [--only NAME ...]

Unit: ulps of the result's scale (scale 1 for sn and cn, the result itself for everything else);
for functions of u or phi only what exceeds one ulp of that argument counts. Arguments are exact.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="30 points per cell, under a minute")
    parser.add_argument("--points", type=int, default=1250, help="per cell: 10,000 a function")
    parser.add_argument("--only", nargs="*", default=FUNCTIONS, help="names of functions")
    options = parser.parse_args()
    start, total = time.perf_counter(), 0
    print(f"{'function':20} {'dtype':8} {'region':18} {'worst':>9} {'99 %':>7}  worst at")
    for name in options.only:
        for dtype in (np.float64, np.float32):
            for region in regions(name):
                count = 30 if options.quick else options.points * (4 // len(regions(name)))
                total += count
                rng = np.random.default_rng(20240229)
                for label, worst, most, at in score(name, region, count, dtype, rng):
                    row = (
                        f"{label:20} {np.dtype(dtype).name:8} {region:18} {worst:9.2f} {most:7.2f}"
                    )
                    print(f"{row}  {at}", flush=True)
    print(f"{total} points, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
