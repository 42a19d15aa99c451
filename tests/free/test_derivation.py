"""The formulas of docs/free_motion.md against quadrature in 30 digits, without the package."""

import mpmath as mp
import pytest


@pytest.mark.parametrize(
    ("moments", "start"),
    [
        ((3, 2, 1), ("0.4", "0", "1.1")),  # about the smallest moment
        ((1, 2, 3), ("0.4", "0", "1.1")),  # about the largest, m = 0.04
        ((1, 2, "2.2"), ("0.55", "0", "1.9")),  # m = 0.91
    ],
)
def test_the_angle_about_the_momentum(moments, start):
    """(8) with (4), integrated numerically, is (10); its mean rate is (13)."""
    with mp.workdps(30):
        d1, d2, d3 = (1 / mp.mpf(i) for i in moments)
        l1, _, l3 = map(mp.mpf, start)
        sigma = 1 if d3 < d1 else -1
        p, r, s = abs(d1 - d2), abs(d2 - d3), abs(d1 - d3)
        A, B, length = s * l1**2, s * l3**2, mp.hypot(l1, l3)
        m, frequency = A * p / (B * r), mp.sqrt(B * r)
        assert 0 < m < 1
        K, q = mp.ellipk(m), mp.qfrom(m=m)

        def dn(u):
            return mp.ellipfun("dn", u, m=m)

        def rate(t):
            return d3 * length + sigma * A / (length + l3 * dn(frequency * t))

        beta = mp.findroot(lambda x: mp.re(dn(1j * x)) - length / l3, mp.mpf("0.5"))
        b = mp.pi * beta / (2 * K)

        def arg(v):
            return mp.arg(mp.jtheta(4, v + 1j * b, q**2))

        mean = mp.pi / (2 * K)
        slow = rate(0) / 2 + sigma * mean * frequency * mp.diff(arg, 0)
        for t in (mp.mpf("0.7"), mp.mpf("2.9")):
            half = mp.quad(rate, [0, t / 2, t]) / 2
            gap = half - (slow * t - sigma * arg(mean * frequency * t))
            assert abs(gap - mp.pi * mp.nint(gap / mp.pi)) < mp.mpf(10) ** -15
        # the smallest rotation differs from Euler's angle by zero or one turn in each period of L
        euler = length * (d3 + sigma * s * mp.ellippi(-p / r, m) / K)
        turns = (2 * slow - euler) * 4 * K / frequency / (2 * mp.pi)
        assert abs(turns - mp.nint(turns)) < mp.mpf(10) ** -15
