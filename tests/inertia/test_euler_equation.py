"""Euler's equation: theory.md 8.3 and 8.4, and where document 003's shortened form is valid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polhode._hamiltonian import Hamiltonian, inverse_inertia
from polhode.inertia import Inertia, MassProperties, angular_acceleration, required_torque
from polhode.rotation import normalise, rotate

OMEGA = np.array([0.3, -0.5, 0.7])
OMEGA_DOT = np.array([0.1, 0.2, -0.3])
# theory.md 8.4
MASSES = [0.5, 0.8, 0.3, 1.1]
PLACES = [[0.2, -0.4, 0.9], [-0.7, 0.1, 0.3], [0.5, 0.6, -0.8], [0.1, -0.3, -0.2]]
TENSOR = [[1.008, 0.039, 0.22], [0.039, 1.211, 0.234], [0.22, 0.234, 0.793]]


def test_particle_of_theory_8_3():
    # the tensor of a single particle is singular: it is available from MassProperties only
    body = MassProperties.from_points([2.0], [[1.0, -2.0, 0.5]])
    shifted = body + MassProperties.from_points([1e-300], [[0.0, 0.0, 0.0]])
    full = shifted.central.tensor + 2 * (5.25 * np.eye(3) - np.outer([1, -2, 0.5], [1, -2, 0.5]))
    np.testing.assert_allclose(full, [[8.5, 4, -1], [4, 2.5, 2], [-1, 2, 10]], rtol=1e-14)
    with pytest.raises(ValueError, match="thin line"):
        Inertia.from_points([2.0], [[1.0, -2.0, 0.5]])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_body_of_theory_8_4(dtype):
    eps = float(jnp.finfo(dtype).eps)
    inertia = Inertia.from_points(jnp.asarray(MASSES, dtype), PLACES)
    omega, omega_dot = jnp.asarray(OMEGA, dtype), jnp.asarray(OMEGA_DOT, dtype)
    np.testing.assert_allclose(inertia.tensor, TENSOR, atol=4 * eps)
    np.testing.assert_allclose(inertia.momentum(omega), [0.4369, -0.43, 0.5041], atol=4 * eps)
    torque = required_torque(inertia, omega, omega_dot)
    np.testing.assert_allclose(torque, [0.09155, 0.3305, -0.07965], atol=4 * eps)
    np.testing.assert_allclose(inertia.momentum(omega_dot), [0.0426, 0.1759, -0.1691], atol=4 * eps)
    np.testing.assert_allclose(
        angular_acceleration(inertia, omega, torque), omega_dot, atol=8 * eps
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_shortened_form_holds_about_principal_axes_only(axis):
    inertia = Inertia.from_tensor(TENSOR)
    along = rotate(inertia.axes, jnp.eye(3)[axis]) * 1.7
    np.testing.assert_allclose(
        required_torque(inertia, along, OMEGA_DOT), inertia.momentum(OMEGA_DOT), atol=1e-14
    )
    off = along + 0.1 * rotate(inertia.axes, jnp.eye(3)[(axis + 1) % 3])
    gap = required_torque(inertia, off, OMEGA_DOT) - inertia.momentum(OMEGA_DOT)
    exact = 0.17 * np.abs(np.diff(np.asarray(inertia.moments)[[axis, (axis + 1) % 3]]))[0]
    np.testing.assert_allclose(np.linalg.norm(gap), exact, rtol=1e-13)


def test_shortened_form_holds_always_for_a_sphere_and_at_rest():
    ball = Inertia.spherical(2.0)
    np.testing.assert_array_equal(required_torque(ball, OMEGA, OMEGA_DOT), ball.momentum(OMEGA_DOT))
    body = Inertia.from_tensor(TENSOR)
    np.testing.assert_array_equal(
        required_torque(body, np.zeros(3), OMEGA_DOT), body.momentum(OMEGA_DOT)
    )


def test_the_same_in_any_axes_and_batched():
    rng = np.random.default_rng(0)
    turn = normalise(jnp.asarray(rng.normal(size=(20, 4))))
    omega, torque = jnp.asarray(rng.normal(size=(2, 20, 3)))
    body = Inertia.from_moments([1.0, 1.7, 2.1])
    there = angular_acceleration(body.turned(turn), rotate(turn, omega), rotate(turn, torque))
    here = angular_acceleration(body, omega, torque)
    np.testing.assert_allclose(there, rotate(turn, here), atol=1e-13)
    x, y, z = np.asarray(omega).T
    by_hand = np.stack(
        [
            ((1.7 - 2.1) * y * z + torque[:, 0]) / 1.0,
            ((2.1 - 1.0) * z * x + torque[:, 1]) / 1.7,
            ((1.0 - 1.7) * x * y + torque[:, 2]) / 2.1,
        ],
        axis=-1,
    )
    np.testing.assert_allclose(here, by_hand, atol=1e-14)
    np.testing.assert_allclose(
        angular_acceleration(body, omega), angular_acceleration(body, omega, jnp.zeros(3))
    )


def test_euler_equation_is_the_lie_poisson_form_of_the_one_hamiltonian():
    # dL/dt = L x dH/dL + N with L = I omega, for a full tensor
    inertia = Inertia.from_tensor(TENSOR)
    momentum = inertia.momentum(jnp.asarray(OMEGA))
    energy = Hamiltonian(inverse_inertia(inertia), inertia)
    slope = jnp.stack(jax.grad(lambda parts: energy(parts, None, 0.0))(tuple(momentum)))
    torque = jnp.asarray([0.4, -0.1, 0.25])
    momentum_rate = jnp.cross(momentum, slope) + torque
    np.testing.assert_allclose(
        angular_acceleration(inertia, jnp.asarray(OMEGA), torque),
        inertia.rates(momentum_rate),
        atol=1e-15,
    )


def test_lists_are_vectors_and_others_are_named():
    body = Inertia.from_moments([1.0, 2.0, 2.5])
    np.testing.assert_allclose(angular_acceleration(body, [1, 2, 3], [1, 0, 0]), [-2, 2.25, -0.8])
    np.testing.assert_allclose(required_torque(body, [1, 2, 3], [-2, 2.25, -0.8]), [1, 0, 0])
    for call in (
        lambda: angular_acceleration(body, [1, 2]),
        lambda: angular_acceleration(body, [1, 2, 3], 1.0),
        lambda: required_torque(body, [1, 2, 3], [0, 0]),
    ):
        with pytest.raises(ValueError, match=r"must have shape \(\.\.\., 3\)"):
            call()
