"""Kepler's equation against mpmath, for ellipses, hyperbolas and circles."""

from math import comb

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import polhode as ph

ECCENTRICITIES = (
    0.0,
    1e-12,
    1e-6,
    1e-3,
    0.1,
    0.5,
    0.9,
    0.99,
    0.999,
    1 - 1e-4,
    1 - 1e-6,
    1 + 1e-6,
    1 + 1e-4,
    1.5,
    5.0,
    100.0,
)
DECADES = [10.0**k for k in range(-12, 3)]
NEAR_PI = [np.nextafter(np.pi, 0), np.pi, np.nextafter(np.pi, 4), np.pi - 1e-9, np.pi + 1e-9]
TURNS = [2 * np.pi, 2000 * np.pi + 1e-5, 6e4, 1e6, 1e9]
POSITIVE = [*DECADES, 3e-5, 0.02, 0.4, 2.0, 3.1, *NEAR_PI, *TURNS]
ANOMALIES = [0.0, *POSITIVE, *(-x for x in POSITIVE)]


def anomaly(mean, e):
    """Eccentric or hyperbolic anomaly of two mpf numbers."""
    if mean < 0:
        return -anomaly(-mean, e)
    if e < 1:
        mean = mean - 2 * mp.pi * mp.nint(mean / (2 * mp.pi))
        sign, m = (-1 if mean < 0 else 1), abs(mean)
        x = min(m + e, m / (1 - e), mp.cbrt(12 * m))
        f, slope = lambda x: x - e * mp.sin(x) - m, lambda x: 1 - e * mp.cos(x)
    else:
        sign, m = 1, mean
        x = min(m / (e - 1), mp.cbrt(6 * m / e))
        x = min(x, mp.asinh((m + x) / e))
        f, slope = lambda x: e * mp.sinh(x) - x - m, lambda x: e * mp.cosh(x) - 1
    for _ in range(300):
        change = f(x) / slope(x)
        x -= change
        if abs(change) <= 1e15 * mp.eps * abs(x):
            return sign * x
    raise AssertionError((mean, e))


def exact(mean, e):
    """Position and velocity (each two mpf) in the plane of the orbit, for mu = |a| = 1."""
    mean, e = mpf(mean), mpf(e)
    x, axis = anomaly(mean, e), mp.sqrt(abs(1 - e * e))
    if e < 1:
        s, c, gone = mp.sin(x), mp.cos(x), 2 * mp.sin(x / 2) ** 2
        size = 1 - e + e * gone
        return (1 - e - gone, axis * s), (-s / size, axis * c / size)
    s, c, gone = mp.sinh(x), mp.cosh(x), 2 * mp.sinh(x / 2) ** 2
    size = e - 1 + e * gone
    return (e - 1 - gone, axis * s), (-s / size, axis * c / size)


def position(mean, e, hyperbolic):
    one = jnp.ones_like(e)
    kind = ph.HyperbolicOrbit if hyperbolic else ph.KeplerOrbit
    return kind(one, -one if hyperbolic else one, e)(mean)[:2]


def error(got, want):
    return mp.hypot(*(mpf(float(a)) - b for a, b in zip(got, want, strict=True)))


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("e", ECCENTRICITIES)
def test_positions(e, dtype):
    """To a few units in the last place of the distance and of the mean anomaly."""
    e, means = np.array(e, dtype), np.array(ANOMALIES, dtype)
    eps = float(np.finfo(dtype).eps)
    found = jax.vmap(lambda m: position(m, jnp.asarray(e), bool(e > 1)))(jnp.asarray(means))
    assert found.dtype == dtype
    with mp.workdps(50):
        for mean, got in zip(means, found):
            place, velocity = exact(float(mean), float(e))
            bound = eps * (mp.hypot(*place) + abs(mpf(float(mean))) * mp.hypot(*velocity))
            assert error(got, place) < 3 * bound, (e, mean)


def check_time_derivatives(e, means):
    """First and second derivatives, from Newton's law."""
    eps = float(np.finfo(float).eps)

    def velocity(m):
        return jax.jacfwd(position)(m, jnp.asarray(e), e > 1)

    means = np.array(means)
    first = jax.vmap(velocity)(jnp.array(means))
    second = jax.vmap(jax.jacrev(velocity))(jnp.array(means))
    with mp.workdps(50):
        for mean, v, a in zip(means, first, second):
            place, motion = exact(mean, e)
            distance, speed = mp.hypot(*place), mp.hypot(*motion)
            pull = [-x / distance**3 for x in place]
            shift = abs(mpf(mean))
            assert error(v, motion) < 8 * eps * (speed + shift / distance**2), (e, mean)
            scale = distance**-2 + speed**2 / distance + 4 * shift * speed / distance**3
            assert error(a, pull) < 16 * eps * scale, (e, mean)


