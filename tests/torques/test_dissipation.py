"""Internal dissipation: an energy sink, and wheels and rings that damp nutation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import polhode as ph

MOMENTS = np.array([1.0, 1.5, 2.5])
INERTIA = ph.Inertia.from_moments(MOMENTS)
STATE = ph.State([0.8, 0.3, 0.4, 0.2], [[2.0, 0.1, -0.05], [1.5, 0.02, 0.1]])
SINK = ph.EnergySink([0.02, 0.03])
RING = ph.Rotor([0.0, 0.6, 0.8], inertia=0.2, speed=0.0, coupling=ph.ViscousCoupling([0.02, 0.04]))
WORK = ph.Record(work=True)
INSIDE = {
    "sink": ph.Scene(INERTIA, torque=SINK),
    "ring": ph.Scene(INERTIA, rotors=RING),
}


@pytest.mark.parametrize("name", list(INSIDE))
def test_the_flip_to_a_spin_about_the_largest_moment(name):
    """R L is constant; the energy only decreases, by the stated work, to L^2 / (2 I_max)."""
    ts = jnp.linspace(0.0, 1500.0, 61)
    got = ph.simulate(INSIDE[name], STATE, ts, rtol=1e-12, record=WORK)
    momentum, energy = np.array(got.momentum_space), np.array(got.energy)
    size = np.linalg.norm(momentum[:, 0], axis=-1)
    drift = np.linalg.norm(momentum - momentum[:, :1], axis=-1) / size[:, None]
    assert drift.max() < 1e-13  # 2e-14: rounding of some 1,500 rad
    assert np.all(np.diff(energy) < 1e-14)
    np.testing.assert_allclose(energy[:, 0] / energy[:, -1], 2.5, rtol=0.02)  # C/A: from x to z
    np.testing.assert_allclose(energy[:, -1], size**2 / (2 * 2.5), rtol=1e-6)
    np.testing.assert_allclose(energy - energy[:, :1], got.work, rtol=0, atol=1e-13)
    spin = np.array(got.omega_body[:, -1])
    np.testing.assert_allclose(np.abs(spin[:, 2]), size / 2.5, rtol=1e-4)
    assert np.abs(spin[:, :2]).max() < 1e-3


@pytest.mark.slow
def test_the_time_of_an_energy_sink():
    """tan theta = tan theta_0 exp(k L^2 (1/C - 1/A) t) about the axis of a symmetric body.

    Value and derivative with respect to k, also in the other coordinates.
    """
    a, c, ts = 2.0, 0.5, np.array([0.0, 1.0, 3.0])
    inertia = ph.Inertia.axisymmetric(a, c)
    momentum = np.array([0.2, 0.1, 2.0])
    start = np.hypot(*momentum[:2]) / momentum[2]
    square, k = momentum @ momentum, 0.2

    state = ph.State([0.8, 0.4, 0.4, 0.2], momentum / [a, a, c])

    def tangent(k, method=None):
        scene = ph.Scene(inertia, torque=ph.EnergySink(k))
        found = ph.simulate(scene, state, ts, method, rtol=1e-12).momentum_body
        return jnp.hypot(found[:, 0], found[:, 1]) / found[:, 2]

    rate = square * (1 / c - 1 / a)
    want = start * np.exp(k * rate * ts)
    assert want[-1] > 20 * start  # nearly flat
    slope, value = jax.jit(jax.jacrev(lambda k: (tangent(k),) * 2, has_aux=True))(k)
    np.testing.assert_allclose(value, want, rtol=1e-10)
    np.testing.assert_allclose(slope, want * rate * ts, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(tangent(k, ph.EulerAngles()), want, rtol=1e-9)


def test_a_wheel_with_friction_about_one_axis():
    """The relative speed decays as exp(-c (1/J + 1/(C - J)) t), and the energy with it."""
    c, j, friction, speed = 2.5, 0.5, 0.3, 4.0
    ts = np.linspace(0.0, 3.0, 4)

    def scene(friction):
        coupling = ph.ViscousCoupling(friction)
        return ph.Scene(INERTIA, rotors=ph.Rotor([0, 0, 1.0], j, speed=speed, coupling=coupling))

    state = ph.State([1.0, 0, 0, 0], [0.0, 0.0, 1.0])
    got = ph.simulate(scene(friction), state, ts, rtol=1e-12, record=WORK)
    rate = 1 / j + 1 / (c - j)
    fade = np.exp(-friction * rate * ts)
    taken = j * speed / c * (1 - fade)  # increase of the body's rate
    np.testing.assert_allclose(got.omega_body[:, 2], 1 + taken, rtol=1e-11)
    np.testing.assert_allclose(got.wheel_speed[:, 0], speed * fade, rtol=1e-11)
    lost = -0.5 * speed**2 / rate * (1 - fade**2)
    np.testing.assert_allclose(got.motor_work[:, 0], lost, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(got.work, lost, rtol=1e-10, atol=1e-14)


def test_an_energy_sink_keeps_the_momentum_in_euler_angles():
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), torque=ph.EnergySink(0.1))
    found = ph.simulate(scene, STATE, [0.0, 2.0], ph.EulerAngles(), rtol=1e-9)
    momentum, energy = np.asarray(found.momentum_space), np.asarray(found.energy)
    np.testing.assert_allclose(momentum[:, 1], momentum[:, 0], rtol=0, atol=1e-7)
    assert np.all(energy[:, 1] < energy[:, 0] - 1e-3)


@pytest.mark.parametrize(
    "name",
    [
        "Lie-Poisson",
        # an energy sink in these coordinates: above
        pytest.param("Euler angles", marks=pytest.mark.slow),
        pytest.param("single precision", marks=pytest.mark.slow),
    ],
)
def test_a_ring_against_newton_in_every_chart(name):
    """A batch with an oblique ring, against SciPy, in all coordinates; in single precision."""
    axis, j, ts = np.array([0.0, 0.6, 0.8]), 0.2, [0.0, 6.0]
    carrier = np.diag(MOMENTS) - j * np.outer(axis, axis)

    def field(t, y, c):
        wxyz, total, own = y[:4], y[4:7], y[7]
        rate = np.linalg.solve(carrier, total - own * axis)
        a, b, g = rate / 2
        w, x, v, z = wxyz
        turn = [
            -x * a - v * b - z * g,
            w * a + v * g - z * b,
            w * b + z * a - x * g,
            w * g + x * b - v * a,
        ]
        return [*turn, *np.cross(total, rate), -c * (own / j - axis @ rate)]

    dtype = jnp.float32 if name == "single precision" else jnp.float64
    scene, state = jax.tree.map(lambda x: x.astype(dtype), (INSIDE["ring"], STATE))
    method = ph.EulerAngles() if name == "Euler angles" else None
    options, atol = ({}, 2e-5) if dtype == jnp.float32 else ({"rtol": 1e-10}, 2e-9)
    got = ph.simulate(scene, state, ts, method, **options)
    assert got.wxyz.dtype == got.spins.dtype == dtype
    for k, c in enumerate((0.02, 0.04)):
        rate = np.asarray(STATE.omega_body[k])
        start = [*np.asarray(STATE.wxyz), *(MOMENTS * rate), j * axis @ rate]
        end = solve_ivp(field, ts, start, "DOP853", args=(c,), rtol=1e-12, atol=1e-13).y[:, -1]
        wxyz = np.asarray(got.wxyz[k, -1])
        np.testing.assert_allclose(wxyz * np.sign(wxyz @ end[:4]), end[:4], rtol=0, atol=atol)
        np.testing.assert_allclose(got.momentum_body[k, -1], end[4:7], rtol=0, atol=atol)
        np.testing.assert_allclose(got.spins[k, -1, 0], end[7], rtol=0, atol=atol)


@pytest.mark.slow  # faster: derivatives of the field, test_every_torque.py
def test_slopes_of_a_damped_motion():
    """With respect to every number of the body and of the damping, against differences of the
    motion.
    """

    def last(x):
        ring = ph.Rotor([0.0, 0.6, 0.8], x[0], speed=x[1], coupling=ph.ViscousCoupling(x[2]))
        scene = ph.Scene(ph.Inertia.from_moments(x[3:6]), torque=ph.EnergySink(x[6]), rotors=ring)
        end = ph.simulate(scene, ph.State(STATE.wxyz, x[7:]), [0.0, 4.0], rtol=1e-12)
        last = jnp.concatenate([end.wxyz[-1], end.omega_body[-1], end.spins[-1]])
        return last, last

    x = jnp.array([0.2, 1.0, 0.05, *MOMENTS, 0.03, 1.5, 0.2, -0.3])
    both, step = jax.jit(jax.jacrev(last, has_aux=True)), 1e-4
    moved = np.asarray(x) + step * np.multiply.outer([-2.0, -1, 1, 2], np.eye(x.size))
    four = np.array([[both(row)[1] for row in rows] for rows in moved])
    want = (four[0] - 8 * four[1] + 8 * four[2] - four[3]) / (12 * step)
    np.testing.assert_allclose(both(x)[0].T, want, rtol=0, atol=1e-7)


def test_what_is_refused():
    with pytest.raises(ValueError, match="must not be negative"):
        ph.EnergySink(-0.1)
    with pytest.raises(ValueError, match="must not be negative"):
        ph.ViscousCoupling([0.1, -0.1])
    with pytest.raises(TypeError, match="momentum_body, omega_body"):
        ph.EnergySink(lambda x: x)
    with pytest.raises(ValueError, match="not both"):
        ph.Rotor([1.0, 0, 0], 0.1, speed=1.0, torque=0.0, coupling=ph.ViscousCoupling(0.1))
    with pytest.raises(TypeError, match="coupling must be"):
        ph.Rotor([1.0, 0, 0], 0.1, speed=1.0, coupling=0.1)
    with pytest.raises(ValueError, match="needs inertia"):
        ph.Rotor([1.0, 0, 0], momentum=1.0, coupling=ph.ViscousCoupling(0.1))
