"""Elliptic functions in mpmath from definitions other than those of the library.

Jacobi's functions by the descending amplitude recursion of the arithmetic-geometric mean (DLMF
22.20(ii)); the integrals by mpmath's own Carlson forms (DLMF 19.25). Every argument is a float and
taken as exact; of the pair (m, m1) the smaller one is, and the other is one minus it.
"""

import math

import mpmath as mp

DIGITS = 40


def parameter(m, m1):
    """(m, 1 - m) in mpmath from the smaller of two floats; raises the precision to hold both."""
    small = min(m, m1)
    lost = -math.log10(small) if 0 < small < 1e-3 else 0
    mp.mp.dps = DIGITS + int(2.2 * lost)
    if m <= m1:
        return mp.mpf(m), 1 - mp.mpf(m)
    return 1 - mp.mpf(m1), mp.mpf(m1)


def jacobi(u, m, m1):
    """sn, cn, dn, am."""
    x, x1 = parameter(m, m1)
    mp.mp.dps += int(max(0, math.log10(abs(u) + 1)))
    return jacobi_of(mp.mpf(u), x, x1)


def jacobi_of(u, x, x1):
    if x1 == 0:
        s, c = mp.tanh(u), mp.sech(u)
        return s, c, c, 2 * mp.atan(mp.tanh(u / 2))
    a, g, c = mp.mpf(1), mp.sqrt(x1), mp.sqrt(x)
    levels = []
    while abs(c) > mp.eps * a:
        a, g, c = (a + g) / 2, mp.sqrt(a * g), (a - g) / 2
        levels.append(c / a)
    angle = mp.ldexp(a * u, len(levels))
    for ratio in reversed(levels):
        angle = (angle + mp.asin(ratio * mp.sin(angle))) / 2
    s, c = mp.sin(angle), mp.cos(angle)
    return s, c, mp.sqrt(c * c + x1 * s * s), angle


def first_of(s, c, x, x1):
    """F for s, c of a quarter turn (c >= 0), normalised or not."""
    return s * mp.elliprf(c * c, c * c + x1 * s * s, c * c + s * s)


def second_of(s, c, x, x1):
    r = mp.sqrt(s * s + c * c)
    s, c = s / r, c / r
    d2 = c * c + x1 * s * s
    if d2 == 0:
        return s
    whole = s * mp.elliprf(c * c, d2, 1) + x * s**3 / 3 * mp.elliprd(c * c, 1, d2)
    return x1 * whole + x * s * c / mp.sqrt(d2)


def third_of(n, s, c, x, x1):
    d2, r2 = c * c + x1 * s * s, c * c + s * s
    # Far below zero the two terms cancel: half as many digits more as the characteristic has.
    mp.mp.dps += int(2 * math.log10(abs(float(n)) + 1)) + 5
    value = s * mp.elliprf(c * c, d2, r2)
    return value + n * s**3 / 3 * mp.elliprj(c * c, d2, r2, r2 - n * s * s)


def ellipk(m, m1):
    x, x1 = parameter(m, m1)
    return first_of(mp.mpf(1), mp.mpf(0), x, x1)


def ellipe(m, m1):
    x, x1 = parameter(m, m1)
    return second_of(mp.mpf(1), mp.mpf(0), x, x1)


def associate_d(m, m1):
    _, x1 = parameter(m, m1)
    return mp.elliprd(0, x1, 1) / 3


def associate_b(m, m1):
    x, x1 = parameter(m, m1)
    return first_of(mp.mpf(1), mp.mpf(0), x, x1) - mp.elliprd(0, x1, 1) / 3


def ellippi(n, m, m1):
    x, x1 = parameter(m, m1)
    return third_of(mp.mpf(n), mp.mpf(1), mp.mpf(0), x, x1)


def associate_j(n, m, m1):
    _, x1 = parameter(m, m1)
    return mp.elliprj(0, x1, 1, 1 - mp.mpf(n)) / 3


def ellipf_sincos(s, c, m, m1):
    x, x1 = parameter(m, m1)
    return first_of(mp.mpf(s), mp.mpf(c), x, x1)


def ellipe_inc_sincos(s, c, m, m1):
    x, x1 = parameter(m, m1)
    return second_of(mp.mpf(s), mp.mpf(c), x, x1)


def ellippi_inc_sincos(n, s, c, m, m1):
    x, x1 = parameter(m, m1)
    return third_of(mp.mpf(n), mp.mpf(s), mp.mpf(c), x, x1)


def _any_angle(phi, quarter, x, x1):
    phi = mp.mpf(phi)
    turns = mp.nint(phi / mp.pi)
    value = quarter(mp.sin(phi - turns * mp.pi), mp.cos(phi - turns * mp.pi), x, x1)
    if turns == 0:
        return value
    return value + 2 * turns * quarter(mp.mpf(1), mp.mpf(0), x, x1)


def ellipf(phi, m, m1):
    return _any_angle(phi, first_of, *parameter(m, m1))


def ellipe_inc(phi, m, m1):
    return _any_angle(phi, second_of, *parameter(m, m1))


def ellippi_inc(n, phi, m, m1):
    pair = parameter(m, m1)
    return _any_angle(phi, lambda *args: third_of(mp.mpf(n), *args), *pair)


def jacobi_epsilon(u, m, m1):
    angle = jacobi(u, m, m1)[3]
    x, x1 = (mp.mpf(m), 1 - mp.mpf(m)) if m <= m1 else (1 - mp.mpf(m1), mp.mpf(m1))
    return _any_angle(angle, second_of, x, x1)


def carlson_rf(x, y, z):
    mp.mp.dps = DIGITS
    return mp.elliprf(x, y, z)


def carlson_rc(x, y):
    mp.mp.dps = DIGITS
    return mp.elliprc(x, y)


def carlson_rd(x, y, z):
    mp.mp.dps = DIGITS
    return mp.elliprd(x, y, z)


def carlson_rj(x, y, z, p):
    mp.mp.dps = DIGITS
    return mp.elliprj(x, y, z, p)
