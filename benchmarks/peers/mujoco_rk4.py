"""MuJoCo's RK4 with constant steps, one body after another (its other integrators have order 1)."""

import mujoco
import numpy as np

from benchmarks.peers import Program
from benchmarks.problems import Problem

NAME = "MuJoCo"
PACKAGES = ("mujoco",)


def programs(problem: Problem, n, dtype, tolerances, quick) -> list[Program]:
    if dtype != np.float64 or problem.gradient or problem.horizon > 1e4:
        return []  # no gravity gradient in MuJoCo
    steps = (1_000, 10_000) if quick else (1_000, 10_000, 100_000)
    wxyz, omega = problem.states(3)
    return [
        Program("RK4, body by body", f"{k} steps", _run(problem, wxyz, omega, k), 3) for k in steps
    ]


def _run(problem, wxyz, omega, steps):
    model = _model(problem, problem.horizon / steps)
    data = mujoco.MjData(model)
    each = steps // problem.saves

    def call():
        q, w = np.empty((len(wxyz), problem.saves, 4)), np.empty((len(wxyz), problem.saves, 3))
        for body in range(len(wxyz)):
            mujoco.mj_resetData(model, data)
            data.qpos[-4:] = wxyz[body]
            data.qvel[-3:] = omega[body]
            for save in range(problem.saves):
                mujoco.mj_step(model, data, nstep=each)
                q[body, save], w[body, save] = data.qpos[-4:], data.qvel[-3:]
        return q, w

    return call


def _model(problem, step):
    """A free body, or a top of mass 1 on a ball joint with its centre of mass 0.5 m up body z."""
    a, b, c = problem.moments
    joint, centre, gravity = "<freejoint/>", 0.0, 0.0
    if problem.weight:
        joint, centre = '<joint type="ball"/>', 0.5
        gravity = problem.weight / centre
        a, b = a - centre**2, b - centre**2
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <compiler balanceinertia="false"/>
      <option timestep="{step!r}" integrator="RK4" gravity="0 0 {-gravity}">
        <flag contact="disable" constraint="disable"/>
      </option>
      <worldbody>
        <body>{joint}<inertial pos="0 0 {centre}" mass="1" diaginertia="{a!r} {b!r} {c!r}"/></body>
      </worldbody>
    </mujoco>""")
