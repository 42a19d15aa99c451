"""Maximum-likelihood estimates of inertia, drag, instrument and noise from throws.

Fisher scoring on the likelihood of ``benchmarks.throws.likelihood`` with priors for the instrument
(its tolerances), drag and noise. The estimated bodies fit a part of the noise of the readings, so
that the remaining scatter underestimates it: the noise is therefore estimated by the restricted
likelihood, which adds half the log-determinant of the information about all other unknowns
(Patterson and Thompson, Biometrika 58 (1971) 545).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.throws.instrument import Instrument, Tolerance
from benchmarks.throws.likelihood import Noise, Readings, Score, innovations, score_of
from benchmarks.throws.numerics import (
    SCALE,
    entries_of,
    origin_of,
    start_by_regression,
    tensor_of,
)

# directions of symmetric traceless matrices, orthonormal
_SKEW = np.zeros((5, 3, 3))
_SKEW[0] = np.diag([1, -1, 0]) / np.sqrt(2)
_SKEW[1] = np.diag([1, 1, -2]) / np.sqrt(6)
for _k, (_i, _j) in enumerate(((1, 2), (2, 0), (0, 1))):
    _SKEW[2 + _k, _i, _j] = _SKEW[2 + _k, _j, _i] = np.sqrt(0.5)
# directions of the tensor: all six, or five and the size, which needs a wheel
_SIZED = np.eye(6)
_SIZELESS = np.linalg.svd(SCALE[None])[2][::-1].T
# Numbers of unknowns of a recording: tensor, drag and noise of its body, shared noise, instrument.
_TENSOR, _DRAG, _LEVEL, _COMMON, _DEVICE = 6, 2, 5, 2, 11
_PARTS = np.cumsum([_TENSOR, _DRAG, _LEVEL, _COMMON])
# Prior standard deviations: of the relative loss of spin by drag, and of the logarithms of the
# noise, of its correlation time and of the wheel's noise
_LOST, _WIDE, _NARROW = 0.15, 1.0, 0.7
# maximum number of steps, and the distance of the tensors from the maximum [standard deviations]
# at which the search ends (four times that for the other unknowns)
_STEPS, _NEAR = 200, 0.03
# largest change of the logarithms of the noise in a step
_LOUDER = 1.5
# step of the logarithms of the noise for finite differences
_SHIFT = 1e-2
# maximum number of updates of the restricted likelihood
_ROUNDS = 5


def instrument_of(unknown: Float[Array, " 11"], given: Instrument, tolerance: Tolerance):
    """The instrument that deviates by ``unknown`` tolerances from the given one."""
    size = tolerance.skew * unknown[:5]
    skew = jnp.einsum("k,kij->ij", size, jnp.asarray(_SKEW, unknown.dtype))
    tilt = tolerance.axis * unknown[5:7]
    # two directions normal to the axis
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


class Known(eqx.Module):
    """Constants of the unknowns: second moments of the bodies, instrument, noise."""

    sigma: Float[Array, "n 3 3"]
    instrument: Instrument
    tolerance: Tolerance
    noise: Noise

    def tensor(self, shape: Float[Array, " 6"], sigma: Float[Array, "3 3"]) -> Array:
        """The tensor (3, 3); without a wheel, ``shape`` does not change its size."""
        if self.instrument.spin_inertia is not None:
            return tensor_of(shape, origin_of(sigma), _SIZED)
        return tensor_of(shape.at[5].set(0), origin_of(sigma), _SIZELESS)

    def parts(self, unknown: Float[Array, " 26"], body: Array, drag: Array):
        """Tensor, drag, instrument and noise of one recording; ``drag``: its unit, over size."""
        shape, slowed, level, common, device = jnp.split(unknown, _PARTS)
        sigma = self.sigma[body]
        tensor = self.tensor(shape, sigma)
        own = [x[body] * jnp.exp(y) for x, y in zip(self.noise[:_LEVEL], level, strict=True)]
        # torques scale with the body: otherwise the scatter would bias its estimated size by about
        # 0.2 standard deviations upward if the wheel hardly moves the body
        grown = jnp.trace(tensor) / (2 * jnp.trace(sigma))
        shared = [x * jnp.exp(y) for x, y in zip(self.noise[_LEVEL:], common, strict=True)]
        instrument = instrument_of(device, self.instrument, self.tolerance)
        return (
            tensor,
            slowed * drag * jnp.trace(sigma),
            instrument,
            Noise(*own, *shared).grown(grown),
        )


class Fitted(eqx.Module):
    """Result of ``solve_balance``; ``covariance``: of the tensor's entries and the two drags."""

    tensors: Float[Array, "n 3 3"]
    drag: Float[Array, "n 2"]
    instrument: Instrument
    noise: Noise
    covariance: Float[Array, "n 8 8"]
    rest: Float[Array, "r b 3"]
    spread: Float[Array, "r b 3"]
    negative_log_likelihood: Float[Array, ""]
    steps: Array
    converged: Array


