"""Reference solutions of the problems: Taylor series in fixed-point arithmetic of 40 digits.

    python -m benchmarks.truth [--check]

writes benchmarks/truth/<problem>.npz for the first bodies of every problem: attitude and rates at
some of the saved times, rounded to float64. Neither the package nor elliptic functions are used:
Euler's equations, the quaternion and the direction of the field in body axes are expanded in time,
and the step follows from the last coefficients. A free body over a long time is propagated by whole
periods of its rates, each of which rotates it by the same angle about its angular momentum. The
period is mpmath's complete elliptic integral, and is verified by the return of the rates.

``--check`` computes the first two bodies of each problem with 10 more digits and compares.
"""

import argparse
import math
from dataclasses import replace
from functools import cache
from operator import mul
from pathlib import Path

import numpy as np

from benchmarks._formulas import multiply
from benchmarks.problems import DIRECTION, PROBLEMS, SATELLITE, Problem

FOLDER = Path(__file__).with_name("truth")
BODIES = 20
DIGITS = 36
_GUARD = 14


def truth(problem: Problem) -> dict[str, np.ndarray]:
    """``wxyz`` (bodies, k, 4), ``omega`` (bodies, k, 3) at the saved times ``index`` (k,)."""
    path = FOLDER / f"{problem.name}.npz"
    if not path.exists():
        raise FileNotFoundError(f"{path.name} is missing: run python -m benchmarks.truth")
    return dict(np.load(path))


def saved(problem: Problem) -> np.ndarray:
    """Indices of the saved times that are scored: at most ten."""
    return np.unique(np.ceil(np.arange(1, 11) * problem.saves / 10).astype(int)) - 1


def make(problem: Problem, bodies: int = BODIES, digits: int = DIGITS) -> dict[str, np.ndarray]:
    """Compute the files that ``truth`` reads."""
    index = saved(problem)
    times = problem.times[1:][index]
    wxyz, omega = problem.states(bodies)
    found = [motion(problem, q, w, times, digits) for q, w in zip(wxyz, omega)]
    values = np.array([[[float(x) for x in state] for state in body] for body in found])
    q, w = values[..., :4], values[..., 4:]
    return {"index": index, "wxyz": q, "omega": w}


def motion(problem: Problem, wxyz, omega, times, digits: int = DIGITS, moments=None) -> list[list]:
    """States (wxyz, omega) at the times, as mpmath numbers; floats are treated as exact.

    ``moments``: moments of inertia that replace those of the problem, as mpmath numbers.
    """
    import mpmath as mp

    with mp.workdps(digits + _GUARD):
        moments = [mp.mpf(m) for m in (problem.moments if moments is None else moments)]
        q = [_number(x) for x in wxyz]
        norm = mp.sqrt(mp.fdot(q, q))
        q = [x / norm for x in q]
        w = [_number(x) for x in omega]
        up = [mp.mpf(0), mp.mpf(0), mp.mpf(1)]
        if problem.gradient:
            up = [mp.mpf(x) for x in DIRECTION]
            size = mp.sqrt(mp.fdot(up, up))
            up = [x / size for x in up]
        if problem.free and times[-1] > 1e4:
            return [_long(moments, q, w, mp.mpf(float(t)), digits) for t in times]
        body = _Series(moments, mp.mpf(problem.weight), mp.mpf(problem.gradient), digits)
        body.drag = [mp.mpf(problem.damping) / m for m in moments] if problem.damping else None
        body.push = [mp.mpf(p) / m for p, m in zip(problem.push, moments)]
        state, now, out = [*q, *w, *_to_body(q, up)], mp.mpf(0), []
        for t in times:
            state = body.advance(state, mp.mpf(float(t)) - now)
            now = mp.mpf(float(t))
            out.append(state[:7])
        return out


def _number(x):
    import mpmath as mp

    return x if isinstance(x, mp.mpf) else mp.mpf(float(x))


def _to_body(q, v):
    """R(q)^T v."""
    w, x, y, z = q
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return [sum(rows[j][i] * v[j] for j in range(3)) for i in range(3)]


