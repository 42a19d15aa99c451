"""Time to the result of eleven typical tasks, each in a new process.

    python -m benchmarks.cold_tasks [--quick] [--tasks NAME ...] [--output out/cold_tasks.json]

Each task runs in a process of its own with polhode and, for some tasks, with a common alternative
(SciPy, or diffrax by hand). Times include imports. ``first``: from the start of the process to the
first result; ``second``: the same call again; ``cached``: to the first result of a later process
that loads compiled programs from JAX's persistent cache; ``memory``: the maximum resident size.
Errors are those of the attitude or of the requested number, relative to a solution of the other
library at a tight tolerance.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import _report

BEGUN = time.perf_counter()

MOMENTS = (1.0, 1.5, 2.0)
RATES = (0.3, 0.2, 3.0)
MU, AXIS = 3.986004418e14, 6.871e6


# A task is a function that imports what it needs and returns the call; the call returns numbers.


def free_body() -> Callable:
    """A free body for 100 s, and its period."""
    import jax.numpy as jnp

    import polhode as ph

    inertia, state = ph.Inertia.from_moments(MOMENTS), ph.State([1.0, 0, 0, 0], RATES)

    def call():
        traj = ph.simulate(ph.Scene(inertia), state, jnp.linspace(0.0, 100.0, 101))
        ph.periods(inertia, state)
        return traj.wxyz[-1]

    return call


def free_body_scipy(tight: bool = False) -> Callable:
    """The same by SciPy."""
    return _scipy(lambda t, wxyz, omega: 0.0, 100.0, tight)


def heavy_top() -> Callable:
    """An asymmetric heavy top for 20 s."""
    import jax.numpy as jnp

    import polhode as ph

    gravity = ph.UniformGravity(1.0, [0.1, 0.2, 0.3], [0.0, 0.0, -9.81])
    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), gravity)
    state = ph.State([1.0, 0, 0, 0], RATES)
    return lambda: ph.simulate(scene, state, jnp.linspace(0.0, 20.0, 101), rtol=1e-8).wxyz[-1]


def heavy_top_scipy(tight: bool = False) -> Callable:
    """The same by SciPy."""
    import numpy as np

    def torque(t, wxyz, omega):
        w, x, y, z = wxyz
        down = -9.81 * np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        return np.cross([0.1, 0.2, 0.3], down)

    return _scipy(torque, 20.0, tight)


def lagrange_gradient() -> Callable:
    """Lagrange's top for 20 s, and the derivative of its final height with respect to the distance
    of the centre of mass.
    """
    import jax

    import polhode as ph

    def height(distance):
        scene = ph.Scene(ph.Inertia.axisymmetric(1.0, 0.5), ph.UniformGravity.axial(1.0, distance))
        state = ph.State([0.96, 0.28, 0.0, 0.0], [0.0, 0.0, 20.0])
        wxyz = ph.simulate(scene, state, [0.0, 20.0]).wxyz[-1]
        return 1 - 2 * (wxyz[1] ** 2 + wxyz[2] ** 2)

    slope = jax.jit(jax.value_and_grad(height))
    return lambda: jax.numpy.stack(slope(0.3))


def lagrange_gradient_diffrax(tight: bool = False) -> Callable:
    """The same by diffrax."""
    import jax
    import jax.numpy as jnp

    def height(distance):
        def torque(t, wxyz, omega):
            w, x, y, z = wxyz
            up = jnp.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
            return -9.80665 * jnp.cross(jnp.array([0.0, 0.0, 1.0]), up) * distance

        moments = jnp.array([1.0, 1.0, 0.5])
        y = _diffrax(torque, moments, [0.96, 0.28, 0, 0], [0.0, 0, 20.0], [0.0, 20.0], tight)[-1]
        return 1 - 2 * (y[1] ** 2 + y[2] ** 2)

    slope = jax.jit(jax.value_and_grad(height))
    return lambda: jnp.stack(slope(0.3))


def _satellite():
    import numpy as np

    import polhode as ph

    body = ph.Inertia.from_box(12.0, [0.2263, 0.1, 0.366])
    orbit = ph.KeplerOrbit(MU, AXIS, inclination=np.deg2rad(97.4))
    field = ph.DipoleField([0.0, 0.0, -7.8e22])
    rods = ph.MagneticDipole(ph.BDot(2e4, max_moment=0.2), field, orbit)
    scene = ph.Scene(body, ph.GravityGradient(MU, orbit), rods)
    state = ph.State([1.0, 0, 0, 0], np.deg2rad(5.0) * np.ones(3) / np.sqrt(3))
    return scene, state


def satellite() -> Callable:
    """A satellite with clipped magnetorquers, 901 samples of six hours."""
    import jax.numpy as jnp

    import polhode as ph

    scene, state = _satellite()
    ts = jnp.linspace(0.0, 21600.0, 901)
    return lambda: ph.simulate(scene, state, ts, rtol=1e-6).wxyz[-1]


def satellite_diffrax(tight: bool = False) -> Callable:
    """The same by diffrax, twenty lines."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    law, moments = _magnetorquers(jnp)
    start = np.deg2rad(5.0) * np.ones(3) / np.sqrt(3)
    ts = jnp.linspace(0.0, 21600.0, 901)
    run = jax.jit(lambda: _diffrax(law, moments, [1.0, 0, 0, 0], start, ts, tight)[-1, :4])
    return run


