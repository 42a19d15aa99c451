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
# # Run time against accuracy
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/work_and_precision.ipynb)
#
# A run time is meaningful only together with an error, and a constant energy does not prove that an
# attitude is accurate. This notebook shows run times together with errors. The errors are
# differences from reference solutions that share no code with the compared programs: Taylor series
# in 40-digit arithmetic (`python -m benchmarks.truth` in the repository).

# %%
# Needs polhode with its figures, installed from a checkout or from an archive of a release (on
# Colab: upload the archive first). Remove the # in front of one line:
# # %pip install '..[all]'
# # %pip install './polhode-<version>.tar.gz[all]'

# %%
import io
import math
import time

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import polhode as ph
from polhode import plot

jax.config.update("jax_enable_x64", True)


def initial_states(count, seed):
    """Attitudes, uniform on the sphere of quaternions, and rates of 1 to 2 rad/s."""
    draws = np.random.Generator(np.random.PCG64(seed)).standard_normal((count, 8))
    axis = draws[:, 4:7] / np.linalg.norm(draws[:, 4:7], axis=1, keepdims=True)
    uniform = (1 + np.vectorize(math.erf)(draws[:, 7:] / math.sqrt(2))) / 2
    return draws[:, :4] / np.linalg.norm(draws[:, :4], axis=1, keepdims=True), axis * (1 + uniform)


def attitude_errors(wxyz, reference):
    """Angle between each attitude and its reference [rad]."""
    return np.asarray(ph.rotation.angle_between(wxyz, reference))


def best_time(call, *arguments, repeats=5):
    """Shortest of several runs [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


# %% [markdown]
# ## A heavy top
# Twelve asymmetric tops about a fixed point (moments 1, 1.5 and 2 kg m², weight times arm 1 N m),
# to t = 100 s. The reference attitudes at that time:

# %%
HEAVY_TOP = np.loadtxt(
    io.StringIO("""
0.64088369283462043 -0.75746467765902004 -0.11013129738655253 0.058193227213580737
-0.33153857119162911 0.67681540425700892 -0.32564442537583854 -0.57092800999274385
-0.19413512062680943 0.72932138805165048 0.57425024151424231 -0.31723576089473665
-0.27737046476241173 0.57957748153652533 -0.75954486945835809 0.10122825422157607
-0.049875570653220444 -0.25449444308452479 0.45889582561267211 0.84979975707596977
0.17486901389591383 0.41436821176501931 -0.81831621665772669 0.35788040266647081
-0.72275662980228605 0.65305912878595052 0.19456535248269852 0.11524301280103615
0.61370637800348204 0.013354285303771559 0.67956402659647186 -0.40171990045037897
-0.10202751223090359 0.24793851586202542 -0.47694938763930789 0.83704011894926411
-0.60622897116611441 0.72872596694621694 -0.3075270500366617 -0.082897606195379017
0.57525570008982563 -0.46185852888445261 0.65934988560729391 0.14500105917027747
-0.28073062196486975 -0.51272230429926668 -0.80180769761100523 0.12413932743899599
""")
)

# %% [markdown]
# Three programs solve the same equations, each at five tolerances: polhode, diffrax with the
# quaternion and the rates as its state, and SciPy with all bodies as one system. Compilation is not
# timed. Times depend on the machine that ran this notebook: compare their ratios.

# %%
count, moments, ts = len(HEAVY_TOP), [1.0, 1.5, 2.0], jnp.array([0.0, 100.0])
wxyz, omega = initial_states(count, 22)
top = ph.Scene(
    ph.Inertia.from_moments(moments), ph.UniformGravity.axial(1.0, 1.0, [0.0, 0.0, -1.0])
)
last = ph.Record(final_only=True)


def field(t, y, args=None):
    """Rates of the quaternion and of the body rates; y: (7,) or (7, bodies)."""
    xp = np if isinstance(y, np.ndarray) else jnp
    w, x, y_, z, p, q, r = y
    a, b, c = moments
    return xp.stack(
        [
            -(x * p + y_ * q + z * r) / 2,
            (w * p + y_ * r - z * q) / 2,
            (w * q + z * p - x * r) / 2,
            (w * r + x * q - y_ * p) / 2,
            ((b - c) * q * r + 2 * (y_ * z + w * x)) / a,
            ((c - a) * r * p - 2 * (x * z - w * y_)) / b,
            (a - b) * p * q / c,
        ]
    )


@jax.jit
def by_polhode(rtol):
    return ph.simulate(top, ph.State(wxyz, omega), ts, rtol=rtol, record=last).wxyz[:, -1]


@jax.jit
def by_diffrax(rtol):
    def one(y):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field), diffrax.Dopri8(), 0.0, 100.0, None, y, max_steps=2**16,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        ).ys[-1, :4]  # fmt: skip

    return jax.vmap(one)(jnp.concatenate([jnp.asarray(wxyz), jnp.asarray(omega)], axis=1))


def by_scipy(rtol):
    start = np.concatenate([wxyz, omega], axis=1).T

    def flat(t, y):
        return field(t, y.reshape(7, count)).reshape(-1)

    solution = solve_ivp(flat, (0.0, 100.0), start.reshape(-1), "DOP853", rtol=rtol, atol=rtol)
    return solution.y[:, -1].reshape(7, count)[:4].T


programs = {"polhode": by_polhode, "diffrax, Dopri8": by_diffrax, "SciPy, DOP853": by_scipy}
tolerances = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
errors = {
    name: [np.median(attitude_errors(program(rtol), HEAVY_TOP)) for rtol in tolerances]
    for name, program in programs.items()
}
print("median attitude error [rad]")
print(f"{'rtol':18}", *(f"{rtol:8.0e}" for rtol in tolerances))
for name, row in errors.items():
    print(f"{name:18}", *(f"{error:8.0e}" for error in row))

# %% tags=["timing"]
times = {
    name: [best_time(program, rtol) / count for rtol in tolerances]
    for name, program in programs.items()
}
print("run time [us per body]")
for name, row in times.items():
    print(f"{name:18}", *(f"{1e6 * spent:8.0f}" for spent in row))
fig, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
plot.work_precision(
    {name: (errors[name], times[name]) for name in programs},
    ax=ax,
    highlight="polhode",
    time_label="run time per body [s]",
    error_label="attitude error at t = 100 s [rad], median body",
)
ax.set_title("Asymmetric heavy top, 12 bodies")
plt.show()

# %% [markdown]
# ## Conservation and accuracy
# With a loose tolerance the energy is far more accurate than the attitude: it reveals only the
# error normal to its level set, not the error along it. The bodies with the largest errors are
# chaotic.

# %%
print("rtol     energy drift   attitude error: median   worst body")
for rtol in (1e-4, 1e-6, 1e-8):
    traj = ph.simulate(top, ph.State(wxyz, omega), ts, rtol=rtol)
    energy = np.asarray(traj.energy)
    drift = np.abs(energy[:, -1] - energy[:, 0]).max() / np.ptp(energy[:, 0])
    off = attitude_errors(traj.wxyz[:, -1], HEAVY_TOP)
    print(f"{rtol:.0e}  {drift:12.0e} {np.median(off):23.0e} {off.max():12.0e} rad")

# %% [markdown]
# ## Closed forms
# The free motion has a closed form, whose error is the rounding error of the angle for any time
# span. The two reference tables are for moments (1, 2, 3) kg m²: after 10⁵ s, and after 100 s near
# the separatrix, where textbook formulas lose half of their digits because the modulus is within
# rounding error of one. polhode computes with the complement of the modulus instead.

# %%
LONG = np.loadtxt(
    io.StringIO("""
