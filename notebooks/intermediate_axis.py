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
# # The intermediate axis: why a body turns over
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/intermediate_axis.ipynb)
#
# In 1985 Vladimir Dzhanibekov unscrewed a wing nut in orbit: it flew off rotating, turned over,
# and turned over again, without a torque. Rotation about the axes of the smallest and the largest
# moment of inertia is stable; rotation about the intermediate axis is not.

# %%
# Needs polhode with its figures, installed from a checkout or from an archive of a release (on
# Colab: upload the archive first). Remove the # in front of one line:
# # %pip install '..[all]'
# # %pip install './polhode-<version>.tar.gz[all]'

# %%
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image

import polhode as ph
from polhode import plot

jax.config.update("jax_enable_x64", True)
plt.rcParams.update({"figure.dpi": 80, "axes.spines.top": False, "axes.spines.right": False})

nut = ph.Inertia.from_moments([1.0, 2.0, 2.5])  # kg m^2: least about x, greatest about z
scene = ph.Scene(nut)

# %% [markdown]
# ## Rotation about each axis
# Three bodies rotate at 1 rad/s, each about another axis, with the same perturbation of one per
# cent. One call simulates all three.

# %%
push = 0.01
omega = jnp.full((3, 3), push).at[jnp.arange(3), jnp.arange(3)].set(1.0)
ts = jnp.linspace(0.0, 60.0, 1201)
three = ph.simulate(scene, ph.State([1.0, 0.0, 0.0, 0.0], omega), ts)

fig, panels = plt.subplots(1, 3, figsize=(10, 2.8), sharey=True, layout="constrained")
for k, (ax, name) in enumerate(zip(panels, ("least", "intermediate", "greatest"), strict=True)):
    ax.plot(ts, three.omega_body[k], label=["x", "y", "z"])
    ax.set(title=f"about the axis of {name} inertia", xlabel="time (s)")
panels[0].set_ylabel("body rates (rad/s)")
panels[0].legend(loc="center right", frameon=False)
plt.show()

# %% [markdown]
# ## The polhode
# Energy and the magnitude of the angular momentum are constant. Each is an ellipsoid in the space
# of body rates, and the angular velocity moves along their intersection, the **polhode**. Around
# the axes of the smallest and the largest moment these curves are small closed loops. The two
# curves of the separatrix (dashed) pass through the intermediate axis; a body that starts near it
# follows them to the opposite side of the ellipsoid: it turns over.

# %%
fig = plt.figure(figsize=(8.6, 3.1), layout="constrained")
for k in range(3):
    plot.polhode(three, body=k, ax=fig.add_subplot(1, 3, k + 1, projection="3d"), view=(22, 35))
plt.show()

# %% [markdown]
# In space, the angular velocity moves in a plane normal to the angular momentum, along the
# **herpolhode**. For a stable axis it is confined to a narrow ring around the momentum; for the
# intermediate axis it spirals outward from the centre and returns to it with every flip.

# %%
fig, panels = plt.subplots(1, 3, figsize=(8.6, 3.1), layout="constrained")
for k, ax in enumerate(panels):
    plot.herpolhode(three, body=k, ax=ax)
plt.show()

# %% [markdown]
# ## The flip
# Faces on the negative side of a body axis are paler. The box turns over; its angular momentum
# is constant.

# %%
flip = ph.simulate(scene, ph.State([1.0, 0.0, 0.0, 0.0], omega[1]), jnp.linspace(0.0, 32.0, 801))
with tempfile.TemporaryDirectory() as folder:
    movie = Path(folder) / "flip.gif"
    plot.animate(flip, movie, seconds=5.4, fps=10, dpi=45)
    plt.close("all")
    picture = Image(movie.read_bytes(), alt="A box spinning about its intermediate axis turns over")
picture  # noqa: B018

