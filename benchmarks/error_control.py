"""Whether errors stay below ``rtol``: random scenes over six decades against 80-bit references.

python -m benchmarks.error_control [--bodies 150] [--quick] [--constants] [--output FILE]

There are two tables. The first compares the estimate of a single step's error
(``_integrate/_midpoint.py``) with the true error, for several orders and step sizes. The second
contains the attitude error at the last time divided by the requested ``rtol``, for bodies whose
moments, rates, fields and torques are drawn over six decades: ratios of torque to kinetic energy
from 1e-6 to 1e3, rotations by 1 to 1,000 radians. ``--constants [NAME ...]`` prints only a third
table: steps, time and errors for some of these and other bodies when one constant of
``_integrate/_error_control.py`` is set to the value at which it has no effect.

Reference: Gragg's extrapolation of order 20 in 80-bit arithmetic, written in NumPy from Newton's
law, with two step sizes whose results must agree. ``spread``: growth of a small change of the
momentum relative to growth in proportion to the rotation angle; bodies above 100 are treated as
chaotic and excluded.
"""

import argparse
import time
from fractions import Fraction
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from polhode._integrate import LiePoissonChart
from polhode._integrate._columns import extrapolated, table
from polhode._integrate._field import BoundTerm

LONG = np.longdouble
SEQUENCE = (2, 4, 6, 8, 10, 12, 14, 16, 24, 36)
FAMILIES = {
    "uniform gravity": ("gravity",),
    "gravity gradient": ("gradient",),
    "gravity and gradient": ("gravity", "gradient"),
    "torque fixed in the body": ("body",),
    "torque fixed in space": ("space",),
    "gravity, damped": ("gravity", "damping"),
}
RTOLS = (1e-3, 1e-6, 1e-9, 1e-12)


def weights() -> list:
    """Weights of the extrapolation columns, in long double."""
    found = []
    for j, n in enumerate(SEQUENCE):
        weight = Fraction(1)
        for i, m in enumerate(SEQUENCE):
            weight *= Fraction(n * n, n * n - m * m) if i != j else 1
        found.append(LONG(weight.numerator) / LONG(weight.denominator))
    return found


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def rates(p: dict, y):
    """dL/dt and dq/dt of several bodies, from Newton's law."""
    momentum, (w, x, z, v) = y[:3], y[3:]  # quaternion w + x i + z j + v k
    omega = [momentum[i] / p["moments"][i] for i in range(3)]
    rows = [
        [1 - 2 * (z * z + v * v), 2 * (x * z - w * v), 2 * (x * v + w * z)],
        [2 * (x * z + w * v), 1 - 2 * (x * x + v * v), 2 * (z * v - w * x)],
        [2 * (x * v - w * z), 2 * (z * v + w * x), 1 - 2 * (x * x + z * z)],
    ]

    def in_body(u):
        return [sum(rows[j][i] * u[j] for j in range(3)) for i in range(3)]

    push = cross(momentum, omega)
    if "gravity" in p:
        push = [a + b for a, b in zip(push, cross(p["centre"], in_body(p["gravity"])))]
    if "gradient" in p:
        n = in_body(p["gradient"])
        turn = cross(n, [p["moments"][i] * n[i] for i in range(3)])
        push = [a + p["strength"] * b for a, b in zip(push, turn)]
    if "body" in p:
        push = [a + b for a, b in zip(push, p["body"])]
    if "space" in p:
        push = [a + b for a, b in zip(push, in_body(p["space"]))]
    if "damping" in p:
        push = [a - p["damping"] * b for a, b in zip(push, omega)]
    a, b, c = (o / 2 for o in omega)
    turning = [
        -x * a - z * b - v * c,
        w * a + z * c - v * b,
        w * b + v * a - x * c,
        w * c + x * b - z * a,
    ]
    return np.stack([*push, *turning])


