"""From recordings of one body to its best parameters: start, Levenberg-Marquardt, information."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from polhode.fit._gyroscope import WALK_KNOTS, Gyroscope
from polhode.fit._linear import Linear, linearise, unknowns
from polhode.fit._motion import AbstractMotion, FreeMotion, SteppedMotion
from polhode.fit._optimiser import LevenbergMarquardt
from polhode.fit._options import FitOptions, noise_is_trusted
from polhode.fit._parameters import (
    AbstractInertiaUnknown,
    Base,
    FullTensor,
    Parameters,
    base_of,
    entries_of,
    free_columns,
    whole_of,
)
from polhode.fit._recording import Recording, bridged, needed, size_of_data, turn_between
from polhode.fit._residuals import Huber, Model, departures, prior_cost
from polhode.fit._start import alternatives, regression, scatter
from polhode.inertia import Inertia, inertia_of_second_moments, second_moments

# Parts of the recording that are fitted one after the other where the whole misleads at first.
_PARTS = (0.1, 0.2, 0.35, 0.6, 1.0)
# Spread of the shape about its start that is believed while a part alone hardly shows it.
_SPREAD = 0.1
# Residuals up to this multiple of the noise, or of what neighbouring samples show of it, end the
# search for a better valley.
_GOOD = 1.5
# Relative difference of two costs that are those of one optimum.
_SAME = 1e-4
# Part of the readings that always counts as noise beside the calibration's prior: without it
# noise-free readings would leave the calibration free.
_LEAST_NOISE = 1e-6
# Distance from the optimum, in standard deviations, at which the optimiser stops.
_OFFSET = 1e-4


class Solution(eqx.Module):
    """The optimum and everything that is linear about it.

    ``tensor``: of any size where the data show none. ``linear``: residuals and Jacobian by the
    entries of the tensor (xx, yy, zz, and for a full one yz, zx, xy) and the other unknowns.
    ``cost``: half the sum of squares. ``steps``: of all attempts together. ``attempts``: how many
    starts were tried. ``expected``: the sum of squares that noise alone would leave.
    """

    parameters: Parameters
    model: Model
    tensor: Float[Array, "3 3"]
    linear: Linear
    cost: Float[Array, ""]
    steps: Array
    attempts: Array
    stopped: Array
    expected: Float[Array, ""]


class _Search(eqx.Module):
    """Where the search stands: the job at hand, where it left off, and the best so far."""

    job: Array
    scaled: Parameters
    best: Parameters
    base: Base
    linear: Linear
    cost: Array
    steps: Array
    attempts: Array
    stopped: Array
    good: Array


def solve(recording: Recording, options: FitOptions) -> Solution:
    """Fit one body to its recordings (leading axis r). Pure; works under jit and vmap."""
    rates = _rates(recording)
    motion = FreeMotion() if options.motion is None else options.motion
    gyroscope = Gyroscope() if options.gyroscope is None else options.gyroscope
    unknown = FullTensor() if options.unknown is None else options.unknown
    bases, first = _bases(recording, rates, motion, unknown, options.initial_inertia)
    scale_known = motion.fixes_scale()
    columns = free_columns(unknown, scale_known)
    fixed = tuple(map(tuple, columns.tolist()))
    attitude = None if recording.wxyz is None else recording.wxyz[:, 0]

    def model_of(base):
        return Model(motion, base, attitude, options.robust, fixed, scale_known, gyroscope)

    dtype = rates.dtype
    zero = jnp.zeros(3, dtype)
    begin = Parameters(
        shape=jnp.zeros(columns.shape[1], dtype),
        omega=rates[:, 0],
        attitude=None if attitude is None else jnp.zeros((rates.shape[0], 3), dtype),
        mounting=zero if options.mounting else None,
        lever=zero if recording.force is not None else None,
        motion=jax.tree.map(lambda x: jnp.asarray(x, dtype), motion.start()),
        **_sensor_start(recording, gyroscope, options.bias, dtype),
    )
    scale = _scale(begin, recording, rates)
    # the optimiser counts in the default precision whatever that of the data
    wide = jnp.result_type(float)
    unbounded = dataclasses.replace(begin, motion=motion.unbounded(begin.motion))
    fresh = jax.tree.map(lambda a, b: (a / b).astype(wide), unbounded, scale)

    def actual(scaled):
        found = jax.tree.map(lambda a, b: a.astype(dtype) * b, scaled, scale)
        return dataclasses.replace(found, motion=motion.bounded(found.motion))

    weight = _weight(recording, rates)
    solver = options.solver or LevenbergMarquardt(_OFFSET, float(jnp.finfo(dtype).eps) ** 0.75)
    expected = _expected(recording, options)
    # of one residual: 1 where the noise is known
    noise = jnp.sqrt(expected / _data(recording))
    noise = jnp.where(jnp.isfinite(noise), noise, 0.1 / weight)

    layout = unknowns(begin, model_of(jax.tree.map(lambda leaf: leaf[0], bases)))
    count = _data(recording)
    trusted = noise_is_trusted(options)

    @jax.jit
    def linear_at(shared, own, within, base):
        # traced once, however often the optimiser asks
        return linearise(shared, own, layout, within, model_of(base))

    def prior_unit(linear):
        """Noise of the residuals, the unit in which the calibration's prior is weighed.

        With a known noise it is one. Else it is that of the present residuals: the sum of squares
        is then proportional, to first order in 1/T, to the logarithm of the likelihood of an
        unknown noise.
        """
        unit = jnp.ones((), dtype) if trusted else jnp.sqrt(jnp.sum(linear.rest**2) / count)
        typical = 10 / weight / jnp.sqrt(count / rates.shape[0])
        return jnp.maximum(unit, _LEAST_NOISE * typical)

    def misfits(scaled, job):
        base, within, belief = job
        parameters = actual(scaled)
        values = unknowns(parameters, model_of(base))
        # The Jacobian is made here, once and by blocks: what the optimiser differentiates is linear
        at = jax.lax.stop_gradient((values.shared, values.own))
        linear = linear_at(*at, within, base)
        misfit = linear.shifted(values.shared - at[0], values.own - at[1])
        unit = jax.lax.stop_gradient(prior_unit(linear))
        rows = [misfit.ravel(), belief * scaled.shape.astype(dtype)]
        rows += [unit * part for part in departures(parameters, recording, model_of(base))]
        return (weight * jnp.concatenate(rows)).astype(wide), linear

    jobs = _jobs(bases.soft.shape[0], options.max_starts)
    which, part = (jnp.asarray(column) for column in (jobs["base"], jobs["part"]))
    part = part.astype(dtype)
    span = recording.times[:, -1:] - recording.times[:, :1]
    elapsed = recording.times - recording.times[:, :1]

    def attempt(search):
        job = search.job
        early = (elapsed <= part[job] * span).astype(dtype)
        within = recording.present * early
        within = eqx.tree_at(lambda r: r.present, recording, within)
        base = jax.tree.map(lambda leaf: leaf[which[job]], bases)
        anew = jnp.asarray(jobs["anew"])[job]
        belief = jnp.where(part[job] < 1, noise / _SPREAD, 0)
        start = jax.tree.map(lambda a, b: jnp.where(anew, a, b), fresh, search.scaled)
        found = optx.least_squares(
            misfits, solver, start, (base, within, belief),
            has_aux=True, max_steps=options.max_steps, throw=False,
        )  # fmt: skip
        # the auxiliary output of the last accepted step; ``found.aux`` is that of the one before
        linear = found.state.aux
        cost = jnp.sum(linear.rest**2) / 2
        cost = cost + prior_unit(linear) ** 2 * prior_cost(
            actual(found.value), recording, model_of(base)
        )
        whole = part[job] == 1
        better = whole & (cost < search.cost)
        # two starts that lead to one place leave little hope for a third
        again = whole & (jnp.abs(cost - search.cost) < _SAME * cost)
        new = (found.value, base, linear, cost, found.result == optx.RESULTS.successful)
        old = (search.best, search.base, search.linear, search.cost, search.stopped)
        best, base, linear, cost, stopped = jax.tree.map(
            lambda a, b: jnp.where(better, a, b), new, old
        )
        return _Search(
            job + 1, found.value, best, base, linear, cost,
            search.steps + found.stats["num_steps"], search.attempts + jnp.where(whole, 1, 0),
            stopped, stopped & (again | (misfit_of(linear, options.robust) <= _GOOD**2 * expected)),
        )  # fmt: skip

    one = jax.tree.map(lambda leaf: leaf[0], bases)
    _, struct = jax.eval_shape(misfits, fresh, (one, recording, noise))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), struct)
    # the body to begin with, should no attempt come to an end
    body = entries_of(inertia_of_second_moments(first), model_of(one).entries)
    nothing = nothing._replace(at=nothing.at.at[: body.shape[0]].set(body))
    begun = _Search(
        jnp.asarray(0), fresh, fresh, one, nothing, jnp.asarray(jnp.inf, dtype),
        jnp.asarray(0), jnp.asarray(0), jnp.asarray(False), jnp.asarray(False),
    )  # fmt: skip
    last = len(jobs["base"])
    ended = jax.lax.while_loop(lambda s: (s.job < last) & ~s.good, attempt, begun)
    model = model_of(ended.base)
    return Solution(
        actual(ended.best), model, whole_of(ended.linear.at, model.entries), ended.linear,
        ended.cost, ended.steps, ended.attempts, ended.stopped, expected,
    )  # fmt: skip


def _sensor_start(
    recording: Recording, gyroscope: Gyroscope, bias: bool, dtype: jnp.dtype
) -> dict[str, Array | None]:
    """The unknowns of the gyroscope, at their calibrated values; none without its readings."""
    if recording.omega is None:
        return {}
    walk = (recording.times.shape[0], WALK_KNOTS, 3)
    return {
        "bias": jnp.zeros(3, dtype) if bias or gyroscope.bias_std else None,
        "gain": jnp.zeros(9, dtype) if gyroscope.gain_std.any() else None,
        "delay": jnp.zeros((), dtype) if gyroscope.delay_std else None,
        "walk": jnp.zeros(walk, dtype) if gyroscope.bias_walk else None,
    }


def _data(recording: Recording) -> Float[Array, ""]:
    """How many numbers were measured."""
    return size_of_data(recording, 3 * _kinds(recording))


def _jobs(bases: int, attempts: int) -> dict[str, np.ndarray]:
    """What is fitted in turn: the first two to all data, then each start to growing parts."""
    tries = [[(base, 1.0, True)] for base in range(min(bases, 2))]
    for base in range(bases):
        tries.append([(base, part, part == _PARTS[0]) for part in _PARTS])
    rows = [row for one in tries[: max(attempts, 1)] for row in one]
    base, part, anew = zip(*rows, strict=True)
    return {"base": np.array(base), "part": np.array(part), "anew": np.array(anew)}


def misfit_of(linear: Linear, robust: Huber | None) -> Float[Array, ""]:
    """The sum of squares that is to be compared with the noise: an outlier counts as its bound."""
    square = linear.rest**2
    return jnp.sum(square if robust is None else jnp.minimum(square, robust.threshold**2))


def _kinds(recording: Recording) -> int:
    """How many of rates, attitudes and forces there are."""
    return sum(part is not None for part in (recording.omega, recording.wxyz, recording.force))


def _expected(recording: Recording, options: FitOptions) -> Float[Array, ""]:
    """The sum of squares that noise alone would leave.

    An unknown noise is taken from neighbouring samples; without rates nothing is known of it.
    """
    expected = _data(recording)
    if noise_is_trusted(options):
        return expected
    if recording.omega is None:
        return jnp.full_like(expected, jnp.inf)
    omega_noise = needed("omega_noise", recording.omega_noise)
    seen = jax.vmap(scatter)(recording.times, recording.omega, recording.present)
    seen = seen / jnp.mean(omega_noise, axis=(1, 2)) ** 2
    # recordings without five samples in a row tell nothing
    told = jnp.isfinite(seen)
    count = jnp.maximum(jnp.sum(told), 1).astype(seen.dtype)
    mean = jnp.sum(jnp.where(told, seen, 0)) / count
    mean = jnp.where(jnp.any(told), mean, jnp.inf)
    # readings without any noise are met to what the optimiser takes for rounding at best
    rounding = float(jnp.finfo(mean.dtype).eps) ** 0.75
    least = rounding**2 * jnp.mean((recording.omega / omega_noise) ** 2)
    return expected * jnp.maximum(mean, least)


def _weight(recording: Recording, rates: Array) -> Float[Array, ""]:
    """Brings the Jacobian to the order of ten, where the optimiser's first damping of one is mild.

    The damping is absolute, so that residuals in units of a small noise would switch it off.
    """
    total = jnp.zeros((), rates.dtype)
    if recording.omega is not None:
        noise = needed("omega_noise", recording.omega_noise)
        total += jnp.sum(recording.present[..., None] * (rates / noise) ** 2)
    if recording.wxyz is not None:
        noise = needed("attitude_noise", recording.attitude_noise)
        total += jnp.sum(recording.present / noise**2)
    if recording.force is not None:
        noise = needed("force_noise", recording.force_noise)
        total += jnp.sum(recording.present[..., None] * (recording.force / noise) ** 2)
    mean = total / rates.shape[0]
    return 10 / jnp.sqrt(jnp.where(mean > 0, mean, 1))


def _rates(recording: Recording) -> Float[Array, "r t 3"]:
    """Measured rates, or those between successive attitudes; gaps filled by interpolation."""
    if recording.omega is None:
        wxyz = needed("wxyz", recording.wxyz)
        step = jnp.diff(recording.times, axis=-1)[..., None]
        between = turn_between(wxyz[:, :-1], wxyz[:, 1:]) / step
        inner = (between[:, 1:] + between[:, :-1]) / 2
        return jnp.concatenate([between[:, :1], inner, between[:, -1:]], axis=1)
    return bridged(recording.times, recording.present, recording.omega)


def _bases(
    recording: Recording,
    rates: Array,
    motion: AbstractMotion,
    unknown: AbstractInertiaUnknown,
    initial: Inertia | None,
) -> tuple[Base, Array]:
    """Starting bodies (leading axis), the best first, and the second moments of that one."""
    if unknown.columns().shape[1] == 0:
        first = jnp.eye(3, dtype=rates.dtype)
        return jax.tree.map(lambda leaf: leaf[None], base_of(first, True)), first
    carried = None
    if isinstance(motion, SteppedMotion) and motion.spin_inertia is not None:
        axis = jnp.asarray(motion.axis, rates.dtype)
        wheel = needed("wheel", recording.wheel)
        carried = motion.spin_inertia * wheel[..., None] * axis[None, None]
    first, second, _ = regression(rates, recording.times, recording.present, carried)
    if initial is not None:
        first = second_moments(initial.tensor)
    bodies = jnp.stack([first, second, *alternatives(rates, first)])
    if unknown.columns().shape[1] == 3:
        bodies = bodies * jnp.eye(3, dtype=bodies.dtype)[None]
    known = motion.fixes_scale()
    return jax.vmap(lambda sigma: base_of(sigma, known))(bodies), bodies[0]


def _scale(begin: Parameters, recording: Recording, rates: Array) -> Parameters:
    """Natural sizes of the unknowns, so that one damping suits them all."""
    typical = jnp.sqrt(jnp.mean(rates**2)) + jnp.finfo(rates.dtype).tiny
    one = jnp.ones((), rates.dtype)

    def like(leaf, size):
        return None if leaf is None else jnp.broadcast_to(size, leaf.shape)

    length = one
    if recording.force is not None:
        length = jnp.sqrt(jnp.mean(recording.force**2)) / typical**2 + jnp.finfo(rates.dtype).tiny
    return Parameters(
        shape=like(begin.shape, one),
        omega=like(begin.omega, typical),
        attitude=like(begin.attitude, one),
        bias=like(begin.bias, typical),
        mounting=like(begin.mounting, one),
        lever=like(begin.lever, length),
        motion=jax.tree.map(_size, begin.motion),
        gain=like(begin.gain, jnp.asarray(0.1, rates.dtype)),
        delay=like(begin.delay, jnp.mean(jnp.diff(recording.times))),
        walk=like(begin.walk, typical),
    )


def _size(start: Array) -> Array:
    """Sizes of unknowns: of their start, where that is zero of the largest beside it, or one."""
    largest = jnp.max(jnp.abs(start), initial=0)
    beside = jnp.where(largest > 0, largest, 1)
    return jnp.where(start != 0, jnp.abs(start), beside)
