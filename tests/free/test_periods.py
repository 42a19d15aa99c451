"""Periods of tumbling bodies against published values, mpmath and symmetric limits."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import polhode as ph
from polhode import Mode
from polhode._closed_forms import principal_periods

# Compiled once: eager dispatch would take much longer than the computation.
_periods = jax.jit(principal_periods)

TOUTATIS = (3.0836, 3.235, 1.0), np.deg2rad([14.51, 33.529, -98.709])  # rad per day


def test_toutatis():
    found = _periods(jnp.array(TOUTATIS[0]), jnp.asarray(TOUTATIS[1]))
    assert abs(float(found.P_psi) - 5.36853031) < 5e-9
    assert abs(float(found.P_phi) - 7.41165227) < 5e-9
    assert int(found.mode) == Mode.LAM


def test_halley():
    """Belton et al. 1991: axisymmetric, theta 66 deg, P_phi 3.69 d, P_psi 7.1 d."""
    theta, precession, spin = np.deg2rad(66.0), 2 * np.pi / 3.69, 2 * np.pi / 7.1
    axial = precession * np.cos(theta) + spin
    ratio = axial / (precession * np.cos(theta))  # largest over smallest moment
    omega = jnp.array([precession * np.sin(theta), 0.0, axial])
    found = _periods(jnp.array([ratio, ratio, 1.0]), omega)
    np.testing.assert_allclose(found.P_phi, 3.69, rtol=1e-14)
    np.testing.assert_allclose(found.P_psi, 7.1, rtol=1e-14)
    np.testing.assert_allclose([found.theta_min, found.theta_max], theta, rtol=1e-14)
    assert int(found.mode) == Mode.PROLATE
    assert abs(ratio - 2.2778) < 1e-4


@pytest.mark.parametrize("omega", [[0.3, 0.2, 1.0], [1.0, 0.1, 0.1]], ids=["SAM", "LAM"])
def test_precession_of_the_short_axis(omega):
    """Revolutions of the axis about the momentum, counted over whole periods of the rates."""
    body, state = ph.Inertia.from_moments([1.0, 2.0, 3.0]), ph.State([1.0, 0, 0, 0], omega)
    found = ph.periods(body, state)
    motion = ph.simulate(ph.Scene(body), state, np.linspace(0, 4 * float(found.P_psi), 401))
    axis = np.asarray(ph.rotation.wxyz_to_matrix(motion.wxyz))[..., 2]
    up = np.asarray(motion.momentum_space[0])
    across = np.cross(up, [0.3, 0.5, -0.8])
    azimuth = np.arctan2(axis @ np.cross(up, across) / np.linalg.norm(up), axis @ across)
    turns = np.ptp(np.unwrap(azimuth)[[0, -1]]) / (2 * np.pi)
    np.testing.assert_allclose(motion.ts[-1] / found.P_phi_short_axis, turns, rtol=1e-9)


def test_a_plate_wobbles_twice_as_fast_as_it_spins():
    disc = ph.periods(
        ph.Inertia.from_moments([1.0, 1.0, 2.0]), ph.State([1, 0, 0, 0], [1e-3, 0, 20.0])
    )
    np.testing.assert_allclose(disc.P_phi_short_axis, np.pi / 20, rtol=1e-6)


def _exact(I, w):
    """P_psi by mpmath's K; P_phi by the mean precession of the long axis over a period."""
    low, mid, high = sorted(range(3), key=lambda k: I[k])
    M2 = sum((a * b) ** 2 for a, b in zip(I, w, strict=True))
    E2 = sum(a * b * b for a, b in zip(I, w, strict=True))
    l, i, s = I[low], I[mid], I[high]
    short = E2 * i < M2
    above, below = (i - l) * (E2 * s - M2), (s - i) * (M2 - E2 * l)
    k2 = above / below if short else below / above
    rate = mp.sqrt((below if short else above) / (l * i * s))
    P = 4 * mp.ellipk(k2) / rate
    a, c = (low, high) if short else (high, low)
    first = (M2 - E2 * I[c]) / (I[a] * (I[a] - I[c]))
    second = (M2 - E2 * I[c]) / (i * (i - I[c]))
    third = (M2 - E2 * I[a]) / (I[c] * (I[c] - I[a]))

    def precession(u):
        sn, cn, dn = (mp.ellipfun(k, u, m=k2) for k in ("sn", "cn", "dn"))
        square = {a: first * cn**2, mid: second * sn**2, c: third * dn**2}
        above = i * square[mid] + s * square[high]
        return mp.sqrt(M2) * above / (i * i * square[mid] + s * s * square[high])

    mean = mp.quad(precession, mp.linspace(0, mp.ellipk(k2), 9)) / mp.ellipk(k2)
    return P, 2 * mp.pi / mean, k2, Mode.SAM if short else Mode.LAM


