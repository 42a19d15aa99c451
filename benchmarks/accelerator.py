"""The main tables on an accelerator: time per body, and what share of the machine is used.

    python -m benchmarks.accelerator [--quick] [--any-device] [--output out/accelerator.json]

Runs where JAX finds an accelerator (``--any-device``: also without). In the same run a vector sum
measures the memory bandwidth and a chain of fused multiply-adds the arithmetic peak of the dtype;
beside each time stand the share of the bandwidth that reading the state and writing the result
takes, and the share of the arithmetic peak of the operations that the compiler counts (for
programs without loops over steps, whose body it counts once).
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks import _report, problems, truth
from benchmarks.peers.polhode_own import scene
from polhode._plan import choose
from polhode._simulate import run

SIZES = {
    "free": (10**3, 10**4, 10**5, 10**6, 10**7),
    "heavy_top": (10**3, 10**4, 10**5, 10**6),
    "gradient": (10**3, 10**5, 10**6),
    "lagrange": (10**4, 10**6),
    "near_symmetric": (10**6,),
    "separatrix": (10**6,),
    "dense": (10**4, 10**5),
}
RTOL = {"float64": 1e-9, "float32": 1e-5}


def peaks(dtype: str, size: int = 2**26, chain: int = 256) -> dict[str, float]:
    """Bytes and operations per second of the device by two small programs."""
    x = jnp.ones(size, dtype)
    add = jax.jit(lambda x: x + 1).lower(x).compile()
    wall = _report.clock(lambda: jax.block_until_ready(add(x)), repeats=5)
    bandwidth = 2 * x.nbytes / wall.median

    def multiply_add(x):
        a = b = c = d = x
        for _ in range(chain // 4):  # four chains at once, to hide the latency
            a, b, c, d = (0.999 * y + 1e-3 for y in (a, b, c, d))
        return a + b + c + d

    work = jax.jit(multiply_add).lower(x[: size // 8]).compile()
    wall = _report.clock(lambda: jax.block_until_ready(work(x[: size // 8])), repeats=5)
    return {
        "bytes_per_s": bandwidth,
        "flop_per_s": 2 * chain * (size // 8) / wall.median,
    }


def measure(family: str, n: int, dtype: str, peak: dict[str, float]) -> dict:
    """One row: the default method on n bodies."""
    problem = problems.PROBLEMS[family]
    kind, record = np.dtype(dtype).type, ph.Record(final_only=problem.saves == 1)
    count = min(n, 100_000)
    repeat = (-(-n // count), 1)
    state = ph.State(*(jnp.asarray(np.tile(x, repeat)[:n], kind) for x in problem.states(count)))
    given, ts = scene(problem, kind), jnp.asarray(problem.times, kind)
    method, _ = choose(given, RTOL[dtype])

    @jax.jit
    def simulated(wxyz, omega):
        made = run(method, given, ph.State(wxyz, omega), ts, jnp.asarray(RTOL[dtype], kind), record)
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
        "family": family, "title": problem.title, "method": type(method).__name__, "bodies": n,
        "dtype": dtype, "ns_per_body": wall.median / n * 1e9, "spread": wall.spread,
        "bandwidth_share": moved / wall.median / peak["bytes_per_s"],
        "arithmetic_share": None if stepped else flops / wall.median / peak["flop_per_s"],
        "attitude_median": found["attitude_median"], "attitude_worst": found["attitude_worst"],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two families, 1e4 bodies")
    parser.add_argument("--any-device", action="store_true")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    device = jax.devices()[0]
    if device.platform == "cpu" and not options.any_device:
        print("no accelerator: JAX sees the CPU only; nothing was run")
        return
    rows, numbers = [], {}
    for dtype in ("float32", "float64"):
        peak = numbers[dtype] = peaks(dtype, 2**22 if options.quick else 2**26)
        print(f"{dtype}: {peak['bytes_per_s']:.2e} bytes/s, {peak['flop_per_s']:.2e} flop/s")
        for family in ("free", "lagrange") if options.quick else SIZES:
            for n in (10_000,) if options.quick else SIZES[family]:
                row = measure(family, n, dtype, peak)
                rows.append(row)
                share = row["arithmetic_share"]
                print(
                    f"{row['title']:34}{row['method']:14}{n:>9} {dtype} {row['ns_per_body']:>10.3g}"
                    f" ns/body, bandwidth {100 * row['bandwidth_share']:.2g} %, arithmetic "
                    + ("–" if share is None else f"{100 * share:.2g} %")
                    + f", median {row['attitude_median']:.0e} rad",
                    flush=True,
                )
                _report.write("accelerator", numbers | {"rows": rows}, path=options.output)
    _report.write("accelerator", numbers | {"rows": rows}, path=options.output)


if __name__ == "__main__":
    main()
