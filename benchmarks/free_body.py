"""The closed-form free motion: errors and times, with heyoka in the same run if it is installed.

Bodies, references and scores are computed here: four inertias, attitudes uniform on SO(3),
isotropic rates with |w| uniform in [1, 2). The reference is a 34-digit Taylor series
(tests/free/reference_free.py) for the first bodies of each case, cached in the folder of this
script, or read from the tables in ../shared if these exist. Times are minima of repeats on one
core.

    python -m benchmarks.free_body [--quick] [--output free_body.json]
"""

import argparse
import dataclasses
import hashlib
import json
import sys
import time
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers import rigid_body
from benchmarks.problems import PROBLEMS
from polhode._closed_forms import free_motion

jax.config.update("jax_enable_x64", True)
HERE = Path(__file__).resolve().parent
CASES = {
    "A": (1.0, 2.0, 3.0),
    "B": (1.0, 1.001, 1.5),
    "C": (0.01, 1.0, 1.0005),
    "D": (0.8, 1.3, 1.9),
}
SEEDS = {"A": 11, "B": 12, "C": 13, "D": 14}


def bodies(case: str, count: int):
    """Random attitudes and rates; the first bodies are the same for any count."""
    from math import erf

    r = np.random.Generator(np.random.PCG64(SEEDS[case])).standard_normal((count, 8))
    q = r[:, :4] / np.linalg.norm(r[:, :4], axis=1, keepdims=True)
    direction = r[:, 4:7] / np.linalg.norm(r[:, 4:7], axis=1, keepdims=True)
    # The order of operations reproduces the inputs of the stored references to the last bit.
    size = 1.0 + 0.5 * (1.0 + np.array([erf(x) for x in r[:, 7] / np.sqrt(2.0)]))
    return q, direction * size[:, None]


def components(array) -> tuple:
    return tuple(jnp.asarray(np.ascontiguousarray(array[..., k])) for k in range(array.shape[-1]))


def truth(case: str, count: int, t: float) -> np.ndarray:
    """Attitude and rates of the first bodies at time t as (count, 7, 2): float64 and remainder."""
    long = "J1" if t == 100 else "J2"
    peers = HERE.parents[1] / "shared" / "peers" / "truth" / f"{long}_{case}.npz"
    if peers.exists():
        table = np.load(peers)
        at = int(np.argmin(np.abs(table["times"] - t)))
        rows = [
            np.concatenate([table[q][:count, at], table[w][:count, at]], 1)
            for q, w in (("q", "w"), ("q_lo", "w_lo"))
        ]
        return np.stack(rows, -1)
    folder = HERE / "cache"
    key = hashlib.sha256(repr((CASES[case], SEEDS[case], count, t)).encode()).hexdigest()[:16]
    path = folder / f"free_body_{key}.npy"
    if path.exists():
        return np.load(path)
    sys.path.insert(0, str(HERE.parent / "tests" / "free"))
    import mpmath as mp
    from reference_free import free_reference

    q, w = bodies(case, count)
    out = np.zeros((count, 7, 2))
    for n in range(count):
        attitude, rates = free_reference(CASES[case], q[n], w[n], t, digits=34)
        values = attitude + rates
        high = [float(x) for x in values]
        out[n, :, 0] = high
        out[n, :, 1] = [float(x - mp.mpf(h)) for x, h in zip(values, high, strict=True)]
    folder.mkdir(exist_ok=True)
    np.save(path, out)
    return out


def score(omega, wxyz, exact) -> dict:
    """Attitude error [rad] and relative rate error, median and maximum over the bodies."""
    count = len(exact)
    q, w = np.stack(wxyz, -1)[:count], np.stack(omega, -1)[:count]
    sign = np.sign((q * exact[:, :4, 0]).sum(-1, keepdims=True))
    angle = 2 * np.linalg.norm(sign * q - exact[:, :4, 0] - exact[:, :4, 1], axis=-1)
    off = np.linalg.norm(w - exact[:, 4:, 0] - exact[:, 4:, 1], axis=-1)
    off = off / np.linalg.norm(exact[:, 4:, 0], axis=-1)
    return {
        "attitude_median": float(np.median(angle)),
        "attitude_worst": float(angle.max()),
        "rate_median": float(np.median(off)),
        "rate_worst": float(off.max()),
    }


def compiled(fn, *given):
    begin = time.process_time()
    program = jax.jit(fn).lower(*given).compile()
    return program, time.process_time() - begin


def final_state(case: str, count: int, t: float, scored: int) -> dict:
    q, w = bodies(case, count)
    moments = components(np.broadcast_to(np.array(CASES[case]), (count, 3)))
    given = moments, components(q), components(w), jnp.full(count, t)
    program, compile_s = compiled(free_motion, *given)
    timing = _report.clock(lambda: jax.block_until_ready(program(*given)), repeats=30)
    omega, wxyz = program(*given)
    exact = truth(case, scored, t)
    return {
        "case": case,
        "moments": CASES[case],
        "bodies": count,
        "t": t,
        "compile_s": compile_s,
        "ns_per_body": timing.least / count * 1e9,
        "ns_per_body_median": timing.median / count * 1e9,
        "scored": scored,
        **score(omega, wxyz, exact),
    }


