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
# # A tumbling asteroid, compared with radar observations
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/tumbling_asteroid.ipynb)
#
# Toutatis, a rock of 4.6 km that passes the Earth every four years, tumbles.
# Radar images of December 1992 gave its attitude on seventeen days. The scene `toutatis`, which is
# part of polhode, contains a published state and the published observations, with sources.
# Does a free rigid body explain the observations? How accurately are its two periods known?

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
from polhode import files, plot

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
DAY = 86400.0

file = files.read_scene(files.shipped_scenes()["toutatis"])
scene = files.build_scene(file, jnp.float64)
state = files.build_state(file, jnp.float64, scene.inertia)
seen = file.observations
print(file.title, "-", file.source)
print("moments (relative):", scene.inertia.diagonal, "about", file.axis_names)

# %% [markdown]
# ## The motion
# Torques are negligible within two months, so the motion has a closed form: `ph.simulate` evaluates
# it at any set of times, here also at those of the observations. The state applies at the first
# time.

# %%
ts = DAY * jnp.linspace(0.0, 45.0, 901)
path = ph.simulate(scene, state, ts)
at_sight = ph.simulate(scene, state, np.append(0.0, seen.seconds)).wxyz[1:]
observed = files.build_attitudes(seen.attitudes, np.float64)

fig, panels = plt.subplots(3, 1, figsize=(9, 5.2), sharex=True)
per_day = np.rad2deg(1.0) * DAY
for k, ax in enumerate(panels):
    ax.plot(ts / DAY, path.omega_body[:, k] * per_day, color=f"C{k}")
    ax.plot(seen.seconds / DAY, seen.omega_body[:, k] * per_day, "o", color="0.2", markersize=4)
    ax.set_ylabel(f"{file.axis_names[k]} (°/d)")
panels[0].set_title("Body rates: the exact motion and the radar observations", loc="left")
panels[-1].set_xlabel(f"days after {file.epoch:%Y-%m-%d %H:%M} UTC")
plt.show()

apart = np.rad2deg(ph.rotation.angle_between(at_sight, observed))
print("angle between observed and computed attitude (deg):", np.round(apart, 1))
print(f"median {np.median(apart):.1f}, largest {apart.max():.1f}")

# %% [markdown]
# The attitudes were determined from radar images. The state was fitted to the apparitions of 1992
# to 2008 together, with tidal torques, which the free body omits, and not to these days alone.
#
# ## Two periods
# A tumbling body has two periods: the long axis precesses about the angular momentum (`P_phi`), and
# the body rotates about its long axis (`P_psi`).

# %%
periods = ph.periods(scene.inertia, state)
print("mode:", ph.Mode(int(periods.mode)).name, "(it turns fully about its long axis)")
print(f"P_psi = {float(periods.P_psi) / DAY:.4f} d, P_phi = {float(periods.P_phi) / DAY:.4f} d")
for item in file.published:
    print(f"published {item.name} = {item.value / DAY:.2f} +- {item.uncertainty / DAY:.2f} d:"
          f" {item.source}")  # fmt: skip

# %% [markdown]
# ## Uncertainty of the periods
# The derivative of a period is one `jax.grad`. Which of the six parameters of state
# and shape matters most?


# %%
def period(moments, omega_body):
    return (
        ph.periods(ph.Inertia.from_moments(moments), ph.State(state.wxyz, omega_body)).P_psi / DAY
    )


slopes = jax.grad(period, argnums=(0, 1))(scene.inertia.diagonal, state.omega_body)
moments_error = 0.01 * np.array([1, 1, 0]) * np.asarray(scene.inertia.diagonal)
rates_error = np.full(3, 0.08 / per_day)
parts = np.concatenate([np.asarray(slopes[0]) * moments_error, np.asarray(slopes[1]) * rates_error])
names = [f"moment, {name}" for name in file.axis_names] + [f"rate, {n}" for n in file.axis_names]
for name, part in zip(names, parts, strict=True):
    print(f"{name:22s} {part:+.4f} d for one standard deviation")
print(f"together               {np.sqrt(np.sum(parts**2)):.4f} d (to first order)")

# %% [markdown]
# To avoid linearisation, simulate 20,000 clones drawn from the same errors in one call:

