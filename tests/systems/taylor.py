"""Taylor series to high order in 50-digit arithmetic: the independent reference of the systems.

A motion is an expression in its unknowns; every product stores its Taylor coefficients, so that a
step of order 40 needs about 40^2 multiplications per product. The package is not used.
"""

from collections.abc import Callable, Sequence

from mpmath import mp, mpf

DIGITS = 50
ORDER = 44


class Node:
    """A power series in time whose coefficients are computed one after another."""

    def __init__(self, rule: Callable[[int], mpf]):
        self._rule, self._known = rule, []

    def __getitem__(self, k: int) -> mpf:
        while len(self._known) <= k:
            self._known.append(self._rule(len(self._known)))
        return self._known[k]

    def __add__(self, other):
        other = lift(other)
        return Node(lambda k: self[k] + other[k])

    def __sub__(self, other):
        return self + lift(other) * mpf(-1)

    def __mul__(self, other):
        if not isinstance(other, Node):
            return Node(lambda k: self[k] * other)
        return Node(lambda k: mp.fsum(self[j] * other[k - j] for j in range(k + 1)))

    def __neg__(self):
        return self * mpf(-1)

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other):
        return lift(other) - self


def lift(value) -> Node:
    if isinstance(value, Node):
        return value
    return Node(lambda k: mpf(value) if k == 0 else mpf(0))


def reciprocal(a: Node) -> Node:
    """1/a, whose convolution with a is one."""

    def rule(k):
        if k == 0:
            return 1 / a[0]
        return -mp.fsum(a[j] * found[k - j] for j in range(1, k + 1)) / a[0]

    found = Node(rule)
    return found


def dot(a, b):
    first, *rest = (x * y for x, y in zip(a, b))
    return sum(rest, start=first)


class Unknown(Node):
    """A component of the state: coefficient k+1 is coefficient k of its rate over k+1."""

    def __init__(self, start: mpf):
        super().__init__(lambda k: start if k == 0 else self.rate[k - 1] / k)
        self.rate: Node | None = None


def integrate(field, start: Sequence[mpf], t0, t1, steps: int) -> list[mpf]:
    """State at t1 of dy/dt = field(t, y), by ``steps`` equal Taylor steps of order ``ORDER``.

    ``field(t, y)`` maps nodes to nodes and must be polynomial in t and y.
    """
    with mp.workdps(DIGITS + 10):
        y, h = [mpf(x) for x in start], (mpf(t1) - mpf(t0)) / steps
        for i in range(steps):
            now = mpf(t0) + i * h
            clock = Node(lambda k, now=now: (now, mpf(1))[k] if k < 2 else mpf(0))
            unknowns = [Unknown(x) for x in y]
            for unknown, rate in zip(unknowns, field(clock, unknowns)):
                unknown.rate = lift(rate)
            y = [mp.polyval([u[k] for k in range(ORDER, -1, -1)], h) for u in unknowns]
        return y


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def rows(q):
    w, x, y, z = q
    return [
        [w * w + x * x - y * y - z * z, (x * y - w * z) * mpf(2), (x * z + w * y) * mpf(2)],
        [(x * y + w * z) * mpf(2), w * w - x * x + y * y - z * z, (y * z - w * x) * mpf(2)],
        [(x * z - w * y) * mpf(2), (y * z + w * x) * mpf(2), w * w - x * x - y * y + z * z],
    ]


def quaternion_rate(q, rates):
    """q (0, rates) / 2."""
    w, x, y, z = q
    a, b, c = (r * mpf("0.5") for r in rates)
    return [
        -(x * a) - y * b - z * c,
        w * a + y * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y * a,
    ]


def growing_body(moments, growth):
    """A body whose moments are moments + t growth: L is constant in space."""

    def field(t, y):
        omega, q = y[:3], y[3:]
        now = [t * mpf(g) + mpf(m) for m, g in zip(moments, growth)]
        momentum = [m * w for m, w in zip(now, omega)]
        push = [p - w * mpf(g) for p, w, g in zip(cross(momentum, omega), omega, growth)]
        return [p * reciprocal(m) for p, m in zip(push, now)] + quaternion_rate(q, omega)

    return field


def body_with_wheels(moments, axes, inertia, motor, torque):
    """y = (omega, q, c): c are the momenta J (Omega + a . omega) of wheels about unit axes a.

    ``moments``: of the body with locked wheels. ``motor(omega)``: torque on each wheel;
    ``torque(rows, h)``: external torque, h the momentum of the wheels.
    """
    J = mpf(inertia)
    carrier = mp.matrix(3, 3)
    for i in range(3):
        for k in range(3):
            carrier[i, k] = (moments[i] if i == k else 0) - J * mp.fsum(a[i] * a[k] for a in axes)
    inverse = carrier**-1

    def field(t, y):
        omega, q, spins = y[:3], y[3:7], y[7:]

        def sums(values):
            return [dot([lift(a[i]) for a in axes], values) for i in range(3)]

        h, u = sums(spins), motor(omega)
        momentum = [dot([lift(carrier[i, k]) for k in range(3)], omega) + h[i] for i in range(3)]
        push = [a + b - c for a, b, c in zip(cross(momentum, omega), torque(rows(q), h), sums(u))]
        change = [dot([lift(inverse[i, k]) for k in range(3)], push) for i in range(3)]
        return [*change, *quaternion_rate(q, omega), *u]

    return field


def body(moments, torque=None, sink=0):
    """Rates and quaternion of a body: y = (omega, q); ``torque(t, omega, rows)`` in body axes.

    ``sink``: k of the slip k (L x omega), a rotation of the axes in addition to omega.
    """
    moments = [mpf(m) for m in moments]

    def field(t, y):
        omega, q = y[:3], y[3:]
        momentum = [m * w for m, w in zip(moments, omega)]
        push, turning = cross(momentum, omega), omega
        if sink:
            turning = [a + b * mpf(sink) for a, b in zip(omega, push)]
            push = cross(momentum, turning)
        if torque is not None:
            push = [a + b for a, b in zip(push, torque(t, omega, rows(q)))]
        return [p * (1 / m) for p, m in zip(push, moments)] + quaternion_rate(q, turning)

    return field
