"""Damping much faster than the motion: right, or reported by the status."""

from functools import cache

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import polhode as ph
from polhode import QuadraticDamping

MOMENTS, OMEGA, END = np.array([1.0, 1.5, 2.0]), np.array([0.25, 1.0, 0.5]), 10.0
LINEAR = np.array([[1e3, 1e3, 1e3], [3e3, 0.125, 0.25], [0.125, 0.25, 1e3], [0, 0, 0]])
QUADRATIC = np.array([0, 0, 0, 1e4])
CENTRE = np.array([0.125, 0.0, 0.5])


@cache
def radau(linear, quadratic, rtol=3e-11):
    """wxyz and omega_body at the end, by an implicit method (SciPy's)."""

    def field(t, y):
        w, x, a, z = y[:4] / np.linalg.norm(y[:4])
        rate = y[4:]
        up = np.array([2 * (x * z - w * a), 2 * (a * z + w * x), 1 - 2 * (x * x + a * a)])
        drag = (np.array(linear) + quadratic * np.linalg.norm(rate)) * rate
        push = np.cross(MOMENTS * rate, rate) - np.cross(CENTRE, up) - drag
        p, q, r = rate / 2
        turn = [-x * p - a * q - z * r, w * p + a * r - z * q]
        turn += [w * q + z * p - x * r, w * r + x * q - a * p]
        return np.concatenate([turn, push / MOMENTS])

    start = np.concatenate([[1.0, 0, 0, 0], OMEGA])
    end = solve_ivp(field, (0, END), start, "Radau", rtol=rtol, atol=1e-14).y[:, -1]
    return end[:4] / np.linalg.norm(end[:4]), end[4:]


def damped(dtype, linear, quadratic):
    """The scene, the state and the times in one precision."""

    def a(x):
        return jnp.asarray(x, dtype)

    drag = ph.LinearDamping(a(linear)) + QuadraticDamping(a(quadratic[:, None] * np.ones(3)))
    gravity = ph.UniformGravity(a(1.0), a(CENTRE), a([0.0, 0.0, -1.0]))
    scene = ph.Scene(ph.Inertia.from_moments(a(MOMENTS)), gravity, drag)
    return scene, ph.State(a([1.0, 0, 0, 0]), a(OMEGA)), a([0.0, END])


@pytest.mark.parametrize(
    ("dtype", "rtol"),
    [pytest.param(jnp.float64, 1e-9, marks=pytest.mark.slow), (jnp.float32, 1e-5)],
)
def test_strong_damping_is_right_or_marked(dtype, rtol):
    """Damping rates times the horizon of 1e4 and more; at 1e8 the limit of steps is reached."""
    record = ph.Record(final_only=True)
    end = ph.simulate(*damped(dtype, LINEAR, QUADRATIC), rtol=rtol, record=record)
    assert np.all(end.steps[:3] > 500)  # but not where drag is strong at first only
    for k in range(len(LINEAR)):
        far = apart(end, k, tuple(LINEAR[k]), QUADRATIC[k], rtol=max(1e-4 * rtol, 3e-11))
        assert far < 10 * rtol, k
    with pytest.raises(ph.SimulationError, match="Kvaerno5") as lost:
        ph.simulate(*damped(dtype, 1e4 * LINEAR, QUADRATIC), rtol=rtol, record=record)
    out_of_steps = (ph.Status.MAX_STEPS, ph.Status.STEP_FAILED)
    assert all(status in out_of_steps for status in lost.value.status[:3])
    assert lost.value.status[3] == ph.Status.SUCCESSFUL


@pytest.mark.slow  # faster: strong damping, above
def test_an_implicit_solver_takes_any_damping():
    method, linear = ph.LiePoisson(diffrax.Kvaerno5(), chunk=1), 1e4 * LINEAR[1:2]
    scene = damped(jnp.float64, linear, np.zeros(1))
    end = ph.simulate(*scene, method, rtol=1e-9, record=ph.Record(final_only=True))
    assert apart(end, 0, tuple(linear[0]), 0.0) < 1e-8


def apart(end, k, linear, quadratic, rtol=3e-11):
    """Error of a body: angle of its attitude [rad] or difference of its rates [rad/s]."""
    wxyz, omega = radau(linear, quadratic, rtol)
    got = np.asarray(end.wxyz[k, 0], float)
    gap = 2 * min(np.linalg.norm(got - s * wxyz) for s in (1, -1))
    return max(gap, np.abs(np.asarray(end.omega_body[k, 0], float) - omega).max())
