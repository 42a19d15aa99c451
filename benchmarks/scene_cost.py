"""Cost of each kind of scene, of each part of a scene, and of reading mass properties.

    python -m benchmarks.scene_cost [--quick] [--bodies 1000] [--output out/scene_cost.json]

For every scene: floating-point operations and bytes per body as counted by the compiler (a loop's
body is counted once), and measured nanoseconds per body on one core, median of repeats. Times of
all tables are processor times.

For every part: one satellite and 50 satellites on an orbit for an hour, under the gravity gradient
alone (the first row) and with the part; 61 samples, ``rtol=1e-6``. The columns are integration
steps (the median of the bodies), seconds of the first call (tracing, compilation and run, in a
process that has simulated another scene before), milliseconds of a later call of the compiled
program, and its ratio to that of the first row.

For every file format: the times of the first and of later reads of the mass properties of one
body.
"""

import argparse
import importlib.util
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

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
            ph.Scene(ph.Inertia.axisymmetric(2.0, 1.0)),
            FINAL,
            2,
        ),
        "free, spherical, final state": (ph.Scene(ph.Inertia.spherical(1.0)), FINAL, 2),
        "heavy top, final state": (ph.Scene(triaxial, gravity), FINAL, 2),
        "heavy top and damping, final state": (
            ph.Scene(triaxial, gravity, ph.LinearDamping(0.01)),
            FINAL,
            2,
        ),
    }


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
    start = time.process_time()
    compiled, arguments = program(scene, state, ts, record)
    spent = time.process_time() - start
    row = {"scene": name, **{key: value / n for key, value in counts(compiled).items()}}
    return row | {"compile_s": spent}, lambda: jax.block_until_ready(compiled(*arguments))


def measure(names: list[str], n: int, repeats: int = 7) -> list[dict]:
    """Rows of all scenes; the programs are timed alternately."""
    built = {name: build(name, n) for name in names}
    calls = {name: call for name, (_, call) in built.items()}
    times = _report.in_turn(calls, repeats=repeats, processor_time=True)
    return [
        row | {"ns": 1e9 * times[name].median / n, "spread": times[name].spread}
        for name, (row, _) in built.items()
    ]


# Cost of a part

MU, AXIS = 3.986004418e14, 6.871e6
SUN = (1.0, 0.0, 0.0)
CORNERS = ((1.0, 1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, 1))
BASE = "gravity gradient"
PART_BODIES = (1, 50)


class Satellite(NamedTuple):
    """A scene, and the recorded quantities."""

    scene: ph.Scene
    record: ph.Record = ph.Record()


def satellite_states(n: int) -> ph.State:
    """Random attitudes and rates of 5 deg/s; a single body has no batch axis."""
    rng = np.random.default_rng(5)
    omega, wxyz = rng.normal(size=(n, 3)), rng.normal(size=(n, 4))
    omega *= np.deg2rad(5.0) / np.linalg.norm(omega, axis=1, keepdims=True)
    return ph.State(wxyz, omega) if n > 1 else ph.State(wxyz[0], omega[0])


def plates() -> ph.Plates:
    """The faces of a box, and a panel exposed on one side."""
    edges = np.array([0.2263, 0.1, 0.366])
    faces = np.prod(edges) / edges
    return ph.Plates(
        [*faces, *faces, 0.06],
        [*np.eye(3), *-np.eye(3), [0.0, 0.0, 1.0]],
        [*np.diag(edges / 2), *-np.diag(edges / 2), [0.0, 0.2, 0.1]],
    )


def attitude_control(t, wxyz, omega_body):
    """Torque on the body towards the attitude (1, 0, 0, 0) [N m]."""
    return -2e-3 * jnp.sign(wxyz[0]) * wxyz[1:] - 0.03 * omega_body


def booms(t):
    """Moments of a box with two tip masses that extend along body x for ten minutes."""
    length = 0.1 + 1e-3 * jnp.minimum(t, 600.0)
    return jnp.array([0.1440, 0.1852, 0.0612]) + 0.2 * length**2 * jnp.array([0.0, 1.0, 1.0])


def momentum(trajectory):
    """Angular momentum in space axes at every sample."""
    return trajectory.momentum_space


def satellites() -> dict[str, Satellite]:
    """Name of the part -> satellite with this part; the first entry has none."""
    body = ph.Inertia.from_box(12.0, [0.2263, 0.1, 0.366])
    orbit = ph.KeplerOrbit(MU, AXIS, inclination=np.deg2rad(97.4))
    gradient = ph.GravityGradient(MU, orbit)
    dipole, moment = ph.DipoleField([0.0, 0.0, -7.8e22]), [0.0, 0.0, 0.02]
    times = jnp.linspace(0.0, 3600.0, 121)
    table = ph.Table(times, jax.vmap(dipole)(orbit(times), times))
    air = ph.Drag(plates(), 4e-13, orbit.velocity_at)
    light = ph.SolarPressure(plates(), SUN, ph.Eclipse(orbit, SUN), specular=0.2, diffuse=0.2)
    wheels = ph.wheel_cluster(CORNERS, 5e-5, attitude_control, max_torque=1e-3)
    unload = ph.MomentumDumping(2e-3, dipole, orbit, max_moment=0.2)
    gyro = ph.ControlMomentGyro(
        0.01, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], lambda t: 0.5 * jnp.sin(0.01 * t)
    )

    def with_torque(torque, rotors=None):
        return Satellite(ph.Scene(body, gradient, torque, rotors))

    return {
        BASE: with_torque(None),
        "magnetic dipole, field by formula": with_torque(ph.MagneticDipole(moment, dipole, orbit)),
        "magnetic dipole, field by cubic table": with_torque(ph.MagneticDipole(moment, table)),
        "drag and sunlight on seven plates, with shadow": with_torque(air + light),
        "inertia that changes with time": Satellite(ph.Scene(ph.VariableInertia(booms), gradient)),
        "four wheels under control": with_torque(None, wheels),
        "four wheels and momentum dumping": with_torque(unload, wheels),
        "control moment gyro": with_torque(gyro),
        "momentum saved in place of states": Satellite(
            ph.Scene(body, gradient), ph.Record(save=momentum)
        ),
    }


