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
# # Spin state and inertia from a light curve
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/light_curve.ipynb)
#
# A telescope sees an asteroid as a point whose brightness changes. Do these changes determine its
# rotation, shape and inertia? This notebook simulates an asteroid and its observation, and
# estimates all three from the light curve alone.

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
from scipy.spatial import ConvexHull

import polhode as ph
from polhode import lightcurve

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
rng = np.random.default_rng(4)

# %% [markdown]
# ## The asteroid
# The asteroid is the convex hull of 60 random points near an egg-shaped surface. It is not an
# ellipsoid, so the model of the search has the wrong shape, as for every real asteroid. Its moments
# are those of constant density.

# %%
corners = rng.normal(size=(60, 3))
corners /= np.linalg.norm(corners, axis=1, keepdims=True)
corners *= np.array([1.0, 0.62, 0.45]) * (1 + 0.15 * corners[:, :1])
hull = ConvexHull(corners)
a, b, c = (corners[hull.simplices[:, k]] for k in range(3))
outward = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=1) > 0
faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])
rock = ph.MassProperties.from_mesh(corners, faces, density=1.0)
moments, axes = np.linalg.eigh(np.asarray(rock.central.full))
axes *= np.linalg.det(axes)  # right-handed: long, middle, short
rock_mesh = (corners - np.asarray(rock.centre)) @ axes
inertia = ph.Inertia.from_moments(moments)
state = ph.State(rng.normal(size=4), 2 * np.pi * np.array([0.9, 0.25, 0.6]))  # rad / day
truth = ph.periods(inertia, state)
mode = ph.Mode(int(truth.mode)).name
print("moments", moments / moments.max())
print(f"{mode}, P_phi {truth.P_phi:.4f} d, P_psi {truth.P_psi:.4f} d")

# %% [markdown]
# ## The observations
# Two telescopes at longitudes 120 degrees apart observe in 18 nights within 90 days; a night has
# six hours, and some points are missing. The asteroid orbits at 1.8 au, the Earth at 1 au. The
# brightness of a convex body is a sum over the facets that are lit and visible, by the
# Lommel-Seeliger law. The noise is 0.02 mag, and the zero points of the nights also differ by 0.02
# mag.

# %%
nights = np.sort(rng.choice(90, 18, replace=False)) + rng.choice([0, 1 / 3], 18)
clear = rng.uniform(size=(18, 22)) > 0.1
jd = np.sort(nights[:, None] + rng.uniform(0, 0.25, clear.shape), axis=1)[clear]
night = np.nonzero(clear)[0]


def circle(radius, angle, tilt):
    return radius * np.stack(
        [np.cos(angle), np.sin(angle) * np.cos(tilt), np.sin(angle) * np.sin(tilt)], axis=-1
    )


place = circle(1.8, 0.25 + 2 * np.pi * jd / (365.25 * 1.8**1.5), 0.1)
sun, earth = -place, circle(1.0, 2 * np.pi * jd / 365.25, 0.0) - place
path = ph.simulate(ph.Scene(inertia), state, jd - jd[0])
to_body = ph.rotation.conjugate(path.wxyz)
units = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (sun, earth)]
in_body = [ph.rotation.rotate(to_body, jnp.asarray(v)) for v in units]
light = lightcurve.Convex.from_mesh(rock_mesh, faces).brightness(*in_body)
magnitude = -2.5 * np.log10(light) + 0.02 * rng.normal(size=jd.size)
magnitude = magnitude + 0.02 * rng.normal(size=18)[night]
curve = lightcurve.LightCurve.of(
    jd, magnitude, *units, sigma=0.02, group=night, calibrated=True, at_body=True, reduced=True
)

fig, ax = plt.subplots(figsize=(9, 3))
ax.plot(curve.t - curve.t[0], curve.magnitude, ".", color="0.3", markersize=4)
ax.invert_yaxis()
ax.set(xlabel="days", ylabel="magnitude", title=f"{curve.t.size} points, and nothing else")
plt.show()

# %% [markdown]
# From here on only `curve` is used: times, magnitudes, and the directions of Sun and Earth.
#
# ## Frequencies
# The brightness of a tumbling body is not periodic. It is a Fourier series in the frequencies i
# f_phi + j f_psi. The spectrum contains lines at such combinations and their aliases at one cycle
# per day, so a peak is not necessarily a frequency of the body. The search fits pairs of
# frequencies:

