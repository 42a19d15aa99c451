"""Stress table of all rotation conversions: worst error, worst gradient errors, per dtype.

Run ``python benchmarks/rotation_stress.py [--quick]``. Values, first derivatives (forward and
reverse mode) and second derivatives are compared with 120-digit arithmetic on random samples and on
samples at and near the identity, half turns, the ends of the angle ranges, and both sides of every
threshold. All errors are in units of eps; values relative to the rotation angle where it is small,
derivatives relative to the largest derivative of the sample.
"""

import argparse
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import polhode.rotation as rotation
from benchmarks import rotation_truth as truth
from polhode.rotation import Sequence

COLUMNS = ("value", "first", "second")


@dataclass(frozen=True)
class Case:
    """One conversion: the package's function on rows, its truth, its samples and its measure."""

    name: str
    function: Callable  # rows (..., n) -> rows (..., m)
    truth: Callable  # exact point -> (function of a path point with branches fixed)
    points: Callable  # dtype -> list of exact points, each a list of mpf, to be rounded
    directions: Callable  # exact point -> list of paths h -> point
    measure: Callable  # (computed row, exact row, exact point) -> mpf
    singular: Callable = lambda point: False  # True where no derivative exists
    near: Callable = lambda point: mp.mpf(1)  # distance to a singular point, for the step


# --- samples --------------------------------------------------------------------------------------


def tiny_angles(dtype) -> list[float]:
    decades = (-300, -200, -100, -37, -20) if dtype == np.float64 else (-32, -26, -20)
    return [10.0**decade for decade in decades]


def vectors(dtype, count: int) -> list[np.ndarray]:
    """Rotation vectors of length at most pi, random and awkward."""
    rng = np.random.default_rng(7)
    axes = [*np.eye(3), np.ones(3) / np.sqrt(3), np.array([1.0, -2, 0]) / np.sqrt(5)]
    axes += [axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3))]
    angles = [0.0, *tiny_angles(dtype), 1e-8, 1e-5, 1e-3, 0.03, 0.5, np.pi / 2, 2 * np.pi / 3, 3.0]
    angles += [np.pi - gap for gap in (1e-2, 1e-5, 1e-7, 1e-12, 0.0)]
    made = [angle * axis for angle, axis in itertools.product(angles, axes)]
    random = rng.normal(size=(count, 3))
    random *= (rng.uniform(0, np.pi, count) / np.linalg.norm(random, axis=1))[:, None]
    return [np.asarray(row, dtype) for row in [*made, *random]]


def eulers(dtype, count: int, is_proper: bool, stride: int) -> list[np.ndarray]:
    """Euler angles over the closed ranges, random and awkward (of these every ``stride``-th)."""
    rng = np.random.default_rng(11)
    pi = float(dtype(np.pi))
    tiny = tiny_angles(dtype)[0]
    outer = [
        (0.0, 0.0), (0.3, -0.3), (0.3, -0.3 + 1e-7), (tiny, tiny), (pi, pi), (pi, -pi), (-pi, -pi),
        (pi / 2, pi / 2), (1.0, pi - 1), (1.0, pi - 1 - 1e-6), (1.0, pi - 1 + 1e-6), (-2.0, 2 - pi),
        (3.0, 3.1), (2.5, 1.9), (-2.5, -1.9), (pi, pi - 1e-6), (0.4, -0.7),
    ]  # fmt: skip
    inner = [0.0, tiny, 1e-8, 1e-4, 0.5, pi / 2 - 1e-6, pi / 2]
    inner += [2.0, pi - 1e-6, pi] if is_proper else [-tiny, -0.5, -pi / 2]
    made = [(first, second, third) for (first, third), second in itertools.product(outer, inner)]
    low, high = (0, np.pi) if is_proper else (-np.pi / 2, np.pi / 2)
    random = np.stack(
        [rng.uniform(-np.pi, np.pi, count), rng.uniform(low, high, count),
         rng.uniform(-np.pi, np.pi, count)], axis=1
    )  # fmt: skip
    return [np.asarray(row, dtype) for row in [*made[::stride], *random]]


def _points_of_vectors(count):
    return lambda dtype: [truth.exact(row) for row in vectors(dtype, count)]


