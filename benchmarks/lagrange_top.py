"""Lagrange's top: closed form beside heyoka, time and error in one run.

    python benchmarks/lagrange_top.py [--bodies 1000] [--truth FILE.npz]

One core: set XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1" and pin
the process. Bodies: A = 1, C = 1/2, m g l = 1, random attitude, |omega| in [1, 2) plus 5 rad/s
about the axis, to t = 100. The error is the attitude's [rad] against a truth file (q0, w0, times,
q, q_lo) if given, else against heyoka at 1e-16. The two are timed in turn; medians of the repeats,
each at least 10 ms of calls.
"""

import argparse
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import polhode as ph
from polhode._closed_forms import LagrangeTop

HORIZON = 100.0


def bodies(n: int):
    """Attitudes and rates, seeded."""
    rng = np.random.default_rng(21)
    q = rng.normal(size=(n, 4))
    direction = rng.normal(size=(n, 3))
    w = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(1, 2, (n, 1))
    return q / np.linalg.norm(q, axis=1, keepdims=True), w + np.array([0, 0, 5.0])


def angle(q, truth, low=0.0):
    """Attitude error [rad]."""
    sign = np.sign(np.sum(q * truth, axis=-1, keepdims=True))
    return 2 * np.linalg.norm((sign * q - truth) - low, axis=-1)


def closed_form(q, w):
    """A function that runs the library, and how long it took to compile [s]."""
    scene = ph.Scene(
        ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity.axial(1.0, 0.5, (0.0, 0.0, -2.0))
    )
    record, state = ph.Record(final_only=True), ph.State(q, w)
    ts = jnp.array([0.0, HORIZON])

    @jax.jit
    def simulated(scene, state):
        got = ph.simulate(scene, state, ts, LagrangeTop(), record=record, throw=False)
        return got.wxyz[:, -1]

    def run():
        return jax.block_until_ready(simulated(scene, state))

    begin = time.perf_counter()
    run()
    return run, time.perf_counter() - begin


def heyoka_top(q, w, tolerance):
    """The same by heyoka's Taylor integrator in batches of eight, or None where it is missing."""
    try:
        import heyoka as hy
    except ImportError:
        return None
    a, b, c, d, x, y, z = hy.make_vars("a", "b", "c", "d", "x", "y", "z")
    u1, u2 = 2 * (b * d - a * c), 2 * (c * d + a * b)
    system = [
        (a, (-b * x - c * y - d * z) / 2),
        (b, (a * x + c * z - d * y) / 2),
        (c, (a * y + d * x - b * z) / 2),
        (d, (a * z + b * y - c * x) / 2),
        (x, 0.5 * y * z + u2),
        (y, -0.5 * x * z - u1),
        (z, 0.0 * z),
    ]
    size = 8
    taylor = hy.taylor_adaptive_batch(system, np.zeros((7, size)), tol=tolerance)
    whole = len(q) - len(q) % size
    start = np.concatenate([q, w], axis=1)[:whole].reshape(-1, size, 7).transpose(0, 2, 1)

    def run():
        out = []
        for block in start:
            taylor.state[:] = block
            taylor.set_time(0.0)
            taylor.propagate_until(HORIZON)
            out.append(taylor.state[:4].T.copy())
        return np.concatenate(out)

    return run


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--bodies", type=int, default=1000)
    options.add_argument("--repeats", type=int, default=7)
    options.add_argument("--truth")
    given = options.parse_args()
    if given.truth:
        data = np.load(given.truth)
        q, w = data["q0"][: given.bodies], data["w0"][: given.bodies]
        truth, low = data["q"][: len(q), -1], data["q_lo"][: len(q), -1]
    else:
        (q, w), low = bodies(given.bodies), 0.0
        best = heyoka_top(q, w, 1e-16)
        truth = None if best is None else best()
    runs = {}
    runs["polhode.LagrangeTop"], compile_time = closed_form(q, w)
    for tolerance in (1e-9, 1e-15):
        runs[f"heyoka {tolerance:.0e}"] = heyoka_top(q, w, tolerance)
    runs = {name: run for name, run in runs.items() if run is not None}
    times: dict[str, list[float]] = {name: [] for name in runs}
    ends = {}
    for _ in range(given.repeats):
        for name, run in runs.items():
            ends[name] = run()  # warms the caches that the other one used
            begin, calls = time.perf_counter(), 0
            while calls == 0 or time.perf_counter() - begin < 0.01:
                run()
                calls += 1
            times[name].append((time.perf_counter() - begin) / calls)
    print(f"{len(q)} bodies to t = {HORIZON:g}; compiled in {compile_time:.1f} s")
    for name, end in ends.items():
        each = statistics.median(times[name]) / len(end) * 1e9
        line = f"{name:22s} {each:12.0f} ns per body {each / HORIZON:9.2f} per time unit"
        if truth is not None:
            n = min(len(end), len(truth))
            error = angle(np.asarray(end)[:n], truth[:n], low if np.isscalar(low) else low[:n])
            line += f"   error median {np.median(error):.1e} worst {error.max():.1e} rad"
        print(line)


if __name__ == "__main__":
    main()
