"""Inertia that changes with time, against Euler's equations with their (dI/dt) omega term."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import polhode as ph

START = [0.7, 0.1, -0.5, 0.5], [0.3, 1.1, -0.4]
MU, PLACE = 0.4, np.array([1.0, -0.5, 0.75])
AXIS, WHEEL, SPEED = np.array([0.6, 0.0, 0.8]), 0.05, 7.0
SPAN = 12.0


def moments(t, a, xp):
    """Booms that extend: the moments grow by up to ``a``."""
    s = 1 - xp.exp(-0.2 * t)
    return xp.stack([1.0 + a * s, 1.5 + 0.5 * a * s, 2.0 + 0.25 * a * s + 0 * t])


def tensor(t, a, xp):
    off = 0.2 * xp.sin(0.7 * t) * a
    i, j, k = moments(t, a, xp)
    zero = 0 * t
    return xp.stack(
        [xp.stack([i, off, zero]), xp.stack([off, j, 0.1 + zero]), xp.stack([zero, 0.1 + zero, k])]
    )


def matrix(q):
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


def by_hand(inertia_of, a, forced):
    """Euler's equations in the rates, with dI/dt by a difference that is accurate to 1e-10."""
    h = 1e-4

    def rates(t, y):
        q, w = y[:4], y[4:]
        I = inertia_of(t, a)
        change = (
            inertia_of(t - 2 * h, a)
            - 8 * inertia_of(t - h, a)
            + 8 * inertia_of(t + h, a)
            - inertia_of(t + 2 * h, a)
        ) / (12 * h)
        momentum, torque = I @ w, np.zeros(3)
        if forced:
            r = matrix(q).T @ PLACE
            distance = np.linalg.norm(r)
            n = r / distance
            torque = 3 * MU / distance**3 * np.cross(n, I @ n) - 0.05 * w
            momentum = momentum + WHEEL * SPEED * AXIS
        turn = np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))]) / 2
        push = torque - np.cross(w, momentum) - change @ w
        return np.concatenate([turn, np.linalg.solve(I, push)])

    y = np.concatenate(START)
    return solve_ivp(rates, (0, SPAN), y, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def final(inertia, forced):
    acting = {}
    if forced:
        acting = {
            "potential": ph.GravityGradient(MU, PLACE),
            "torque": ph.LinearDamping(0.05),
            "rotors": ph.Rotor(AXIS, inertia=WHEEL, speed=SPEED),
        }
    scene = ph.Scene(inertia, **acting)
    traj = ph.simulate(scene, ph.State(*START), [0.0, SPAN / 2, SPAN], rtol=1e-10)
    return jnp.concatenate([traj.wxyz[-1], traj.omega_body[-1]])


def test_a_deployment_keeps_the_momentum_and_agrees_with_eulers_equations():
    body = ph.VariableInertia(lambda t: moments(t, 0.8, jnp))
    traj = ph.simulate(ph.Scene(body), ph.State(*START), [0.0, SPAN / 2, SPAN], rtol=1e-10)
    want = by_hand(lambda t, a: np.diag(moments(t, a, np)), 0.8, False)
    np.testing.assert_allclose(traj.wxyz[-1], want[:4], atol=2e-9)
    np.testing.assert_allclose(traj.omega_body[-1], want[4:], atol=2e-9)
    momentum = traj.momentum_space
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], (3, 3)), rtol=1e-9)
    energy = (
        np.sum(
            np.stack([moments(t, 0.8, np) for t in (0.0, SPAN)])
            * np.asarray(traj.omega_body[::2]) ** 2,
            axis=-1,
        )
        / 2
    )
    np.testing.assert_allclose(traj.energy[::2], energy, rtol=1e-12)


def test_only_what_can_be_an_inertia_is_taken():
    with pytest.raises(ValueError, match="must return moments"):
        ph.VariableInertia(lambda t: jnp.ones(2) * t)
    with pytest.raises(TypeError, match="VariableInertia"):
        ph.VariableInertia(jnp.ones(3))
    with pytest.raises(ValueError, match="vectors of 2"):
        ph.VariableInertia(ph.Table([0.0, 1.0, 2.0], np.ones((3, 2))))


def test_closed_forms_are_refused():
    body = ph.VariableInertia(lambda t: jnp.array([1.0, 1.0, 1.0]) + 0 * t)
    scene, state = ph.Scene(body), ph.State(*START)
    assert not scene.is_free
    for method in (ph.ClosedForm(), ph.SymmetricTop()):
        with pytest.raises(ValueError, match="the inertia changes with time"):
            ph.simulate(scene, state, [0.0, 1.0], method=method)


def test_the_acceleration_holds_the_term_of_euler():
    body = ph.VariableInertia(lambda t: tensor(t, 0.8, jnp))
    omega, t, h = jnp.array(START[1]), 1.3, 1e-6
    found = ph.Scene(body).acceleration(None, omega, t)
    I = tensor(np.float64(t), 0.8, np)
    change = (tensor(np.float64(t + h), 0.8, np) - tensor(np.float64(t - h), 0.8, np)) / (2 * h)
    want = np.linalg.solve(I, -np.cross(omega, I @ omega) - change @ omega)
    np.testing.assert_allclose(found, want, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("full", [False, True])
def test_motion_and_gradient_with_forces_and_a_wheel(full):
    inertia_of = tensor if full else moments

    def numbers(a):
        return final(ph.VariableInertia(lambda t: inertia_of(t, a, jnp)), True)

    def reference(a):
        return by_hand(
            (lambda t, a: tensor(t, a, np)) if full else (lambda t, a: np.diag(moments(t, a, np))),
            a,
            True,
        )

    value, change = jax.jvp(numbers, (0.8,), (1.0,))
    np.testing.assert_allclose(value, reference(0.8), atol=5e-9)
    slope = (reference(0.8 + 1e-4) - reference(0.8 - 1e-4)) / 2e-4
    np.testing.assert_allclose(change, slope, atol=1e-6)
    weights = jnp.arange(1.0, 8.0)
    reverse = jax.grad(lambda a: jnp.dot(weights, numbers(a)))(0.8)
    np.testing.assert_allclose(reverse, np.dot(weights, change), rtol=1e-6)


@pytest.mark.slow
def test_tables_of_inertia_and_batches():
    times = np.linspace(0, SPAN, 241)
    many = np.stack([moments(times, a, np).T for a in (0.8, 0.3)])
    traj = ph.simulate(
        ph.Scene(ph.VariableInertia(ph.Table(times, many))), ph.State(*START), [0.0, SPAN]
    )
    assert traj.wxyz.shape == (2, 2, 4)
    for k, a in enumerate((0.8, 0.3)):
        want = by_hand(lambda t, a: np.diag(moments(t, a, np)), a, False)
        np.testing.assert_allclose(traj.omega_body[k, -1], want[4:], atol=1e-7)
    nine = np.stack([tensor(np.float64(t), 0.8, np).reshape(9) for t in times])
    one = ph.VariableInertia(ph.Table(times, nine))
    found = ph.simulate(ph.Scene(one), ph.State(*START), [0.0, SPAN]).omega_body[-1]
    want = by_hand(lambda t, a: tensor(t, a, np), 0.8, False)
    np.testing.assert_allclose(found, want[4:], atol=1e-7)
