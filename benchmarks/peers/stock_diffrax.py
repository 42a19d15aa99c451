"""diffrax as its documentation shows it: quaternion and rates, or Euler angles by jax.grad of H.

Three layouts: ``vmap`` of a solve for each body (each with its own steps, all running until the
last finishes), one solve of a chunk of bodies as an array (7, 40), and one body alone.
"""

import time
from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers import Program, rigid_body
from benchmarks.problems import Problem

NAME = "diffrax"
PACKAGES = ("diffrax", "jax")
CHUNK = 40
STEPS = 2**20


def programs(problem: Problem, n, dtype, tolerances, quick) -> list[Program]:
    if problem.horizon > 1e4:
        return []  # would take hours
    wxyz, omega = problem.states(n)
    start = np.concatenate([wxyz, omega], axis=1).astype(dtype)
    times = jnp.asarray(problem.times, dtype)
    floor = 20 * float(np.finfo(dtype).eps)
    tolerances = [t for t in tolerances if t >= floor]
    found = []
    if n == 1:
        found += _rows("Dopri8, quaternion", _alone, problem, start[:3], times, tolerances, "quat")
    else:
        few = start[: min(n, 1000)]
        found += _rows("Dopri8, chunks of 40", _chunks, problem, few, times, tolerances, "quat")
        if not quick or problem.name == "free":
            some = few[: 100 if quick else 200]
            found += _rows("Dopri8, vmap", _vmap, problem, some, times, tolerances, "quat")
    if problem.name in ("free", "heavy_top") and dtype == np.float64 and n <= 1000:
        count = 3 if n == 1 else 20
        angles = np.array([_to_euler(problem, *s) for s in zip(wxyz[:count], omega[:count])])
        runs = _alone if n == 1 else _vmap
        loose = [t for t in tolerances if t >= 1e-10][-2:]
        label = "Dopri8, Euler angles by grad H" + ("" if n == 1 else ", vmap")
        found += _rows(label, runs, problem, angles, times, loose, "euler")
    return found


def _rows(label, layout, problem, start, times, tolerances, chart):
    start = jnp.asarray(start)
    begin = time.perf_counter()
    alone = layout is _alone
    first = start[0] if alone else start
    program = layout(problem, chart).lower(first, times, jnp.asarray(1e-3, start.dtype)).compile()
    spent = time.perf_counter() - begin

    def call(tolerance):
        tolerance = jnp.asarray(tolerance, start.dtype)
        if alone:
            ys = [jax.block_until_ready(program(body, times, tolerance)) for body in bodies]
        else:
            ys = jax.block_until_ready(program(start, times, tolerance))
        return _finish(np.asarray(ys), chart)

    bodies = list(start)

    return [
        Program(label, f"{t:.0e}", lambda t=t: call(t), len(start), spent if i == 0 else None)
        for i, t in enumerate(tolerances)
    ]


def _finish(ys, chart):
    if chart == "quat":
        return ys[..., :4], ys[..., 4:]
    phi, theta, psi = (ys[..., k] for k in range(3))
    c, s = np.cos(theta / 2), np.sin(theta / 2)
    plus, minus = (phi + psi) / 2, (phi - psi) / 2
    wxyz = np.stack(
        [c * np.cos(plus), -s * np.sin(minus), s * np.cos(minus), c * np.sin(plus)], axis=-1
    )
    return wxyz, None


@cache
def _alone(problem, chart):
    return jax.jit(_solve(problem, chart))


@cache
def _vmap(problem, chart):
    return jax.jit(jax.vmap(_solve(problem, chart), in_axes=(0, None, None)))


@cache
def _chunks(problem, chart):
    solve = _solve(problem, chart)

    def run(start, times, tol):
        blocks = start.reshape(-1, CHUNK, 7).transpose(0, 2, 1)
        ys = jax.lax.map(lambda block: solve(block, times, tol), blocks)
        return jnp.moveaxis(ys, 3, 1).reshape(-1, *ys.shape[1:3])

    return jax.jit(run)


def _solve(problem, chart):
    field = {"quat": _quaternion, "euler": _euler}[chart](problem)

    def solve(start, times, tol):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            times[0],
            times[-1],
            None,
            start,
            saveat=diffrax.SaveAt(ts=times[1:]),
            stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
            max_steps=STEPS,
            throw=False,
        ).ys

    return solve


def _quaternion(problem):
    def field(t, y, args):
        return jnp.stack(rigid_body(problem, y[:4], y[4:], 0 * y[0]))

    return field


def _euler(problem):
    """Hamilton's equations in ZYZ angles and their momenta."""
    a, b, c = problem.moments

    def energy(q, p):
        _, theta, psi = q
        rest = (p[0] - p[2] * jnp.cos(theta)) / jnp.sin(theta)
        x = p[1] * jnp.sin(psi) - rest * jnp.cos(psi)
        y = p[1] * jnp.cos(psi) + rest * jnp.sin(psi)
        total = (x * x / a + y * y / b + p[2] * p[2] / c) / 2
        return total + problem.weight * jnp.cos(theta)

    def field(t, y, args):
        by_q, by_p = jax.grad(energy, argnums=(0, 1))(y[:3], y[3:])
        return jnp.concatenate([by_p, -by_q])

    return field


def _to_euler(problem, wxyz, omega):
    """Angles and momenta of one body."""
    w, x, y, z = wxyz
    plus, minus = np.arctan2(z, w), np.arctan2(-x, y)
    theta = 2 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
    phi, psi = plus + minus, plus - minus
    p, q, r = np.array(problem.moments) * omega
    spin = -p * np.cos(psi) + q * np.sin(psi)
    return np.array(
        [
            phi,
            theta,
            psi,
            spin * np.sin(theta) + r * np.cos(theta),
            p * np.sin(psi) + q * np.cos(psi),
            r,
        ]
    )
