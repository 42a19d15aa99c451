"""Relations of document 000 between its forms, and its expanded equations, against autodiff."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode._hamiltonian import _reference as doc
from polhode.inertia import Inertia

MOMENTS = jnp.array([1.0, 1.7, 2.1])


@pytest.fixture(scope="module")
def states():
    """Random states with sin(theta) > 0.3, and the derivatives of the Hamiltonian by autodiff."""
    rng = np.random.default_rng(11)
    q = jnp.asarray(rng.uniform([-3, 0.4, -3], [3, 2.7, 3], (40, 3)))
    p = jnp.asarray(rng.normal(size=(40, 3)))

    @jax.jit
    def autodiff(q, p):
        equations = ph.hamiltons_equations(ph.hamiltonian(Inertia.from_moments(MOMENTS)))
        rates, (qdd, _) = jax.jvp(equations, (q, p), equations(q, p))
        return *rates, qdd

    return q, p, *autodiff(q, p)


def along(function, q, qd):
    """Derivative of a function of the angles along the motion."""
    return jax.jit(lambda q, qd: jax.jvp(function, (q,), (qd,))[1])(q, qd)


def times(matrix, vector):
    return jnp.einsum("nij,nj->ni", matrix, vector)


def close(got, want):
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


def test_combinations_of_the_inverse_moments(states):
    """Eqs. 5-7, 16, the identity before 24, and the rates 29, 30."""
    q, _, qd, _, _ = states
    ix, iy, _ = MOMENTS
    al, be, ga = doc.alpha(MOMENTS, q), doc.beta(MOMENTS), doc.gamma(MOMENTS, q)
    s, c = jnp.sin(q[:, 2]), jnp.cos(q[:, 2])
    close(al, (ix * s**2 + iy * c**2) / (ix * iy))
    close(ga, (ix * c**2 + iy * s**2) / (ix * iy))
    close(be, (ix - iy) / (ix * iy))
    close(ga - al, be * jnp.cos(2 * q[:, 2]))
    close(al * ga - s**2 * c**2 * be**2, jnp.full(40, 1 / (ix * iy)))
    rate = 2 * s * c * be * qd[:, 2]
    close(along(lambda q: doc.alpha(MOMENTS, q), q, qd), rate)
    close(along(lambda q: doc.gamma(MOMENTS, q), q, qd), -rate)


def test_velocity_form_relations(states):
    """Eqs. 17-23, 27 and 36, with the accelerations of autodiff."""
    q, p, qd, pd, qdd = states
    v, mass = doc.inverse_mass_matrix(MOMENTS, q), doc.mass_matrix(MOMENTS, q)
    rate = doc.mass_matrix_rate(MOMENTS, q, qd)
    v_rate = along(lambda q: doc.inverse_mass_matrix(MOMENTS, q), q, qd)
    close(rate, along(lambda q: doc.mass_matrix(MOMENTS, q), q, qd))
    close(times(mass, qd), p)
    close(times(rate, qd) + times(mass, qdd), pd)
    close(times(v, pd - times(rate, qd)), qdd)
    close(times(v, pd) + times(v_rate @ mass, qd), qdd)
    close(v @ mass, jnp.broadcast_to(jnp.eye(3), (40, 3, 3)))
    close(v_rate @ mass + v @ rate, jnp.zeros((40, 3, 3)))
    close(times(v, doc.generalised_force(MOMENTS, q, qd)), qdd)


def test_expanded_momentum_rates(states):
    """Eqs. 13 and 15 written out: eq. 13 holds with sin psi, not with the printed cos psi."""
    q, p, _, pd, _ = states
    ix, iy, _ = MOMENTS
    st, ct, s, c = jnp.sin(q[:, 1]), jnp.cos(q[:, 1]), jnp.sin(q[:, 2]), jnp.cos(q[:, 2])
    across = p[:, 0] - ct * p[:, 2]
    u1, u2 = across * c - st * s * p[:, 1], across * s + st * c * p[:, 1]

    def theta_rate(factor):
        return (
            ct * u1**2 / (ix * st**3)
            - u1 * (c * st * p[:, 2] - ct * s * p[:, 1]) / (ix * st**2)
            + ct * u2**2 / (iy * st**3)
            - factor * (s * st * p[:, 2] + ct * c * p[:, 1]) / (iy * st**2)
        )

    close(theta_rate(u2), pd[:, 1])
    printed = theta_rate(across * c + st * c * p[:, 1])
    assert np.median(np.abs(printed - pd[:, 1])) > 0.05
    close(u1 * u2 / (ix * st**2) - u1 * u2 / (iy * st**2), pd[:, 2])
