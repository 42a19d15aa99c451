"""Both coordinates follow from the one Hamiltonian and describe the same motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import rotation
from polhode._hamiltonian import Attitude, Hamiltonian, from_quaternion, inverse_inertia


def skew_potential(matrix, t):
    """A potential that depends on all entries of R and on t."""
    return matrix[0, 1] * 0.3 - matrix[2, 2] + 0.2 * matrix[1, 0] * matrix[2, 1] * jnp.cos(t)


SCENES = {
    "general_tensor": ph.Scene(
        ph.Inertia.from_tensor([[1.0, 0.1, 0.2], [0.1, 1.5, -0.1], [0.2, -0.1, 1.25]])
    ),
    "weight": ph.Scene(
        ph.Inertia.from_moments([1.0, 1.5, 2.0]),
        ph.UniformGravity(1.0, [0.1, -0.2, 0.3], [0.5, 0.25, -2.0]),
    ),
    "any_potential_and_torques": ph.Scene(
        ph.Inertia.from_moments([1.0, 1.5, 2.0]),
        ph.Potential(skew_potential)
        + ph.GravityGradient(0.5, lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0 * t + 0.5])),
        ph.BodyTorque([0.1, 0.0, -0.1])
        + ph.SpaceTorque(lambda t: jnp.stack([0 * t, jnp.sin(t), 0 * t]))
        + ph.LinearDamping(0.05),
    ),
}


@pytest.mark.slow  # faster: a heavy top in both, test_one_hamiltonian
@pytest.mark.parametrize("name", ["weight", "general_tensor"])
def test_both_charts_give_the_same_motion(name):
    """All other torques: tests/torques/test_every_torque.py."""
    scene = SCENES[name]
    state = ph.State.from_euler(0.3, 1.1, 0.7, rates=[0.4, -0.6, 0.9])
    ts = jnp.linspace(0, 3, 4)
    one, other = (
        ph.simulate(scene, state, ts, method, rtol=1e-12)
        for method in (ph.LiePoisson(), ph.EulerAngles())
    )
    angle = rotation.angle_between(one.wxyz, other.wxyz)
    assert float(jnp.max(angle)) < 2e-10
    np.testing.assert_allclose(one.omega_body, other.omega_body, atol=2e-10)
    np.testing.assert_allclose(one.energy, other.energy, rtol=1e-9)
    if scene.torque is None:
        np.testing.assert_allclose(one.energy, one.energy[0], rtol=1e-10)


def test_potential_torque_is_the_slope_along_body_turns():
    """N_k = -dV along a small rotation about body axis k, for any potential."""
    from polhode._hamiltonian._lie_poisson import rates_and_torque

    scene = SCENES["any_potential_and_torques"]
    wxyz = rotation.normalise(jnp.array([0.7, -0.3, 0.5, 0.2]))

    def energy(turn):
        turned = rotation.multiply(wxyz, rotation.rotation_vector_to_wxyz(turn))
        return scene.potential.energy(from_quaternion(tuple(turned)), 0.3, scene.inertia)

    @jax.jit
    def both(momentum, wxyz):
        attitude = from_quaternion(tuple(wxyz))
        _, torque = rates_and_torque(scene.hamiltonian, tuple(momentum), attitude, 0.3)
        return jnp.stack(torque), jax.jacfwd(energy)(jnp.zeros(3))

    torque, slope = both(jnp.array([0.3, 0.2, 0.1]), wxyz)
    np.testing.assert_allclose(torque, -slope, atol=1e-14)


def test_gravity_gradient_torque_is_three_mu_over_r_cubed():
    from polhode._hamiltonian._lie_poisson import rates_and_torque

    inertia = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    place, mu = jnp.array([3.0, -1.0, 2.0]), 7.0
    scene = ph.Scene(inertia, ph.GravityGradient(mu, place))
    wxyz = rotation.normalise(jnp.array([0.7, -0.3, 0.5, 0.2]))
    _, torque = rates_and_torque(
        scene.hamiltonian, tuple(jnp.zeros(3)), from_quaternion(tuple(wxyz)), 0.0
    )
    r = np.linalg.norm(place)
    n = np.asarray(rotation.wxyz_to_matrix(wxyz)).T @ np.asarray(place) / r
    np.testing.assert_allclose(
        jnp.stack(torque), 3 * mu / r**3 * np.cross(n, np.array([1.0, 1.5, 2.0]) * n), atol=1e-15
    )


def test_only_the_rows_that_are_looked_at_are_computed():
    class LooksUp(ph.AbstractPotential):
        core_ranks = {}  # noqa: RUF012

        def energy(self, attitude, t, inertia):
            return attitude.row(2)[0] ** 2

    inertia = ph.Inertia.from_moments([1.0, 1.5, 2.0])
    attitude = from_quaternion(tuple(jnp.array([1.0, 0.0, 0.0, 0.0])))
    hamiltonian = Hamiltonian(inverse_inertia(inertia), inertia, LooksUp())
    assert hamiltonian.rows_used(attitude, 0.0) == (2,)
    assert attitude.used == ()
    assert Hamiltonian(inverse_inertia(inertia), inertia).rows_used(attitude, 0.0) == ()


def test_attitude_of_angles_and_quaternion_agree():
    from polhode._hamiltonian import from_euler_angles

    angles = (0.3, 1.1, 0.7)
    wxyz = rotation.euler_to_wxyz(*angles)
    one = from_euler_angles(*(jnp.array(a) for a in angles))
    other = from_quaternion(tuple(wxyz))
    np.testing.assert_allclose(one.matrix, other.matrix, atol=4e-16)
    assert isinstance(one, Attitude)
    vector = tuple(jnp.array([0.2, -0.5, 0.7]))
    back = one.to_body(one.to_space(vector))
    np.testing.assert_allclose(jnp.stack(back), jnp.stack(vector), atol=4e-16)
