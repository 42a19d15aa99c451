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
# # Quick start: one body, a batch, a gradient
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/quick_start.ipynb)
#
# A rigid body is described by its inertia, and its state by an attitude and body rates. polhode
# simulates one body or a batch and differentiates through the motion. Everything is JAX: arrays in,
# arrays out.

# %%
# Needs polhode with its figures, installed from a checkout or from an archive of a release (on
# Colab: upload the archive first). Remove the # in front of one line:
# # %pip install '..[all]'
# # %pip install './polhode-<version>.tar.gz[all]'

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import polhode as ph

jax.config.update("jax_enable_x64", True)  # your choice: polhode follows the dtype of its input

# %% [markdown]
# ## One body
# A wing nut spins about its intermediate axis with a small perturbation. polhode chooses the
# method; `explain` states which one and why.

# %%
inertia = ph.Inertia.from_moments([1.0, 2.0, 2.5])  # kg m^2, about body x, y, z
state = ph.State(wxyz=[1.0, 0.0, 0.0, 0.0], omega_body=[1e-3, 1.0, 1e-3])  # rad/s
scene = ph.Scene(inertia)
ts = jnp.linspace(0.0, 60.0, 601)

traj = ph.simulate(scene, state, ts)
print(ph.explain(scene, state, ts))

# %%
fig, ax = plt.subplots(figsize=(8, 3))
ax.plot(traj.ts, traj.omega_body, label=["x", "y", "z"])
ax.set(xlabel="time (s)", ylabel="body rates (rad/s)", title="The intermediate axis flips over")
ax.legend(loc="upper right", ncols=3)
fig.tight_layout()

# %% [markdown]
# Energy and the momentum in space are constant to rounding error:

# %%
print("energy drift  ", float(jnp.ptp(traj.energy) / traj.energy[0]))
print("momentum drift", float(jnp.max(jnp.ptp(traj.momentum_space, axis=0)) / 2.0))

# %% [markdown]
# ## A batch
# Any array of a scene or state may have leading axes, which are broadcast. These are a thousand
# bodies with different perturbations:

# %%
rng = np.random.default_rng(0)
push = 1e-3 * rng.normal(size=(1000, 3)) + np.array([0.0, 1.0, 0.0])
batch = ph.simulate(scene, ph.State([1.0, 0.0, 0.0, 0.0], push), ts)
print(batch.wxyz.shape, "attitudes;", int(batch.successful.sum()), "bodies finished")

fig, ax = plt.subplots(figsize=(8, 3))
ax.plot(ts, batch.omega_body[:40, :, 1].T, color="C0", alpha=0.2, linewidth=0.8)
ax.set(xlabel="time (s)", ylabel="rate about y (rad/s)", title="When it flips depends on the push")
fig.tight_layout()

# %% [markdown]
# ## A gradient
# How does the final attitude depend on the moments of inertia? Reverse mode differentiates the
# closed form:


# %%
def turned_away(moments):
    """Angle between the final and the initial body y axis, as 1 - cos."""
    end = ph.simulate(
        ph.Scene(ph.Inertia.from_moments(moments)),
        state,
        jnp.array([0.0, 20.0]),
        record=ph.Record(final_only=True),
    )
    y_axis = ph.rotation.rotate(end.wxyz[0], jnp.array([0.0, 1.0, 0.0]))
    return 1 - y_axis[1]


moments = jnp.array([1.0, 2.0, 2.5])
slope = jax.grad(turned_away)(moments)
step = 1e-6
difference = (turned_away(moments.at[1].add(step)) - turned_away(moments.at[1].add(-step))) / (
    2 * step
)
print("gradient            ", slope)
print("central difference  ", difference, "(second entry)")

# %% [markdown]
# ## Gravity
# The same call simulates a heavy top about a fixed point if the scene has a potential. The torque
# is a derivative of the Hamiltonian.

# %%
top = ph.Scene(
    ph.Inertia.from_moments([1.0, 1.5, 2.0]),
    potential=ph.UniformGravity(
        mass=1.0, centre_body=[0.0, 0.0, 0.5], gravity_space=[0.0, 0.0, -2.0]
    ),
)
lean = ph.State.from_euler(0.0, 0.5, 0.0, rates=[0.0, 0.0, 3.0])
times = jnp.linspace(0, 20, 401)
swing = ph.simulate(top, lean, times, rtol=1e-10)
phi, theta, psi = swing.euler()

fig, ax = plt.subplots(figsize=(8, 3))
ax.plot(times, theta)
ax.set(xlabel="time (s)", ylabel="theta (rad)", title="Nutation of an asymmetric heavy top")
fig.tight_layout()
print("energy drift", float(jnp.ptp(swing.energy) / abs(swing.energy[0])))
