"""Inertia of satellites from a gyroscope and a wheel: 60 s at 10 Hz, noise of 1e-4 rad/s.

The study follows arXiv:2510.16738; its satellites and wheel programmes are not available and are
replaced by assumptions: cuboids of 4, 20 and 60 kg with small products of inertia; one wheel along
(1, 1, 1) whose known speed is a sum of six sines and which causes rates of about 0.2 rad/s; initial
rates up to 0.3 rad/s about each axis. Disturbed: a random torque with a correlation time of 30 s
that would change the rates by 1e-5 rad/s^2.

Three estimators of the six entries use the same readings: least squares on Euler's equations with
central differences; instrumental variables, that is, the same equations with regressors from the
simulated motion of the first estimate, which are independent of the noise of the readings; and the
estimator of ``benchmarks.throws``. The output contains the mean over the runs of |tensor - true| /
|true| (Frobenius), in per cent, and for the last estimator the rms of the errors of the moments
over the stated standard deviations.

    python -m benchmarks.satellites [--runs 20]
"""

import argparse
import sys

from benchmarks._report import one_thread, write

if __name__ == "__main__":
    one_thread()

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._formulas import runge_kutta
from benchmarks.throws import Instrument, fit_balance
from polhode import fit as room

STEP, LENGTH, PARTS = 0.1, 60.0, 10
FIRST = 0.3
NOISE, PUSH, MEMORY = 1e-4, 1e-5, 30.0
AXIS = np.ones(3) / np.sqrt(3)
# inertia [kg m^2]; spin inertia [kg m^2] and maximum speed [rad/s] of the wheel
SATELLITES = {
    "4 kg": (
        [[0.036, 0.0008, -0.0005], [0.0008, 0.034, 0.0004], [-0.0005, 0.0004, 0.0075]],
        1e-5,
        800.0,
    ),
    "20 kg": ([[0.32, 0.008, -0.006], [0.008, 0.27, 0.01], [-0.006, 0.01, 0.19]], 2e-4, 600.0),
    "60 kg": ([[3.1, 0.06, 0.09], [0.06, 2.6, -0.08], [0.09, -0.08, 2.1]], 2e-3, 600.0),
}
# speed of the wheel: cycles per minute and phases of its sines
CYCLES, PHASES = np.array([1.3, 2.9, 5.1, 7.7, 9.1, 12.3]), np.array([0.3, 1.9, 4.1, 0.9, 5.2, 2.7])


def program(t):
    """Speed of the wheel relative to its maximum."""
    angles = 2 * np.pi * CYCLES * t[..., None] / 60 + PHASES
    return jnp.sum(jnp.sin(angles), axis=-1) / len(CYCLES)


@jax.jit
def flown(key, tensor, spin, fastest, push):
    """Rates (t, 3) without noise, by Runge-Kutta steps of 10 ms."""
    first, begin, fresh = jax.random.split(key, 3)
    size, inverse, dt = jnp.trace(tensor) / 2, jnp.linalg.inv(tensor), STEP / PARTS
    count = round(LENGTH / STEP) * PARTS + 1

    def rates(momentum, t):
        return inverse @ (momentum - spin * fastest * program(t) * AXIS)

    def field(momentum, t, slow):
        return jnp.cross(momentum, rates(momentum, t)) + size * slow

    stays = jnp.exp(-dt / MEMORY)

    def step(state, inputs):
        momentum, slow = state
        t, push_now = inputs
        found = rates(momentum, t)
        momentum = runge_kutta(lambda m, t: field(m, t, slow), momentum, t, dt)
        return (momentum, stays * slow + push * (1 - stays**2) ** 0.5 * push_now), found

    times = dt * jnp.arange(count)
    start = tensor @ jax.random.uniform(first, (3,), minval=-FIRST, maxval=FIRST)
    start = start + spin * fastest * program(times[0]) * AXIS
    slow = push * jax.random.normal(begin, (3,))
    _, path = jax.lax.scan(step, (start, slow), (times, jax.random.normal(fresh, (count, 3))))
    return path[::PARTS]


