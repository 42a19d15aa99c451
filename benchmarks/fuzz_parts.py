"""The public parts of a scene, each with random numbers and an independent implementation.

A ``Part`` draws its numbers (``draw``), builds polhode's objects from them (``build``), and
implements its torque, wheels and switches in plain Python from the public docstrings (``torque``,
``wheels``, ``margins``). The equations call nothing of polhode.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks._formulas import multiply
from benchmarks.fuzz_truth import (
    anomaly,
    cross,
    dot,
    matrix,
    norm,
    scaled,
    to_body,
    total,
)

ZERO = (0.0, 0.0, 0.0)


class Scale:
    """Sizes from which a scene is drawn: principal moments [kg m^2], rate [rad/s], angle [rad]."""

    def __init__(self, rng: np.random.Generator, rate: float | None, longest: float):
        self.rng = rng
        masses = 10.0 ** rng.uniform(-1.5, 0, 3)
        self.moments = (masses.sum() - masses) * 10.0 ** rng.uniform(-3, 9)
        self.rate = 10.0 ** rng.uniform(-4, 2) if rate is None else rate
        self.angle = 10.0 ** rng.uniform(0, np.log10(longest))
        self.start = 0.0
        self.unit = float(np.mean(self.moments)) * self.rate**2
        self.size = 0.0  # sum of the torques that oscillate with the motion [N m]
        self.steady = 0.0  # sum of the other torques [N m]

    def decades(self, low: float, high: float) -> float:
        return float(10.0 ** self.rng.uniform(low, high))

    def direction(self, n: int = 3) -> np.ndarray:
        v = self.rng.normal(size=n)
        return v / np.linalg.norm(v)

    def torque(self, low: float = -4, high: float = 1, steady: bool = False) -> float:
        """Draw the size of a torque [N m]; a larger torque shortens the simulated time."""
        found = self.unit * self.decades(low, high)
        if steady:
            self.steady += found
        else:
            self.size += found
        return found

    @property
    def span(self) -> float:
        """Time [s] in which the body rotates by about ``angle``."""
        least = float(np.min(self.moments))
        fast = math.sqrt(self.rate**2 + self.size / least)
        push = self.steady / least
        if push == 0:
            return self.angle / fast
        return (math.sqrt(fast**2 + 2 * push * self.angle) - fast) / push

    def damping(self, low: float = -4, high: float = -0.5) -> float:
        return float(np.min(self.moments)) * self.rate * self.decades(low, high)

    def orbit(self, kind: str, low: float = -2, high: float = 0.0) -> dict[str, Any]:
        """Draw the elements of an orbit whose mean motion is within decades of the rate."""
        n = self.rate * self.decades(low, high)
        a = self.decades(3, 9)
        found: dict[str, Any] = {"mu": n * n * a**3, "a": a}
        if kind == "ellipse":
            found["e"] = self.rng.uniform(0.01, 0.9)
        if kind == "hyperbola":
            found |= {"e": self.rng.uniform(1.1, 3.0), "a": -a}
        for name in ("inclination", "node", "periapsis", "mean_anomaly"):
            found[name] = self.rng.uniform(0, 3)
        if kind == "hyperbola":
            found["mean_anomaly"] = self.rng.uniform(-3, 0)
        found["epoch"] = self.start + self.rng.uniform(-1, 1) / n
        self.size += float(np.max(self.moments)) * n * n * (10 if kind == "ellipse" else 1)
        return found


class Moment(NamedTuple):
    """The time and state at which the equations of a part are evaluated."""

    t: float
    q: Any
    rows: Any
    omega: Any
    momentum: Any
    inertia: Any
    wheels: Any
    held: dict


class Wheel(NamedTuple):
    """Axis, moment of inertia, initial relative speed, and torque of the motor of a wheel.

    ``motor(moment, speed, speeds, levels)`` is None if the speed is constant.
    """

    axis: Any
    inertia: float
    speed: float
    motor: Any


class Part:
    """Base class of the parts; ``gain``: the number with respect to which derivatives are taken."""

    name = ""
    gain = ""
    batched = True
    smooth = True
    rate: float | None = None
    exclusive: tuple[str, ...] = ()

    def draw(self, s: Scale) -> dict[str, Any]:
        return {}

    def build(self, n) -> dict[str, Any]:
        return {}

    def torque(self, n, m: Moment, levels) -> Any:
        return ZERO

    def slip(self, n, m: Moment) -> Any:
        return None

    def margins(self, n, m: Moment) -> list[float]:
        return []

    def motor_margins(self, n, m: Moment, speeds) -> list[float]:
        return []

    def wheels(self, n) -> list[Wheel]:
        return []

    def edges(self, n, start: float, end: float) -> list[float]:
        return []

    def at_edge(self, n, m: Moment) -> None:
        """Called at the start and at every edge in time; may change ``m.held``."""

    def inertia(self, n, moments, t: float) -> Any:
        return None


# Orbits


def orbit_of(o) -> Any:
    angles = [o[k] for k in ("inclination", "node", "periapsis", "mean_anomaly", "epoch")]
    if "e" not in o:
        return ph.KeplerOrbit(o["mu"], o["a"], None, *angles)
    return ph.KeplerOrbit(o["mu"], o["a"], o["e"], *angles)


def flyby_of(o) -> Any:
    angles = [o[k] for k in ("inclination", "node", "periapsis", "mean_anomaly", "epoch")]
    return ph.HyperbolicOrbit(o["mu"], o["a"], o["e"], *angles)


def plane(o, x: float, y: float) -> tuple[float, float, float]:
    """Space components of a vector in the plane of the orbit: x along the node, y normal to it."""
    ci, si = math.cos(o["inclination"]), math.sin(o["inclination"])
    cn, sn = math.cos(o["node"]), math.sin(o["node"])
    return cn * x - sn * ci * y, sn * x + cn * ci * y, si * y


def place(o, t: float) -> tuple[Any, float, float]:
    """Position, distance and continuous argument of latitude."""
    n = math.sqrt(o["mu"] / abs(o["a"]) ** 3)
    mean, e, a = o["mean_anomaly"] + n * (t - o["epoch"]), o.get("e", 0.0), abs(o["a"])
    x = anomaly(mean, e)
    if e < 1:
        u, v = a * (math.cos(x) - e), a * math.sqrt(1 - e * e) * math.sin(x)
        true = x + 2 * math.atan2(
            (b := e / (1 + math.sqrt(1 - e * e))) * math.sin(x), 1 - b * math.cos(x)
        )
    else:
        u, v = a * (e - math.cosh(x)), a * math.sqrt(e * e - 1) * math.sinh(x)
        true = math.atan2(v, u)
    c, s = math.cos(o["periapsis"]), math.sin(o["periapsis"])
    return plane(o, c * u - s * v, s * u + c * v), math.hypot(u, v), true + o["periapsis"]


def pole(o) -> tuple[float, float, float]:
    i, node = o["inclination"], o["node"]
    return math.sin(node) * math.sin(i), -math.cos(node) * math.sin(i), math.cos(i)


def half(axis: int, angle: float) -> tuple[float, float, float, float]:
    q = [math.cos(angle / 2), 0.0, 0.0, 0.0]
    q[axis + 1] = math.sin(angle / 2)
    return tuple(q)  # pyright: ignore[reportReturnType]


def frame(o, t: float) -> tuple[Any, Any]:
    """Quaternion of the LVLH frame, continuous in time, and its angular velocity in space."""
    _, r, u = place(o, t)
    q = multiply(multiply(half(2, o["node"]), half(0, o["inclination"])), half(2, u))
    e = o.get("e", 0.0)
    h = math.sqrt(o["mu"] * o["a"] * (1 - e * e))
    return multiply(q, (0.5, -0.5, -0.5, 0.5)), scaled(h / r**2, pole(o))


def gradient(mu: float, r: Any, m: Moment) -> Any:
    size = norm(r)
    n = to_body(m.rows, scaled(1 / size, r))
    return scaled(3 * mu / size**3, cross(n, [dot(row, n) for row in m.inertia]))


# Nothing, and potentials


class Free(Part):
    name = "free body"


class Gravity(Part):
    name, gain = "UniformGravity", "mass"

    def draw(self, s):
        length = s.decades(-2, 1)
        mass = s.torque() / length / 9.8
        return {"mass": mass, "centre": length * s.direction(), "g": 9.8 * s.direction()}

    def build(self, n):
        return {"potential": ph.UniformGravity(n["mass"], n["centre"], n["g"])}

    def torque(self, n, m, levels):
        return cross(n["centre"], scaled(n["mass"], to_body(m.rows, n["g"])))


class Lagrange(Gravity):
    name = "UniformGravity.axial, axisymmetric"
    exclusive = ("inertia",)

    def draw(self, s):
        s.moments[1:] = s.moments[0] * np.array([1.0, s.rng.uniform(0.1, 1.9)])
        length = s.decades(-2, 1)
        return {"mass": s.torque() / length / 9.80665, "distance": length}

    def build(self, n):
        down = jnp.asarray([0.0, 0.0, -9.80665], jnp.asarray(n["mass"]).dtype)
        found = ph.UniformGravity.axial(n["mass"], n["distance"], down)
        return {"potential": found, "inertia": _axisymmetric}

    def torque(self, n, m, levels):
        down = to_body(m.rows, (0.0, 0.0, -n["mass"] * 9.80665))
        return cross((0.0, 0.0, n["distance"]), down)


def _axisymmetric(moments):
    return ph.Inertia.axisymmetric(moments[..., 0], moments[..., 2])


class Gradient(Part):
    name, gain = "GravityGradient, fixed centre", "mu"

    def draw(self, s):
        r = s.decades(3, 9)
        rate = s.torque(-4, 0.5) / float(np.max(s.moments))
        return {"mu": rate * r**3, "r": r * s.direction()}

    def build(self, n):
        return {"potential": ph.GravityGradient(n["mu"], n["r"])}

    def torque(self, n, m, levels):
        return gradient(n["mu"], n["r"], m)


class OrbitGradient(Part):
    kind = "circle"
    gain = "mu"

    def __init__(self, kind: str):
        self.kind, self.name = kind, f"GravityGradient, {kind}"

    def draw(self, s):
        return s.orbit(self.kind, -2, 0.5 if self.kind == "circle" else 0)

    def build(self, n):
        orbit = flyby_of(n) if self.kind == "hyperbola" else orbit_of(n)
        return {"potential": ph.GravityGradient(n["mu"], orbit)}

    def torque(self, n, m, levels):
        return gradient(n["mu"], place(n, m.t)[0], m)


class _Energy(eqx.Module):
    k: Any

    def __call__(self, R, t):
        a, b, c, f = (self.k[i] for i in range(4))
        return a * R[0, 0] ** 2 + b * R[1, 2] * R[2, 0] + c * jnp.sin(f * t) * R[2, 2]


class UserPotential(Part):
    name, gain, batched = "Potential", "k", False

    def draw(self, s):
        size = s.torque()
        return {"k": np.array([*(size * s.direction()), s.rate * s.decades(-2, 0)])}

    def build(self, n):
        return {"potential": ph.Potential(_Energy(jnp.asarray(n["k"])))}

    def torque(self, n, m, levels):
        a, b, c, f = n["k"]
        x, y, z = m.rows
        parts = (
            cross(x, (2 * a * x[0], 0.0, 0.0)),
            cross(y, (0.0, 0.0, b * z[0])),
            cross(z, (b * y[2], 0.0, c * math.sin(f * m.t))),
        )
        return total(*parts)


# Torques of time


class _Sine(eqx.Module):
    size: Any
    rate: Any
    phase: float = eqx.field(static=True, default=0.0)

    def __call__(self, t):
        return self.size * jnp.sin(self.rate * t + self.phase)


class BodyConstant(Part):
    name, gain = "BodyTorque", "n"

    def draw(self, s):
        return {"n": s.torque(-5, 0, steady=True) * s.direction()}

    def build(self, n):
        return {"torque": ph.BodyTorque(n["n"])}

    def torque(self, n, m, levels):
        return n["n"]


class BodySine(Part):
    name, gain, batched = "BodyTorque of time", "n", False

    def draw(self, s):
        return {"n": s.torque() * s.direction(), "f": s.rate * s.decades(-1, 1)}

    def build(self, n):
        return {"torque": ph.BodyTorque(_Sine(jnp.asarray(n["n"]), jnp.asarray(n["f"]), 0.3))}

    def torque(self, n, m, levels):
        return scaled(math.sin(n["f"] * m.t + 0.3), n["n"])


class SpaceConstant(BodyConstant):
    name = "SpaceTorque"

    def build(self, n):
        return {"torque": ph.SpaceTorque(n["n"])}

    def torque(self, n, m, levels):
        return to_body(m.rows, n["n"])


class SpaceSine(BodySine):
    name = "SpaceTorque of time"

    def build(self, n):
        return {"torque": ph.SpaceTorque(_Sine(jnp.asarray(n["n"]), jnp.asarray(n["f"]), 0.3))}

    def torque(self, n, m, levels):
        return to_body(m.rows, super().torque(n, m, levels))


@cache
def _slopes(times, values) -> np.ndarray:
    """Derivatives at the knots: those of the polynomials through the five nearest knots."""
    found = []
    for k in range(len(times)):
        first = int(np.clip(k - 2, 0, len(times) - 5))
        t = np.array(times[first : first + 5]) - times[k]
        unit = np.max(np.abs(t))
        powers = np.vander(t / unit, increasing=True)
        found.append(np.linalg.solve(powers, np.array(values[first : first + 5]))[1] / unit)
    return np.array(found)


class TableTorque(Part):
    batched = False
    gain = "values"
    knots = 14

    def __init__(self, order: int, slopes: bool = False):
        self.order, self.slopes = order, slopes
        self.smooth = order == 3
        self.name = f"Table, order {order}" + (", derivatives given" if slopes else "")

    def draw(self, s):
        size = s.torque(-4, 0)
        gaps = s.rng.uniform(0.2, 1, self.knots - 1)
        times = np.concatenate([[0.0], np.cumsum(gaps)])
        # longer than the simulated span in both directions: the sign of time is drawn later
        times = s.start + (times / times[-1] * 2.2 - 1.1) * s.span
        found = {"times": times, "values": size * s.rng.normal(size=(self.knots, 3))}
        if self.slopes:
            found["slopes"] = size / s.span * s.rng.normal(size=(self.knots, 3))
        return found

    def build(self, n):
        table = ph.Table(n["times"], n["values"], self.order, n.get("slopes"))
        return {"torque": ph.BodyTorque(table)}

    def at_edge(self, n, m):
        m.held["place"] = None

    def torque(self, n, m, levels):
        times = np.asarray(n["times"])
        # the interval of the step, forward or backward in time, from the middle of the step
        middle = m.held.get("middle", m.t)
        i = int(np.clip(np.searchsorted(times, middle, side="right") - 1, 0, len(times) - 2))
        h = times[i + 1] - times[i]
        x = (m.t - times[i]) / h
        a, b = (np.asarray(n["values"][k]) for k in (i, i + 1))
        if self.order == 1:
            return tuple((a + x * (b - a)).tolist())
        slopes = n.get("slopes")
        if slopes is not None:
            da, db = (np.asarray(slopes[k]) for k in (i, i + 1))
        else:
            da, db = _slopes(tuple(n["times"]), tuple(map(tuple, n["values"])))[i : i + 2]
        h00, h01 = (1 + 2 * x) * (1 - x) ** 2, x * x * (3 - 2 * x)
        h10, h11 = x * (1 - x) ** 2, x * x * (x - 1)
        return tuple((h00 * a + h01 * b + h * (h10 * da + h11 * db)).tolist())

    def edges(self, n, start, end):
        return list(n["times"])


class PulsesOf(Part):
    gain = "n"
    batched = False

    def __init__(self, inner: Part):
        self.inner = inner
        self.gain, self.smooth = inner.gain, inner.smooth
        self.name = f"Pulses({inner.name})"

    def draw(self, s):
        found = self.inner.draw(s)
        span = s.span
        lengths = s.rng.uniform(0.001, 0.2, 3) * span
        starts = s.start + s.rng.uniform(-1, 1, 3) * span
        return found | {"starts": starts, "ends": starts + lengths}

    def build(self, n):
        torque = self.inner.build(n)["torque"]
        return {"torque": ph.Pulses(torque, n["starts"], n["ends"])}

    def torque(self, n, m, levels):
        t = m.held.get("middle", m.t)
        on = any(a <= t < b for a, b in zip(n["starts"], n["ends"]))
        return self.inner.torque(n, m, levels) if on else ZERO

    def margins(self, n, m):
        return self.inner.margins(n, m)

    def edges(self, n, start, end):
        return [*n["starts"], *n["ends"]]


# Damping and control


class Linear(Part):
    name, gain = "LinearDamping", "c"

    def draw(self, s):
        return {"c": s.damping() * s.rng.uniform(0.3, 1, 3)}

    def build(self, n):
        return {"torque": ph.LinearDamping(n["c"])}

    def torque(self, n, m, levels):
        return tuple(-c * w for c, w in zip(n["c"], m.omega))


class Quadratic(Part):
    name, gain = "QuadraticDamping", "c"

    def draw(self, s):
        return {"c": s.damping() / s.rate * s.rng.uniform(0.3, 1, 3)}

    def build(self, n):
        return {"torque": ph.QuadraticDamping(n["c"])}

    def torque(self, n, m, levels):
        size = norm(m.omega)
        return tuple(-c * size * w for c, w in zip(n["c"], m.omega))


class Sink(Part):
    name, gain = "EnergySink", "k"

    def draw(self, s):
        return {"k": s.decades(-4, -1) / (float(np.mean(s.moments)) * s.rate)}

    def build(self, n):
        return {"torque": ph.EnergySink(n["k"])}

    def slip(self, n, m):
        return scaled(n["k"], cross(m.momentum, m.omega))


class Rates(Part):
    name, gain = "RateDamping", "c"

    def draw(self, s):
        return {"c": s.damping() * s.rng.uniform(0.3, 1, 3), "rates": s.rate * s.direction()}

    def build(self, n):
        return {"torque": ph.RateDamping(n["c"], n["rates"])}

    def torque(self, n, m, levels):
        return tuple(-c * (w - r) for c, w, r in zip(n["c"], m.omega, n["rates"]))


class Aim(Part):
    name, gain, smooth = "Pointing", "kp", False

    def draw(self, s):
        kp = s.torque(-3, 1)
        return {
            "kp": kp * s.rng.uniform(0.3, 1, 3),
            "kd": s.damping() * s.rng.uniform(0.3, 1, 3),
            "target": s.direction(4),
        }

    def build(self, n):
        return {"torque": ph.Pointing(n["kp"], n["kd"], n["target"])}

    def _relative(self, n, m):
        size = math.sqrt(sum(x * x for x in n["target"]))
        a, b, c, d = (x / size for x in n["target"])
        return multiply((a, -b, -c, -d), m.q)

    def torque(self, n, m, levels):
        sign = 1 if levels[0] else -1
        e = self._relative(n, m)[1:]
        return tuple(-2 * sign * p * x - d * w for p, d, x, w in zip(n["kp"], n["kd"], e, m.omega))

    def margins(self, n, m):
        return [self._relative(n, m)[0]]


class Relative(Part):
    gain = "kp"

    def __init__(self, inner: Part, kind: str):
        self.inner, self.kind = inner, kind
        self.gain, self.smooth = inner.gain, inner.smooth
        self.name = f"RelativeTorque({inner.name}), {kind}"

    def draw(self, s):
        return self.inner.draw(s) | {"orbit": s.orbit(self.kind)}

    def build(self, n):
        torque = self.inner.build(n)["torque"]
        return {"torque": ph.RelativeTorque(torque, ph.LVLH(orbit_of(n["orbit"])))}

    def _seen(self, n, m):
        q, rate = frame(n["orbit"], m.t)
        relative = multiply((q[0], -q[1], -q[2], -q[3]), m.q)
        turning = to_body(m.rows, rate)
        omega = tuple(w - f for w, f in zip(m.omega, turning))
        return m._replace(q=relative, rows=matrix(relative), omega=omega)

    def torque(self, n, m, levels):
        return self.inner.torque(n, self._seen(n, m), levels)

    def margins(self, n, m):
        return self.inner.margins(n, self._seen(n, m))


class Dipole(Part):
    name, gain = "MagneticDipole", "moment"

    def draw(self, s):
        size = s.decades(-6, -4)
        return {"moment": s.torque() / size * s.direction(), "field": size * s.direction()}

    def build(self, n):
        return {"torque": ph.MagneticDipole(n["moment"], n["field"])}

    def torque(self, n, m, levels):
        return cross(n["moment"], to_body(m.rows, n["field"]))


def dipole_field(n, t: float):
    r, size, _ = place(n["orbit"], t)
    unit = scaled(1 / size, r)
    along = dot(unit, n["dipole"])
    return tuple(1e-7 * (3 * u * along - d) / size**3 for u, d in zip(unit, n["dipole"]))


class Detumble(Part):
    gain, smooth = "k", False
    batched = False

    def __init__(self, limit: bool):
        self.limit, self.smooth = limit, not limit
        self.name = "BDot on an orbit" + (", limited" if limit else "")

    def draw(self, s):
        o = s.orbit("circle")
        size = s.decades(-6, -4)
        found = {"orbit": o, "dipole": size * o["a"] ** 3 * 1e7 * s.direction()}
        found["k"] = s.damping(-3, -0.5) / size**2
        if self.limit:
            found["most"] = found["k"] * s.rate * size * s.decades(-1, 0.3)
        return found

    def build(self, n):
        law = ph.BDot(n["k"], n.get("most"))
        return {"torque": ph.MagneticDipole(law, ph.DipoleField(n["dipole"]), orbit_of(n["orbit"]))}

    def _moment(self, n, m):
        field = to_body(m.rows, dipole_field(n, m.t))
        return scaled(n["k"], cross(m.omega, field)), field

    def torque(self, n, m, levels):
        moment, field = self._moment(n, m)
        if self.limit:
            most = n["most"]
            moment = tuple(
                (most if levels[2 * i] else -most if levels[2 * i + 1] else x)
                for i, x in enumerate(moment)
            )
        return cross(moment, field)

    def margins(self, n, m):
        if not self.limit:
            return []
        moment, _ = self._moment(n, m)
        return [s * x - n["most"] for x in moment for s in (1, -1)]


# Functions of the user: every kind of kink and jump


class _Relu(eqx.Module):
    k: Any

    def __call__(self, t, wxyz, omega):
        return -self.k * jnp.maximum(omega, 0)


class _Clip(eqx.Module):
    k: Any
    limit: Any

    def __call__(self, t, wxyz, omega):
        return jnp.clip(-self.k * omega, -self.limit, self.limit)


class _Where(eqx.Module):
    k: Any
    level: Any

    def __call__(self, t, wxyz, omega):
        up = 1 - 2 * (wxyz[1] ** 2 + wxyz[2] ** 2)
        return jnp.where(up > self.level, self.k, -self.k)


class _Dead(eqx.Module):
    k: Any
    width: Any

    def __call__(self, t, wxyz, omega):
        out = jnp.abs(omega) - self.width
        return -self.k * jnp.where(out > 0, jnp.sign(omega) * out, 0.0)


class _Steps(eqx.Module):
    k: Any

    def __call__(self, t, wxyz, omega):
        up = 1 - 2 * (wxyz[1] ** 2 + wxyz[2] ** 2)
        return self.k * jnp.floor(3 * up)


class _Window(eqx.Module):
    k: Any
    times: Any

    def __call__(self, t, wxyz, omega):
        return jnp.where((t > self.times[0]) & (t < self.times[1]), self.k, jnp.zeros(3, t.dtype))


class _Tanh(eqx.Module):
    k: Any
    width: Any

    def __call__(self, t, wxyz, omega):
        return -self.k * jnp.tanh(omega / self.width)


class Feedback(Part):
    gain, batched, smooth = "k", False, False

    def __init__(self, kind: str):
        self.kind, self.name = kind, f"FeedbackTorque, {kind}"
        self.smooth = kind == "tanh"

    def draw(self, s):
        if self.kind in ("where", "floor", "window"):
            size = s.torque(-4, 0.5, steady=self.kind == "window")
            found: dict[str, Any] = {"k": size * s.direction()}
            if self.kind == "where":
                found["level"] = s.rng.uniform(-0.8, 0.8)
            if self.kind == "window":
                found["times"] = s.start + np.sort(s.rng.uniform(-1, 1, 2)) * s.span
            return found
        found = {"k": s.damping(-3, -0.5)}
        if self.kind == "clip":
            found["limit"] = found["k"] * s.rate * s.decades(-1, 0)
        if self.kind == "dead band":
            found["width"] = s.rate * s.decades(-2, -0.3)
        if self.kind == "tanh":
            found |= {"k": found["k"] * s.rate, "width": s.rate * s.decades(-1, 0)}
        return found

    def build(self, n):
        n = {k: jnp.asarray(v) for k, v in n.items()}
        laws = {
            "relu": lambda: _Relu(n["k"]),
            "clip": lambda: _Clip(n["k"], n["limit"]),
            "where": lambda: _Where(n["k"], n["level"]),
            "dead band": lambda: _Dead(n["k"], n["width"]),
            "floor": lambda: _Steps(n["k"]),
            "window": lambda: _Window(n["k"], n["times"]),
            "tanh": lambda: _Tanh(n["k"], n["width"]),
        }
        return {"torque": ph.FeedbackTorque(laws[self.kind]())}

    def margins(self, n, m):
        up = m.rows[2][2]
        match self.kind:
            case "relu":
                return list(m.omega)
            case "clip":
                return [s * n["k"] * w - n["limit"] for w in m.omega for s in (1, -1)]
            case "where":
                return [up - n["level"]]
            case "dead band":
                return [s * w - n["width"] for w in m.omega for s in (1, -1)]
            case "floor":
                return [3 * up - i for i in range(-2, 3)]
            case "window":
                return [m.t - x for x in n["times"]]
        return []

    def torque(self, n, m, levels):
        k = n["k"]
        match self.kind:
            case "relu":
                return tuple(-k * w if on else 0.0 for w, on in zip(m.omega, levels))
            case "clip":
                pairs = zip(m.omega, levels[::2], levels[1::2])
                return tuple(-n["limit"] if a else n["limit"] if b else -k * w for w, a, b in pairs)
            case "where":
                return scaled(1 if levels[0] else -1, k)
            case "dead band":
                pairs = zip(m.omega, levels[::2], levels[1::2])
                d = n["width"]
                return tuple(-k * (w - d) if a else -k * (w + d) if b else 0.0 for w, a, b in pairs)
            case "floor":
                return scaled(sum(levels) - 3, k)
            case "window":
                return k if levels[0] and not levels[1] else ZERO
            case _:
                return tuple(-k * math.tanh(w / n["width"]) for w in m.omega)


class Sampled(Part):
    name, gain, batched, rate = "SampledTorque", "k", False, 0.3
    exclusive = ("pulses",)

    def draw(self, s):
        # always 20.5 periods of two seconds: the period is a constant of the program
        s.angle = 20.5 * 2.0 * s.rate
        return {"k": s.damping(-2, -0.3), "kp": s.unit * s.decades(-2, 0)}

    def build(self, n):
        return {"torque": ph.SampledTorque(_Sampled(*map(jnp.asarray, (n["k"], n["kp"]))), 2.0)}

    def edges(self, n, start, end):
        sign = 1 if end > start else -1
        return [start + sign * 2.0 * k for k in range(1, 21)]

    def at_edge(self, n, m):
        q = m.q
        m.held["command"] = tuple(-n["k"] * w - n["kp"] * q[0] * x for w, x in zip(m.omega, q[1:]))

    def torque(self, n, m, levels):
        return m.held["command"]


class _Sampled(eqx.Module):
    k: Any
    kp: Any

    def __call__(self, t, wxyz, omega):
        return -self.k * omega - self.kp * wxyz[0] * wxyz[1:]


# Plates


def _box(s: Scale) -> dict[str, Any]:
    sides = s.rng.uniform(0.5, 2, 3) * s.decades(-1, 1)
    normal = np.concatenate([np.eye(3), -np.eye(3)])
    area = np.concatenate([[sides[1] * sides[2], sides[0] * sides[2], sides[0] * sides[1]]] * 2)
    shift = 0.2 * sides * s.rng.uniform(-1, 1, 3)
    return {"area": area, "normal": normal, "centre": normal * sides / 2 + shift}


class AirDrag(Part):
    name, gain, smooth = "Drag", "density", False

    def draw(self, s):
        found = _box(s)
        speed = s.decades(2, 4)
        lever = float(np.max(found["area"]) * np.max(np.abs(found["centre"])))
        density = s.torque(-4, 0) / (speed**2 * lever)
        return found | {"velocity": speed * s.direction(), "density": density}

    def build(self, n):
        plates = ph.Plates(n["area"], n["normal"], n["centre"])
        return {"torque": ph.Drag(plates, n["density"], n["velocity"])}

    def torque(self, n, m, levels):
        v = to_body(m.rows, n["velocity"])
        found = ZERO
        for k, on in enumerate(levels):
            if on:
                flow = dot(n["normal"][k], v)
                force = scaled(-0.5 * n["density"] * 2.2 * n["area"][k] * flow, v)
                found = total(found, cross(n["centre"][k], force))
        return found

    def margins(self, n, m):
        v = to_body(m.rows, n["velocity"])
        return [dot(x, v) for x in n["normal"]]


class Light(Part):
    name, gain, smooth = "SolarPressure, Eclipse", "pressure", False
    batched = False  # the leading axis of the numbers is that of the plates

    def draw(self, s):
        found = _box(s)
        lever = float(np.max(found["area"]) * np.max(np.abs(found["centre"])))
        o = s.orbit("circle")
        return found | {
            "pressure": s.torque(-4, 0) / lever,
            "sun": s.direction(),
            "specular": s.rng.uniform(0, 0.5),
            "diffuse": s.rng.uniform(0, 0.5),
            "orbit": o,
            "radius": o["a"] * s.rng.uniform(0.5, 0.95),
        }

    def build(self, n):
        plates = ph.Plates(n["area"], n["normal"], n["centre"])
        shadow = ph.Eclipse(orbit_of(n["orbit"]), n["sun"], n["radius"])
        return {
            "torque": ph.SolarPressure(
                plates, n["sun"], shadow, n["specular"], n["diffuse"], n["pressure"]
            )
        }

    def torque(self, n, m, levels):
        *lit, ahead, outside = levels
        if not (ahead or outside):
            return ZERO
        s = to_body(m.rows, scaled(1 / norm(n["sun"]), n["sun"]))
        found = ZERO
        for k, on in enumerate(lit):
            if not on:
                continue
            normal = n["normal"][k]
            c = dot(normal, s)
            across = 2 * (n["specular"] * c + n["diffuse"] / 3)
            push = total(scaled(1 - n["specular"], s), scaled(across, normal))
            force = scaled(-n["pressure"] * n["area"][k] * c, push)
            found = total(found, cross(n["centre"][k], force))
        return found

    def margins(self, n, m):
        s = to_body(m.rows, n["sun"])
        r, _, _ = place(n["orbit"], m.t)
        across = norm(cross(r, scaled(1 / norm(n["sun"]), n["sun"])))
        shadow = [dot(r, n["sun"]) / n["radius"], across / n["radius"] - 1]
        return [dot(x, s) for x in n["normal"]] + shadow


# Wheels


class Held(Part):
    name, gain = "Rotor, held", "h"

    def draw(self, s):
        size = float(np.mean(s.moments)) * s.rate
        return {"h": size * s.decades(-2, 0.5), "axis": s.direction()}

    def build(self, n):
        return {"rotors": ph.Rotor(n["axis"], momentum=n["h"])}

    def wheels(self, n):
        return [Wheel(_unit(n["axis"]), 1.0, n["h"], None)]


def _unit(a):
    return scaled(1 / norm(a), a)


def _wheel(s: Scale) -> dict[str, Any]:
    inertia = float(np.min(s.moments)) * s.decades(-3, -0.7)
    speed = float(np.mean(s.moments)) * s.rate / inertia * s.decades(-2, 0)
    return {"axis": s.direction(), "J": inertia, "speed": speed * s.rng.choice([-1, 1])}


class Driven(Part):
    name, gain = "Rotor, torque", "torque"

    def draw(self, s):
        found = _wheel(s)
        span = s.span
        return found | {"torque": found["J"] * abs(found["speed"]) / span * s.decades(-1, 1)}

    def build(self, n):
        return {"rotors": ph.Rotor(n["axis"], n["J"], speed=n["speed"], torque=n["torque"])}

    def wheels(self, n):
        return [Wheel(_unit(n["axis"]), n["J"], n["speed"], lambda m, w, ws, levels: n["torque"])]


class Impulse(Part):
    name, gain, batched = "Rotor, impulse", "size", False

    def draw(self, s):
        found = _wheel(s)
        size = found["J"] * abs(found["speed"]) * s.decades(-1, 0)
        return found | {"size": size, "f": s.rate * s.decades(-1, 0)}

    def build(self, n):
        law = _Sine(jnp.asarray(n["size"]), jnp.asarray(n["f"]))
        return {"rotors": ph.Rotor(n["axis"], n["J"], speed=n["speed"], impulse=law)}

    def wheels(self, n):
        def motor(m, w, ws, levels):
            return n["size"] * n["f"] * math.cos(n["f"] * m.t)

        return [Wheel(_unit(n["axis"]), n["J"], n["speed"], motor)]


class Viscous(Part):
    name, gain = "Rotor, ViscousCoupling", "c"

    def draw(self, s):
        found = _wheel(s)
        return found | {"c": found["J"] * s.rate * s.decades(-3, 0)}

    def build(self, n):
        ring = ph.ViscousCoupling(n["c"])
        return {"rotors": ph.Rotor(n["axis"], n["J"], speed=n["speed"], coupling=ring)}

    def wheels(self, n):
        motor = lambda m, w, ws, levels: -n["c"] * w  # noqa: E731
        return [Wheel(_unit(n["axis"]), n["J"], n["speed"], motor)]


class Coulomb(Part):
    gain = "size"

    def __init__(self, narrow: bool):
        self.narrow = narrow
        self.name = "Rotor, CoulombFriction" + (", narrow" if narrow else "")

    def draw(self, s):
        found = _wheel(s)
        width = abs(found["speed"]) * (s.decades(-6, -3) if self.narrow else s.decades(-2, 0))
        torque = found["J"] * abs(found["speed"]) / s.span * s.decades(-1, 1)
        return found | {"size": torque, "width": width, "c": torque / abs(found["speed"]) / 10}

    def build(self, n):
        both = ph.CoulombFriction(n["size"], n["width"]) + ph.ViscousCoupling(n["c"])
        return {"rotors": ph.Rotor(n["axis"], n["J"], speed=n["speed"], coupling=both)}

    def wheels(self, n):
        def motor(m, w, ws, levels):
            return -n["size"] * math.tanh(w / n["width"]) - n["c"] * w

        return [Wheel(_unit(n["axis"]), n["J"], n["speed"], motor)]


class _Command(eqx.Module):
    kp: Any
    kd: Any

    def __call__(self, t, wxyz, omega, speed):
        return self.kp * wxyz[1] * jnp.sign(wxyz[0]) + self.kd * omega[0]


class LimitedMotor(Part):
    name, gain, batched, smooth = "Rotor, Motor with limits", "kd", False, False

    def draw(self, s):
        found = _wheel(s)
        found["axis"] = np.array([1.0, 0.0, 0.0])
        most = s.torque(-3, -0.3)
        return found | {
            "kp": most * s.decades(-1, 1),
            "kd": most / s.rate * s.decades(-1, 1),
            "most": most,
            "fast": abs(found["speed"]) * s.decades(-0.3, 1),
        }

    def build(self, n):
        law = _Command(jnp.asarray(n["kp"]), jnp.asarray(n["kd"]))
        motor = ph.Motor(law, n["most"], n["fast"])
        return {"rotors": ph.Rotor(n["axis"], n["J"], speed=n["speed"], coupling=motor)}

    def _command(self, n, m, positive: bool) -> float:
        return (1 if positive else -1) * n["kp"] * m.q[1] + n["kd"] * m.omega[0]

    def _limits(self, n, w, levels):
        above, over, under = levels  # w > 0, w > fast, w > -fast
        share, most = w / n["fast"], n["most"]
        high = 0.0 if over else most * (1 - share) if above else most
        low = -most if above else -most * (1 + share) if under else 0.0
        return low, high

    def motor_margins(self, n, m, speeds):
        (w,) = speeds
        low, high = self._limits(n, w, (w > 0, w > n["fast"], w > -n["fast"]))
        command = self._command(n, m, m.q[0] > 0)
        return [w, w - n["fast"], w + n["fast"], m.q[0], command - high, command - low]

    def wheels(self, n):
        def motor(m, w, ws, levels):
            low, high = self._limits(n, w, levels[:3])
            return high if levels[4] else self._command(n, m, levels[3]) if levels[5] else low

        return [Wheel(_unit(n["axis"]), n["J"], n["speed"], motor)]


class _Law(eqx.Module):
    kp: Any
    kd: Any

    def __call__(self, t, wxyz, omega):
        return -2 * self.kp * wxyz[0] * wxyz[1:] - self.kd * omega


_CORNERS = np.array([[1.0, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
_SHARES = np.linalg.pinv(_CORNERS.T / math.sqrt(3)).tolist()
_NULL = (np.eye(4) - np.array(_SHARES) @ _CORNERS.T / math.sqrt(3)).tolist()


class Cluster(Part):
    name, gain, batched, smooth = "wheel_cluster, limited", "kd", False, False
    exclusive = ("wheels",)

    def draw(self, s):
        inertia = float(np.min(s.moments)) * s.decades(-3, -1.3)
        most = s.torque(-3, -1)
        return {
            "J": inertia,
            "kp": most * s.decades(-1, 1),
            "kd": most / s.rate * s.decades(-1, 1),
            "most": most,
            "speed": float(np.mean(s.moments)) * s.rate / inertia * s.rng.uniform(-0.3, 0.3, 4),
            "gain": s.rate * s.decades(-2, -1),
            "c": inertia * s.rate * s.decades(-3, -1),
        }

    def build(self, n):
        law = _Law(jnp.asarray(n["kp"]), jnp.asarray(n["kd"]))
        dtype = jnp.asarray(n["kp"]).dtype
        wheels = ph.wheel_cluster(
            jnp.asarray(_CORNERS, dtype),
            n["J"],
            law,
            speed=n["speed"],
            max_torque=n["most"],
            friction=ph.ViscousCoupling(n["c"]),
            null_gain=n["gain"],
            bias=jnp.zeros((), dtype),
        )
        return {"rotors": wheels}

    def _commands(self, n, m, speeds) -> list[float]:
        law = (-2 * n["kp"] * m.q[0] * x - n["kd"] * w for x, w in zip(m.q[1:], m.omega))
        torque = tuple(law)
        k = n["gain"] * n["J"]
        return [
            -dot(share, torque) - k * sum(p * w for p, w in zip(null, speeds))
            for share, null in zip(_SHARES, _NULL)
        ]

    def motor_margins(self, n, m, speeds):
        return [s * u - n["most"] for u in self._commands(n, m, speeds) for s in (1, -1)]

    def wheels(self, n):
        def motor(i):
            def torque(m, w, ws, levels):
                u = self._commands(n, m, ws)[i]
                a, b = levels[2 * i : 2 * i + 2]
                return (n["most"] if a else -n["most"] if b else float(u)) - n["c"] * w

            return torque

        return [
            Wheel(_unit(_CORNERS[i].tolist()), n["J"], n["speed"][i], motor(i)) for i in range(4)
        ]


class Dumping(Part):
    name, gain, smooth = "MomentumDumping", "k", False
    exclusive = ("wheels",)

    def draw(self, s):
        found = _wheel(s)
        o = s.orbit("circle")
        size = s.decades(-6, -4)
        k = s.rate * s.decades(-3, -1)
        momentum = found["J"] * abs(found["speed"])
        return found | {
            "orbit": o,
            "dipole": size * o["a"] ** 3 * 1e7 * s.direction(),
            "k": k,
            "most": k * momentum / size * s.decades(-1, 0),
        }

    def build(self, n):
        field = ph.DipoleField(n["dipole"])
        dump = ph.MomentumDumping(n["k"], field, orbit_of(n["orbit"]), n["most"])
        wheel = ph.Rotor(n["axis"], n["J"], speed=n["speed"], torque=n["k"] * 0)
        return {"torque": dump, "rotors": wheel}

    batched = False

    def _moment(self, n, m):
        field = to_body(m.rows, dipole_field(n, m.t))
        return scaled(-n["k"] / dot(field, field), cross(field, m.wheels)), field

    def torque(self, n, m, levels):
        moment, field = self._moment(n, m)
        most = n["most"]
        limited = (
            most if levels[2 * i] else -most if levels[2 * i + 1] else x
            for i, x in enumerate(moment)
        )
        return cross(tuple(limited), field)

    def margins(self, n, m):
        moment, _ = self._moment(n, m)
        return [s * x - n["most"] for x in moment for s in (1, -1)]

    def wheels(self, n):
        return [Wheel(_unit(n["axis"]), n["J"], n["speed"], lambda m, w, ws, levels: 0.0)]


class Gyro(Part):
    name, gain, batched = "ControlMomentGyro", "h", False

    def draw(self, s):
        gimbal = s.direction()
        spin = np.cross(gimbal, s.direction())
        size = float(np.mean(s.moments)) * s.rate * s.decades(-2, 0)
        s.size += size * s.rate
        return {
            "h": size,
            "gimbal": gimbal,
            "spin": spin / np.linalg.norm(spin),
            "size": s.rng.uniform(0.2, 2),
            "f": s.rate * s.decades(-1, 0),
        }

    def build(self, n):
        law = _Sine(jnp.asarray(n["size"]), jnp.asarray(n["f"]))
        return {"torque": ph.ControlMomentGyro(n["h"], n["gimbal"], n["spin"], law)}

    def torque(self, n, m, levels):
        angle = n["size"] * math.sin(n["f"] * m.t)
        rate = n["size"] * n["f"] * math.cos(n["f"] * m.t)
        spin = _unit(n["spin"])
        across = cross(_unit(n["gimbal"]), spin)
        c, s = n["h"] * math.cos(angle), n["h"] * math.sin(angle)
        h = total(scaled(c, spin), scaled(s, across))
        change = total(scaled(-s * rate, spin), scaled(c * rate, across))
        return scaled(-1, total(change, cross(m.omega, h)))


# Inertia


class Tensor(Part):
    name, gain, exclusive = "Inertia with products", "mass", ("inertia",)
    batched = False

    def draw(self, s):
        return Gravity().draw(s) | {"frame": np.array(matrix(s.direction(4).tolist()))}

    def build(self, n):
        rotation = jnp.asarray(n["frame"])

        def inertia(moments):
            tensor = rotation @ (moments[:, None] * rotation.T)
            return ph.Inertia.from_tensor((tensor + tensor.T) / 2)

        return Gravity().build(n) | {"inertia": inertia}

    def torque(self, n, m, levels):
        return Gravity().torque(n, m, levels)

    def inertia(self, n, moments, t):
        rotation = np.asarray(n["frame"])
        return rotation @ np.diag(moments) @ rotation.T


class _Breathing(eqx.Module):
    moments: Any
    size: Any
    rate: Any

    def __call__(self, t):
        phases = jnp.arange(3, dtype=self.moments.dtype)
        return self.moments * (1 + self.size * jnp.sin(self.rate * t + phases))


class Breathing(Part):
    name, gain, batched, exclusive = "VariableInertia", "size", False, ("inertia", "wheels")

    def draw(self, s):
        return {"size": s.decades(-3, -1), "f": s.rate * s.decades(-1.5, 0)}

    def build(self, n):
        def inertia(moments):
            size, rate = jnp.asarray(n["size"]), jnp.asarray(n["f"])
            return ph.VariableInertia(_Breathing(moments, size, rate))

        return {"inertia": inertia}

    def inertia(self, n, moments, t):
        phases = np.arange(3)
        return np.diag(np.asarray(moments) * (1 + n["size"] * np.sin(n["f"] * t + phases)))


PARTS: list[Part] = [
    Free(),
    Gravity(),
    Lagrange(),
    Gradient(),
    OrbitGradient("circle"),
    OrbitGradient("ellipse"),
    OrbitGradient("hyperbola"),
    UserPotential(),
    BodyConstant(),
    BodySine(),
    SpaceConstant(),
    SpaceSine(),
    TableTorque(1),
    TableTorque(3),
    TableTorque(3, True),
    PulsesOf(BodyConstant()),
    PulsesOf(Aim()),
    Linear(),
    Quadratic(),
    Sink(),
    Rates(),
    Aim(),
    Relative(Linear(), "ellipse"),
    Relative(Aim(), "circle"),
    Relative(Aim(), "ellipse"),
    Dipole(),
    Detumble(False),
    Detumble(True),
    *(Feedback(kind) for kind in ("relu", "clip", "where", "dead band", "floor", "window", "tanh")),
    Sampled(),
    AirDrag(),
    Light(),
    Held(),
    Driven(),
    Impulse(),
    Viscous(),
    Coulomb(False),
    Coulomb(True),
    LimitedMotor(),
    Cluster(),
    Dumping(),
    Gyro(),
    Tensor(),
    Breathing(),
]
"""All parts."""


def fits(parts: tuple[Part, ...]) -> bool:
    """Whether these parts can be combined in one scene."""
    marks = [mark for part in parts for mark in part.exclusive]
    if len(marks) != len(set(marks)):
        return False
    for part in parts:
        others = [x for x in parts if x is not part]
        if "wheels" in part.exclusive and any(_has_wheels(x) for x in others):
            return False
        if "pulses" in part.exclusive and any(isinstance(x, PulsesOf) for x in others):
            return False
        if part.rate is not None and any(isinstance(x, PulsesOf | TableTorque) for x in others):
            return False
    return True


def _has_wheels(part: Part) -> bool:
    return type(part).wheels is not Part.wheels
