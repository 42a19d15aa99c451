"""Formulas that several benchmarks use, for numbers and arrays of any kind."""


def runge_kutta(field, state, t, dt):
    """``state`` at ``t + dt`` where its rate is ``field(state, t)``; one step of order 4."""
    one = field(state, t)
    two = field(state + dt / 2 * one, t + dt / 2)
    three = field(state + dt / 2 * two, t + dt / 2)
    four = field(state + dt * three, t + dt)
    return state + dt / 6 * (one + 2 * two + 2 * three + four)


def multiply(p, q) -> list:
    """Components of the product of the quaternions p and q, scalar first."""
    a, b, c, d = p
    w, x, y, z = q
    return [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