def truth(p: dict, width: float, nudge=0.0):
    """Final states (7, N), integrated in steps of about ``width`` radians."""
    p = {k: np.asarray(x, LONG) if k != "name" else x for k, x in p.items()}
    y = np.concatenate([p["moments"] * p["omega"] * (1 + LONG(nudge)), p["wxyz"]])
    y[3:] /= np.sqrt((y[3:] ** 2).sum(0))
    steps = np.maximum(2, np.ceil(p["angle"].astype(float) / width)).astype(int)
    order = np.argsort(-steps)  # the longest first: finished bodies are dropped from the end
    p = {k: x[..., order] for k, x in p.items() if k != "name"}
    y, steps = y[:, order], steps[order]
    h, columns = p["span"] / steps, weights()
    for k in range(steps[0]):
        n = int(np.searchsorted(-steps, -k, side="left"))
        q, now, step = {a: x[..., :n] for a, x in p.items()}, y[:, :n], h[:n]
        first, ends = rates(q, now), []
        for m in SEQUENCE:
            a, b = now, now + step / m * first
            for _ in range(m - 1):
                a, b = b, a + 2 * step / m * rates(q, b)
            ends.append(b)
        new = ends[-1] + sum(w * (e - ends[-1]) for w, e in zip(columns, ends[:-1]))
        new[3:] /= np.sqrt((new[3:] ** 2).sum(0))
        y[:, :n] = new
    back = np.empty_like(order)
    back[order] = np.arange(order.size)
    return y[:, back]


def angle(p, q) -> np.ndarray:
    """Angles [rad] between attitudes (4, N)."""
    sign = np.where((p * q).sum(0) < 0, -1, 1)
    gap = np.sqrt(((p - sign * q) ** 2).sum(0)).astype(float)
    return 4 * np.arcsin(np.minimum(1, gap / 2))


def draw(name: str, count: int, seed: int, longest: float) -> dict:
    """Random bodies of a family; all quantities are drawn over six decades."""
    rng = np.random.default_rng(seed)

    def decades(low, high, size=count):
        return 10.0 ** rng.uniform(low, high, size)

    def directions(size=3):
        v = rng.normal(size=(size, count))
        return v / np.linalg.norm(v, axis=0)

    masses = decades(-1.5, 0, (3, count))  # point masses on the axes, for possible moments
    moments = (masses.sum(0) - masses) * decades(-3, 3)
    rate = decades(-3, 3)
    omega = directions() * rate
    energy = 0.5 * (moments * omega**2).sum(0)
    strength = decades(-6, 3) * energy
    p = {"name": name, "moments": moments, "omega": omega, "wxyz": directions(4)}
    square = rate**2
    for part in FAMILIES[name]:
        if part == "gravity":
            length = decades(-2, 0)
            p["centre"], p["gravity"] = directions() * length, directions() * strength / length
        if part == "gradient":
            p["gradient"], p["strength"] = directions(), strength / moments.max(0)
        if part in ("body", "space"):
            p[part] = directions() * strength
        if part == "damping":
            p["damping"] = moments.min(0) * rate * decades(-4, -1)
        else:
            square = square + strength / moments.min(0)
    p["angle"] = 10.0 ** rng.uniform(0, np.log10(longest), count)
    return p | {"span": p["angle"] / np.sqrt(square)}


def scene_and_state(p: dict) -> tuple[ph.Scene, ph.State, np.ndarray]:
    potentials, torques = [], []
    if "gravity" in p:
        potentials.append(ph.UniformGravity(1.0, p["centre"].T, p["gravity"].T))
    if "gradient" in p:
        potentials.append(ph.GravityGradient(p["strength"] / 3, p["gradient"].T))
    if "body" in p:
        torques.append(ph.BodyTorque(p["body"].T))
    if "space" in p:
        torques.append(ph.SpaceTorque(p["space"].T))
    if "damping" in p:
        torques.append(ph.LinearDamping(np.stack([p["damping"]] * 3, -1)))
    potential = sum(potentials[1:], start=potentials[0]) if potentials else None
    torque = sum(torques[1:], start=torques[0]) if torques else None
    scene = ph.Scene(ph.Inertia.from_moments(p["moments"].T), potential, torque)
    ts = np.stack([np.zeros_like(p["span"]), p["span"]], -1)
    return scene, ph.State(p["wxyz"].T, p["omega"].T), ts


