"""Reference motions with switches: SciPy's DOP853, restarted at every kink or jump of the field.

The equations are ``field(t, y, levels)`` with ``margins(t, y)``. A level states whether its margin
is positive; for constant levels the field is smooth. Each step is searched for sign changes of the
margins, also for those between samples, where an extremum crosses zero. The step is then repeated
at full accuracy up to the root.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq, minimize_scalar

SAMPLES = 8
"""Number of samples of the margins within a step, to find sign changes."""


class Failure(Exception):
    """A motion without a reference: it slides along a switch, diverges or takes too long."""


class Reference:
    """Integration of ``field(t, y, levels)`` with tolerance ``rtol`` relative to ``scale`` (n,).

    ``switches``: times at which a level changed, with its number; ``longest``: the largest step.
    """

    def __init__(
        self,
        field: Callable[[float, np.ndarray, Sequence[bool]], np.ndarray],
        margins: Callable[[float, np.ndarray], Sequence[float]],
        scale: np.ndarray,
        longest: float,
        rtol: float = 1e-13,
        evaluations: int = 400_000,
    ):
        self.field, self.margins = field, margins
        self.scale, self.longest, self.rtol = np.asarray(scale, float), longest, rtol
        self.left = evaluations
        self.switches: list[tuple[float, int]] = []

    def levels(self, t: float, y: np.ndarray) -> list[bool]:
        """Levels at a point."""
        found = np.asarray(self.margins(t, y), float)
        return [bool(g > 0) for g in found]

    def run(self, t: float, y: np.ndarray, end: float, levels: list[bool]) -> np.ndarray:
        """The state at ``end``; ``levels`` are updated in place."""
        y, again = np.asarray(y, float), 0
        while t != end:
            begin = t
            t, y, flips = self._until_switch(t, y, end, levels)
            for k in flips:
                levels[k] = not levels[k]
                self.switches.append((t, k))
            again = again + 1 if flips and abs(t - begin) < 1e-9 * self.longest else 0
            if again > 8:
                raise Failure("slides along a switch")
        return y

    def _solver(self, t, y, end, levels, first=None) -> DOP853:
        def field(t, y):
            self.left -= 1
            if self.left < 0:
                raise Failure("takes too long")
            return self.field(t, y, levels)

        if first is not None:
            first = min(first, abs(end - t))
        return DOP853(
            field,
            t,
            y,
            end,
            max_step=self.longest,
            rtol=self.rtol,
            atol=self.rtol * self.scale,
            first_step=first,
        )

    def _step(self, solver: DOP853) -> None:
        message = solver.step()
        if solver.status == "failed" or not np.all(np.isfinite(solver.y)):
            raise Failure(message or "diverges")

    def _until_switch(self, t, y, end, levels) -> tuple[float, np.ndarray, list[int]]:
        solver = self._solver(t, y, end, levels)
        while solver.status == "running":
            before = solver.y.copy()
            self._step(solver)
            if not levels:
                continue
            found = self._first(solver, levels)
            if found is None:
                continue
            place, which = found
            start: Any = solver.t_old
            state = before
            if place != start:
                inner = self._solver(start, before, place, levels, abs(place - start))
                while inner.status == "running":
                    self._step(inner)
                state = inner.y
            return *self._polished(place, state, levels, which), which
        return end, solver.y, []

    def _polished(self, t, y, levels, which) -> tuple[float, np.ndarray]:
        """One Newton step to the root of the first margin."""
        rate = self.field(t, y, levels)
        h = 1e-6 * self.longest
        g, after, before = (self.margins(t + s, y + s * rate)[which[0]] for s in (0.0, h, -h))
        slope = (after - before) / (2 * h)
        if slope:
            change = -g / slope
            if abs(change) < 1e-4 * self.longest:
                return t + change, y + change * rate
        return t, y

    def _first(self, solver: DOP853, levels) -> tuple[float, list[int]] | None:
        """Time and indices of the margins that change sign first within the step."""
        dense = solver.dense_output()
        begin, width = solver.t_old, solver.t - solver.t_old

        def value(x: float) -> np.ndarray:
            t = begin + x * width
            sign = np.where(levels, 1, -1)
            return sign * np.asarray(self.margins(t, dense(t)), float)

        places = np.linspace(0, 1, SAMPLES + 1)
        rows = np.array([value(x) for x in places])
        roots: list[tuple[float, int]] = []
        for k in range(rows.shape[1]):
            g = rows[:, k]
            scale = np.max(np.abs(g))
            if scale == 0:
                continue
            if g[0] <= 1e-9 * scale:  # a root at the start: sample slightly later for the sign
                low = 1e-7
                if value(low)[k] < 0:
                    roots.append((0.0, k))
                    continue
            else:
                low = 0.0
            root = None
            for i in range(SAMPLES):
                left = max(places[i], low)
                if g[i + 1] < 0:
                    root = brentq(lambda x, k=k: value(x)[k], left, places[i + 1], xtol=1e-15)
                    break
                if i > 0 and g[i] < g[i - 1] and g[i] <= g[i + 1]:
                    root = self._dip(value, k, places[i - 1 : i + 2], low)
                    if root is not None:
                        break
            # an extremum in the first or last interval is not enclosed by three samples
            if root is None and g[-1] < g[-2] and value(1 - 1e-4)[k] < g[-1]:
                root = self._dip(value, k, (places[-2], 0, places[-1]), low)
            if root is None and g[1] > g[0] and value(low + 1e-4)[k] < value(low)[k]:
                root = self._dip(value, k, (low, 0, places[1]), low)
            if root is not None:
                roots.append((root, k))
        if not roots:
            return None
        first = min(x for x, _ in roots)
        return begin + first * width, [k for x, k in roots if x - first <= 1e-13]

    def _dip(self, value, k, bounds, low) -> float | None:
        """First root of a margin that is positive at both bounds; None if there is none."""
        a, b = max(bounds[0], low), bounds[-1]
        found: Any = minimize_scalar(
            lambda x: value(x)[k], bounds=(a, b), method="bounded", options={"xatol": 1e-9}
        )
        if found.fun >= 0:
            return None
        if value(a)[k] <= 0:
            return a
        root: Any = brentq(lambda x: value(x)[k], a, found.x, xtol=1e-15)
        return root


# Vectors are tuples: scalar arithmetic is several times faster than NumPy on small arrays.

Vector = Any


def cross(a: Vector, b: Vector) -> tuple[float, float, float]:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def scaled(k: float, a: Vector) -> tuple[float, float, float]:
    return k * a[0], k * a[1], k * a[2]


def total(*vectors: Vector) -> tuple[float, float, float]:
    return tuple(map(sum, zip(*vectors)))  # pyright: ignore[reportReturnType]


def norm(a: Vector) -> float:
    return math.sqrt(dot(a, a))


def matrix(q: Vector) -> tuple[tuple[float, float, float], ...]:
    """Rows of R, body -> space, of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def to_body(rows: Vector, v: Vector) -> tuple[float, float, float]:
    """R^T v."""
    return tuple(rows[0][i] * v[0] + rows[1][i] * v[1] + rows[2][i] * v[2] for i in range(3))  # pyright: ignore[reportReturnType]


def anomaly(mean: float, e: float) -> float:
    """Eccentric anomaly of an ellipse, hyperbolic anomaly for e > 1, by Newton's method within a
    bracket.
    """
    if e < 1:
        whole = 2 * math.pi * round(mean / (2 * math.pi))
        m = mean - whole
        low, high, x = -math.pi - 1, math.pi + 1, m if e < 0.8 else math.copysign(math.pi, m)
    else:
        whole, m, low, high, x = 0.0, mean, -700.0, 700.0, math.asinh(mean / e)
    for _ in range(200):
        if e < 1:
            f, slope = x - e * math.sin(x) - m, 1 - e * math.cos(x)
        else:
            f, slope = e * math.sinh(x) - x - m, e * math.cosh(x) - 1
        low, high = (low, x) if f > 0 else (x, high)
        new = x - f / slope
        if not low <= new <= high:
            new = (low + high) / 2
        if abs(new - x) <= 2e-16 * abs(x):
            x = new
            break
        x = new
    return x + whole
