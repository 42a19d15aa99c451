"""Autodiff of the one Hamiltonian against the closed forms of document 000.

    python -m benchmarks.document_000

prints the largest relative deviation of every formula, over 1,000 random states with
sin(theta) >= 0.1 for each of several bodies, in float32 and float64. Each deviation is divided by
the size of the terms that the formula adds up, so that it measures rounding, not cancellation.
"""

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode.hamiltonian import document_000 as doc
from polhode.inertia import Inertia

BODIES = [
    (1.0, 1.7, 2.1), (2.0, 2.0, 1.0), (1.0, 1.0, 1.0), (0.01, 1.0, 1.0005), (3e-4, 2e-4, 4e-4)
]  # fmt: skip


def random_states(moments, dtype, n=1000):
    """Angles with sin(theta) >= 0.1, momenta of the size that the body's rates of order 1 give."""
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
    """Largest deviation of autodiff from each closed form, relative to the size of its terms."""
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
        "dq/dt = V p, eqs. 8-10": deviation(rate_q, qd, jnp.abs(V @ jnp.abs(p)[..., None])[..., 0]
            + jnp.einsum("nij,nj->ni", jnp.abs(V), jnp.abs(p))),
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
    }  # fmt: skip


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    worst = {}
    for dtype in (jnp.float32, jnp.float64):
        for moments in BODIES:
            found = deviations(*random_states(moments, dtype))
            for name, value in found.items():
                row = worst.setdefault(name, {})
                row[dtype] = max(row.get(dtype, 0.0), float(value))
    print(f"{'formula':<34}{'float32':>10}{'float64':>10}")
    for name, row in worst.items():
        print(f"{name:<34}{row[jnp.float32]:>10.1e}{row[jnp.float64]:>10.1e}")
    largest = max(row[jnp.float64] for row in worst.values())
    print(f"largest in float64: {largest:.1e}")


if __name__ == "__main__":
    main()