def saved_times(count: int, times: int) -> dict:
    q, w = bodies("A", count)
    moments = components(np.broadcast_to(np.array(CASES["A"]), (count, 3)))
    t = jnp.linspace(0.0, 100.0, times)[None, :]
    row = {"bodies": count, "times": times}
    for name, wanted in (("both", {}), ("rates", {"attitude": False})):
        program, _ = compiled(
            lambda *a, wanted=wanted: free_motion(*a, **wanted),
            moments,
            components(q),
            components(w),
            t,
        )
        given = moments, components(q), components(w), t
        timing = _report.clock(lambda p=program, g=given: jax.block_until_ready(p(*g)), repeats=15)
        row[f"ns_per_state_{name}"] = timing.least / count / times * 1e9
    return row


def latency() -> dict:
    q, w = bodies("A", 1)
    given = jnp.array([CASES["A"]]), jnp.asarray(q), jnp.asarray(w), jnp.array([100.0])
    call = jax.jit(free_motion)
    timing = _report.clock(lambda: jax.block_until_ready(call(*given)), repeats=30)
    return {"us_per_call": timing.least * 1e6, "us_per_call_median": timing.median * 1e6}


def gradient(count: int, t: float = 100.0) -> dict:
    """Time and error of the derivative of each body's loss with respect to its own moments."""
    q, w = bodies("A", count)
    target = free_motion(
        components(np.broadcast_to(np.array((1.001, 1.998, 3.002)), (count, 3))),
        components(q),
        components(w),
        jnp.full(count, t),
    )
    times = jnp.full(count, t)
    start, rates = components(q), components(w)

    def loss(moments):
        omega, wxyz = free_motion(moments, start, rates, times)
        along = sum(a * b for a, b in zip(wxyz, target[1], strict=True))
        off = sum((a - b) ** 2 for a, b in zip(omega, target[0], strict=True))
        return jnp.sum(4 * (1 - along**2) + off)

    moments = components(np.broadcast_to(np.array(CASES["A"]), (count, 3)))
    forward, compile_forward = compiled(loss, moments)
    backward, compile_backward = compiled(jax.value_and_grad(loss), moments)
    calls = {
        "value": lambda: jax.block_until_ready(forward(moments)),
        "both": lambda: jax.block_until_ready(backward(moments)),
    }
    value, both = (x.least for x in _report.in_turn(calls, repeats=30).values())
    row = {
        "bodies": count,
        "t": t,
        "forward_ns_per_body": value / count * 1e9,
        "gradient_ns_per_body": both / count * 1e9,
        "ratio": both / value,
        "compile_forward_s": compile_forward,
        "compile_gradient_s": compile_backward,
    }
    peers = HERE.parents[1] / "shared" / "peers" / "truth" / "J4_A.npz"
    if peers.exists():
        table = np.load(peers)
        exact = table["grad_I"][:count]
        target = components(table["w_target"][:count]), components(table["q_target"][:count])
        found = np.stack(jax.grad(loss)(moments), -1)
        off = np.linalg.norm(found[: len(exact)] - exact, axis=-1)
        off = off / np.linalg.norm(exact, axis=-1)
        row |= {"error_median": float(np.median(off)), "error_worst": float(off.max())}
    return row


def heyoka_final(case: str, count: int, t: float, tolerance: float) -> dict | None:
    """The same final states by heyoka's Taylor integrator, eight bodies at a time."""
    try:
        import heyoka as hy
    except ImportError:
        return None
    names = hy.make_vars("q0", "q1", "q2", "q3", "x", "y", "z")
    body = dataclasses.replace(PROBLEMS["free"], moments=CASES[case])
    system = list(zip(names, rigid_body(body, names[:4], names[4:], 0 * names[0])))
    q, w = bodies(case, count)
    states = np.concatenate([q, w], 1)
    lanes = 8
    first = np.ascontiguousarray(states[:lanes].T)
    integrator = hy.taylor_adaptive_batch(system, first, tol=tolerance)
    found = np.empty((count, 7))

    def run():
        for n in range(0, count, lanes):
            integrator.set_time(0.0)
            integrator.state[:] = states[n : n + lanes].T
            integrator.propagate_until(t)
            found[n : n + lanes] = integrator.state.T

    timing = _report.clock(run, repeats=10)
    row = {"case": case, "bodies": count, "t": t, "tolerance": tolerance}
    row["ns_per_body"] = timing.least / count * 1e9
    return row | score(found[:, 4:].T, found[:, :4].T, truth(case, min(count, 20), t))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer scored bodies, no large batch")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    known = (HERE.parents[1] / "shared" / "peers" / "truth").is_dir()
    scored = 200 if known else 20 if options.quick else 100
    long = 1e5 if known else 1e3
    report = {
        "truth": f"Taylor series, {'double-double' if known else '34 digits'}",
        "final_states": [
            final_state(case, 1000, t, n)
            for t, n in ((100.0, scored), (long, 200 if known else 3))
            for case in CASES
        ],
    }
    ours = report["final_states"][0]["ns_per_body"]
    report["heyoka"] = [
        row | {"times_as_long": row["ns_per_body"] / ours}
        for row in (heyoka_final("A", 200, 100.0, tolerance) for tolerance in (1e-9, 1e-15))
        if row
    ]
    report["saved_times"] = saved_times(1000, 100)
    report["latency"] = latency()
    report["gradient"] = gradient(1000)
    if not options.quick:
        report["linear"] = [
            {k: final_state("A", n, 100.0, scored)[k] for k in ("bodies", "ns_per_body")}
            for n in (1000, 10_000, 100_000, 1_000_000)
        ]
    print(json.dumps(report, indent=1))
    print(_report.write("free_body", report, path=options.output, packages=("heyoka",)))


if __name__ == "__main__":
    main()
