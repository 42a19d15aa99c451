"""Likelihood of the readings of gyroscope and wheel under random torques and sensor noise.

The gyroscope's rates define a rotating frame, in which a Kalman filter propagates the momentum
``L = R (I omega + h)``. Drag, a torque with a correlation time, and every error of the gyroscope,
which also rotates the frame, change the momentum. The filter compares predicted with measured
rates. Measured rates are never coefficients of the unknowns, so their noise does not bias the
inertia towards zero (errors in variables), and with the determinants of the covariances the
likelihood is that of the readings alone (the trajectory is integrated out: Schweppe, IEEE Trans.
Inf. Theory 11 (1965) 61).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from benchmarks.throws.instrument import Instrument
from benchmarks.throws.numerics import (
    attitudes,
    central_differences,
    cofactors_of,
    interpolate_gaps,
    inverse_of,
)
from polhode.fit import Recording


class Noise(NamedTuple):
    """Standard deviations of readings and disturbing torques, by body on the leading axis n.

    ``omega``, rad/s: noise of a residual, ``omega_wheel``: addition at the maximum wheel speed;
    ``torque``, N m s^(1/2): white torques, ``torque_wheel``: addition at the maximum wheel speed
    (both additions grow with the square of the speed, as for an imbalance); ``slow``, N m: a torque
    with the correlation time ``memory``, s; ``wheel``, rad/s: noise of the wheel's speed in a
    residual.
    """

    omega: Float[Array, "*n"]
    omega_wheel: Float[Array, "*n"]
    torque: Float[Array, "*n"]
    torque_wheel: Float[Array, "*n"]
    slow: Float[Array, "*n"]
    memory: Float[Array, ""]
    wheel: Float[Array, ""]

    def grown(self, factor: Array) -> "Noise":
        """The noise of a body of ``factor`` times the inertia: torques are proportional to it."""
        torque, wheel, slow = (x * factor for x in (self.torque, self.torque_wheel, self.slow))
        return self._replace(torque=torque, torque_wheel=wheel, slow=slow)


class Readings(NamedTuple):
    """Recordings (leading axis r) cut into blocks, each of which provides one residual.

    ``known`` (r, b): 1 if a block has rates and wheel speed; ``stir`` (r, b): squared speed of the
    wheel relative to its maximum; ``body`` (r,): number of the body.
    """

    times: Float[Array, "*r t"]
    omega: Float[Array, "*r t 3"]
    wheel: Float[Array, "*r t"]
    known: Float[Array, "*r b"]
    stir: Float[Array, "*r b"]
    body: Array


def readings_of(recording: Recording, body: Array, block: int) -> Readings:
    """Prepare recordings (leading axis r) of the bodies with numbers ``body`` (r,)."""
    times = recording.times
    omega = jax.vmap(interpolate_gaps)(times, recording.present, recording.omega)
    wheel, sample = jnp.zeros_like(times), recording.present
    if recording.wheel is not None and recording.wheel_known is not None:
        wheel, sample = recording.wheel, sample * recording.wheel_known
    count = (times.shape[1] - 1) // block

    def blocks(values):
        cut = values[:, : count * block]
        return jnp.mean(cut.reshape(-1, count, block), axis=2)

    known = jnp.floor(blocks(sample))
    fast = jnp.max(jnp.abs(wheel) * sample)
    stir = (blocks(wheel) / jnp.where(fast > 0, fast, 1)) ** 2
    return Readings(times, omega, wheel, known, stir, body)


class Innovations(NamedTuple):
    """Measured rates minus those predicted from all earlier readings, and their covariances."""

    rest: Float[Array, "b 3"]
    covariance: Float[Array, "b 3 3"]


class _Moved(NamedTuple):
    """Inputs of a filter step for one block (leading axis: blocks)."""

    rates: Array  # mean rates
    carried: Array  # mean momentum of the wheel, body axes
    back: Array  # mean of R^T
    turn: Array  # R in the middle of the block
    spun: Array  # derivative of the momentum gained in the block by the error of the rate
    gained: Array  # momentum gained from drag
    span: Array
    known: Array
    omega: Array  # variance of the rates
    torque: Array  # variance of the impulse of the white torque


def innovations(
    data: Readings,
    tensor: Float[Array, "3 3"],
    drag: Float[Array, " 2"],
    instrument: Instrument,
    noise: Noise,
) -> Innovations:
    """Innovations of one recording; ``drag``: linear, N m s, and quadratic, N m s^2, isotropic.

    Momenta are divided by half the trace of the tensor, so that all numbers have the size of rates.
    """
    count = data.known.shape[0]
    block = (data.times.shape[0] - 1) // count
    size = jnp.trace(tensor) / 2
    unit = jnp.eye(3, dtype=tensor.dtype)
    body = tensor / size
    inverse = inverse_of(body)

    def cut(values):
        return values[: count * block].reshape(count, block, *values.shape[1:])

    rates = instrument.rates(data.omega)
    turn = attitudes(rates, central_differences(rates, data.times), data.times)
    carried = instrument.carried(data.times, data.wheel) / size
    speed = jnp.sqrt(jnp.sum(rates**2, axis=1, keepdims=True) + jnp.finfo(rates.dtype).tiny)
    push = -(drag[0] + drag[1] * speed) / size * rates
    ends = data.times[: count * block + 1 : block]
    span = jnp.diff(ends)
    mean = jnp.mean(cut(rates), axis=1), jnp.mean(cut(carried), axis=1)
    middle = cut(turn)[:, block // 2]
    momentum = jnp.einsum("ij,bj->bi", body, mean[0]) + mean[1]
    spun = jnp.einsum("bij,bjk->bik", middle, -_hat(momentum)) * span[:, None, None]
    gained = jnp.mean(cut(jnp.einsum("tij,tj->ti", turn, push)), axis=1) * span[:, None]
    omega = noise.omega**2 + (noise.omega_wheel * data.stir) ** 2
    torque = (noise.torque**2 + (noise.torque_wheel * data.stir) ** 2) * span / size**2
    spin = 0.0 if instrument.spin_inertia is None else instrument.spin_inertia
    along = jnp.einsum("ij,j->i", inverse, instrument.axis) * spin / size
    wheel = noise.wheel**2 * along[:, None] * along[None]
    slow = (noise.slow / size) ** 2

    def step(state, now: _Moved):
        # momentum and slow torque (6,), the latter in body axes
        mean, spread = state
        back = inverse @ now.back
        # mean rates are those in the middle of a block, when half of a torque's impulse has acted
        expects = jnp.concatenate([back, now.span / 2 * back @ now.turn], axis=1)
        rest = now.rates - (expects @ mean + back @ now.gained / 2 - inverse @ now.carried)
        heard = unit + back @ now.spun / 2
        seen = expects @ spread @ expects.T + now.omega * heard @ heard.T + wheel
        stays = jnp.exp(-now.span / noise.memory)
        moves = jnp.block([[unit, now.span * now.turn], [jnp.zeros_like(unit), stays * unit]])
        shaken = now.torque * unit + now.omega * now.spun @ now.spun.T
        fresh = slow * (1 - stays**2) * unit
        zero = jnp.zeros_like(unit)
        # covariance: one error affects both the reading and the rotation of the frame
        both = jnp.concatenate([now.omega * now.spun @ heard.T, zero])
        gain = (moves @ spread @ expects.T + both) @ inverse_of(seen) * now.known
        mean = moves @ mean + jnp.concatenate([now.gained, jnp.zeros_like(rest)]) + gain @ rest
        spread = moves @ spread @ moves.T + jnp.block([[shaken, zero], [zero, fresh]])
        spread = spread - gain @ seen @ gain.T
        found = Innovations(jnp.where(now.known > 0, rest, 0), jnp.where(now.known > 0, seen, unit))
        return (mean, (spread + spread.T) / 2), found

    # diffuse prior of the initial momentum: the rms rate as the standard deviation of the rates
    wide = jnp.mean(speed**2)
    zero = jnp.zeros_like(unit)
    begin = jnp.block([[wide * body @ body.T, zero], [zero, slow * unit]])
    start = jnp.concatenate([momentum[0], jnp.zeros_like(momentum[0])])
    back = jnp.swapaxes(jnp.mean(cut(turn), axis=1), -1, -2)
    moved = _Moved(*mean, back, middle, spun, gained, span, data.known, omega, torque)
    _, found = jax.lax.scan(step, (start, begin), moved)
    return found


def _hat(vector: Float[Array, "b 3"]) -> Float[Array, "b 3 3"]:
    """The matrix of ``vector x``."""
    x, y, z = (vector[:, k] for k in range(3))
    o = jnp.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def negative_log_likelihood(found: Innovations) -> Float[Array, ""]:
    """Negative log-likelihood, up to a constant."""
    weighed = jnp.einsum("bi,bij,bj->", found.rest, inverse_of(found.covariance), found.rest)
    return (weighed + jnp.sum(jnp.log(cofactors_of(found.covariance)[0]))) / 2


class Score(NamedTuple):
    """``negative_log_likelihood``, its derivatives with respect to p unknowns, the Fisher
    information, and the innovations over their standard deviation ``spread``, rad/s.
    """

    negative_log_likelihood: Float[Array, "*r"]
    slope: Float[Array, "*r p"]
    information: Float[Array, "*r p p"]
    rest: Float[Array, "*r b 3"]
    spread: Float[Array, "*r b 3"]


def score_of(found: Innovations, by: Innovations) -> Score:
    """Score of innovations whose derivatives with respect to p unknowns (last axis) are ``by``."""
    inverse = inverse_of(found.covariance)
    pull = jnp.einsum("bij,bj->bi", inverse, found.rest)
    relative = jnp.einsum("bij,bjkp->bikp", inverse, by.covariance)
    slope = jnp.einsum("bip,bi->p", by.rest, pull)
    slope = slope - jnp.einsum("bi,bijp,bj->p", pull, by.covariance, pull) / 2
    slope = slope + jnp.einsum("biip->p", relative) / 2
    shown = jnp.einsum("bip,bij,bjq->pq", by.rest, inverse, by.rest)
    shown = shown + jnp.einsum("bikp,bkiq->pq", relative, relative) / 2
    spread = jnp.sqrt(jnp.diagonal(found.covariance, axis1=1, axis2=2))
    return Score(negative_log_likelihood(found), slope, shown, found.rest / spread, spread)
