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
# # Explorer 1: a body that loses energy
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/explorer.ipynb)
#
# On 1 February 1958 Explorer 1, a tube of 2 m, was released with a spin of 750 revolutions per
# minute about its long axis. Within an orbit it was rotating end over end. No torque acted on it:
# four whip antennas bent and dissipated rotational energy as heat, at constant angular momentum.
# How much power did they dissipate?

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
mass, length, radius = 14.0, 2.03, 0.076  # kg, m: a uniform tube, filled
C = mass * radius**2 / 2
A = mass * (3 * radius**2 + length**2) / 12
L = C * 750 * 2 * np.pi / 60
print(f"moments {A:.2f} and {C:.3f} kg m^2, momentum {L:.2f} kg m^2/s")
print(f"energy {L**2 / (2 * C):.0f} J spinning along, {L**2 / (2 * A):.1f} J end over end, there"
      f" {60 / (2 * np.pi) * L / A:.1f} turns a minute")  # fmt: skip

# %% [markdown]
# ## A sink, and the angle in closed form
# `ph.EnergySink(k)` dissipates $k\,|L\times\omega|^2$ watts at constant $L$ in space. For the angle
# $\theta$ between the axis and $L$, this body has
# $\tan\theta=\tan\theta_0\,\exp(kL^2(1/C-1/A)\,t)$. The next cell simulates three rates of
# dissipation, starting 0.1° from the axis:

# %%
theta0 = np.deg2rad(0.1)
growth = np.array([0.1, 0.15, 0.25])  # 1/s
k = growth / (L**2 * (1 / C - 1 / A))
start = ph.State([1.0, 0, 0, 0], [L * np.sin(theta0) / A, 0.0, L * np.cos(theta0) / C])
ts = jnp.linspace(0.0, 120.0, 481)
scene = ph.Scene(ph.Inertia.axisymmetric(A, C), torque=ph.EnergySink(k))
path = ph.simulate(scene, start, ts, rtol=1e-8)

momentum = path.momentum_body
theta = np.arctan2(np.hypot(momentum[..., 0], momentum[..., 1]), momentum[..., 2])
formula = np.arctan(np.tan(theta0) * np.exp(growth[:, None] * np.asarray(ts)))
fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.4))
for i, g in enumerate(growth):
    left.plot(ts, np.rad2deg(theta[i]), color=f"C{i}", label=f"{g:.2f} /s")
    left.plot(ts[::24], np.rad2deg(formula[i, ::24]), "o", color=f"C{i}", markersize=4)
    right.plot(ts, path.energy[i], color=f"C{i}")
left.set(xlabel="s", title="Angle from the long axis (°); dots: the formula")
left.legend(title="growth")
right.axhline(L**2 / (2 * A), color="0.6", linestyle="--")
right.set(xlabel="s", title="Energy (J); dashed: the least for this momentum", yscale="log")
plt.show()
drift = jnp.linalg.norm(path.momentum_space - path.momentum_space[:, :1], axis=-1) / L
print(f"largest difference from the formula {np.rad2deg(np.abs(theta - formula).max()):.1e}°")
print(f"momentum in space: within {float(drift.max()):.0e} of where it was")
print(f"the energy only fell: {bool(jnp.all(jnp.diff(path.energy) < 1e-9))}")

# %% [markdown]
# ## The loss within one orbit
# The time to reach an angle is inversely proportional to `k`. The next cell computes the `k` for
# which the body goes from 0.1° to 80° within one orbit of 115 minutes:

# %%
orbit = 115 * 60.0
rate = np.log(np.tan(np.deg2rad(80.0)) / np.tan(theta0)) / orbit
most = rate * L**2 * (1 / C - 1 / A) / 4  # at 45 degrees
print(f"growth {rate:.1e} /s; the antennas need to turn at most {most:.3f} W into heat")

# %% [markdown]
# The power is a few hundredths of a watt. The angle at any time is differentiable; from an angle
# that was observed after a minute, Newton's method on the simulation determines `k`:


# %%
def angle(log_k):
    scene = ph.Scene(ph.Inertia.axisymmetric(A, C), torque=ph.EnergySink(jnp.exp(log_k)))
    momentum = ph.simulate(scene, start, jnp.array([0.0, 60.0]), rtol=1e-8).momentum_body[-1]
    return jnp.arctan2(jnp.hypot(momentum[0], momentum[1]), momentum[2])


both = jax.jit(jax.value_and_grad(angle))
seen, x = np.deg2rad(35.0), jnp.log(k[1])
for _ in range(6):
    value, slope = both(x)
    x = x - jnp.log(jnp.tan(value) / jnp.tan(seen)) * jnp.sin(2 * value) / (2 * slope)
exact = np.log(np.tan(seen) / np.tan(theta0)) / 60
print(f"growth {float(jnp.exp(x)) * L**2 * (1 / C - 1 / A):.6f} /s, by the formula {exact:.6f} /s")

# %% [markdown]
# ## A nutation damper
# Satellites that should rotate about the axis of their largest moment carry a ring of fluid. It is
# modelled as a wheel with friction, `ph.Rotor(..., coupling=ph.ViscousCoupling(c))`, which
# exchanges angular momentum with the body and damps the nutation of this disk.

# %%
disk = ph.Inertia.from_moments([1.0, 1.1, 1.6])
tipped = ph.State([1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 2.0])
friction = jnp.array([0.003, 0.03, 0.3])
ring = ph.Rotor([1.0, 0.0, 0.0], inertia=0.05, speed=0.0, coupling=ph.ViscousCoupling(friction))
ts = jnp.linspace(0.0, 200.0, 801)
calm = ph.simulate(ph.Scene(disk, rotors=ring), tipped, ts, record=ph.Record(work=True))
momentum = calm.momentum_body
wobble = np.arctan2(np.hypot(momentum[..., 0], momentum[..., 1]), momentum[..., 2])
fig, ax = plt.subplots(figsize=(7.2, 3.2))
for i, c in enumerate(friction):
    ax.plot(
        ts, np.rad2deg(wobble[i]), color=f"C{i}", label=f"c = {float(c):g} N m s", linewidth=0.9
    )
ax.set(xlabel="s", yscale="log", title="Wobble with a ring damper (°)")
ax.legend()
plt.show()
balance = calm.energy - calm.work
print("heat in the rings (J):", np.round(-calm.motor_work[:, -1, 0], 4))
print(f"energy less work is constant to {float(jnp.ptp(balance, axis=-1).max()):.0e} J")
