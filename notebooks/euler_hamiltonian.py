# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # The Hamiltonian in Euler angles and its singular attitudes
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/euler_hamiltonian.ipynb)
#
# With ZYZ Euler angles $q=(\varphi,\theta,\psi)$ and their momenta $p$, the kinetic energy of a
# rigid body is a quadratic form, $H=\tfrac12\,p\cdot V(q)\,p$. Hamilton's equations are
# $\dot q = Vp$, $\dot p_\varphi=0$, $\dot p_\theta=p\cdot\Theta p$, $\dot p_\psi=p\cdot\Psi p$,
# with matrices that are long when written out. In polhode the Hamiltonian is written once, and
# `jax.grad` derives the equations. This notebook answers two questions:
#
# 1. Does automatic differentiation agree with the closed forms?
# 2. What happens at $\theta=0$ and $\theta=\pi$?

# %%
# Needs polhode with its figures, installed from a checkout or from an archive of a release (on
# Colab: upload the archive first). Remove the # in front of one line:
# # %pip install '..[all]'
# # %pip install './polhode-<version>.tar.gz[all]'

# %%
import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # no warnings of the compiler

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from diffrax import Dopri8

import polhode as ph

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(
    {
        "figure.dpi": 80,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "figure.constrained_layout.use": True,
    }
)
moments = jnp.array([1.0, 1.7, 2.1])  # kg m^2
body = ph.Inertia.from_moments(moments)

# %% [markdown]
# ## 1. Autodiff against the closed forms
# `ph.hamiltonian` is the Hamiltonian; `ph.hamiltons_equations` differentiates it.
# `ph.hamiltonian_matrices` returns the closed forms for comparison; no simulation uses them.

# %%
hamiltonian = ph.hamiltonian(body)
equations = jax.jit(ph.hamiltons_equations(hamiltonian))

q = jnp.array([0.3, 1.1, -0.4])  # phi, theta, psi (rad)
p = jnp.array([0.5, -0.2, 1.5])  # their momenta (N m s)
rate_q, rate_p = equations(q, p)
V, Theta, Psi = ph.hamiltonian_matrices(body, q)
print("V, from d2H/dp2:\n", jax.hessian(hamiltonian, argnums=1)(q, p))
print("V, closed form:\n", V)
print("dq/dt     ", rate_q, "\nV p       ", V @ p)
print("dp/dt     ", rate_p, "\n0, pTp, pPp", jnp.array([0.0, p @ Theta @ p, p @ Psi @ p]))

# %% [markdown]
# The next cell compares 20,000 random states, some of them within a thousandth of a radian of a
# pole ($\theta = 0$ or $\pi$). Every deviation is divided by the size of the terms of the closed
# form.

# %%
rng = np.random.default_rng(0)
count = 20_000
distance = 10 ** rng.uniform(-3, np.log10(np.pi / 2), count)
theta = np.where(rng.random(count) < 0.5, distance, np.pi - distance)
q = jnp.stack([rng.uniform(-3, 3, count), theta, rng.uniform(-3, 3, count)], axis=-1)
p = jnp.asarray(rng.normal(size=(count, 3)))
rate_q, rate_p = equations(q, p)


def quadratic(form, vector):
    return jnp.einsum("ni,nij,nj->n", vector, form, vector)


def size(form, vector):
    return quadratic(jnp.abs(form), jnp.abs(vector))


V, Theta, Psi = ph.hamiltonian_matrices(body, q)
rows = {
    r"$\dot q$ and $Vp$": jnp.max(
        jnp.abs(rate_q - jnp.einsum("nij,nj->ni", V, p))
        / jnp.einsum("nij,nj->ni", jnp.abs(V), jnp.abs(p)),
        axis=-1,
    ),
    r"$\dot p_\theta$ and $p\cdot\Theta p$": jnp.abs(rate_p[:, 1] - quadratic(Theta, p))
    / size(Theta, p),
    r"$\dot p_\psi$ and $p\cdot\Psi p$": jnp.abs(rate_p[:, 2] - quadratic(Psi, p))
    / (size(Psi, p) + size(V, p)),
}
fig, ax = plt.subplots(figsize=(8, 3.2))
for label, deviation in rows.items():
    ax.loglog(distance, np.maximum(deviation, 1e-17), ".", markersize=2, alpha=0.4, label=label)
    print(f"{label:42s} largest deviation {float(deviation.max()):.1e}")