def equations(rates, slopes, spin, fastest, times):
    """Matrix (3 t, 6) and right side of Euler's equations for xx, yy, zz, yz, zx, xy."""

    def rows(v):
        x, y, z = v.T
        o = np.zeros_like(x)
        return np.stack(
            [
                np.stack([x, o, o, o, z, y], -1),
                np.stack([o, y, o, z, o, x], -1),
                np.stack([o, o, z, y, x, o], -1),
            ],
            axis=1,
        )

    carried = spin * fastest * np.asarray(program(times))[:, None] * AXIS
    torque = spin * fastest * np.asarray(jax.vmap(jax.grad(program))(times))[:, None] * AXIS
    turning = np.cross(rates[:, None], np.swapaxes(rows(rates), 1, 2)).swapaxes(1, 2)
    left = (rows(slopes) + turning)[1:-1].reshape(-1, 6)
    return left, -(torque + np.cross(rates, carried))[1:-1].ravel()


def whole(entries):
    a, b, c, p, q, r = entries
    return np.array([[a, r, q], [r, b, p], [q, p, c]])


def regressions(reading, spin, fastest, times):
    """Tensors by least squares and by instrumental variables."""
    left, right = equations(reading, np.gradient(reading, STEP, axis=0), spin, fastest, times)
    plain = np.linalg.lstsq(left, right, rcond=None)[0]
    fine = jnp.linspace(0, times[-1], (len(times) - 1) * PARTS + 1)
    motion = room.SteppedMotion(spin, tuple(AXIS.tolist()))
    none = {"drag": None, "delay": None}
    guess = motion(
        jnp.asarray(whole(plain)),
        jnp.asarray(reading[0]),
        None,
        fine,
        fastest * program(fine),
        none,
    )
    rates, slopes = (np.asarray(x)[::PARTS] for x in (guess.omega, guess.omega_dot))
    instruments, _ = equations(rates, slopes, spin, fastest, times)
    return whole(plain), whole(np.linalg.solve(instruments.T @ left, instruments.T @ right))


def study(name, push, runs):
    """Errors for one satellite."""
    tensor, spin, fastest = SATELLITES[name]
    true = np.array(tensor)
    times = jnp.linspace(0, LENGTH, round(LENGTH / STEP) + 1)
    keys = jax.random.split(jax.random.key(len(name)), runs)
    paths = np.asarray(jax.vmap(lambda k: flown(k, jnp.asarray(true), spin, fastest, push))(keys))
    rng = np.random.default_rng(5)
    readings = paths + NOISE * rng.normal(size=paths.shape)
    wheel = fastest * np.asarray(program(times))
    fits = [
        fit_balance(
            [room.Recording.of(times, one, wheel_speed=wheel)], Instrument(spin, AXIS), throw=False
        )
        for one in readings
    ]
    fit = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *fits)
    both = [regressions(one, spin, fastest, times) for one in readings]
    found = {
        "least_squares": [a for a, _ in both],
        "instrumental_variables": [b for _, b in both],
        "likelihood": np.asarray(fit.inertia.tensor),
    }
    off = (np.asarray(fit.moments) - np.linalg.eigvalsh(true)) / np.asarray(fit.moments_std)
    return {
        "satellite": name,
        "disturbed": push > 0,
        "runs": runs,
        "rates_rms_rad_s": float(np.sqrt(np.mean(np.sum(paths**2, axis=-1)))),
        **{
            f"{kind}_percent": float(
                np.mean([100 * np.linalg.norm(one - true) / np.linalg.norm(true) for one in ones])
            )
            for kind, ones in found.items()
        },
        "moments_rms_error_over_std": float(np.sqrt(np.mean(off**2))),
        "covered_percent": 100 * float(np.mean(np.abs(off) < 1.959964)),
        "converged": int(np.sum(fit.converged)),
    }


def main() -> int:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--output", default=None)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for push in (0.0, PUSH):
        for name in SATELLITES:
            rows.append(study(name, push, options.runs))
            print(rows[-1], flush=True)
    print(f"written: {write('satellites', {'rows': rows}, path=options.output)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
