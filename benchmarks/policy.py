"""Compare values of ``polhode._policy`` with alternatives, on the scenes that they affect.

    python -m benchmarks.policy NAME ... [--scenes WORD ...] [--rounds 7] [--output FILE]

Each value runs in its own process; the processes run alternately. Numbers are processor times of
one core, minima over the rounds, relative to the value in use: 1.5 means that the alternative takes
1.5 times as long. ``PLAIN`` is ``POLHODE_PLAIN=1``, which disables all CPU optimisations.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

BODIES = 1000
CLOSED = ("free body", "free bodies", "free bodies, 100 times", "Lagrange's tops")
STEPS = ("heavy top", "heavy tops", "satellite", "satellites", "clipped satellites")
GRADIENTS = (
    "gradient of free bodies",
    "gradient of Lagrange's tops",
    "gradient of a heavy top",
    "gradient of heavy tops",
    "gradient of a satellite",
)
ALL = (*CLOSED, *STEPS, *GRADIENTS)
FIELDS = (*STEPS, *GRADIENTS[2:])

# alternative values and scenes, for each name
CASES: dict[str, tuple[tuple[Any, ...], tuple[str, ...]]] = {
    "FUSION": ((False,), ALL),
    "FOLDING": ((False,), (*FIELDS, "cluster of wheels")),
    "STAGING": ((False,), ALL),
    "REFILLING": ((False,), ("heavy tops", "gradient of heavy tops")),
    "TIME_LOOP": ((False,), ("free bodies, 100 times",)),
    "KERNEL_BODIES": ((0, 64), ("heavy top", "ten heavy tops", "satellite", "clipped satellites")),
    "SINGLE_BODIES": ((0,), ("clipped satellites", "gradient of clipped satellites")),
    "KERNEL_BATCH": ((4, 64), ("tops under vmap", "free bodies under vmap", "Jacobian of a top")),
    "KERNEL_SUM": ((64,), ("gradient of heavy tops", "gradient of Lagrange's tops")),
    "KERNEL_TABLE": ((0,), ("heavy top", "heavy tops", "Lagrange's tops")),
    "KERNEL_PRODUCT": (
        (0, 32),
        ("matrix law", "gradient of a matrix law", "gradient of a network", "gradient of networks"),
    ),
    "KERNEL_INDEX": ((0, 4096), ("torque in a table", "gradient of a torque in a table")),
    "STAGE_WORK": ((2, 10**6), ("satellites", "gradient of heavy tops", "gradient of satellites")),
    "SUM_ROWS": ((1, 16), ("gradient of Lagrange's tops",)),
    "LANES": ((16, 32, 128, 256), ("heavy tops", "satellites")),
    "REFILL_LANES": ((1, 4, 16, 32), ("heavy tops",)),
    "QUEUE": ((128, 4096), ("heavy tops",)),
    "EXPLICIT_BODIES": ((0, 16), ("satellite", "ten satellites")),
    "LOW_ORDER_SWITCHES": ((0, 10**6), ("network", "clipped satellites")),
    "LOW_ORDER_RTOL": ((1e-12, 1.0), ("network",)),
    "SORTED_BODIES": ((10**9,), ("heavy tops", "satellites")),
    "SHARED_STEP_BODIES": ((20, 1000), ("heavy tops by diffrax",)),
    "ACCELERATOR_BODIES": ((2**14,), ("heavy tops",)),
    "STEP_OVERHEAD": ((0, 100), ("heavy tops", "heavy tops, 100 times")),
    "RECORD_SEGMENTS": ((32, 2048), ("gradient of a satellite",)),
    "RECORDED_ITERATIONS": ((0, 128), ("gradient of networks",)),
    "RECORDED_ITERATIONS_OF_FEW": ((0, 512), ("gradient of a satellite",)),
    "RECORDED_MEMORY": ((0,), ("gradient of networks",)),
    "MIN_RECORDED_ITERATIONS": ((1024,), ("gradient of networks",)),
    "COMPENSATED_STEPS": ((0, 10**9), ("heavy top", "heavy tops")),
    "COMPENSATED_PHASES": ((10**9,), ("free body", "free bodies")),
    "FREE_CHUNK": ((2**10, 2**40), ("free bodies", "gradient of 100,000 free bodies")),
    "FREE_LANES": ((64, 4096), ("free bodies, 100 times",)),
    "TIME_LOOP_BODIES": ((8, 10**4), ("free bodies, 100 times",)),
    "TOP_CHUNK": ((2**9, 2**12, 2**14), ("Lagrange's tops", "Lagrange's tops, 100 times")),
    "ELEMENTARY_CHUNK": ((2**11, 2**17), ("damped symmetric bodies, 100 times",)),
    "ACCELERATOR_SAMPLES": ((2**13, 2**20), ("free bodies", "Lagrange's tops")),
    "EVENT_SAMPLES": ((2, 2**16), ("first event of a body", "first events of bodies")),
    "BRIEF_FIT": ((0, 10**9), ("fits",)),
    "FIT_SAMPLES": ((128, 8192), ("fits",)),
    "SAVE_SAMPLES": ((2**15, 2**22), ("saved function of free bodies", "saved function of tops")),
    "ACCELERATOR_SAVE_SAMPLES": ((2**18,), ("saved function of tops",)),
}


def programs() -> dict[str, Callable[[], Callable[[], Any]]]:
    """For each scene, a function that compiles it and returns the call."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    jax.config.update("jax_enable_x64", True)

    import polhode as ph

    rng = np.random.default_rng(3)
    shapes = 1 + np.stack([rng.uniform(0, 0.3, BODIES), rng.uniform(0.4, 0.9, BODIES)], axis=1)
    moments = np.concatenate([np.ones((BODIES, 1)), shapes], axis=1)
    omega = rng.normal(size=(BODIES, 3))
    omega *= rng.uniform(1, 3, (BODIES, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    wxyz = rng.normal(size=(BODIES, 4))
    gravity = ph.UniformGravity(1.0, [0.0, 0.1, 0.3])
    axial = ph.UniformGravity.axial(1.0, 0.3)
    orbit = ph.KeplerOrbit(1.0, 2.0, 0.2)
    gradient, drag = ph.GravityGradient(0.0, orbit), ph.LinearDamping(0.01)

    def clipped(t, wxyz, omega):
        return jnp.clip(-0.2 * omega, -0.05, 0.05)

    weights = [jnp.asarray(rng.normal(size=shape) / 3) for shape in ((16, 7), (3, 16))]

    def network(t, wxyz, omega):
        hidden = jnp.maximum(weights[0] @ jnp.concatenate([wxyz, omega]), 0)
        return 0.1 * weights[1] @ hidden

    gain = jnp.asarray(0.2 * np.eye(3) + 0.05)

    def matrix_law(t, wxyz, omega):
        return -gain @ jnp.clip(omega, -0.5, 0.5)

    knots = np.linspace(0.0, 20.0, 100)
    table = ph.Table(knots, 0.1 * np.stack([np.sin(knots), np.cos(knots), knots / 20], axis=1), 1)

    frame, corners = ph.LVLH(orbit), [[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]

    def pointing(t, wxyz, omega):
        error, rate = frame.to_frame(wxyz, omega, t)
        return -0.2 * jnp.sign(error[0]) * error[1:] - 0.4 * rate

    def triaxial(potential=None, torque=None):
        return lambda m: ph.Scene(ph.Inertia.from_moments(m), potential, torque)

    def clustered(m):
        wheels = ph.wheel_cluster(corners, 1e-3, pointing, max_torque=0.05)
        return ph.Scene(ph.Inertia.from_moments(m), rotors=wheels)

    def symmetric(potential=None, torque=None):
        return lambda m: ph.Scene(ph.Inertia.axisymmetric(m[..., 0], m[..., 2]), potential, torque)

    def motion(build, n, times=2, seconds=20.0, method=None):
        ts = jnp.linspace(0.0, seconds, times)
        rows = np.arange(n) % BODIES if n > 1 else 0
        start = [jnp.asarray(x[rows]) for x in (moments, wxyz, omega)]

        def samples(m, q, w):
            found = ph.simulate(build(m), ph.State(q, w), ts, method)
            return found.wxyz[..., 1:, :], found.omega_body[..., 1:, :]

        return samples, start

    def value(*arguments, **options):
        def ready():
            samples, start = motion(*arguments, **options)
            program = jax.jit(samples).lower(*start).compile()
            return lambda: jax.block_until_ready(program(*start))

        return ready

    def first_event(n):
        def ready():
            m, q, w = (jnp.asarray(x[:n] if n > 1 else x[0]) for x in (moments, wxyz, omega))
            speed = jnp.max(jnp.abs(w[..., 0]))
            event = ph.Event(lambda wxyz, omega, t: omega[0] - speed * jnp.cos(0.05 * t))

            def stopped(m, q, w):
                scene, ts = triaxial()(m), jnp.array([0.0, 60.0])
                return ph.simulate(scene, ph.State(q, w), ts, until=event).event_time

            program = jax.jit(stopped).lower(m, q, w).compile()
            return lambda: jax.block_until_ready(program(m, q, w))

        return ready

    def saved(build):
        def ready():
            m, q, w = (jnp.asarray(np.tile(x, (4, 1))) for x in (moments, wxyz, omega))
            record = ph.Record(save=lambda motion: motion.omega_body[..., 2])

            def values(m, q, w):
                ts = jnp.linspace(0.0, 20.0, 401)
                return ph.simulate(build(m), ph.State(q, w), ts, record=record).saved

            program = jax.jit(values).lower(m, q, w).compile()
            return lambda: jax.block_until_ready(program(m, q, w))

        return ready

    def slope(*arguments, **options):
        def ready():
            samples, start = motion(*arguments, **options)

            def total(*start):
                wxyz, rates = samples(*start)
                return jnp.sum(wxyz**3) + jnp.sum(rates**2)

            program = jax.jit(jax.grad(total, argnums=(0, 2))).lower(*start).compile()
            return lambda: jax.block_until_ready(program(*start))

        return ready

    def mapped(build, n):
        """``jax.vmap`` of a simulation of one body."""

        def ready():
            ts, start = jnp.linspace(0.0, 20.0, 21), motion(build, n)[1]

            def one(m, q, w):
                return ph.simulate(build(m), ph.State(q, w), ts).wxyz

            program = jax.jit(jax.vmap(one)).lower(*start).compile()
            return lambda: jax.block_until_ready(program(*start))

        return ready

    def jacobian(build):
        """Forward mode with respect to 16 numbers: the initial state and a full inertia tensor."""

        def ready():
            m, q, w = motion(build, 1)[1]
            start = jnp.concatenate([q, w, jnp.diag(m).ravel()])

            def last(x):
                scene = build(m)
                scene = ph.Scene(ph.Inertia(full=x[7:].reshape(3, 3)), scene.potential)
                return ph.simulate(scene, ph.State(x[:4], x[4:7]), [0.0, 10.0]).wxyz[-1]

            program = jax.jit(jax.jacfwd(last)).lower(start).compile()
            return lambda: jax.block_until_ready(program(start))

        return ready

    def fits():
        times = np.linspace(0, 6, 150)
        _, start = motion(triaxial(), 20)
        scene = ph.Scene(ph.Inertia.from_moments(start[0]))
        rates = ph.simulate(scene, ph.State(*start[1:]), times).omega_body
        readings = np.asarray(rates) + rng.normal(scale=1e-4, size=rates.shape)
        return lambda: ph.fit_inertia(times, readings)

    satellite = triaxial(gradient, drag)
    controlled = triaxial(None, ph.FeedbackTorque(matrix_law))
    tabulated = triaxial(None, ph.BodyTorque(table) + drag)
    return {
        "free body": value(triaxial(), 1),
        "free bodies": value(triaxial(), BODIES),
        "free bodies, 100 times": value(triaxial(), BODIES, 101),
        "Lagrange's tops": value(symmetric(axial), BODIES),
        "Lagrange's tops, 100 times": value(symmetric(axial), BODIES, 101),
        "damped symmetric bodies, 100 times": value(symmetric(None, drag), BODIES, 101),
        "heavy top": value(triaxial(gravity), 1),
        "ten heavy tops": value(triaxial(gravity), 10),
        "heavy tops": value(triaxial(gravity), BODIES),
        "heavy tops, 100 times": value(triaxial(gravity), BODIES, 101),
        "heavy tops by diffrax": value(triaxial(gravity), BODIES, method=ph.LiePoisson()),
        "satellite": value(satellite, 1),
        "ten satellites": value(satellite, 10),
        "satellites": value(satellite, 200),
        "clipped satellites": value(triaxial(gradient, ph.FeedbackTorque(clipped)), 50),
        "tops under vmap": mapped(triaxial(gravity), 64),
        "free bodies under vmap": mapped(triaxial(), 64),
        "Jacobian of a top": jacobian(triaxial(gravity)),
        "matrix law": value(controlled, 1),
        "gradient of a matrix law": slope(controlled, 1),
        "torque in a table": value(tabulated, 1),
        "gradient of a torque in a table": slope(tabulated, 1),
        "cluster of wheels": value(clustered, 1),
        "network": value(triaxial(None, ph.FeedbackTorque(network)), 10),
        "gradient of a network": slope(triaxial(None, ph.FeedbackTorque(network)), 1),
        "gradient of networks": slope(triaxial(None, ph.FeedbackTorque(network)), 64),
        "gradient of free bodies": slope(triaxial(), BODIES),
        "gradient of 100,000 free bodies": slope(triaxial(), 100 * BODIES),
        "gradient of Lagrange's tops": slope(symmetric(axial), BODIES),
        "gradient of a heavy top": slope(triaxial(gravity), 1),
        "gradient of heavy tops": slope(triaxial(gravity), BODIES),
        "gradient of a satellite": slope(satellite, 1),
        "gradient of satellites": slope(satellite, 200),
        "gradient of clipped satellites": slope(triaxial(gradient, ph.FeedbackTorque(clipped)), 50),
        "saved function of free bodies": saved(triaxial()),
        "saved function of tops": saved(triaxial(gravity)),
        "first event of a body": first_event(1),
        "first events of bodies": first_event(BODIES),
        "fits": fits,
    }


def serve(name: str, value: Any, scenes: list[str]) -> None:
    """Compile the scenes with one value, then time each scene whose name is read from stdin."""
    from polhode import _policy

    if name != "PLAIN":
        assert hasattr(_policy, name)
        setattr(_policy, name, value)  # before any other module reads it
    ready, calls, compiled = programs(), {}, {}
    for scene in scenes:
        start = time.process_time()
        calls[scene] = ready[scene]()
        calls[scene]()
        compiled[scene] = time.process_time() - start
    print(json.dumps(compiled), flush=True)
    for line in sys.stdin:
        call, count = calls[line.strip()], 0
        start = time.process_time()
        while time.process_time() - start < 0.1:
            call()
            count += 1
        print((time.process_time() - start) / count, flush=True)


def compare(name: str, rounds: int, words: list[str]) -> list[dict[str, Any]]:
    """One row for each scene and alternative value."""
    others, scenes = ((True,), ALL) if name == "PLAIN" else CASES[name]
    scenes = [s for s in scenes if not words or any(word in s for word in words)]
    values = [None, *others]
    servers = []
    for value in values:
        environment = dict(os.environ)
        environment.pop("POLHODE_PLAIN", None)
        own = name
        if value is None:
            own = "PLAIN"  # the value in use: the server sets nothing
        elif name == "PLAIN":
            environment["POLHODE_PLAIN"] = "1"
        command = [sys.executable, "-m", "benchmarks.policy", own, "--serve", json.dumps(value)]
        servers.append(
            subprocess.Popen(
                [*command, "--scenes", *scenes],
                env=environment,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
        )
    compiled = [json.loads(server.stdout.readline()) for server in servers]
    times = {scene: [float("inf")] * len(values) for scene in scenes}
    for _ in range(rounds):
        for scene, least in times.items():
            for k, server in enumerate(servers):
                server.stdin.write(scene + "\n")
                server.stdin.flush()
                least[k] = min(least[k], float(server.stdout.readline()))
    for server in servers:
        server.stdin.close()
        server.wait()
    return [
        {
            "name": name,
            "value": value,
            "scene": scene,
            "ms": 1e3 * least[0],
            "ratio": least[k] / least[0],
            "compile_ratio": compiled[k][scene] / compiled[0][scene],
        }
        for scene, least in times.items()
        for k, value in enumerate(values)
        if k
    ]


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="+", choices=[*CASES, "PLAIN"])
    parser.add_argument("--scenes", nargs="*", default=[], help="words of the names of scenes")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    if options.serve is not None:
        serve(options.names[0], json.loads(options.serve), options.scenes)
        return
    rows = []
    print(f"{'name':<20}{'value':>9}  {'scene':<36}{'ms':>10}{'ratio':>8}{'compile':>9}")
    for name in options.names:
        for row in compare(name, options.rounds, options.scenes):
            rows.append(row)
            print(
                f"{row['name']:<20}{row['value']!s:>9}  {row['scene']:<36}{row['ms']:>10.3g}"
                f"{row['ratio']:>8.2f}{row['compile_ratio']:>9.2f}",
                flush=True,
            )
    if options.output is not None:
        _report.write("policy", {"rows": rows}, path=options.output)


if __name__ == "__main__":
    main()
