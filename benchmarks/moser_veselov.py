"""Splittings by Moser and Veselov's step and by rotations, beside the planner's integrator.

    python -m benchmarks.moser_veselov [--quick] [--output out/benchmarks/moser_veselov.json]

Attitude error at t = 100 (about 150 rad) against time per body, through ``ph.simulate`` on 1,000
bodies of moments (1, 1.5, 2), under weight and gravity gradients of falling strength, and on
bodies nearly spherical. Truth: Taylor series of 24 digits (benchmarks/truth.py) of the first
bodies; all programs take turns.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks import problems, truth
from benchmarks.problems import PROBLEMS
from polhode._integrate import Splitting

TOP, GRADIENT = PROBLEMS["heavy_top"], PROBLEMS["gradient"]
CASES = (
    TOP,
    GRADIENT,
    *(replace(GRADIENT, title=f"the same, {s:.0e}", gradient=s) for s in (1e-2, 1e-4, 1e-6)),
    replace(
        GRADIENT, title="gradient 0.75 on (1, 1.01, 1.02)", moments=(1.0, 1.01, 1.02), gradient=0.75
    ),
)
RTOLS = (1e-3, 1e-6, 1e-9)
WHOLE = {2: (200, 400, 800), 4: (100, 200, 400), 6: (50, 100, 200)}
ROTATIONS = {2: (400,), 4: (100, 200), 6: (100, 200)}
"""Steps of each order: with Moser and Veselov's step, and with rotations."""


def programs(problem, bodies, steps):
    """By name: functions returning the final attitudes (bodies, 4)."""
    moments = jnp.asarray(problem.moments)
    if problem.weight:
        acts = ph.UniformGravity(problem.weight, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    else:
        acts = ph.GravityGradient(problem.gradient / 3, problems.DIRECTION)
    scene = ph.Scene(ph.Inertia.from_moments(moments), acts)
    state = ph.State(*(jnp.asarray(x) for x in problem.states(bodies)))
    ts, record = jnp.array([0.0, problem.horizon]), ph.Record(final_only=True, rates=False)

    def program(method, rtol=None):
        def run():
            found = ph.simulate(scene, state, ts, method, rtol=rtol, record=record, throw=False)
            return np.asarray(found.wxyz[:, 0])

        return run

    found = {("planner", f"rtol {rtol:.0e}", None): program(None, rtol) for rtol in RTOLS}
    for free, table in ((10, WHOLE), (None, ROTATIONS)):
        for order, counts in table.items():
            for count in counts[:steps]:
                solver = Splitting(order, moser_veselov=free)
                width = jnp.asarray(problem.horizon / count)  # compiled once
                method = ph.LiePoisson(solver, dt0=width)
                kind = "rotations" if free is None else f"Moser-Veselov {free}"
                found[f"{kind}, order {order}", f"{count} steps", order] = program(method)
    return found


def run(problem, bodies, scored, steps=None) -> list[dict]:
    """One row for each program."""
    exact = truth.make(problem, scored, digits=24)
    calls = programs(problem, bodies, steps)
    times = _report.in_turn(calls, repeats=5)
    rows = []
    for key, call in calls.items():
        error = problems.errors(exact, call()[:, None], None)
        rows.append({
            "acts": problem.title, "program": key[0], "setting": key[1],
            "us_per_body": times[key].median / bodies * 1e6,
            "median": error["attitude_median"], "worst": error["attitude_worst"],
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one case, one number of steps")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for problem in CASES[:1] if options.quick else CASES:
        new = run(problem, *((100, 4, 1) if options.quick else (1000, 20)))
        rows += new
        for row in new:
            print("  ".join(f"{v:.2g}" if isinstance(v, float) else v for v in row.values()),
                  flush=True)  # fmt: skip
    print(_report.write("moser_veselov", {"rows": rows}, path=options.output))


if __name__ == "__main__":
    main()
