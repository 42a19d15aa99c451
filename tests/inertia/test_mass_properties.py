"""Shapes against their defining integrals, points, composite bodies, log-Cholesky, flat bodies."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from polhode.inertia import (
    Inertia,
    MassProperties,
    compose,
    inertia_from_log_cholesky,
    inertia_to_log_cholesky,
    is_physical,
    physical_margin,
)
from polhode.rotation import axis_angle_to_wxyz, wxyz_to_matrix


def of_revolution(outer, inner, low, high):
    """Moments per mass, and height of the centre, of a solid of revolution, by quadrature."""
    with mp.workdps(25):
        volume = mp.quad(lambda z: outer(z) ** 2 - inner(z) ** 2, [low, high])
        height = mp.quad(lambda z: z * (outer(z) ** 2 - inner(z) ** 2), [low, high]) / volume
        zz = mp.quad(lambda z: z**2 * (outer(z) ** 2 - inner(z) ** 2), [low, high]) / volume
        xx = mp.quad(lambda z: (outer(z) ** 4 - inner(z) ** 4) / 4, [low, high]) / volume
        across = xx + zz - height**2
        return [float(across), float(across), float(2 * xx)], float(height)


def zero(z):
    return mp.mpf(0)


def ball(radius):
    return lambda z: mp.sqrt(max(mp.mpf(radius) ** 2 - z * z, 0))


SOLIDS = {
    "sphere": (Inertia.from_sphere, (1.3,), (ball(1.3), zero, -1.3, 1.3)),
    "cylinder": (Inertia.from_cylinder, (0.7, 1.9), (lambda z: mp.mpf("0.7"), zero, -0.95, 0.95)),
    "tube": (
        Inertia.from_cylinder,
        (0.7, 1.9, 0.4),
        (lambda z: mp.mpf("0.7"), lambda z: mp.mpf("0.4"), -0.95, 0.95),
    ),
    "rod": (Inertia.from_rod, (1.9, 0.01), (lambda z: mp.mpf("0.01"), zero, -0.95, 0.95)),
    "disc": (Inertia.from_disc, (0.8,), (lambda z: mp.mpf("0.8"), zero, -1e-12, 1e-12)),
    "ring": (
        Inertia.from_disc,
        (0.8, 0.5),
        (lambda z: mp.mpf("0.8"), lambda z: mp.mpf("0.5"), -1e-12, 1e-12),
    ),
    "cone": (Inertia.from_cone, (0.6, 1.4), (lambda z: (1.4 - z) / 1.4 * 0.6, zero, 0, 1.4)),
    "torus": (
        Inertia.from_torus,
        (1.1, 0.3),
        (lambda z: 1.1 + ball(0.3)(z), lambda z: 1.1 - ball(0.3)(z), -0.3, 0.3),
    ),
    "ellipsoid": (
        Inertia.from_ellipsoid,
        ([0.7, 0.7, 1.2],),
        (lambda z: ball(1.2)(z) * 0.7 / 1.2, zero, -1.2, 1.2),
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_of_revolution_against_their_integrals(name):
    build, arguments, profile = SOLIDS[name]
    moments, _ = of_revolution(*profile)
    np.testing.assert_allclose(build(2.5, *arguments).moments, 2.5 * np.array(moments), rtol=1e-14)


def test_centre_of_a_cone_is_where_it_says():
    assert abs(of_revolution(*SOLIDS["cone"][2])[1] - 1.4 / 4) < 1e-15


def box_moments(a, b):
    with mp.workdps(50):
        a, b = [mp.mpf(x) for x in a], [mp.mpf(x) for x in b]
        volume = mp.fprod(a) - mp.fprod(b)
        s = [
            (mp.fprod(a) * x * x - mp.fprod(b) * y * y) / (12 * volume)
            for x, y in zip(a, b, strict=True)
        ]
        return [float(s[1] + s[2]), float(s[2] + s[0]), float(s[0] + s[1])]


@pytest.mark.parametrize("wall", [1.0, 1e-3, 1e-9, 1e-15])
def test_hollow_bodies_keep_accuracy_down_to_thin_walls(wall):
    outer = np.array([1.0, 2.0, 3.0])
    inner = outer * (1 - wall)
    body = Inertia.from_box(3.0, outer, inner)
    np.testing.assert_allclose(body.moments, 3 * np.array(box_moments(outer, inner)), rtol=4e-15)
    r = 1.5 * (1 - wall)
    with mp.workdps(50):
        big, small = mp.mpf(1.5), mp.mpf(r)
        exact = float(3 * mp.mpf(2) / 5 * (big**5 - small**5) / (big**3 - small**3))
    np.testing.assert_allclose(Inertia.from_sphere(3.0, 1.5, r).moments, exact, rtol=4e-15)


def test_shell_and_solid_box():
    np.testing.assert_allclose(Inertia.from_shell(3.0, 2.0).moments, 8.0, rtol=1e-15)
    np.testing.assert_allclose(
        Inertia.from_box(12.0, [1, 2, 3]).moments, [13.0, 10.0, 5.0], rtol=1e-15
    )
    np.testing.assert_allclose(
        Inertia.from_ellipsoid(5.0, [1, 2, 3]).moments, [13.0, 10.0, 5.0], rtol=1e-15
    )


def test_gradient_with_respect_to_sizes():
    slope = jax.grad(lambda r: Inertia.from_sphere(1.0, 1.5, r).moments[0])(0.6)
    with mp.workdps(30):
        exact = mp.diff(
            lambda r: mp.mpf(2) / 5 * (mp.mpf("1.5") ** 5 - r**5) / (mp.mpf("1.5") ** 3 - r**3),
            mp.mpf("0.6"),
        )
    assert abs(slope - float(exact)) < 1e-14


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_shapes_are_batched_and_broadcast(dtype):
    body = Inertia.from_cylinder(jnp.ones((3, 1), dtype), 0.5, jnp.asarray([1.0, 2.0], dtype))
    assert body.moments.shape == (3, 2, 3)
    assert body.dtype == dtype
    assert Inertia.from_box([1.0, 2.0], [1, 1, 1]).moments.shape == (2, 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Inertia.from_box(-1, [1, 1, 1]), "mass must be positive"),
        (lambda: Inertia.from_box(1, [1, -1, 1]), "sides must be positive"),
        (lambda: Inertia.from_box(1, [1, 1, 1], [2, 1, 1]), "inner_sides must not exceed"),
        (lambda: Inertia.from_box(1, [1, 1, 1], [1, 1, 1]), "wall"),
        (lambda: Inertia.from_sphere(1, 0), "radius must be positive"),
        (lambda: Inertia.from_sphere(1, 1, 2), "inner_radius must not exceed"),
        (lambda: Inertia.from_cylinder(1, 1, 1, -1), "inner_radius must not be negative"),
        (lambda: Inertia.from_rod(1, 1), "thin line"),
        (lambda: Inertia.from_torus(1, 1, 2), "tube_radius must not exceed"),
        (lambda: Inertia.from_cone(1, 1, np.nan), "NaN"),
        (lambda: MassProperties.from_rod(1, 1).inertia, "thin line"),
        (lambda: compose([]), "at least one part"),
        (lambda: MassProperties.from_rod(1, 1) - MassProperties.from_rod(2, 1), "remains"),
        (lambda: MassProperties.from_sphere(1, 1).moved([0, 0]), "offset"),
        (lambda: MassProperties.from_sphere(1, 1).moved(wxyz=[0, 0, 0, 0]), "must not be zero"),
        (lambda: MassProperties.of(0, [0, 0, 0], Inertia.spherical(1)), "mass must be positive"),
    ],
)
def test_bad_sizes_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def cloud(seed, n=200):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 1, n), rng.normal(size=(n, 3)) * [1, 2, 3]


def brute(masses, points, about):
    d = points - about
    return np.einsum(
        "n,nij->ij",
        masses,
        np.einsum("n,ij->nij", (d**2).sum(1), np.eye(3)) - (d[:, :, None] * d[:, None, :]),
    )


def test_points_about_origin_and_about_their_centre():
    masses, points = cloud(0)
    centre = (masses @ points) / masses.sum()
    body = MassProperties.from_points(masses, points)
    np.testing.assert_allclose(body.mass, masses.sum(), rtol=1e-14)
    np.testing.assert_allclose(body.centre, centre, rtol=1e-13)
    np.testing.assert_allclose(body.inertia.tensor, brute(masses, points, centre), rtol=1e-12)
    np.testing.assert_allclose(
        Inertia.from_points(masses, points).tensor, brute(masses, points, 0), rtol=1e-12
    )
    at = np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(body.about(at).tensor, brute(masses, points, at), rtol=1e-12)


def test_points_batched_and_differentiable():
    masses, points = cloud(1, 12)
    batch = MassProperties.from_points(masses.reshape(3, 4), points.reshape(3, 4, 3))
    assert batch.inertia.tensor.shape == (3, 3, 3)
    one = MassProperties.from_points(masses[4:8], points[4:8])
    np.testing.assert_allclose(batch.central.tensor[1], one.central.tensor, rtol=1e-14)

    def probe(m, x):
        body = MassProperties.from_points(m, x)
        return body.central.tensor[0, 1] + body.central.tensor[2, 2]

    by_mass, by_place = jax.jit(jax.grad(probe, (0, 1)))(jnp.asarray(masses), jnp.asarray(points))
    # derivatives of sums about the centre of mass: the motion of the centre does not contribute
    centre = (masses @ points) / masses.sum()
    d = points - centre
    np.testing.assert_allclose(
        by_mass, -d[:, 0] * d[:, 1] + d[:, 0] ** 2 + d[:, 1] ** 2, rtol=1e-11
    )
    exact = masses[:, None] * np.stack(
        [2 * d[:, 0] - d[:, 1], 2 * d[:, 1] - d[:, 0], 0 * d[:, 2]], axis=1
    )
    np.testing.assert_allclose(by_place, exact, rtol=1e-11, atol=1e-12)


def test_composite_equals_the_cloud_of_all_points():
    (m1, x1), (m2, x2) = cloud(2), cloud(3)
    turn = np.array([0.3, -0.5, 0.2, 0.9])
    w, v = turn[0] / np.linalg.norm(turn), turn[1:] / np.linalg.norm(turn)
    shift = np.array([1.0, -2.0, 0.7])
    moved = x2 + 2 * w * np.cross(v, x2) + 2 * np.cross(v, np.cross(v, x2)) + shift
    whole = MassProperties.from_points(m1, x1) + MassProperties.from_points(m2, x2).moved(
        shift, turn
    )
    direct = MassProperties.from_points(np.r_[m1, m2], np.r_[x1, moved])
    np.testing.assert_allclose(whole.mass, direct.mass, rtol=1e-14)
    np.testing.assert_allclose(whole.centre, direct.centre, rtol=1e-12)
    np.testing.assert_allclose(whole.inertia.tensor, direct.inertia.tensor, rtol=1e-12, atol=1e-10)
    rest = whole - MassProperties.from_points(m1, x1)
    np.testing.assert_allclose(
        rest.inertia.tensor,
        MassProperties.from_points(m2, moved).inertia.tensor,
        rtol=1e-11,
        atol=1e-10,
    )


def test_dumbbell_of_thin_parts_by_hand():
    # two unit balls of radius 1/2 on the ends of a thin rod of mass 1 and length 2
    sphere, rod = MassProperties.from_sphere(1.0, 0.5), MassProperties.from_rod(1.0, 2.0)
    body = compose([rod, sphere.moved([0, 0, 1.0]), sphere.moved([0, 0, -1.0])])
    across = 1 / 3 + 2 * (0.1 + 1)
    np.testing.assert_allclose(body.inertia.tensor, np.diag([across, across, 0.2]), rtol=1e-14)
    assert float(body.mass) == 3.0


def test_log_cholesky_of_the_pseudo_inertia():
    rng = np.random.default_rng(4)
    parameters = rng.normal(size=(500, 10))
    body = MassProperties.from_log_cholesky(parameters)
    np.testing.assert_allclose(body.to_log_cholesky(), parameters, atol=1e-10)
    # eqs. 11-13 by matrix products: J = U U^T holds mass, first and second moments about origin
    a, d1, d2, d3, s12, s23, s13, t1, t2, t3 = parameters[0]
    upper = np.exp(a) * np.array(
        [[np.exp(d1), s12, s13, t1], [0, np.exp(d2), s23, t2], [0, 0, np.exp(d3), t3], [0, 0, 0, 1]]
    )
    pseudo = upper @ upper.T
    about_origin = np.trace(pseudo[:3, :3]) * np.eye(3) - pseudo[:3, :3]
    np.testing.assert_allclose(body.mass[0], pseudo[3, 3], rtol=1e-13)
    np.testing.assert_allclose(body.centre[0] * body.mass[0], pseudo[:3, 3], rtol=1e-13)
    np.testing.assert_allclose(body.about([0, 0, 0]).tensor[0], about_origin, rtol=1e-12)
    jacobian = jax.jacfwd(lambda p: MassProperties.from_log_cholesky(p).central.tensor)(
        jnp.zeros(10)
    )
    np.testing.assert_allclose(jacobian[..., 1], np.diag([0.0, 2.0, 2.0]), atol=1e-15)


@pytest.mark.parametrize("flat", [[1.0, 2.0, 3.0], [3.0, 1.0, 2.0], [2.0, 3.0, 1.0]])
def test_log_cholesky_of_a_flat_body_is_infinite_and_no_more(flat):
    tensor = jnp.diag(jnp.array(flat))
    parameters = inertia_to_log_cholesky(tensor)
    assert not jnp.any(jnp.isnan(parameters))
    assert jnp.sum(parameters == -jnp.inf) == 1
    np.testing.assert_allclose(inertia_from_log_cholesky(parameters), tensor, rtol=1e-14)
    several = Inertia.from_moments([flat, [1.0, 2.0, 2.5]])
    body = MassProperties.of(1.5, [0.1, 0.2, 0.3], several)
    parameters = body.to_log_cholesky()
    np.testing.assert_array_equal(jnp.sum(parameters == -jnp.inf, axis=-1), [1, 0])
    back = MassProperties.from_log_cholesky(parameters[1])
    np.testing.assert_allclose(back.central.tensor, several.tensor[1], rtol=1e-14)
    # rounding may make a square slightly negative; this body is still possible
    matrix = wxyz_to_matrix(axis_angle_to_wxyz([1 / 3, 2 / 3, 2 / 3], jnp.linspace(0.1, 3, 100)))
    turned = inertia_to_log_cholesky(jnp.einsum("nij,jk,nlk->nil", matrix, tensor, matrix))
    assert not jnp.any(jnp.isnan(turned))
    assert jnp.any(jnp.isnan(inertia_to_log_cholesky(jnp.diag(jnp.array([1.0, 2.0, 4.0])))))


def test_margin_is_the_distance_to_the_boundary():
    assert abs(float(physical_margin(jnp.diag(jnp.asarray([1.0, 2.0, 3.0]))))) < 1e-15
    assert float(physical_margin(jnp.diag(jnp.asarray([2.0, 2.0, 2.0])))) == 1
    # Sigma = diag(1.5, 1.5, -0.5) outside; diag(-1, -1, 2): two negative eigenvalues
    assert float(physical_margin(jnp.diag(jnp.asarray([1.0, 1.0, 3.0])))) == -0.5
    assert np.isclose(physical_margin(jnp.diag(jnp.asarray([1.0, 1.0, -2.0]))), -np.sqrt(2))
    inside, outside = (
        jnp.diag(jnp.asarray([1, 2, 3 - 1e-9])),
        jnp.diag(jnp.asarray([1, 2, 3 + 1e-9])),
    )
    assert bool(is_physical(inside))
    assert not bool(is_physical(outside))
    assert bool(is_physical(outside, slack=1e-8))
    for tensor, slope in ((inside, [0.5, 0.5, -0.5]), (outside, [0.5, 0.5, -0.5])):
        gradient = jax.grad(physical_margin)(tensor)
        np.testing.assert_allclose(np.diag(gradient), slope, atol=1e-12)
    assert np.isfinite(jax.grad(physical_margin)(jnp.eye(3))).all()
