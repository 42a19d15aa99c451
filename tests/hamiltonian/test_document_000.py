"""Autodiff of the Hamiltonian gives the closed forms of document 000 (corrected)."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import polhode as ph
from polhode import rotation
from polhode._hamiltonian import _reference as doc, rates_from_angle_rates
from polhode.inertia import Inertia

# theory section 8.1: I, q, qd and 20-digit results, recomputed from rotation matrices
MOMENTS, Q, QD = (1.0, 1.7, 2.1), (0.3, 1.1, 0.7), (0.4, -0.6, 0.9)
P = (1.2556915811678615133, -0.7227394926819728157, 2.2710207419974850057)
H = 1.4899194979370323999
ACCELERATIONS = (-0.90230604131951434591, -0.60974440927554360484, 0.1450195329307836778)
DRIVEN = (-1.1164689893415615021, -0.52589158872709294859, 0.38502015836379465543)
PRINTED_EQ_39 = -0.39019028674671222915


BODIES = [
    (1.0, 1.7, 2.1),
    (2.0, 2.0, 1.0),
    (1.0, 1.0, 1.0),
    (0.01, 1.0, 1.0005),
    (3e-4, 2e-4, 4e-4),
]


def random_states(moments, dtype, n=1000):
    """Angles with sin(theta) >= 0.1, and momenta that correspond to body rates of order 1."""
    rng = np.random.default_rng(7)
    q = np.stack([rng.uniform(-3, 3, n), rng.uniform(0.11, 3.03, n), rng.uniform(-3, 3, n)], -1)
    qd = rng.normal(size=(n, 3))
    q, qd, moments = (jnp.asarray(x, dtype) for x in (q, qd, moments))
    p = jnp.einsum("nij,nj->ni", doc.mass_matrix(moments, q), qd)
    return moments, q, qd, p


def deviation(got, want, scale):
    return jnp.max(jnp.abs(got - want) / scale)


@jax.jit
def deviations(moments, q, qd, p) -> dict[str, jax.Array]:
    """Largest deviation of autodiff from each closed form, relative to the size of its terms.

    It therefore measures rounding, not cancellation.
    """
    dtype = q.dtype
    hamiltonian = ph.hamiltonian(Inertia.from_moments(moments))
    equations = ph.hamiltons_equations(hamiltonian)
    rate_q, rate_p = equations(q, p)
    V, Vi = doc.inverse_mass_matrix(moments, q), doc.mass_matrix(moments, q)
    hessian = jax.vmap(jax.hessian(hamiltonian, argnums=1))(q, p)
    energy = hamiltonian(q, p)
    theta, psi = doc.theta_form(moments, q), doc.psi_form(moments, q)

    def size(form, vector):
        return jnp.einsum("ni,nij,nj->n", jnp.abs(vector), jnp.abs(form), jnp.abs(vector))

    def norm(matrix):
        return jnp.max(jnp.abs(matrix), axis=(-1, -2), keepdims=True)

    def accelerations(q, p):
        rates = equations(q, p)
        return jax.jvp(lambda q, p: equations(q, p)[0], (q, p), rates)[1]

    qdd = jax.vmap(accelerations)(q, p)
    force = jnp.sum(jnp.abs(Vi), axis=-1) * jnp.max(jnp.abs(qd), axis=-1, keepdims=True) ** 2
    scale = jnp.einsum("nij,nj->ni", jnp.abs(V), force)
    vel_theta, vel_psi = doc.theta_velocity_form(moments, q), doc.psi_velocity_form(moments, q)
    half = jax.vmap(jax.jacfwd(lambda q: doc.mass_matrix(moments, q)))(q) / 2
    rate = jnp.einsum("nijk,nk->nij", 2 * half, qd)
    sums = jnp.einsum("nij,njk->nik", jnp.abs(V), jnp.abs(Vi))
    return {
        "H, eq. 1": deviation(energy, doc.energy(moments, q, p), size(V, p)),
        "d2H/dp2 = V, eq. 11": deviation(hessian, V, norm(V)),
        "dq/dt = V p, eqs. 8-10": deviation(
            rate_q,
            qd,
            jnp.abs(V @ jnp.abs(p)[..., None])[..., 0]
            + jnp.einsum("nij,nj->ni", jnp.abs(V), jnp.abs(p)),
        ),
        "-dH/dphi = 0, eq. 12": jnp.max(jnp.abs(rate_p[:, 0])),
        "-dH/dtheta = p.Theta p, eq. 14": deviation(
            rate_p[:, 1], doc.quadratic(theta, p), size(theta, p) + size(V, p)
        ),
        "-dH/dpsi = p.Psi p, eq. 15": deviation(
            rate_p[:, 2], doc.quadratic(psi, p), size(psi, p) + size(V, p)
        ),
        "V V^-1 = 1, eqs. 22, 24": deviation(V @ Vi, jnp.eye(3, dtype=dtype)[None], sums + 1),
        "V^-1 Theta V^-1, eq. 25": deviation(vel_theta, half[..., 1], norm(Vi)),
        "V^-1 Psi V^-1, eq. 26": deviation(vel_psi, half[..., 2], norm(Vi)),
        "T = d(V^-1)/dt, eqs. 31-35": deviation(
            doc.mass_matrix_rate(moments, q, qd), rate, norm(Vi) * norm(qd[..., None])
        ),
        "x, after eq. 36": deviation(
            doc.generalised_force(moments, q, qd),
            rate_p - jnp.einsum("nij,nj->ni", rate, qd),
            force + (size(theta, p) + size(psi, p) + size(V, p))[:, None],
        ),
        "accelerations, eqs. 37-39": deviation(qdd, doc.accelerations(moments, q, qd), scale),
    }


@pytest.mark.parametrize("dtype", [pytest.param(jnp.float32, marks=pytest.mark.slow), jnp.float64])
@pytest.mark.parametrize("moments", BODIES)
def test_autodiff_is_document_000(moments, dtype):
    tolerance = 450 * float(jnp.finfo(dtype).eps)  # 1e-13 in float64
    worst = {k: float(v) for k, v in deviations(*random_states(moments, dtype)).items()}
    assert max(worst.values()) <= tolerance, worst


def test_twenty_digit_vectors():
    moments, q, qd, p = (jnp.array(x) for x in (MOMENTS, Q, QD, P))

    def close(got, want):
        np.testing.assert_allclose(got, want, rtol=4e-15, atol=1e-15)

    hamiltonian = ph.hamiltonian(Inertia.from_moments(moments))
    close(hamiltonian(q, p), H)
    close(ph.hamiltons_equations(hamiltonian)(q, p)[0], QD)
    close(doc.accelerations(moments, q, qd), ACCELERATIONS)
    V = doc.inverse_mass_matrix(moments, q)
    force = jnp.stack(generalised_force(q, (0.2, -0.1, 0.3)))
    close(doc.accelerations(moments, q, qd) + V @ force, DRIVEN)
    state = ph.State.from_euler(*Q, rates=QD)
    close(
        state.omega_body, (-0.65918380697998376784, -0.22925269463149862813, 1.0814384485702309551)
    )
    back = state.canonical(Inertia.from_moments(moments))
    close(back[0], Q)
    close(back[1], P)


def generalised_force(q, torque):
    from polhode._hamiltonian import canonical_from_momentum

    return canonical_from_momentum(tuple(q), tuple(jnp.array(n) for n in torque))


def test_vectors_file(shared):
    rigid = json.loads((shared / "spec" / "vectors.json").read_text())["rigid"]
    moments, q, qd = (jnp.array([float(x) for x in rigid["input"][k]]) for k in ("I", "q", "qd"))
    forms = {
        "V": doc.inverse_mass_matrix(moments, q),
        "Vinv": doc.mass_matrix(moments, q),
        "Theta": doc.theta_form(moments, q),
        "Psi": doc.psi_form(moments, q),
        "A_th": doc.theta_velocity_form(moments, q),
        "A_ps": doc.psi_velocity_form(moments, q),
        "Tm": doc.mass_matrix_rate(moments, q, qd),
        "x": doc.generalised_force(moments, q, qd),
        "qdd": doc.accelerations(moments, q, qd),
        "R": rotation.wxyz_to_matrix(rotation.euler_to_wxyz(*q)),
        "w_body": jnp.stack(rates_from_angle_rates(tuple(q), tuple(qd))),
    }
    for name, value in forms.items():
        want = np.array(rigid[name], dtype=float)
        np.testing.assert_allclose(value, want, rtol=1e-14, atol=1e-15, err_msg=name)


def printed_eq_39(moments, q, qd):
    """Eq. 39 as printed: no theta' psi' term, and -2 Ix Iy/Iz sin^2 theta without beta."""
    ix, iy, iz = moments
    st, ct, s, c = jnp.sin(q[1]), jnp.cos(q[1]), jnp.sin(q[2]), jnp.cos(q[2])
    al, be, ga = doc.alpha(moments, q), doc.beta(moments), doc.gamma(moments, q)
    f, h, g = qd
    sin2, k = 2 * s * c, ix * iy
    return (
        sin2 / 2 * (iz * be * ct**2 - k * be * (al + ga) * ct**2 - 2 * k / iz * st**2) * f**2
        + (ct**2 / st * (k * al * (al + ga) - iz * al) + st * (k / iz * (al - ga) + 1)) * f * h
        + sin2 * ct / 2 * (iz * be - k * be * (al + ga)) * f * g
        + k / (2 * iz) * sin2 * be * h**2
    )


def test_printed_eq_39_fails():
    moments, q, qd, p = (jnp.array(x) for x in (MOMENTS, Q, QD, P))
    equations = ph.hamiltons_equations(ph.hamiltonian(Inertia.from_moments(moments)))
    qdd = jax.jvp(lambda q, p: equations(q, p)[0], (q, p), equations(q, p))[1]
    printed = printed_eq_39(moments, q, qd)
    np.testing.assert_allclose(printed, PRINTED_EQ_39, rtol=1e-14)  # as printed
    assert abs(printed - qdd[2]) > 0.5
    np.testing.assert_allclose(doc.accelerations(moments, q, qd)[2], qdd[2], rtol=1e-13)


def test_other_misprints_fail():
    """The check rejects eq. 14 with its stray p_theta, and eq. 10 with sin psi."""
    moments, q, p = (jnp.array(x) for x in (MOMENTS, Q, P))
    rate_q, rate_p = ph.hamiltons_equations(ph.hamiltonian(Inertia.from_moments(moments)))(q, p)
    stray = doc.theta_form(moments, q).at[2, 1].multiply(p[1])
    assert abs(doc.quadratic(stray, p) - rate_p[1]) > 0.1
    st, ct, s, c = jnp.sin(q[1]), jnp.cos(q[1]), jnp.sin(q[2]), jnp.cos(q[2])
    u1 = (p[0] - ct * p[2]) * c - st * s * p[1]
    for sine, holds in ((s, False), (c, True)):
        u2 = (p[0] - ct * p[2]) * s + st * sine * p[1]
        psi_dot = (
            -c * ct * u1 / (moments[0] * st**2)
            - s * ct * u2 / (moments[1] * st**2)
            + p[2] / moments[2]
        )
        assert bool(abs(psi_dot - rate_q[2]) < 1e-14) is holds


@pytest.mark.parametrize(
    ("symmetric", "moments"),
    [
        (Inertia.axisymmetric([2.0, 3.0], 1.0), [[2.0, 2.0, 1.0], [3.0, 3.0, 1.0]]),
        (Inertia.spherical(1.5), [1.5, 1.5, 1.5]),
    ],
    ids=["axisymmetric", "spherical"],
)
def test_matrices_of_symmetric_bodies(symmetric, moments):
    q = jnp.broadcast_to(jnp.array(Q), jnp.shape(jnp.array(moments)))
    got = ph.hamiltonian_matrices(symmetric, q)
    for matrix, want in zip(got, ph.hamiltonian_matrices(Inertia.from_moments(moments), q)):
        np.testing.assert_array_equal(matrix, want)


def test_hamiltons_equations_of_angles_and_momenta_that_broadcast(unchecked):
    equations = ph.hamiltons_equations(ph.hamiltonian(Inertia.from_moments(MOMENTS)))
    momenta = jnp.array([P, [1.0, 2.0, 3.0]])
    for angles in (Q, jnp.array(Q)):
        for got, want in zip(equations(angles, momenta), equations(jnp.array([Q, Q]), momenta)):
            np.testing.assert_array_equal(got, want)
    for got, want in zip(
        equations(np.array([1, 1, 1]), [1, 2, 3]), equations([1.0] * 3, [1.0, 2, 3])
    ):
        np.testing.assert_array_equal(got, want)
    bodies = Inertia.from_moments([MOMENTS, [1.0, 1.0, 1.0]])  # a batch of their own
    of_bodies = ph.hamiltons_equations(ph.hamiltonian(bodies))
    for got, want in zip(of_bodies(Q, P), equations(Q, P)):
        assert got.shape == (2, 3)
        np.testing.assert_allclose(got[0], want, rtol=1e-15)
    total = ph.hamiltons_equations(lambda q, p: jnp.sum(p**2) / 2)  # a sum over all bodies
    np.testing.assert_allclose(total(jnp.array([Q, Q]), momenta)[0], momenta, rtol=1e-15)
