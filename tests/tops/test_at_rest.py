"""Symmetric bodies at rest, or without weight: values and derivatives against integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._closed_forms import _lagrange_top

TILTED = [0.8, 0.6, 0.0, 0.0]
UP, DOWN = [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]
SLANTED = [3.0, -4.0, -8.0]  # m/s^2
TS = jnp.array([0.0, 1.0, 3.0])
USUAL = {"mass": 1.0, "distance": 0.5, "gravity": [0.0, 0.0, -9.80665], "moments": [2.0, 3.0]}


def top(numbers, wheel=None):
    mass, distance, gravity, moments = numbers[0], numbers[1], numbers[2:5], numbers[5:7]
    potential = ph.UniformGravity.axial(mass, distance, gravity)
    return ph.Scene(ph.Inertia.axisymmetric(moments[0], moments[1]), potential, rotors=wheel)


def numbers_of(rates, **changed):
    given = USUAL | changed
    return jnp.concatenate(
        [jnp.atleast_1d(jnp.asarray(x, float)) for x in given.values()] + [jnp.asarray(rates)]
    )


def last(numbers, wxyz, method, wheel=None):
    state = ph.State(wxyz, numbers[7:10])
    traj = ph.simulate(top(numbers, wheel), state, TS, method, rtol=1e-12, throw=False)
    return jnp.concatenate([traj.wxyz[-1], traj.omega_body[-1]])


REST = [0.0, 0.0, 0.0]
CASES = {
    "no mass": (TILTED, numbers_of(REST, mass=0.0, gravity=SLANTED)),
    "no distance": (TILTED, numbers_of(REST, distance=0.0)),
    "no gravity": (TILTED, numbers_of(REST, gravity=[0.0, 0.0, 0.0])),
    "hardly any mass": (TILTED, numbers_of(REST, mass=1e-25)),
    "less than that": (TILTED, numbers_of(REST, mass=1e-300)),
    "hanging": (DOWN, numbers_of(REST)),
    "inverted": (UP, numbers_of(REST)),
    "sleeping": (UP, numbers_of([0.0, 0.0, 9.0])),
    "spinning without mass": (TILTED, numbers_of([0.0, 0.0, 2.0], mass=0.0, gravity=SLANTED)),
    "tumbling without mass": (TILTED, numbers_of([0.5, -0.3, 2.0], mass=0.0, gravity=SLANTED)),
    "tumbling without gravity": (TILTED, numbers_of([0.5, -0.3, 2.0], gravity=[0.0, 0.0, 0.0])),
    "tumbling about its centre": (TILTED, numbers_of([0.5, -0.3, 2.0], distance=0.0)),
    "slowly without mass": (TILTED, numbers_of([5e-3, -3e-3, 2e-3], mass=0.0, gravity=SLANTED)),
}
WHEELS = {  # the second wheel cancels the momentum of the body
    "with a wheel": (ph.Rotor.axial(momentum=0.7), REST),
    "balanced by a wheel": (ph.Rotor.axial(momentum=-3.0), [0.0, 0.0, 1.0]),
}


@jax.jit
def values_and_derivatives(numbers, wxyz, wheel):
    """Of the closed form, with its derivatives also in reverse mode, and of the integration."""

    def exact(x):
        return last(x, wxyz, ph.LagrangeTop(), wheel)

    def stepped(x):
        return last(x, wxyz, ph.LiePoisson(), wheel)

    closed = exact(numbers), jax.jacfwd(exact)(numbers), jax.jacrev(exact)(numbers)
    return closed, (stepped(numbers), jax.jacfwd(stepped)(numbers))


def check(wxyz, numbers, wheel=None):
    (exact, forward, reverse), (stepped, want) = values_and_derivatives(
        numbers, jnp.array(wxyz), wheel
    )
    np.testing.assert_allclose(exact, stepped, rtol=0, atol=1e-12)
    np.testing.assert_allclose(forward, want, rtol=0, atol=1e-9)
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_against_integration(name):
    check(*CASES[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", WHEELS)
def test_wheels_against_integration(name):
    wheel, rates = WHEELS[name]
    check(TILTED, numbers_of(rates, mass=0.0, gravity=SLANTED), wheel)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "bound"), [(jnp.float64, 1e-14), (jnp.float32, 1e-5)])
def test_bodies_at_rest_among_others(dtype, bound):
    """A batch over the distance, with one body at rest and one that rotates without weight."""
    axes = jax.random.normal(jax.random.key(1), (4, 4), dtype)
    rates = jnp.array([[0, 0, 0], [0, 0, 0], [0.1, 0.2, 0.3], [0.5, -0.3, 2.0]], dtype)
    inertia = ph.Inertia.axisymmetric(*jnp.array([2.0, 3.0], dtype))
    gravity = jnp.array(SLANTED, dtype)
    ts = jnp.asarray([0.0, 3.0], dtype)

    def moved(distance, rates, mass):
        potential = ph.UniformGravity.axial(mass, distance, gravity)
        traj = ph.simulate(ph.Scene(inertia, potential), ph.State(axes, rates), ts)
        return traj.wxyz[:, -1], traj.omega_body[:, -1]

    @jax.jit
    def moved_and_slopes(distance, mass):
        """With respect to the distance, and to the mass for the last body."""
        along = jnp.array([1.0, 1.0, 1.0, 0.0], dtype)
        return jax.jvp(lambda d, m: moved(d, rates, m), (distance, mass), (along, 1 - along))

    distance = jnp.array([0.0, 0.1, 0.5, 0.7], dtype)
    mass = jnp.array([1.0, 1.0, 1.0, 0.0], dtype)
    (wxyz, omega), by_distance = moved_and_slopes(distance, mass)
    start = ph.State(axes, rates).wxyz[0]
    np.testing.assert_allclose(wxyz[0], start, rtol=0, atol=bound)
    np.testing.assert_array_equal(omega[0], 0)
    # a body at rest: rates grow as torque times time, the attitude by half of that times time
    down = ph.rotation.rotate(ph.rotation.conjugate(start), gravity)
    pull = jnp.cross(jnp.array([0, 0, 1], dtype), down) / jnp.array([2, 2, 3], dtype)
    np.testing.assert_allclose(by_distance[1][0], 3 * pull, rtol=0, atol=30 * bound)
    turn = jnp.concatenate([jnp.zeros(1, dtype), pull * 9 / 4])
    want = ph.rotation.multiply(start, turn)
    np.testing.assert_allclose(by_distance[0][0], want, rtol=0, atol=30 * bound)
    # a body that turns: central differences over masses that are not zero
    near = bound ** (1 / 3)
    (above, _), (below, _) = (moved_and_slopes(distance, mass.at[3].set(x)) for x in (near, -near))
    for slope, high, low in zip(by_distance, above, below):
        gap = (high - low)[3] / (2 * near)
        np.testing.assert_allclose(slope[3], gap, rtol=0, atol=100 * bound ** (2 / 3))
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in by_distance)
    total = jax.grad(lambda d, w: jnp.sum(moved(d, w, mass)[1]), argnums=(0, 1))
    found = jax.jit(total)(distance, rates)
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in found)
    np.testing.assert_allclose(found[0][0], 3 * jnp.sum(pull), rtol=0, atol=50 * bound)
    np.testing.assert_allclose(found[1][0], 1, rtol=0, atol=bound)


def test_the_first_order_in_the_weight_is_left_to_derivatives_by_the_force(monkeypatch):
    """Otherwise it is a tenth of the program of every gradient."""
    asked, first_order = [], _lagrange_top._first_order
    monkeypatch.setattr(
        _lagrange_top, "_first_order", lambda *given: asked.append(0) or first_order(*given)
    )
    one, turning = jnp.ones(1), jnp.array([[0.5, -0.3, 2.0]])
    motion = jnp.array([[[0.8, 0.6, 0.0, 0.0]]]), turning[:, None]

    def corrected(force, distance):
        top = _lagrange_top.Top(force, distance, motion[0][0], turning, 2 * one)
        return _lagrange_top.with_weight(top, one[:, None], motion, jnp.ones((1, 1), bool))

    none = jnp.zeros((1, 3))
    np.testing.assert_array_equal(corrected(none, one)[1], motion[1])
    jax.jvp(lambda a: corrected(none, a), (one,), (one,))
    assert not asked
    _, (by_force, _) = jax.jvp(lambda f: corrected(f, one), (none,), (none + 1,))
    assert asked
    assert jnp.any(by_force != 0)


@pytest.mark.slow
def test_second_derivatives_without_weight_are_no_wrong_numbers():
    """With respect to the weight: NaN for a rotating body, right for one at rest."""

    def height(mass, rates):
        numbers = numbers_of(jnp.zeros(3), gravity=SLANTED).at[0].set(mass).at[7:].set(rates)
        return last(numbers, TILTED, ph.LagrangeTop())[4]

    bend = jax.jit(jax.grad(jax.grad(height)))
    assert jnp.isnan(bend(0.0, jnp.array([0.5, -0.3, 2.0])))
    near = (jax.grad(height)(1e-3, jnp.zeros(3)) - jax.grad(height)(-1e-3, jnp.zeros(3))) / 2e-3
    np.testing.assert_allclose(bend(0.0, jnp.zeros(3)), near, rtol=1e-4)
    mixed = jax.jit(jax.jacfwd(jax.grad(height), argnums=1))(0.0, jnp.array([0.5, -0.3, 2.0]))
    assert jnp.all(jnp.isfinite(mixed))


def test_a_weight_has_second_derivatives_beside_the_first_order_in_it():
    """Bodies with weight do not use the first-order term, which must not make their Hessian NaN."""
    one, turning = jnp.ones(1), jnp.array([[0.5, -0.3, 2.0]])
    motion = jnp.array([[[0.8, 0.6, 0.0, 0.0]]]), turning[:, None]

    def rate(force, applies):
        top = _lagrange_top.Top(force, turning[:, 2], motion[0][0], turning, 2 * one)
        _, rates = _lagrange_top.with_weight(top, one[:, None], motion, applies[None])
        return jnp.sum(jnp.where(applies, rates[0, 0, 0], force[0, 0] ** 2))

    second = jax.jacfwd(jax.jacrev(rate))
    force = jnp.array([[0.0, 0.0, -9.81]])
    want = jnp.zeros((1, 3, 1, 3)).at[0, 0, 0, 0].set(2)
    np.testing.assert_array_equal(second(force, jnp.array([False])), want)
    assert jnp.all(jnp.isnan(second(0 * force, jnp.array([True]))))