def _magnetorquers(np):
    edges = np.array([0.2263, 0.1, 0.366])
    moments = 12.0 / 12 * (np.sum(edges**2) - edges**2)
    tilt, rate = 97.4 * np.pi / 180, np.sqrt(MU / AXIS**3)
    dipole = np.array([0.0, 0.0, -7.8e22])

    def law(t, wxyz, omega):
        w, x, y, z = wxyz
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        c, s = np.cos(rate * t), np.sin(rate * t)
        place = AXIS * np.array([c, s * np.cos(tilt), s * np.sin(tilt)])
        along = np.dot(dipole, place) / AXIS**2
        field = turn.T @ (1e-7 * (3 * along * place - dipole) / AXIS**3)
        body = turn.T @ place
        moment = np.clip(2e4 * np.cross(omega, field), -0.2, 0.2)
        return 3 * MU / AXIS**5 * np.cross(body, moments * body) + np.cross(moment, field)

    return law, moments


def event() -> Callable:
    """The time at which the rate of this satellite falls to 0.1 deg/s."""
    import jax.numpy as jnp
    import numpy as np

    import polhode as ph

    scene, state = _satellite()
    calm = ph.Event(lambda wxyz, omega, t: jnp.linalg.norm(omega) - np.deg2rad(0.1), -1)
    return lambda: ph.simulate(scene, state, [0.0, 86400.0], rtol=1e-7, until=calm).event_time


def event_scipy(tight: bool = False) -> Callable:
    """The same by SciPy."""
    import numpy as np
    from scipy.integrate import solve_ivp

    law, moments = _magnetorquers(np)

    def calm(t, y):
        return np.linalg.norm(y[4:]) - np.deg2rad(0.1)

    calm.terminal, calm.direction = True, -1
    start = np.concatenate([[1.0, 0, 0, 0], np.deg2rad(5.0) * np.ones(3) / np.sqrt(3)])
    rtol = 1e-11 if tight else 1e-8

    def call():
        found = solve_ivp(
            _rates(law, moments, np),
            (0.0, 86400.0),
            start,
            "DOP853",
            events=calm,
            rtol=rtol,
            atol=rtol,
        )
        return np.array(found.t_events[0][0])

    return call


def monte_carlo(bodies: int = 2000) -> Callable:
    """2,000 copies of this satellite for six hours; last states."""
    import jax.numpy as jnp
    import numpy as np

    import polhode as ph

    scene, _ = _satellite()
    rng = np.random.default_rng(0)
    state = ph.State(rng.normal(size=(bodies, 4)), 0.05 * rng.normal(size=(bodies, 3)))
    ts, last = jnp.array([0.0, 21600.0]), ph.Record(final_only=True)
    return lambda: ph.simulate(scene, state, ts, rtol=1e-6, record=last).wxyz[0, -1]


def flyby(bodies: int = 500) -> Callable:
    """500 clones of an asteroid on a hyperbolic passage of the Earth, 101 times."""
    import jax.numpy as jnp
    import numpy as np

    import polhode as ph

    orbit = ph.HyperbolicOrbit.from_state(MU, [-3.8e8, 7.0e7, 0.0], [6.0e3, 0.0, 0.0])
    scene = ph.Scene(ph.Inertia.from_moments([0.61, 0.95, 1.0]), ph.GravityGradient(MU, orbit))
    rng = np.random.default_rng(0)
    turn = 2 * np.pi / 1.1e5
    state = ph.State(rng.normal(size=(bodies, 4)), turn * rng.normal(size=(bodies, 3)))
    ts = jnp.linspace(0.0, 1.3e5, 101)
    return lambda: ph.simulate(scene, state, ts, rtol=1e-6).wxyz[0, -1]


