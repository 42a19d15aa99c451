"""Information of throws: ``throw_information`` over initial spins and programmes of the wheel.

A body with 10 times the inertia of the TU Delft device, with its wheel, window and noise
(``benchmarks.throws_synthetic``). The result is ``exp(-log det / 12)``: the geometric mean of the
standard deviations of the tensor after a single throw, relative to half its trace. It is computed
by direction of a spin of 18 rad/s (angle from the wheel's axis, and about it) with the wheel's
actual programme; and, for the most informative of these spins, by start and duration of the wheel's
acceleration.

    python -m benchmarks.throw_design [--side 24]
"""

import argparse
import sys

from benchmarks._report import one_thread, write

if __name__ == "__main__":
    one_thread()

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import throws_synthetic as study
from benchmarks.throws import Instrument, Noise, throw_information

jax.config.update("jax_enable_x64", True)
TENSOR = jnp.asarray(10 * study.DEVICE)
SIZE = float(np.trace(TENSOR)) / 2
TIMES = study.STEP * np.arange(0, 481, 4)
# noise of a residual, for one sample of 4 ms
NOISE = Noise(
    *(jnp.asarray(x) for x in (2e-3, 3e-3, 0.01 * SIZE, 1e-4 * SIZE, 0.25 * SIZE, 0.05, 0.5))
)
INSTRUMENT = Instrument(study.SPIN)
SPIN = 18.0


def spread(omega, wheel):
    """Geometric mean of the relative standard deviations of the tensor's entries."""
    found = throw_information(TENSOR, omega, jnp.asarray(TIMES), wheel, INSTRUMENT, NOISE)
    return jnp.exp(-jnp.linalg.slogdet(found)[1] / 12)


def direction(tilt, turn):
    """Unit vector at ``tilt`` [rad] from the wheel's axis."""
    return jnp.stack([jnp.sin(tilt) * jnp.cos(turn), jnp.sin(tilt) * jnp.sin(turn), jnp.cos(tilt)])


def program(begin, length):
    """Speed of the wheel: -200 rad/s, towards -1300 from ``begin`` [s] on, and back after
    ``length`` [s].
    """
    t = jnp.asarray(TIMES)
    first = 1 - jnp.exp(-jnp.maximum(t - begin, 0) / 0.03)
    last = 1 - jnp.exp(-jnp.maximum(t - begin - length, 0) / 0.03)
    return -200 - 1100 * first + 1100 * last


def table(function, rows, columns):
    """Values of ``function`` at all pairs, computed sequentially."""
    pairs = jnp.stack(jnp.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    found = jax.jit(lambda pairs: jax.lax.map(lambda p: function(*p), pairs))(pairs)
    return np.asarray(found).reshape(len(rows), len(columns))


def main() -> int:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--side", type=int, default=24)
    parser.add_argument("--output", default=None)
    options = parser.parse_args()
    wheel = study.speed(jnp.asarray(TIMES))
    tilts = jnp.linspace(0, np.pi, options.side)
    turns = jnp.linspace(0, 2 * np.pi, 2 * options.side)
    spins = table(lambda a, b: spread(SPIN * direction(a, b), wheel), tilts, turns)
    best = np.unravel_index(np.argmin(spins), spins.shape)
    chosen = SPIN * direction(tilts[best[0]], turns[best[1]])
    begins = jnp.linspace(0.02, 0.4, options.side)
    lengths = jnp.linspace(0.02, 0.4, options.side)
    programs = table(lambda a, b: spread(chosen, program(a, b)), begins, lengths)
    numbers = {
        "tilt_deg": np.degrees(tilts).tolist(),
        "turn_deg": np.degrees(turns).tolist(),
        "spread_of_spins": spins.tolist(),
        "best_spin_rad_s": np.asarray(chosen).tolist(),
        "begin_s": begins.tolist(),
        "length_s": lengths.tolist(),
        "spread_of_programs": programs.tolist(),
    }
    numbers["largest_over_least_spread"] = {
        "spin": np.max(spins) / np.min(spins),
        "program": np.max(programs) / np.min(programs),
    }
    for name in ("spread_of_spins", "spread_of_programs"):
        least, most = np.min(numbers[name]), np.max(numbers[name])
        print(f"{name:20s} {100 * least:.3f} to {100 * most:.3f} %")
    print(f"best spin {np.round(numbers['best_spin_rad_s'], 2)} rad/s")
    print(f"written: {write('throw_design', numbers, path=options.output)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
