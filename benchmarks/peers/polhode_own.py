"""polhode: the default method, and LiePoisson where the default is a different method."""

import time

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks.peers import Program
from benchmarks.problems import DIRECTION, Problem

NAME = "polhode"
DEFAULT = "default"
PACKAGES = ()


def scene(problem: Problem, dtype) -> ph.Scene:
    """The problem as a scene."""
    a, _, c = problem.moments
    if problem.name == "lagrange":
        inertia = ph.Inertia.axisymmetric(jnp.asarray(a, dtype), jnp.asarray(c, dtype))
    else:
        inertia = ph.Inertia.from_moments(jnp.asarray(problem.moments, dtype))
    torque = None
    if any(problem.push):
        torque = ph.BodyTorque(jnp.asarray(problem.push, dtype))
    if problem.damping:
        drag = ph.LinearDamping(jnp.full(3, problem.damping, dtype))
        torque = drag if torque is None else torque + drag
    if problem.weight:
        gravity = jnp.asarray([0.0, 0.0, -problem.weight], dtype)
        one = jnp.ones((), dtype)
        return ph.Scene(inertia, ph.UniformGravity.axial(one, one, gravity), torque)
    if problem.gradient:
        mu = jnp.asarray(problem.gradient / 3, dtype)
        gradient = ph.GravityGradient(mu, jnp.asarray(DIRECTION, dtype))
        return ph.Scene(inertia, gradient, torque)
    return ph.Scene(inertia, torque=torque)


def programs(problem: Problem, n, dtype, tolerances, quick) -> list[Program]:
    given, record = scene(problem, dtype), ph.Record(final_only=problem.saves == 1)
    count = 3 if n == 1 else n
    wxyz, omega = (jnp.asarray(x, dtype) for x in problem.states(count))
    starts = list(zip(wxyz, omega)) if n == 1 else [(wxyz, omega)]
    ts = jnp.asarray(problem.times, dtype)
    floor = 4 * float(np.finfo(dtype).eps)
    tolerances = [t for t in tolerances if t >= floor]
    state = ph.State(*starts[0])
    asked = [(DEFAULT, t, ph.explain(given, state, ts, rtol=t).method) for t in tolerances]
    stepped = not isinstance(asked[0][2], ph.ClosedForm | ph.LagrangeTop)
    if not stepped:
        asked = asked[:1]
    if not quick and problem.horizon < 1e4 and n <= 1000:
        own = ph.LiePoisson()
        asked += [("LiePoisson", t, own) for t in tolerances if own != asked[0][2]]
    built, found = {}, []
    for label, tolerance, method in asked:
        spent = None
        if repr(method) not in built:
            begin = time.perf_counter()
            built[repr(method)] = _compiled(method, given, starts[0], ts, record)
            spent = time.perf_counter() - begin
        name = f"{label}: {_named(method)}" if label == DEFAULT else label
        exact = isinstance(method, ph.ClosedForm | ph.LagrangeTop)
        call = _call(built[repr(method)], starts, jnp.asarray(tolerance, dtype), record, n)
        setting = "exact" if exact else f"{tolerance:.0e}"
        found.append(Program(name, setting, call, count, spent))
    return found


def _named(method) -> str:
    """Label of a method: its solver if it integrates."""
    return type(getattr(method, "solver", method)).__name__


def _compiled(method, given, start, ts, record):
    """The compiled program of ``jax.jit`` of a call of ``ph.simulate``."""

    @jax.jit
    def simulated(wxyz, omega, rtol):
        made = ph.simulate(given, ph.State(wxyz, omega), ts, method, rtol=rtol, record=record)
        return made.wxyz, made.omega_body

    return simulated.lower(*start, jnp.asarray(1e-3, ts.dtype)).compile()


def _call(program, starts, rtol, record, n):
    skip = 0 if record.final_only else 1

    def call():
        made = jax.block_until_ready([program(*start, rtol) for start in starts])
        q, w = (np.stack(x) if n == 1 else np.asarray(x[0]) for x in zip(*made))
        return q[:, skip:], w[:, skip:]

    return call
