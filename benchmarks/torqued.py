"""Requested and actual errors of ``method=None`` for scenes with potentials, torques or wheels.

    python -m benchmarks.torqued [SCENE ...] [--quick] [--output out/benchmarks/torqued.json]

Every class of potential, torque and rotor, alone and in combination, on 24 different bodies:
needles, discs, near-spheres and ordinary ones, with rates between 1/32 and 8 rad/s, in one batch
and (four of them) one at a time; horizons from 0.25 s to 1,000 s (128 s where a torque spins bodies
up); float64 and float32. The reference is Newton-Euler's equations in benchmarks/torqued_truth.py,
integrated by heyoka's Taylor method in 80-bit arithmetic. Bodies whose final attitude depends on
the initial state more than ``WILD`` times as strongly as that of free rotation are counted
separately, because no method can bound their error.
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
from benchmarks import torqued_truth
from benchmarks.torqued_truth import BODIES, HORIZONS, MOMENTS, SCENES, WILD

TOLERANCES = {"float64": (1e-5, 1e-9), "float32": (1e-5,)}
ALONE = (0, 7, 14, 21)
"""Bodies that are also moved one at a time."""


def scene_of(name: str, moments, dtype) -> ph.Scene:
    """The scene as a user would construct it."""

    def a(*x):
        return jnp.asarray(x if len(x) > 1 else x[0], dtype)

    def wave(t):
        return jnp.stack([a(0.125) * jnp.sin(t), a(0.0625) * jnp.cos(2 * t), a(0.03125) + 0 * t])

    gravity = ph.UniformGravity(a(1.0), a(0.125, 0.0, 0.5), a(0.0, 0.0, -1.0))
    axial = ph.UniformGravity(a(1.0), a(0.0, 0.0, 0.5), a(0.0, 0.0, -1.0))
    gradient = ph.GravityGradient(a(0.5), a(1.5, 0.0, 2.0))
    orbit = ph.GravityGradient(a(0.5), ph.KeplerOrbit(a(0.5), a(2.0), a(0.25)))
    spring = ph.Potential(lambda r, t: 0.25 * r[0, 1] * r[2, 2] + 0.125 * r[1, 0] ** 2)
    linear, quadratic = (
        ph.LinearDamping(a(0.25, 0.125, 0.0625) / 8),
        ph.QuadraticDamping(a(0.03125)),
    )
    held = ph.Rotor(a(1.0, 2.0, 2.0), momentum=a(0.75))
    loose = ph.Rotor(a(0.0, 1.0, 0.0), inertia=a(0.25), speed=a(3.0), torque=a(0.0))
    driven = ph.Rotor(a(1.0, 0.0, 0.0), inertia=a(0.125), speed=a(2.0), impulse=jnp.sin)
    parts = {
        "asymmetric top": (gravity,),
        "Lagrange's top": (axial,),
        "gravity gradient": (gradient,),
        "gravity gradient, Kepler": (orbit,),
        "potential of attitude": (spring,),
        "body torque": (None, ph.BodyTorque(a(0.03125, 0.015625, -0.0078125))),
        "body torque of time": (None, ph.BodyTorque(wave)),
        "space torque": (None, ph.SpaceTorque(a(0.03125, 0.0, 0.015625))),
        "space torque of time": (None, ph.SpaceTorque(wave)),
        "linear damping": (gravity, linear),
        "quadratic damping": (None, quadratic),
        "rotor held": (None, None, held),
        "rotor free": (None, None, loose),
        "rotor driven": (None, None, driven),
        "several": (gravity + gradient, linear + ph.SpaceTorque(wave), held + loose),
    }[name]
    return ph.Scene(ph.Inertia.from_moments(jnp.asarray(moments, dtype)), *parts)


def error_of(wxyz, exact) -> np.ndarray:
    """Angles [rad] between attitudes (n, 4) and the reference; NaN if there is none."""
    q, exact = np.asarray(wxyz, np.longdouble), np.asarray(exact)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    gap = np.minimum(*(np.linalg.norm(q - s * exact, axis=-1) for s in (1, -1)))
    return np.asarray(4 * np.arcsin(np.minimum(gap / 2, 1)), float)


def run(name, horizon, rtol, dtype, which, method=None):
    """Final attitudes (n, 4), status and steps of the bodies ``which``."""
    moments, wxyz, omega = MOMENTS[which], *(x[which] for x in torqued_truth.states(name))
    if name == "Lagrange's top":
        moments = torqued_truth.axisymmetric(moments)
    scene = scene_of(name, moments, dtype)
    state = ph.State(jnp.asarray(wxyz, dtype), jnp.asarray(omega, dtype))
    times = jnp.asarray([0.0, horizon], dtype)
    record = ph.Record(final_only=True)
    out = ph.simulate(scene, state, times, method, rtol=rtol, record=record, throw=False)
    return np.asarray(out.wxyz)[..., -1, :], np.asarray(out.status), np.asarray(out.steps)


def reached(name, dtype, horizons, tolerances) -> list[dict]:
    """Rows of one scene."""
    rows, everyone = [], np.arange(BODIES)
    for horizon in horizons:
        exact, growth, turned = torqued_truth.truth(name, horizon)
        for rtol in tolerances:
            # rounding: a random walk of the momentum, which the phase integrates
            floor = 4 * np.finfo(dtype).eps * turned**1.5
            for kind in ("batch", "alone"):
                which = everyone if kind == "batch" else np.array(ALONE)
                if kind == "batch":
                    wxyz, status, steps = run(name, horizon, rtol, dtype, which)
                else:
                    each = [run(name, horizon, rtol, dtype, i) for i in which]
                    wxyz, status, steps = (np.stack(x) for x in zip(*each))
                error = error_of(wxyz, exact[which])
                calm = (growth[which] < WILD) & (status == 0)
                over = error / np.maximum(rtol, floor[which])
                worst = int(np.argmax(np.where(calm, over, -1)))
                rows.append(
                    {
                        "scene": name,
                        "dtype": dtype,
                        "horizon": horizon,
                        "rtol": rtol,
                        "kind": kind,
                        "median": np.median(error[calm]) if calm.any() else np.nan,
                        "worst": error[calm].max() if calm.any() else np.nan,
                        "over_median": np.median(over[calm]) if calm.any() else np.nan,
                        "over_worst": over[worst] if calm.any() else np.nan,
                        "worst_body": int(which[worst]),
                        "turned": turned[which][worst],
                        "tame": int(calm.sum()),
                        "bodies": len(which),
                        "flagged": int(np.sum(status != 0)),
                        "steps": int(steps.max()),
                    }
                )
    return rows


def over_tolerance(rows: list[dict]) -> list[dict]:
    """One row for each scene, dtype and tolerance: errors over the larger of ``rtol`` and rounding.

    The columns are the largest median over all horizons, the largest error by horizon, the smallest
    number of bodies in the batch that count, and the number of flagged bodies.
    """
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["dtype"], row["rtol"]), []).append(row)

    def largest(some: list[dict], key: str) -> float | None:
        values = (row[key] for row in some if row[key] is not None and np.isfinite(row[key]))
        return max(values, default=None)

    found = []
    for (scene, dtype, rtol), group in groups.items():
        worst = {
            f"worst_t_{horizon:g}": largest(
                [r for r in group if r["horizon"] == horizon], "over_worst"
            )
            for horizon in dict.fromkeys(row["horizon"] for row in group)
        }
        found.append(
            {"scene": scene, "dtype": dtype, "rtol": rtol, "median": largest(group, "over_median")}
            | worst
            | {
                "bodies_counted": min(row["tame"] for row in group if row["kind"] == "batch"),
                "flagged": sum(row["flagged"] for row in group),
            }
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", help="all when none is named")
    parser.add_argument("--quick", action="store_true", help="float64, two horizons")
    parser.add_argument("--dtype", choices=("float64", "float32"))
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name in options.scenes or SCENES:
        for dtype in ("float64", "float32") if options.dtype is None else (options.dtype,):
            if options.quick and dtype == "float32":
                continue
            horizons = HORIZONS[1:3] if options.quick else HORIZONS
            if "torque" in name:  # after half a million radians only rounding is left
                horizons = [h for h in horizons if h < 1000]
            tolerances = TOLERANCES[dtype]
            rows += (new := reached(name, dtype, horizons, tolerances))
            for row in new:
                print(
                    "  ".join(f"{v:.2g}" if isinstance(v, float) else f"{v}" for v in row.values()),
                    flush=True,
                )
        jax.clear_caches()  # all programs together would not fit into memory
        numbers = {"rows": rows, "over_tolerance": over_tolerance(rows)}
        path = _report.write("torqued", numbers, path=options.output, packages=("heyoka",))
    print(path)


if __name__ == "__main__":
    main()
