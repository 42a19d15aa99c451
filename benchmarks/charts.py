"""The two charts on the same free bodies: time and error side by side, and the exact motion.

    python -m benchmarks.charts [--bodies 1000] [--euler-bodies 100] [--output out/charts.json]

Case A, T = 100, one core, float64. Each row: median wall time of repeats, per body and time unit,
compile time apart, and the attitude error against truth that is independent of the package.
"""

import argparse
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import diffrax
import jax
import numpy as np

import polhode as ph
from benchmarks.free_body import CASES, bodies, score, timed, truth

HORIZON = 100.0
FINAL = ph.Record(final_only=True)


def row(name: str, method, rtol: float, count: int, exact) -> dict:
    """One method on ``count`` bodies."""
    wxyz, omega = bodies("A", count)
    scene = ph.Scene(ph.Inertia.from_moments(CASES["A"]))
    state = ph.State(wxyz, omega)

    def go():
        traj = ph.simulate(scene, state, [0.0, HORIZON], method, rtol=rtol, record=FINAL)
        return jax.block_until_ready(traj)

    first, _ = timed(go, repeats=1)
    _, wall = timed(go, repeats=3 if first > 1 else 15)
    end = go()
    errors = score(
        list(np.asarray(end.omega_body)[:, 0].T), list(np.asarray(end.wxyz)[:, 0].T), exact[:count]
    )
    return {
        "method": name, "rtol": rtol, "bodies": count,
        "ns_per_body_and_time": wall / count / HORIZON * 1e9,
        "steps": float(np.mean(np.asarray(end.steps))), **errors,
    }  # fmt: skip


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, default=1000)
    parser.add_argument("--euler-bodies", type=int, default=100)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    exact = truth("A", min(options.bodies, 1000), HORIZON)
    dopri8 = diffrax.Dopri8()
    jobs = [("ClosedForm", ph.ClosedForm(), 1e-9, options.bodies)]
    for chunk in (8, 40, 200, options.bodies):
        name = f"LiePoisson(Dopri8), chunks of {chunk}"
        jobs.append((name, ph.LiePoisson(dopri8, chunk=chunk), 1e-12, options.bodies))
    jobs.append(("EulerAngles(Dopri8)", ph.EulerAngles(dopri8), 1e-12, options.euler_bodies))
    rows = []
    print(f"{'method':<38}{'bodies':>7}{'steps':>7}{'ns/body/time':>14}{'median':>10}{'worst':>10}")
    for job in jobs:
        rows.append(found := row(*job, exact))
        print(
            f"{found['method']:<38}{found['bodies']:>7}{found['steps']:>7.0f}"
            f"{found['ns_per_body_and_time']:>14.0f}{found['attitude_median']:>10.1e}"
            f"{found['attitude_worst']:>10.1e}",
            flush=True,
        )
    path = _report.write("charts", {"horizon": HORIZON, "rows": rows}, path=options.output)
    print(f"written: {path.name}")


if __name__ == "__main__":
    main()
