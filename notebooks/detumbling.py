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
# # Detumbling a satellite: tuning a gain by its derivative
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/detumbling.ipynb)
#
# A small satellite tumbles after its release. Three magnetorquers damp its rotation in the Earth's
# magnetic field by the B-dot law: their moment is `k` times $\omega\times B$. With a small gain `k`
# this takes a long time. A large gain damps only the rate normal to the field, until the direction
# of the field has changed. The best gain is in between; the derivative of the simulation determines
# it.

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
body = ph.Inertia.from_moments([0.03, 0.035, 0.01])  # a 3U cubesat, kg m^2
start = ph.State([1.0, 0.0, 0.0, 0.0], np.deg2rad([2.0, -3.0, 4.0]))
orbit = ph.KeplerOrbit(3.986e14, 6.9e6, inclination=np.deg2rad(97.5))
earth = ph.DipoleField([0.0, 0.0, -7.8e22])
period = 2 * np.pi / float(orbit.mean_motion)


def scene(k):
    return ph.Scene(body, torque=ph.MagneticDipole(ph.BDot(k), earth, orbit))


def degrees(path):
    return np.rad2deg(np.linalg.norm(path.omega_body, axis=-1))


# %% [markdown]
# ## Three gains

# %%
ts = jnp.linspace(0.0, period, 201)
gains = (2e3, 2e4, 2e7)
fig, ax = plt.subplots(figsize=(7.6, 3.3))
for k in gains:
    path = ph.simulate(scene(k), start, ts, rtol=1e-8)
    ax.semilogy(ts / 60, degrees(path), label=f"k = {k:.0e}")
    print(f"k = {k:.0e}: {degrees(path)[-1]:.3f} deg/s after one orbit")
ax.set(xlabel="min", title="Rate (°/s)")
ax.legend(title="A m² s/T")
plt.show()

# %% [markdown]
# ## The loss and its derivative
# Not every loss is suitable for gradient-based tuning. Near the best gain the energy at the end of
# the orbit varies by orders of magnitude, and the energy of a single satellite varies abruptly with
# the gain, because its motion passes close to the separatrix. The mean kinetic energy over the
# orbit and over 32 directions of the initial rate is smooth near the best gain. For a single
# parameter, forward mode (`jax.jvp`) is cheapest. The derivative with respect to `log k` includes
# orbit, field, control law and motion; here it is compared with central differences.

# %%
directions = np.random.default_rng(0).normal(size=(32, 3))
directions /= np.linalg.norm(directions, axis=1, keepdims=True)
starts = ph.State([1.0, 0.0, 0.0, 0.0], np.deg2rad(5.4) * directions)


def loss(log_k):
    """Mean kinetic energy over one orbit, relative to the start."""
    energy = ph.simulate(scene(jnp.exp(log_k)), starts, ts, rtol=1e-8).energy
    return jnp.mean(jnp.mean(energy, axis=-1) / energy[:, 0])


@jax.jit
def value_and_derivative(log_k):
    return jax.jvp(loss, (log_k,), (jnp.ones_like(log_k),))


grid = jnp.log(jnp.logspace(3.3, 7.3, 17))
curve = np.array([value_and_derivative(x) for x in grid])

h = 1e-4
for x, (_, derivative) in zip(grid[8::2], curve[8::2], strict=True):
    difference = (value_and_derivative(x + h)[0] - value_and_derivative(x - h)[0]) / (2 * h)
    print(
        f"k = {float(jnp.exp(x)):7.2g}: derivative {derivative:+.5f},"
        f" central difference {float(difference):+.5f}"
    )

# %% [markdown]
# The derivative changes sign once on this grid. Bisection on its sign, between the two outer gains,
# finds the minimum:

# %%
print("changes of sign:", np.count_nonzero(np.diff(np.sign(curve[:, 1]))))
low, high = jnp.log(gains[0]), jnp.log(gains[2])
for _ in range(10):
    middle = (low + high) / 2
    low, high = (middle, high) if value_and_derivative(middle)[1] < 0 else (low, middle)
best = float(jnp.exp(middle))
print("mean energy, as a fraction of the energy at the start:")
for k in (*gains, best):
    print(f"k = {k:8.3g} A m^2 s/T: {float(value_and_derivative(jnp.log(k))[0]):.4f}")

fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.3))
left.loglog(np.exp(grid), curve[:, 0], "o-", markersize=3)
left.axvline(best, color="C1", label="minimum")
left.set(xlabel="k (A m² s/T)", title="Mean energy, relative to the start")
left.legend()
for k in (gains[0], best, gains[2]):
    path = ph.simulate(scene(k), start, ts, rtol=1e-8)
    right.semilogy(ts / 60, degrees(path), label=f"k = {k:.1e}")
right.set(xlabel="min", title="Rate (°/s)")
right.legend(title="A m² s/T")
plt.show()

# %% [markdown]
# This gain is optimal for these rates and this orbit. Real magnetorquers saturate:
# `ph.BDot(k, max_moment=...)` limits their moment, and derivatives take the limit into account.
#
# ## Pointing
# Once the rates are small, reaction wheels take over: three motors with limits control the attitude
# by a PD law. A thruster fires for 20 ms; integration steps end at the edges of the pulse.


# %%
def wheel(i):
    def law(t, wxyz, omega_body, speed):
        return 2e-3 * jnp.sign(wxyz[0]) * wxyz[1 + i] + 8e-3 * omega_body[i]

    axis = np.eye(3)[i]
    drive = ph.Motor(law, max_torque=1e-3, max_speed=600.0) + ph.ViscousCoupling(1e-8)
    return ph.Rotor(axis, inertia=1e-5, speed=0.0, coupling=drive)


kick = ph.Pulses(ph.BodyTorque([0.0, 0.01, 0.0]), [60.0], [60.02])
holding = ph.Scene(body, torque=kick, rotors=wheel(0) + wheel(1) + wheel(2))
tipped = ph.State([0.9, 0.3, -0.2, 0.245], [0.0, 0.0, 0.0])
times = jnp.linspace(0.0, 140.0, 281)
held = ph.simulate(holding, tipped, times, rtol=1e-7, record=ph.Record(work=True))
off = 2 * np.arccos(np.clip(np.abs(held.wxyz[:, 0]), 0, 1))
fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.2))
left.plot(times, np.rad2deg(off))
left.set(xlabel="s", title="Angle from the target attitude (°)")
right.plot(times, held.wheel_speed)
right.set(xlabel="s", title="Wheel speeds (rad/s)")
plt.show()
balance = held.energy - held.work
print(f"fastest wheel {float(jnp.abs(held.wheel_speed).max()):.0f} rad/s of 600")
print(f"energy less the work of motors and thruster: constant to {float(jnp.ptp(balance)):.0e} J")
