"""What each kind of scene costs, and what skipping saves.

    python -m benchmarks.scene_cost [--quick] [--bodies 1000] [--output out/scene_cost.json]

For every scene: floating-point operations and bytes per body as counted by the compiler (a loop's
body is counted once), and measured nanoseconds per body on one core, median of repeats.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph

FINAL = ph.Record(final_only=True)
RATES = ph.Record(attitude=False, final_only=True)


def states(n: int, dtype=jnp.float64) -> ph.State:
    """Uniform attitudes, isotropic rates of size 1 to 2 rad/s."""
    rng = np.random.default_rng(3)
    omega = rng.normal(size=(n, 3))
    omega *= rng.uniform(1, 2, (n, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    return ph.State(jnp.asarray(rng.normal(size=(n, 4)), dtype), jnp.asarray(omega, dtype))


def scenes() -> dict[str, tuple[ph.Scene, ph.Record, int]]:
    """Name -> scene, record, number of times."""
    triaxial = ph.Inertia.from_moments([1.0, 2.0, 3.0])
    tensor = ph.Inertia.from_tensor([[1.0, 0.1, 0.2], [0.1, 1.5, -0.1], [0.2, -0.1, 1.25]])
    gravity = ph.UniformGravity(1.0, [0.0, 0.0, 0.5], [0.0, 0.0, -2.0])
    every = ph.Record()
    return {
        "free, rates only, final state": (ph.Scene(triaxial), RATES, 2),
        "free, final state": (ph.Scene(triaxial), FINAL, 2),
        "free, 100 times": (ph.Scene(triaxial), every, 101),
        "free, general tensor, final state": (ph.Scene(tensor), FINAL, 2),
        "free, axisymmetric, final state": (
            ph.Scene(ph.Inertia.axisymmetric(2.0, 1.0)), FINAL, 2,
        ),
        "free, spherical, final state": (ph.Scene(ph.Inertia.spherical(1.0)), FINAL, 2),
        "heavy top, final state": (ph.Scene(triaxial, gravity), FINAL, 2),
        "heavy top and damping, final state": (
            ph.Scene(triaxial, gravity, ph.LinearDamping(0.01)), FINAL, 2,
        ),
    }  # fmt: skip


def program(scene, state, ts, record):
    """The compiled program of a call of ``simulate``, and its arguments."""

    def simulated(scene, state, ts):
        return ph.simulate(scene, state, ts, record=record)

    arguments = scene, state, ts
    return eqx.filter_jit(simulated).lower(*arguments).compile(), arguments


def counts(compiled) -> dict[str, float]:
    """Operations, transcendental functions and bytes of a compiled program."""
    found = compiled.compiled.cost_analysis()
    return {
        name: float(found.get(name, 0.0)) for name in ("flops", "transcendentals", "bytes accessed")
    }


def build(name: str, n: int) -> tuple[dict, Callable]:
    """A row of the table without its time, and the call to be timed."""
    scene, record, times = scenes()[name]
    state, ts = states(n), jnp.linspace(0.0, 100.0, times)
    start = time.perf_counter()
    compiled, arguments = program(scene, state, ts, record)
    spent = time.perf_counter() - start
    row = {"scene": name, **{key: value / n for key, value in counts(compiled).items()}}
    return row | {"compile_s": spent}, lambda: jax.block_until_ready(compiled(*arguments))


def measure(names: list[str], n: int, repeats: int = 7) -> list[dict]:
    """The table; the programs take turns."""
    built = {name: build(name, n) for name in names}
    walls = _report.in_turn({name: call for name, (_, call) in built.items()}, repeats=repeats)
    return [
        row | {"ns": 1e9 * walls[name].median / n, "spread": walls[name].spread}
        for name, (row, _) in built.items()
    ]


def main() -> None:
    """Measure, print and write the table."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, default=1000)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--quick", action="store_true", help="200 bodies")
    options = parser.parse_args()
    bodies = 200 if options.quick else options.bodies
    rows = measure(list(scenes()), bodies)
    print(f"{'per body':<38}{'flops':>9}{'transc.':>9}{'bytes':>9}{'ns':>11}{'compile s':>11}")
    for row in rows:
        print(
            f"{row['scene']:<38}{row['flops']:>9.0f}{row['transcendentals']:>9.1f}"
            f"{row['bytes accessed']:>9.0f}{row['ns']:>11.0f}{row['compile_s']:>11.2f}"
        )
    _report.write("scene_cost", {"bodies": bodies, "rows": rows}, path=options.output)


if __name__ == "__main__":
    main()