def _expected_square_sum(sized: bool) -> np.ndarray:
    """Prior precisions of the unknowns of a recording; those of the tensor are zero."""
    # without a wheel nothing depends on the size, which remains constant
    shape = [np.inf] * (_TENSOR - 1) + [np.inf if sized else 1.0]
    noise = [_WIDE] * _LEVEL + [_NARROW] * _COMMON
    return 1 / np.array(shape + [1.0] * _DRAG + noise + [1.0] * _DEVICE) ** 2


def solve_balance(data: Readings, known: Known, free: str) -> Fitted:
    """The most likely bodies. ``free``: "tensor" (and drag), "noise" (in addition), or "instrument"
    (all).
    """
    count, recordings = known.sigma.shape[0], data.body.shape[0]
    ends = {"tensor": _PARTS[1], "noise": _PARTS[3], "instrument": _PARTS[3] + _DEVICE}
    used, own = int(ends[free]), int(min(ends[free], _PARTS[2]))
    dtype = known.sigma.dtype
    # indices of a recording's unknowns: those of its body, then the shared ones
    common = count * own + np.arange(used - own)
    place = jnp.concatenate(
        [
            data.body[:, None] * own + np.arange(own)[None],
            jnp.broadcast_to(jnp.asarray(common), (recordings, used - own)),
        ],
        axis=1,
    )
    expected = _expected_square_sum(known.instrument.spin_inertia is not None)
    precision = jnp.asarray(
        np.concatenate([np.tile(expected[:own], count), expected[own:used]]), dtype
    )
    # steps of poorly determined noise overshoot, and are damped more than the others
    noise = np.zeros(used, bool)
    noise[_PARTS[1] : _PARTS[3]] = True
    heard, others = np.flatnonzero(noise), np.flatnonzero(~noise)
    loud = jnp.asarray(np.concatenate([np.tile(noise[:own], count), noise[own:]]), dtype)
    held = jnp.where(loud > 0, 1, 1e-3).astype(dtype)
    span = data.times[0, -1] - data.times[0, 0]
    typical = jnp.sqrt(jnp.mean(jnp.sum(data.omega**2, axis=2)))
    drag = _LOST / span * jnp.stack([jnp.ones_like(typical), 1 / typical])
    first = jnp.asarray(own * np.arange(count)[:, None] + np.arange(own)[None])
    inner = first[:, :_TENSOR]

    def score_by(data: Readings, unknown, which) -> Score:
        """Score of one recording with respect to some of its unknowns."""

        def found(part):
            missing = jnp.zeros(_PARTS[3] + _DEVICE - used, dtype)
            full = jnp.concatenate([unknown.at[which].set(part), missing])
            got = innovations(data, *known.parts(full, data.body, drag))
            return got, got

        by, found = jax.jacfwd(found, has_aux=True)(unknown[which])
        return score_of(found, by)

    def scored(unknown) -> Score:
        each = jax.vmap(lambda data, own: score_by(data, own, np.arange(used)))(
            data, unknown[place]
        )
        value = jnp.sum(each.negative_log_likelihood) + jnp.sum(precision * unknown**2) / 2
        slope = (precision * unknown).at[place].add(each.slope)
        shown = jnp.diag(precision).at[place[:, :, None], place[:, None, :]].add(each.information)
        return Score(value, slope, shown, each.rest, each.spread)

    def used_up(unknown, information):
        """Derivatives, with respect to the noise, of half the log-determinant of the information
        about all other unknowns.
        """

        def told(shift):
            each = jax.vmap(lambda data, own: score_by(data, own + shift, others))
            return each(data, unknown[place]).information

        # by finite differences: the program of second derivatives is several times as large
        shifts = np.zeros((1 + heard.size, used))
        shifts[1 + np.arange(heard.size), heard] = _SHIFT
        every = jax.lax.map(told, jnp.asarray(shifts, dtype))
        bends = (every[1:] - every[:1]) / _SHIFT
        # covariances for known noise
        quiet = 1 - loud
        sure = jnp.linalg.inv(information * quiet[None] * quiet[:, None] + jnp.diag(loud))
        where = place[:, others]
        sure = sure[where[:, :, None], where[:, None, :]]
        found = jnp.einsum("rpq,mrpq->rm", sure, bends) / 2
        return jnp.zeros_like(unknown).at[place[:, heard]].add(found)

    def restricted(unknown, information, lost, rounds):
        """Derivatives that the restricted likelihood adds, and the number of their updates."""
        # the mean of all updates: single updates may oscillate
        return lost + (used_up(unknown, information) - lost) / (rounds + 1), rounds + 1

    def far(score, lost):
        """Distance from the maximum in standard deviations: that of the bodies, or a quarter of
        that of the other unknowns if it is larger.
        """
        covariance = jnp.linalg.inv(score.information)
        left = covariance @ (score.slope + lost) / jnp.sqrt(jnp.diagonal(covariance))
        return jnp.maximum(jnp.max(jnp.abs(left[inner])), jnp.max(jnp.abs(left)) / 4)

    def again(carry):
        unknown, move, score, lost, rounds, damping, _, steps = carry
        tried = scored(unknown + move)
        value = tried.negative_log_likelihood + lost @ move
        well = jnp.isfinite(value) & (value <= score.negative_log_likelihood)
        score = jax.tree.map(lambda a, b: jnp.where(well, a, b), tried, score)
        unknown = jnp.where(well, unknown + move, unknown)
        damping = jnp.where(well, damping / 3, jnp.maximum(damping * 10, 1e-3))
        distance = far(score, lost)
        if heard.size:
            lost, rounds = jax.lax.cond(
                (distance < _NEAR) & (rounds < _ROUNDS),
                restricted,
                lambda *same: same[2:],
                unknown,
                score.information,
                lost,
                rounds,
            )
            distance = far(score, lost)
        shown = score.information
        shown = shown + damping * jnp.diag(held * jnp.diagonal(shown))
        move = -jnp.linalg.solve(shown, score.slope + lost)
        # from a distant start a full step could make the noise so large that anything is likely
        move = move / jnp.maximum(1, jnp.max(jnp.abs(loud * move)) / _LOUDER)
        return unknown, move, score, lost, rounds, damping, distance, steps + 1

    def unsettled(carry):
        *_, distance, steps = carry
        return ~(distance < _NEAR) & (steps < _STEPS)

    # the first iteration accepts the starting point: the value before it is infinite
    zero, large = jnp.zeros(loud.size, dtype), jnp.asarray(jnp.inf, dtype)
    blank = jnp.zeros((*data.known.shape, 3), dtype)
    nothing = Score(large, zero, jnp.eye(loud.size, dtype=dtype), blank, blank)
    state = (zero, zero, nothing, zero, 0, jnp.asarray(3e-3, dtype), large, 0)
    unknown, _, score, *_, distance, steps = jax.lax.while_loop(unsettled, again, state)
    covariance = jnp.linalg.inv(score.information)
    shared = jnp.broadcast_to(unknown[count * own :], (count, used - own))
    rest = jnp.zeros((count, _PARTS[3] + _DEVICE - used), dtype)
    every = jnp.concatenate([unknown[first], shared, rest], axis=1)
    bodies = jnp.arange(count)
    tensors, slowed, instrument, noise = jax.vmap(known.parts, in_axes=(0, 0, None))(
        every, bodies, drag
    )
    # shared by all bodies
    instrument = jax.tree.map(lambda x: x[0], instrument)
    noise = Noise(*noise[:_LEVEL], *(x[0] for x in noise[_LEVEL:]))

    def outputs(part, sigma):
        shape, slowed = part[:_TENSOR], part[_TENSOR:]
        moved = slowed * drag * jnp.trace(sigma)
        return jnp.concatenate([entries_of(known.tensor(shape, sigma)), moved])

    both = _TENSOR + _DRAG
    slopes = jax.vmap(jax.jacfwd(outputs))(every[:, :both], known.sigma)
    place = first[:, :both]
    blocks = covariance[place[:, :, None], place[:, None, :]]
    blocks = slopes @ blocks @ jnp.swapaxes(slopes, 1, 2)
    return Fitted(
        tensors,
        slowed,
        instrument,
        noise,
        blocks,
        score.rest,
        score.spread,
        score.negative_log_likelihood,
        steps,
        distance < _NEAR,
    )