def satellite_call(satellite: Satellite, n: int) -> Callable:
    """The simulation of n satellites as a compiled program; returns the arrays of a trajectory."""
    state, ts = satellite_states(n), jnp.linspace(0.0, 3600.0, 61)

    @jax.jit
    def simulated(state):
        traj = ph.simulate(satellite.scene, state, ts, rtol=1e-6, record=satellite.record)
        return eqx.filter(traj, eqx.is_array)

    return lambda: jax.block_until_ready(simulated(state))


def measure_parts(
    names: list[str], bodies: tuple[int, ...] = PART_BODIES, repeats: int = 9
) -> list[dict]:
    """Rows of all parts, beginning with none; the programs are timed alternately."""
    named, rows = satellites(), []
    satellite_call(Satellite(ph.Scene(ph.Inertia.from_moments([1.0, 2.0, 3.0]))), 1)()
    for n in bodies:
        calls = {name: satellite_call(named[name], n) for name in [BASE, *names]}
        times = _report.in_turn(calls, repeats=repeats, budget=2.0, processor_time=True)
        for name, call in calls.items():
            rows.append(
                {
                    "part": name,
                    "bodies": n,
                    "steps": int(np.median(call().steps)),
                    "first_call_s": times[name].first,
                    "later_call_ms": 1e3 * times[name].median,
                    "ratio": times[name].median / times[BASE].median,
                    "spread": times[name].spread,
                }
            )
    return rows


# Cost of reading a body

LINK = """<link name="link{}"><inertial><origin xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"/>
<mass value="2.5"/><inertia ixx="0.1" iyy="0.12" izz="0.07" ixy="0" ixz="0" iyz="0"/>
</inertial></link>"""
BODY = """<body name="body{}"><freejoint/><geom type="box" size="0.1 0.2 0.3" mass="2"/></body>"""


def measure_files(repeats: int = 9) -> list[dict]:
    """Milliseconds to read one body, for each format whose reader is installed."""
    with tempfile.TemporaryDirectory() as folder:
        urdf, mjcf, mesh = (Path(folder) / name for name in ("a.urdf", "a.xml", "a.stl"))
        links, bodies = ("".join(text.format(i) for i in range(30)) for text in (LINK, BODY))
        urdf.write_text(f"<robot name='arm'>{links}</robot>")
        mjcf.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
        calls = {"URDF, 30 links": lambda: ph.MassProperties.from_urdf(urdf, "link29").mass}
        if importlib.util.find_spec("mujoco"):
            calls["MJCF, 30 bodies"] = lambda: ph.MassProperties.from_mjcf(mjcf, "body29").mass
        if importlib.util.find_spec("trimesh"):
            import trimesh

            trimesh.creation.icosphere(subdivisions=4).export(mesh)
            calls["STL, 5,120 triangles"] = lambda: (
                ph.MassProperties.from_mesh_file(mesh, density=1000.0).mass
            )
        blocking = {
            name: lambda call=call: jax.block_until_ready(call()) for name, call in calls.items()
        }
        times = _report.in_turn(blocking, repeats=repeats, processor_time=True)
    return [
        {"file": name, "first_read_s": timing.first, "later_read_ms": 1e3 * timing.median}
        for name, timing in times.items()
    ]


def main() -> None:
    """Measure, print and write the tables."""
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
    few = {"bodies": (1,), "repeats": 3} if options.quick else {}
    parts = measure_parts(list(satellites())[1:], **few)
    files = measure_files()
    print(f"\n{'part':<48}{'bodies':>7}{'steps':>7}{'first s':>9}{'ms':>9}{'ratio':>7}")
    for row in parts:
        print(
            f"{row['part']:<48}{row['bodies']:>7}{row['steps']:>7}{row['first_call_s']:>9.2f}"
            f"{row['later_call_ms']:>9.2f}{row['ratio']:>7.2f}"
        )
    for row in files:
        print(f"{row['file']:<48}{row['first_read_s']:.2f} s, later {row['later_read_ms']:.2f} ms")
    numbers = {"bodies": bodies, "rows": rows, "parts": parts, "files": files}
    _report.write("scene_cost", numbers, path=options.output)


if __name__ == "__main__":
    main()
