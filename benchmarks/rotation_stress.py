"""Stress test of all rotation conversions: largest errors of values and derivatives, by dtype.

Run ``python -m benchmarks.rotation_stress [--quick] [--output FILE]``. Values, first derivatives
(forward and reverse mode) and second derivatives are compared with 120-digit arithmetic on random
samples and on samples at and near the identity, half turns, the ends of the angle ranges, and both
sides of every threshold. All errors are in units of eps; those of values are relative to the
rotation angle where it is small, those of derivatives relative to the largest derivative of the
sample.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

from benchmarks import _report, rotation_truth as truth
from benchmarks.rotation_cases import Case, at_identity, composed_cases, euler_cases, plain_cases
from polhode.rotation import Sequence

COLUMNS = ("value", "first", "second")


def _row_of(case: Case, point):
    return truth.to_matrix(point) if case.name.startswith("matrix") else point


def _rounded(values, dtype) -> np.ndarray:
    return np.asarray([float(value) for value in values], np.float64).astype(dtype)


def _derivative_program(function):
    """Value, first and second derivatives along paths, and a reverse-mode product."""

    def along(rows, speeds, bends):
        def path(h):
            return function(rows[:, None, :] + h * speeds + h * h / 2 * bends)

        def first(h):
            return jax.jvp(path, (h,), (jnp.ones_like(h),))[1]

        zero = jnp.zeros((), rows.dtype)
        slope, curvature = jax.jvp(first, (zero,), (jnp.ones_like(zero),))
        return slope, curvature

    def everything(rows, speeds, bends, weights):
        values, pull = jax.vjp(function, rows)
        (gradient,) = pull(weights)
        reverse = jnp.sum(gradient[:, None, :] * speeds, axis=-1)
        return values, *along(rows, speeds, bends), reverse

    return jax.jit(everything)


@mp.workdps(truth.DIGITS)  # independent of the precision that other code has set
def measure_case(case: Case, dtype) -> dict[str, float]:
    """Largest errors in units of eps: value, first derivative (both modes), second derivative."""
    eps = float(np.finfo(dtype).eps)
    huge = float(np.finfo(dtype).max) ** 0.5
    points = case.points(dtype)
    rows, speeds, bends, exact = [], [], [], []
    for point in points:
        rows.append(_rounded(_row_of(case, point), dtype))
        paths = case.directions(point)
        row_paths = [lambda h, path=path: _row_of(case, path(h)) for path in paths]
        moves = [truth.derivatives(lambda row: row, path, mp.mpf(10) ** -20) for path in row_paths]
        speeds.append([_rounded(first, dtype) for _, first, _ in moves])
        bends.append([_rounded(second, dtype) for _, _, second in moves])
        if case.singular(point):
            exact.append(None)
            continue
        function = case.truth(point)
        step = mp.mpf(10) ** -20 * case.near(point)
        exact.append([truth.derivatives(function, path, step) for path in paths])
    outputs = jax.eval_shape(case.function, jnp.asarray(rows)).shape[-1]
    weights = np.random.default_rng(3).normal(size=(len(rows), outputs)).astype(dtype)
    program = _derivative_program(case.function)
    values, first, second, reverse = (
        np.asarray(part, np.float64)
        for part in program(*(jnp.asarray(part) for part in (rows, speeds, bends, weights)))
    )
    worst = dict.fromkeys(COLUMNS, 0.0)
    is_euler_out = case.name.startswith("wxyz -> Euler")
    for number, point in enumerate(points):
        if is_euler_out:
            target = truth.unit(point)
        elif exact[number] is None:
            target = case.truth(point)(point) if not at_identity(point) else None
        else:
            target = exact[number][0][0]
        if target is None:
            if "shadow" in case.name:
                continue
            target = case.truth(point)(point)
        error = float(case.measure(values[number], target, point))
        worst["value"] = max(worst["value"], error / eps)
        if exact[number] is None:
            assert np.isfinite(first[number]).all(), f"{case.name}: first derivative at {point}"
            continue
        slopes = np.array([[float(v) for v in row] for _, row, _ in exact[number]])
        curves = np.array([[float(v) for v in row] for _, _, row in exact[number]])
        scale = np.abs(slopes).max()
        if np.isfinite(scale) and scale < huge**1.9:
            forward_error = np.abs(first[number] - slopes).max()
            product = slopes @ weights[number].astype(np.float64)
            reverse_error = np.abs(reverse[number] - product).max()
            assert np.isfinite(forward_error), f"{case.name}: first derivative at {point}"
            worst["first"] = max(
                worst["first"], forward_error / scale / eps, reverse_error / scale / eps / 3
            )
        # next to a singularity of the coordinates, second derivatives scale as slope**2
        with np.errstate(over="ignore"):  # an infinite scale is skipped below
            scale = max(np.abs(curves).max(), scale, scale * min(scale, huge))
        if np.isfinite(scale) and scale < huge:
            curve_error = np.abs(second[number] - curves).max()
            assert np.isfinite(curve_error), f"{case.name}: second derivative at {point}"
            worst["second"] = max(worst["second"], curve_error / scale / eps)
    return worst


def worst_by_conversion(rows: list[dict]) -> list[dict]:
    """One row for each conversion; the Euler sequences share one row for each direction."""
    groups: dict[str, dict[str, float]] = {}
    for row in rows:
        name = row["conversion"]
        if {"Euler", "wxyz"} <= set(name.split()):
            to_wxyz = name.startswith("Euler")
            name = "Euler (any sequence) -> wxyz" if to_wxyz else "wxyz -> Euler (any sequence)"
        worst = groups.setdefault(name, {})
        for column in COLUMNS:
            key = f"{row['dtype']}_{column}"
            worst[key] = max(worst.get(key, 0.0), row[column])
    return [{"conversion": name, **worst} for name, worst in groups.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few random samples, ZYZ and XYZ only")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    quick = options.quick
    jax.config.update("jax_enable_x64", True)
    count = 20 if quick else 200
    sequences = [Sequence.ZYZ, Sequence.XYZ] if quick else list(Sequence)
    cases = plain_cases(count) + composed_cases(count // 4)
    for sequence in sequences:
        cases += euler_cases(sequence, count // 4)
    print("worst errors in units of eps (float64 2.2e-16, float32 1.2e-7)")
    print(f"{'conversion':<32}{'dtype':<10}" + "".join(f"{name:>10}" for name in COLUMNS))
    rows = []
    for case in cases:
        for dtype in (np.float64, np.float32):
            worst = measure_case(case, dtype)
            rows.append({"conversion": case.name, "dtype": dtype.__name__, **worst})
            cells = "".join(f"{worst[name]:>10.2f}" for name in COLUMNS)
            print(f"{case.name:<32}{dtype.__name__:<10}{cells}", flush=True)
    numbers = {
        "random_points": {"plain": count, "euler": count // 4},
        "rows": rows,
        "worst_by_conversion": worst_by_conversion(rows),
    }
    print(_report.write("rotation_stress", numbers, path=options.output, packages=("mpmath",)))


if __name__ == "__main__":
    main()
