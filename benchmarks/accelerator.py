"""Free bodies, tops and satellites on an accelerator: bodies times saved times per second.

    python -m benchmarks.accelerator [--quick] [--any-device] [--output out/accelerator.json]

Without an accelerator the result is "not run", unless ``--any-device`` permits the CPU.
``--quick``: fewer and smaller rows, a minute or two. polhode's default method is compared with
diffrax as its documentation shows it (``vmap`` of a solve for each body, quaternion and rates,
Dopri8). diffrax runs at the loosest tolerance 1e-3, 1e-4, ... at which its median attitude error is
at most the larger of polhode's error and polhode's tolerance; if there is none, at the tolerance
with the smallest error.

In the same run a vector sum measures the memory bandwidth, and a chain of fused multiply-adds the
arithmetic peak of the dtype. Each row states two shares: that of the bandwidth, for reading the
state and writing the result, and that of the arithmetic peak, for the operations that the compiler
counts (only for programs without loops over steps, whose bodies it counts once).
"""

import argparse
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks import _report, problems, truth
from benchmarks.peers import stock_diffrax
from benchmarks.peers.polhode_own import scene

SIZES = {
    "free": (10**3, 10**5, 10**6, 10**7),
    "heavy_top": (10**3, 10**5, 10**6),
    "satellite": (10**3, 10**5, 10**6),
    "lagrange": (10**3, 10**5, 10**6),
}
QUICK = {"free": (1_000,), "lagrange": (1_000,), "satellite": (1_000,)}
KNOWN = problems.PROBLEMS | {problems.SATELLITE.name: problems.SATELLITE}
DIFFRAX_BODIES = 10**5
"""At most, of diffrax: its time per body does not fall any more."""
RTOL = {"float64": 1e-9, "float32": 1e-5}