def _by_quadrature(moments, omega, digits=30):
    with mp.workdps(digits):
        *values, mode = _exact(*([mp.mpf(float(x)) for x in given] for given in (moments, omega)))
        return *map(float, values), mode


@pytest.mark.parametrize(
    ("moments", "omega"),
    [
        ((1.0, 2.0, 3.0), (0.3, 0.2, 1.0)),
        ((2.0, 3.0, 1.0), (0.3, 0.2, 1.0)),
        ((1.0, 2.0, 3.0), (0.95, 0.3, 0.6)),
        ((1.0, 2.0, 3.0), (1.0, 0.3, 0.575)),
        ((1.0, 1.001, 0.01), (0.3, 0.2, 5.0)),
        # a thin body far from a permanent rotation, for which the theta series converges slowest
        (
            (0.007142514668163261, 0.8252089701268291, 0.8320578071836973),
            (140.0067128258563, 0.0, 126.43734614976562),
        ),
        # 1 - k2 = 1e-14: the frequency needs all digits of a difference of products
        ((1.0, 2.0, 3.0), (1.1, 0.7, 1.1 / 3**0.5 * (1 + 1e-14))),
    ],
)
def test_against_quadrature(moments, omega):
    found = _periods(jnp.array(moments), jnp.array(omega))
    P_psi, P_phi, k2, mode = _by_quadrature(moments, omega)
    np.testing.assert_allclose(found.P_psi, P_psi, rtol=5e-15)
    np.testing.assert_allclose(found.P_phi, P_phi, rtol=2e-14)
    np.testing.assert_allclose(found.k2, k2, rtol=2e-14)
    assert int(found.mode) == mode


def test_modes_without_a_period():
    moments = jnp.array([[1.0, 1, 1], [1, 2, 3], [1, 2, 2.25], [1, 2, 2], [1, 1, 2]])
    omega = jnp.array([[0.3, 0.4, 0], [0, 0, 0], [0.75, 0.5, 1], [0, 0.6, 0.8], [0.6, 0.8, 0]])
    found = _periods(moments, omega)
    names = [Mode.SPHERICAL, Mode.AT_REST, Mode.SEPARATRIX, Mode.PROLATE, Mode.OBLATE]
    assert [Mode(int(m)) for m in found.mode] == names
    assert np.all(np.isinf(found.P_psi))
    length = np.linalg.norm(np.asarray(moments * omega), axis=-1)
    rates = np.array([length[0], 0, length[2] / 2, length[3] / 2, length[4]])
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(found.P_phi, 2 * np.pi / rates, rtol=4e-16)
    assert not np.any(np.isnan(np.stack([found.theta_min, found.theta_max])))


def _numbers(i, w, products):
    found = principal_periods(i, w, products)
    return jnp.stack([found.P_psi, found.P_phi, found.k2, found.theta_min, found.theta_max])


@jax.jit
def _jacobians(*given):
    return jax.jacfwd(_numbers, (0, 1, 2))(*given), jax.jacrev(_numbers, (0, 1, 2))(*given)


@pytest.mark.parametrize(
    "omega",
    [
        pytest.param((0.3, 0.2, 1.0), marks=pytest.mark.slow),
        (1.0, 0.2, 0.2),
        pytest.param((0.95, 0.3, 0.6), marks=pytest.mark.slow),
    ],
)
def test_derivatives(omega):
    moments, omega = np.array([1.0, 2.0, 3.0]), np.array(omega)

    given = jnp.asarray(moments), jnp.asarray(omega), jnp.zeros(3)
    forward, reverse = _jacobians(*given)
    np.testing.assert_allclose(np.hstack(forward), np.hstack(reverse), atol=1e-13)

    def exact(tensor, w):
        values, axes = np.linalg.eigh(tensor)
        return np.array(_by_quadrature(values, axes.T @ w, digits=18)[:3])

    step = 1e-5
    columns = []
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        change = np.zeros((3, 3))
        change[i, j] = change[j, i] = step
        up, down = exact(np.diag(moments) + change, omega), exact(np.diag(moments) - change, omega)
        columns.append((up - down) / (2 * step))
    found = np.hstack([forward[0], forward[2]])[:3]
    np.testing.assert_allclose(found, np.array(columns).T, rtol=1e-7, atol=1e-7)


@jax.jit
def _second(a, point, direction):
    def numbers(a):
        x = point + a * direction
        found = principal_periods(x[:3], x[3:])
        return jnp.stack([found.P_psi, found.P_phi, found.k2])

    return jax.jacfwd(jax.jacrev(numbers))(a)


