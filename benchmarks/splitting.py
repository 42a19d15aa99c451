"""A million steps of the splitting methods: energy, vertical momentum, length of the quaternion.

    python -m benchmarks.splitting [--quick] [--output out/benchmarks/splitting.json]

The heavy tops of ``benchmarks.integrators``, 16 bodies each. The energy error of a symplectic
method swings with the motion and must not grow: its largest value in the first 400 steps stands
beside those in samples of the whole run and in the last 400 steps. The vertical momentum, which
the flows conserve exactly, and the quaternion's length show what rounding adds up to.
"""

import argparse
import time
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.integrators import CASES, heavy_top, initial_states
from polhode._integrate import Splitting

BODIES, WINDOW = 16, 400
STEPS = {2: 2**-7, 4: 3 * 2**-6, 6: 3 * 2**-5, 8: 3 * 2**-4}  # sums of them are exact


def conserved(y, moments, strength):
    """Energy, vertical momentum and quaternion length, each (samples, bodies)."""
    momentum, wxyz = ([np.asarray(x, np.float64) for x in part] for part in y)
    w, x, a, b = wxyz
    down = (2 * (x * b - w * a), 2 * (a * b + w * x), w * w - x * x - a * a + b * b)
    energy = sum(m * m / (2 * i) for m, i in zip(momentum, moments)) + strength * down[2]
    return energy, sum(m * d for m, d in zip(momentum, down)), np.sqrt(sum(q * q for q in wxyz))


def run(case, order, steps, dtype, free=None):
    """One row: what the conserved quantities do over ``steps`` steps.

    ``free``: order of Moser and Veselov's step for the free motion; None: rotations.
    """
    moments, _, strength, *_ = CASES[case]
    dtype = jnp.dtype(dtype)
    wxyz, omega = initial_states(case, BODIES)
    y0 = (
        tuple(jnp.asarray(omega[:, i] * moments[i], dtype) for i in range(3)),
        tuple(jnp.asarray(wxyz[:, i], dtype) for i in range(4)),
    )
    given = (tuple(jnp.asarray(1 / m, dtype) for m in moments), jnp.asarray(strength, dtype))
    middle = 0 if case == "lagrange" else 1
    step = STEPS[order]

    def solve(y, saves, between):
        """States after every so many steps, of a field that does not ask for the time."""
        solver, term = Splitting(order, middle, moser_veselov=free), diffrax.ODETerm(heavy_top)
        t0, t1 = jnp.zeros((), dtype), jnp.asarray(step, dtype)

        def one(_, carry):
            y, memory = carry
            y, _, _, memory, _ = solver.step(term, t0, t1, y, given, memory, False)
            return y, memory

        def save(carry, _):
            carry = jax.lax.fori_loop(0, between, one, carry)
            return carry, carry[0]

        start = y, solver.init(term, t0, t1, y, given)
        return jax.lax.scan(save, start, None, length=saves)[1]

    near = jax.jit(lambda y: solve(y, WINDOW, 1))
    far = jax.jit(lambda y: solve(y, 1000, steps // 1000)).lower(y0).compile()
    first = near(y0)
    began = time.perf_counter()
    whole = jax.block_until_ready(far(y0))
    seconds = time.perf_counter() - began
    last = near(jax.tree.map(lambda x: x[-1], whole))
    start = conserved(jax.tree.map(lambda x: x[None], y0), moments, strength)
    scale = np.abs(start[0]) + strength
    found = {"start": first, "run": whole, "end": last}
    kept = {name: conserved(y, moments, strength) for name, y in found.items()}
    energy = {n: np.max(np.abs(k[0] - start[0]) / scale, axis=0) for n, k in kept.items()}
    size = np.sqrt(sum(np.asarray(m, np.float64) ** 2 for m in y0[0]))
    vertical = np.max(np.abs(kept["run"][1] - start[1]) / size, axis=0)
    return {
        "top": case, "order": order, "moser_veselov": free, "dtype": dtype.name,
        "steps": steps, "step": step,
        "energy_first_median": np.median(energy["start"]),
        "energy_run_median": np.median(energy["run"]),
        "energy_end_median": np.median(energy["end"]),
        "growth_median": np.median(energy["end"] / energy["start"]),
        "growth_worst": np.max(energy["end"] / energy["start"]),
        "vertical_worst": np.max(vertical),
        "length_worst": np.max(np.abs(kept["run"][2] - 1)),
        "ns_per_body_step": seconds / steps / BODIES * 1e9,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="1e4 steps of order 4")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    steps = 10_000 if options.quick else 1_000_000
    tops = ("lagrange", "asymmetric")
    kinds = [(top, 4, "float64", free) for free in (None, 10) for top in tops]
    if not options.quick:
        kinds += [("lagrange", 4, "float32", None), ("asymmetric", 4, "float32", 10)]
        kinds += [("asymmetric", order, "float64", None) for order in (2, 6, 8)]
        kinds += [("asymmetric", order, "float64", 10) for order in (2, 6, 8)]
    rows = []
    for case, order, dtype, free in kinds:
        rows.append(run(case, order, steps, dtype, free))
        print("  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{v}"
                        for k, v in rows[-1].items()), flush=True)  # fmt: skip
    print(_report.write("splitting", {"rows": rows}, path=options.output))


if __name__ == "__main__":
    main()
