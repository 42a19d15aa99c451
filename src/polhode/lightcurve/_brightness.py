"""Magnitudes of bodies: scattering laws, phase functions, shapes, and the model of a fit."""

import math
from functools import partial
from typing import Any, ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode import rotation
from polhode._checks import ArrayLike, as_float_array
from polhode._closed_forms import free_motion, principal_periods
from polhode._closed_forms._free_constants import Triple
from polhode.inertia._mass import check_mesh

# Light scattered by a convex body, integrated over the surface that is both lit and visible.
#
# A surface element of area dA scatters ``mu mu0 / (mu + mu0) dA`` to the observer by the
# Lommel-Seeliger law, ``mu mu0 dA`` by Lambert's law; mu and mu0 are the cosines of emergence and
# incidence. Directions point from the body to the Sun and to the observer, in body axes.

Scalars = Float[Array, "*b"]


def _components(name: str, vector: Any) -> Triple:
    """The three components of a tuple, a list, or an array (..., 3)."""
    shape = (len(vector),) if isinstance(vector, (tuple, list)) else np.shape(vector)
    if shape[-1:] != (3,):
        raise ValueError(
            f"{name} must be an array (..., 3) or a tuple of three components, got shape {shape}."
        )
    x, y, z = vector if isinstance(vector, (tuple, list)) else jnp.unstack(vector, axis=-1)
    return x, y, z


def _dot(a: Triple, b: Triple) -> Scalars:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Triple, b: Triple) -> Triple:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def seeliger_ellipsoid(
    axes: Triple | Float[ArrayLike, "*b 3"],
    sun: Triple | Float[ArrayLike, "*b 3"],
    observer: Triple | Float[ArrayLike, "*b 3"],
) -> Scalars:
    """Lommel-Seeliger brightness of triaxial ellipsoids, in closed form.

    ``axes``: semi-axes along x, y, z; ``sun``, ``observer``: unit vectors in body axes; each an
    array (..., 3), or a tuple or list of the three components, which broadcast together. Scale:
    pi a^2 / 2 for a sphere at opposition. Raises ValueError for another number of components.
    Source: Muinonen & Lumme, Astron. Astrophys. 584 (2015) A23, here without angles: in coordinates
    in which the ellipsoid is a unit sphere, only squares of sines occur, so that value and
    derivatives are accurate at opposition too. Zero, with derivative zero, at a phase angle of pi.
    """
    a, b, c = _components("axes", axes)
    toward = tuple(x / y for x, y in zip(_components("sun", sun), (a, b, c)))
    away = tuple(x / y for x, y in zip(_components("observer", observer), (a, b, c)))
    lit2, seen2, product = _dot(toward, toward), _dot(away, away), _dot(toward, away)
    whole = tuple(x + y for x, y in zip(toward, away, strict=True))
    size2 = _dot(whole, whole)
    dark = size2 == 0
    size2 = jnp.where(dark, 1, size2)
    size = jnp.sqrt(size2)
    lit, visible = jnp.sqrt(lit2), jnp.sqrt(seen2)
    cosine_lit = (lit2 + product) / (lit * size)
    cosine_seen = (seen2 + product) / (visible * size)
    across = _cross(toward, away)
    # sin p sin q, with the angles p, q from the terminator and from the limb to the bisecting plane
    sines = _dot(across, across) / (lit * visible * size2)
    open_ = sines > 0
    inner = jnp.where(open_, sines, 1)
    ratio = inner / ((1 + cosine_lit) * (1 + cosine_seen))
    # x log x has an infinite derivative at x = 0, but ``sines`` is of second order there
    bend = jnp.where(open_, inner * jnp.log(jnp.where(dark, 1, ratio)), 0)
    total = cosine_lit + cosine_seen + bend
    return jnp.where(dark, 0, math.pi / 2 * a * b * c * lit * visible / size * total)


