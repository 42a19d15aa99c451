"""Tables over time, drag, sunlight and shadow against NumPy and SciPy."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

import polhode as ph
from polhode._hamiltonian import components
from polhode._hamiltonian._energy import from_quaternion

TIMES = np.array([0.0, 4.0, 9.0, 15.0, 20.0, 26.0, 30.0, 34.0, 41.0, 45.0, 50.0, 55.0, 60.0])
MOMENTS = np.array([0.15, 0.185, 0.063])
AREAS = np.array([0.02, 0.02, 0.05, 0.06])
NORMALS = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0.2], [0, -0.3, -1.0]])
CENTRES = np.array([[0.1, 0.02, 0], [-0.1, 0, 0.01], [0, 0.15, 0.05], [0.03, -0.1, -0.1]])
VELOCITY, DIPOLE, RADIUS, LIGHT = np.array([7.6, 1.0, 0]), np.array([3.0, 1.0, -2.0]), 5.0, 1e-3
START = [0.7, 0.1, -0.5, 0.5], [0.2, -0.1, 0.3]
PATH = (np.array([-10.0, 3.0, 0]), np.array([0.3, 0.0, 0.0]))  # leaves the shadow at 33.3 s


def field(t):
    return np.stack([2e-5 * np.cos(0.1 * t), 3e-5 * np.sin(0.13 * t), 1e-5 + 0 * t], -1)


def density(t):
    return 1e-6 * (1 + 0.5 * np.sin(0.2 * t))


def sun(t):
    return np.stack([np.cos(0.05 * t), np.sin(0.05 * t), 0.3 + 0 * t], -1)


def test_cubic_tables_are_those_of_scipy_and_of_fourth_order():
    rng = np.random.default_rng(3)
    t, q = np.sort(rng.uniform(0, 10, 40)), np.linspace(0.5, 9.5, 201)
    slopes = np.stack([-2e-6 * np.sin(0.1 * t), 3.9e-6 * np.cos(0.13 * t), 0 * t], -1)
    known = ph.Table(t, field(t), derivatives=slopes)
    want = CubicHermiteSpline(t, field(t), slopes)(q)
    np.testing.assert_allclose(known(q), want, rtol=0, atol=1e-19)
    errors = []
    for n in (41, 81):
        grid = np.linspace(0, 60, n)
        errors.append(np.abs(ph.Table(grid, sun(grid))(q) - sun(q)).max())
    assert 12 < errors[0] / errors[1] < 40
    quartic = np.linspace(-1, 2, 9) ** 4  # the derivatives of a quartic are exact
    want = 4 * np.linspace(-1, 2, 9) ** 3
    np.testing.assert_allclose(
        ph.Table(np.linspace(-1, 2, 9), quartic).derivatives[:, 0], want, atol=1e-12
    )


def test_linear_tables_are_those_of_numpy_and_continue_their_ends():
    q = np.linspace(0, 60, 301)
    table = ph.Table(TIMES, density(TIMES), order=1)
    np.testing.assert_allclose(table(q), np.interp(q, TIMES, density(TIMES)), rtol=1e-14)
    slope = (density(4.0) - density(0.0)) / 4
    np.testing.assert_allclose(table(-2.0), density(0.0) - 2 * slope, rtol=1e-14)


@pytest.mark.parametrize("order", [1, 3])
def test_a_batch_of_tables_and_one_precision(order):
    values = np.stack([field(TIMES), 2 * field(TIMES)]).astype(np.float32)
    table = ph.Table(TIMES, values, order)
    assert table(jnp.float32(3.0)).dtype == np.float32
    assert table(1.0).shape == (2, 3)
    each = [ph.Table(TIMES, values[k], order)(7.0) for k in range(2)]
    np.testing.assert_array_equal(table(7.0), np.stack(each))
    rows = table(jnp.array([[7.0], [7.0]]))  # a column of times against the bodies
    np.testing.assert_array_equal(rows[0], table(7.0))


@pytest.mark.parametrize("batched", ["values", "derivatives"])
def test_values_and_derivatives_have_common_batch_axes(batched):
    slopes = np.stack([np.cos(TIMES), TIMES, 0 * TIMES], -1)
    given = {"values": sun(TIMES), "derivatives": slopes}
    two = given | {batched: np.stack([given[batched], 2 * given[batched]])}
    table = ph.Table(TIMES, **two)
    assert table.values.shape == table.derivatives.shape == (2, TIMES.size, 3)
    for i in range(2):
        one = ph.Table(TIMES, **(given | {batched: two[batched][i]}))
        np.testing.assert_array_equal(table(7.0)[i], one(7.0))
    with pytest.raises(ValueError, match="derivatives"):
        ph.Table(TIMES, np.ones((2, 13, 3)), derivatives=np.ones((3, 13, 3)))


def test_kinks_of_tables_end_steps():
    """Between the knots the torque is a polynomial, for which steps of high order are exact; a jump
    of the second derivative within a step would cause errors up to several hundred rtol without a
    warning. A linear table about x, a cubic one with other knots about z.
    """
    values, slopes = np.array([[0.0, 1.0, -2.0, 3.0, 3.0], [1.0, -3.0, 2.0, 0.0, 4.0]])
    times = np.array([0.0, 1.0, 1.7, 3.1, 4.0])
    axes = np.eye(3)[[0, 2]]
    linear = ph.Table(4 - times[::-1], values[:, None] * axes[0], 1)
    cubic = ph.Table(times, values[:, None] * axes[1], 3, slopes[:, None] * axes[1])
    torque = ph.BodyTorque(linear) + ph.BodyTorque(cubic)
    scene = ph.Scene(ph.Inertia.spherical(2.0), torque=torque)
    state = ph.State([1.0, 0, 0, 0], [0.0, 0, 0.5])
    assert "2 switches" in str(ph.explain(scene, state, [0.0, 4.0]))
    end = ph.simulate(scene, state, [0.0, 4.0], rtol=1e-5).omega_body[-1]
    of_linear = np.trapezoid(values, 4 - times[::-1])
    of_cubic = np.trapezoid(values, times) - np.sum(np.diff(times) ** 2 * np.diff(slopes)) / 12
    np.testing.assert_allclose(end, [of_linear / 2, 0, 0.5 + of_cubic / 2], rtol=0, atol=1e-13)


def test_dense_cubic_tables_have_no_kinks_and_do_not_end_steps():
    times = np.linspace(0.0, 6.0, 1001)
    torque = np.stack([np.sin(times), np.cos(times), 0 * times], -1)
    state = ph.State([1.0, 0, 0, 0], [0.0, 0, 0.5])
    body = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    rough = torque + 0.01 * np.random.default_rng(0).normal(size=torque.shape)
    for values, many in ((torque, False), (rough, True)):
        scene = ph.Scene(body, torque=ph.BodyTorque(ph.Table(times, values)))
        found = ph.simulate(scene, state, [0.5, 2.5], rtol=1e-7)
        assert (int(found.steps) > 300) == many


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"times": [0.0, 2.0, 1.0], "values": [1.0, 2, 3]}, "ascend"),
        ({"times": [0.0, 1.0], "values": [1.0, 2, 3]}, "shape"),
        ({"times": [0.0, 1.0], "values": [[1.0, 2], [3, 4]]}, "kind"),
        ({"times": [0.0], "values": [1.0]}, "two or more"),
        ({"times": [0.0, 1.0], "values": [1.0, 2], "order": 2}, "order"),
        ({"times": [0.0, 1.0], "values": [1.0, 2], "order": 1, "derivatives": [0.0, 0]}, "order=3"),
        ({"times": [0.0, 1.0], "values": [1.0, 2], "derivatives": [0.0, 0, 0]}, "derivatives"),
        ({"times": [0.0, 1.0], "values": [1.0, 2], "kind": "scalar"}, "kind"),
    ],
)
def test_tables_that_are_none_are_refused(given, match):
    with pytest.raises(ValueError, match=match):
        ph.Table(**given)


NUMBERS = ph.Table([0.0, 1.0, 5.0], [1.0, 2.0, 3.0])
VECTORS = ph.Table([0.0, 1.0, 5.0], [[1.0, 0.0, 0.0]] * 3, kind="vector")
TWO = ph.Table([0.0, 1.0, 5.0], [[1.0, 0.0]] * 3)


@pytest.mark.parametrize(
    ("make", "wanted"),
    [
        (lambda plates: ph.Drag(plates, 1e-9, NUMBERS), "Drag velocity takes a Table of vectors"),
        (lambda plates: ph.Drag(plates, VECTORS, VELOCITY), "Drag density takes a Table of numb"),
        (lambda plates: ph.SolarPressure(plates, NUMBERS), "vectors of 3, got one of numbers"),
        (lambda plates: ph.SolarPressure(plates, VELOCITY, VECTORS), "numbers, got one of vectors"),
        (lambda _: ph.ControlMomentGyro(1.0, [0, 0, 1], [1, 0, 0], VECTORS), "angle takes a Table"),
        (lambda _: ph.BodyTorque(TWO), "vectors of 3, got one of vectors of 2"),
        (lambda _: ph.MagneticDipole([1.0, 0, 0], NUMBERS), "field takes a Table of vectors of 3"),
        (lambda plates: ph.SolarPressure(plates, [0.0, 0, 0]), "direction must not be zero"),
        (lambda _: ph.Eclipse([7e6, 0, 0], [0.0, 0, 0]), "direction must not be zero"),
        (lambda _: ph.Plates(AREAS[:0], NORMALS[:0], CENTRES[:0]), "one plate at least"),
        (lambda _: ph.BDot(4e4, max_moment=-0.2), "max_moment must be positive"),
    ],
)
def test_a_part_of_another_kind_is_refused_where_it_is_made(make, wanted):
    with pytest.raises(ValueError, match=wanted):
        make(ph.Plates(AREAS, NORMALS, CENTRES))


def test_plates_that_are_none_are_refused():
    faces = ph.Plates(AREAS, NORMALS, CENTRES)
    for wrong in (
        (-AREAS, NORMALS, CENTRES),
        (AREAS, 0 * NORMALS, CENTRES),
        (AREAS[:2], NORMALS, CENTRES),
    ):
        with pytest.raises(ValueError, match="Plates"):
            ph.Plates(*wrong)
    with pytest.raises(TypeError, match="Plates"):
        ph.Drag(AREAS, 1.0, VELOCITY)
    with pytest.raises(ValueError, match="not exceed 1"):
        ph.SolarPressure(faces, [1.0, 0, 0], specular=0.7, diffuse=0.4)
    with pytest.raises(ValueError, match="density"):
        ph.Drag(faces, -1.0, VELOCITY)


def matrix(q):
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


def lit_by_hand(t):
    r = PATH[0] + PATH[1] * t
    return float(r[0] > 0 or np.hypot(r[1], r[2]) > RADIUS)


def torques_by_hand(t, R, rho, s):
    """Drag and sunlight from their formulas, plate by plate."""
    v, s = R.T @ VELOCITY, R.T @ (s / np.linalg.norm(s))
    total = np.zeros(3)
    for area, n, centre in zip(AREAS, NORMALS, CENTRES):
        n = n / np.linalg.norm(n)
        total += np.cross(centre, -0.5 * rho * 2.2 * area * max(n @ v, 0) * v)
        c = max(n @ s, 0)
        push = -LIGHT * lit_by_hand(t) * area * c
        total += np.cross(centre, push * ((1 - 0.3) * s + 2 * (0.3 * c + 0.2 / 3) * n))
    return total


def acting(order, dipole=DIPOLE):
    plates = ph.Plates(AREAS, NORMALS, CENTRES)
    shadow = ph.Eclipse(
        lambda t: jnp.asarray(PATH[0]) + jnp.asarray(PATH[1]) * t, [1.0, 0, 0], RADIUS
    )
    return (
        ph.MagneticDipole(dipole, ph.Table(TIMES, field(TIMES), order))
        + ph.Drag(plates, ph.Table(TIMES, density(TIMES), order), VELOCITY)
        + ph.SolarPressure(plates, ph.Table(TIMES, sun(TIMES), order), shadow, 0.3, 0.2, LIGHT)
    )


def test_torques_are_those_of_the_formulas():
    rng = np.random.default_rng(5)
    torque = acting(3)
    seen = set()
    for t in (0.0, 20.0, 41.0):
        q = rng.normal(size=4)
        attitude = from_quaternion([jnp.asarray(x) for x in q / np.linalg.norm(q)])
        found = torque.body_components(t, attitude, components(jnp.zeros(3)))
        want = torques_by_hand(t, matrix(q), density(t), sun(t))
        want = want + np.cross(DIPOLE, matrix(q).T @ field(t))
        np.testing.assert_allclose(np.stack(found), want, rtol=1e-12, atol=1e-18)
        seen.add(lit_by_hand(t))
    assert seen == {0.0, 1.0}


def by_hand(order, dipole):
    """DOP853 from one kink in time to the next."""
    splines = []
    for f in (field, density, sun):
        if order == 1:
            splines.append(lambda t, f=f: f_linear(f, t))
        else:
            slopes = np.asarray(ph.Table(TIMES, f(TIMES)).derivatives)
            splines.append(CubicHermiteSpline(TIMES, f(TIMES), slopes.reshape(f(TIMES).shape)))

    def rates(t, y):
        q, w, R = y[:4], y[4:], matrix(y[:4])
        torque = torques_by_hand(t, R, splines[1](t), splines[2](t))
        torque = torque + np.cross(dipole, R.T @ splines[0](t))
        turn = np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))]) / 2
        return np.concatenate([turn, (torque - np.cross(w, MOMENTS * w)) / MOMENTS])

    y = np.concatenate(START)
    edges = sorted({*TIMES.tolist(), -PATH[0][0] / PATH[1][0]})
    for a, b in pairwise(edges):
        y = solve_ivp(rates, (a, b), y, "DOP853", rtol=1e-11, atol=1e-13, max_step=0.2).y[:, -1]
    return y


def f_linear(f, t):
    values = f(TIMES)
    if values.ndim == 1:
        return np.interp(t, TIMES, values)
    return np.stack([np.interp(t, TIMES, column) for column in values.T], -1)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 3])
def test_motion_and_derivative_are_those_of_scipy(order):
    def final(dipole):
        scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), torque=acting(order, dipole))
        traj = ph.simulate(scene, ph.State(*START), [0.0, 20.0, 60.0], rtol=1e-9)
        return jnp.concatenate([traj.wxyz[-1], traj.omega_body[-1]])

    along = np.array([1.0, -1.0, 0.5])
    value, change = jax.jvp(final, (jnp.asarray(DIPOLE),), (jnp.asarray(along),))
    np.testing.assert_allclose(value, by_hand(order, DIPOLE), rtol=0, atol=5e-9)
    h = 1e-3
    ends = [by_hand(order, DIPOLE + sign * h * along) for sign in (1, -1)]
    np.testing.assert_allclose(change, (ends[0] - ends[1]) / (2 * h), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_bodies_with_tables_of_their_own():
    values = np.stack([field(TIMES), -2 * field(TIMES)])

    def final(values):
        torque = ph.MagneticDipole(DIPOLE, ph.Table(TIMES, values))
        scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), torque=torque)
        traj = ph.simulate(scene, ph.State(*START), [0.0, 60.0], record=ph.Record(work=True))
        return traj.wxyz[..., -1, :], traj.energy - traj.work

    wxyz, balance = final(values)
    each = [final(x)[0] for x in values]
    np.testing.assert_allclose(wxyz, np.stack(each), atol=1e-9)
    np.testing.assert_allclose(balance[:, 1], balance[:, 0], rtol=1e-9)


@pytest.mark.slow  # of one body: solvers/test_switches.py::test_derivatives_through_a_table
def test_mapped_gradients_go_back_through_the_steps_of_each_body():
    """More bodies than a fused kernel contains, with different numbers of steps: a sphere with
    damping, w' = (p torque - c w) / I.
    """
    times, moment, drag = np.linspace(0.0, 1.0, 5), 2.0, 0.5
    torques = np.stack([np.sin(3 * times), 1 - times, times**2], axis=-1)

    def end(rates, strength):
        torque = ph.BodyTorque(ph.Table(times, strength * torques, 1)) + ph.LinearDamping(drag)
        scene = ph.Scene(ph.Inertia.spherical(moment), torque=torque)
        motion = ph.simulate(scene, ph.State([1.0, 0.0, 0.0, 0.0], rates), [0.0, 1.0])
        return jnp.sum(motion.omega_body[-1])

    strengths = jnp.linspace(0.1, 60.0, 20)
    rates = jnp.outer(strengths, jnp.array([0.3, 0.4, 0.5]))
    by_rates, by_strength = jax.jit(jax.vmap(jax.grad(end, argnums=(0, 1))))(rates, strengths)
    np.testing.assert_allclose(by_rates, np.exp(-drag / moment), rtol=1e-8)
    fine = np.linspace(0.0, 1.0, 20001)
    pull = sum(np.interp(fine, times, torques[:, k]) for k in range(3))
    want = np.trapezoid(pull * np.exp(-drag * (1 - fine) / moment), fine) / moment
    np.testing.assert_allclose(by_strength, want, rtol=1e-7)