def _points_of_quaternions(count):
    """Quaternions rounded to the dtype, some of them with a negative scalar part."""

    def points(dtype):
        rows = []
        for number, row in enumerate(vectors(dtype, count)):
            sign = -1 if number % 5 == 4 else 1
            exact = truth.from_vector(truth.exact(row))
            rows.append(truth.exact([dtype(sign * float(value)) for value in exact]))
        rows += [truth.exact(row) for row in np.concatenate([np.eye(4), -np.eye(4)])]
        return rows

    return points


def _points_unrounded(count):
    """Exact unit quaternions: what a rounded matrix stands for."""
    return lambda dtype: [truth.from_vector(truth.exact(row)) for row in vectors(dtype, count)]


def _straight(point):
    """Paths along each coordinate."""
    size = len(point)
    return [
        (lambda h, k=k: [value + h * (slot == k) for slot, value in enumerate(point)])
        for k in range(size)
    ]


def _turning(point):
    """Paths of unit quaternions, turning about each body axis at unit rate."""
    base = truth.unit(point)
    return [(lambda h, k=k: truth.multiply(base, truth.about(k, h))) for k in range(3)]


# --- measures -------------------------------------------------------------------------------------


def _difference(computed, exact):
    return [truth.exact([c])[0] - e for c, e in zip(computed, exact, strict=True)]


def _over(error, size):
    if size == 0:
        return mp.mpf(0) if error == 0 else mp.inf
    return error / size


def measure_vector(computed, exact, _):
    return _over(truth.norm(_difference(computed, exact)), truth.norm(exact))


def measure_quaternion(computed, exact, _):
    error = _difference(computed, exact)
    return max(abs(error[0]), _over(truth.norm(error[1:]), truth.norm(exact[1:])))


def measure_axis_angle(computed, exact, _):
    error = _difference(computed, exact)
    return max(truth.norm(error[:3]), _over(abs(error[3]), exact[3]))


def measure_matrix(computed, exact, _):
    error = _difference(computed, exact)
    off = [slot for slot in range(9) if slot % 4]
    size = min(mp.mpf(1), truth.norm([exact[slot] for slot in off]))
    worst_off = max(abs(error[slot]) for slot in off)
    # near a half turn the off-diagonal entries may vanish while the angle is large
    size = size if exact[0] + exact[4] + exact[8] > 2 else mp.mpf(1)
    return max(max(abs(value) for value in error), _over(worst_off, size))


def measure_euler(sequence):
    """Half the angle of the rotation between the exact one and that of the computed angles."""

    def measure(computed, exact_quaternion, _):
        made = truth.from_euler(truth.exact(computed), sequence.axes, sequence.is_extrinsic)
        inverse = [exact_quaternion[0], *(-value for value in exact_quaternion[1:])]
        error = truth.norm(truth.multiply(inverse, made)[1:])
        # proper Euler angles near zero hide a small rotation in the sum of two large angles
        size = mp.mpf(1) if sequence.is_proper else truth.norm(exact_quaternion[1:])
        return _over(error, size)

    return measure


# --- the conversions ------------------------------------------------------------------------------


def _size_of_turn(point):
    size = truth.norm(truth.unit(point)[1:])
    return size if size > 0 else mp.mpf(1)


def _from_quaternion(name, function, target, measure, count, **more):
    def fixed(point):
        sign = truth.side(point)
        return lambda moved: target(moved, sign)

    return Case(name, function, fixed, _points_of_quaternions(count), _turning, measure, **more)


def _axis_angle_row(wxyz):
    axis, angle = rotation.wxyz_to_axis_angle(wxyz)
    return jnp.concatenate([axis, angle[..., None]], axis=-1)


def _matrix_row(wxyz):
    return rotation.wxyz_to_matrix(wxyz).reshape(*wxyz.shape[:-1], 9)


def _on_side(point):
    sign = truth.side(point)
    return lambda moved: [sign * value for value in moved]


def _at_identity(point):
    return all(value == 0 for value in point[1:])