@pytest.mark.parametrize("e", [0.0, 0.5, 1 - 1e-6, 1 + 1e-6, 5.0])
def test_derivatives_in_time(e):
    check_time_derivatives(e, [-1e-9, 1e-3, 0.4, np.pi, -20.0])


@pytest.mark.slow
@pytest.mark.parametrize("e", ECCENTRICITIES)
def test_all_derivatives_in_time(e):
    check_time_derivatives(e, ANOMALIES[1:-5])


@pytest.mark.parametrize(
    "e", [0.99, *(pytest.param(x, marks=pytest.mark.slow) for x in (0.1, 1.5))]
)
def test_derivatives_by_the_eccentricity(e):
    """Up to second order including mixed ones, and the third in the mean anomaly."""
    eps = float(np.finfo(float).eps)
    orders = [(0, 1), (1, 1), (0, 2), (3, 0)]
    means = [1e-6, -0.4, 2.0]

    def derivative(order):
        f = position
        for argument in (0,) * order[0] + (1,) * order[1]:
            f = jax.jacfwd(f, argument)
        return jax.vmap(lambda m: f(m, jnp.asarray(e), e > 1))(jnp.array(means))

    found = {order: derivative(order) for order in orders}

    def difference(mean, i, j):
        h = mpf(10) ** -14 * abs(1 - mpf(e)) ** 2 * min(1, abs(mpf(mean)))
        total = [mpf(0), mpf(0)]
        for k in range(i + 1):
            for n in range(j + 1):
                weight = (-1) ** (i - k + j - n) * comb(i, k) * comb(j, n)
                now = exact(mean + h * (2 * k - i) / 2, e + h * (2 * n - j) / 2)[0]
                total = [a + weight * b for a, b in zip(total, now)]
        return [x / h ** (i + j) for x in total]

    with mp.workdps(34 + 60):
        for k, mean in enumerate(means):
            size = {o: mp.hypot(*difference(mean, *o)) for o in [*orders, (2, 1), (1, 2), (0, 3)]}
            size[4, 0] = mp.hypot(*difference(mean, 4, 0))
            for i, j in orders:
                bound = (
                    size[i, j]
                    + abs(mpf(mean)) * size.get((i + 1, j), 0)
                    + mpf(e) * size.get((i, j + 1), 0)
                )
                loose = 200 if i == 3 else 10
                want = difference(mean, i, j)
                assert error(found[i, j][k], want) < loose * eps * bound, (mean, i, j)


def from_state(r, v, t, mu):
    """Position (2 mpf) on the conic through a state in the plane, by its elements."""
    r, v, mu, t = [mpf(x) for x in r], [mpf(x) for x in v], mpf(mu), mpf(t)
    distance, square = mp.hypot(*r), v[0] ** 2 + v[1] ** 2
    bound = 2 - distance * square / mu
    axis = distance / abs(bound)
    along = (r[0] * v[0] + r[1] * v[1]) / mp.sqrt(mu * axis)
    moment = r[0] * v[1] - r[1] * v[0]
    e = mp.sqrt(1 - (moment**2 / (mu * axis)) * (1 if bound > 0 else -1))
    n = mp.sqrt(mu / axis**3)
    if bound > 0:
        x = mp.atan2(along, 1 - bound)
        mean = x - e * mp.sin(x)
    else:
        x = mp.asinh(along / e)
        mean = e * mp.sinh(x) - x
    first, _ = exact(mean, e)
    later, _ = exact(mean + n * t, e)
    turn = mp.atan2(r[1], r[0]) - mp.atan2(first[1], first[0])
    c, s = mp.cos(turn), mp.sin(turn)
    return [axis * (c * later[0] - s * later[1]), axis * (s * later[0] + c * later[1])]