# %%
rng = np.random.default_rng(4179)
clones = 20_000
moments = np.asarray(scene.inertia.diagonal) + moments_error * rng.normal(size=(clones, 3))
rates = np.asarray(state.omega_body) + rates_error * rng.normal(size=(clones, 3))
drawn = ph.periods(ph.Inertia(diagonal=moments), ph.State(state.wxyz, rates))

fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.6))
for ax, values, item in (
    (left, drawn.P_psi, file.published[0]),
    (right, drawn.P_phi, file.published[1]),
):
    ax.hist(np.asarray(values) / DAY, bins=80, density=True, color="C0", alpha=0.7)
    value, error = item.value / DAY, item.uncertainty / DAY
    ax.axvspan(value - error, value + error, color="C1", alpha=0.25)
    ax.axvline(value, color="C1", label="published")
    ax.set(xlabel=f"{item.name} (d)", yticks=[])
    ax.legend()
plt.show()
for name in ("P_psi", "P_phi"):
    values = np.asarray(getattr(drawn, name)) / DAY
    print(f"{name}: {values.mean():.3f} +- {values.std():.3f} d")

# %% [markdown]
# ## Polhode and path of the short axis
# Left, the polhode: the angular velocity circulates about the long axis. Right, the direction of
# the short axis, seen along the angular momentum: the two periods are incommensurate, so the path
# does not close.

# %%
fig = plt.figure(figsize=(9.6, 4.2))
plot.polhode(path, ax=fig.add_subplot(1, 2, 1, projection="3d"), axis_names=tuple(file.axis_names))
sky = fig.add_subplot(1, 2, 2, projection="polar")
momentum = np.asarray(path.momentum_space[0])
pole = momentum / np.linalg.norm(momentum)
first = np.cross([0.0, 0.0, 1.0], pole)
first /= np.linalg.norm(first)
short_axis = np.asarray(ph.rotation.rotate(path.wxyz, jnp.array([0.0, 1.0, 0.0])))
azimuth = np.arctan2(short_axis @ np.cross(pole, first), short_axis @ first)
sky.plot(azimuth, np.rad2deg(np.arccos(short_axis @ pole)), linewidth=0.9)
sky.set_title("Short axis: angle from the momentum (°)")
plt.show()
low, high = np.rad2deg([float(periods.theta_min), float(periods.theta_max)])
print(f"the long axis stays between {low:.1f}° and {high:.1f}° from the angular momentum")

# %% [markdown]
# ## The inverse problem: Halley's nucleus
# From light curves and images of 1986, Belton et al. (1991) inferred that the long axis of Halley's
# nucleus is 66° from the angular momentum and precesses about it in 3.69 d, and that the nucleus
# rotates about that axis in 7.1 d. For an axisymmetric body these three numbers determine the ratio
# of the moments: with the angle $\theta$ and the rate $n$ of the precession about the momentum
# $L=I_s\,n$, the rotation rate about the long axis is $\dot\psi=(I_s/I_l-1)\,n\cos\theta$.

# %%
theta, P_phi, P_psi = np.deg2rad(66.0), 3.69 * DAY, 7.1 * DAY
ratio = 1 + (P_phi / P_psi) / np.cos(theta)
n = 2 * np.pi / P_phi
nucleus = ph.Inertia.from_moments([ratio, ratio, 1.0])
spin = ph.State([1.0, 0.0, 0.0, 0.0], [n * np.sin(theta), 0.0, ratio * n * np.cos(theta)])
halley = ph.periods(nucleus, spin)
momentum = nucleus.diagonal * spin.omega_body
total, size = (float(jnp.linalg.norm(v)) for v in (spin.omega_body, momentum))
tilt = np.rad2deg(np.arccos(float(spin.omega_body @ momentum) / (total * size)))
print(f"I_short / I_long = {ratio:.4f}; mode {ph.Mode(int(halley.mode)).name}")
print(f"P_phi = {float(halley.P_phi) / DAY:.3f} d, P_psi = {float(halley.P_psi) / DAY:.3f} d")
print(f"total spin {2 * np.pi / total / DAY:.3f} d (published 2.84 d),"
      f" {tilt:.2f}° from the momentum (published 21.4°)")  # fmt: skip
