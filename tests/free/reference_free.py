"""The free motion to 50 digits without elliptic functions: an independent reference for tests.

High-order Taylor series of Euler's equations and of the quaternion,

    dL/dt = L x w,   dq/dt = q (0, w) / 2,   w = I^-1 L,

with a step that follows from the last coefficients. No regime is special for this method.
Derivatives are central differences of these 50-digit solutions, accurate to 30 digits.
"""

from collections.abc import Sequence
from math import ceil, log2
from operator import mul

import mpmath as mp

DIGITS = 50
_GUARD = 15  # guard digits of the sums


def _tensor(moments, products):
    a, b, c = (mp.mpf(x) for x in moments)
    xy, xz, yz = (mp.mpf(x) for x in products)
    return mp.matrix([[a, xy, xz], [xy, b, yz], [xz, yz, c]])


def _fixed(x, bits) -> int:
    return int(mp.nint(mp.ldexp(x, bits)))


def _product(a, b, n, bits):
    return sum(map(mul, a[: n + 1], b[n::-1])) >> bits


def _step(q, momentum, inverse, left, digits):
    """One Taylor step of at most ``left``; returns the new state and the step.

    Momenta are in units of the largest, time in units of the present rate, all in fixed point.
    """
    bits, order = ceil((digits + _GUARD) * log2(10)), ceil(1.15 * digits)
    size = max(abs(x) for x in momentum)
    if size == 0:
        return q, momentum, left
    rate = mp.norm(inverse * mp.matrix(momentum))
    L, Q = [[_fixed(x / size, bits)] for x in momentum], [[_fixed(x, bits)] for x in q]
    D = [[_fixed(inverse[i, j] * size / rate, bits) for j in range(3)] for i in range(3)]
    W = [[] for _ in range(3)]
    for n in range(order):
        for i in range(3):
            W[i].append(sum(D[i][j] * L[j][n] for j in range(3)) >> bits)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            L[i].append((_product(L[j], W[k], n, bits) - _product(L[k], W[j], n, bits)) // (n + 1))
        a, b, c, d = Q
        x, y, z = W
        slopes = (
            -_product(b, x, n, bits) - _product(c, y, n, bits) - _product(d, z, n, bits),
            _product(a, x, n, bits) + _product(c, z, n, bits) - _product(d, y, n, bits),
            _product(a, y, n, bits) + _product(d, x, n, bits) - _product(b, z, n, bits),
            _product(a, z, n, bits) + _product(b, y, n, bits) - _product(c, x, n, bits),
        )
        for i in range(4):
            Q[i].append(slopes[i] // (2 * (n + 1)))
    rows = [[mp.ldexp(mp.mpf(x), -bits) for x in row] for row in Q + L]
    largest = max(abs(row[n]) for row in rows for n in (order - 1, order))
    # At most a radian, to limit the growth of rounding errors of the coefficients.
    step = min(abs(left) * rate, mp.mpf(1))
    if largest > 0:
        step = min(step, (mp.mpf(10) ** -digits / largest) ** (mp.mpf(1) / order))
    step = mp.sign(left) * step
    new = [mp.polyval(row[::-1], step) for row in rows]
    taken = left if abs(step) == abs(left) * rate else step / rate
    return new[:4], [x * size for x in new[4:]], taken


def free_reference(
    moments: Sequence,
    wxyz: Sequence,
    omega: Sequence,
    t,
    products: Sequence = (0, 0, 0),
    digits: int = DIGITS,
) -> tuple[list, list]:
    """Attitude and body rates at time t, as mpmath numbers.

    The inputs are treated as exact (floats, mpmath numbers or strings); ``products`` are the
    entries xy, xz, yz of the inertia tensor. The attitude is normalised first.
    """
    with mp.workdps(digits + 10):
        tensor = _tensor(moments, products)
        inverse = tensor**-1
        q = [mp.mpf(x) for x in wxyz]
        size = mp.sqrt(mp.fdot(q, q))
        q = [x / size for x in q]
        momentum = list(tensor * mp.matrix([mp.mpf(x) for x in omega]))
        left = mp.mpf(t)
        while left != 0:
            q, momentum, step = _step(q, momentum, inverse, left, digits)
            left -= step
        return q, list(inverse * mp.matrix(momentum))


def free_jacobian(moments, wxyz, omega, t, digits: int = DIGITS) -> list[list]:
    """Rows: derivatives of (wxyz, omega) by 3 moments, 3 products, 3 initial rates, the time."""
    with mp.workdps(digits + 10):
        scale = max(mp.mpf(x) for x in moments)
        pace = max(abs(mp.mpf(x)) for x in omega) or mp.mpf(1)
        base = [list(map(mp.mpf, moments)), [mp.mpf(0)] * 3, list(map(mp.mpf, omega)), [mp.mpf(t)]]
        units = (scale, scale, pace, 1 / pace)
        rows = []
        for part, unit in enumerate(units):
            for k in range(len(base[part])):
                ends = []
                h = unit * mp.mpf(10) ** -(digits // 3)
                if part == 0:
                    h = base[0][k] * mp.mpf(10) ** -(digits // 3)
                for sign in (1, -1):
                    moved = [list(x) for x in base]
                    moved[part][k] += sign * h
                    q, w = free_reference(moved[0], wxyz, moved[2], moved[3][0], moved[1], digits)
                    ends.append(q + w)
                rows.append([(a - b) / (2 * h) for a, b in zip(*ends, strict=True)])
        return rows
