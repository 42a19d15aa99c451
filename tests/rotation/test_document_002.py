"""Document 002: the matrix K, its relation to R, its axis-angle formulas, published values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode.rotation as rotation
from polhode._hamiltonian import _reference as document
from polhode.rotation._conversions import euler_to_matrix_k

# theory section 8.2: angles, rotation angle, axis of K, quaternion of K
TRUTH = [
    (
        (0.5, 1.2, 0.8),
        1.70783138319998929,
        (0.11192958449298595, -0.74059233798050348, -0.66256679439872265),
        (0.65703631139511745, 0.08437911673942801, -0.55830214706728218, -0.49948189431313227),
    ),
    (
        (2.5, 1.2, 1.9),
        2.12724006233112780,
        (0.19089296307526033, 0.61710505418024499, 0.76337489397644207),
        (0.48571093148497343, 0.16686326042747078, 0.53942355814441148, 0.66728087659870504),
    ),
    (
        (-2.5, 0.7, -1.9),
        1.97009894185231332,
        (-0.12160482301069053, 0.39311533376432158, -0.91141242112443512),
        (0.55282189102986753, -0.10133323092295520, 0.32758278750335894, -0.75947946018335839),
    ),
    (
        (1.0, 2.0, np.pi - 1),
        np.pi,
        (0.45464871341284084, -0.70807341827357119, -0.54030230586813971),
        (0.0, 0.45464871341284084, -0.70807341827357119, -0.54030230586813971),
    ),
    (
        (0.4, np.pi, -0.7),
        np.pi,
        (-0.52268722893065916, -0.85252452205950574, 0.0),
        (0.0, -0.52268722893065916, -0.85252452205950574, 0.0),
    ),
    (
        (0.3, 1e-8, -0.299999999),
        1.004987562112089027e-8,
        (-0.29405359561127697, -0.95059533599164565, -0.09950371902099891),
        (
            0.99999999999999998,
            -1.477601030918356644e-9,
            -4.776682446366830594e-9,
            -4.999999999999999933e-10,
        ),
    ),
]
ANGLES = np.array([row[0] for row in TRUTH]).T
REVERSED = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def random_angles():
    rng = np.random.default_rng(5)
    return tuple(
        jnp.asarray(rng.uniform(low, high, 500))
        for low, high in [(-np.pi, np.pi), (0, np.pi), (-np.pi, np.pi)]
    )


def test_robust_axis_angle_of_published_cases():
    axis, angle = jax.jit(rotation.euler_to_axis_angle)(*jnp.asarray(ANGLES))
    quaternion = rotation.canonical(rotation.euler_to_wxyz(*jnp.asarray(ANGLES)))
    for number, (_, true_angle, true_axis, true_quaternion) in enumerate(TRUTH):
        of_r = np.array(true_axis) * [1, -1, -1]
        # the axis of a half turn has either sign; rounded input angles move the small case by
        # 1e-16/1e-8 relative
        sign = np.sign(axis[number] @ of_r) if true_angle == np.pi else 1.0
        tolerance = 1e-7 if true_angle < 1e-3 else 1e-15
        np.testing.assert_allclose(sign * axis[number], of_r, rtol=0, atol=tolerance)
        np.testing.assert_allclose(angle[number], true_angle, rtol=tolerance)
        of_q = np.array(true_quaternion) * [1, 1, -1, -1]
        sign = np.sign(quaternion[number] @ of_q)
        np.testing.assert_allclose(sign * quaternion[number], of_q, rtol=0, atol=4e-16)


def test_identity_of_published_case():
    phi, theta, psi = (jnp.asarray(value) for value in (0.3, 0.0, -0.3))
    axis, angle = rotation.euler_to_axis_angle(phi, theta, psi)
    assert angle == 0
    np.testing.assert_array_equal(axis, [0, 0, 1])


def test_relations_of_k_to_r(random_angles):
    phi, theta, psi = random_angles
    k = document.matrix_k(phi, theta, psi)
    r = rotation.euler_to_matrix
    swapped = jnp.swapaxes(r(psi, theta, phi), -1, -2)
    for same in (
        euler_to_matrix_k(phi, theta, psi),
        r(-phi, -theta, -psi),
        r(jnp.pi - phi, theta, jnp.pi - psi),
        swapped,
        REVERSED @ r(phi, theta, psi) @ REVERSED,
    ):
        np.testing.assert_allclose(k, same, rtol=0, atol=3e-15)
    assert np.abs(k - r(phi, theta, psi)).max() > 1
    assert np.abs(k - jnp.swapaxes(r(phi, theta, psi), -1, -2)).max() > 1


def test_printed_formulas_agree_with_the_robust_form(random_angles):
    phi, theta, psi = random_angles
    total = np.abs(psi + phi)
    assert (total < np.pi).sum() > 100
    assert (total > np.pi).sum() > 100
    axis, angle = rotation.euler_to_axis_angle(phi, theta, psi)
    np.testing.assert_allclose(
        document.trace_k(phi, theta, psi), 1 + 2 * jnp.cos(angle), atol=4e-15
    )
    for cosine in (document.cos_angle, document.cos_angle_half):
        np.testing.assert_allclose(cosine(phi, theta, psi), jnp.cos(angle), atol=4e-15)
    sine = document.sin_angle(phi, theta, psi)
    np.testing.assert_allclose(sine, jnp.sin(angle), atol=4e-15)
    of_k = axis * jnp.array([[1.0, -1.0, -1.0]])
    far = np.asarray(sine) > 1e-2
    by_sine = jnp.stack(document.axis_by_sine(phi, theta, psi), axis=-1)
    np.testing.assert_allclose(by_sine[far], of_k[far], atol=1e-12)
    by_half = jnp.stack(document.axis_by_half_angles(phi, theta, psi), axis=-1)
    np.testing.assert_allclose(by_half, of_k, atol=1e-13)
    turned = document.axis_angle_matrix(tuple(of_k.T), angle)
    np.testing.assert_allclose(turned, document.matrix_k(phi, theta, psi), atol=3e-15)


def test_both_sides_of_the_branch_give_one_rotation():
    """The axis jumps where |psi + phi| passes pi; the matrix does not."""
    gap = jnp.asarray([-1e-6, -1e-9, 0.0, 1e-9, 1e-6])
    phi, theta = jnp.full(5, 1.0), jnp.full(5, 2.0)
    psi = jnp.pi - phi + gap
    axis, angle = rotation.euler_to_axis_angle(phi, theta, psi)
    assert axis[0] @ axis[-1] < -0.999
    of_k = tuple((axis * jnp.array([[1.0, -1.0, -1.0]])).T)
    made = document.axis_angle_matrix(of_k, angle)
    np.testing.assert_allclose(made, document.matrix_k(phi, theta, psi), atol=2e-15)