def start_of(data: Readings, instrument: Instrument, count: int) -> tuple[Array, Noise]:
    """Second moments (n, 3, 3) by a regression with constant momentum, and the noise."""
    rates = jax.vmap(instrument.rates)(data.omega)
    carried = None
    if instrument.spin_inertia is not None:
        carried = jax.vmap(instrument.carried)(data.times, data.wheel)
    blocks = data.known.shape[1]
    block = (data.times.shape[1] - 1) // blocks

    def one(body):
        weight = jnp.repeat(data.known, block, axis=1)
        weight = jnp.pad(weight, ((0, 0), (0, data.times.shape[1] - weight.shape[1])))
        weight = weight * (data.body == body).astype(data.times.dtype)[:, None]
        sigma = start_by_regression(rates, data.times, weight, carried)
        return sigma, jnp.sqrt(
            jnp.sum(weight[..., None] * rates**2) / jnp.maximum(jnp.sum(weight), 1)
        )

    # one body after another: batched calls of LAPACK can deadlock (jax below 0.12)
    sigma, typical = jax.lax.map(one, jnp.arange(count))
    size = jnp.trace(sigma, axis1=1, axis2=2)
    span = data.times[0, -1] - data.times[0, 0]
    fast = jnp.max(jnp.abs(data.wheel))
    white = 1e-3 * size * typical / jnp.sqrt(span)
    return sigma, Noise(
        3e-4 * typical,
        1e-4 * typical,
        white,
        0.3 * white,
        0.01 * size * typical / span,
        0.1 * span,
        1e-3 * fast,
    )
