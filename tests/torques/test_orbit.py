import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import polhode as ph
from polhode import HyperbolicOrbit, KeplerOrbit


def test_the_orbit_obeys_newton():
    orbit = KeplerOrbit([1.0, 2.5], 1.3, 0.4, 0.7, 0.3, 1.1, 0.2, 0.5)
    for t in (-3.0, 0.0, 2.0, 40.0):
        velocity = jax.jacfwd(orbit)
        place, push = orbit(t), jax.jacfwd(velocity)(t)
        pull = orbit.mu[:, None] * place / jnp.linalg.norm(place, axis=-1, keepdims=True) ** 3
        assert np.abs(np.array(push + pull)).max() < 1e-12
        speed = jnp.sum(velocity(t) ** 2, axis=-1)
        energy = speed / 2 - orbit.mu / jnp.linalg.norm(place, axis=-1)
        assert np.abs(np.array(energy + orbit.mu / (2 * 1.3))).max() < 1e-14
        normal = jnp.cross(place, velocity(t))
        pole = [np.sin(0.7) * np.sin(0.3), -np.sin(0.7) * np.cos(0.3), np.cos(0.7)]
        assert (
            np.abs(np.array(normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)) - pole).max()
            < 1e-14
        )


def test_an_orbit_by_place_and_velocity_is_the_same_one():
    """For any eccentricity and inclination, long before and after the epoch; both precisions."""
    for dtype, bound in ((jnp.float64, 2e-12), (jnp.float32, 2e-3)):
        e, tilt = (jnp.array(x, dtype) for x in ([0.0, 1e-9, 0.3, 0.95], [0.0, 1.0, jnp.pi, 0.4]))
        number = jnp.ones((), dtype)
        elements = KeplerOrbit(
            1.7 * number,
            1.3 * number,
            e,
            tilt,
            0.3 * number,
            1.1 * number,
            2.0 * number,
            0.5 * number,
        )
        t0 = 4.0 * number
        velocity = jax.jacfwd(elements)(t0)
        by_state = KeplerOrbit.from_state(1.7 * number, elements(t0), velocity, t0)
        for t in (-30.0, 0.0, 4.0, 7.5, 55.0):
            got, want = by_state(t * number), elements(t * number)
            assert got.dtype == dtype
            assert np.abs(np.array(got - want)).max() < bound / (1 - 0.95)


@pytest.mark.parametrize("radius", [pytest.param(6.9e6, marks=pytest.mark.slow), 4.2164e7])
def test_derivatives_by_the_size_of_an_orbit_in_single_precision(radius):
    """Fields decrease with the cube of the distance: derivatives -3 and 12 times the field."""
    for dtype, bound in ((jnp.float64, 1e-13), (jnp.float32, 1e-5)):
        place = jnp.array([0.6, -0.48, 0.64], dtype) * radius
        dipole = ph.DipoleField(jnp.array([1e22, 2e22, -7.8e22], dtype))
        body = ph.Inertia(jnp.array([1.0, 1.5, 2.0], dtype))
        wxyz, rates = jnp.array([0.5, 0.1, 0.7, 0.5], dtype), jnp.zeros(3, dtype)

        def turn(size, place=place, body=body, wxyz=wxyz, rates=rates):
            gradient = ph.GravityGradient(jnp.asarray(3.986e14, size.dtype), size * place)
            return ph.Scene(body, gradient).acceleration(wxyz, rates, 0.0)

        def field(size, place=place, dipole=dipole):
            return dipole(size * place, 0.0)

        one = jnp.ones((), dtype)
        for fn in (jax.jit(field), jax.jit(turn)):
            value = np.asarray(fn(one))
            assert value.dtype == dtype
            for mode in (jax.jacfwd, jax.jacrev):
                np.testing.assert_allclose(mode(fn)(one), -3 * value, rtol=bound)
            np.testing.assert_allclose(jax.jacfwd(jax.jacrev(fn))(one), 12 * value, rtol=bound)


def test_an_orbit_through_a_state_is_a_kepler_orbit():
    elements = KeplerOrbit(1.7, 1.3, 0.3, 0.7, 0.3, 1.1, 0.2, 0.5)
    place, velocity = elements(2.0), elements.velocity_at(2.0)
    orbit = KeplerOrbit.from_state(1.7, place, velocity, epoch=2.0)
    assert isinstance(orbit, KeplerOrbit)
    assert not hasattr(ph, "StateOrbit")
    assert orbit.semi_major_axis is None
    assert len(jax.tree.leaves(orbit)) == 4
    np.testing.assert_allclose(orbit.mean_motion, elements.mean_motion, rtol=1e-14)
    np.testing.assert_allclose(orbit.momentum, elements.momentum, rtol=1e-13)
    np.testing.assert_allclose(orbit(2.0 + orbit.period), place, rtol=1e-13)
    assert np.isinf(HyperbolicOrbit.from_state(1.7, place, 2 * velocity).period)

    for scale, kind in ((1.0, KeplerOrbit), (2.0, HyperbolicOrbit)):

        def later(scale, kind):
            return kind.from_state(1.7, place, scale * velocity, 2.0)(9.0)

        traced = jax.jit(jax.vmap(later, (0, None)), static_argnums=1)
        found = traced(jnp.array([scale, scale]), kind)
        np.testing.assert_allclose(found, jnp.stack([later(scale, kind)] * 2), rtol=1e-13)