# %% [markdown]
# ## How often?
# Near the axis a perturbation grows as $e^{\lambda t}$ with $\lambda =
# \omega\sqrt{(I_2-I_1)(I_3-I_2)/(I_1I_3)}$, so the time between flips depends on the logarithm of
# the perturbation: a perturbation ten times smaller adds only $\ln 10/\lambda$. The exact period is
# a complete elliptic integral, which `ph.periods` evaluates also for perturbations that no
# integrator resolves.

# %%
small, middle, great = 1.0, 2.0, 2.5
growth = np.sqrt((middle - small) * (great - middle) / (small * great))
pushes = jnp.logspace(-15, -0.5, 59)
tilted = jnp.stack([pushes, jnp.ones_like(pushes), pushes], axis=-1)
body = ph.periods(nut, ph.State([1.0, 0.0, 0.0, 0.0], tilted))

measured = []
for size in (1e-2, 1e-6, 1e-10):
    start = ph.State([1.0, 0.0, 0.0, 0.0], [size, 1.0, size])
    fine = jnp.linspace(0.0, 240.0, 24001)
    about_y = np.asarray(ph.simulate(scene, start, fine).omega_body[:, 1])
    crossings = np.flatnonzero(np.diff(np.sign(about_y)))
    measured.append(float(fine[crossings[1]] - fine[crossings[0]]))

fig, ax = plt.subplots(figsize=(8, 3.4), layout="constrained")
ax.semilogx(pushes, body.P_psi / 2, color="C0", label="half of ph.periods(...).P_psi")
slope = -2 * np.log(np.asarray(pushes)) / growth
offset = float(body.P_psi[8] / 2 - slope[8])
ax.semilogx(pushes, slope + offset, "--", color="0.5", label=r"$-(2/\lambda)\ln$ push + constant")
ax.semilogx([1e-2, 1e-6, 1e-10], measured, "o", color="C1", label="simulated")
ax.set(xlabel="sideways push (rad/s)", ylabel="between two flips (s)")
ax.legend(frameon=False)
plt.show()
for size, seen in zip((1e-2, 1e-6, 1e-10), measured, strict=True):
    start = ph.State([1.0, 0.0, 0.0, 0.0], [size, 1.0, size])
    exact = float(ph.periods(nut, start).P_psi) / 2
    print(f"push {size:.0e}: flips every {seen:.2f} s, ph.periods gives {exact:.4f} s")

# %% [markdown]
# ## Internal friction
# Real bodies bend and contain fluids: they lose energy, but no angular momentum, and end in a
# rotation about the axis of the *largest* moment of inertia, as Explorer 1 did in 1958.
# `ph.FeedbackTorque` accepts any torque that depends on the state. A torque along
# $L\times(L\times\omega)$ removes energy and does not change the magnitude of the momentum, but its
# direction in space drifts; `ph.EnergySink` avoids this.


# %%
def rubbing(t, wxyz, omega_body):
    """A torque normal to the momentum that lowers the energy."""
    momentum = nut.diagonal * omega_body
    return 0.03 * jnp.cross(momentum, jnp.cross(momentum, omega_body))


long = jnp.linspace(0.0, 600.0, 3001)
slow = ph.simulate(
    ph.Scene(nut, torque=ph.FeedbackTorque(rubbing)),
    ph.State([1.0, 0.0, 0.0, 0.0], [1.0, 0.02, 0.02]),
    long,
    rtol=1e-8,
)
fig, ax = plt.subplots(figsize=(8, 3), layout="constrained")
ax.plot(long, slow.omega_body, label=["x (least)", "y", "z (greatest)"], linewidth=0.9)
ax.set(xlabel="time (s)", ylabel="body rates (rad/s)")
ax.legend(loc="center right", frameon=False)
plt.show()
size = jnp.linalg.norm(slow.momentum_space, axis=-1)
print(f"momentum changed by {float(jnp.ptp(size) / size[0]):.1e} of itself,"
      f" energy fell to {float(slow.energy[-1] / slow.energy[0]):.4f} of its start;"
      f" {small / great} belongs to spin about z")  # fmt: skip
