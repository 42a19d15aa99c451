"""Time and error of gradients: reverse mode with respect to the three moments of every body.

    python -m benchmarks.gradients [FAMILY ...] [--quick] [--output out/gradients.json]

A fixed linear function of the attitude and rates at t = 20 is differentiated with respect to the
moments of inertia of each body, on one core. Further columns contain the time of the value alone,
the memory of the compiled programs, and the error against derivatives of 40-digit solutions
(benchmarks/truth.py). Other programs: diffrax in reverse mode, and heyoka's variational equations
(forward mode in three parameters, which computes the same numbers).
"""

import argparse
import dataclasses
import importlib.util
import time
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks import truth
from benchmarks.peers import polhode_own, rigid_body
from benchmarks.problems import PROBLEMS, Problem

WEIGHTS = (0.7, -0.4, 0.9, 0.3, -0.5, 0.8, 0.6)
HORIZON = 20.0
FAMILIES = ("free", "near_symmetric", "lagrange", "heavy_top", "gradient", "damped_top")
QUICK = ("free", "heavy_top")
DAMPED = Problem(
    "damped_top",
    "heavy top with drag and a torque",
    (1.0, 1.5, 2.0),
    24,
    weight=1.0,
    damping=0.05,
    push=(0.1, 0.02, 0.05),
)
FEW = 3
"""Bodies scored where the derivatives are by other numbers than the moments."""
SCORED = 8
RTOLS = (1e-6, 1e-9)


def loss(wxyz, omega):
    """Weighted sum over the components and over all bodies."""
    return sum(w * jnp.sum(x) for w, x in zip(WEIGHTS, (*wxyz, *omega)))


def own(problem: Problem, n: int, rtol: float, by: str = "moments"):
    """Loss by polhode's default as a function of the moments, the moments (n, k), and a label.

    ``by``: "state" or "weight" for a function of the state (n, 7), or of the weight of each heavy
    top (n, 1), instead of the moments.
    """
    wxyz, omega = (jnp.asarray(x) for x in problem.states(n))
    state, ts = ph.State(wxyz, omega), jnp.array([0.0, problem.horizon])
    record = ph.Record(final_only=True)
    symmetric = problem.moments[0] == problem.moments[1]

    acting = polhode_own.scene(problem, float)

    def scene(moments):
        if symmetric:
            inertia = ph.Inertia.axisymmetric(moments[:, 0], moments[:, 1])
        else:
            inertia = ph.Inertia.from_moments(moments)
        return ph.Scene(inertia, acting.potential, acting.torque)

    moments = np.array(problem.moments)[[0, 2]] if symmetric else np.array(problem.moments)
    moments = jnp.asarray(np.broadcast_to(moments, (n, len(moments))))
    method = ph.explain(scene(moments), state, ts, rtol=rtol).method

    def value(moments):
        end = ph.simulate(scene(moments), state, ts, method, rtol=rtol, record=record, throw=False)
        return loss(end.wxyz[:, 0].T, end.omega_body[:, 0].T)

    name = f"default: {type(getattr(method, 'solver', method)).__name__}"
    if by == "moments":
        return value, moments, name

    def of_others(given):
        body, start = scene(moments), state
        if by == "state":
            start = ph.State(given[:, :4], given[:, 4:])
        else:
            gravity = jnp.concatenate([0 * given, 0 * given, -given], axis=1)
            field = ph.UniformGravity.axial(jnp.ones(()), jnp.ones(()), gravity)
            body = ph.Scene(body.inertia, field, body.torque)
        end = ph.simulate(body, start, ts, method, rtol=rtol, record=record, throw=False)
        return loss(end.wxyz[:, 0].T, end.omega_body[:, 0].T)

    given = jnp.full((n, 1), problem.weight)
    if by == "state":
        given = jnp.concatenate([wxyz, omega], axis=1)
    return of_others, given, f"{name}, by {by}"


