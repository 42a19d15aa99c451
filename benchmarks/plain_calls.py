"""Cost of an ordinary call: ``ph.simulate`` compared with its bare compiled program.

    python -m benchmarks.plain_calls [--quick] [--output FILE]

Bodies of the families of ``problems.py`` to t = 100, one core, float64. ``bare``: the last state
only, compiled ahead of time. ``plain``: ``ph.simulate(scene, state, [0, 100])`` with its input
checks and two saved times; with 100 saved times, the time per sample. ``spread``: the largest ratio
of the time at a number of saved times to the linear interpolation between its neighbours. Times are
medians of programs that run alternately; errors are angles against a 40-digit reference.
"""

import argparse
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks import problems, truth
from benchmarks.peers.polhode_own import scene

FAMILIES = {"free": 10**5, "lagrange": 10**4, "heavy_top": 10**4, "gradient": 10**4}
BODIES = (1, 10, 100, 1_000, 10_000, 100_000)
SAVES = (1, 2, 4, 8, 16, 32, 64, 100)
LAST = ph.Record(final_only=True)


def states(problem, n: int) -> ph.State:
    return ph.State(*(jnp.asarray(x) for x in problem.states(n)))


def measure(family: str, n: int) -> dict:
    """One row: an ordinary call and its bare program."""
    problem = problems.PROBLEMS[family]
    given, state = scene(problem, np.float64), states(problem, n)
    ts = jnp.asarray([0.0, problem.horizon])
    many = jnp.linspace(0.0, problem.horizon, 101)

    def last(state, ts):
        found = ph.simulate(given, state, ts, record=LAST)
        return found.wxyz, found.omega_body

    program = jax.jit(last).lower(state, ts).compile()
    calls = {
        "bare": lambda: jax.block_until_ready(program(state, ts)),
        "plain": lambda: jax.block_until_ready(ph.simulate(given, state, ts).wxyz),
    }
    if n * 100 <= 10**6:
        calls["hundred"] = lambda: jax.block_until_ready(ph.simulate(given, state, many).wxyz)
    times = _report.in_turn(calls, repeats=9)
    wxyz, omega = program(state, ts)
    found = problems.errors(truth.truth(problem), np.asarray(wxyz[:20]), np.asarray(omega[:20]))
    bare, plain = times["bare"].median, times["plain"].median
    hundred = times["hundred"].median if "hundred" in times else None
    return {
        "family": family,
        "title": problem.title,
        "bodies": n,
        "ns_bare": bare / n * 1e9,
        "ns_plain": plain / n * 1e9,
        "ratio": plain / bare,
        "us_over_program": (plain - bare) * 1e6,
        "ns_sample": None if hundred is None else hundred / n / 100 * 1e9,
        "attitude_median": found["attitude_median"],
        "attitude_worst": found["attitude_worst"],
    }


def layouts(n: int) -> dict:
    """Free bodies at several numbers of saved times; the largest deviation from a straight line."""
    problem = problems.PROBLEMS["free"]
    given, state = scene(problem, np.float64), states(problem, n)
    calls = {
        saves: (lambda ts: lambda: jax.block_until_ready(ph.simulate(given, state, ts).wxyz))(
            jnp.linspace(0.0, problem.horizon, saves + 1)
        )
        for saves in SAVES
        if n * saves <= 10**6
    }
    found = _report.in_turn(calls, repeats=9)
    saves = list(found)
    times = np.array([found[s].median / n * 1e9 for s in saves])
    between = [
        times[i] / np.interp(saves[i], [saves[i - 1], saves[i + 1]], times[[i - 1, i + 1]])
        for i in range(1, len(saves) - 1)
    ]
    return {"bodies": n, "saves": saves, "ns_per_body": times, "spread": max(between)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two families, up to 1,000 bodies")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for family, most in FAMILIES.items():
        if options.quick and family not in ("free", "heavy_top"):
            continue
        for n in BODIES:
            if n > (1_000 if options.quick else most):
                continue
            rows.append(measure(family, n))
            r = rows[-1]
            print(
                f"{r['title']:24}{n:>8,} bodies: bare {r['ns_bare']:>10.4g} ns, plain"
                f" {r['ns_plain']:>10.4g} ({r['ratio']:.2f}x, {r['us_over_program']:.0f} us more),"
                f" a saved time {r['ns_sample'] or float('nan'):.3g} ns; median error"
                f" {r['attitude_median']:.0e} rad",
                flush=True,
            )
    sweeps = [layouts(n) for n in ((100,) if options.quick else (1, 100, 1_000, 10_000))]
    for sweep in sweeps:
        print(sweep, flush=True)
    _report.write("plain_calls", {"rows": rows, "layouts": sweeps}, path=options.output)


if __name__ == "__main__":
    main()
