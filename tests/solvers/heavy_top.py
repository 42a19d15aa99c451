"""The field of a heavy top, written by hand for solvers of diffrax."""


def heavy_top(t, y, parameters):
    """Lie-Poisson field of a heavy top with its centre of mass on body z, by components."""
    inverse, strength = parameters
    momentum, (w, x, y_, z) = y
    a, b, c = (m * i for m, i in zip(momentum, inverse))
    l, m, n = momentum
    torque_x, torque_y = 2 * strength * (y_ * z + w * x), 2 * strength * (w * y_ - x * z)
    rate = (m * c - n * b + torque_x, n * a - l * c + torque_y, l * b - m * a)
    a, b, c = a / 2, b / 2, c / 2
    turn = (
        -x * a - y_ * b - z * c,
        w * a + y_ * c - z * b,
        w * b + z * a - x * c,
        w * c + x * b - y_ * a,
    )
    return rate, turn
