"""Light scattered by a convex body, integrated over what is both lit and seen.

A surface element of area dA sends ``mu mu0 / (mu + mu0) dA`` to the observer by the law of
Lommel and Seeliger, ``mu mu0 dA`` by Lambert's; mu and mu0 are the cosines of emergence and
incidence. Directions point from the body to the Sun and to the observer, in body axes.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode._closed_forms._free_motion import Triple

Scalars = Float[Array, "*b"]


def _dot(a: Triple, b: Triple) -> Scalars:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Triple, b: Triple) -> Triple:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def seeliger_ellipsoid(axes: Triple, sun: Triple, observer: Triple) -> Scalars:
    """Lommel-Seeliger brightness of triaxial ellipsoids, in closed form.

    ``axes``: semi-axes along x, y, z; ``sun``, ``observer``: unit vectors in body axes; tuples of
    component arrays that broadcast together. Scale: pi a^2 / 2 for a sphere at opposition.
    Source: Muinonen & Lumme, Astron. Astrophys. 584 (2015) A23, here without angles: in the space
    where the ellipsoid is a unit sphere only squares of sines occur, so that value and derivatives
    are right at opposition too. Zero, with derivative zero, at a phase angle of exactly pi.
    """
    a, b, c = axes
    toward = (sun[0] / a, sun[1] / b, sun[2] / c)
    away = (observer[0] / a, observer[1] / b, observer[2] / c)
    lit2, seen2, product = _dot(toward, toward), _dot(away, away), _dot(toward, away)
    whole = tuple(x + y for x, y in zip(toward, away, strict=True))
    size2 = _dot(whole, whole)
    dark = size2 == 0
    size2 = jnp.where(dark, 1, size2)
    size = jnp.sqrt(size2)
    lit, seen = jnp.sqrt(lit2), jnp.sqrt(seen2)
    cosine_lit = (lit2 + product) / (lit * size)
    cosine_seen = (seen2 + product) / (seen * size)
    across = _cross(toward, away)
    # sin p sin q of the two angles from the terminator and the limb to the bisecting plane
    sines = _dot(across, across) / (lit * seen * size2)
    open_ = sines > 0
    inner = jnp.where(open_, sines, 1)
    ratio = inner / ((1 + cosine_lit) * (1 + cosine_seen))
    # x log x: at x = 0 its slope is infinite, but sines is of second order there
    bend = jnp.where(open_, inner * jnp.log(jnp.where(dark, 1, ratio)), 0)
    total = cosine_lit + cosine_seen + bend
    return jnp.where(dark, 0, math.pi / 2 * a * b * c * lit * seen / size * total)


@jax.jit
def seeliger_sphere(alpha: Scalars) -> Scalars:
    """Lommel-Seeliger brightness of a sphere over that at opposition; ``alpha`` in [0, pi]."""
    half = alpha / 2
    quarter = jnp.where(half > 0, jnp.tan(half / 2), 1)
    below = jnp.where(half < math.pi / 2, half, 0)
    value = 1 + jnp.sin(below) * jnp.tan(below) * jnp.log(quarter)
    return jnp.where(half < math.pi / 2, value, 0)


def facets(
    normals: Float[Array, "f 3"],
    areas: Float[Array, "*#b f"],
    sun: Float[Array, "*#b 3"],
    observer: Float[Array, "*#b 3"],
    lambert: float | Scalars = 0.0,
    seeliger: float | Scalars = 1.0,
) -> Scalars:
    """Brightness of convex bodies of plane facets: ``seeliger`` and ``lambert`` parts of the laws.

    ``normals``: outward unit vectors; ``areas`` of the facets, in which their albedo may be
    included. The sum over the facets both lit and seen of
    ``mu mu0 (seeliger / (mu + mu0) + lambert) area``.
    """
    incidence = jnp.maximum(sun @ normals.T, 0)
    emergence = jnp.maximum(observer @ normals.T, 0)
    both = (incidence > 0) & (emergence > 0)
    divisor = jnp.where(both, incidence + emergence, 1)
    shape = jnp.broadcast_shapes(incidence.shape, emergence.shape, jnp.shape(areas))
    seeliger, lambert = (
        x if jnp.ndim(x) == 0 else jnp.asarray(x)[..., None] for x in (seeliger, lambert)
    )
    law = seeliger / divisor + lambert
    return jnp.sum(jnp.broadcast_to(areas, shape) * incidence * emergence * law, axis=-1)