@jax.jit
def seeliger_sphere(alpha: Scalars) -> Scalars:
    """Lommel-Seeliger brightness of a sphere relative to opposition; ``alpha`` in [0, pi] [rad]."""
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
    """Brightness of convex bodies of plane facets, by a mixture of two scattering laws.

    ``normals``: outward unit vectors; ``areas`` of the facets, which may include their albedo. The
    sum of ``mu mu0 (seeliger / (mu + mu0) + lambert) area`` over the facets both lit and visible.
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


# Phase functions: brightness as a function of the phase angle, relative to opposition.


class AbstractPhase(eqx.Module):
    """A phase function; ``typical``: prior means of its coefficients."""

    typical: eqx.AbstractClassVar[tuple[float, ...]]

    def magnitudes(self, alpha: Scalars, coefficients: Float[Array, "*#b c"]) -> Scalars:
        """Magnitudes at phase angles ``alpha`` [rad], minus those at opposition."""
        raise NotImplementedError


class SeeligerPhase(AbstractPhase):
    """Phase function of a sphere with the Lommel-Seeliger law; no coefficients."""

    typical: ClassVar[tuple[float, ...]] = ()

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        return -2.5 * jnp.log10(seeliger_sphere(alpha))


class LinearPhase(AbstractPhase):
    """``beta alpha``, beta in magnitudes per degree; valid between about 5 and 70 degrees."""

    typical: ClassVar[tuple[float, ...]] = (0.033,)

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        return coefficients[..., 0] * alpha * (180 / math.pi)


class HG(AbstractPhase):
    """The H, G system of 1985; coefficient G. Bowell et al. 1989, Asteroids II, p. 524, eq. A4."""

    typical: ClassVar[tuple[float, ...]] = (0.15,)

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        slope = coefficients[..., 0]
        first, second = (_bowell(alpha, *k) for k in _BOWELL)
        return -2.5 * jnp.log10((1 - slope) * first + slope * second)


class HG1G2(AbstractPhase):
    """The H, G1, G2 system; coefficients G1, G2. Muinonen et al. 2010, Icarus 209, 542.

    Beyond 150 degrees, where the system is not defined, its splines are continued as a decreasing
    exponential with their last value and derivative.
    """

    typical: ClassVar[tuple[float, ...]] = (0.26, 0.38)

    def magnitudes(self, alpha: Array, coefficients: Array) -> Array:
        first, second = coefficients[..., 0], coefficients[..., 1]
        a, b, c = hg1g2_basis(alpha)
        return -2.5 * jnp.log10(first * a + second * b + (1 - first - second) * c)


_BOWELL = ((3.332, 0.631, 0.986), (1.862, 1.218, 0.238))


@partial(jax.jit, static_argnums=(1, 2, 3))  # outside jit too, one program for all operations
def _bowell(alpha, a, b, c):
    sine, tangent = jnp.sin(alpha), jnp.tan(alpha / 2)
    far = jnp.exp(-a * jnp.where(tangent > 0, tangent, 1) ** b)
    far = jnp.where(tangent > 0, far, 1)
    near = 1 - c * sine / (0.119 + 1.341 * sine - 0.754 * sine * sine)
    weight = jnp.exp(-90.56 * tangent * tangent)
    return weight * near + (1 - weight) * far


# Values and derivatives (per radian) at the knots: Muinonen et al. 2010, tables 3 and 4, with
# derivatives of the cubic splines for the printed end derivatives (Penttila et al. 2016, PSS 123,
# 117).
_KNOTS = np.radians([7.5, 30.0, 60.0, 90.0, 120.0, 150.0])
_FIRST = (
    (0.75, 0.33486016, 0.13410560, 0.051104756, 0.021465687, 0.0036396989),
    (-1.9098593, -0.55463432, -0.24404599, -0.094980438, -0.021411424, -0.091328612),
)
_SECOND = (
    (0.925, 0.62884169, 0.31755495, 0.12716367, 0.022373903, 0.00016505689),
    (-0.57295780, -0.76705367, -0.45665789, -0.28071809, -0.11173257, -8.6573138e-8),
)
_NEAR = np.radians([0.0, 0.3, 1.0, 2.0, 4.0, 8.0, 12.0, 20.0, 30.0])
_THIRD = (
    (
        1.0,
        0.83381185,
        0.57735424,
        0.42144772,
        0.23174230,
        0.10348178,
        0.061733473,
        0.016107006,
        0.0,
    ),
    (
        -0.10630097,
        -41.180439,
        -10.366915,
        -7.5784615,
        -3.6960950,
        -0.78605652,
        -0.46527012,
        -0.20459545,
        0.0,
    ),
)


def _spline(knots, table, alpha):
    """Cubic Hermite spline of a ``table`` (values, derivatives) at ``knots``."""
    dtype = alpha.dtype
    knots, values, slopes = (jnp.asarray(x, dtype) for x in (knots, *table))
    k = jnp.clip(jnp.searchsorted(knots, alpha, side="right") - 1, 0, knots.size - 2)
    width = knots[k + 1] - knots[k]
    t = jnp.clip((alpha - knots[k]) / width, 0, 1)
    rise = values[k + 1] - values[k]
    left, right = slopes[k] * width - rise, rise - slopes[k + 1] * width
    return values[k] + t * rise + t * (1 - t) * ((1 - t) * left + t * right)


@jax.jit
def hg1g2_basis(alpha: Scalars) -> tuple[Scalars, Scalars, Scalars]:
    """The three basis functions of the H, G1, G2 system at ``alpha`` [rad]."""
    out = []
    for table, slope in ((_FIRST, -6 / math.pi), (_SECOND, -9 / (5 * math.pi))):
        value = _spline(_KNOTS, table, alpha)
        last = table[0][-1]
        tail = last * jnp.exp(jnp.minimum(table[1][-1] / last * (alpha - _KNOTS[-1]), 0))
        value = jnp.where(alpha > _KNOTS[-1], tail, value)
        out.append(jnp.where(alpha < _KNOTS[0], 1 + slope * alpha, value))
    third = jnp.where(alpha < _NEAR[-1], _spline(_NEAR, _THIRD, alpha), 0)
    return out[0], out[1], third


# Convex bodies as facets: from a mesh, an ellipsoid, or spherical harmonics of the surface density.


class Convex(NamedTuple):
    """Facets of a convex body: outward ``normals`` (f, 3) and ``areas`` (..., f).

    The light of a convex body depends only on its surface area per solid angle of the normal (the
    Gaussian surface density, the inverse of the curvature), which the facets sample.
    """

    normals: Float[Array, "f 3"]
    areas: Float[Array, "*b f"]

    @classmethod
    def from_mesh(cls, vertices: ArrayLike, faces: ArrayLike) -> "Convex":
        """A closed triangle mesh (v, 3), (f, 3); shadows of the mesh on itself are neglected.

        Triangles without an area, such as between vertices on one line, have the normal zero.
        """
        vertices, faces = check_mesh(vertices, faces)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        across = jnp.cross(b - a, c - a)
        square = jnp.sum(across * across, axis=-1)
        has_area = square > 0
        size = jnp.sqrt(jnp.where(has_area, square, 1))
        return cls(across / size[:, None], jnp.where(has_area, size / 2, 0))

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
        The density is always positive. The surface closes, and such a body exists (Minkowski), if
        the sum of ``areas`` times ``normals`` vanishes: see `unclosed`.
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
        """|sum of areas times normals| over the total area; 0 for a closed surface."""
        rest = self.areas @ self.normals
        return jnp.sqrt(jnp.sum(rest * rest, axis=-1)) / jnp.sum(self.areas, axis=-1)

    def brightness(
        self,
        sun: ArrayLike,
        observer: ArrayLike,
        *,
        lambert: Array | float = 0.0,
        seeliger: Array | float = 1.0,
    ) -> Scalars:
        """Brightness for directions (..., 3) to ``sun`` and ``observer``: see `facets`.

        Both are unit vectors in body axes.

        Raises ValueError for vectors of another shape.
        """
        sun, observer = (
            as_float_array(name, vector, (3,), finite=False)
            for name, vector in (("sun", sun), ("observer", observer))
        )
        return facets(self.normals, self.areas, sun, observer, lambert, seeliger)


def _sphere(count: int):
    """``count`` directions (n, 3) evenly distributed on a spiral, and the solid angle of each."""
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


# Magnitudes of a torque-free ellipsoid from the unknowns of a fit, in batches, with exact
# derivatives.

# Unknowns besides the attitude: logarithms of the second and third semi-axis over the first, of
# the homogeneous ellipsoid of the same inertia (2) and of the visible shape (2); body rates (3);
# coefficients of the phase function; offsets. A step rotates the attitude by a rotation vector (3).
INERTIA, SHAPE, RATES, PHASE = slice(0, 2), slice(2, 4), slice(4, 7), 7


class Points(NamedTuple):
    """A light curve as the model needs it; rows (1, n), directions as component tuples."""

    t: Float[Array, "1 n"]
    sun: Triple
    observer: Triple
    alpha: Float[Array, "1 n"]
    sphere: Float[Array, "1 n"]  # magnitude of a sphere by the scattering law alone
    magnitude: Float[Array, "1 n"]
    weight: Float[Array, "1 n"]  # 1 / sigma^2; 0 for padding
    columns: Float[Array, "c n"]  # of the offsets
    stiffness: Float[Array, " c"]  # 1 / sigma^2 of the offsets' priors

    def without_offsets(self) -> "Points":
        """Without columns: one compiled program then serves every number of offsets."""
        none = jnp.zeros((0, self.t.shape[-1]), self.t.dtype)
        return self._replace(columns=none, stiffness=none[:, 0])


class Bodies(NamedTuple):
    """A batch of trial bodies: unknowns (b, u) and attitudes at t = 0 (b, 4)."""

    unknowns: Float[Array, "b u"]
    wxyz: Float[Array, "b 4"]


def moments_of(unknowns: Float[Array, "*b u"]) -> Triple:
    """Moments, up to scale: those of the homogeneous ellipsoid with axes 1, e^u0, e^u1."""
    y, z = jnp.exp(2 * unknowns[..., 0]), jnp.exp(2 * unknowns[..., 1])
    return y + z, 1 + z, 1 + y


def attitudes(unknowns: Float[Array, "b u"], wxyz: Float[Array, "b 4"], t: Float[Array, "1 n"]):
    """Quaternion components (b, n) of the torque-free motion at times ``t``."""
    omega = tuple(unknowns[:, k] for k in (4, 5, 6))
    start = tuple(wxyz[:, k] for k in range(4))
    return free_motion(moments_of(unknowns), start, omega, t, rates=False)[1]


def _to_body(q, vector: Triple) -> Triple:
    axis = tuple(-x for x in q[1:])
    twice = tuple(2 * x for x in _cross(axis, vector))
    again = _cross(axis, twice)
    return tuple(x + q[0] * y + z for x, y, z in zip(vector, twice, again, strict=True))


def _sample_magnitudes(
    phase: AbstractPhase, q, turn: Triple, shape, coefficients, points: Points
) -> Scalars:
    """Magnitudes without offsets. All arguments are per sample; ``turn``: a small rotation vector
    in space, which is zero and only carries derivatives."""
    sun, observer = (
        tuple(a - b for a, b in zip(v, _cross(turn, v), strict=True))
        for v in (points.sun, points.observer)
    )
    b, c = jnp.exp(shape[0]), jnp.exp(shape[1])
    light = seeliger_ellipsoid((jnp.ones_like(b), b, c), _to_body(q, sun), _to_body(q, observer))
    # relative to the sphere of the same volume
    light = jnp.maximum(light, 1e-12) / (jnp.pi / 2 * (b * c) ** (2 / 3))
    return -2.5 * jnp.log10(light) - points.sphere + phase.magnitudes(points.alpha, coefficients)


def magnitudes(phase: AbstractPhase, bodies: Bodies, points: Points) -> Float[Array, "b n"]:
    """Reduced magnitudes, without the offsets."""
    q = attitudes(*bodies, points.t)
    u, zero = bodies.unknowns[:, :, None], jnp.zeros(())
    many = len(phase.typical)
    coefficients = jnp.moveaxis(u[:, PHASE : PHASE + many], 1, -1)
    return _sample_magnitudes(
        phase, q, (zero, zero, zero), (u[:, 2], u[:, 3]), coefficients, points
    )


def magnitudes_and_derivatives(phase: AbstractPhase, bodies: Bodies, points: Points):
    """Magnitudes (b, n) and their derivatives (b, 10 + c, n), by the rotation vector (3) last.

    Forward mode through the motion for its five unknowns, reverse mode through the light.
    """
    u, wxyz = bodies
    count = u.shape[0]

    def motion_after(step):
        return attitudes(u.at[:, jnp.array([0, 1, 4, 5, 6])].add(step), wxyz, points.t)

    q, along = jax.linearize(motion_after, jnp.zeros(5, u.dtype))
    many = len(phase.typical)
    whole = (count, points.t.shape[1])

    def spread(x):
        return jnp.broadcast_to(x[:, None], whole)

    turn = tuple(jnp.zeros(whole, u.dtype) for _ in range(3))
    shape = tuple(spread(u[:, k]) for k in (2, 3))
    coefficients = jnp.broadcast_to(u[:, None, PHASE : PHASE + many], (*whole, many))

    def brightness_of(q, turn, shape, coefficients):
        return _sample_magnitudes(phase, q, turn, shape, coefficients, points)

    # The light of a sample depends on the quaternion of that sample only. One reverse pass with
    # unit cotangents therefore gives the derivatives by all arguments at every sample, and the
    # unknowns of the motion follow by the chain rule: 5 tangents of the closed form, not 10 + c of
    # the light.
    value, pull = jax.vjp(brightness_of, q, turn, shape, coefficients)
    by_q, by_turn, by_shape, by_coefficients = pull(jnp.ones(whole, u.dtype))
    # One tangent at a time in a loop: the program contains the motion once, and the samples remain
    # contiguous.
    turned = jax.lax.map(along, jnp.eye(5, dtype=u.dtype))
    motion = cast(Array, sum(a[None] * b for a, b in zip(by_q, turned, strict=True)))
    by_phase_function = [by_coefficients[..., k] for k in range(many)]
    return value, jnp.stack(
        [*motion[:2], *by_shape, *motion[2:], *by_phase_function, *by_turn], axis=1
    )


def _frequencies(unknowns):
    """Logarithms of f_phi and f_psi (2,), and the mode of one body."""
    periods = principal_periods(moments_of(unknowns), unknowns[RATES])
    return -jnp.log(jnp.stack([periods.P_phi, periods.P_psi])), periods.mode


def _with_corrected_rates(old, step):
    """``old + step`` of one body, with rates corrected so that its frequencies change linearly.

    The frequencies of the result are those of ``old`` plus their derivative along ``step``.
    """
    # The data determine the frequencies to a fraction of 1/span, and these are nonlinear in the
    # rates: an uncorrected step leaves the narrow, curved valley of good fits unless it is very
    # short. Two Newton corrections of the rates, each the minimum-norm solution of two equations in
    # three unknowns, return to the valley. They cost a few evaluations of the periods, none of the
    # light curve.
    (before, mode), (change, _) = jax.jvp(_frequencies, (old,), (step,))
    plain = old + step

    def correct(_, corrected):
        rates, near = corrected

        def residual(x):
            now, mode = _frequencies(plain.at[RATES].set(x))
            return now - before - change, (now - before - change, mode)

        slopes, (rest, now) = jax.jacfwd(residual, has_aux=True)(rates)
        # minimum-norm solution, by the explicit inverse of the 2 x 2 matrix J J^T
        a, b, c = (slopes[i] @ slopes[j] for i, j in ((0, 0), (0, 1), (1, 1)))
        weights = jnp.stack([c * rest[0] - b * rest[1], a * rest[1] - b * rest[0]]) / (
            a * c - b * b
        )
        return rates - weights @ slopes, near & (now == mode)

    rates, near = jax.lax.fori_loop(0, 2, correct, (plain[RATES], jnp.array(True)))
    change = rates - plain[RATES]
    near = near & (jnp.sum(change**2) < 0.1 * jnp.sum(plain[RATES] ** 2))  # false if not finite
    return plain.at[RATES].set(jnp.where(near, rates, plain[RATES]))


def apply_step(bodies: Bodies, step: Float[Array, "b u+3"]) -> Bodies:
    """The bodies after a step of the unknowns and a rotation in space (last three components).

    The rates are corrected so that the frequencies change linearly with the step: the cost of a
    long light curve has valleys that are narrow in the frequencies and curved in the rates.
    """
    turn = rotation.rotation_vector_to_wxyz(step[:, -3:])
    wxyz = rotation.normalise(rotation.multiply(turn, bodies.wxyz))
    return Bodies(jax.vmap(_with_corrected_rates)(bodies.unknowns, step[:, :-3]), wxyz)