def filter_steps() -> Callable:
    """100 prediction steps of a Kalman filter, each with its Jacobian."""
    import jax
    import jax.numpy as jnp

    import polhode as ph

    scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), None, ph.LinearDamping(0.01))

    @jax.jit
    def steps(state):
        def one(state, _):
            step = ph.propagate(scene, state, 0.1)
            return step.state, step.jacobian

        end, _ = jax.lax.scan(one, state, None, length=100)
        return end.wxyz

    return lambda: steps(ph.State(jnp.array([1.0, 0, 0, 0]), jnp.array(RATES)))


def control() -> Callable:
    """A rest-to-rest rotation: 20 gradient steps on the widths of two pulses."""
    import jax
    import jax.numpy as jnp

    import polhode as ph

    def miss(widths):
        pulses = ph.Pulses(
            ph.BodyTorque([0.0, 0.0, 0.5]), jnp.array([0.5]), 0.5 + widths[:1]
        ) + ph.Pulses(ph.BodyTorque([0.0, 0.0, -0.5]), jnp.array([5.0]), 5.0 + widths[1:])
        scene = ph.Scene(ph.Inertia.from_moments(MOMENTS), None, pulses)
        end = ph.simulate(scene, ph.State([1.0, 0, 0, 0], jnp.zeros(3)), [0.0, 8.0])
        angle = 2 * jnp.arctan2(end.wxyz[-1, 3], end.wxyz[-1, 0])
        return (angle - 1.0) ** 2 + 10 * end.omega_body[-1, 2] ** 2

    slope = jax.jit(jax.value_and_grad(miss))

    def call():
        widths = jnp.array([1.0, 1.0])
        for _ in range(20):
            value, change = slope(widths)
            widths = widths - 0.1 * change
        return value

    return call


def toss() -> Callable:
    """The inertia of a body from a recorded toss: rates of 2 s at 200 Hz."""
    import jax
    import numpy as np

    import polhode as ph

    inertia = ph.Inertia.from_moments(MOMENTS)
    ts = np.linspace(0.0, 2.0, 401)
    omega = np.asarray(
        ph.simulate(ph.Scene(inertia), ph.State([1.0, 0, 0, 0], RATES), ts).omega_body
    )
    rng = np.random.default_rng(0)
    seen = omega + 1e-3 * rng.normal(size=omega.shape)
    return lambda: jax.block_until_ready(ph.fit_inertia(ts, seen).inertia.tensor)


def view() -> Callable:
    """An HTML page of a tumbling body."""
    import jax.numpy as jnp

    import polhode as ph

    scene, state = ph.Scene(ph.Inertia.from_moments(MOMENTS)), ph.State([1.0, 0, 0, 0], RATES)

    def call():
        traj = ph.simulate(scene, state, jnp.linspace(0.0, 20.0, 201))
        with tempfile.TemporaryDirectory() as folder:
            ph.plot.view(traj, Path(folder) / "body.html")
        return traj.wxyz[-1]

    return call


def _rates(torque, moments, np):
    def field(t, y):
        q, w = y[:4], y[4:]
        turn = np.concatenate([np.reshape(-q[1:] @ w, (1,)), q[0] * w + np.cross(q[1:], w)]) / 2
        return np.concatenate([turn, (torque(t, q, w) - np.cross(w, moments * w)) / moments])

    return field


def _scipy(torque, end: float, tight: bool) -> Callable:
    import numpy as np
    from scipy.integrate import solve_ivp

    start, rtol = np.concatenate([[1.0, 0, 0, 0], RATES]), 1e-12 if tight else 1e-9
    field = _rates(lambda t, q, w: torque(t, q, w) + np.zeros(3), np.array(MOMENTS), np)

    def call():
        return solve_ivp(field, (0.0, end), start, "DOP853", rtol=rtol, atol=rtol).y[:4, -1]

    return call


def _diffrax(torque, moments, wxyz, omega, ts, tight: bool):
    import diffrax
    import jax.numpy as jnp

    field = _rates(torque, jnp.asarray(moments), jnp)
    rtol = 1e-12 if tight else 1e-9
    y0 = jnp.concatenate([jnp.asarray(wxyz, float), jnp.asarray(omega, float)])
    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: field(t, y)),
        diffrax.Dopri8(),
        ts[0],
        ts[-1],
        None,
        y0,
        saveat=diffrax.SaveAt(ts=jnp.asarray(ts)),
        max_steps=2**20,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
    ).ys


