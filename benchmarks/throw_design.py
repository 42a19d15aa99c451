"""Which throw tells most: ``throw_information`` over initial spins and wheel programs.

A body of 10 times the inertia of the TU Delft device, its wheel, window and noise
(``benchmarks.throws_synthetic``). The number shown is ``exp(-log det / 12)``: the geometric mean of
the standard deviations that a single throw leaves of the tensor, over half its trace. By direction
of a spin of 18 rad/s (angle from the wheel's axis, and about it), the wheel as thrown; and by when
the wheel is switched on and for how long, for the spin of 18 rad/s that tells most.

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
# of residuals of one sample of 4 ms
NOISE = Noise(
    *(jnp.asarray(x) for x in (2e-3, 3e-3, 0.01 * SIZE, 1e-4 * SIZE, 0.25 * SIZE, 0.05, 0.5))
)
INSTRUMENT = Instrument(study.SPIN)
SPIN = 18.0


def spread(omega, wheel):
    """Geometric mean of the standard deviations of the tensor's entries, relative."""
    found = throw_information(TENSOR, omega, jnp.asarray(TIMES), wheel, INSTRUMENT, NOISE)
    return jnp.exp(-jnp.linalg.slogdet(found)[1] / 12)


def direction(tilt, turn):
    """Unit vector at ``tilt`` from the wheel's axis, rad."""
    return jnp.stack([jnp.sin(tilt) * jnp.cos(turn), jnp.sin(tilt) * jnp.sin(turn), jnp.cos(tilt)])


def program(begin, length):
    """-200 rad/s, towards -1300 from ``begin`` on, and back after ``length``, s."""
    t = jnp.asarray(TIMES)
    first = 1 - jnp.exp(-jnp.maximum(t - begin, 0) / 0.03)
    last = 1 - jnp.exp(-jnp.maximum(t - begin - length, 0) / 0.03)
    return -200 - 1100 * first + 1100 * last


def table(function, rows, columns):
    """``function`` of all pairs, one after the other."""
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
