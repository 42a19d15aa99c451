"""Rotation conversions in 120-digit arithmetic (mpmath), independent of the package.

A quaternion is a product of rotations about coordinate axes, or the exponential of half a rotation
vector; no formula of the package is used.
"""

from collections.abc import Callable, Sequence as Seq

import mpmath as mp

from benchmarks._formulas import multiply

DIGITS = 120
mp.mp.dps = DIGITS
Vector = list


def exact(values: Seq[float]) -> Vector:
    """Floating-point numbers as mpmath numbers, without rounding."""
    return [mp.mpf(float(value)) for value in values]


def norm(values: Vector) -> mp.mpf:
    return mp.sqrt(sum(value * value for value in values))


def unit(values: Vector) -> Vector:
    size = norm(values)
    return [value / size for value in values]


def about(axis: int, angle: mp.mpf) -> Vector:
    quaternion = [mp.cos(angle / 2), mp.mpf(0), mp.mpf(0), mp.mpf(0)]
    quaternion[1 + axis] = mp.sin(angle / 2)
    return quaternion


def from_euler(angles: Vector, axes: tuple[int, int, int], extrinsic: bool) -> Vector:
    turns = [about(axis, angle) for axis, angle in zip(axes, angles, strict=True)]
    if extrinsic:
        turns.reverse()
    return multiply(multiply(turns[0], turns[1]), turns[2])


def from_vector(vector: Vector) -> Vector:
    angle = norm(vector)
    if angle == 0:
        return [mp.mpf(1), *(value / 2 for value in vector)]
    factor = mp.sin(angle / 2) / angle
    return [mp.cos(angle / 2), *(factor * value for value in vector)]


def from_axis_angle(axis_and_angle: Vector) -> Vector:
    *axis, angle = axis_and_angle
    sine = mp.sin(angle / 2)
    return [mp.cos(angle / 2), *(sine * value for value in axis)]


def from_rodrigues(parameters: Vector) -> Vector:
    squared = sum(value * value for value in parameters)
    return [(1 - squared) / (1 + squared), *(2 * value / (1 + squared) for value in parameters)]


def side(quaternion: Vector) -> int:
    """Sign that makes the scalar part non-negative."""
    return -1 if quaternion[0] < 0 else 1


def to_vector(quaternion: Vector, sign: int) -> Vector:
    """Rotation vector of ``sign * quaternion``, where ``sign`` is not differentiated."""
    w, *v = (sign * value for value in unit(quaternion))
    size = norm(v)
    if size == 0:
        return v
    return [2 * mp.atan2(size, w) / size * value for value in v]


def to_axis_angle(quaternion: Vector, sign: int) -> Vector:
    w, *v = (sign * value for value in unit(quaternion))
    size = norm(v)
    if size == 0:
        return [mp.mpf(0), mp.mpf(0), mp.mpf(1), mp.mpf(0)]
    return [*(value / size for value in v), 2 * mp.atan2(size, w)]


def to_rodrigues(quaternion: Vector, sign: int) -> Vector:
    w, *v = (sign * value for value in unit(quaternion))
    return [value / (1 + w) for value in v]


def to_shadow(quaternion: Vector, sign: int) -> Vector:
    w, *v = (sign * value for value in unit(quaternion))
    return [-value * (1 + w) / norm(v) ** 2 for value in v]


def to_matrix(quaternion: Vector) -> Vector:
    """Nine entries, row by row: the images of the coordinate axes under q e q*."""
    q = unit(quaternion)
    inverse = [q[0], -q[1], -q[2], -q[3]]
    columns = []
    for axis in range(3):
        basis = [mp.mpf(int(slot == 1 + axis)) for slot in range(4)]
        columns.append(multiply(multiply(q, basis), inverse)[1:])
    return [columns[column][row] for row in range(3) for column in range(3)]


def derivatives(function: Callable[[Vector], Vector], path: Callable, step: mp.mpf):
    """Value, first and second derivative at 0 of ``function(path(h))``, by central differences.

    With 120 digits a step of 1e-20 leaves errors below 1e-38.
    """
    middle, ahead, behind = (function(path(h)) for h in (mp.mpf(0), step, -step))
    first = [(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
    second = [(a - 2 * m + b) / step**2 for a, m, b in zip(ahead, middle, behind, strict=True)]
    return middle, first, second


def to_euler(quaternion: Vector, axes: tuple[int, int, int], extrinsic: bool) -> Vector:
    """Euler angles from matrix entries; the second angle must be inside its range."""
    flat = to_matrix(quaternion)
    i, j, k = axes[::-1] if extrinsic else axes

    def entry(row: int, column: int) -> mp.mpf:
        return flat[3 * row + column]

    if i == k:
        k = 3 - i - j
        parity = (i - j) * (j - k) * (k - i) // 2
        first = mp.atan2(entry(j, i), -parity * entry(k, i))
        second = mp.atan2(mp.hypot(entry(j, i), entry(k, i)), entry(i, i))
        third = mp.atan2(entry(i, j), parity * entry(i, k))
    else:
        parity = (i - j) * (j - k) * (k - i) // 2
        first = mp.atan2(-parity * entry(j, k), entry(k, k))
        second = mp.atan2(parity * entry(i, k), mp.hypot(entry(k, k), entry(j, k)))
        third = mp.atan2(-parity * entry(i, j), entry(i, i))
    return [third, second, first] if extrinsic else [first, second, third]


def unwrapped(angles: Vector, near: Vector) -> Vector:
    """The same angles, shifted by full turns to be close to ``near``."""
    turn = 2 * mp.pi
    return [a + turn * mp.nint((b - a) / turn) for a, b in zip(angles, near, strict=True)]