TASKS: dict[str, tuple[Callable, Callable | None, str]] = {
    "free body and its period": (free_body, free_body_scipy, "SciPy"),
    "heavy top": (heavy_top, heavy_top_scipy, "SciPy"),
    "Lagrange's top and a gradient": (lagrange_gradient, lagrange_gradient_diffrax, "diffrax"),
    "satellite, 901 samples": (satellite, satellite_diffrax, "diffrax"),
    "satellite until an event": (event, event_scipy, "SciPy"),
    "2,000 satellites": (monte_carlo, None, ""),
    "flyby of 500": (flyby, None, ""),
    "filter, 100 steps": (filter_steps, None, ""),
    "pulses by gradient": (control, None, ""),
    "fit of a toss": (toss, None, ""),
    "HTML view": (view, None, ""),
}


def _child(name: str, which: str) -> dict:
    """Run one task in this process: seconds, result and memory."""
    import numpy as np

    ours, other, peer = TASKS[name]
    make = ours if which == "polhode" else other
    assert make is not None
    if which == "polhode" or peer == "diffrax":  # SciPy does not need JAX
        import jax

        jax.config.update("jax_enable_x64", True)
    call = make(tight=True) if which == "truth" else make()
    value = np.asarray(call())
    first = time.perf_counter() - BEGUN
    begin = time.perf_counter()
    np.asarray(call())
    second = time.perf_counter() - begin
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"first": first, "second": second, "memory": memory, "value": value.ravel().tolist()}


def _in_process(name: str, which: str, cache: str | None = None) -> dict:
    environment = dict(os.environ)
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
    command = [sys.executable, "-m", "benchmarks.cold_tasks", "--child", name, which]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise RuntimeError(f"{name}, {which}: {ran.stderr[-800:]}")
    return json.loads(ran.stdout.splitlines()[-1])


def apart(a: list[float], b: list[float]) -> float:
    """Relative distance of two results; the sign of a quaternion is ignored."""
    import numpy as np

    x, y = np.array(a), np.array(b)
    signs = (1, -1) if x.size == 4 else (1,)
    return float(min(np.linalg.norm(x - s * y) for s in signs) / max(np.linalg.norm(y), 1e-300))


def measured(names: list[str], repeats: int) -> list[dict]:
    """One row for each task and program: the minima over alternating runs."""
    _report.compile_package()
    rows = []
    for name in names:
        _, other, peer = TASKS[name]
        kinds = ["polhode"] if other is None else ["polhode", "peer"]
        runs: dict[str, list[dict]] = {kind: [] for kind in kinds}
        for _ in range(repeats):
            for kind in kinds:
                runs[kind].append(_in_process(name, kind))
        row: dict = {"task": name, "peer": peer}
        truth = None if other is None else _in_process(name, "truth")["value"]
        for kind, found in runs.items():
            best = {k: min(r[k] for r in found) for k in ("first", "second", "memory")}
            if truth is not None:
                best["error"] = apart(found[0]["value"], truth)
            row[kind] = best
        with tempfile.TemporaryDirectory() as cache:
            _in_process(name, "polhode", cache)
            row["polhode"]["cached"] = _in_process(name, "polhode", cache)["first"]
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def side_by_side(rows: list[dict]) -> list[dict]:
    """One row for each task with the results of polhode and of the other library."""
    found = []
    for row in rows:
        ours, other = row["polhode"], row["peer"] or {}
        found.append(
            {
                "task": row["task"],
                "other_library": TASKS[row["task"]][2] or None,
                "first_s": ours["first"],
                "other_first_s": other.get("first"),
                "second_s": ours["second"],
                "other_second_s": other.get("second"),
                "first_stored_s": ours["cached"],
                "memory_MB": ours["memory"],
                "other_memory_MB": other.get("memory"),
                "error": ours.get("error"),
                "other_error": other.get("error"),
            }
        )
    return found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--tasks", nargs="+", choices=[*TASKS], default=[*TASKS])
    parser.add_argument("--quick", action="store_true", help="one run of each")
    parser.add_argument("--output", type=Path, default=_report.OUT / "cold_tasks.json")
    args = parser.parse_args()
    _report.one_thread()
    if args.child:
        print(json.dumps(_child(*args.child)))
        return
    rows = measured(args.tasks, 1 if args.quick else 3)
    numbers = {"rows": rows, "side_by_side": side_by_side(rows)}
    _report.write("cold_tasks", numbers, path=args.output)


if __name__ == "__main__":
    main()
