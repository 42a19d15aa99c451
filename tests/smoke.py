"""Tests for any supported set of versions: ``python tests/smoke.py [name ...]``.

They cover the README's examples, one scene of each kind with value and gradient in both modes, a
fit, and the commands with their files; names select some of these. versions.py runs this script.
"""

import contextlib
import os
import re
import sys
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path

# as polhode.cli does
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode import plot

jax.config.update("jax_enable_x64", True)

ROOT = Path(__file__).resolve().parents[1]
MOMENTS = jnp.array([1.0, 1.5, 2.0])
SYMMETRIC = jnp.array([1.0, 1.0, 0.5])
TOP = ph.UniformGravity(1.0, [0.0, 0.0, 0.5])
ORBIT = ph.GravityGradient(2.0, lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0.5 + 0 * t]))


def general(potential=None, torque=None, rotors=None):
    return lambda m: ph.Scene(ph.Inertia.from_moments(m), potential, torque, rotors)


def symmetric(potential=None, torque=None):
    return lambda m: ph.Scene(ph.Inertia.axisymmetric(m[0], m[2]), potential, torque)


SCENES = {
    "free": (general(), MOMENTS),
    "free, symmetric": (symmetric(), SYMMETRIC),
    "Lagrange's top": (symmetric(ph.UniformGravity.axial(1.0, 0.5)), SYMMETRIC),
    "heavy top": (general(TOP), MOMENTS),
    "gravity gradient": (general(ph.GravityGradient(2.0, [0.6, 0.0, 0.8])), MOMENTS),
    "gravity gradient in orbit": (general(ORBIT), MOMENTS),
    "any potential": (general(ph.Potential(lambda R, t: R[0, 1] * jnp.cos(t) + R[2, 2])), MOMENTS),
    "torques": (
        general(
            TOP,
            ph.BodyTorque([0.1, 0.0, -0.1])
            + ph.SpaceTorque(lambda t: jnp.stack([0 * t, jnp.sin(t), 0 * t]))
            + ph.LinearDamping(0.05)
            + ph.QuadraticDamping(0.01),
        ),
        MOMENTS,
    ),
    "rotor": (general(rotors=ph.Rotor([0.0, 0.0, 1.0], momentum=0.4)), MOMENTS),
}


def check_scene(scene, moments):
    """The default method against another integrator, its gradient against differences."""
    state = ph.State([0.5, 0.5, 0.5, -0.5], [0.5, -1.0, 0.75])

    def end(m, method=None):
        found = ph.simulate(scene(m), state, [0.0, 1.5], method, rtol=1e-10)
        return found.omega_body[-1] @ jnp.array([0.3, 0.5, -0.7]) + found.wxyz[-1, 1]

    value, slope = jax.jit(jax.value_and_grad(end))(moments)
    np.testing.assert_allclose(value, end(moments, ph.LiePoisson()), rtol=0, atol=1e-8)
    # two changes that preserve the symmetry of the body
    for step in (jnp.array([1.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0])):
        ends = [end(moments + s * 1e-5 * step) for s in (1, -1)]
        along = (ends[0] - ends[1]) / 2e-5
        np.testing.assert_allclose(slope @ step, along, rtol=0, atol=1e-5)
    pushed = jax.jvp(end, (moments,), (step,))[1]
    np.testing.assert_allclose(pushed, slope @ step, rtol=0, atol=1e-8)


def check_fit():
    """The inertia ratios of a free body from its rates, to the noise."""
    times = np.linspace(0, 6, 150)
    moments = np.array([1.0, 1.6, 2.1])
    scene = ph.Scene(ph.Inertia.from_moments(moments))
    rates = ph.simulate(scene, ph.State([1.0, 0, 0, 0], [0.4, 2.0, 0.5]), times).omega_body
    noise = np.random.default_rng(1).normal(scale=1e-4, size=(150, 3))
    found = ph.fit_inertia(times, np.asarray(rates) + noise)
    fitted = np.linalg.eigvalsh(np.asarray(found.inertia.tensor))
    np.testing.assert_allclose(fitted / fitted.sum(), moments / moments.sum(), rtol=2e-3)


def check_commands():
    """Scene file to NetCDF, figure and page; ensemble to Zarr; recording to numbers and figure."""
    import trimesh

    from polhode.cli import main as polhode

    def run(words):
        assert polhode(words.split()) == 0, words

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        run("run wing_nut --clones 3 -o nut.nc -q")
        run("view nut.nc")
        run("explain toutatis --clones 0")
        run("schema")
        batch = "[ensemble]\nbodies = 8\nseed = 1\n[ensemble.attitude]\nany = true\n"
        scene = Path(ph.files.shipped_scenes()["nasa_brick"]).read_text(encoding="utf-8")
        Path("many.toml").write_text(scene.partition("[observations]")[0] + batch)
        run("run many.toml -q")
        times = np.linspace(0, 6, 150)
        scene = ph.Scene(ph.Inertia.from_moments([1.0, 1.6, 2.1]))
        motion = ph.simulate(scene, ph.State([1.0, 0, 0, 0], [0.4, 2.0, 0.5]), times)
        plot.view(motion, mesh=trimesh.creation.box((1.0, 2.0, 3.0)))
        noise = np.random.default_rng(1).normal(scale=1e-4, size=(150, 3))
        table = np.column_stack([times, np.asarray(motion.omega_body) + noise])
        np.savetxt("imu.csv", table, delimiter=",", header="t,wx,wy,wz", comments="")
        run("fit imu.csv -q -o fit")
        plot.overview(motion).savefig("overview.png")
        written = {path.name for path in Path().iterdir()}
        needed = {"nut.nc", "nut.png", "nut.html", "many.zarr", "fit.json", "fit.png"}
        assert needed <= written, needed - written


OTHERS = {"fit": check_fit, "commands": check_commands}


def main():
    warnings.simplefilter("error")
    packages = (
        "jax",
        "jaxlib",
        "equinox",
        "diffrax",
        "optimistix",
        "lineax",
        "jaxtyping",
        "numpy",
        "typer",
        "pydantic",
        "rich",
        "xarray",
        "h5netcdf",
        "h5py",
        "zarr",
        "matplotlib",
    )
    print(*(f"{name} {version(name)}" for name in packages), sep=", ")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks, scope = re.findall(r"^```python\n(.*?)^```", readme, re.S | re.M), {}
    assert blocks, "README.md has no example"
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for block in blocks:
            exec(block, scope)
    failed, checks = [], {**SCENES, **OTHERS}
    for name, run in checks.items():
        if sys.argv[1:] and name not in sys.argv[1:]:
            continue
        try:
            run() if callable(run) else check_scene(*run)
        except Exception as error:
            failed.append(name)
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
        else:
            print(f"{name}: good", flush=True)
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