# %%
columns = np.vstack([curve.columns(np.inf)[0], curve.alpha])
pairs = lightcurve.fourier_lattices(curve.t, curve.magnitude, columns=columns, max_frequency=6.0)
for g, h, part in list(zip(pairs.f_phi, pairs.f_psi, pairs.explained, strict=True))[:6]:
    print(f"{part:6.1%} of the variance by sums of multiples of {g:.3f} and {h:.3f} a day")
print("as f_phi and f_psi, the first would mean:", lightcurve.meaning(*(x[0] for x in pairs[:2])))

# %% [markdown]
# Every pair has many interpretations: each line may be any of the strong combinations, in both
# modes. The search tries the most probable interpretations.
#
# ## The search
# For each interpretation, trial bodies have its periods and are otherwise random. Least-squares
# steps start from the two best bodies of each interpretation and continue from those that fit. The
# search is repeated with the periods that it has found, and the mirror images of every solution are
# tried.

# %%
fit = lightcurve.fit_light_curve(curve, pairs=pairs, floor=0.02)
print(lightcurve.table(fit))

# %%
lightcurve.figure(fit, title="An unseen rock")
plt.show()

# %% [markdown]
# ## Comparison with the truth

# %%
best = fit.best
momentum = np.asarray(ph.rotation.rotate(state.wxyz, jnp.asarray(moments * state.omega_body)))
momentum = momentum / np.linalg.norm(momentum)


def pole_error(solution):
    longitude, latitude = np.radians(solution.pole)
    pole = circle(1.0, longitude, 0.0) * np.cos(latitude) + [0, 0, np.sin(latitude)]
    return float(np.degrees(np.arccos(pole @ momentum)))


print(f"P_phi {best.P_phi:.4f} +- {best.P_phi_std:.4f} d, true {truth.P_phi:.4f}")
print(f"P_psi {best.P_psi:.4f} +- {best.P_psi_std:.4f} d, true {truth.P_psi:.4f}")
print(f"mode {best.mode.name}, true {mode}")
print("moments", np.sort(best.moments), "true", moments / moments.max())
for k, solution in enumerate(fit.solutions[:4]):
    print(f"solution {k}: pole {pole_error(solution):.0f} deg from the truth, odds"
          f" {solution.probability:.1g}")  # fmt: skip

# %% [markdown]
# The periods are right within their errors, the moments to 7 %. The last fit uses a general convex
# shape instead of an ellipsoid, so that the residuals are those of the noise. The list contains
# mirror images of the pole.
#
# The next cell compares the attitudes in each night. An ellipsoid looks the same after half a turn
# about each axis, so the nearest of four attitudes counts.

# %%
long_to_short = np.argsort(best.moments)
body = ph.Scene(ph.Inertia.from_moments(best.moments))
found = ph.simulate(body, ph.State(best.wxyz, best.omega_body), jd - jd[0])
mine = np.asarray(ph.rotation.wxyz_to_matrix(found.wxyz))[:, :, long_to_short]
mine = mine * np.array([1, 1, np.linalg.det(mine[0])])
real = np.asarray(ph.rotation.wxyz_to_matrix(path.wxyz))
turns = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
traces = np.einsum("nij,nij,ej->en", mine, real, turns)
off = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
off = min(off, key=np.median)
print(f"attitude off by {np.median(off):.1f} deg in the median, {off.max():.1f} at most")

# %% [markdown]
# ## One night
# The same asteroid is observed for six hours from one place. Many bodies explain the points to
# their noise, and the first of them may be far from the truth; the notes state what one night does
# not determine.

# %%
one = curve.group == curve.group[0]
short = curve._replace(
    t=curve.t[one], magnitude=curve.magnitude[one], sigma=curve.sigma[one],
    group=curve.group[one] * 0, names=("one",), sun=curve.sun[one], observer=curve.observer[one],
)  # fmt: skip
night_fit = lightcurve.fit_light_curve(short, floor=0.02, trials=10_000, searches=1)
print(f"{len(night_fit.solutions)} distinct bodies, rms {night_fit.best.rms:.3f} mag; the first has"
      f" P_phi {night_fit.best.P_phi:.3f} d, P_psi {night_fit.best.P_psi:.3f} d")  # fmt: skip
for note in night_fit.notes:
    print("-", note)
