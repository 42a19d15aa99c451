"""The balance of angular momentum along a measured motion, with torques that nobody knows.

The gyroscope turns the body frame itself: ``R(t)`` is integrated from its readings. With a wheel of
momentum ``h`` the sum ``I omega + h - R^T L`` vanishes, where L is constant in space but for the
torques of the air. These are taken for white noise, so L wanders as Brownian motion does: linear
between knots, each step as likely as its length allows. Nothing is simulated, so an error of the
wheel's speed stays where it is, and a gap in it costs its own samples only.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from polhode.fit._instrument import Instrument, Tolerance
from polhode.fit._linear import entries_of
from polhode.fit._matrices import inverse
from polhode.fit._parameters import base_of, tensor_of
from polhode.fit._recording import Recording, bridged, needed
from polhode.fit._start import central_slope, integrate, regression
from polhode.rotation import to_matrix

# directions of symmetric traceless matrices, orthonormal
_SKEW = np.zeros((5, 3, 3))
_SKEW[0] = np.diag([1, -1, 0]) / np.sqrt(2)
_SKEW[1] = np.diag([1, 1, -2]) / np.sqrt(6)
for _k, (_i, _j) in enumerate(((1, 2), (2, 0), (0, 1))):
    _SKEW[2 + _k, _i, _j] = _SKEW[2 + _k, _j, _i] = np.sqrt(0.5)
_ALL = np.eye(6)
# rounds of fitting and judging the noise at most, and the relative change of the noise in a round
# that is the last
_ROUNDS, _SETTLED = 60, 0.01


class Noise(NamedTuple):
    """Standard deviations per body: of the balance, rad/s; of the torque, N m s^(1/2)."""

    omega: Float[Array, " n"]
    torque: Float[Array, " n"]


class Balance(eqx.Module):
    """What all recordings bring to the balance, with the knots between which L is linear."""

    times: Float[Array, "r t"]
    omega: Float[Array, "r t 3"]
    wheel: Float[Array, "r t"]
    weight: Float[Array, "r b"]
    hats: Float[Array, "r b k"]
    spacing: Float[Array, " r"]
    body: Array

    @property
    def block(self) -> int:
        """Samples whose balance is averaged to one residual (static)."""
        return self.times.shape[1] // self.weight.shape[1]


def _blocks(values: Array, count: int, block: int) -> Array:
    """Means of blocks of the first axis."""
    return jnp.mean(values[: count * block].reshape(count, block, *values.shape[1:]), axis=1)


def balance_of(recording: Recording, body: Array, knots: int, block: int) -> Balance:
    """Prepare recordings (leading axis r) of the bodies with numbers ``body`` (r,)."""
    times = recording.times
    omega = bridged(times, recording.present, recording.omega)
    sample = recording.present * needed("wheel_known", recording.wheel_known)
    count = times.shape[1] // block
    weight = jax.vmap(lambda x: jnp.floor(_blocks(x, count, block)))(sample)
    end = jnp.max(jnp.where(sample > 0, times, times[:, :1]), axis=1)
    spacing = (end - times[:, 0]) / (knots - 1)
    place = (times - times[:, :1]) / spacing[:, None]
    apart = jnp.abs(place[..., None] - jnp.arange(knots, dtype=times.dtype)[None, None])
    hats = jax.vmap(lambda x: _blocks(x, count, block))(jnp.maximum(1 - apart, 0))
    hats = hats * weight[..., None]
    return Balance(times, omega, recording.wheel, weight, hats, spacing, body)


def instrument_of(unknown: Float[Array, " 11"], given: Instrument, tolerance: Tolerance):
    """The instrument that lies ``unknown`` tolerances from the one given."""
    size = tolerance.skew * unknown[:5]
    skew = jnp.einsum("k,kij->ij", size, jnp.asarray(_SKEW, unknown.dtype))
    tilt = tolerance.axis * unknown[5:7]
    # two directions at right angles to the axis
    helper = jnp.where(jnp.argmin(jnp.abs(given.axis)) == jnp.arange(3), 1.0, 0.0)
    first = jnp.cross(given.axis, helper.astype(unknown.dtype))
    first = first / jnp.sqrt(jnp.sum(first**2))
    second = jnp.cross(given.axis, first)
    axis = given.axis + tilt[0] * first + tilt[1] * second
    return Instrument(
        given.spin_inertia,
        axis / jnp.sqrt(jnp.sum(axis**2)),
        given.delay + tolerance.delay * unknown[7],
        skew if given.skew is None else given.skew + skew,
        tolerance.bias * unknown[8:] + (0 if given.bias is None else given.bias),
    )


class Balanced(NamedTuple):
    """Residuals in units of their noise, and what the noise is judged by."""

    rest: Float[Array, "r t 3"]
    steps: Float[Array, "r k 3"]
    held: Float[Array, " r"]


def balance(
    data: Balance, tensors: Array, weights: Array, instrument: Instrument, noise: Noise
) -> Balanced:
    """Residuals for tensors (n, 3, 3), the momenta L eliminated by linear least squares.

    ``weights`` (n, 3, 3): the inverse tensors that turn errors of momentum into those of rates.
    ``held``: how many of the steps between knots the data leave to their own probability.
    """

    blocks = data.weight.shape[1], data.block

    def one(times, omega, wheel, weight, hats, spacing, body):
        sigma, drift = noise.omega[body], noise.torque[body] * jnp.sqrt(spacing)
        rates = instrument.rates(omega)
        turn = to_matrix(integrate(rates, central_slope(rates, times), times))
        momentum = jnp.einsum("ij,tj->ti", tensors[body], rates) + instrument.carried(times, wheel)
        # averaged in space, where it hardly moves, and turned back to the middle of the block
        momentum = _blocks(jnp.einsum("tij,tj->ti", turn, momentum), *blocks)
        turn = turn[blocks[1] // 2 :: blocks[1]][: blocks[0]]
        momentum = jnp.einsum("tji,tj->ti", turn, momentum)
        scaled = jnp.einsum("ij,tj->ti", weights[body], momentum) * weight[:, None] / sigma
        lever = jnp.einsum("ij,tkj->tik", weights[body], turn) / sigma
        knots = hats.shape[1]
        square = jnp.einsum("tij,tik->tjk", lever, lever)
        pairs = (hats[:, :, None] * hats[:, None, :]).reshape(hats.shape[0], -1)
        normal = (pairs.T @ square.reshape(-1, 9)).reshape(knots, knots, 3, 3)
        step = np.diff(np.eye(knots), axis=0)
        chain = jnp.asarray(step.T @ step, omega.dtype)[:, :, None, None] / drift**2
        prior = chain * jnp.eye(3, dtype=omega.dtype)[None, None]

        def flat(blocks):
            return jnp.swapaxes(blocks, 1, 2).reshape(3 * knots, 3 * knots)

        right = jnp.einsum("tk,tij,ti->kj", hats, lever, scaled).ravel()
        both = flat(normal + prior)
        # The inverse of the value and one step of Newton's: it brings the derivatives as well.
        inverted = inverse(jax.lax.stop_gradient(both))
        momenta = inverted @ jax.lax.stop_gradient(right)
        momenta = momenta + inverted @ (right - both @ jax.lax.stop_gradient(momenta))
        momenta = momenta.reshape(knots, 3)
        rest = scaled - jnp.einsum("tij,tj->ti", lever, hats @ momenta)
        held = jnp.sum(inverted * jax.lax.stop_gradient(flat(prior)))
        return Balanced(rest, jnp.diff(momenta, axis=0) / drift, held)

    return jax.vmap(one)(
        data.times, data.omega, data.wheel, data.weight, data.hats, data.spacing, data.body
    )


class Fitted(eqx.Module):
    """Unknowns of a balance and their information."""

    tensors: Float[Array, "n 3 3"]
    instrument: Instrument
    noise: Noise
    covariance: Float[Array, "n 6 6"]
    rest: Float[Array, "r t 3"]
    converged: Array


def solve_balance(
    data: Balance,
    start: Float[Array, "n 3 3"],
    given: Instrument,
    tolerance: Tolerance,
    noise: Noise,
    free: bool,
) -> Fitted:
    """Tensors by Levenberg-Marquardt; with ``free`` the instrument and the noise as well."""
    count = start.shape[0]
    bases = jax.vmap(lambda sigma: base_of(sigma, True))(start)
    wide = jnp.result_type(float)

    def parts(unknown):
        shape, device = unknown
        tensors = jax.vmap(lambda y, base: tensor_of(y, base, _ALL))(shape, bases)
        instrument = instrument_of(device, given, tolerance) if free else given
        return tensors, instrument

    def misfit(unknown, args):
        weights, noise = args
        unknown = jax.tree.map(lambda x: x.astype(start.dtype), unknown)
        tensors, instrument = parts(unknown)
        found = balance(data, tensors, weights, instrument, noise)
        every = [found.rest.ravel(), found.steps.ravel()] + ([unknown[1]] if free else [])
        return jnp.concatenate(every).astype(wide), found

    def judged(found, noise):
        """The noise that makes the residuals as large as they should be (evidence, MacKay 1992)."""
        steps = 3 * (data.hats.shape[2] - 1)
        samples = 3 * jnp.sum(data.weight, axis=1)

        def by_body(values):
            return jax.ops.segment_sum(values, data.body, count)

        freedom = by_body(samples - 3 - steps + found.held) - 6
        rest = by_body(jnp.sum(found.rest**2, axis=(1, 2)))
        moved = by_body(jnp.sum(found.steps**2, axis=(1, 2)))
        # steps that the data show; where they show none the noise of the torque is nothing
        shown = jnp.maximum(by_body(steps - found.held), 1e-3)
        return Noise(noise.omega * jnp.sqrt(rest / freedom), noise.torque * jnp.sqrt(moved / shown))

    solver = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)

    def attempt(unknown, noise):
        weights = inverse(parts(unknown)[0])
        found = optx.least_squares(
            misfit, solver, jax.tree.map(lambda x: x.astype(wide), unknown), (weights, noise),
            has_aux=True, max_steps=30, throw=False,
        )  # fmt: skip
        unknown = jax.tree.map(lambda x: x.astype(start.dtype), found.value)
        # of the last accepted step; ``found.aux`` is that of the one before
        linear = found.state.f_info.jac.as_matrix()
        return unknown, found.state.aux, linear, found.result == optx.RESULTS.successful

    def again(carry):
        unknown, noise, _, _, _, rounds = carry
        unknown, found, linear, well = attempt(unknown, noise)
        better = judged(found, noise) if free else noise
        moved = jnp.max(jnp.abs(jnp.log(jnp.stack(better) / jnp.stack(noise))))
        settled = well & (moved < _SETTLED) & (rounds > 0)
        return unknown, better, found.rest, linear, settled, rounds + 1

    unknown = (jnp.zeros((count, 6), start.dtype), jnp.zeros(11, start.dtype))
    _, _, rest, linear, *_ = jax.eval_shape(again, (unknown, noise, 0, 0, 0, 0))
    nothing = [jnp.zeros(x.shape, x.dtype) for x in (rest, linear)]

    def unsettled(carry):
        *_, settled, rounds = carry
        return ~settled & (rounds < _ROUNDS)

    unknown, noise, rest, linear, converged, _ = jax.lax.while_loop(
        unsettled,
        again,
        (unknown, noise, *nothing, jnp.asarray(False), 0),
    )
    tensors, instrument = parts(unknown)

    def entries(shape, base):
        return entries_of(tensor_of(shape, base, _ALL), 6)

    slopes = jax.vmap(jax.jacfwd(entries))(unknown[0], bases)
    # the instrument, when it is not fitted, has no derivatives
    used = 6 * count + (11 if free else 0)
    covariance = inverse(linear[:, :used].T @ linear[:, :used]).astype(start.dtype)
    blocks = jnp.stack([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])
    blocks = slopes @ blocks @ jnp.swapaxes(slopes, 1, 2)
    return Fitted(tensors, instrument, noise, blocks, rest, converged)


def start_of(data: Balance, instrument: Instrument, count: int) -> tuple[Array, Noise]:
    """Second moments (n, 3, 3) by a regression with a constant momentum, and a noise."""
    rates = jax.vmap(instrument.rates)(data.omega)
    carried = jax.vmap(instrument.carried)(data.times, data.wheel)

    def one(body):
        weight = jnp.repeat(data.weight, data.block, axis=1)
        weight = jnp.pad(weight, ((0, 0), (0, data.times.shape[1] - weight.shape[1])))
        weight = weight * (data.body == body).astype(data.times.dtype)[:, None]
        _, sigma, _ = regression(rates, data.times, weight, carried)
        return sigma, jnp.sqrt(
            jnp.sum(weight[..., None] * rates**2) / jnp.maximum(jnp.sum(weight), 1)
        )

    sigma, typical = jax.vmap(one)(jnp.arange(count))
    size = jnp.trace(sigma, axis1=1, axis2=2)
    span = data.times[0, -1] - data.times[0, 0]
    return sigma, Noise(1e-3 * typical, 0.01 * size * typical / jnp.sqrt(span))
