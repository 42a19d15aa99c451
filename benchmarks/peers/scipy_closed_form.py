"""The free body's closed form in NumPy with SciPy's ellipj, ellipkinc, elliprf and elliprj.

Euler angles about the angular momentum: tilt and spin from the body rates (Jacobi functions), the
precession from Legendre's third integral through Carlson's forms; Whittaker, Analytical Dynamics,
section 69.
"""

import numpy as np
from scipy.special import ellipj, ellipk, ellipkinc, elliprf, elliprj

from benchmarks._formulas import multiply
from benchmarks.peers import Program
from benchmarks.problems import Problem

NAME = "SciPy closed form"
PACKAGES = ("scipy",)


def programs(problem: Problem, n, dtype, tolerances, quick) -> list[Program]:
    if not problem.free or dtype != np.float64:
        return []
    count = 3 if n == 1 else n
    q, w = problem.states(count)
    moments, t = np.array(problem.moments), problem.times[1:]

    def call():
        if n > 1:
            return closed_form(moments, q, w, t)
        parts = [closed_form(moments, q[i : i + 1], w[i : i + 1], t) for i in range(count)]
        return tuple(np.concatenate(part) for part in zip(*parts))

    return [Program("ellipj and elliprj", "exact", call, count)]


def closed_form(moments, q, w, t):
    """wxyz (n, T, 4) and rates (n, T, 3) at times t (T,) after the state."""
    n = len(q)
    momentum = moments * w
    size = np.linalg.norm(momentum, axis=1)
    low, middle, high = np.argsort(moments)
    above = np.sum(momentum**2, 1) > np.sum(momentum * w, 1) * moments[middle]
    c = np.where(above, high, low)  # the axis about which the momentum circulates
    a, b = np.where(above, low, high), np.full(n, middle)
    body = np.arange(n)
    hand = np.where((b - a) % 3 == 1, 1.0, -1.0)
    wa, wb, wc = w[body, a], hand * w[body, b], w[body, c]
    A, B, C = moments[a], moments[b], moments[c]

    # L^2 - 2 T C and L^2 - 2 T A as sums of terms with one sign
    excess = A * (A - C) * wa**2 + B * (B - C) * wb**2
    other = B * (B - A) * wb**2 + C * (C - A) * wc**2
    top = [np.sqrt(excess / (A * (A - C))), np.sqrt(excess / (B * (B - C)))]
    top.append(np.sqrt(other / (C * (C - A))))
    pace = np.sqrt((C - B) * other / (A * B * C))
    m = (A - B) * excess / ((C - B) * other)
    sense = np.where(wc < 0, -1.0, 1.0)
    turn = np.where(B > C, -1.0, 1.0) * sense
    start = np.arctan2(turn * wb / top[1], wa / top[0])
    quarter = ellipk(m)
    u = pace[:, None] * t + ellipkinc(start, m)[:, None]

    half_turns = np.rint(u / (2 * quarter[:, None]))
    sn, cn, dn, _ = ellipj(u - 2 * quarter[:, None] * half_turns, m[:, None])
    phase = np.arctan2(sn, cn)
    flip = np.where(half_turns % 2 == 0, 1.0, -1.0)
    rates = [top[0][:, None] * cn * flip, (turn * top[1])[:, None] * sn * flip]
    rates.append((sense * top[2])[:, None] * dn)

    third = 1 - B * (A - C) / (A * (B - C))
    first_turns = np.rint(start / np.pi)
    swept = _third(third[:, None], phase, half_turns, m[:, None])
    swept = swept - _third(third, start - np.pi * first_turns, first_turns, m)[:, None]
    angle = (size / C)[:, None] * (t - (excess / (A**2 * top[0] ** 2 * pace))[:, None] * swept)

    before = _attitude(np.zeros(n), A * wa, B * wb, C * wc)
    after = _attitude(angle, A[:, None] * rates[0], B[:, None] * rates[1], C[:, None] * rates[2])
    before[..., 1:] *= -1
    relative = _multiply(before[:, None], after)
    local = np.zeros_like(relative)
    local[..., 0] = relative[..., 0]
    found = np.empty((n, len(t), 3))
    for k, (axis, sign) in enumerate(((a, 1.0), (b, hand), (c, 1.0))):
        local[body, :, 1 + axis] = (np.broadcast_to(sign, n) * relative[..., 1 + k].T).T
        found[body, :, axis] = (np.broadcast_to(sign, n) * rates[k].T).T
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return _multiply(q[:, None], local), found


def _third(n, phase, half_turns, m):
    """Legendre's third integral over phase + pi half_turns, |phase| <= pi / 2."""
    s, c = np.sin(phase), np.cos(phase)
    rest = 1 - m * s**2
    part = s * elliprf(c**2, rest, 1) + n / 3 * s**3 * elliprj(c**2, rest, 1, 1 - n * s**2)
    whole = elliprf(0, 1 - m, 1) + n / 3 * elliprj(0, 1 - m, 1, 1 - n)
    return part + 2 * half_turns * whole


def _attitude(phi, la, lb, lc):
    """Quaternion Rz(phi) Ry(theta) Rz(psi) of a body whose momentum is along z of space."""
    theta, psi = np.arctan2(np.hypot(la, lb), lc), np.arctan2(lb, -la)
    c, s = np.cos(theta / 2), np.sin(theta / 2)
    plus, minus = (phi + psi) / 2, (phi - psi) / 2
    return np.stack(
        [c * np.cos(plus), -s * np.sin(minus), s * np.cos(minus), c * np.sin(plus)], axis=-1
    )


def _multiply(p, q):
    return np.stack(multiply(np.moveaxis(p, -1, 0), np.moveaxis(q, -1, 0)), axis=-1)