def peaks(dtype: str, size: int = 2**26, chain: int = 256) -> dict[str, float]:
    """Measured bandwidth [bytes/s] and arithmetic peak [operations/s] of the device."""
    x = jnp.ones(size, dtype)
    add = jax.jit(lambda x: x + 1).lower(x).compile()
    wall = _report.clock(lambda: jax.block_until_ready(add(x)), repeats=5)
    bandwidth = 2 * x.nbytes / wall.median

    def multiply_add(x):
        a = b = c = d = x
        for _ in range(chain // 4):  # four independent chains, to hide the latency
            a, b, c, d = (0.999 * y + 1e-3 for y in (a, b, c, d))
        return a + b + c + d

    part = x[: size // 8]
    work = jax.jit(multiply_add).lower(part).compile()
    wall = _report.clock(lambda: jax.block_until_ready(work(part)), repeats=5)
    return {
        "bytes_per_s": bandwidth,
        "flop_per_s": 2 * chain * part.size / wall.median,
    }


def measure(family: str, n: int, dtype: str, peak: dict[str, float]) -> dict:
    """One row: polhode's default method on n bodies."""
    problem = KNOWN[family]
    kind, record = np.dtype(dtype).type, ph.Record(final_only=problem.saves == 1)
    count = min(n, 100_000)
    repeat = (-(-n // count), 1)
    state = ph.State(*(jnp.asarray(np.tile(x, repeat)[:n], kind) for x in problem.states(count)))
    given, ts = scene(problem, kind), jnp.asarray(problem.times, kind)
    method = ph.explain(given, state, ts, rtol=RTOL[dtype]).method

    @jax.jit
    def simulated(wxyz, omega):
        made = ph.simulate(given, ph.State(wxyz, omega), ts, rtol=RTOL[dtype], record=record)
        return made.wxyz, made.omega_body

    program = simulated.lower(state.wxyz, state.omega_body).compile()
    wall = _report.clock(
        lambda: jax.block_until_ready(program(state.wxyz, state.omega_body)), repeats=5
    )
    wxyz, omega = program(state.wxyz, state.omega_body)
    skip = 0 if record.final_only else 1
    found = problems.errors(
        truth.truth(problem), np.asarray(wxyz[:20, skip:]), np.asarray(omega[:20, skip:])
    )
    moved = sum(x.nbytes for x in (state.wxyz, state.omega_body, wxyz, omega))
    about = program.cost_analysis() or {}
    flops = float(about.get("flops", 0.0))
    stepped = not isinstance(method, ph.ClosedForm | ph.LagrangeTop)
    return {
        "program": "polhode",
        "rtol": RTOL[dtype],
        "family": family,
        "title": problem.title,
        "method": type(method).__name__,
        "bodies": n,
        "dtype": dtype,
        "ns_per_body": wall.median / n * 1e9,
        "spread": wall.spread,
        "samples_per_s": n * problem.saves / wall.median,
        "bandwidth_share": moved / wall.median / peak["bytes_per_s"],
        "arithmetic_share": None if stepped else flops / wall.median / peak["flop_per_s"],
        "attitude_median": found["attitude_median"],
        "attitude_worst": found["attitude_worst"],
    }


@cache
def equal_error(family: str, dtype: str, target: float) -> tuple[float, dict[str, float]]:
    """The loosest tolerance at which the median error of diffrax is at most ``target``, and the
    errors there; if there is none, those of the tolerance with the smallest error.
    """
    problem = KNOWN[family]
    few = jnp.asarray(np.concatenate(problem.states(truth.BODIES), axis=1), dtype)
    times, exact = jnp.asarray(problem.times, dtype), truth.truth(problem)
    run_all = stock_diffrax._vmap(problem, "quat")
    floor, tried = 20 * float(np.finfo(dtype).eps), []
    for tolerance in [t for t in 10.0 ** -np.arange(3, 15) if t >= floor]:
        ys = np.asarray(run_all(few, times, jnp.asarray(tolerance, dtype)))
        tried.append((tolerance, problems.errors(exact, ys[..., :4], ys[..., 4:])))
        if tried[-1][1]["attitude_median"] <= target:
            break
    else:
        tried.sort(key=lambda entry: -entry[1]["attitude_median"])
    return tried[-1]


def measure_diffrax(family: str, n: int, dtype: str, target: float) -> dict:
    """One row: diffrax on the same bodies, at an error of at most ``target`` if it can reach it."""
    problem, n = KNOWN[family], min(n, DIFFRAX_BODIES)
    start = jnp.asarray(np.concatenate(problem.states(n), axis=1), dtype)
    times = jnp.asarray(problem.times, dtype)
    run_all = stock_diffrax._vmap(problem, "quat")
    tolerance, found = equal_error(family, dtype, target)
    program = run_all.lower(start, times, jnp.asarray(tolerance, dtype)).compile()
    given = start, times, jnp.asarray(tolerance, dtype)
    wall = _report.clock(lambda: jax.block_until_ready(program(*given)), repeats=3)
    return {
        "program": "diffrax",
        "rtol": float(tolerance),
        "equal_error": bool(found["attitude_median"] <= target),
        "family": family,
        "title": problem.title,
        "method": "Dopri8, vmap",
        "bodies": n,
        "dtype": dtype,
        "ns_per_body": wall.median / n * 1e9,
        "spread": wall.spread,
        "samples_per_s": n * problem.saves / wall.median,
        "attitude_median": found["attitude_median"],
        "attitude_worst": found["attitude_worst"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three families, 1e3 bodies")
    parser.add_argument("--any-device", action="store_true")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    device = jax.devices()[0]
    if device.platform == "cpu" and not options.any_device:
        reason = "there is no accelerator, JAX sees the CPU only"
        print(f"not run: {reason} (--any-device runs on it)")
        _report.write("accelerator", {"not_run": reason}, path=options.output)
        return
    rows, numbers = [], {}
    for dtype in ("float64", "float32"):
        peak = numbers[dtype] = peaks(dtype, 2**22 if options.quick else 2**26)
        print(f"{dtype}: {peak['bytes_per_s']:.2e} bytes/s, {peak['flop_per_s']:.2e} flop/s")
        for family, sizes in (QUICK if options.quick else SIZES).items():
            for n in sizes:
                row = measure(family, n, dtype, peak)
                rows.append(row)
                _show(row)
                if n <= DIFFRAX_BODIES:
                    other = measure_diffrax(
                        family, n, dtype, max(row["attitude_median"], row["rtol"])
                    )
                    rows.append(other)
                    _show(other)
                    gain = row["samples_per_s"] / other["samples_per_s"]
                    note = "" if other["equal_error"] else ", which does not reach this error"
                    print(f"    polhode / diffrax: {gain:.3g}{note}", flush=True)
                _report.write("accelerator", numbers | {"rows": rows}, path=options.output)
    _report.write("accelerator", numbers | {"rows": rows}, path=options.output)


def _show(row: dict) -> None:
    """Print one line of the table."""
    shares = ""
    if "bandwidth_share" in row:
        share = row["arithmetic_share"]
        shares = f", bandwidth {100 * row['bandwidth_share']:.2g} %, arithmetic " + (
            "–" if share is None else f"{100 * share:.2g} %"
        )
    print(
        f"{row['title']:44}{row['program']:9}{row['method']:14}{row['bodies']:>9} {row['dtype']}"
        f" {row['samples_per_s']:>9.3g} bodies x times/s, {row['ns_per_body']:.3g} ns/body, median"
        f" {row['attitude_median']:.0e} rad{shares}",
        flush=True,
    )


if __name__ == "__main__":
    main()
