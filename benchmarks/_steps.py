"""One classical Runge-Kutta step, for benchmarks that simulate motions with random torques."""


def runge_kutta(field, state, t, dt):
    """``state`` at ``t + dt`` where its rate is ``field(state, t)``; order 4."""
    one = field(state, t)
    two = field(state + dt / 2 * one, t + dt / 2)
    three = field(state + dt / 2 * two, t + dt / 2)
    four = field(state + dt * three, t + dt)
    return state + dt / 6 * (one + 2 * two + 2 * three + four)