def plain_cases(count: int) -> list[Case]:
    """Every conversion that has nothing to do with Euler angles."""
    return [
        Case(
            "rotation vector -> wxyz", rotation.rotation_vector_to_wxyz,
            lambda point: truth.from_vector, _points_of_vectors(count), _straight,
            measure_quaternion,
        ),
        Case(
            "axis-angle -> wxyz",
            lambda row: rotation.axis_angle_to_wxyz(row[..., :3], row[..., 3]),
            lambda point: truth.from_axis_angle, _points_of_axes(count), _straight,
            measure_quaternion,
        ),
        Case(
            "Rodrigues -> wxyz", rotation.modified_rodrigues_to_wxyz,
            lambda point: truth.from_rodrigues, _points_of_rodrigues(count), _straight,
            measure_quaternion,
        ),
        Case(
            "matrix -> wxyz",
            lambda row: rotation.matrix_to_wxyz(row.reshape(*row.shape[:-1], 3, 3)),
            _on_side,
            _points_unrounded(count), _turning, measure_quaternion,
        ),
        _from_quaternion(
            "wxyz -> rotation vector", rotation.wxyz_to_rotation_vector, truth.to_vector,
            measure_vector, count,
        ),
        _from_quaternion(
            "wxyz -> axis-angle", _axis_angle_row, truth.to_axis_angle, measure_axis_angle, count,
            singular=_at_identity, near=_size_of_turn,
        ),
        _from_quaternion(
            "wxyz -> Rodrigues", rotation.wxyz_to_modified_rodrigues, truth.to_rodrigues,
            measure_vector, count,
        ),
        _from_quaternion(
            "wxyz -> shadow Rodrigues", rotation.wxyz_to_shadow, truth.to_shadow, measure_vector,
            count, singular=_at_identity, near=_size_of_turn,
        ),
        _from_quaternion(
            "wxyz -> matrix", _matrix_row, lambda moved, _: truth.to_matrix(moved),
            measure_matrix, count,
        ),
    ]  # fmt: skip


def _points_of_axes(count):
    def points(dtype):
        rows = []
        for row in vectors(dtype, count):
            exact = truth.exact(row)
            angle = truth.norm(exact)
            axis = truth.unit(exact) if angle > 0 else [mp.mpf(0), mp.mpf(0), mp.mpf(1)]
            rows.append(truth.exact([dtype(float(value)) for value in [*axis, angle]]))
        return rows

    return points


def _points_of_rodrigues(count):
    def points(dtype):
        rows = []
        for number, row in enumerate(vectors(dtype, count)):
            exact = truth.to_rodrigues(truth.from_vector(truth.exact(row)), 1)
            longer = number % 3 if number % 7 == 0 else 0
            rows.append(truth.exact([dtype(float(value) * 10.0**longer) for value in exact]))
        return rows

    return points


def euler_cases(sequence: Sequence, count: int, stride: int = 1) -> list[Case]:
    """Both directions of one sequence of Euler angles."""
    axes, extrinsic, is_proper = sequence.axes, sequence.is_extrinsic, sequence.is_proper

    def forward(row):
        return rotation.euler_to_wxyz(row[..., 0], row[..., 1], row[..., 2], sequence)

    def backward(row):
        return jnp.stack(rotation.wxyz_to_euler(row, sequence), axis=-1)

    def angles(point):
        near = truth.to_euler(point, axes, extrinsic)
        return lambda moved: truth.unwrapped(truth.to_euler(moved, axes, extrinsic), near)

    def to_end(point):
        second = truth.to_euler(point, axes, extrinsic)[1]
        return abs(mp.sin(second) if is_proper else mp.cos(second))

    def points(dtype):
        return [truth.exact(row) for row in eulers(dtype, count, is_proper, stride)]

    def quaternions(dtype):
        made = [truth.from_euler(point, axes, extrinsic) for point in points(dtype)]
        rounded = [truth.exact([dtype(float(value)) for value in row]) for row in made]
        return rounded + [truth.exact(row) for row in np.eye(4)]

    return [
        Case(
            f"Euler {sequence.name} -> wxyz", forward,
            lambda point: lambda moved: truth.from_euler(moved, axes, extrinsic),
            points, _straight, measure_quaternion,
        ),
        Case(
            f"wxyz -> Euler {sequence.name}", backward, angles, quaternions, _turning,
            measure_euler(sequence),
            # closer than this a float cannot tell the two sides of the end apart
            singular=lambda point: to_end(point) < 1e-40, near=to_end,
        ),
    ]  # fmt: skip