@pytest.mark.parametrize("omega", [(0.3, 0.2, 1.0), (1.0, 0.2, 0.2)])
@pytest.mark.slow  # faster: derivatives of states, test_second_derivatives
def test_second_derivatives(omega):
    """Along a direction in moments and rates together, against differences of 50 digits."""
    point = np.array([1.0, 2.0, 3.0, *omega])
    direction = np.array([0.25, -0.5, 0.125, 0.75, -0.25, 0.5])

    def moved(a):
        x = [mp.mpf(p) + a * mp.mpf(d) for p, d in zip(point, direction, strict=True)]
        return x[:3], x[3:]

    with mp.workdps(50):
        step = mp.mpf(10) ** -12
        low, here, high = (_exact(*moved(k * step))[:3] for k in (-1, 0, 1))
        exact = [float((a - 2 * b + c) / step**2) for a, b, c in zip(low, here, high, strict=True)]
    np.testing.assert_allclose(_second(0.0, point, direction), exact, rtol=1e-13)


@pytest.mark.parametrize("off", [1e-4, -1e-9, 1e-13])
def test_derivatives_next_to_the_separatrix(off):
    """P_psi is logarithmic in the distance: against 50-digit differences of 4 K / rate."""
    moments, omega = (1.0, 2.0, 2.25), (0.75, 0.5, 1.0 + off)

    def exact(a, b, c, u, v, w):
        above = c * w * w * (c - b) - a * u * u * (b - a)
        outer = b * v * v * (b - a) + c * w * w * (c - a)
        inner = a * u * u * (c - a) + b * v * v * (c - b)
        square, share = (
            ((c - b) * outer, (b - a) * inner) if above > 0 else ((b - a) * inner, (c - b) * outer)
        )
        return 4 * mp.ellipk(share / square) / mp.sqrt(square / a / b / c)

    with mp.workdps(60):
        point = [mp.mpf(x) for x in (*moments, *omega)]
        slopes = []
        for k in range(6):
            ends = []
            for step in (mp.mpf(10) ** -25, -(mp.mpf(10) ** -25)):
                moved = list(point)
                moved[k] += step
                ends.append(exact(*moved))
            slopes.append(float((ends[0] - ends[1]) / mp.mpf(10) ** -25 / 2))
    forward, _ = _jacobians(jnp.array(moments), jnp.array(omega), jnp.zeros(3))
    found = np.concatenate([forward[0][0], forward[1][0]])
    np.testing.assert_allclose(found, slopes, rtol=1e-14, atol=1e-14 * max(map(abs, slopes)))


def test_derivatives_are_finite_in_the_limits():
    moments = jnp.array([[1.0, 1, 1], [1, 2, 3], [1, 1, 2], [1, 2, 2], [1, 2, 2.25]])
    omega = jnp.array([[0.3, 0.4, 0], [0, 0, 0], [0.3, 0.2, 1], [1, 0.1, 0.1], [0, 0, 1]])

    def finite(i, w):
        found = _periods(i, w)
        return jnp.where(jnp.isinf(found.P_psi), 0.0, found.P_psi).sum() + found.k2.sum()

    for part in jax.jit(jax.grad(finite, (0, 1)))(moments, omega):
        assert np.all(np.isfinite(part))


@pytest.mark.parametrize(
    ("moments", "omega"),
    [((1.5, 1.5, 1.5), (0.3, -0.4, 1.2)), ((1.0, 1.5, 2.0), (0.0, 1.3, 0.0))],
    ids=["sphere", "intermediate axis"],
)
def test_derivative_of_the_period_of_a_permanent_rotation(moments, omega):
    """P = 2 pi/|omega|, whose derivative along the axis is -2 pi omega/|omega|^3."""
    omega = jnp.array(omega)
    gradient = jax.jit(jax.grad(lambda w: principal_periods(jnp.array(moments), w).P_phi))(omega)
    size = float(jnp.linalg.norm(omega))
    found = float(gradient @ omega) / size
    np.testing.assert_allclose(found, -2 * np.pi / size**2, rtol=1e-13)


def test_mixed_dtypes_are_refused():
    single = ph.Inertia.from_moments(jnp.array([1.0, 1.5, 2.0], jnp.float32))
    state = ph.State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.3, 1.0, 0.2]))
    with pytest.raises(TypeError, match="inertia and state mix the dtypes"):
        ph.periods(single, state)


@jax.jit
def _derivatives_by_rates(moments, omega):
    """Forward and reverse, of each body with respect to its own rates: (5, N, 3)."""
    one = [jacobian(_numbers, 1) for jacobian in (jax.jacfwd, jax.jacrev)]
    return [jax.vmap(f, (0, 0, None), 1)(moments, omega, jnp.zeros(3)) for f in one]


def test_derivatives_at_rest_and_of_spheres_are_finite_in_both_modes():
    moments = jnp.array([[1.0, 2.0, 2.5], [1.0, 1.0, 1.5], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    omega = jnp.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0.5, 0.4, 0.8]])
    forward, reverse = _derivatives_by_rates(moments, omega)
    size = np.linalg.norm(omega[3])
    want = np.zeros((5, 4, 3))
    want[1, 3] = -2 * np.pi * omega[3] / size**3
    np.testing.assert_allclose(forward, want, rtol=0, atol=1e-14)
    np.testing.assert_allclose(reverse, want, rtol=0, atol=1e-14)
