"""One step of a filter: Jacobian against differences of the motion, noise against a push."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import rotation

MOMENTS = (0.15, 0.14, 0.16)  # kg m^2, of a free flyer as large as a melon
STATE = ph.State([0.9, 0.1, -0.3, 0.2], [0.3, -0.2, 0.4])
PULL = ph.UniformGravity(10.0, [0.0, 0.002, 0.004])
DT = 0.7


def tangent(nominal, end):
    """Error rotation vector and rates of a motion's end (NumPy's small differences)."""
    turn = rotation.multiply(rotation.conjugate(nominal.wxyz), end.wxyz)
    turn = rotation.wxyz_to_rotation_vector(turn)
    return np.concatenate([turn, end.omega_body - nominal.omega_body])


@pytest.mark.parametrize("potential", [None, PULL], ids=["free", "gravity"])
def test_jacobian_and_noise_are_those_of_the_motion(potential):
    def ends(error, push=None):
        """The motion itself, by a method and a chart that ``propagate`` does not use."""
        turn = rotation.rotation_vector_to_wxyz(jnp.asarray(error[:3]))
        start = ph.State(rotation.multiply(STATE.wxyz, turn), STATE.omega_body + error[3:6])
        inertia = ph.Inertia(diagonal=jnp.array(MOMENTS) + error[6:9])
        torque = ph.BodyTorque(jnp.zeros(3) if push is None else push)
        scene = ph.Scene(inertia, potential, torque)
        traj = ph.simulate(scene, start, jnp.array([2.0, 2.0 + DT]), ph.LiePoisson(), rtol=1e-13)
        return traj.last

    ends = jax.jit(ends)
    scene = ph.Scene(ph.Inertia(diagonal=jnp.array(MOMENTS)), potential)
    state, jacobian, noise = ph.propagate(
        scene, STATE, DT, t=2.0, free=lambda s: s.inertia.diagonal, rtol=1e-12
    )
    nominal = ends(np.zeros(9), np.zeros(3))
    assert float(rotation.angle_between(state.wxyz, nominal.wxyz)) < 1e-11
    np.testing.assert_allclose(state.omega_body, nominal.omega_body, rtol=0, atol=1e-11)

    def slope(at, step):
        """By differences of fourth order."""
        one, two = (
            (tangent(nominal, at(k * step)) - tangent(nominal, at(-k * step))) / (2 * k * step)
            for k in (1, 2)
        )
        return (4 * one - two) / 3

    for k, basis in enumerate(np.eye(9)):
        step = 1e-3 if k < 6 else 1e-4
        want = slope(lambda h, b=basis: ends(h * b, np.zeros(3)), step)
        np.testing.assert_allclose(jacobian[:6, k], want, rtol=0, atol=2e-7 * max(1, 0.1 / step))
    np.testing.assert_array_equal(jacobian[6:], np.eye(9)[6:])
    for k, basis in enumerate(np.eye(3)):
        want = slope(lambda h, b=basis: ends(np.zeros(9), h * b), 1e-3)
        np.testing.assert_allclose(noise[:6, k], want, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(noise[6:], 0)


def test_steps_join_and_map():
    """Two half steps are a whole one; bodies are mapped; a batch is refused."""
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS))
    step = jax.jit(lambda state, dt: ph.propagate(scene, state, dt))
    whole, half = step(STATE, 2 * DT), step(STATE, DT)
    again = step(half.state, DT)
    np.testing.assert_allclose(again.jacobian @ half.jacobian, whole.jacobian, rtol=0, atol=1e-12)
    joined = again.noise + again.jacobian @ half.noise
    np.testing.assert_allclose(joined, whole.noise, rtol=0, atol=1e-11)
    rates = jnp.stack([STATE.omega_body, 2 * STATE.omega_body])
    both = ph.State(jnp.stack([STATE.wxyz, STATE.wxyz]), rates)
    mapped = jax.vmap(lambda state: ph.propagate(scene, state, DT))(both)
    np.testing.assert_allclose(mapped.jacobian[0], half.jacobian, rtol=0, atol=1e-12)
    for free in (lambda s: s.inertia.size, lambda s: 2 * s.inertia.diagonal):
        with pytest.raises(TypeError, match="arrays that the scene holds"):
            ph.propagate(scene, STATE, DT, free=free)
    for given in ((scene, STATE.wxyz), (STATE, STATE)):
        with pytest.raises(TypeError, match=r"must be a ph\."):
            ph.propagate(*given, DT)
    with pytest.raises(ValueError, match="one body"):
        ph.propagate(scene, both, DT)