def stock(problem: Problem, n: int, tolerance: float, chunk: int = 40):
    """The same loss by diffrax's Dopri8 in chunks of bodies, by the moments (n, 3)."""
    import diffrax

    start = jnp.asarray(np.concatenate(problem.states(n), axis=1))
    control = diffrax.PIDController(rtol=tolerance, atol=tolerance)

    def field(t, y, moments):
        body = dataclasses.replace(problem, moments=tuple(moments))
        return jnp.stack(rigid_body(body, y[:4], y[4:], 0 * y[0]))

    def one(block):
        y, moments = block
        end = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            0.0,
            problem.horizon,
            None,
            y.T,
            moments.T,
            stepsize_controller=control,
            max_steps=2**12,
        ).ys[0]
        return loss(end[:4], end[4:])

    def value(moments):
        blocks = start.reshape(-1, chunk, 7), moments.reshape(-1, chunk, 3)
        return jnp.sum(jax.lax.map(one, blocks))

    moments = jnp.asarray(np.broadcast_to(np.array(problem.moments), (n, 3)))
    return value, moments, f"Dopri8, chunks of {chunk}, reverse mode"


def measure_jax(peer, made, problem, n, setting, exact) -> dict:
    """One row for a value function: times, memory and error."""
    value, moments, name = made
    compile_s, programs = [], []
    for function in (value, jax.value_and_grad(value)):
        begin = time.perf_counter()
        programs.append(jax.jit(function).lower(moments).compile())
        compile_s.append(time.perf_counter() - begin)
    forward, both = programs
    found = np.asarray(both(moments)[1])[: len(exact)]
    if found.shape[1] == 2:
        exact = np.stack([exact[:, 0] + exact[:, 1], exact[:, 2]], axis=1)
    walls = _report.in_turn(
        {
            "forward": lambda: jax.block_until_ready(forward(moments)),
            "both": lambda: jax.block_until_ready(both(moments)),
        },
        repeats=5,
    )
    return {
        **_row(problem, peer, name, n, setting, found, exact, walls, n),
        "compile_value_s": compile_s[0],
        "compile_s": compile_s[1],
        "memory_value_MB": _memory(forward),
        "memory_MB": _memory(both),
    }


def _row(problem, peer, name, n, setting, found, exact, walls, ran) -> dict:
    off = np.linalg.norm(found - exact, axis=1) / np.linalg.norm(exact, axis=1)
    off = np.where(np.isfinite(off), off, np.inf)
    return {
        "family": problem.name,
        "title": problem.title,
        "peer": peer,
        "program": name,
        "setting": setting,
        "bodies": n,
        "ns_value": walls["forward"].median / ran * 1e9,
        "ns_gradient": walls["both"].median / ran * 1e9,
        "ratio": walls["both"].median / walls["forward"].median,
        "spread": max(walls["forward"].spread, walls["both"].spread),
        "error_median": float(np.median(off)),
        "error_worst": float(off.max()),
    }


def _memory(program) -> float | None:
    """Memory of a compiled program [MB]: arguments, results and temporaries."""
    about = program.memory_analysis()
    if about is None:
        return None
    sizes = about.argument_size_in_bytes, about.output_size_in_bytes, about.temp_size_in_bytes
    return sum(sizes) / 1e6