def kept(count: int, seed: int, longest: float) -> list[dict]:
    """Rows of the second table."""
    rows = []
    for k, name in enumerate(FAMILIES):
        p = draw(name, count, seed + k, longest)
        best, check, moved = truth(p, 0.6), truth(p, 0.7), truth(p, 0.7, 1e-10)
        spread = angle(check[3:], moved[3:]) / 1e-10 / np.maximum(1, p["angle"])
        trusted = angle(best[3:], check[3:]) < 1e-13
        calm = (spread < 100) & trusted
        scene, state, ts = scene_and_state(p)
        for rtol in RTOLS:
            record = ph.Record(final_only=True, error=True)
            found = ph.simulate(scene, state, ts, rtol=rtol, record=record, throw=False)
            error = angle(np.asarray(found.wxyz[:, 0]).T, best[3:]) / rtol
            status, estimate = np.asarray(found.status), np.asarray(found.error) / rtol / error
            here = error[calm]
            rows.append(
                {
                    "family": name,
                    "rtol": rtol,
                    "bodies": int(calm.sum()),
                    "left_out": int((~calm).sum()),
                    "median": float(np.median(here)),
                    "q95": float(np.quantile(here, 0.95)),
                    "worst": float(here.max()),
                    "beyond_10": int((here > 10).sum()),
                    "spread_of_worst": float(spread[calm][np.argmax(here)]),
                    "unsuccessful": int(((status != 0) & (status != 5))[calm].sum()),
                    "estimate_within_10": float(np.mean(np.abs(np.log10(estimate[calm])) < 1)),
                    "false_alarms": int(((status == 5) & (error <= 10) & calm).sum()),
                    "missed": int(((status == 0) & (error > 10) & calm).sum()),
                    "steps": float(np.mean(np.asarray(found.steps)[calm])),
                }
            )
            print(rows[-1], flush=True)
    return rows


def calibrated(count: int, seed: int) -> list[dict]:
    """Rows of the first table: true error of one step over ``e^2 / d`` and over ``e``."""
    rows = []
    for name in ("uniform gravity", "gravity gradient"):
        p = draw(name, count, seed, 1.0)
        scene, state, ts = scene_and_state(p)
        chart = LiePoissonChart()
        dynamics = chart.dynamics(scene, state, jnp.asarray(ts[:, 0]))
        y, _ = chart.start(scene, state, jnp.zeros(()))
        leaves, zero = jax.tree.leaves(y), jnp.zeros(())
        problem = BoundTerm.of(diffrax.ODETerm(chart.field), dynamics).prepare(zero, y, jnp.float64)

        def field(t, y, along, problem=problem):
            return problem.rates(problem.coefficients, t, y), []

        @jax.jit
        def step(y, width, given, field=field, zero=zero):
            return extrapolated(field, given, zero, width, y, field(zero, y, False)[0], [])

        first, _ = field(zero, leaves, False)
        measure, rate = dynamics.units(leaves, first)

        def size(error, measure=measure):
            return np.sqrt(sum(np.asarray(w * e) ** 2 for w, e in zip(measure, error)))

        for order in (8, 12, 16):
            for wide in (0.3, 0.6, 1.0, 1.5, 2.2):
                found = step(leaves, wide / rate, table(order, jnp.float64))
                fine = leaves
                for _ in range(8):
                    fine = step(fine, wide / rate / 8, table(20, jnp.float64)).change
                true = size([a - b for a, b in zip(found.change, fine)])
                last, before = size(found.difference), size(found.lower_difference)
                seen = (true > 1e-13) & (true < 0.1)  # above rounding, and converging
                if seen.sum() < count // 20:
                    continue
                ratio = (true / (last * np.minimum(1, last / before)))[seen]
                quantiles = [float(x) for x in np.quantile(ratio, (0.05, 0.5, 0.95))]
                rows.append(
                    {
                        "family": name,
                        "order": order,
                        "radians": wide,
                        "bodies": int(seen.sum()),
                        "true_over_estimate": quantiles,
                        "true_over_difference": float(np.median((true / last)[seen])),
                    }
                )
                print(rows[-1], flush=True)
    return rows


