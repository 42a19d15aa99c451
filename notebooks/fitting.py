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
# # Inertia from a toss
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/fitting.ipynb)
#
# A box with a gyroscope inside is thrown. It tumbles freely for a second, and the gyroscope records
# three rates two hundred times a second. What is its inertia? The recording is simulated, so that
# the answer can be checked: a box of 0.9 kg, 18 x 11 x 4 cm, a sensor that is not aligned with the
# box, white noise of 0.03 rad/s, and seven lost samples.

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

import polhode as ph
from polhode import fit, plot, rotation

jax.config.update("jax_enable_x64", True)
np.set_printoptions(precision=4, suppress=True)

box = ph.Inertia.from_box(0.9, (0.18, 0.11, 0.04))  # kg, m; about its own axes
mounting = rotation.normalise([0.95, 0.12, -0.2, 0.15])  # from the sensor's axes to the box's
ts = np.arange(201) * 0.005
thrown = ph.State([1.0, 0.0, 0.0, 0.0], [2.0, 13.0, 4.0])
toss = ph.simulate(ph.Scene(box), thrown, ts)
to_sensor = jnp.broadcast_to(rotation.conjugate(mounting), (201, 4))
rng = np.random.default_rng(5)
readings = np.asarray(rotation.rotate(to_sensor, toss.omega_body))
readings = readings + 0.03 * rng.normal(size=readings.shape)
readings[rng.choice(np.arange(5, 195), 7, replace=False)] = np.nan

file = Path(tempfile.mkdtemp()) / "toss.csv"
rows = np.column_stack([ts, readings])
np.savetxt(file, rows, "%.4f", ",", header="time_s,gyro_x,gyro_y,gyro_z", comments="")

recording = fit.read_recording(
    file, {"t": "time_s", "wx": "gyro_x", "wy": "gyro_y", "wz": "gyro_z"}, noise=0.03
)
print(recording.times.shape[-1], "rows,", int(np.sum(recording.present == 0)), "of them gaps")

# %% [markdown]
# ## The fit
#
# The model is the closed-form free motion. The unknowns are the shape of the inertia
# tensor and the rates at the first sample; every iterate is a possible body. The starting
# point comes from the data, by linear regression on the conservation of angular momentum.
#
# The simulated sensor has exact scale factors and axes, `Gyroscope.ideal()`. Those of a real sensor
# are known to about one per cent, which is the default and leads to wider intervals.

# %%
options = fit.FitOptions(trust_noise=True, gyroscope=fit.Gyroscope.ideal())
found = fit.fit_recordings([recording], options=options)
print(found.report())

# %% [markdown]
# The report states what the data do not determine. Only *ratios* of moments are determined: a body
# of twice the inertia moves in the same way. The handedness of the axes is not determined either:
# with one axis of the sensor inverted, the same data belong to the other body that the report
# names. The numbers in brackets are standard deviations from the Fisher information: no unbiased
# estimate from these data has smaller ones.

# %%
figure = plot.fit(found, recording, title="toss")
plt.show()

# %% [markdown]
# ## Comparison with the truth
#
# The next cell compares the fit with the simulated box; errors are in units of standard deviations.

# %%
true = np.sort(np.asarray(box.tensor).diagonal())
true = true / true[2]
off = (np.asarray(found.ratios) - true)[:2] / np.asarray(found.ratios_std)[:2]
print("true ratios  ", true)
print("fitted ratios", np.asarray(found.ratios))
print("off by       ", off, "standard deviations")

# %% [markdown]
# The fit also yields the directions of the principal axes in sensor axes, the columns of this
# matrix. Their uncertainty is stated as a rotation angle about each axis.

# %%
print(np.asarray(rotation.wxyz_to_matrix(found.axes)))
print("known to", np.degrees(np.asarray(found.axes_std)), "degrees")

# %% [markdown]
# ## How long must a recording be?
#
# The bound on the standard deviations can be computed before the throw. The residual function is
# public, and its Jacobian determines the bound for any body and rates; here for the same box and
# shorter and shorter recordings.

# %%
parameters, model = found.parameters, found.model


