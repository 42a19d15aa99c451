"""The free motion in closed form in arithmetic of many digits: the source of the reference data.

With the angular momentum along z and the principal axes (1, 2, 3) ordered so that the motion
circulates about axis 3 (that of the largest moment in short-axis mode, of the smallest in long-axis
mode), the rates are

    omega = (a cn u, b sn u, c dn u),   u = p t + u0,   parameter m,

and the attitude is Rz(phi) Ry(theta) Rz(psi) with cos theta = L3/L, psi = atan2(L2, -L1) and

    dphi/dt = L (2 E - I3 omega3^2) / (L^2 - I3^2 omega3^2),

whose integral is one elliptic integral of the third kind (E. T. Whittaker, A Treatise on the
Analytical Dynamics of Particles and Rigid Bodies, 1937, section 69; Landau and Lifshitz, Mechanics,
section 37). Derivatives are central differences. Nothing of the package is used.
"""

from typing import NamedTuple

import mpmath as mp

DIGITS = 150
"""Digits of the arithmetic: differences of nearly equal moments and long phases cancel some."""

STEP = mp.mpf(10) ** -40
"""Relative step of central differences; their error is of relative order STEP^2 (2 pi turns)^2."""


def quaternion_product(a, b) -> list:
    return [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]


def conjugate(q) -> list:
    return [q[0], -q[1], -q[2], -q[3]]


def about(axis: int, angle) -> list:
    q = [mp.cos(angle / 2), mp.mpf(0), mp.mpf(0), mp.mpf(0)]
    q[1 + axis] = mp.sin(angle / 2)
    return q


def _of_rows(R) -> list:
    """Unit quaternion of a rotation matrix, from its largest component."""
    trace = R[0][0] + R[1][1] + R[2][2]
    squares = [1 + trace] + [1 + 2 * R[i][i] - trace for i in range(3)]
    k = max(range(4), key=lambda i: squares[i])
    size = 2 * mp.sqrt(squares[k])
    if k == 0:
        return [size / 4] + [
            (R[(i + 2) % 3][(i + 1) % 3] - R[(i + 1) % 3][(i + 2) % 3]) / size for i in range(3)
        ]
    i = k - 1
    j, n = (i + 1) % 3, (i + 2) % 3
    q = [mp.mpf(0)] * 4
    q[0], q[1 + i] = (R[n][j] - R[j][n]) / size, size / 4
    q[1 + j], q[1 + n] = (R[j][i] + R[i][j]) / size, (R[n][i] + R[i][n]) / size
    return q


