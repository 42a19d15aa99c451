"""Cost of the first calls in a new process: tracing, lowering and compilation.

    python -m benchmarks.first_calls [--quick] [KIND ...] [--output FILE]

Each kind of scene runs in its own process without a compilation cache. ``value`` is the first
ordinary call of ``ph.simulate``; ``gradient`` is the first ``jax.grad`` after it, of a scalar
function of the motion with respect to the principal moments and the initial rates. The stages of
both are those of one program under ``jax.jit`` in a second process. Times are processor times [s]
of one core; imports are listed separately.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from benchmarks import _report

KINDS = ("free", "heavy_top", "lagrange", "damped", "gradient")
TITLES = {
    "free": "free body",
    "heavy_top": "asymmetric heavy top",
    "lagrange": "Lagrange's top",
    "damped": "damped satellite in an orbit",
    "gradient": "gravity gradient",
}
STAGES = ("trace", "lower", "compile")


def _problem(kind: str):
    """A function of moments and rates that simulates, and its arguments."""
    import jax.numpy as jnp

    import polhode as ph

    state = [1.0, 0.0, 0.0, 0.0]
    moments, omega = jnp.array([1.0, 1.5, 2.0]), jnp.array([0.3, 0.2, 1.1])
    acts = {
        "free": (),
        "heavy_top": (ph.UniformGravity(1.0, [0.0, 0.0, 0.5]),),
        "lagrange": (ph.UniformGravity.axial(1.0, 0.5),),
        "damped": (
            ph.GravityGradient(1.0, ph.KeplerOrbit(1.0, 2.0, 0.1)),
            ph.LinearDamping(0.01),
        ),
        "gradient": (ph.GravityGradient(0.25, [0.6, 0.0, 0.8]),),
    }[kind]

    def simulated(moments, omega):
        if kind == "lagrange":
            inertia = ph.Inertia.axisymmetric(moments[0], moments[2])
        else:
            inertia = ph.Inertia.from_moments(moments)
        return ph.simulate(ph.Scene(inertia, *acts), ph.State(state, omega), [0.0, 10.0])

    def loss(moments, omega):
        found = simulated(moments, omega)
        end = found.last
        return jnp.sum(end.wxyz[1:]) + jnp.sum(end.omega_body)

    return simulated, loss, (moments, omega)


def _child(kind: str, staged: bool) -> dict:
    """Seconds of the first calls in this process, or of the stages of their programs."""
    begin = time.process_time()
    import jax

    jax.config.update("jax_enable_x64", True)
    import diffrax  # noqa: F401 (so that its import counts below)

    import polhode as ph
    import polhode.fit

    simulated, loss, given = _problem(kind)
    ph.simulate  # noqa: B018 (imports the lazy name)
    jax.block_until_ready(jax.jit(lambda x: x + 1)(given[0]))
    found = {"imports": time.process_time() - begin}
    slope = jax.grad(loss, argnums=(0, 1))
    if not staged:
        for name, call in (("value", lambda *x: simulated(*x).wxyz), ("gradient", slope)):
            begin = time.process_time()
            jax.block_until_ready(call(*given))
            found[name] = time.process_time() - begin
        return found
    for name, call in (("value", loss), ("gradient", slope)):
        program, marks = jax.jit(call), [time.process_time()]
        traced = program.trace(*given)
        marks.append(time.process_time())
        lowered = traced.lower()
        marks.append(time.process_time())
        lowered.compile()
        marks.append(time.process_time())
        found[name] = {s: b - a for s, a, b in zip(STAGES, marks, marks[1:])}
    return found


def measure(kind: str, repeats: int) -> dict:
    """One row: for each number the minimum over the repeats."""
    _report.compile_package()
    environment = {
        **os.environ,
        "JAX_ENABLE_COMPILATION_CACHE": "false",
        "XLA_FLAGS": _report.ONE_THREAD,
        "NPROC": "1",
    }

    def ask(how: str) -> dict:
        words = [sys.executable, "-m", "benchmarks.first_calls", how, kind]
        return json.loads(subprocess.run(words, env=environment, stdout=-1, check=True).stdout)

    calls = [ask("--calls") for _ in range(repeats)]
    stages = [ask("--stages") for _ in range(repeats)]
    row = {"kind": kind, "title": TITLES[kind]}
    row |= {name: min(c[name] for c in calls) for name in ("imports", "value", "gradient")}
    for what in ("value", "gradient"):
        row[f"{what}_stages"] = {s: min(c[what][s] for c in stages) for s in STAGES}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("kinds", nargs="*", choices=(*KINDS, []), help="which scenes; none: all")
    parser.add_argument("--quick", action="store_true", help="one process of each instead of two")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--calls", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--stages", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.calls or options.stages:
        print(json.dumps(_child(options.kinds[0], options.stages)))
        return
    rows = []
    for kind in options.kinds or KINDS:
        rows.append(measure(kind, 1 if options.quick else 2))
        r = rows[-1]
        parts = "; ".join(
            f"{what} {r[what]:.2f} s ("
            + ", ".join(f"{s} {r[f'{what}_stages'][s]:.2f}" for s in STAGES)
            + ")"
            for what in ("value", "gradient")
        )
        print(f"{r['title']:30} {parts}; imports {r['imports']:.2f}", flush=True)
    _report.write("first_calls", {"rows": rows}, path=options.output)


if __name__ == "__main__":
    main()