class _Series:
    """Taylor steps of (wxyz, omega, field direction in body axes)."""

    def __init__(self, moments, weight, gradient, digits):
        import mpmath as mp

        self.mp, self.digits = mp, digits
        self.bits = math.ceil((digits + _GUARD) * math.log2(10))
        self.order = math.ceil(1.2 * digits)
        a, b, c = moments
        self.euler = [(b - c) / a, (c - a) / b, (a - b) / c]
        self.weight = [weight / a, -weight / b] if weight else None
        self.gradient = None
        if gradient:
            self.gradient = [gradient * (c - b) / a, gradient * (a - c) / b, gradient * (b - a) / c]
        self.drag, self.push = None, [mp.mpf(0)] * 3  # over the moments
        self.unit = mp.mpf(1) / 4  # of time; adapted to the motion

    def advance(self, state, span):
        """The state after ``span`` [s]."""
        mp = self.mp
        while span > 0:
            series = self._coefficients(state, self.unit)
            last = max(abs(row[-k]) for row in series for k in (1, 2))
            size = mp.ldexp(mp.mpf(last), -self.bits)
            limit = mp.mpf(10) ** -(self.digits + 2)
            share = mp.mpf(2) if size == 0 else (limit / size) ** (mp.mpf(1) / self.order)
            if share < mp.mpf(1) / 2:  # the coefficients exceed the range of the fixed point
                self.unit = self.unit * share
                continue
            step = min(share * self.unit, self.unit, span)
            x = step / self.unit
            state = [
                mp.ldexp(mp.mpf(_horner(row, self._fixed(x), self.bits)), -self.bits)
                for row in series
            ]
            span -= step
            if share > 1:
                self.unit = self.unit * min(share, mp.mpf("1.3"))
        return state

    def _fixed(self, value) -> int:
        return int(self.mp.nint(self.mp.ldexp(value, self.bits)))

    def _coefficients(self, state, unit):
        """Fixed-point Taylor coefficients of the ten components, in units of time ``unit``."""
        bits, fixed = self.bits, self._fixed
        rows = [[fixed(x)] for x in state]
        q0, q1, q2, q3, x, y, z, a, b, c = rows
        unit_ = fixed(unit)
        euler = [fixed(k) for k in self.euler]
        weight = None if self.weight is None else [fixed(k) for k in self.weight]
        gradient = None if self.gradient is None else [fixed(k) for k in self.gradient]
        drag = None if self.drag is None else [fixed(k) for k in self.drag]
        push = [fixed(k) for k in self.push]
        for n in range(self.order):

            def product(u, v, n=n):
                return sum(map(mul, u[: n + 1], v[n::-1])) >> bits

            rates = [euler[0] * product(y, z), euler[1] * product(z, x), euler[2] * product(x, y)]
            if weight is not None:
                rates[0] += weight[0] * b[n]
                rates[1] += weight[1] * a[n]
            if gradient is not None:
                for i, (u, v) in enumerate(((b, c), (c, a), (a, b))):
                    rates[i] += gradient[i] * product(u, v)
            if drag is not None:
                for i, v in enumerate((x, y, z)):
                    rates[i] -= drag[i] * v[n]
            if n == 0:
                rates = [r + (p << bits) for r, p in zip(rates, push)]
            slopes = [
                -(product(q1, x) + product(q2, y) + product(q3, z)) >> 1,
                product(q0, x) + product(q2, z) - product(q3, y) >> 1,
                product(q0, y) + product(q3, x) - product(q1, z) >> 1,
                product(q0, z) + product(q1, y) - product(q2, x) >> 1,
                *(rate >> bits for rate in rates),
                product(b, z) - product(c, y),
                product(c, x) - product(a, z),
                product(a, y) - product(b, x),
            ]
            for row, slope in zip(rows, slopes):
                row.append((slope * unit_ >> bits) // (n + 1))
        return rows


def _horner(row, x, bits):
    total = 0
    for coefficient in reversed(row):
        total = (total * x >> bits) + coefficient
    return total


def _long(moments, q, w, t, digits):
    """Propagate a free body over many periods of its rates."""
    import mpmath as mp

    body = _Series(moments, mp.mpf(0), mp.mpf(0), digits)
    zero = [mp.mpf(0)] * 3
    period = _period(moments, w)
    count = int(t / period)
    once = body.advance([*q, *w, *zero], period)
    if max(abs(a - b) for a, b in zip(once[4:7], w)) > mp.mpf(10) ** (4 - digits):
        raise ArithmeticError("the rates did not return after one period")
    # each period multiplies the attitude by the same rotation in space
    turn = multiply(once[:4], [q[0], -q[1], -q[2], -q[3]])
    half = mp.atan2(mp.sqrt(mp.fdot(turn[1:], turn[1:])), turn[0])
    axis = [x / mp.sqrt(mp.fdot(turn[1:], turn[1:])) for x in turn[1:]]
    whole = [mp.cos(count * half), *(mp.sin(count * half) * x for x in axis)]
    return body.advance([*multiply(whole, q), *w, *zero], t - count * period)[:7]


def _period(moments, w):
    """Period of the body rates, in mpmath."""
    import mpmath as mp

    order = sorted(range(3), key=lambda k: moments[k])
    a, b, c = (moments[k] for k in order)
    x, y, z = (w[k] for k in order)
    # L^2 - 2 T I of the smallest and largest axes, without cancellation
    low = b * (b - a) * y**2 + c * (c - a) * z**2
    high = a * (c - a) * x**2 + b * (c - b) * y**2
    first, second = (b - a) * high, (c - b) * low
    parameter = min(first, second) / max(first, second)
    return 4 * mp.ellipk(parameter) * mp.sqrt(a * b * c / max(first, second))


@cache
def slopes(
    problem: Problem, bodies: int, weights: tuple, digits: int = 40, by: str = "moments"
) -> np.ndarray:
    """Derivatives (bodies, k) of ``weights . (wxyz, omega)`` at the end, exact to float64.

    ``by``: the three moments, the ``state`` (seven numbers) or the ``weight``. Central differences
    with a step of 1e-14 in arithmetic of ``digits`` digits.
    """
    import mpmath as mp

    wxyz, omega = problem.states(bodies)
    size = {"moments": 3, "state": 7, "weight": 1}[by]
    out = np.zeros((bodies, size))

    def end(n, k, change):
        given = [*problem.moments, *wxyz[n], *omega[n], problem.weight]
        given = [mp.mpf(float(x)) for x in given]
        at = {"moments": 0, "state": 3, "weight": 10}[by] + k
        given[at] += change
        body = replace(problem, weight=given[10])
        start = given[3:7], given[7:10]
        state = motion(body, *start, [problem.horizon], digits, given[:3])[-1]
        return sum(mp.mpf(float(a)) * b for a, b in zip(weights, state))

    with mp.workdps(digits + _GUARD):
        step = mp.mpf(10) ** -14
        for n in range(bodies):
            for k in range(size):
                out[n, k] = float((end(n, k, step) - end(n, k, -step)) / (2 * step))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    known = PROBLEMS | {SATELLITE.name: SATELLITE}
    parser.add_argument("problems", nargs="*", default=list(known))
    parser.add_argument("--check", action="store_true", help="compare with more digits, write none")
    options = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    for name in options.problems:
        problem = known[name]
        if options.check:
            old, new = truth(problem), make(problem, 2, DIGITS + 10)
            apart = max(float(np.abs(old[k][:2] - new[k]).max()) for k in ("wxyz", "omega"))
            print(f"{name}: {apart:.1e}", flush=True)
            if apart > 1e-15:
                raise SystemExit(f"{name}: the two differ")
        else:
            np.savez_compressed(FOLDER / f"{name}.npz", **make(problem))
            print(name, flush=True)


if __name__ == "__main__":
    main()
