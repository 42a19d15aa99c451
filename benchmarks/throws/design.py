"""Design of throws: Fisher information about the tensor that a planned throw provides."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from benchmarks.throws.instrument import Instrument
from benchmarks.throws.likelihood import Noise, Readings, innovations, score_of
from benchmarks.throws.numerics import entries_of, symmetric_matrix
from polhode.fit import SteppedMotion

# prior standard deviation of the relative loss of spin by drag in a second
_LOST = 0.3


def throw_information(
    tensor: ArrayLike,
    omega: ArrayLike,
    times: ArrayLike,
    wheel_speed: ArrayLike,
    instrument: Instrument,
    noise: Noise,
    block: int = 1,
) -> Float[Array, "6 6"]:
    """Fisher information about the tensor from one planned throw, for the model of ``fit_balance``.

    **Arguments:** ``tensor`` (3, 3), kg m^2, sensor axes, with the wheel locked; ``omega`` (3,),
    rad/s: rates at ``times[0]``; ``wheel_speed`` (T,), rad/s, at ``times`` (T,), s; ``instrument``
    (its axis must not be traced); ``noise`` of one body, for residuals of ``block`` samples, such
    as ``Fit.noise_levels``. The throw is simulated without drag, but drag is one of the unknowns.

    Returns the information (6, 6) about xx, yy, zz, yz, zx, xy over half the trace of the tensor:
    its inverse is the Cramer-Rao bound of their relative errors. Its log-determinant is
    differentiable with respect to ``omega`` and ``wheel_speed``:

        def worth(omega, wheel_speed):
            found = throw_information(tensor, omega, times, wheel_speed, instrument, noise)
            return jnp.linalg.slogdet(found)[1]
        slopes = jax.grad(worth, argnums=(0, 1))(omega, wheel_speed)
    """
    tensor, omega, times, wheel_speed = (
        jnp.asarray(value, float) for value in (tensor, omega, times, wheel_speed)
    )
    x, y, z = (float(component) for component in np.asarray(instrument.axis))
    flight = SteppedMotion(instrument.spin_inertia, (x, y, z), instrument.delay, steps=2)
    unknown = {"drag": None, "delay": None}
    rates = flight(tensor, omega, None, times, wheel_speed, unknown).omega
    size = jnp.trace(tensor) / 2
    count = (times.shape[0] - 1) // block
    blocks = jnp.mean(wheel_speed[: count * block].reshape(count, block), axis=1)
    fast = jnp.max(jnp.abs(jax.lax.stop_gradient(wheel_speed)))
    stir = (blocks / jnp.where(fast > 0, fast, 1)) ** 2
    data = Readings(times, rates, wheel_speed, jnp.ones_like(blocks), stir, jnp.zeros((), int))
    typical = jnp.sqrt(jnp.mean(jnp.sum(rates**2, axis=1)))

    def found(unknown):
        drag = _LOST * size * jnp.stack([unknown[6], unknown[7] / typical])
        body = symmetric_matrix(unknown[:6])
        # as in the fit: torques scale with the body
        shaken = noise.grown(jnp.trace(body) / 2)
        got = innovations(data, size * body, drag, instrument, shaken)
        return got, got

    here = jnp.concatenate([entries_of(tensor / size), jnp.zeros(2, tensor.dtype)])
    by, got = jax.jacfwd(found, has_aux=True)(here)
    every = score_of(got, by).information
    air = every[6:, 6:] + jnp.eye(2, dtype=tensor.dtype)
    determinant = air[0, 0] * air[1, 1] - air[0, 1] * air[1, 0]
    swapped = jnp.stack([jnp.stack([air[1, 1], -air[0, 1]]), jnp.stack([-air[1, 0], air[0, 0]])])
    return every[:6, :6] - every[:6, 6:] @ (swapped / determinant) @ every[6:, :6]