ax.axhline(np.finfo(float).eps, color="0.5", linewidth=1)
ax.set(xlabel="distance from the nearer pole (rad)", ylabel="relative deviation")
ax.legend(markerscale=5, loc="upper right", ncols=3)
ax.set_ylim(5e-18, 3e-13)
plt.show()

# %% [markdown]
# The two agree to rounding.
#
# ## 2. The poles
# At $\theta=0$ the first and the third rotation have the same axis: only $\varphi+\psi$ is defined.
# The motion is regular there, but $V$ grows as $1/\sin^2\theta$. When a body passes a pole at
# distance $\delta$, its angles $\varphi$ and $\psi$ change by about $\pi$ within a time
# proportional to $\delta$, which an integrator in these coordinates must resolve. The next cells
# simulate bodies that pass the pole at eight distances by three methods: the closed form,
# integration in quaternion and body momentum, and integration in Euler angles, the latter two with
# the same solver and tolerance.

# %%
closest = np.logspace(0, -7, 8)
# at the nearest point the body z axis moves sideways; every body is then led 1.5 s back
near = ph.State(ph.rotation.euler_to_wxyz(0.0 * closest, closest, 0.0 * closest), [1.0, 0.0, 0.3])
back = ph.simulate(ph.Scene(body), near, [0.0, -1.5])
start = ph.State(back.wxyz[:, -1], back.omega_body[:, -1])
ts = jnp.linspace(0.0, 3.0, 601)

exact = ph.simulate(ph.Scene(body), start, ts)
runs = {
    "Euler angles": ph.EulerAngles(Dopri8()),
    "Lie-Poisson (quaternion)": ph.LiePoisson(Dopri8()),
}
results = {
    name: ph.simulate(ph.Scene(body), start, ts[jnp.array([0, -1])], method, rtol=1e-9, throw=False)
    for name, method in runs.items()
}

# %%
errors = {
    name: np.asarray(ph.rotation.angle_between(run.wxyz[:, -1], exact.wxyz[:, -1]))
    for name, run in results.items()
}
fig, (left, middle, right) = plt.subplots(1, 3, figsize=(10.5, 3.2))
phi, theta, psi = exact.euler()
for index in (0, 1, 3):
    turned = np.unwrap(np.asarray(phi[index]))
    left.plot(ts, turned - turned[0], label=f"passes at {closest[index]:.0e} rad")
left.set(xlabel="time (s)", ylabel=r"$\varphi$ (rad)", title="The same turn, near the pole")
left.legend(fontsize=8, loc="lower left")
for name, run in results.items():
    middle.loglog(closest, errors[name], "o-", label=name)
    right.semilogx(closest, run.steps, "o-", label=name)
middle.set(xlabel="closest approach (rad)", ylabel="attitude error (rad)", title="Error")
right.set(xlabel="closest approach (rad)", ylabel="steps", title="Work", ylim=0)
middle.legend(fontsize=8)
plt.show()
for name, run in results.items():
    print(f"{name:24s} steps {np.asarray(run.steps)}, worst error {errors[name].max():.1e} rad,"
          f" finished {int(run.successful.sum())} of {len(closest)}")  # fmt: skip

# %% [markdown]
# Integration in quaternion and body momentum is not affected by the poles. Euler angles need more
# steps at every approach. polhode uses them for derivations and tests: `method=None` never selects
# them, and the status of the result reports a body that comes too close to a pole.
