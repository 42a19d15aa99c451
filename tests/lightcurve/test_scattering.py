"""Brightness of ellipsoids, spheres and facets against integration over the surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull

import polhode as ph
from benchmarks import light_curves
from polhode import lightcurve

RNG = np.random.default_rng(19)


def _integrals(axes, sun, observer, n=500):
    """Lommel-Seeliger and Lambert brightness by quadrature over the surface."""
    z, weight = np.polynomial.legendre.leggauss(n)
    angle = (np.arange(2 * n) + 0.5) * np.pi / n
    across = np.sqrt(1 - z * z)
    unit = np.stack(
        [across[:, None] * np.cos(angle), across[:, None] * np.sin(angle), z[:, None] + 0 * angle],
        -1,
    )
    normal = unit / axes
    size = np.linalg.norm(normal, axis=-1)
    area = np.prod(axes) * size * weight[:, None] * np.pi / n
    incidence = np.maximum(normal @ sun / size, 0)
    emergence = np.maximum(normal @ observer / size, 0)
    total = np.where(incidence + emergence > 0, incidence + emergence, 1)
    product = incidence * emergence * area
    return (product / total).sum(), product.sum()


def _directions(alpha):
    sun, other = RNG.normal(size=(2, 3))
    sun = sun / np.linalg.norm(sun)
    other = np.cross(sun, other)
    other = other / np.linalg.norm(other)
    return sun, np.cos(alpha) * sun + np.sin(alpha) * other


ALPHAS = np.radians([0.0, 1e-5, 3.0, 40.0, 90.0, 140.0])
CASES = [(np.exp(0.5 * RNG.normal(size=3)), *_directions(alpha)) for alpha in ALPHAS]


@pytest.mark.parametrize("case", CASES)
def test_ellipsoid_against_integration(case):
    axes, sun, observer = case
    value = lightcurve.seeliger_ellipsoid(tuple(axes), tuple(sun), tuple(observer))
    assert value == pytest.approx(_integrals(axes, sun, observer)[0], rel=1e-4)


@pytest.mark.parametrize("case", CASES)
def test_derivatives_of_ellipsoid(case):
    """Also at opposition, where an angle would have a kink and its logarithm a pole."""
    whole = jnp.concatenate([jnp.asarray(x) for x in case])

    def value(x):
        return lightcurve.seeliger_ellipsoid(*(tuple(x[k : k + 3]) for k in (0, 3, 6)))

    slopes = jax.grad(value)(whole)
    step = 1e-4
    ends = np.array([[value(whole + s * step * e) for s in (-1, 1)] for e in np.eye(9)])
    measured = (ends[:, 1] - ends[:, 0]) / (2 * step)
    # near opposition the third derivative grows as the logarithm of the step
    np.testing.assert_allclose(slopes, measured, atol=2e-6)


def test_sphere_and_darkness():
    alpha = jnp.radians(jnp.array([0.0, 30.0, 120.0, 180.0]))
    one, zero = jnp.ones(4), jnp.zeros(4)
    sun, observer = (one, zero, zero), (jnp.cos(alpha), jnp.sin(alpha), zero)
    found = lightcurve.seeliger_ellipsoid((one, one, one), sun, observer) / (jnp.pi / 2)
    half = np.radians([30.0, 120.0]) / 2
    published = 1 - np.sin(half) * np.tan(half) * np.log(1 / np.tan(half / 2))
    np.testing.assert_allclose(found[1:3], published, rtol=1e-12)
    np.testing.assert_allclose(found[0], 1, rtol=1e-14)
    np.testing.assert_allclose(lightcurve.seeliger_sphere(alpha), found, atol=1e-12)
    rows = (jnp.stack(v, axis=-1) for v in (sun, observer))
    found_of_rows = lightcurve.seeliger_ellipsoid(np.ones(3), *rows) / (jnp.pi / 2)
    np.testing.assert_allclose(found_of_rows, found, rtol=1e-14)
    with pytest.raises(ValueError, match=r"sun must be an array \(..., 3\).*got shape \(3, 4\)"):
        lightcurve.seeliger_ellipsoid(np.ones(3), jnp.stack(sun), jnp.stack(observer))
    dark = jax.grad(
        lambda y: lightcurve.seeliger_ellipsoid((1.0, 0.7, y), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    )
    assert dark(0.5) == 0


def test_facets_of_ellipsoid_and_of_harmonics():
    axes, sun, observer = CASES[3]
    body = lightcurve.Convex.from_ellipsoid(axes, 4000)
    seeliger, lambert = _integrals(axes, sun, observer)
    found = body.brightness(jnp.asarray(sun), jnp.asarray(observer), lambert=0.3)
    assert found == pytest.approx(seeliger + 0.3 * lambert, rel=2e-3)
    assert body.unclosed < 1e-3
    # a body given by harmonics of its log density, fitted to those of the ellipsoid
    density = np.log(np.asarray(body.areas))
    basis = lightcurve.harmonics(body.normals, 8)
    coefficients = np.linalg.lstsq(
        np.asarray(basis).T, density - np.log(4 * np.pi / 4000), rcond=None
    )[0]
    again = lightcurve.Convex.from_harmonics(coefficients, 4000)
    other = again.brightness(list(sun), list(observer), lambert=0.3)
    assert other == pytest.approx(float(found), rel=0.02)


@pytest.mark.slow  # faster: of ellipsoids, test_fit
def test_derivatives_of_facets_through_motion_and_shape():
    """With respect to moments, rates, attitude, mesh vertices, and harmonics of the curvature."""
    moments, vertices, faces = light_curves.blunt(np.array([1.0, 0.7, 0.5]))
    ts = jnp.linspace(0.0, 5.0, 7)
    sun, observer = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.8, 0.0, 0.6])

    def light(x):
        stretch, inertia, omega, turn, coefficients = jnp.split(x, [3, 6, 9, 12])
        wxyz = ph.rotation.rotation_vector_to_wxyz(turn)
        scene = ph.Scene(ph.Inertia(moments * jnp.exp(inertia)))
        path = ph.simulate(scene, ph.State(wxyz, omega), ts)
        back = ph.rotation.conjugate(path.wxyz)
        bodies = (
            lightcurve.Convex.from_mesh(vertices * jnp.exp(stretch)[None], faces),
            lightcurve.Convex.from_harmonics(coefficients, 500),
        )
        lit, seen = (ph.rotation.rotate(back, v[None]) for v in (sun, observer))
        found = jnp.stack([body.brightness(lit, seen, lambert=0.2) for body in bodies])
        return found, found

    x = jnp.asarray(np.r_[np.zeros(6), 0.4, 1.1, -0.5, 0.3, -0.2, 0.9, 0.5, 0.2, -0.3, 0.1])
    light = jax.jit(jax.jacrev(light, has_aux=True))
    slopes, _ = light(x)
    step = 1e-6
    measured = np.stack(
        [(light(x + step * e)[1] - light(x - step * e)[1]) / (2 * step) for e in np.eye(16)], -1
    )
    # facets turn dark with a corner of theirs, which a difference may straddle
    np.testing.assert_allclose(slopes, measured, atol=1e-5 * np.abs(measured).max())
    # every one of them matters, and a body does not depend on the other's shape
    seen = np.abs(measured).max(1) > 1e-3
    np.testing.assert_array_equal(seen[0], np.arange(16) < 12)
    np.testing.assert_array_equal(seen[1], np.arange(16) >= 3)


def test_lambert_sphere_and_cube():
    alpha = np.radians(70.0)
    sun, observer = jnp.array([1.0, 0, 0]), jnp.array([np.cos(alpha), np.sin(alpha), 0])
    ball = lightcurve.Convex.from_ellipsoid(jnp.ones(3), 4000)
    found = ball.brightness(sun, observer, lambert=1.0, seeliger=0.0)
    law = 2 / 3 * (np.sin(alpha) + (np.pi - alpha) * np.cos(alpha))
    assert found == pytest.approx(law, rel=1e-3)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    cube = lightcurve.Convex.from_mesh(corners, faces)
    # only the face x = 1 is both lit and seen
    seen = np.cos(alpha) / (1 + np.cos(alpha))
    assert cube.brightness(sun, observer) == pytest.approx(seen)
    # an edge that is divided in one of its two faces, and the triangle without an area beside it
    divided = [f for f in faces.tolist() if f != [0, 1, 3]] + [[0, 8, 3], [8, 1, 3], [0, 1, 8]]
    split = lightcurve.Convex.from_mesh(np.vstack([corners, [[0, 0, 0.5]]]), np.array(divided))
    assert split.brightness(sun, observer) == pytest.approx(seen)


def test_harmonics_are_those_of_scipy():
    special = pytest.importorskip("scipy.special")
    directions = RNG.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    rows = lightcurve.harmonics(jnp.asarray(directions), 5)
    numbers = [(l, m) for l in range(6) for m in range(-l, l + 1)]
    for row, (l, m) in zip(rows, numbers, strict=True):
        value = special.sph_harm_y(l, abs(m), theta, phi) * (np.sqrt(2) * (-1) ** m if m else 1)
        np.testing.assert_allclose(row, value.imag if m < 0 else value.real, atol=1e-12)


def test_harmonics_need_a_square_number():
    with pytest.raises(ValueError, match=r"1, 4, 9, 16"):
        lightcurve.Convex.from_harmonics(jnp.zeros(5))


def _stone(rng, axes):
    """Hull of 60 points around an ellipsoid, in its principal axes: normals, areas, semi-axes."""
    corners = rng.normal(size=(60, 3))
    corners *= axes / np.linalg.norm(corners, axis=1, keepdims=True)
    return _faceted(corners * np.exp(0.12 * rng.normal(size=(60, 1))))


def _faceted(corners):
    hull = ConvexHull(corners)
    a, b, c = (corners[hull.simplices[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    faces = np.where(
        (np.sum(across * hull.equations[:, :3], axis=1) > 0)[:, None],
        hull.simplices,
        hull.simplices[:, ::-1],
    )
    whole = ph.MassProperties.from_mesh(corners, faces, density=1.0).central.full
    moments, turn = np.linalg.eigh(np.asarray(whole))
    areas = np.linalg.norm(across, axis=1) / 2
    return hull.equations[:, :3] @ turn, areas, np.sqrt(moments.sum() / 2 - moments)


@pytest.mark.slow
def test_what_ellipsoids_miss_of_other_bodies_grows_as_the_floor_does():
    """Error at larger phase angles of the ellipsoid that fits best below 30 degrees, for random
    bodies.
    """
    rng, many = np.random.default_rng(5), 150
    angles = np.radians([3.0, 25.0, 60.0, 90.0, 120.0])
    ellipsoid = jax.jit(
        lambda axes, s, o: lightcurve.seeliger_ellipsoid(tuple(axes), tuple(s), tuple(o))
    )
    missed = []
    for k in range(8):
        b = rng.uniform(0.35, 0.9)
        axes = np.array([1.0, b, b * rng.uniform(0.5, 0.95)])
        if k % 2:
            _, corners, _ = light_curves.blunt(axes, rng.uniform(2, 4), rng.uniform(0, 0.4))
            normals, areas, axes = _faceted(corners)
        else:
            normals, areas, axes = _stone(rng, axes)
        seen = []
        for alpha in angles:
            sun, across = rng.normal(size=(2, many, 3))
            across = np.cross(sun, across)
            sun, across = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (sun, across))
            observer = np.cos(alpha) * sun + np.sin(alpha) * across
            mu0, mu = np.maximum(sun @ normals.T, 0), np.maximum(observer @ normals.T, 0)
            light = (mu0 * mu / np.maximum(mu0 + mu, 1e-9)) @ areas
            seen.append((sun.T, observer.T, -2.5 * np.log10(light)))

        def rest(x, place, axes=axes, seen=seen):
            sun, observer, magnitude = seen[place]
            light = ellipsoid(axes * np.exp(np.r_[0.0, x]), sun, observer)
            rest = -2.5 * np.log10(light) - magnitude
            return rest - np.mean(rest)  # what is common to all is the phase function's

        best = least_squares(
            lambda x: np.concatenate([rest(x, 0), rest(x, 1)]), np.zeros(2), diff_step=1e-3
        ).x
        missed.append([np.std(rest(best, place)) for place in range(len(angles))])
    missed = np.sqrt(np.mean(np.square(missed), axis=0))
    sun = np.tile([1.0, 0.0, 0.0], (len(angles), 1))
    observer = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    repeated = (np.repeat(x, 2, axis=0) for x in (sun, observer))
    curve = lightcurve.LightCurve.of(np.arange(10.0), np.zeros(10), *repeated)
    floors = np.asarray(curve.points(1.0).weight)[0, :10:2] ** -0.5
    growth = missed / missed[0] / (floors / floors[0])
    assert np.all((growth > 0.6) & (growth < 1.6))