@pytest.mark.parametrize("e", [0.0, 1e-8, 0.4, 0.9])
def test_slopes_of_an_orbit_by_state(e):
    """Against 50-digit differences; including a circle and an orbit in the reference plane."""
    mu, t = 1.7, 11.0
    place, velocity = [1.2, 0.0, 0.0], [0.0, float(np.sqrt(mu * (1 + e) / 1.2)), 0.0]

    def exact(given):
        with mp.workdps(50):
            r, v = mp.matrix(given[:3]), mp.matrix(given[3:])
            size = mp.norm(r)
            axis = 1 / (2 / size - (v.T * v)[0] / mpf(mu))
            n = mp.sqrt(mpf(mu) / axis**3)
            a, b = 1 - size / axis, (r.T * v)[0] / mp.sqrt(mpf(mu) * axis)
            x = mp.findroot(
                lambda x: x - a * mp.sin(x) + b * (1 - mp.cos(x)) - n * t, n * t, tol=1e-45
            )
            f = 1 - axis / size * (1 - mp.cos(x))
            g = (size / axis * mp.sin(x) + b * (1 - mp.cos(x))) / n
            return f * r + g * v

    def place_at(given):
        return KeplerOrbit.from_state(mu, given[:3], given[3:])(t)

    given = [*place, *velocity]
    got, slopes = place_at(jnp.array(given)), jax.jacfwd(place_at)(jnp.array(given))
    back = jax.jacrev(place_at)(jnp.array(given))
    want = exact([mpf(x) for x in given])
    assert max(abs(float(a) - float(b)) for a, b in zip(got, want)) < 1e-13 / (1 - e) ** 2
    for k in range(6):
        with mp.workdps(50):
            step = mpf(10) ** -20
            up, down = (
                [mpf(x) + s * step * (i == k) for i, x in enumerate(given)] for s in (1, -1)
            )
            slope = (exact(up) - exact(down)) / (2 * step)
        for i in range(3):
            scale = 1e-12 * max(1, abs(float(slope[i]))) / (1 - e) ** 3
            assert abs(float(slopes[i, k]) - float(slope[i])) < scale
            assert abs(float(back[i, k]) - float(slope[i])) < scale


def test_refused_orbits():
    with pytest.raises(ValueError, match=r"an ellipse, .* below 2, got 2\.: check the units"):
        KeplerOrbit.from_state(1.0, [2.0, 0, 0], [0, 1.0, 0])
    with pytest.raises(ValueError, match="straight to or from"):
        KeplerOrbit.from_state(1.0, [1.0, 0, 0], [0.5, 0, 0])
    with pytest.raises(ValueError, match="must have shape"):
        KeplerOrbit.from_state(1.0, [1.0, 0], [0.5, 0, 0])
    with pytest.raises(ValueError, match="eccentricity"):
        KeplerOrbit(1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="semi_major_axis"):
        KeplerOrbit(1.0, -1.0)


@pytest.mark.slow  # faster: librations of other bodies, test_published.py
def test_pitch_libration_on_a_circular_orbit():
    """theta'' = -3 n^2 (Ix - Iz)/Iy sin theta cos theta in the rotating frame of the orbit.

    Small librations, and their derivative with respect to the moments.
    """
    n, a = 0.5, 2.0
    orbit = KeplerOrbit(n**2 * a**3, a, inclination=np.pi / 2)  # normal: space -y
    small, t = 1e-5, 7.0

    def angle(moments):
        scene = ph.Scene(ph.Inertia.from_moments(moments), ph.GravityGradient(n**2 * a**3, orbit))
        # the body's z axis points along the radius (space x), tilted by a small angle about -y
        tilt = -(jnp.pi / 2) * -1 - small
        q = jnp.stack([jnp.cos(tilt / 2), 0 * tilt, jnp.sin(tilt / 2), 0 * tilt])
        state = ph.State(q, jnp.array([0.0, -n, 0.0]))
        got = ph.simulate(scene, state, jnp.array([0.0, t]), ph.LiePoisson(), rtol=1e-11)
        w, _, y, _ = got.wxyz[-1]
        turned = -2 * jnp.arctan2(y, w)  # about the normal
        return jnp.sin(turned - n * t + jnp.pi / 2)

    moments = jnp.array([2.0, 2.2, 1.0])
    value, slope = jax.jit(jax.value_and_grad(angle))(moments)

    def linear(i):
        return small * jnp.cos(jnp.sqrt(3 * (i[0] - i[2]) / i[1]) * n * t)

    want, want_slope = jax.value_and_grad(linear)(moments)
    assert abs(value - want) < 1e-8 * small + 2 * small**3 + 1e-11
    assert np.abs(np.array(slope - want_slope)).max() < 1e-3 * small


def test_times_that_do_not_broadcast_with_the_orbits_are_named():
    orbits = ph.KeplerOrbit(1.0, jnp.array([1.0, 2.0, 3.0]), 0.1)
    assert orbits(jnp.zeros(3)).shape == (3, 3)
    with pytest.raises(ValueError, match=r"KeplerOrbit: .*\(3,\).*; ts: \[\(5,\)\]"):
        orbits(jnp.zeros(5))
