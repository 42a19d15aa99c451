"""Energy and angular momentum of polhode's default methods over 1e5 revolutions.

    python -m benchmarks.conservation [--turns 100000] [--quick] [--output FILE]

One body of each scene is simulated by ``ph.simulate`` with its defaults (except ``max_steps``), in
float64 and float32. The table contains relative changes of the energy and of the angular momentum:
of the whole vector in space for free bodies, of its vertical component under uniform gravity.
"""

import argparse
import dataclasses
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import numpy as np

import polhode as ph

SAMPLES = 10  # with logarithmic spacing up to the last time


def scenes() -> dict[str, tuple[ph.Scene, list[float]]]:
    """A scene and its initial body rates [rad/s] for each default method."""
    gravity = ph.UniformGravity.axial
    free = {
        "free sphere": ph.Inertia.spherical(1.0),
        "free axisymmetric body": ph.Inertia.axisymmetric(transverse=1.0, axial=1.5),
        "free body": ph.Inertia.from_moments([1.0, 2.0, 3.0]),
    }
    tops = {
        "Lagrange's top": ph.Inertia.axisymmetric(transverse=1.0, axial=1.5),
        "asymmetric heavy top": ph.Inertia.from_moments([1.0, 1.3, 1.7]),
    }
    rates = [0.3, 0.2, 2.0]
    weight = gravity(mass=1.0, distance=0.1)
    return {name: (ph.Scene(inertia), rates) for name, inertia in free.items()} | {
        name: (ph.Scene(inertia, potential=weight), rates) for name, inertia in tops.items()
    }


def measure(name: str, dtype: str, turns: int) -> list[dict]:
    """One row for each power of ten of revolutions: the largest changes up to that time."""
    scene, rates = scenes()[name]
    scene = jax.tree.map(lambda x: np.asarray(x, dtype), scene)
    state = ph.State(np.array([0.9, 0.3, 0.2, 0.1], dtype), np.array(rates, dtype))
    last = turns * 2 * np.pi / np.linalg.norm(rates)
    marks = np.logspace(0, np.log10(turns), SAMPLES * round(np.log10(turns)) + 1)
    ts = np.concatenate([[0.0], marks / turns * last]).astype(dtype)
    plan = ph.explain(scene, state, ts)
    # 1e5 revolutions take more steps than the default method allows
    is_integrated = isinstance(plan.method, ph.LiePoisson)
    method = dataclasses.replace(plan.method, max_steps=2**22) if is_integrated else None
    motion = ph.simulate(scene, state, ts, method)
    energy = np.asarray(motion.energy, float)
    momentum = np.asarray(motion.momentum_space, float)
    if scene.potential is not None:
        momentum = momentum[:, 2:]
    change = np.abs(energy - energy[0]) / np.abs(energy[0])
    drift = np.linalg.norm(momentum - momentum[0], axis=-1) / np.linalg.norm(momentum[0])
    return [
        {
            "scene": name,
            "method": type(plan.method).__name__,
            "dtype": dtype,
            "turns": 10**power,
            "energy": change[: SAMPLES * power + 2].max(),
            "momentum": drift[: SAMPLES * power + 2].max(),
        }
        for power in range(1, round(np.log10(turns)) + 1)
    ]


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=100_000, help="a power of ten")
    parser.add_argument("--quick", action="store_true", help="100 revolutions")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    turns = 100 if options.quick else options.turns
    jax.config.update("jax_enable_x64", True)
    rows = []
    for dtype in ("float64", "float32"):
        for name in scenes():
            rows += measure(name, dtype, turns)
            row = rows[-1]
            print(
                f"{name:<24}{row['method']:<14}{dtype:<9}{row['energy']:>10.1e}"
                f"{row['momentum']:>10.1e}",
                flush=True,
            )
    path = _report.write("conservation", {"turns": turns, "rows": rows}, path=options.output)
    print(f"written: {path.name}")


if __name__ == "__main__":
    main()
