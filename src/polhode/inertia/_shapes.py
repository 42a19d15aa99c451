"""Homogeneous bodies of simple shape: principal moments about the centre of mass.

The closed-form formulas avoid differences of nearly equal numbers, so that they remain accurate for
thin walls; the tests compare each with its defining integral.
"""

import abc
import enum
from collections.abc import Mapping
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polhode._checks import ArrayLike, as_float_array, as_floats, numbers, on_host, require_positive
from polhode.inertia._physical import require_below


class Symmetry(enum.Enum):
    """Which moments are equal by construction (static: it selects the program)."""

    NONE = "no two moments known to be equal"
    AXISYMMETRIC = "the moments about body x and y are equal"
    SPHERICAL = "all three moments are equal"


def _of_second_moments(mass: Array, x: Array, y: Array, z: Array) -> Array:
    """Principal moments of a body with mean squares x, y, z of its coordinates."""
    return _moments(mass, y + z, z + x, x + y)


def _axial(mass: Array, transverse: Array, axial: Array) -> Array:
    """Principal moments (transverse, transverse, axial) times mass."""
    return _moments(mass, transverse, transverse, axial)


def _moments(mass: Array, *squares: Array) -> Array:
    xp = jnp if any(isinstance(x, jax.Array) for x in (mass, *squares)) else np
    moments = mass[..., None] * xp.stack(squares, axis=-1)
    return as_float_array("the principal moments", moments, finite=False)