def composed_cases(count: int, stride: int = 1) -> list[Case]:
    """From the documents' ZYZ angles straight to every other description."""

    def angles(row):
        return row[..., 0], row[..., 1], row[..., 2]

    def axis_angle(row):
        axis, angle = rotation.euler_to_axis_angle(*angles(row))
        return jnp.concatenate([axis, angle[..., None]], axis=-1)

    def matrix(row):
        return rotation.euler_to_matrix(*angles(row)).reshape(*row.shape[:-1], 9)

    def quaternion(point):
        return truth.from_euler(point, (2, 1, 2), False)

    def through(target):
        def fixed(point):
            sign = truth.side(quaternion(point))
            return lambda moved: target(quaternion(moved), sign)

        return fixed

    def points(dtype):
        return [truth.exact(row) for row in eulers(dtype, count, True, stride)]

    def unmoved(point):
        return truth.norm(quaternion(point)[1:]) < 1e-40

    def size(point):
        return truth.norm(quaternion(point)[1:])

    rows = [
        ("rotation vector", lambda row: rotation.euler_to_rotation_vector(*angles(row)),
         truth.to_vector, measure_vector),
        ("axis-angle", axis_angle, truth.to_axis_angle, measure_axis_angle),
        ("Rodrigues", lambda row: rotation.euler_to_modified_rodrigues(*angles(row)),
         truth.to_rodrigues, measure_vector),
        ("matrix", matrix, lambda moved, _: truth.to_matrix(moved), measure_matrix),
    ]  # fmt: skip
    return [
        Case(
            f"Euler ZYZ -> {name}", function, through(target), points, _straight, measure,
            singular=unmoved if name == "axis-angle" else lambda point: False,
            near=size if name == "axis-angle" else lambda point: mp.mpf(1),
        )
        for name, function, target, measure in rows
    ]  # fmt: skip


# --- running --------------------------------------------------------------------------------------


def _row_of(case: Case, point):
    return truth.to_matrix(point) if case.name.startswith("matrix") else point


def _rounded(values, dtype) -> np.ndarray:
    return np.asarray([float(value) for value in values], np.float64).astype(dtype)


def _derivative_program(function):
    """Value, first and second derivative along paths, and a reverse-mode product."""

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


def measure_case(case: Case, dtype) -> dict[str, float]:
    """Worst errors in units of eps: value, first derivative (both modes), second derivative."""
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
            target = case.truth(point)(point) if not _at_identity(point) else None
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
        # next to the singularity of a chart, second derivatives vary on the scale slope**2
        with np.errstate(over="ignore"):  # an infinite scale is left out below
            scale = max(np.abs(curves).max(), scale, scale * min(scale, huge))
        if np.isfinite(scale) and scale < huge:
            curve_error = np.abs(second[number] - curves).max()
            assert np.isfinite(curve_error), f"{case.name}: second derivative at {point}"
            worst["second"] = max(worst["second"], curve_error / scale / eps)
    return worst


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few random samples, ZYZ and XYZ only")
    quick = parser.parse_args().quick
    jax.config.update("jax_enable_x64", True)
    count = 20 if quick else 200
    sequences = [Sequence.ZYZ, Sequence.XYZ] if quick else list(Sequence)
    cases = plain_cases(count) + composed_cases(count // 4)
    for sequence in sequences:
        cases += euler_cases(sequence, count // 4)
    print("worst errors in units of eps (float64 2.2e-16, float32 1.2e-7)")
    print(f"{'conversion':<32}{'dtype':<10}" + "".join(f"{name:>10}" for name in COLUMNS))
    for case in cases:
        for dtype in (np.float64, np.float32):
            worst = measure_case(case, dtype)
            cells = "".join(f"{worst[name]:>10.2f}" for name in COLUMNS)
            print(f"{case.name:<32}{dtype.__name__:<10}{cells}", flush=True)


if __name__ == "__main__":
    main()