class Motion(NamedTuple):
    """One body: ``state(t)`` and ``flips(count)``; see the module."""

    moments: tuple
    wxyz: tuple
    omega: tuple
    axes: tuple[int, int, int] | None
    data: tuple

    @classmethod
    def of(cls, moments, wxyz, omega) -> "Motion":
        moments, omega, q = ([mp.mpf(x) for x in v] for v in (moments, omega, wxyz))
        size = mp.sqrt(mp.fdot(q, q))
        q = [x / size for x in q]
        L = [i * w for i, w in zip(moments, omega)]
        bare = sum(x != 0 for x in L) == 1  # a permanent rotation
        if bare or moments[0] == moments[1] == moments[2] or not any(omega):
            return cls(tuple(moments), tuple(q), tuple(omega), None, ())
        square, twice = mp.fdot(L, L), mp.fdot(L, omega)
        order = sorted(range(3), key=lambda i: moments[i])
        if square < twice * moments[order[1]]:  # long-axis mode
            order = order[::-1]
        one, two, three = order
        I1, I2, I3 = (moments[i] for i in order)
        size, c = mp.sqrt(square), mp.sqrt((square - twice * I1) / (I3 * (I3 - I1)))
        a = mp.sqrt((square - twice * I3) / (I1 * (I1 - I3)))
        c = c if omega[three] >= 0 else -c
        p = mp.sqrt((I3 - I2) * (square - twice * I1) / (I1 * I2 * I3))
        m = (I2 - I1) * (twice * I3 - square) / ((I3 - I2) * (square - twice * I1))
        b = mp.sqrt((twice * I3 - square) / (I2 * (I3 - I2)))
        # the sign of b from Euler's equation, I1 domega1/dt = (I2 - I3) omega2 omega3, which holds
        # for axes (1, 2, 3) that are right-handed
        even = order in ([0, 1, 2], [1, 2, 0], [2, 0, 1])
        signs = (I3 > I2, c > 0, even)
        b = b if sum(signs) % 2 else -b
        start = mp.atan2(omega[two] / b, omega[one] / a)
        u0 = mp.ellipf(start, m)
        A, B = square - (I3 * c) ** 2, (I3 * c) ** 2 * m
        n, share = -B / A, size * (twice - square / I3) / (A * p)
        motion = cls(
            tuple(moments),
            tuple(q),
            tuple(omega),
            (one, two, three),
            (a, b, c, p, m, u0, size, size / I3, n, share, even),
        )
        frame, _ = motion._in_frame(mp.mpf(0))
        return motion._replace(wxyz=tuple(quaternion_product(q, conjugate(frame))))

    def _amplitude(self, u):
        """am u: the part within a half-turn, and the number of half-turns of K."""
        m = self.data[4]
        K = mp.ellipk(m)
        turns = mp.nint(u / (2 * K))
        rest = u - 2 * K * turns
        sn, cn = mp.ellipfun("sn", rest, m=m), mp.ellipfun("cn", rest, m=m)
        return turns, mp.atan2(sn, cn)

    def _third(self, turns, angle):
        """Pi(n; am u | m) for the amplitude angle + pi turns."""
        m, n = self.data[4], self.data[8]
        return mp.ellippi(n, angle, m) + 2 * turns * mp.ellippi(n, m)

    def _in_frame(self, t):
        """Attitude from the body to the frame whose z axis is the momentum; body rates."""
        a, b, c, p, m, u0, _, drift, _, share, even = self.data
        turns, angle = self._amplitude(u0 + p * t)
        whole = angle + mp.pi * turns
        phi = drift * t + share * (self._third(turns, angle) - self._third(*self._amplitude(u0)))
        sine, cosine = mp.sin(whole), mp.cos(whole)
        rates = [a * cosine, b * sine, c * mp.sqrt(1 - m * sine**2)]
        one, two, three = self.axes
        omega = [mp.mpf(0)] * 3
        for axis, rate in zip(self.axes, rates):
            omega[axis] = rate
        I = self.moments
        L1, L2, L3 = I[one] * rates[0], I[two] * rates[1], I[three] * rates[2]
        if not even:  # a right-handed triad of body axes: 1, -2, 3
            L2 = -L2
        psi = mp.atan2(L2, -L1)
        # the continuous angle: psi follows -/+ the amplitude, plus pi
        direction = 1 if (L1 * cosine >= 0 and (L2 >= 0) == (sine >= 0)) else -1
        psi = psi + 2 * mp.pi * mp.nint((mp.pi - direction * whole - psi) / (2 * mp.pi))
        theta = mp.atan2(mp.hypot(L1, L2), L3)
        triad = quaternion_product(
            about(2, phi), quaternion_product(about(1, theta), about(2, psi))
        )
        e = [[mp.mpf(0)] * 3 for _ in range(3)]  # rows: triad axes in body axes
        e[0][one], e[1][two], e[2][three] = mp.mpf(1), mp.mpf(1 if even else -1), mp.mpf(1)
        return quaternion_product(triad, _of_rows(e)), omega

    def state(self, t) -> tuple[list, list]:
        """Unit quaternion, continuous in t, and body rates at time t."""
        t = mp.mpf(t)
        if self.axes is None:
            size = mp.sqrt(mp.fdot(self.omega, self.omega))
            half = size * t / 2
            turn = [mp.cos(half)] + [mp.sin(half) * (x / size if size else x) for x in self.omega]
            return quaternion_product(self.wxyz, turn), list(self.omega)
        frame, omega = self._in_frame(t)
        return quaternion_product(self.wxyz, frame), omega

    def flips(self, count: int) -> list:
        """The first ``count`` times above 0 at which the rate about the intermediate axis is 0."""
        if self.axes is None or len(set(self.moments)) < 3:
            return []
        p, m, u0 = self.data[3:6]
        K = mp.ellipk(m)
        first = mp.floor(u0 / (2 * K)) + 1
        return [(2 * K * (first + k) - u0) / p for k in range(count)]


def differences(of, moments, omega) -> list[list]:
    """Derivatives of a list of numbers ``of(moments, omega)``: rows by number, columns by moment
    and rate (six).
    """
    columns = []
    size = mp.sqrt(sum(mp.mpf(w) ** 2 for w in omega))
    for k in range(6):
        h = STEP * (mp.mpf(moments[k]) if k < 3 else size)
        ends = []
        for sign in (1, -1):
            given = [[mp.mpf(x) for x in moments], [mp.mpf(x) for x in omega]]
            given[k // 3][k % 3] += sign * h
            ends.append(of(*given))
        columns.append([(x - y) / (2 * h) for x, y in zip(*ends)])
    return [list(row) for row in zip(*columns)]
