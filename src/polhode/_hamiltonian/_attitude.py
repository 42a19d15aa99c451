"""The attitude as a potential or torque sees it: rows of R, computed only when asked for."""

from collections.abc import Callable, Iterable, Sequence

import jax.numpy as jnp
from jaxtyping import Array

from polhode.rotation._components import matrix_row

Vector = tuple[Array, Array, Array]
"""Three component arrays of one common shape (structure of arrays)."""


def dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """Scalar product of two component triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[Array], b: Sequence[Array]) -> Vector:
    """Vector product of two component triples."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def triple(values: Iterable[Array]) -> Vector:
    """Three component arrays, one after the other, as a tuple of three; ValueError for others."""
    x, y, z = values
    return x, y, z


def components(array: Array) -> Vector:
    """The last axis of an array as a triple of component arrays."""
    return array[..., 0], array[..., 1], array[..., 2]


class Attitude:
    """Rotation body -> space by the rows of its matrix R (``x_space = R x_body``).

    Row ``i`` holds the body components of the space axis ``i``. Rows are evaluated when first
    used and remembered, so that what a potential does not look at costs nothing; ``used`` tells
    which rows were asked for.
    """

    def __init__(
        self,
        compute: Callable[[int], Vector],
        quaternion: Callable[[], tuple[Array, ...]] | None = None,
    ):
        self.compute, self._quaternion = compute, quaternion
        self._rows: dict[int, Vector] = {}

    def row(self, i: int) -> Vector:
        """Body components of the unit vector along space axis ``i``."""
        if i not in self._rows:
            self._rows[i] = self.compute(i)
        return self._rows[i]

    @property
    def wxyz(self) -> tuple[Array, ...]:
        """Unit quaternion, scalar first, as four component arrays (for torques; not potentials)."""
        if self._quaternion is None:
            raise ValueError(
                "a potential sees the attitude by its rows: use row(i), to_body, to_space, matrix."
            )
        return self._quaternion()

    @property
    def used(self) -> tuple[int, ...]:
        """Rows asked for so far."""
        return tuple(sorted(self._rows))

    def to_body(self, vector_space: Sequence[Array]) -> Vector:
        """Body components ``R^T v`` of a vector given by space components."""
        x, y, z = (self.row(i) for i in range(3))
        a, b, c = vector_space
        return triple(a * x[k] + b * y[k] + c * z[k] for k in range(3))

    def to_space(self, vector_body: Sequence[Array]) -> Vector:
        """Space components ``R v`` of a vector given by body components."""
        return triple(dot(self.row(i), vector_body) for i in range(3))

    @property
    def matrix(self) -> Array:
        """R as one array of shape (..., 3, 3)."""
        rows = [jnp.stack(self.row(i), axis=-1) for i in range(3)]
        return jnp.stack(rows, axis=-2)


def from_quaternion(wxyz: Sequence[Array]) -> Attitude:
    """Attitude of a unit quaternion given by four component arrays."""
    return Attitude(lambda i: matrix_row(wxyz, i), lambda: tuple(wxyz))


def from_euler_angles(phi: Array, theta: Array, psi: Array) -> Attitude:
    """Attitude ``Rz(phi) Ry(theta) Rz(psi)`` of three component arrays."""
    cf, sf, ct = jnp.cos(phi), jnp.sin(phi), jnp.cos(theta)
    st, cp, sp = jnp.sin(theta), jnp.cos(psi), jnp.sin(psi)

    def row(i: int) -> Vector:
        if i == 0:
            return ct * cf * cp - sf * sp, -ct * cf * sp - sf * cp, st * cf
        if i == 1:
            return ct * sf * cp + cf * sp, -ct * sf * sp + cf * cp, st * sf
        return -st * cp, st * sp, ct

    def quaternion() -> tuple[Array, ...]:
        half, sum_, difference = theta / 2, (psi + phi) / 2, (psi - phi) / 2
        c, s = jnp.cos(half), jnp.sin(half)
        return (
            c * jnp.cos(sum_),
            s * jnp.sin(difference),
            s * jnp.cos(difference),
            c * jnp.sin(sum_),
        )

    return Attitude(row, quaternion)


def from_rows(rows: dict[int, Vector]) -> Attitude:
    """Attitude of rows that are known already."""
    return Attitude(lambda i: rows[i])
