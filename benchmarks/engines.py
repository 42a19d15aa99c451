"""Physics engines against the exact motion of tumbling bodies: attitude, energy, momentum.

    python -m benchmarks.engines [--quick] [--output out/benchmarks/engines.json]

Each engine that is installed simulates a free body: MuJoCo with three integrators, and Bullet.
Damping, gravity, contacts and resets are disabled. The step is MuJoCo's default, 2 ms, which is 314
steps per revolution at 10 rad/s. Attitude errors are angles to polhode's closed form, which a test
compares with the data of ``polhode reference``; errors of the energy and of the angular momentum in
space are relative to the initial values. The last row is a body without the gyroscopic term, whose
angular velocity in space is constant.
"""

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import polhode as ph

STEP = 0.002
BODIES = {"t_handle": 1.0, "short_axis": 8.0, "long_axis": 8.0}
"""Bodies of the reference data, and a factor to their rates, so that each turns at about 10
rad/s."""


def bodies() -> list[dict]:
    """Bodies of the reference data, with rates that fit the time step."""
    found = []
    for body in ph.files.reference_motions()["bodies"]:
        if body["name"] in BODIES:
            omega = BODIES[body["name"]] * np.array(body["omega_body"])
            wxyz = np.array(body["wxyz"]) / np.linalg.norm(body["wxyz"])
            moments = np.array(body["moments"])
            found.append({"name": body["name"], "moments": moments, "wxyz": wxyz, "omega": omega})
    return found


Run = Callable[[dict, list[int]], tuple[np.ndarray, np.ndarray]]
"""From a body and numbers of steps to attitudes (n, 4) and body rates (n, 3) after them."""


def mujoco_run(integrator: str) -> Run:
    import mujoco

    # MuJoCo warns of motions that diverge; they become NaN below
    mujoco.set_mju_user_warning(lambda text: None)

    def run(body: dict, saves: list[int]) -> tuple[np.ndarray, np.ndarray]:
        moments = " ".join(map(repr, map(float, body["moments"])))
        model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <compiler balanceinertia="false"/>
          <option timestep="{STEP}" integrator="{integrator}" gravity="0 0 0">
            <flag contact="disable" constraint="disable" autoreset="disable"/>
          </option>
          <worldbody>
            <body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="{moments}"/></body>
          </worldbody>
        </mujoco>""")
        data = mujoco.MjData(model)
        data.qpos[3:7], data.qvel[3:6] = body["wxyz"], body["omega"]
        q, w = np.empty((len(saves), 4)), np.empty((len(saves), 3))
        done = 0
        for k, steps in enumerate(saves):
            mujoco.mj_step(model, data, nstep=steps - done)
            q[k], w[k], done = data.qpos[3:7], data.qvel[3:6], steps
        return q, w

    return run


def bullet_run(body: dict, saves: list[int]) -> tuple[np.ndarray, np.ndarray]:
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    x, y, z = body["wxyz"][1:]
    one = pybullet.createMultiBody(
        baseMass=1.0, baseOrientation=[x, y, z, body["wxyz"][0]], physicsClientId=client
    )
    pybullet.changeDynamics(
        one,
        -1,
        localInertiaDiagonal=list(body["moments"]),
        linearDamping=0.0,
        angularDamping=0.0,
        maxJointVelocity=1e6,
        physicsClientId=client,
    )
    pybullet.setTimeStep(STEP, physicsClientId=client)
    spin = matrix(body["wxyz"]) @ body["omega"]
    pybullet.resetBaseVelocity(one, [0, 0, 0], list(spin), physicsClientId=client)
    q, w, done = np.empty((len(saves), 4)), np.empty((len(saves), 3)), 0
    for k, steps in enumerate(saves):
        for _ in range(steps - done):
            pybullet.stepSimulation(physicsClientId=client)
        done = steps
        x, y, z, s = pybullet.getBasePositionAndOrientation(one, physicsClientId=client)[1]
        q[k] = s, x, y, z
        w[k] = matrix(q[k]).T @ pybullet.getBaseVelocity(one, physicsClientId=client)[1]
    pybullet.disconnect(client)
    return q, w


def without_gyroscopic_term(body: dict, saves: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Semi-implicit Euler steps with the angular velocity in space held constant."""
    spin = matrix(body["wxyz"]) @ body["omega"]
    rate = float(np.linalg.norm(spin))
    q, w = np.empty((len(saves), 4)), np.empty((len(saves), 3))
    for k, steps in enumerate(saves):
        half = rate * STEP * steps / 2
        turn = np.array([np.cos(half), *(np.sin(half) * spin / rate)])
        q[k] = ph.rotation.multiply(turn, body["wxyz"])
        w[k] = matrix(q[k]).T @ spin
    return q, w


