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
# # Detumbling: a gain tuned by its gradient
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/detumbling.ipynb)
# (there, run `%pip install 'polhode[all]'` first)
#
# A small satellite leaves its launcher tumbling. Three rods in the field of the Earth brake it by
# the B-dot law. With a small gain that takes long; with a large one only the rate across the field
# is braked, and the rest waits for the field to turn. The gradient through the law finds the gain.

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
gains = (2e3, 2e4, 2e6)
fig, ax = plt.subplots(figsize=(7.6, 3.3))
for k in gains:
    path = ph.simulate(scene(k), start, ts, rtol=1e-7)
    ax.semilogy(ts / 60, degrees(path), label=f"k = {k:.0e}")
    print(f"k = {k:.0e}: {degrees(path)[-1]:.3f} deg/s after one orbit")
ax.set(xlabel="min", title="Rate (°/s)")
ax.legend(title="A m² s/T")
plt.show()

# %% [markdown]
# ## The gradient through the law
# Loss: the logarithm of the kinetic energy after one orbit. Its derivative by `log k` goes through
# orbit, field, law and motion; Newton's method on the derivative would do, a few steps along
# it are enough.


# %%
def loss(log_k):
    end = ph.simulate(scene(jnp.exp(log_k)), start, jnp.array([0.0, period]), rtol=1e-7)
    return jnp.log(end.energy[-1] / end.energy[0])


value_and_slope = jax.jit(jax.value_and_grad(loss))
x, step, seen = jnp.log(gains[0]), 1.0, []
last = None
for _ in range(14):
    value, slope = value_and_slope(x)
    seen.append((float(jnp.exp(x)), float(value), float(slope)))
    if last is not None and slope * last < 0:  # the valley lies behind
        step = step / 3
    last = slope
    x = x - step * jnp.sign(slope)
best = min(seen, key=lambda row: row[1])
for k, value, slope in seen:
    print(f"k = {k:9.3g}: energy {np.exp(value):.2e} of the start, slope by log k {slope:+.3f}")
print(f"best gain {best[0]:.3g} A m^2 s/T")

# %%
fig, ax = plt.subplots(figsize=(7.6, 3.3))
for k in (gains[0], best[0], gains[2]):
    path = ph.simulate(scene(k), start, ts, rtol=1e-7)
    ax.semilogy(ts / 60, degrees(path), label=f"k = {k:.1e}")
ax.set(xlabel="min", title="Rate (°/s): the tuned gain between two others")
ax.legend(title="A m² s/T")
plt.show()

# %% [markdown]
# ## And then point
# At rest, wheels take over: three motors with limits hold the attitude by a PD law. A thruster
# pushes for 20 ms in between; no step misses it.


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
left.set(xlabel="s", title="Angle from the attitude wanted (°)")
right.plot(times, held.wheel_speed)
right.set(xlabel="s", title="Wheel speeds (rad/s)")
plt.show()
balance = held.energy - held.work
print(f"fastest wheel {float(jnp.abs(held.wheel_speed).max()):.0f} rad/s of 600")
print(f"energy less the work of motors and thruster: constant to {float(jnp.ptp(balance)):.0e} J")
