"""Convex bodies by their facets: from a mesh, an ellipsoid, or harmonics of their curvature."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode.inertia._mass import check_mesh
from polhode.lightcurve._scattering import facets

Scalars = Float[Array, "*b"]


class Convex(NamedTuple):
    """Facets of a convex body: outward ``normals`` (f, 3) and ``areas`` (..., f).

    A convex body's light depends on its area per solid angle of normal only (its Gaussian surface
    density, one over the curvature), of which these are samples.
    """

    normals: Float[Array, "f 3"]
    areas: Float[Array, "*b f"]

    @classmethod
    def from_mesh(cls, vertices: ArrayLike, faces: ArrayLike) -> "Convex":
        """A closed triangle mesh (v, 3), (f, 3); what it hides from itself is not accounted for."""
        vertices, faces = check_mesh(vertices, faces)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        across = jnp.cross(b - a, c - a)
        size = jnp.sqrt(jnp.sum(across * across, axis=-1))
        return cls(across / size[:, None], size / 2)

    @classmethod
    def from_ellipsoid(cls, axes: Float[Array, "*b 3"], count: int = 1000) -> "Convex":
        """Ellipsoids of semi-axes (..., 3): density (abc)^2 / (n' diag(axes^2) n)^2."""
        axes = jnp.asarray(axes)
        normals, weight = _sphere(count)
        square = (axes**2) @ (normals**2).T
        return cls(normals, weight * jnp.prod(axes, axis=-1)[..., None] ** 2 / square**2)

    @classmethod
    def from_harmonics(cls, coefficients: Float[Array, "*b k"], count: int = 1000) -> "Convex":
        """Density exp(sum of coefficients times real spherical harmonics).

        ``coefficients`` (..., (l + 1)^2) in the order l = 0; 1, m = -1, 0, 1; ... of `harmonics`.
        Always positive; the surface closes, and a body exists (Minkowski), where the sum of
        ``areas`` times ``normals`` vanishes: `unclosed` measures that.
        """
        coefficients = jnp.asarray(coefficients)
        degree = math.isqrt(coefficients.shape[-1]) - 1
        if (degree + 1) ** 2 != coefficients.shape[-1]:
            raise ValueError(
                "coefficients must be (l + 1)^2 = 1, 4, 9, 16, ... numbers in the last axis, got"
                f" {coefficients.shape[-1]}."
            )
        normals, weight = _sphere(count)
        return cls(normals, weight * jnp.exp(coefficients @ harmonics(normals, degree)))

    @property
    def unclosed(self) -> Scalars:
        """|sum of areas times normals| over the whole area; 0 for a closed surface."""
        rest = self.areas @ self.normals
        return jnp.sqrt(jnp.sum(rest * rest, axis=-1)) / jnp.sum(self.areas, axis=-1)

    def brightness(
        self,
        sun: Array,
        observer: Array,
        *,
        lambert: Array | float = 0.0,
        seeliger: Array | float = 1.0,
    ) -> Scalars:
        """Of bodies lit and seen from directions (..., 3) in body axes: see `facets`."""
        return facets(self.normals, self.areas, sun, observer, lambert, seeliger)


def _sphere(count: int):
    """``count`` directions (n, 3) spread evenly on a spiral, and the solid angle of each."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - z * z)
    normals = np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)
    return jnp.asarray(normals), 4 * math.pi / count


def harmonics(directions: Float[Array, "n 3"], degree: int) -> Float[Array, "k n"]:
    """Real spherical harmonics of unit vectors, orthonormal on the sphere: ((degree + 1)^2, n)."""
    x, y, z = (directions[:, k] for k in range(3))
    # (x + i y)^m, and Legendre functions over sin^m by the usual recurrence in the degree
    real, imaginary = jnp.ones_like(z), jnp.zeros_like(z)
    rows: dict[tuple[int, int], Array] = {}
    start = jnp.ones_like(z) * math.sqrt(1 / (4 * math.pi))
    for m in range(degree + 1):
        if m > 0:
            real, imaginary = real * x - imaginary * y, real * y + imaginary * x
            start = start * math.sqrt((2 * m + 1) / (2 * m))
        below, now = jnp.zeros_like(z), start
        for l in range(m, degree + 1):
            root = math.sqrt(2) if m else 1.0
            rows[l, m] = root * now * real
            if m:
                rows[l, -m] = root * now * imaginary
            n = l + 1
            a = math.sqrt((4 * n * n - 1) / (n * n - m * m))
            b = (
                math.sqrt((2 * n + 1) * ((n - 1) ** 2 - m * m) / ((2 * n - 3) * (n * n - m * m)))
                if n - 1 > m
                else 0.0
            )
            below, now = now, a * z * now - b * below
    return jnp.stack([rows[l, m] for l in range(degree + 1) for m in range(-l, l + 1)])
