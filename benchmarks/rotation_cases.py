"""The conversions of rotations, each with its reference, its samples and its measure of error."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import mpmath as mp
import numpy as np

import polhode.rotation as rotation
from benchmarks import rotation_truth as truth
from polhode.rotation import Sequence


@dataclass(frozen=True)
class Case:
    """One conversion: the package's function on rows, its reference, samples and error measure."""

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
    """Rotation vectors of length at most pi, random and special."""
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
    """Euler angles over the closed ranges, random and special (of these every ``stride``-th)."""
    rng = np.random.default_rng(11)
    pi = float(dtype(np.pi))
    tiny = tiny_angles(dtype)[0]
    outer = [
        (0.0, 0.0),
        (0.3, -0.3),
        (0.3, -0.3 + 1e-7),
        (tiny, tiny),
        (pi, pi),
        (pi, -pi),
        (-pi, -pi),
        (pi / 2, pi / 2),
        (1.0, pi - 1),
        (1.0, pi - 1 - 1e-6),
        (1.0, pi - 1 + 1e-6),
        (-2.0, 2 - pi),
        (3.0, 3.1),
        (2.5, 1.9),
        (-2.5, -1.9),
        (pi, pi - 1e-6),
        (0.4, -0.7),
    ]
    inner = [0.0, tiny, 1e-8, 1e-4, 0.5, pi / 2 - 1e-6, pi / 2]
    inner += [2.0, pi - 1e-6, pi] if is_proper else [-tiny, -0.5, -pi / 2]
    made = [(first, second, third) for (first, third), second in itertools.product(outer, inner)]
    low, high = (0, np.pi) if is_proper else (-np.pi / 2, np.pi / 2)
    random = np.stack(
        [
            rng.uniform(-np.pi, np.pi, count),
            rng.uniform(low, high, count),
            rng.uniform(-np.pi, np.pi, count),
        ],
        axis=1,
    )
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
    """Unit quaternions in full precision, from which rounded matrices are computed."""
    return lambda dtype: [truth.from_vector(truth.exact(row)) for row in vectors(dtype, count)]


def _straight(point):
    """Paths along each coordinate."""
    size = len(point)
    return [
        (lambda h, k=k: [value + h * (slot == k) for slot, value in enumerate(point)])
        for k in range(size)
    ]


def _turning(point):
    """Paths of unit quaternions: rotations about each body axis at unit rate."""
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
    # near a half turn the antisymmetric part vanishes although the angle is large
    size = size if exact[0] + exact[4] + exact[8] > 2 else mp.mpf(1)
    return max(max(abs(value) for value in error), _over(worst_off, size))


def measure_euler(sequence):
    """Half of the angle between the exact rotation and that of the computed angles."""

    def measure(computed, exact_quaternion, _):
        made = truth.from_euler(truth.exact(computed), sequence.axes, sequence.is_extrinsic)
        inverse = [exact_quaternion[0], *(-value for value in exact_quaternion[1:])]
        error = truth.norm(truth.multiply(inverse, made)[1:])
        # with proper Euler angles, two large angles of opposite sign can be a small rotation
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


def at_identity(point):
    return all(value == 0 for value in point[1:])


def plain_cases(count: int) -> list[Case]:
    """All conversions without Euler angles."""
    return [
        Case(
            "rotation vector -> wxyz",
            rotation.rotation_vector_to_wxyz,
            lambda point: truth.from_vector,
            _points_of_vectors(count),
            _straight,
            measure_quaternion,
        ),
        Case(
            "axis-angle -> wxyz",
            lambda row: rotation.axis_angle_to_wxyz(row[..., :3], row[..., 3]),
            lambda point: truth.from_axis_angle,
            _points_of_axes(count),
            _straight,
            measure_quaternion,
        ),
        Case(
            "Rodrigues -> wxyz",
            rotation.modified_rodrigues_to_wxyz,
            lambda point: truth.from_rodrigues,
            _points_of_rodrigues(count),
            _straight,
            measure_quaternion,
        ),
        Case(
            "matrix -> wxyz",
            lambda row: rotation.matrix_to_wxyz(row.reshape(*row.shape[:-1], 3, 3)),
            _on_side,
            _points_unrounded(count),
            _turning,
            measure_quaternion,
        ),
        _from_quaternion(
            "wxyz -> rotation vector",
            rotation.wxyz_to_rotation_vector,
            truth.to_vector,
            measure_vector,
            count,
        ),
        _from_quaternion(
            "wxyz -> axis-angle",
            _axis_angle_row,
            truth.to_axis_angle,
            measure_axis_angle,
            count,
            singular=at_identity,
            near=_size_of_turn,
        ),
        _from_quaternion(
            "wxyz -> Rodrigues",
            rotation.wxyz_to_modified_rodrigues,
            truth.to_rodrigues,
            measure_vector,
            count,
        ),
        _from_quaternion(
            "wxyz -> shadow Rodrigues",
            rotation.wxyz_to_shadow,
            truth.to_shadow,
            measure_vector,
            count,
            singular=at_identity,
            near=_size_of_turn,
        ),
        _from_quaternion(
            "wxyz -> matrix",
            _matrix_row,
            lambda moved, _: truth.to_matrix(moved),
            measure_matrix,
            count,
        ),
    ]


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
            f"Euler {sequence.name} -> wxyz",
            forward,
            lambda point: lambda moved: truth.from_euler(moved, axes, extrinsic),
            points,
            _straight,
            measure_quaternion,
        ),
        Case(
            f"wxyz -> Euler {sequence.name}",
            backward,
            angles,
            quaternions,
            _turning,
            measure_euler(sequence),
            # closer than this, rounding may move the angle to the other side of the end
            singular=lambda point: to_end(point) < 1e-40,
            near=to_end,
        ),
    ]


def composed_cases(count: int, stride: int = 1) -> list[Case]:
    """From the ZYZ angles of the documents directly to every other representation."""

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
        (
            "rotation vector",
            lambda row: rotation.euler_to_rotation_vector(*angles(row)),
            truth.to_vector,
            measure_vector,
        ),
        ("axis-angle", axis_angle, truth.to_axis_angle, measure_axis_angle),
        (
            "Rodrigues",
            lambda row: rotation.euler_to_modified_rodrigues(*angles(row)),
            truth.to_rodrigues,
            measure_vector,
        ),
        ("matrix", matrix, lambda moved, _: truth.to_matrix(moved), measure_matrix),
    ]
    return [
        Case(
            f"Euler ZYZ -> {name}",
            function,
            through(target),
            points,
            _straight,
            measure,
            singular=unmoved if name == "axis-angle" else lambda point: False,
            near=size if name == "axis-angle" else lambda point: mp.mpf(1),
        )
        for name, function, target, measure in rows
    ]