@pytest.mark.parametrize("e", [1e-12, 1e-3, 0.5, 0.99, 1 - 1e-6, 1 + 1e-6, 1.5, 100.0])
def test_orbits_by_a_state(e):
    """Errors relative to the effect of one unit in the last place of the state and the time."""
    mu, eps = 1.7, float(np.finfo(float).eps)
    starts = [0.0, 1e-3, -0.5, 2.0]
    times = [1e-9, -1e-3, 0.4, 3.0, -40.0]
    with mp.workdps(50):
        for start in starts:
            place, velocity = exact(start, e)
            speed = mp.sqrt(mpf(mu) / 2)
            r, v = ([float(scale * x) for x in y] for scale, y in ((2, place), (speed, velocity)))
            kind = ph.HyperbolicOrbit if e > 1 else ph.KeplerOrbit
            orbit = kind.from_state(mu, [*r, 0.0], [*v, 0.0])
            for t, got in zip(times, jax.vmap(orbit)(jnp.array(times))):
                given = [*r, *v, t, mu]

                def moved(k, given=given):
                    step = abs(mpf(given[k])) * mpf(10) ** -20
                    if not step:
                        return mpf(0)
                    up, down = (
                        [x + sign * step * (i == k) for i, x in enumerate(map(mpf, given))]
                        for sign in (1, -1)
                    )
                    a, b = (from_state(y[:2], y[2:4], y[4], y[5]) for y in (up, down))
                    return mp.hypot(*(p - q for p, q in zip(a, b))) * abs(mpf(given[k])) / step / 2

                want = from_state(r, v, t, mu)
                bound = eps * (mp.hypot(*want) + sum(moved(k) for k in range(6)))
                assert error(got[:2], want) < 25 * bound, (start, t)


@pytest.mark.slow
def test_a_circle_by_construction():
    """Without an eccentricity: the same position as at eccentricity 0, and the same derivatives."""
    t = 7.3
    elements = (1.3, 2.1, 0.7, 0.3, 1.1, 0.2, 0.5)

    def circle(given):
        mu, axis, *angles = given
        return ph.KeplerOrbit(mu, axis, None, *angles)(t)

    def ellipse(given):
        mu, axis, *angles = given
        return ph.KeplerOrbit(mu, axis, 0.0, *angles)(t)

    given = jnp.array(elements)
    for f in (lambda f: f, jax.jacrev, lambda f: jax.jacfwd(jax.jacrev(f))):
        a, b = f(circle)(given), f(ellipse)(given)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14 * float(jnp.abs(b).max()))
    plain = ph.KeplerOrbit(1.3, 2.1, inclination=0.7)
    assert plain.eccentricity is None
    assert ph.KeplerOrbit(1.3, 2.1, 0.0).eccentricity is not None
    np.testing.assert_allclose(
        plain.velocity_at(t), ph.KeplerOrbit(1.3, 2.1, 0.0, 0.7).velocity_at(t)
    )
    np.testing.assert_allclose(
        plain.momentum, jnp.cross(plain(t), plain.velocity_at(t)), rtol=1e-14, atol=1e-15
    )
    with pytest.raises(ValueError, match="needs an eccentricity"):
        ph.HyperbolicOrbit(1.3, -2.1)
    with pytest.raises(ValueError, match="semi_major_axis must be positive"):
        ph.KeplerOrbit(1.3, -2.1)


@pytest.mark.slow
def test_batches_and_edits_of_circles():
    axes, t = jnp.array([2.0, 3.0]), 1.7
    circles = ph.KeplerOrbit(1.0, axes)
    want = jnp.stack([ph.KeplerOrbit(1.0, a, 0.0)(t) for a in axes])
    np.testing.assert_allclose(circles(t), want, atol=1e-15)
    np.testing.assert_allclose(
        jax.vmap(lambda a: ph.KeplerOrbit(1.0, a)(t))(axes), want, atol=1e-15
    )
    np.testing.assert_allclose(eqx.filter_jit(lambda o: o(t))(circles), want, atol=1e-15)
    moved = eqx.tree_at(lambda o: o.semi_major_axis, circles, axes + 1)
    np.testing.assert_allclose(moved(t), ph.KeplerOrbit(1.0, axes + 1)(t))
    bent = eqx.tree_at(
        lambda o: o.eccentricity, circles, jnp.array(0.3), is_leaf=lambda x: x is None
    )
    np.testing.assert_allclose(bent(t), ph.KeplerOrbit(1.0, axes, 0.3)(t))
    bodies = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    state = ph.State([1.0, 0, 0, 0], [0.1, 0.3, 0.2])
    ends = [
        ph.simulate(ph.Scene(bodies, ph.GravityGradient(1.0, orbit)), state, [0.0, 5.0]).wxyz[
            ..., -1, :
        ]
        for orbit in (circles, ph.KeplerOrbit(1.0, axes, 0.0))
    ]
    assert ends[0].shape == (2, 4)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
    scene = ph.Scene(bodies, ph.GravityGradient(1.0, ph.KeplerOrbit(1.0, 2.0)))
    other = ph.Scene(bodies, ph.GravityGradient(1.0, ph.KeplerOrbit(1.0, 2.0, 0.1)))
    told = [str(ph.explain(x, state, [0.0, 5.0])) for x in (scene, other)]
    assert told[0] == told[1]
