"""Random scenes of every public part, alone and in pairs, against independent references.

python -m benchmarks.fuzz [--scenes 12] [--pairs 40] [--quick] [--seed S] [--parts WORD ...]
    [--lines FILE] [--output FILE]

Moments, rates, gains, orbits and times are drawn over six or more decades
(``benchmarks/fuzz_parts.py``), forward and backward in time, for single bodies and for batches. The
reference (``benchmarks/fuzz_truth.py``) is SciPy's DOP853 at 1e-13, restarted at every switch,
applied to equations in plain Python. A motion is excluded if a small change grows more than 100
times as fast as the rotation angle, or if the reference is uncertain. ``error``: the largest angle
[rad] between the attitudes at the saved times. A result is *kept* if its error is at most 10 rtol
plus the error that rounding explains, *flagged* if its status is not SUCCESSFUL, and otherwise
*beyond*. Rounding explains the larger of 4 eps times the rotation angle and eps times the angle to
the power of 1.5 (rounding of the momenta in every step; Brouwer, Astron. J. 46, 149, 1937),
multiplied by the growth of a small change of the rates, and in single precision also of the
moments.

Derivatives of a function of the last attitude with respect to the initial rates, one moment of
inertia and one gain of the part, in forward and reverse mode, are compared with central differences
of the reference, extrapolated from two steps by Richardson's rule.

``--parts``: only groups whose names contain one of the words. ``--lines``: a file to which each
result is appended when it is computed; groups that the file already contains are not run again.
"""

import argparse
import itertools
import json
import math
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import polhode as ph
from benchmarks._formulas import multiply
from benchmarks.fuzz_parts import PARTS, ZERO, Moment, Part, Scale, fits
from benchmarks.fuzz_truth import (
    Failure,
    Reference,
    cross,
    dot,
    matrix,
    norm,
    scaled,
    total,
)

RTOLS = {"float64": (1e-4, 1e-6, 1e-8, 1e-10), "float32": (1e-4, 1e-5)}
ALLOWED = 10
CHAOTIC = 100
BATCH = 8
SAVED = 4


class Case(NamedTuple):
    """A body, its parts and their numbers, in float64 values that its dtype can represent."""

    parts: tuple[Part, ...]
    numbers: tuple[dict[str, Any], ...]
    moments: np.ndarray
    wxyz: np.ndarray
    omega: np.ndarray
    ts: np.ndarray

    @property
    def angle(self) -> float:
        return max(1.0, float(np.linalg.norm(self.omega)) * abs(self.ts[-1] - self.ts[0]))


def rounded(tree: Any, dtype: str) -> Any:
    """Numbers rounded to ``dtype``, returned in float64."""
    if isinstance(tree, dict):
        return {k: rounded(v, dtype) for k, v in tree.items()}
    return np.asarray(tree, dtype).astype(float)


def draw(parts: tuple[Part, ...], dtype: str, seed: int, longest: float) -> Case:
    rng = np.random.default_rng(seed)
    fixed = [part.rate for part in parts if part.rate is not None]
    s = Scale(rng, fixed[0] if fixed else None, longest)
    sign = -1 if rng.random() < 0.3 else 1
    if dtype == "float64" and rng.random() < 0.4:
        s.start = s.angle / s.rate * s.decades(-1, 2) * rng.choice([-1, 1])
    numbers = tuple(part.draw(s) for part in parts)
    span = 41.0 if fixed else s.span
    inner = np.sort(rng.uniform(0.02, 0.98, SAVED - 2))
    ts = s.start + sign * span * np.concatenate([[0], inner, [1]])
    case = Case(parts, numbers, s.moments, s.direction(4), s.rate * s.direction(), ts)
    return Case(
        parts,
        *(
            rounded(x, dtype) if not isinstance(x, tuple) else tuple(rounded(y, dtype) for y in x)
            for x in case[1:]
        ),
    )


# The reference