NEUTRAL = {
    "SAFETY": 1.0,
    "MEMORY": 0.0,
    "DRIFT_ANGLE": 1e30,
    "ROUNDED_STEP": 0.0,
    "MIN_FACTOR": 1e-3,
    "MAX_FACTOR": 1e3,
    "MIN_RATIO": 1e-30,
    "FIRST_WIDTH": 1.0,
    "CUT": 0.0,
    "CALIBRATION": 1.0,
    "MIDPOINT_SHARE": 1.0,
    "FIRST_SHARE": 1.0,
    "COMPENSATED_STEP": 0.0,
    "SHORT_STEP": 0.0,
    "GRAIN": 0.0,
    "JUMP_RATIO": 1e30,
    "JUMP_NOISE": 0.0,
    "ROUGH_FALL": 1e30,
    "ROUGH_ROUNDING": 0.0,
    "ROUGH_ERROR": 1.0,
    "EXPLICIT_SHARE": 1.0,
    "SIXTH_DIFFERENCE": 0.0,
    "UNDEFINED_SIDE": 1.0,
}
"""The value at which each constant of the error control does nothing; those that only set a status
have none."""


def hidden_jump(t, wxyz, omega_body):
    """A torque that jumps every 3.5 s inside a loop, so that no step ends at the jump."""
    on = jax.lax.while_loop(lambda c: (t % 7 > 3.5) & (c == 0), lambda c: c + 1.0, 0.0 * t)
    return 0.02 * on * jnp.ones_like(omega_body)


def clipped(t, wxyz, omega_body):
    """A torque with six kinks and a jump."""
    return jnp.clip(-0.05 * omega_body, -0.02, 0.02) + jnp.where(wxyz[..., 1:2] > 0, 0.01, 0.0)


def rooted(t, wxyz, omega_body):
    """A torque that is undefined beyond its switch."""
    x = wxyz[..., 1:2]
    return 0.02 * jnp.where(x > 0, jnp.sqrt(x), 0.0) * jnp.ones_like(omega_body)


def span_of(p: dict, angle: float) -> dict:
    """The same bodies, simulated until each has rotated by about ``angle`` [rad]."""
    return p | {"angle": np.full_like(p["angle"], angle), "span": p["span"] * angle / p["angle"]}


def scenes_of_constants(count: int) -> dict[str, tuple]:
    """Scene, state and times by name."""
    found = {}
    for k, name in enumerate(("uniform gravity", "gravity gradient", "gravity, damped")):
        p = draw(name, count, 11 + k, 300.0)
        found[name] = scene_and_state(p)
        if name == "uniform gravity":
            scene, state, ts = found[name]
            even = np.linspace(0, 1, 101)
            pairs = np.sort(np.concatenate([even[::4], even[4::4] - 1e-3]))
            for label, parts in (("101 times", even), ("times in pairs", pairs)):
                between = ts[:, :1] + (ts[:, 1:] - ts[:, :1]) * parts
                found[f"{name}, {label}"] = scene, state, between
            found["a radian"] = scene_and_state(span_of(p, 1.0))
        if name == "gravity, damped":
            p["damping"] = 30 * p["damping"]
            found["strongly damped"] = scene_and_state(span_of(p, 300.0))
    rng = np.random.default_rng(4)
    state = ph.State(rng.normal(size=(count, 4)), rng.normal(size=(count, 3)))
    body = ph.Inertia.from_moments([1.0, 1.6, 2.1])
    field = ph.GravityGradient(1e-3, [0.0, 0.0, 1.0])
    found["3,000 radians"] = ph.Scene(body, field), state, np.array([0.0, 3000.0])
    for law in (clipped, rooted, hidden_jump):
        scene = ph.Scene(body, torque=ph.FeedbackTorque(law))
        found[law.__name__] = scene, state, np.array([0.0, 60.0])
    return found


