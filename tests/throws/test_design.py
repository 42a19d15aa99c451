"""Design of throws: information of a planned throw, with derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import throws_synthetic as study
from benchmarks.throws import Instrument, Noise, throw_information

TENSOR = jnp.asarray(10 * study.DEVICE)
SIZE = float(np.trace(TENSOR)) / 2
TIMES = study.STEP * jnp.linspace(0, 480, 481)[::4]
INSTRUMENT = Instrument(study.SPIN)
NOISE = Noise(
    *(jnp.asarray(x) for x in (2e-3, 3e-3, 0.01 * SIZE, 1e-4 * SIZE, 0.25 * SIZE, 0.05, 0.5))
)
SPIN = jnp.asarray([10.0, -9.0, 12.0])


@jax.jit
def information(omega, wheel):
    return throw_information(TENSOR, omega, TIMES, wheel, INSTRUMENT, NOISE)


@jax.jit
def worth(omega, wheel):
    return jnp.linalg.slogdet(information(omega, wheel))[1]


@pytest.mark.slow  # compiles for a minute
def test_the_log_determinant_has_derivatives():
    wheel = study.speed(TIMES)
    slopes = jax.jit(jax.grad(worth, argnums=(0, 1)))(SPIN, wheel)
    rng = np.random.default_rng(4)
    for place, size in ((0, 1e-3), (1, 1e-2)):
        given = [SPIN, wheel]
        along = rng.normal(size=given[place].shape)
        # the fastest speed is a scale of the noise, not part of the program
        along[np.argmax(np.abs(given[place])) if place else slice(0, 0)] = 0
        ends = []
        for sign in (1, -1):
            moved = list(given)
            moved[place] = given[place] + sign * size * along
            ends.append(worth(*moved))
        slope = (ends[0] - ends[1]) / (2 * size)
        np.testing.assert_allclose(np.sum(slopes[place] * along), slope, rtol=1e-4)


@pytest.mark.slow
def test_a_wheel_that_moves_more_tells_more():
    still = jnp.full_like(TIMES, -200.0)
    wheel = study.speed(TIMES)
    found = [information(SPIN, still + part * (wheel - still)) for part in (1.0, 0.5, 0.0)]
    most, half, least = np.linalg.slogdet(np.array(found))[1]
    assert most > half > least
    # the scatter of single throws of this body in benchmarks.throws_synthetic
    trace = np.array([1.0, 1, 1, 0, 0, 0]) / 2
    spread = np.sqrt(trace @ np.linalg.inv(found[0]) @ trace)
    assert 0.003 < spread < 0.012
