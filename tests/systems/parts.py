"""Reference motions of plates, tables, wheels, gyroscopes and sampled commands, written by hand.

Only for ``make_truth.py``; the package is not used.
"""

import taylor
from mpmath import mp, mpf
from taylor import cross, dot, lift


def field_of(system):
    """``field(moments, part, y)``: equations of motion in a part of the span that begins at y."""
    acts = system.acts
    if system.is_simple:
        return lambda moments, part, y: taylor.body(moments, system.torque(moments), system.sink)
    if "growth" in acts:
        return lambda moments, part, y: taylor.growing_body(moments, acts["growth"])
    if "wheels" in acts:
        return lambda moments, part, y: _with_wheels(moments, *acts["wheels"])
    if "gyro" in acts:
        return lambda moments, part, y: _with_gyro(moments, *acts["gyro"])
    torque = {"table": _polynomial, "drag": _drag, "light": _light, "sampled": _held}
    ((kind, numbers),) = acts.items()
    return lambda moments, part, y: taylor.body(moments, torque[kind](part, y, numbers))


def more_unknowns(system, y):
    """Unknowns besides rates and quaternion: momenta of wheels, cosine and sine of the gimbal
    angle.
    """
    if "wheels" in system.acts:
        axes, inertia, speeds, *_ = system.acts["wheels"]
        return [mpf(inertia) * (mpf(s) + dot(a, y)) for a, s in zip(_units(axes), speeds)]
    return [mpf(1), mpf(0)] if "gyro" in system.acts else []


def _units(axes):
    sizes = (mp.sqrt(mp.fsum(x * x for x in a)) for a in axes)
    return [[mpf(x) / size for x in a] for a, size in zip(axes, sizes)]


def _polynomial(part, y, curve):
    def torque(t, omega, rows):
        total = [lift(x) for x in curve[3]]
        for row in reversed(curve[:3]):
            total = [t * x + mpf(c) for x, c in zip(total, row)]
        return total

    return torque


def _in_body(rows, vector):
    return [dot([lift(x) for x in vector], [row[i] for row in rows]) for i in range(3)]


def _exposed(normal, direction):
    """Cosine (times the size) of a plate's exposure, which must remain positive."""
    along = dot([lift(x) for x in normal], direction)
    assert along[0] > mpf("0.1"), "a plate turns away"
    return along


def _drag(part, y, numbers):
    plates, density, velocity, coefficient = numbers

    def torque(t, omega, rows):
        v, total = _in_body(rows, velocity), [lift(0)] * 3
        for area, normal, centre in plates:
            size = _exposed(normal, v) * (-mpf(density) * mpf(coefficient) * mpf(area) / 2)
            push = cross([lift(x) for x in centre], [size * x for x in v])
            total = [a + b for a, b in zip(total, push)]
        return total

    return torque


def _light(part, y, numbers):
    plates, direction, specular, diffuse, pressure, shadow = numbers
    size = mp.sqrt(mp.fsum(mpf(x) ** 2 for x in direction))
    specular, diffuse = mpf(specular), mpf(diffuse)
    if shadow is not None and part == 1:
        return None  # in the dark

    def torque(t, omega, rows):
        s, total = _in_body(rows, [mpf(x) / size for x in direction]), [lift(0)] * 3
        for area, normal, centre in plates:
            c = _exposed(normal, s)
            across = (c * specular + diffuse / 3) * mpf(2)
            force = [
                c * (-mpf(pressure) * mpf(area)) * (a * (1 - specular) + across * mpf(n))
                for a, n in zip(s, normal)
            ]
            push = cross([lift(x) for x in centre], force)
            total = [a + b for a, b in zip(total, push)]
        return total

    return torque


def _held(part, y, gains):
    command = [-mpf(g) * w for g, w in zip(gains, y[:3])]
    return lambda t, omega, rows: [lift(x) for x in command]


def _with_wheels(moments, axes, inertia, speeds, gains, dumping):
    units = _units(axes)
    square = mp.matrix([[mp.fsum(a[i] * a[k] for a in units) for k in range(3)] for i in range(3)])
    inverse = square**-1
    # the least motor torques u with sum of a u = -N are u = -A^T (A A^T)^-1 N
    shares = [[mp.fsum(a[i] * inverse[i, k] for i in range(3)) for k in range(3)] for a in units]

    def motor(omega):
        command = [w * -mpf(g) for w, g in zip(omega, gains)]
        return [-dot([lift(x) for x in share], command) for share in shares]

    def torque(rows, h):
        if dumping is None:
            return [lift(0)] * 3
        k, field = mpf(dumping[0]), [mpf(x) for x in dumping[1]]
        square = mp.fsum(x * x for x in field)
        b = _in_body(rows, field)
        moment = [x * (-k / square) for x in cross(b, h)]
        return cross(moment, b)

    return taylor.body_with_wheels(moments, units, inertia, motor, torque)


def _with_gyro(moments, momentum, rate):
    """A gimbal about body z that rotates at a constant rate, the wheel's axis initially along x."""
    momentum, rate = mpf(momentum), mpf(rate)

    def field(t, y):
        body, (c, s) = y[:7], y[7:]

        def torque(t, omega, rows):
            h = [c * momentum, s * momentum, lift(0)]
            change = [s * (-momentum * rate), c * (momentum * rate), lift(0)]
            return [-a - b for a, b in zip(change, cross(omega, h))]

        return [*taylor.body(moments, torque)(t, body), s * -rate, c * rate]

    return field
