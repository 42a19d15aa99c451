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
# # What does a digit cost?
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/polhode/polhode/blob/main/notebooks/work_and_precision.ipynb)
# (there, run `%pip install 'polhode[all]'` first)
#
# A fast answer that is wrong is worth nothing, and a conserved energy is no proof that it is right.
# So time is only ever shown beside the error, and the error is measured against a solution that
# nothing here had a hand in: Taylor series in 40-digit arithmetic (`benchmarks/truth.py`).

# %%
import sys

sys.path.insert(0, "..")  # the benchmarks of the repository

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import polhode as ph
from benchmarks import _figures, _page, _report, problems, truth
from benchmarks.peers import polhode_own, scipy_closed_form, scipy_ivp, stock_diffrax
from polhode import plot

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## A heavy top, here and now
# Forty asymmetric tops about a fixed point, to t = 100. Every program moves the same bodies, all
# take turns, compiling is apart. One point is one tolerance asked for. (Times are of the machine
# that ran this notebook, with whatever else it was doing: read ratios.)

# %%
problem = problems.PROBLEMS["heavy_top"]
exact = truth.truth(problem)
tolerances = [1e-5, 1e-7, 1e-9]
programs = {}
for module in (polhode_own, stock_diffrax, scipy_ivp):
    for program in module.programs(problem, 40, np.float64, tolerances, True):
        if "body by body" not in program.label:
            programs[f"{module.NAME} {program.label}", program.setting] = program

errors = {key: problems.errors(exact, *program.call()) for key, program in programs.items()}
times = _report.in_turn(
    {key: program.call for key, program in programs.items()}, repeats=3, budget=0.5
)

curves = {}
for name, setting in programs:
    found = curves.setdefault(name, ([], []))
    found[0].append(errors[name, setting]["attitude_median"])
    found[1].append(times[name, setting].median / programs[name, setting].bodies)
fig, ax = plt.subplots(figsize=(9, 4), layout="constrained")
plot.work_precision(
    curves,
    ax=ax,
    highlight=next(name for name in curves if name.startswith("polhode")),
    time_label="run time per body [s]",
    error_label="attitude error at t = 100 [rad], median body",
)
ax.set_title("Asymmetric heavy top, 40 bodies")
plt.show()

# %% [markdown]
# Euler angles lose twice: their equations are longer, and a body that passes near a pole makes all
# those that share its steps wait. ([The Hamiltonian in Euler angles](euler_hamiltonian.ipynb) says
# why.)
#
# ## Conserved is not correct
# With a loose tolerance energy is kept far better than the attitude: it sees only the error across
# the level set, not the one along it. The worst bodies of this top are chaotic.

# %%
wxyz, omega = problem.states(20)
scene = polhode_own.scene(problem, np.float64)
state, ts = ph.State(wxyz, omega), jnp.asarray(problem.times)
print("rtol     energy drift   attitude error: median   worst body")
for rtol in (1e-4, 1e-6, 1e-8):
    traj = ph.simulate(scene, state, ts, ph.LiePoisson(), rtol=rtol)
    energy = np.asarray(traj.energy)
    drift = np.abs(energy[:, -1] - energy[:, 0]).max() / np.ptp(energy[:, 0])
    off = problems.errors(exact, traj.wxyz[:, 1:], traj.omega_body[:, 1:])
    median, worst = off["attitude_median"], off["attitude_worst"]
    print(f"{rtol:.0e}  {drift:12.0e} {median:23.0e} {worst:12.0e} rad")

# %% [markdown]
# ## Nothing acts: nothing is stepped
# A free body has a closed form, and its error is rounding in the angle turned through, whatever
# the horizon. The same formulas through SciPy's special functions are the nearest peer.

# %%
for name in ("free", "long", "separatrix"):
    problem = problems.PROBLEMS[name]
    for module in (polhode_own, scipy_closed_form):
        (program,) = module.programs(problem, 1000, np.float64, [1e-9], True)
        off = problems.errors(truth.truth(problem), *program.call())
        wall = _report.clock(program.call, repeats=3)
        print(
            f"{problem.title:28} {module.NAME:18} {wall.median / 1000 * 1e6:6.2f} us per body,"
            f" worst error {off['attitude_worst']:.0e} rad"
        )

# %% [markdown]
# Near the separatrix the textbook formulas lose half of the digits, because the modulus is within
# rounding of one; the library keeps its complement instead.
#
# ## All families
# The committed results of the last full run, on one core, drawn from their JSON. An exact method
# has a single point. Which programs ran, in which versions, how, and where others are better:
# [benchmarks](../benchmarks/README.md).

# %%
figure = _figures.work_precision(_page.merged())
plt.show()
