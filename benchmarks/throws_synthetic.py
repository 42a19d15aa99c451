"""Simulated throws: bias, efficiency and coverage of the inertia of single throws.

Bodies of 1 to 30 times the inertia of the TU Delft device (``benchmarks.throws``) are thrown with
the same wheel, window, noise of gyroscope and wheel, and aerodynamic torques. The noise levels are
estimated from 40 throws of a body together (``fit_balance``), then every throw is fitted alone with
these levels; in further throws the noise is estimated from the same single throw. For each size and
principal moment the output contains the mean error over its standard deviation, the rms error over
the Cramer-Rao bound (the standard deviation that the fit states), and the coverage of the 95 %
intervals.

    python -m benchmarks.throws_synthetic [--throws 960] [--own 240] [--sizes 1,3,10,30]
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
from benchmarks.throws import Instrument, fit_balance, fit_each
from polhode import fit as room

SPIN = 1.7e-6
# tensor of the device with its wheel locked [kg m^2]: the rounded result of benchmarks.throws
DEVICE = 1e-6 * np.array([[78.0, 3.0, 2.0], [3.0, 24.0, -2.0], [2.0, -2.0, 91.0]])
STEP, LENGTH, BLOCK = 1e-3, 0.48, 4
# noise of a sample of 1 ms [rad/s]: gyroscope at rest, addition at full wheel speed; wheel
GYRO, STIRRED, WHEEL = 4e-3, 6e-3, 1.0
# torques over half the trace: white [rad/s^(3/2)], slow [rad/s^2], correlation time [s]
WHITE, SLOW, MEMORY = 0.01, 0.25, 0.05
# drag over half the trace [1/s, 1/rad]
LINEAR, QUADRATIC = 0.01, 1e-3


def speed(t):
    """Speed of the wheel: -200 rad/s, towards -1300 from 0.1 s on, and back from 0.3 s on."""
    first = 1 - jnp.exp(-jnp.maximum(t - 0.1, 0) / 0.03)
    last = 1 - jnp.exp(-jnp.maximum(t - 0.3, 0) / 0.03)
    return -200 - 1100 * first + 1100 * last


def simulated(key, tensor, parts=4):
    """Readings of rates (t, 3) and wheel (t,) in one throw; steps of 1 ms / ``parts``."""
    size, inverse = jnp.trace(tensor) / 2, jnp.linalg.inv(tensor)
    axis = jnp.asarray([0.0, 0.0, 1.0])
    keys = jax.random.split(key, 5)
    count = round(LENGTH / STEP)
    dt = STEP / parts
    first = jax.random.normal(keys[0], (3,))
    first = 18 * first / jnp.linalg.norm(first)

    def rates(momentum, t):
        return inverse @ (momentum - SPIN * speed(t) * axis)

    def field(momentum, t, slow):
        w = rates(momentum, t)
        drag = LINEAR + QUADRATIC * jnp.linalg.norm(w)
        return jnp.cross(momentum, w) + size * (slow - drag * w)

    stays = jnp.exp(-dt / MEMORY)

    def step(state, inputs):
        momentum, slow = state
        t, push, fresh = inputs
        found = rates(momentum, t)
        momentum = runge_kutta(lambda m, t: field(m, t, slow), momentum, t, dt)
        momentum = momentum + size * WHITE * dt**0.5 * push
        return (momentum, stays * slow + SLOW * (1 - stays**2) ** 0.5 * fresh), found

    times = jnp.linspace(0, LENGTH - dt, count * parts)
    pushes = jax.random.normal(keys[1], (2, count * parts, 3))
    slow = SLOW * jax.random.normal(keys[2], (3,))
    start = tensor @ first + SPIN * speed(0.0) * axis
    _, path = jax.lax.scan(step, (start, slow), (times, *pushes))
    wheel = speed(times[::parts])
    stirred = jnp.hypot(GYRO, STIRRED * (wheel / 1300) ** 2)[:, None]
    reading = path[::parts] + stirred * jax.random.normal(keys[3], (count, 3))
    return reading, wheel + WHEEL * jax.random.normal(keys[4], (count,))


def throws(seed, tensor, number):
    """Recordings, without wheel speeds just after the motor is switched."""
    keys = jax.random.split(jax.random.key(seed), number)
    readings, wheels = jax.jit(jax.vmap(simulated, in_axes=(0, None)))(keys, jnp.asarray(tensor))
    times = STEP * np.arange(readings.shape[1])
    switched = ((times > 0.08) & (times < 0.137)) | ((times > 0.28) & (times < 0.314))
    wheels = np.where(switched, np.nan, wheels)
    return [
        room.Recording.of(times, w, wheel_speed=h)
        for w, h in zip(np.asarray(readings), wheels, strict=True)
    ]


def study(size, number, together=40, group=120):
    """Errors of single throws of a body of ``size`` times the device's inertia.

    The noise is estimated again for every ``group`` of throws, from its first ``together``, so that
    the errors include those of the noise levels, which the throws of a group share.
    """
    tensor = size * DEVICE
    true = np.linalg.eigvalsh(tensor)
    joints, moments, spread, done = [], [], [], 0
    for first in range(0, number, group):
        given = throws(round(100 * size) + first, tensor, min(group, number - first))
        joint = fit_balance(given[:together], Instrument(SPIN), block=BLOCK)
        alone = fit_each(joint, given)
        joints.append((np.asarray(joint.moments[0]) - true) / np.asarray(joint.moments_std[0]))
        moments.append(np.asarray(alone.moments))
        spread.append(np.asarray(alone.moments_std))
        done += int(np.sum(alone.converged))
    return {
        "size": size,
        **told(np.concatenate(moments) - true, np.concatenate(spread), true),
        "joint_rms_error_over_std": np.sqrt(np.square(joints).mean(axis=0)).tolist(),
        "converged": done,
    }


def study_own(size, number):
    """Errors of single throws whose noise is estimated from the same throw."""
    tensor = size * DEVICE
    true = np.linalg.eigvalsh(tensor)
    fits = [
        fit_balance([one], Instrument(SPIN), block=BLOCK, throw=False)
        for one in throws(round(100 * size) + 11, tensor, number)
    ]
    moments, spread = (
        np.array([getattr(one, kind)[0] for one in fits]) for kind in ("moments", "moments_std")
    )
    return {
        "size": size,
        **told(moments - true, spread, true),
        "converged": sum(int(np.sum(one.converged)) for one in fits),
    }


def told(error, spread, true):
    """Statistics of the errors (n, 3) and of the stated standard deviations."""
    off = error / spread
    held = np.abs(off) < 1.959964
    return {
        "throws": len(error),
        "std_percent": (100 * np.median(spread / true, axis=0)).tolist(),
        "mean_error_over_std": (error.mean(axis=0) / error.std(axis=0)).tolist(),
        "rms_error_over_bound": np.sqrt((off**2).mean(axis=0)).tolist(),
        "covered_percent": (100 * held.mean(axis=0)).tolist(),
        "covered_percent_all": 100 * float(held.mean()),
    }


def main() -> int:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--throws", type=int, default=960)
    parser.add_argument("--own", type=int, default=240)
    parser.add_argument("--sizes", default="1,3,10,30")
    parser.add_argument("--output", default=None)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    numbers = {"sizes": [], "own_noise": []}
    for size in map(float, options.sizes.split(",")):
        numbers["own_noise"].append(study_own(size, options.own))
        numbers["sizes"].append(study(size, options.throws))
        for kind, rows in numbers.items():
            print(kind)
            for name, value in rows[-1].items():
                print(f"  {name:24s} {np.round(value, 3)}", flush=True)
    print(f"written: {write('throws_synthetic', numbers, path=options.output)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
