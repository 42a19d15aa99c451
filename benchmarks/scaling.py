"""Time and memory of the default method against number of bodies, horizon and saved times.

    python -m benchmarks.scaling [--quick] [--output out/scaling.json]

One core. Memory is that of the compiled program: arguments, results and temporaries. If bodies
times samples exceed a chunk, chunks are computed one after another, so that temporaries do not
grow.
"""

import argparse
import dataclasses
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks.peers.polhode_own import scene
from benchmarks.problems import PROBLEMS

FAMILIES = ("free", "lagrange", "heavy_top")
BODIES = (1, 10, 100, 1_000, 10_000, 100_000, 1_000_000)
HORIZONS = (1.0, 10.0, 100.0, 1_000.0, 10_000.0)
SAVES = (1, 10, 100, 1_000)
RTOL = 1e-9


def measure(family: str, bodies: int, saves: int, horizons: tuple, budget: float = 0.5) -> list:
    """Rows of one compiled program at several horizons."""
    problem = dataclasses.replace(PROBLEMS[family], saves=saves)
    record = ph.Record(final_only=saves == 1)
    wxyz, omega = problem.states(min(bodies, 1000))
    repeat = (-(-bodies // len(wxyz)), 1)
    state = ph.State(*(jnp.asarray(np.tile(x, repeat)[:bodies]) for x in (wxyz, omega)))
    given, ts = scene(problem, np.float64), jnp.asarray(problem.times)
    method = ph.explain(given, state, ts, rtol=RTOL).method

    @jax.jit
    def simulated(wxyz, omega, ts):
        made = ph.simulate(given, ph.State(wxyz, omega), ts, rtol=RTOL, record=record)
        return made.wxyz, made.omega_body

    program = simulated.lower(state.wxyz, state.omega_body, ts).compile()
    about = program.memory_analysis()
    temporary = about.temp_size_in_bytes / 1e6
    whole = temporary + (about.argument_size_in_bytes + about.output_size_in_bytes) / 1e6
    rows = []
    for horizon in horizons:
        times = ts * (horizon / problem.horizon)
        wall = _report.clock(
            lambda times=times: jax.block_until_ready(program(state.wxyz, state.omega_body, times)),
            repeats=5,
            budget=budget,
        )
        rows.append(
            {
                "bodies": bodies,
                "horizon": horizon,
                "saves": saves,
                "ns_per_body": wall.median / bodies * 1e9,
                "spread": wall.spread,
                "memory_MB": whole,
                "temporary_MB": temporary,
                "method": type(method).__name__,
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="free bodies and tops, fewer points")
    parser.add_argument("--families", nargs="*", default=FAMILIES)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    quick = options.quick
    numbers: dict = {"bodies": {}, "horizon": {}, "saves": {}}
    print(f"{'':12}{'bodies':>9}{'horizon':>9}{'saves':>7}{'us/body':>10}{'MB':>9}{'temp. MB':>10}")
    for family in options.families[:2] if quick else options.families:
        name = PROBLEMS[family].title
        most = 100_000 if family != "free" else 1_000_000
        count = [n for n in (BODIES[1::2][:2] if quick else BODIES) if n <= most]
        reach = HORIZONS[:3:2] if quick else HORIZONS[: 4 if family == "heavy_top" else 5]
        sweeps = {
            "bodies": [row for n in count for row in measure(family, n, 1, (100.0,))],
            "horizon": measure(family, 100, 1, reach),
            "saves": [
                row
                for k in SAVES[:: 2 if quick else 1]
                for row in measure(family, 100, k, (100.0,))
            ],
        }
        for sweep, rows in sweeps.items():
            numbers[sweep][name] = rows
            for r in rows:
                print(
                    f"{family:12}{r['bodies']:>9}{r['horizon']:>9g}{r['saves']:>7}"
                    f"{r['ns_per_body'] / 1e3:>10.3g}{r['memory_MB']:>9.2f}"
                    f"{r['temporary_MB']:>10.2f}",
                    flush=True,
                )
    path = _report.write("scaling", numbers, path=options.output)
    print(f"written: {path.name}")


if __name__ == "__main__":
    main()