-0.62493206054325767 -0.37469339658241685 0.59244839356624612 0.34361268780920207
0.39045517077389819 -0.17189619467969877 -0.85466485932824887 -0.29587909033926285
-0.64057669406027351 -0.61086112380099866 -0.3697708482358269 0.28245301600504968
0.7336708612421069 0.24316866559549566 0.054656689299792616 0.63214611740606075
""")
)
SEPARATRIX = np.loadtxt(
    io.StringIO("""
0.61593092453810716 0.59233403112888849 -0.51056206969386175 0.095372243101196769
-0.30887557417373701 -0.78193781032302434 -0.39408061187018428 0.37130797434757506
-0.88840058593584603 0.25536974687135611 0.020590737059016786 -0.3809287503445643
-0.29113541319937297 0.27599472776656492 -0.49956694140885383 -0.76778900257667981
""")
)

free = ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))
start = ph.State(*initial_states(4, 11))
end = ph.simulate(free, start, [0.0, 1e5], record=last).wxyz[:, -1]
print(f"to t = 1e5 s: worst error {attitude_errors(end, LONG).max():.0e} rad")

draws = np.random.Generator(np.random.PCG64(15)).standard_normal((4, 8))
uniform = (1 + np.vectorize(math.erf)(draws[:, 7:] / math.sqrt(2))) / 2
push = 10 ** (4 * uniform - 6) * draws[:, 4:7] * np.array([1.0, 0.0, 1.0])
attitudes = draws[:, :4] / np.linalg.norm(draws[:, :4], axis=1, keepdims=True)
start = ph.State(attitudes, np.array([0.0, 1.5, 0.0]) + push)
end = ph.simulate(free, start, [0.0, 100.0], record=last).wxyz[:, -1]
print(f"near the separatrix: worst error {attitude_errors(end, SEPARATRIX).max():.0e} rad")

# %% tags=["timing"]
many = ph.State(*initial_states(1000, 11))
simulated = jax.jit(lambda state, ts: ph.simulate(free, state, ts, record=last).wxyz)
for horizon in (100.0, 1e5):
    ts = jnp.array([0.0, horizon])
    spent = best_time(simulated, many, ts) / 1000
    print(f"1,000 free bodies to t = {horizon:.0f} s: {1e6 * spent:.2f} us per body")

# %% [markdown]
# The [benchmarks](../benchmarks/README.md) contain more programs, problems and precisions, and the
# cases in which other programs are better.