class AbstractShaped(eqx.Module):
    """Constructors from homogeneous simple shapes, all centred on the centre of mass.

    Masses in kg (positive), lengths in m; leading axes of the arguments broadcast to a batch.
    Axes of rotational symmetry are body z, and the result has that symmetry by construction. Every
    constructor raises ValueError for a negative mass or length, NaN, infinity, or a wrong shape.
    """

    @classmethod
    @abc.abstractmethod
    def _of_shape(cls, mass: Array, moments: Array, symmetry: Symmetry) -> Self:
        """The object for a mass and its central principal moments."""

    @classmethod
    def from_box(
        cls, mass: ArrayLike, sides: ArrayLike, inner_sides: ArrayLike | None = None
    ) -> Self:
        """A solid box of edge lengths ``sides`` (..., 3), or a closed box around a cavity.

        ``inner_sides`` (..., 3): edge lengths of a concentric empty box inside it.
        """
        if inner_sides is None:
            mass, a = _sized(mass, {"sides": sides}, core=(3,))
            x, y, z = (a[..., i] ** 2 / 12 for i in range(3))
            return cls._of_shape(mass, _of_second_moments(mass, x, y, z), Symmetry.NONE)
        lengths = {"sides": sides, "inner_sides": inner_sides}
        mass, a, b = _sized(mass, lengths, {"inner_sides": "sides"}, core=(3,))
        wall = a - b
        require_positive("the wall, max(sides - inner_sides),", numbers(wall).max(wall, axis=-1))
        squares = []
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            # a_i a_j a_k - b_i b_j b_k and a_i^3 a_j a_k - b_i^3 b_j b_k as sums of positive terms
            face = a[..., j] * a[..., k]
            face_wall = wall[..., j] * a[..., k] + b[..., j] * wall[..., k]
            volume = wall[..., i] * face + b[..., i] * face_wall
            cubes = a[..., i] ** 2 + a[..., i] * b[..., i] + b[..., i] ** 2
            second = wall[..., i] * cubes * face + b[..., i] ** 3 * face_wall
            squares.append(second / (12 * volume))
        return cls._of_shape(mass, _of_second_moments(mass, *squares), Symmetry.NONE)

    @classmethod
    def from_ellipsoid(cls, mass: ArrayLike, semi_axes: ArrayLike) -> Self:
        """A solid ellipsoid of semi-axes (..., 3)."""
        mass, a = _sized(mass, {"semi_axes": semi_axes}, core=(3,))
        moments = _of_second_moments(mass, *(a[..., i] ** 2 / 5 for i in range(3)))
        return cls._of_shape(mass, moments, Symmetry.NONE)

    @classmethod
    def from_sphere(cls, mass: ArrayLike, radius: ArrayLike, inner_radius: ArrayLike = 0.0) -> Self:
        """A solid ball, or a hollow ball with a concentric cavity of ``inner_radius`` (...)."""
        lengths = {"radius": radius, "inner_radius": inner_radius}
        mass, outer, inner = _sized(mass, lengths, _HOLLOW)
        q = inner / outer
        # (1 - q^5)/(1 - q^3), both divided by 1 - q
        ratio = (1 + q + q**2 + q**3 + q**4) / (1 + q + q**2)
        square = outer**2 * ratio / 5
        return cls._of_shape(
            mass, _of_second_moments(mass, square, square, square), Symmetry.SPHERICAL
        )

    @classmethod
    def from_shell(cls, mass: ArrayLike, radius: ArrayLike) -> Self:
        """A thin spherical shell."""
        return cls.from_sphere(mass, radius, radius)

    @classmethod
    def from_cylinder(
        cls, mass: ArrayLike, radius: ArrayLike, length: ArrayLike, inner_radius: ArrayLike = 0.0
    ) -> Self:
        """A cylinder along body z, solid or (``inner_radius``) a tube."""
        lengths = {"radius": radius, "length": length, "inner_radius": inner_radius}
        mass, radius, length, inner = _sized(mass, lengths, _HOLLOW)
        axial = (radius**2 + inner**2) / 2
        return cls._of_shape(
            mass, _axial(mass, axial / 2 + length**2 / 12, axial), Symmetry.AXISYMMETRIC
        )

    @classmethod
    def from_disc(cls, mass: ArrayLike, radius: ArrayLike, inner_radius: ArrayLike = 0.0) -> Self:
        """A flat disc or ring normal to body z, at the limit of physical bodies (Iz = Ix + Iy)."""
        lengths = {"radius": radius, "inner_radius": inner_radius}
        mass, radius, inner = _sized(mass, lengths, _HOLLOW)
        axial = (radius**2 + inner**2) / 2
        return cls._of_shape(mass, _axial(mass, axial / 2, axial), Symmetry.AXISYMMETRIC)

    @classmethod
    def from_rod(cls, mass: ArrayLike, length: ArrayLike, radius: ArrayLike = 0.0) -> Self:
        """A round rod along body z. A rod of radius 0 has a zero moment about its axis: use it only
        as a part of a composite body."""
        lengths = {"length": length, "radius": radius}
        mass, length, radius = _sized(mass, lengths, {"radius": None})
        axial = radius**2 / 2
        return cls._of_shape(
            mass, _axial(mass, axial / 2 + length**2 / 12, axial), Symmetry.AXISYMMETRIC
        )

    @classmethod
    def from_cone(cls, mass: ArrayLike, radius: ArrayLike, height: ArrayLike) -> Self:
        """A solid circular cone along body z, about its centre of mass.

        The centre of mass lies ``height / 4`` above the base.
        """
        mass, radius, height = _sized(mass, {"radius": radius, "height": height})
        axial = 3 * radius**2 / 10
        return cls._of_shape(
            mass, _axial(mass, axial / 2 + 3 * height**2 / 80, axial), Symmetry.AXISYMMETRIC
        )

    @classmethod
    def from_torus(cls, mass: ArrayLike, ring_radius: ArrayLike, tube_radius: ArrayLike) -> Self:
        """A solid torus around body z: tube centre at ``ring_radius``, tube of ``tube_radius``."""
        lengths = {"ring_radius": ring_radius, "tube_radius": tube_radius}
        mass, ring, tube = _sized(mass, lengths, {"tube_radius": "ring_radius"})
        moments = _axial(mass, ring**2 / 2 + 5 * tube**2 / 8, ring**2 + 3 * tube**2 / 4)
        return cls._of_shape(mass, moments, Symmetry.AXISYMMETRIC)


_HOLLOW = {"inner_radius": "radius"}


def _sized(
    mass: ArrayLike,
    lengths: Mapping[str, Any],
    inner: Mapping[str, str | None] | None = None,
    core: tuple[int, ...] = (),
) -> tuple[Array, ...]:
    """Mass and lengths (..., *core) as floats with common batch axes; ValueError for invalid ones.

    All must be positive, except those in ``inner``, which may be zero and must not exceed the
    length that ``inner`` names (None: no limit).
    """
    inner = inner or {}
    arrays = as_floats(mass=(mass, ()), **{name: (x, core) for name, x in lengths.items()})
    arrays_by_name = dict(zip(("mass", *lengths), arrays, strict=True))
    for name, array in arrays_by_name.items():
        require_positive(name, array, zero=name in inner)
    for name, outer in inner.items():
        if outer is not None:
            require_below(name, arrays_by_name[name], outer, arrays_by_name[outer])
    # concrete numbers as NumPy arrays, for which the formulas need no compilation
    some_strong = any(not x.weak_type for x in arrays)
    return tuple(on_host(x, weak=some_strong) for x in arrays)
