"""Formulas of document 003 that no other test covers, with the corrected misprints."""

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode import rotation
from polhode._hamiltonian import Dynamics, lie_poisson_field
from polhode.frames import RotatingFrame
from polhode.inertia import Inertia, MassProperties

TIME = 0.83
EPSILON = np.zeros((3, 3, 3))
for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    EPSILON[i, j, k], EPSILON[i, k, j] = 1, -1


def attitude(t):
    return rotation.euler_to_matrix(0.3 + 0.7 * t, 1.1 + 0.4 * jnp.sin(t), jnp.cos(2 * t))


def hat(vector):
    """The matrix of a cross product, [hat(a)] b = a x b (formulas 11, 23)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turning():
    """R, its derivative, and the angular velocity of a frame."""
    t = jnp.asarray(TIME)
    matrix, slope = jax.jvp(attitude, (t,), (jnp.ones_like(t),))
    frame = RotatingFrame.from_attitude(attitude)
    return np.asarray(matrix), np.asarray(slope), np.asarray(frame.omega_body(t))


def test_rotation_matrices_are_orthogonal():
    """Formulas 1, 2: R^T R = R R^T = 1, lengths and angles preserved, det R = +1."""
    rng = np.random.default_rng(2)
    wxyz = rotation.normalise(jnp.asarray(rng.normal(size=(50, 4))))
    matrix = np.asarray(rotation.wxyz_to_matrix(wxyz))
    across = np.swapaxes(matrix, -1, -2)
    for product in (matrix @ across, across @ matrix):
        np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), (50, 3, 3)), atol=2e-15)
    np.testing.assert_allclose(np.linalg.det(matrix), 1, rtol=3e-15)
    a, b = rng.normal(size=(2, 50, 3))
    turned = [np.asarray(rotation.rotate(wxyz, jnp.asarray(v))) for v in (a, b)]
    np.testing.assert_allclose(np.sum(turned[0] * turned[1], -1), np.sum(a * b, -1), atol=1e-14)


def test_omega_is_the_antisymmetric_matrix_of_the_frame():
    """Formulas 5-12: R^T dR/dt = -(dR/dt)^T R = hat(omega), the sum of three generators."""
    matrix, slope, omega = turning()
    turn = matrix.T @ slope
    np.testing.assert_allclose(turn, -turn.T, atol=1e-15)
    np.testing.assert_allclose(turn, hat(omega), atol=1e-15)
    np.testing.assert_allclose(turn, sum(w * hat(e) for w, e in zip(omega, np.eye(3))), atol=1e-15)
    vector = np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(turn @ vector, np.cross(omega, vector), atol=1e-14)


def test_omega_acts_on_frame_components():
    """Formula 11, corrected: Omega x_frame is a velocity, Omega x_space is not."""
    matrix, slope, omega = turning()
    frame = RotatingFrame.from_attitude(attitude)
    at = np.array([1.0, -2.0, 0.5])
    moved = frame.velocity_to_space(jnp.asarray(TIME), jnp.asarray(at), jnp.zeros(3))
    np.testing.assert_allclose(moved, slope @ at, atol=1e-14)
    np.testing.assert_allclose(hat(omega) @ at, matrix.T @ moved, atol=1e-14)
    in_space, omega_space = matrix @ at, matrix @ omega
    np.testing.assert_allclose(np.cross(omega_space, in_space), moved, atol=1e-14)
    printed = hat(omega) @ in_space
    assert np.linalg.norm(printed - moved) > 0.5
    assert np.linalg.norm(printed - matrix.T @ moved) > 0.5


def test_small_steps_turn_about_body_axes():
    """Formulas 13-16: R(t + h) = R(t)(1 + Omega h) + O(h^2), three small rotations in any order."""
    matrix, _, omega = turning()
    small = []
    for h in (1e-3, 1e-4):
        after = np.asarray(attitude(TIME + h))
        about = [
            rotation.rotation_vector_to_wxyz(jnp.asarray(w * h * e))
            for w, e in zip(omega, np.eye(3))
        ]
        x, y, z = (np.asarray(rotation.wxyz_to_matrix(q)) for q in about)
        steps = [np.eye(3) + h * hat(omega), x @ y @ z, z @ y @ x]
        left = [np.abs(after - matrix @ step).max() for step in steps]
        small.append([*left, np.abs(after - steps[1] @ matrix).max()])
    ratio = np.array(small[0]) / np.array(small[1])
    np.testing.assert_allclose(ratio[:3], 100, rtol=0.02)
    np.testing.assert_allclose(ratio[3], 10, rtol=0.02)  # factors on the left: wrong axes


def test_momentum_of_a_moving_particle_has_a_second_part():
    """Formula 22, corrected: R^T L_space = m x cross v + I omega; I omega alone at rest."""
    matrix, _, omega = turning()
    frame, mass, at = RotatingFrame.from_attitude(attitude), 2.0, np.array([1.0, -2.0, 0.5])
    tensor = np.asarray(MassProperties.from_points([mass, mass], [at, -at]).central.tensor) / 2
    for velocity, alone in ((np.zeros(3), True), (np.array([0.4, 0.3, -0.2]), False)):
        moved = frame.velocity_to_space(jnp.asarray(TIME), jnp.asarray(at), jnp.asarray(velocity))
        momentum = matrix.T @ np.cross(matrix @ at, mass * np.asarray(moved))
        whole = mass * np.cross(at, velocity) + tensor @ omega
        np.testing.assert_allclose(momentum, whole, atol=2e-14)
        assert bool(np.abs(momentum - tensor @ omega).max() < 1e-13) is alone


def test_tensor_of_a_particle_is_minus_m_x_squared():
    """Formulas 23-26: I = -m X X, in indices, and the triple product from which it follows."""
    mass, at, omega = 2.0, np.array([1.0, -2.0, 0.5]), np.array([0.3, -0.5, 0.7])
    pair = MassProperties.from_points([mass, mass], [at, -at])
    tensor = np.asarray(pair.central.tensor) / 2
    np.testing.assert_allclose(tensor, -mass * hat(at) @ hat(at), atol=1e-14)
    np.testing.assert_allclose(tensor, mass * (at @ at * np.eye(3) - np.outer(at, at)), atol=1e-14)
    unit = np.eye(3)
    pairs = np.einsum("jkl,lmn->jkmn", EPSILON, EPSILON)
    deltas = np.einsum("jm,kn->jkmn", unit, unit) - np.einsum("jn,km->jkmn", unit, unit)
    np.testing.assert_array_equal(pairs, deltas)
    by_index = np.einsum("jkl,lmn,k,m,n->j", EPSILON, EPSILON, at, at, omega)
    triple = np.cross(at, np.cross(at, omega))
    np.testing.assert_allclose(by_index, triple, atol=1e-14)
    np.testing.assert_allclose(at * (at @ omega) - at @ at * omega, triple, atol=1e-14)
    np.testing.assert_allclose(tensor @ omega, -mass * triple, atol=1e-14)


def test_torque_is_the_rate_of_momentum_in_space():
    """Formulas 27, 28: dL/dt = N in inertial axes, for a free and for a driven body."""
    inertia = Inertia.from_tensor(
        [[1.008, 0.039, 0.22], [0.039, 1.211, 0.234], [0.22, 0.234, 0.793]]
    )
    wxyz = rotation.normalise(jnp.asarray([0.5, -0.5, 0.1, 0.7]))
    omega, push = jnp.asarray([0.3, -0.5, 0.7]), np.array([0.4, -0.1, 0.25])
    for torque, wanted in ((None, np.zeros(3)), (ph.SpaceTorque(push), push)):
        scene = ph.Scene(inertia, torque=torque)
        momentum = inertia.momentum(omega)
        state = (tuple(momentum), tuple(wxyz))
        slope = lie_poisson_field(0.0, state, Dynamics(scene.hamiltonian, scene.torque))

        def in_space(momentum, wxyz):
            return rotation.rotate(jnp.stack(wxyz), jnp.stack(momentum))

        rate = jax.jvp(in_space, state, slope)[1]
        np.testing.assert_allclose(rate, wanted, atol=1e-15)