def without(count: int, names: list[str]) -> list[dict]:
    """Rows of the third table: sums over the bodies and over three tolerances. ``steps`` includes
    rejected steps.
    """
    from polhode._integrate import _error_control as control

    scenes = scenes_of_constants(count)
    rtols = (1e-4, 1e-7, 1e-10)

    def run(scene, state, ts, rtol):
        record = ph.Record(final_only=ts.shape[-1] == 2)
        t = ph.simulate(scene, state, ts, rtol=rtol, record=record, throw=False)
        return t.wxyz[:, -1], t.step_counts.accepted + t.step_counts.refused, t.status

    best = {k: run(*x, 3e-13)[0] for k, x in scenes.items()}
    moved = {k: run(*x, 1e-12)[0] for k, x in scenes.items()}
    rows: list[dict] = []
    for constant in ["", *(names or NEUTRAL)]:
        value = NEUTRAL.get(constant, 0.0)
        before = getattr(control, constant, None)
        if constant:
            setattr(control, constant, value)
        jax.clear_caches()
        for name, (scene, state, ts) in scenes.items():
            program = jax.jit(
                lambda rtol, scene=scene, state=state, ts=ts: run(scene, state, ts, rtol)
            )
            jax.block_until_ready(program(1e-4))
            ratios, steps, failed, seconds = [], 0, 0, 0.0
            gap = angle(np.asarray(best[name]).T, np.asarray(moved[name]).T)
            for rtol in rtols:
                begin = time.process_time()
                wxyz, taken, status = jax.block_until_ready(program(rtol))
                seconds += time.process_time() - begin
                good = (gap < 0.1 * rtol) & (np.asarray(status) == 0)
                error = angle(np.asarray(wxyz).T, np.asarray(best[name]).T) / rtol
                ratios += error[good].tolist()
                steps, failed = (
                    steps + int(np.sum(taken)),
                    failed + int(np.sum(np.asarray(status) != 0)),
                )
            row = {
                "constant": constant,
                "value": value,
                "scene": name,
                "steps": steps,
                "failed": failed,
                "seconds": seconds,
                "median": float(np.median(ratios)) if ratios else None,
                "q95": float(np.quantile(ratios, 0.95)) if ratios else None,
                "beyond_10": int(np.sum(np.array(ratios) > 10)),
            }
            base = next((r for r in rows if not r["constant"] and r["scene"] == name), row)
            rows.append(
                row
                | {"steps_ratio": steps / base["steps"], "time_ratio": seconds / base["seconds"]}
            )
            print(rows[-1], flush=True)
        if constant:
            setattr(control, constant, before)
    return rows


def summary(rows: list[dict]) -> list[dict]:
    """One row for each constant, over all motions."""
    base = {row["scene"]: row for row in rows if not row["constant"]}
    found = []
    for name in dict.fromkeys(row["constant"] for row in rows if row["constant"]):
        own = [row for row in rows if row["constant"] == name]
        ended = [row for row in own if row["q95"] is not None]
        most = max(ended, key=lambda row: row["steps_ratio"])
        # errors below a tenth of rtol count as a tenth: their ratio would be meaningless
        errors = [row["q95"] / max(0.1, base[row["scene"]]["q95"]) for row in ended]
        found.append(
            {
                "constant": name,
                "without": own[0]["value"],
                "least_steps": min(row["steps_ratio"] for row in ended),
                "most_steps": most["steps_ratio"],
                "most_in": most["scene"].replace("_", " "),
                "error": max(errors),
                "beyond_10": sum(
                    row["beyond_10"] - base[row["scene"]]["beyond_10"] for row in ended
                ),
                "failed": sum(row["failed"] - base[row["scene"]]["failed"] for row in own),
            }
        )
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, default=150, help="of each family")
    parser.add_argument("--quick", action="store_true", help="20 bodies, 30 radians")
    parser.add_argument("--constants", nargs="*", help="the third table only; of all, or of these")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    count, longest = (20, 30.0) if given.quick else (given.bodies, 1000.0)
    if given.constants is not None:
        found = {"constants": summary(without(40, given.constants))}
        name = "error_control_constants"
        _report.write(name, found, path=given.output, module="error_control")
        return
    found = {"steps": calibrated(10 * count, 3), "kept": kept(count, 11, longest)}
    _report.write("error_control", found, path=given.output)


if __name__ == "__main__":
    main()