def bound(duration):
    """Standard deviation of the smaller two ratios from the samples up to `duration`."""
    early = recording.present * (recording.times - recording.times[0] <= duration)
    stacked = fit.stack([recording])
    stacked = fit.Recording(
        stacked.times, early[None], stacked.omega, omega_noise=stacked.omega_noise
    )

    def flat(shape, omega):
        moved = fit.Parameters(shape, omega)
        return fit.residuals(moved, stacked, model)["omega"].ravel()

    by_shape, by_omega = jax.jacfwd(flat, argnums=(0, 1))(parameters.shape, parameters.omega)
    jacobian = jnp.concatenate([by_shape, by_omega.reshape(by_shape.shape[0], -1)], axis=1)
    covariance = jnp.linalg.inv(jacobian.T @ jacobian)[:5, :5]

    def ratios(shape):
        moments = ph.Inertia.from_tensor(model.tensor(fit.Parameters(shape, None))).moments
        return moments[:2] / moments[2]

    slope = jax.jacfwd(ratios)(parameters.shape)
    return jnp.sqrt(jnp.diagonal(slope @ covariance @ slope.T))


durations = np.array([0.2, 0.3, 0.4, 0.6, 0.8, 1.0])
spread = np.array([bound(d) for d in durations])
fig, ax = plt.subplots(figsize=(6, 3.4), dpi=90, layout="constrained")
ax.loglog(durations, spread, "o-", label=["smallest", "middle"])
ax.set(xlabel="length of the recording [s]", ylabel="standard deviation of the ratio")
ax.set_xticks(durations, [f"{d:g}" for d in durations])
ax.minorticks_off()
ax.legend(frameon=False)
plt.show()

# %% [markdown]
# If every sample had the same information, the bound would decrease with the square root of the
# number of samples. It decreases much faster, because a small error of the inertia grows with time
# to a large error of the phase: a longer recording helps more than a higher sampling rate.

# %% [markdown]
# ## Absolute size: a reaction wheel
#
# Free motion determines only ratios. A reaction wheel of known spin inertia, switched on and off in
# flight, determines the size as well. `SteppedMotion` integrates the motion of body and wheel; the
# fit estimates drag and the delay between gyroscope and wheel together with the tensor.

# %%
rng = np.random.default_rng(3)
tensor = 1e-6 * np.array([[400.0, 15.0, -10.0], [15.0, 180.0, 8.0], [-10.0, 8.0, 500.0]])
spin_inertia, delay = 1.7e-6, 6e-4
times = np.arange(0, 0.48, 2e-3)


def wheel_speed(t):
    """Switched on after 0.1 s, off after 0.3 s, rad/s."""
    on, off = (1 - np.exp(-np.maximum(t - start, 0) / 0.03) for start in (0.1, 0.3))
    return -200 - 1100 * on + 1100 * off


flight = fit.SteppedMotion(spin_inertia, drag=fit.Drag(6e-6, 1.5e-6), steps=4)
throws = []
for _ in range(4):
    start = rng.normal(size=3)
    start *= 18 / np.linalg.norm(start)
    moved = flight(
        jnp.asarray(tensor), jnp.asarray(start), None, jnp.asarray(times),
        jnp.asarray(wheel_speed(times - delay)), {"drag": None, "delay": None},
    )  # fmt: skip
    reading = np.asarray(moved.omega) + 0.01 * rng.normal(size=moved.omega.shape)
    throws.append(fit.Recording.of(times, reading, wheel_speed=wheel_speed(times)))

# %%
motion = fit.SteppedMotion(spin_inertia, drag=fit.Drag(), fit_drag=True, fit_delay=True)
options = fit.FitOptions(motion=motion, gyroscope=fit.Gyroscope.ideal())
sized = fit.fit_recordings(throws, options=options)
true = np.linalg.eigvalsh(tensor)
print("true moments [g cm^2]  ", 1e7 * true)
print("fitted                 ", 1e7 * np.asarray(sized.moments))
print("standard deviations    ", 1e7 * np.asarray(sized.moments_std))
print("off by                 ", np.asarray((sized.moments - true) / sized.moments_std))
lag = float(sized.parameters.motion["delay"])
print(f"delay of the gyroscope  {1e3 * lag:.2f} ms, set {1e3 * delay} ms")

# %% [markdown]
# For the accuracy with real instruments and real drag see
# [what a motion reveals about the inertia](../docs/identifiability.md).