def _plain(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {k: _plain(v) for k, v in tree.items()}
    return tree.tolist()


class Equations:
    """Equations of motion of a case from Newton's law.

    The state is the quaternion, the momentum in the body, the axial momenta of the wheels, and the
    rotation angle.
    """

    def __init__(self, case: Case):
        self.case, self.parts = case, case.parts
        self.numbers = [_plain(n) for n in case.numbers]
        self.wheels = [p.wheels(n) for p, n in zip(self.parts, self.numbers)]
        self.loose = [w for ws in self.wheels for w in ws if w.motor is not None]
        self.fixed = total(
            ZERO, *(scaled(w.speed, w.axis) for ws in self.wheels for w in ws if w.motor is None)
        )
        self.varies = any(p.name == "VariableInertia" for p in self.parts)
        self.held: dict[str, Any] = {}
        self.constant = self._inertia(case.ts[0])
        self.counts: list[tuple[int, int]] = []

    def _inertia(self, t: float) -> tuple[Any, Any]:
        """Rows of the inertia, and of the inverse of the inertia without free wheels."""
        tensor = np.diag(self.case.moments)
        for part, n in zip(self.parts, self.numbers):
            found = part.inertia(n, self.case.moments, t)
            tensor = tensor if found is None else found
        carrier = tensor.copy()
        for wheel in self.loose:
            carrier -= wheel.inertia * np.outer(wheel.axis, wheel.axis)
        return tensor.tolist(), np.linalg.inv(carrier).tolist()

    def start(self, factor: float = 1.0) -> np.ndarray:
        omega = tuple((self.case.omega * factor).tolist())
        tensor, _ = self.constant
        carrier = np.array(tensor)
        momentum = np.array(self.fixed)
        axial = []
        for w in self.loose:
            carrier -= w.inertia * np.outer(w.axis, w.axis)
            axial.append(w.inertia * (w.speed + dot(w.axis, omega)))
            momentum = momentum + axial[-1] * np.array(w.axis)
        momentum = momentum + carrier @ np.array(omega)
        wxyz = self.case.wxyz / np.linalg.norm(self.case.wxyz)
        return np.concatenate([wxyz, momentum, axial, [0.0]])

    def scale(self) -> np.ndarray:
        case = self.case
        size = float(np.max(case.moments) * np.linalg.norm(case.omega)) + norm(self.fixed)
        axial = [w.inertia * (abs(w.speed) + np.linalg.norm(case.omega)) for w in self.loose]
        size += sum(axial)
        return np.array([1.0] * 4 + [size] * 3 + axial + [1e12])

    def seen(self, t: float, y) -> tuple[Moment, list[list[float]]]:
        """What the parts see, and the speeds of the wheels of each."""
        y = y.tolist() if hasattr(y, "tolist") else y
        size = math.sqrt(y[0] ** 2 + y[1] ** 2 + y[2] ** 2 + y[3] ** 2)
        q = tuple(x / size for x in y[:4])
        momentum, axial = tuple(y[4:7]), y[7:-1]
        tensor, inverse = self._inertia(t) if self.varies else self.constant
        carried = total(self.fixed, *(scaled(c, w.axis) for c, w in zip(axial, self.loose)))
        rest = tuple(a - b for a, b in zip(momentum, carried))
        omega = tuple(dot(row, rest) for row in inverse)
        values = iter(axial)
        speeds = [
            [next(values) / w.inertia - dot(w.axis, omega) for w in ws if w.motor is not None]
            for ws in self.wheels
        ]
        moment = Moment(t, q, matrix(q), omega, momentum, tensor, carried, self.held)
        return moment, speeds

    def margins(self, t: float, y) -> list[float]:
        moment, speeds = self.seen(t, y)
        found: list[float] = []
        counts = []
        for part, n, own in zip(self.parts, self.numbers, speeds):
            a, b = part.margins(n, moment), part.motor_margins(n, moment, own)
            counts.append((len(a), len(b)))
            found += [*a, *b]
        self.counts = counts
        return found

    def field(self, t: float, y, levels) -> np.ndarray:
        m, speeds = self.seen(t, y)
        push = ZERO
        turn = m.omega
        motors: list[float] = []
        place = 0
        for part, n, own, ws, (a, b) in zip(
            self.parts, self.numbers, speeds, self.wheels, self.counts
        ):
            push = total(push, part.torque(n, m, levels[place : place + a]))
            if (slip := part.slip(n, m)) is not None:
                turn = total(turn, slip)
            place += a
            loose = [w for w in ws if w.motor is not None]
            motors += [
                w.motor(m, speed, own, levels[place : place + b]) for w, speed in zip(loose, own)
            ]
            place += b
        change = multiply(m.q, (0.0, *turn))
        momentum = total(push, cross(m.momentum, turn))
        rate = norm(m.omega)
        return np.array([*(x / 2 for x in change), *momentum, *motors, rate])


class Motion(NamedTuple):
    """The reference at the saved times: attitudes (T, 4), rates (T, 3), wheel speeds (T, m), the
    final rotation angle, and the switches.
    """

    wxyz: np.ndarray
    omega: np.ndarray
    speeds: np.ndarray
    angle: float
    switches: list[tuple[float, int]]


def reference(case: Case, rtol: float = 1e-13, factor: float = 1.0, width: float = 0.25) -> Motion:
    """The reference motion of a case; raises ``Failure`` if there is none."""
    equations = Equations(case)
    begin, end = float(case.ts[0]), float(case.ts[-1])
    sign = 1 if end > begin else -1
    stops = {float(t) for t in case.ts[1:]}
    for part, n in zip(case.parts, equations.numbers):
        stops |= {float(t) for t in part.edges(n, begin, end)}
    stops = sorted(t for t in stops if sign * (t - begin) > 0 and sign * (end - t) >= 0)[::sign]
    y, t = equations.start(factor), begin
    longest = width * abs(end - begin) / case.angle
    found = Reference(equations.field, equations.margins, equations.scale(), longest, rtol)
    saved = {begin: y}
    edges = [set(p.edges(n, begin, end)) | {begin} for p, n in zip(case.parts, equations.numbers)]
    levels: list[bool] = []
    for stop in stops:
        equations.held["middle"] = (t + stop) / 2
        for part, n, own in zip(case.parts, equations.numbers, edges):
            if t in own:
                part.at_edge(n, equations.seen(t, y)[0])
        if t == begin:
            levels = found.levels(t, y)
        y = found.run(t, y, stop, levels)
        y[:4] /= np.linalg.norm(y[:4])
        t = stop
        saved[t] = y
    moments, speeds = zip(*(equations.seen(t, saved[float(t)]) for t in case.ts))
    return Motion(
        np.array([m.q for m in moments]),
        np.array([m.omega for m in moments]),
        np.array([list(itertools.chain(*s)) for s in speeds]),
        max(1.0, float(abs(y[-1]))),
        found.switches,
    )


def apart(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Angles [rad] between attitudes (..., 4)."""
    p = p / np.linalg.norm(p, axis=-1, keepdims=True)
    sign = np.where(np.sum(p * q, axis=-1, keepdims=True) < 0, -1, 1)
    gap = np.linalg.norm(p - sign * q, axis=-1)
    return 4 * np.arcsin(np.minimum(1, gap / 2))


# polhode


def scene_of(parts: tuple[Part, ...], numbers, moments) -> ph.Scene:
    """The scene of one body, or of a batch if all numbers have a leading axis."""
    built = [part.build(n) for part, n in zip(parts, numbers)]
    fields: dict[str, Any] = {}
    for key in ("potential", "torque", "rotors"):
        some = [b[key] for b in built if key in b]
        fields[key] = sum(some[1:], start=some[0]) if some else None
    makers = [b["inertia"] for b in built if "inertia" in b]
    inertia = makers[0](moments) if makers else ph.Inertia.from_moments(moments)
    return ph.Scene(inertia, **fields)


def typed(tree: Any, dtype: str) -> Any:
    if isinstance(tree, dict):
        return {k: typed(v, dtype) for k, v in tree.items()}
    return np.asarray(tree, dtype)


def stacked(cases: list[Case], dtype: str) -> tuple[ph.Scene, ph.State, np.ndarray]:
    """The cases as one batch; a single case has no batch axis."""

    def join(*trees):
        if isinstance(trees[0], dict):
            return {k: join(*(t[k] for t in trees)) for k in trees[0]}
        if len(trees) == 1:
            return np.asarray(trees[0], dtype)
        return np.stack([np.asarray(t, dtype) for t in trees])

    numbers = tuple(join(*column) for column in zip(*(c.numbers for c in cases)))
    moments, wxyz, omega, ts = (
        jnp.asarray(join(*(getattr(c, k) for c in cases)))
        for k in ("moments", "wxyz", "omega", "ts")
    )
    scene = scene_of(cases[0].parts, numbers, moments)
    return scene, ph.State(wxyz, omega), np.asarray(ts)


# Values


class Group(NamedTuple):
    """Cases of one compiled program: the parts, the precision, and whether they form a batch."""

    parts: tuple[Part, ...]
    dtype: str
    batch: bool

    @property
    def name(self) -> str:
        return " + ".join(part.name for part in self.parts)

    def seed(self, seed: int, k: int) -> int:
        return zlib.crc32(f"{seed} {self.name} {self.dtype} {self.batch} {k}".encode())


def judged(case: Case, dtype: str) -> tuple[Motion, float, float] | str:
    """Reference, growth of a small change per radian, and uncertainty of the reference [rad].

    If the case is excluded, the reason as a string.
    """
    nudge = 1e-8
    try:
        best = reference(case)
        check = reference(case, 3e-13, width=0.19)
        moved = [reference(case, 3e-13, 1 + nudge, width=0.19)]
        if dtype == "float32":
            other = case._replace(moments=case.moments * (1 + nudge * np.array([1, 1, -1])))
            moved.append(reference(other, 3e-13, width=0.19))
    except (Failure, OverflowError, ZeroDivisionError, FloatingPointError, ValueError) as error:
        return f"no reference: {error}"
    uncertain = float(np.max(apart(best.wxyz, check.wxyz)))
    growth = max(float(np.max(apart(check.wxyz, m.wxyz))) for m in moved) / nudge / best.angle
    if growth > CHAOTIC:
        return "chaotic"
    if uncertain > 3e-10:
        return "reference uncertain"
    return best, growth, uncertain


def results(group: Group, count: int, seed: int, longest: float) -> Iterator[dict[str, Any]]:
    """Rows, one for each case and tolerance."""
    cases, motions = [], []
    eps = float(np.finfo(group.dtype).eps)
    draws = 4 * count
    for k in range(draws):
        if len(cases) == count:
            break
        case = draw(group.parts, group.dtype, group.seed(seed, k), longest)
        found = judged(case, group.dtype)
        common = {"parts": group.name, "dtype": group.dtype, "batch": group.batch, "draw": k}
        if isinstance(found, str):
            yield common | {"left_out": found, "seed": seed}
            continue
        cases.append((k, case))
        motions.append(found)
    for first in range(0, len(cases), BATCH if group.batch else 1):
        some = cases[first : first + (BATCH if group.batch else 1)]
        for rtol in RTOLS[group.dtype]:
            begin = time.perf_counter()
            try:
                scene, state, ts = stacked([case for _, case in some], group.dtype)
                t = ph.simulate(scene, state, ts, rtol=rtol, throw=False)
            except Exception as error:
                yield {
                    "parts": group.name,
                    "dtype": group.dtype,
                    "batch": group.batch,
                    "draw": some[0][0],
                    "seed": seed,
                    "rtol": rtol,
                    "raised": f"{type(error).__name__}: {error}"[:300],
                }
                continue
            shape = (len(some), -1)
            wxyz = np.asarray(t.wxyz, float).reshape(*shape, 4)
            omega = np.asarray(t.omega_body, float).reshape(*shape, 3)
            status = np.asarray(t.status).reshape(-1)
            steps = np.asarray(t.steps).reshape(-1)
            speeds = None
            if motions[first][0].speeds.size:
                speeds = np.asarray(t.wheel_speed, float).reshape(*shape, t.wheel_speed.shape[-1])
            seconds = time.perf_counter() - begin
            for i, (k, case) in enumerate(some):
                best, growth, uncertain = motions[first + i]
                error = float(np.max(apart(wxyz[i], best.wxyz)))
                scale = np.max(np.linalg.norm(best.omega, axis=-1))
                rates = float(np.max(np.abs(omega[i] - best.omega)) / scale)
                wheel = None
                if speeds is not None:
                    own = best.speeds
                    loose = list(range(speeds.shape[-1]))
                    if own.shape[1] == speeds.shape[-1]:
                        gap = np.max(np.abs(speeds[i][:, loose] - own))
                        wheel = float(gap / max(np.max(np.abs(own)), scale))
                rounding = eps * max(4 * best.angle, best.angle**1.5) * max(1.0, growth)
                bound = ALLOWED * rtol + rounding + 2 * uncertain
                kind = "kept" if error <= bound else "beyond"
                kind = kind if status[i] == 0 else "flagged"
                yield {
                    "parts": group.name,
                    "dtype": group.dtype,
                    "batch": group.batch,
                    "draw": k,
                    "seed": seed,
                    "rtol": rtol,
                    "error": error,
                    "ratio": error / rtol,
                    "rates": rates / rtol,
                    "wheels": None if wheel is None else wheel / rtol,
                    "rounding": rounding / rtol,
                    "growth": growth,
                    "angle": best.angle,
                    "switches": len(best.switches),
                    "kind": kind,
                    "status": int(status[i]),
                    "steps": int(steps[i]),
                    "backward": bool(case.ts[-1] < case.ts[0]),
                    "seconds": seconds,
                    "smooth": all(p.smooth for p in group.parts),
                }


# Derivatives


def value_of(wxyz: Any, xp: Any) -> Any:
    """A scalar function of the attitude (4,) that does not depend on the quaternion's sign."""
    w, x, y, z = (wxyz[i] for i in range(4))
    return (
        0.7 * (1 - 2 * (y * y + z * z))
        - 0.4 * 2 * (x * y - w * z)
        + 1.1 * 2 * (x * z + w * y)
        + 0.9 * 2 * (y * z + w * x)
        - 0.6 * (1 - 2 * (x * x + y * y))
    )


def changed(case: Case, theta: Any, xp: Any) -> tuple[Any, Any, Any]:
    """A case whose moments, rates and numbers are changed by ``theta`` (5,).

    The entries are changes of the rates in units of their size, and relative changes of the first
    moment and of the gain.
    """
    size = float(np.linalg.norm(case.omega))
    omega = case.omega + size * theta[:3]
    moments = xp.asarray(case.moments) * (1 + xp.asarray([1.0, 0, 0]) * theta[3])
    if case.parts[0].name.startswith("UniformGravity.axial"):  # of equal moments
        moments = xp.asarray(case.moments) * (1 + xp.asarray([1.0, 1.0, 0]) * theta[3])
    part, n = case.parts[0], dict(case.numbers[0])
    if part.gain:
        n[part.gain] = xp.asarray(n[part.gain]) * (1 + theta[4])
    return moments, omega, (n,)


def differences(case: Case) -> tuple[np.ndarray, float]:
    """Derivatives of ``value_of`` with respect to ``theta`` by differences of references, and the
    change that Richardson's extrapolation made. Raises ``Failure``.
    """
    step = 1e-3 / case.angle
    counts = set()

    def value(theta):
        moments, omega, numbers = changed(case, theta, np)
        numbers = tuple(rounded(n, "float64") for n in numbers)
        other = case._replace(moments=moments, omega=omega, numbers=numbers)
        found = reference(other, 3e-14)
        counts.add(len(found.switches))
        return value_of(found.wxyz[-1], np)

    fine, coarse = np.zeros(5), np.zeros(5)
    for i in range(5 if case.parts[0].gain else 4):
        unit = step * np.eye(5)[i]
        a, b, c, d, e, f = (value(k * unit) for k in (-4, -2, -1, 1, 2, 4))
        fine[i] = (8 * (d - c) - (e - b)) / (12 * step)
        coarse[i] = (8 * (e - b) - (f - a)) / (24 * step)
    if len(counts) > 1:
        raise Failure("switches appear")
    change = (fine - coarse) / 15
    return fine + change, float(np.linalg.norm(change))


def derivatives(
    part: Part, dtype: str, count: int, seed: int, longest: float
) -> Iterator[dict[str, Any]]:
    """Rows of the derivatives of a part, one for each case, mode and tolerance."""
    group = Group((part,), dtype, False)
    programs: dict[str, Any] = {}
    done = 0
    for k in range(3 * count):
        if done == count:
            break
        case = draw(group.parts, dtype, group.seed(seed + 1000, k), longest)
        if isinstance(judged(case, dtype), str):
            continue
        try:
            exact, uncertain = differences(case)
        except (Failure, OverflowError, ZeroDivisionError, ValueError):
            continue
        done += 1

        def loss(theta, case_arrays, rtol, times=None):
            numbers, moments, wxyz, omega, ts = case_arrays
            own = Case((part,), numbers, moments, wxyz, omega, ts)
            size = jnp.linalg.norm(omega)
            rates = omega + size * theta[:3]
            pair = part.name.startswith("UniformGravity.axial")
            mask = jnp.asarray([1.0, 1.0 if pair else 0.0, 0.0], dtype)
            n = dict(own.numbers[0])
            if part.gain:
                n[part.gain] = n[part.gain] * (1 + theta[4])
            scene = scene_of((part,), (n,), moments * (1 + mask * theta[3]))
            state = ph.State(wxyz, rates)
            t = ph.simulate(scene, state, ts if times is None else times, rtol=rtol, throw=False)
            return value_of(t.wxyz[-1], jnp), t.status

        ts = np.asarray(case.ts, dtype)
        arrays = (
            tuple(jax.tree.map(jnp.asarray, typed(n, dtype)) for n in case.numbers),
            *(jnp.asarray(x, dtype) for x in (case.moments, case.wxyz, case.omega, ts)),
        )
        for mode, transform in (("reverse", jax.jacrev), ("forward", jax.jacfwd)):
            if mode not in programs:
                fn = transform(loss, has_aux=True)
                programs[mode] = fn if part.rate is not None else jax.jit(fn)
            for rtol in RTOLS[dtype]:
                extra = (ts,) if part.rate is not None else ()
                given = rtol if part.rate is not None else jnp.asarray(rtol)
                found, status = programs[mode](jnp.zeros(5, dtype), arrays, given, *extra)
                size = max(1.0, float(np.linalg.norm(exact)))
                error = float(np.linalg.norm(np.asarray(found, float) - exact)) / size
                yield {
                    "derivative": mode,
                    "parts": part.name,
                    "dtype": dtype,
                    "draw": k,
                    "seed": seed,
                    "rtol": rtol,
                    "error": error,
                    "ratio": error / rtol,
                    "size": size,
                    "uncertain": uncertain / size,
                    "status": int(status),
                    "angle": case.angle,
                    "smooth": part.smooth,
                }


# Tables


def table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Counts by part; a pair counts for both of its parts."""
    names = dict.fromkeys(name for row in rows for name in row["parts"].split(" + "))
    found = []
    for name in names:
        own = [r for r in rows if name in r["parts"].split(" + ") and "derivative" not in r]
        ran = [r for r in own if "kind" in r]
        kinds = [r["kind"] for r in ran]
        good = [r for r in ran if r["kind"] != "flagged"]
        worst = max(good, key=lambda r: r["ratio"], default=None)
        found.append(
            {
                "part": name,
                "runs": len(ran),
                "kept": kinds.count("kept"),
                "flagged": kinds.count("flagged"),
                "beyond": kinds.count("beyond"),
                "left_out": sum("left_out" in r for r in own),
                "raised": sum("raised" in r for r in own),
                "median": float(np.median([r["ratio"] for r in good])) if good else None,
                "worst": worst and worst["ratio"],
                "worst_case": worst
                and {k: worst[k] for k in ("parts", "dtype", "batch", "draw", "seed", "rtol")},
            }
        )
    return found


def value_counts(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Outcomes by precision, of parts alone and in pairs."""
    found = []
    for dtype, pairs in itertools.product(RTOLS, (False, True)):
        values = [r for r in rows if "derivative" not in r]
        own = [r for r in values if r.get("dtype") == dtype and (" + " in r["parts"]) == pairs]
        ran = [r for r in own if "kind" in r]
        good = [r["ratio"] for r in ran if r["kind"] != "flagged"]
        found.append(
            {
                "dtype": dtype,
                "parts": "in pairs" if pairs else "alone",
                "runs": len(ran),
                "beyond": sum(r["kind"] == "beyond" for r in ran),
                "flagged": sum(r["kind"] == "flagged" for r in ran),
                "raised": sum("raised" in r for r in own),
                "median": float(np.median(good)) if good else None,
                "worst": max(good, default=None),
                "left_out": sum("left_out" in r for r in own),
            }
        )
    return found


def slope_counts(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Errors of derivatives over rtol, by rtol, for smooth parts and for parts with switches.

    A derivative that is NaN counts as flagged.
    """
    found = []
    tolerances = [(dtype, rtol) for dtype, rtols in RTOLS.items() for rtol in rtols]
    for smooth, (dtype, rtol) in itertools.product((True, False), tolerances):
        kind = smooth, dtype, rtol
        slopes = [r for r in rows if "derivative" in r]
        own = [r for r in slopes if (r["smooth"], r["dtype"], r["rtol"]) == kind]
        good = [r["ratio"] for r in own if r["status"] == 0 and math.isfinite(r["ratio"])]
        found.append(
            {
                "parts": "smooth" if smooth else "with switches",
                "dtype": dtype,
                "rtol": rtol,
                "runs": len(own),
                "flagged": len(own) - len(good),
                "median": float(np.median(good)) if good else None,
                "worst": max(good, default=None),
            }
        )
    return found


def derivative_table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    found = []
    slopes = [r for r in rows if "derivative" in r and r["status"] == 0]
    some = [r for r in slopes if math.isfinite(r["ratio"])]
    for name, dtype in dict.fromkeys((r["parts"], r["dtype"]) for r in some):
        for mode in ("forward", "reverse"):
            own = [
                r for r in some if (r["parts"], r["dtype"], r["derivative"]) == (name, dtype, mode)
            ]
            if not own:
                continue
            worst = max(own, key=lambda r: r["ratio"])
            found.append(
                {
                    "part": name,
                    "dtype": dtype,
                    "mode": mode,
                    "runs": len(own),
                    "median": float(np.median([r["ratio"] for r in own])),
                    "worst": worst["ratio"],
                    "worst_case": {k: worst[k] for k in ("draw", "seed", "rtol")},
                    "smooth": worst["smooth"],
                }
            )
    return found


def groups(pairs: int, seed: int, words: list[str]) -> list[Group]:
    """Every part alone, in both precisions and in a batch, then random pairs."""
    rng = np.random.default_rng([seed, 7])
    found = []
    found += [Group((part,), "float64", False) for part in PARTS]
    found += [Group((part,), "float32", part.batched) for part in PARTS]
    found += [Group((part,), "float64", True) for part in PARTS if part.batched]
    while pairs:
        i, j = rng.choice(np.arange(1, len(PARTS)), 2, replace=False)
        pair = (PARTS[i], PARTS[j])
        if not fits(pair) or any(p.name.endswith("narrow") for p in pair):
            continue
        batched = all(p.batched for p in pair) and bool(rng.random() < 0.5)
        found.append(Group(pair, "float32" if pairs % 4 == 0 else "float64", batched))
        pairs -= 1
    if words:
        found = [g for g in found if any(w.lower() in g.name.lower() for w in words)]
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=12, help="of each group")
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--derivatives", type=int, default=3, help="cases of each part")
    parser.add_argument("--quick", action="store_true", help="3 scenes, 30 radians, no pairs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--parts", nargs="*", default=[], metavar="WORD")
    parser.add_argument("--lines", type=Path)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    count, pairs, slopes, longest = given.scenes, given.pairs, given.derivatives, 1000.0
    if given.quick:
        count, pairs, slopes, longest = 3, 0, min(1, slopes), 30.0
    rows: list[dict[str, Any]] = []
    lines: Path | None = given.lines
    if lines is not None and lines.exists():
        rows = [json.loads(line) for line in lines.read_text().splitlines()]
    done = {row["done"] for row in rows if "done" in row}
    rows = [row for row in rows if "done" not in row]

    def note(row):
        if "done" not in row:
            rows.append(row)
        if lines is not None:
            with lines.open("a") as file:
                file.write(json.dumps(row) + "\n")

    tasks = [
        (f"{g.name} {g.dtype} {g.batch}", results(g, count, given.seed, longest))
        for g in groups(pairs, given.seed, given.parts)
    ]
    for part in PARTS if slopes else []:
        if not given.parts or any(w.lower() in part.name.lower() for w in given.parts):
            for dtype in RTOLS:
                cases = derivatives(part, dtype, slopes, given.seed, 100.0)
                tasks.append((f"d {part.name} {dtype}", cases))
    for name, rest in tasks:
        if name in done:
            continue
        begin, own = time.perf_counter(), []
        for row in rest:
            note(row)
            own.append(row)
        note({"done": name})
        ratios = [r["ratio"] for r in own if "ratio" in r]
        kinds = [r.get("kind", "raised" if "raised" in r else "") for r in own]
        print(
            f"{name}: {len(ratios)} runs, {kinds.count('flagged')} flagged,"
            f" {kinds.count('beyond')} beyond, {kinds.count('raised')} raised, worst"
            f" {max(ratios, default=0):.3g} rtol, {time.perf_counter() - begin:.0f} s",
            flush=True,
        )
        jax.clear_caches()
        eqx.clear_caches()
    numbers = {
        "values": value_counts(rows),
        "slopes": slope_counts(rows),
        "parts": table(rows),
        "derivatives": derivative_table(rows),
    }
    _report.write("fuzz", numbers, path=given.output, packages=("scipy",))


if __name__ == "__main__":
    main()