def engines() -> dict[str, tuple[str, Run]]:
    """Name -> package and function to run, for each installed engine."""
    found: dict[str, tuple[str, Run]] = {}
    if importlib.util.find_spec("mujoco"):
        for integrator in ("Euler", "implicitfast", "RK4"):
            found[f"MuJoCo {integrator}"] = "mujoco", mujoco_run(integrator)
    if importlib.util.find_spec("pybullet"):
        found["Bullet"] = "pybullet", bullet_run
    found["no gyroscopic term"] = "", without_gyroscopic_term
    return found


def matrix(wxyz: np.ndarray) -> np.ndarray:
    """Rotation matrix, body -> space."""
    return Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()


def exact(body: dict, saves: list[int]) -> np.ndarray:
    """Attitudes (n, 4) by the closed form."""
    scene = ph.Scene(ph.Inertia.from_moments(body["moments"]))
    times = np.array([0.0, *(STEP * k for k in saves)])
    return np.asarray(ph.simulate(scene, ph.State(body["wxyz"], body["omega"]), times).wxyz[1:])


def score(body: dict, saves: list[int], truth: np.ndarray, q: np.ndarray, w: np.ndarray) -> dict:
    """Errors at the saved times: angle [rad]; energy and momentum relative to the initial ones."""
    size = np.linalg.norm(q, axis=1, keepdims=True)
    # |q - p| is accurate for small angles
    near = np.minimum(
        np.linalg.norm(q / size - truth, axis=1), np.linalg.norm(q / size + truth, axis=1)
    )
    energy = np.sum(body["moments"] * w**2, axis=1)
    first = np.sum(body["moments"] * body["omega"] ** 2)
    momentum = np.array([matrix(a) @ (body["moments"] * b) for a, b in zip(q, w)])
    start = matrix(body["wxyz"]) @ (body["moments"] * body["omega"])
    turns = STEP * np.array(saves) * np.linalg.norm(body["omega"]) / (2 * np.pi)
    return {
        "body": body["name"],
        "turns": turns.tolist(),
        "attitude": (4 * np.arcsin(np.clip(near / 2, 0, 1))).tolist(),
        "energy": (energy / first - 1).tolist(),
        "momentum": (np.linalg.norm(momentum - start, axis=1) / np.linalg.norm(start)).tolist(),
    }


def measure(turns: float, count: int = 25) -> list[dict]:
    """Every engine on every body, at ``count`` times up to a number of revolutions."""
    rows = []
    for body in bodies():
        steps = 2 * np.pi / (np.linalg.norm(body["omega"]) * STEP)
        grid = np.geomspace(0.25, turns, count)
        saves = sorted({max(1, round(x * steps)) for x in grid.tolist()})
        truth = exact(body, saves)
        for name, (_, run) in engines().items():
            began = time.process_time()
            q, w = run(body, saves)
            spent = time.process_time() - began
            row = {"engine": name, "us_per_step": 1e6 * spent / saves[-1]}
            rows.append(row | score(body, saves, truth, q, w))
    return rows


def after_turns(rows: list[dict]) -> list[dict]:
    """Attitude errors [rad] and relative changes of the energy after 1 to 1,000 revolutions, at the
    nearest saved times.
    """
    found = []
    for row in rows:
        at = {
            turns: int(np.argmin(np.abs(np.log(np.array(row["turns"]) / turns))))
            for turns in (1, 10, 100, 1000)
            if turns < 1.1 * row["turns"][-1]
        }
        found.append(
            {"body": row["body"], "engine": row["engine"]}
            | {f"rad_after_{turns}": row["attitude"][k] for turns, k in at.items()}
            | {f"energy_after_{turns}": row["energy"][k] for turns, k in at.items()}
            | {"us_per_step": row["us_per_step"]}
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="to 10 revolutions")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = measure(10.0 if options.quick else 1000.0)
    for row in rows:
        print(
            f"{row['body']:12}{row['engine']:20}{row['turns'][-1]:>7.0f} turns:"
            f" {row['attitude'][-1]:.1e} rad,"
            f" energy {row['energy'][-1]:+.1e}, momentum {row['momentum'][-1]:.1e},"
            f" {row['us_per_step']:.2g} us a step"
        )
    packages = tuple({package for package, _ in engines().values() if package})
    numbers = {"step": STEP, "rows": rows, "after_turns": after_turns(rows)}
    path = _report.write("engines", numbers, path=options.output, packages=packages)
    print(path)


if __name__ == "__main__":
    main()