def variational(problem: Problem, n: int, tolerance: float, exact) -> dict:
    """One row: heyoka's first-order variational equations with respect to the three moments."""
    import heyoka as hy

    names = hy.make_vars("q0", "q1", "q2", "q3", "x", "y", "z")
    body = dataclasses.replace(problem, moments=tuple(hy.par[k] for k in range(3)))
    plain = list(zip(names, rigid_body(body, names[:4], names[4:], 0 * names[0])))
    width = hy.recommended_simd_size()
    start = np.concatenate(problem.states(n), axis=1)[: n - n % width]
    moments = np.repeat(np.array(problem.moments)[:, None], width, axis=1)
    system = hy.var_ode_sys(plain, args=hy.var_args.params, order=1)
    programs, compile_s = {}, 0.0
    for label, given in (("forward", plain), ("both", system)):
        begin = time.perf_counter()
        size = 7 if label == "forward" else 28
        made = hy.taylor_adaptive_batch(given, np.zeros((7, width)), tol=tolerance, pars=moments)
        compile_s = time.perf_counter() - begin
        programs[label] = _heyoka_call(made, start, size, problem.horizon, width)
    ends = programs["both"]()
    found = np.einsum("k,nkm->nm", np.array(WEIGHTS), ends[:, 7:].reshape(-1, 7, 3))
    walls = _report.in_turn(programs, repeats=5)
    row = _row(
        problem,
        "heyoka",
        f"variational, batches of {width}",
        n,
        f"{tolerance:.0e}",
        found[: len(exact)],
        exact,
        walls,
        len(start),
    )
    return row | {"compile_s": compile_s}


def _heyoka_call(made, start, size, horizon, width):
    blocks = start.reshape(-1, width, 7).transpose(0, 2, 1)

    def call():
        out = []
        for block in blocks:
            made.set_time(0.0)
            made.state[:] = 0.0
            made.state[:7] = block
            made.propagate_until(horizon)
            out.append(made.state[:size].T.copy())
        return np.concatenate(out)

    return call


def measure(family: str, n: int, quick: bool) -> list[dict]:
    """Rows of one family."""
    known = PROBLEMS | {DAMPED.name: DAMPED}
    problem = dataclasses.replace(known[family], horizon=HORIZON, saves=1)
    exact = truth.slopes(problem, SCORED, WEIGHTS)
    rows = []
    made = own(problem, n, RTOLS[-1])
    exact_law = "ClosedForm" in made[2] or "LagrangeTop" in made[2]
    if exact_law:
        rows.append(measure_jax("polhode", made, problem, n, "exact", exact))
    else:
        for rtol in RTOLS[-1:] if quick else RTOLS:
            made = own(problem, n, rtol)
            rows.append(measure_jax("polhode", made, problem, n, f"{rtol:.0e}", exact))
    if family == "heavy_top" and not quick:
        for by in ("state", "weight"):
            made = own(problem, n, RTOLS[-1], by)
            others = truth.slopes(problem, FEW, WEIGHTS, by=by)
            rows.append(measure_jax("polhode", made, problem, n, f"{RTOLS[-1]:.0e}", others))
    for tolerance in RTOLS[-1:] if quick else RTOLS:
        made = stock(problem, n, tolerance)
        rows.append(measure_jax("diffrax", made, problem, n, f"{tolerance:.0e}", exact))
    if importlib.util.find_spec("heyoka"):
        for tolerance in RTOLS[-1:] if quick else (*RTOLS, 1e-15):
            few = 40 if quick else 200
            rows.append(variational(problem, few, tolerance, exact))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("families", nargs="*")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--bodies", type=int, default=1000)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    print(
        f"{'gradient by the moments':66}{'us/body':>9}{'ratio':>7}{'median':>9}{'worst':>9}"
        f"{'MB':>8}{'compile s':>10}"
    )
    for family in options.families or (QUICK if options.quick else FAMILIES):
        for row in measure(family, options.bodies, options.quick):
            rows.append(row)
            name = f"{row['title']}: {row['peer']} {row['program']}"[:60]
            memory = "" if row.get("memory_MB") is None else f"{row['memory_MB']:.1f}"
            print(
                f"{name:<60}{row['setting']:>6}{row['ns_gradient'] / 1e3:>9.3g}"
                f"{row['ratio']:>7.1f}{row['error_median']:>9.1e}{row['error_worst']:>9.1e}"
                f"{memory:>8}{row['compile_s']:>10.2f}",
                flush=True,
            )
    numbers = {"horizon": HORIZON, "rows": rows}
    path = _report.write("gradients", numbers, path=options.output, packages=("heyoka",))
    print(f"written: {path.name}")


if __name__ == "__main__":
    main()
