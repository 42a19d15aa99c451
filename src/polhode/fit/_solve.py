"""The fit of one body: starting points, optimisation, and linearisation at the optimum."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from polhode.fit._model import (
    AbstractInertiaUnknown,
    AbstractMotion,
    Base,
    FreeMotion,
    FullTensor,
    Parameters,
    SteppedMotion,
    base_of,
    entries_of,
    free_columns,
    is_nearly_flat,
    whole_of,
)
from polhode.fit._numerics import LevenbergMarquardt, curvature_rows, eigh
from polhode.fit._options import WALK_KNOTS, FitOptions, Gyroscope, Huber, noise_is_trusted
from polhode.fit._recording import (
    Recording,
    interpolate_gaps,
    require_channel,
    size_of_data,
    turns_between_samples,
    turns_of_rates,
)
from polhode.fit._residuals import (
    Linear,
    Model,
    linearise,
    prior_cost,
    prior_residuals,
    square_sum,
    unknowns,
)
from polhode.fit._start import (
    alternative_starts,
    nearest_physical,
    neighbour_noise_variance,
    regression,
)
from polhode.inertia import Inertia, inertia_of_second_moments, second_moments

# Growing parts of the recording, fitted in turn where a fit of the whole ends in a local minimum.
_PARTS = (0.1, 0.2, 0.35, 0.6, 1.0)
# Standard deviation of a prior of ``shape`` while a part of the data alone hardly determines it.
_SPREAD = 0.1
# Residuals up to this multiple of the noise (known, or estimated from neighbouring samples) end the
# search for a better minimum.
_GOOD = 1.5
# Residuals beyond this multiple of the noise do not end it, even if two starts reach one optimum.
_BAD = 5.0
# Two costs with a smaller relative difference belong to one optimum.
_SAME = 1e-4
# A fit that did not converge replaces a converged one only if its cost is lower by more than this,
# in units of the variance of the noise.
_ALIKE = 2.0
# Least noise, as a part of the readings, in the weight of the calibration's prior: with noise-free
# readings the prior would otherwise have no weight and the calibration would be undetermined.
_LEAST_NOISE = 1e-6
# Distance from the optimum, in standard deviations, at which the optimiser stops.
_OFFSET = 1e-4


class Solution(eqx.Module):
    """The optimum and the residuals linearised there.

    ``tensor``: of arbitrary size where the data do not determine it. ``linear``: residuals and
    Jacobian by the entries of the tensor (xx, yy, zz, and for a full one yz, zx, xy) and the other
    unknowns. ``cost``: half the sum of squares. ``steps``: of all attempts together. ``attempts``:
    number of starting points tried. ``stopped``: whether the optimiser converged. ``expected``: the
    sum of squares that noise alone would leave.
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
    """Carry of the search loop: the next row of ``_sequence_of_fits`` (``job``), the parameters
    that the last fit reached, and the best solution so far; ``good``: whether the search ends."""

    job: Array
    scaled_parameters: Parameters
    best: Parameters
    base: Base
    linear: Linear
    cost: Array
    steps: Array
    attempts: Array
    stopped: Array
    good: Array


def solve_fit(recording: Recording, options: FitOptions) -> Solution:
    """Fit one body to its recordings (leading axis r). Pure; works under jit and vmap."""
    motion = FreeMotion() if options.motion is None else options.motion
    gyroscope = Gyroscope() if options.gyroscope is None else options.gyroscope
    bias = _bias_of_rates(recording, options, gyroscope)
    rates = _rates(recording)
    if bias is not None:
        rates = rates - bias[None, None]
    unknown = FullTensor() if options.unknown is None else options.unknown
    bases, initial_moments = _bases(recording, rates, motion, unknown, options.initial_inertia)
    scale_known = motion.fixes_scale()
    columns = free_columns(unknown, scale_known)
    column_tuples = tuple(map(tuple, columns.tolist()))
    attitude = None if recording.wxyz is None else recording.wxyz[:, 0]

    def model_of(base):
        return Model(motion, base, attitude, options.robust, column_tuples, scale_known, gyroscope)

    dtype = rates.dtype
    zero = jnp.zeros(3, dtype)
    first_parameters = Parameters(
        shape=jnp.zeros(columns.shape[1], dtype),
        omega=rates[:, 0],
        attitude=None if attitude is None else jnp.zeros((rates.shape[0], 3), dtype),
        mounting=zero if options.mounting else None,
        lever=zero if recording.force is not None else None,
        motion=jax.tree.map(lambda x: jnp.asarray(x, dtype), motion.start()),
        **_sensor_start(recording, gyroscope, bias, dtype),
    )
    scale = _scale(first_parameters, recording, rates, gyroscope)
    # The optimiser computes in the default precision, whatever the precision of the data.
    optimiser_dtype = jnp.result_type(float)
    unbounded = dataclasses.replace(
        first_parameters, motion=motion.unbounded(first_parameters.motion)
    )
    first_scaled = jax.tree.map(lambda a, b: (a / b).astype(optimiser_dtype), unbounded, scale)

    def parameters_of(scaled_parameters):
        solution = jax.tree.map(lambda a, b: a.astype(dtype) * b, scaled_parameters, scale)
        return dataclasses.replace(solution, motion=motion.bounded(solution.motion))

    weight = _weight(recording, rates)
    solver = options.solver or LevenbergMarquardt(_OFFSET, float(jnp.finfo(dtype).eps) ** 0.75)
    expected = _expected_square_sum(recording, options)
    count = _data_count(recording)
    # standard deviation of one residual: 1 where the noise is known
    noise = jnp.sqrt(expected / count)
    noise = jnp.where(jnp.isfinite(noise), noise, 0.1 / weight)

    layout = unknowns(first_parameters, model_of(jax.tree.map(lambda leaf: leaf[0], bases)))
    trusted = noise_is_trusted(options)

    @jax.jit
    def linear_at(shared, own, data_part, base):
        # jit: traced once, however often the optimiser evaluates it
        return linearise(shared, own, layout, data_part, model_of(base))

    def prior_unit(linear):
        """Standard deviation of the residuals, the factor of the prior's residuals.

        With a known noise it is one, else that of the present residuals: the sum of squares is then
        proportional, to first order in 1/T, to the log-likelihood with an unknown noise.
        """
        unit = jnp.ones((), dtype)
        if not trusted:
            unit = jnp.sqrt(square_sum(linear.residuals, count, options.robust) / count)
        typical = 10 / weight / jnp.sqrt(count / rates.shape[0])
        return jnp.maximum(unit, _LEAST_NOISE * typical)

    def misfits(scaled_parameters, job):
        base, data_part, shape_weight = job
        parameters = parameters_of(scaled_parameters)
        values = unknowns(parameters, model_of(base))
        # Residuals and Jacobian are computed here together, by blocks. The optimiser then
        # differentiates a linear function: its own Jacobian costs no further integration.
        at = jax.lax.stop_gradient((values.shared, values.own))
        linear = linear_at(*at, data_part, base)
        misfit = linear.residuals_near(values.shared - at[0], values.own - at[1])
        unit = jax.lax.stop_gradient(prior_unit(linear))
        rows = [misfit.ravel(), shape_weight * scaled_parameters.shape.astype(dtype)]
        rows += [unit * part for part in prior_residuals(parameters, recording, model_of(base))]

        def cost_at(motion_values):
            moved = dataclasses.replace(parameters, motion=motion_values)
            values = unknowns(moved, model_of(base))
            misfit = linear.residuals_near(values.shared - at[0], values.own - at[1])
            prior = prior_residuals(moved, recording, model_of(base))
            return sum(jnp.sum(x**2) for x in (misfit, *(unit * part for part in prior))) / 2

        if motion.has_bounds:
            numbers = scaled_parameters.motion
            rows += curvature_rows(motion.bounded, numbers, scale.motion, cost_at)
        return (weight * jnp.concatenate(rows)).astype(optimiser_dtype), linear

    jobs = _sequence_of_fits(bases.soft.shape[0], options.max_starts)
    which, part = (jnp.asarray(column) for column in (jobs["base"], jobs["part"]))
    part = part.astype(dtype)
    span = recording.times[:, -1:] - recording.times[:, :1]
    elapsed = recording.times - recording.times[:, :1]

    def attempt(search):
        job = search.job
        part_mask = (elapsed <= part[job] * span).astype(dtype)
        data_part = recording.present * part_mask
        data_part = eqx.tree_at(lambda r: r.present, recording, data_part)
        base = jax.tree.map(lambda leaf: leaf[which[job]], bases)
        restarts = jnp.asarray(jobs["anew"])[job]
        shape_weight = jnp.where(part[job] < 1, noise / _SPREAD, 0)
        start = jax.tree.map(
            lambda a, b: jnp.where(restarts, a, b), first_scaled, search.scaled_parameters
        )
        solution = optx.least_squares(
            misfits,
            solver,
            start,
            (base, data_part, shape_weight),
            has_aux=True,
            max_steps=options.max_steps,
            throw=False,
        )
        # the auxiliary output of the last accepted step; ``solution.aux`` is that of the one before
        linear = solution.state.aux
        cost = jnp.sum(linear.residuals**2) / 2
        cost = cost + prior_unit(linear) ** 2 * prior_cost(
            parameters_of(solution.value), recording, model_of(base)
        )
        uses_all_data = part[job] == 1
        # of two fits with nearly equal costs, prefer the one that converged
        converged = solution.result == optx.RESULTS.successful
        ahead = converged.astype(dtype) - search.stopped.astype(dtype)
        better = uses_all_data & (cost < search.cost + ahead * _ALIKE * prior_unit(linear) ** 2)
        # Two starts that reach the same optimum near the noise end the search: a third rarely finds
        # a better one. Far above the noise both may have reached the same local minimum.
        same_optimum = uses_all_data & (jnp.abs(cost - search.cost) < _SAME * cost)
        candidate = (solution.value, base, linear, cost, converged)
        previous = (search.best, search.base, search.linear, search.cost, search.stopped)
        best, base, linear, cost, stopped = jax.tree.map(
            lambda a, b: jnp.where(better, a, b), candidate, previous
        )
        misfit = misfit_of(linear, options.robust)
        limit = jnp.where(same_optimum, _BAD, _GOOD) ** 2 * expected
        return _Search(
            job + 1,
            solution.value,
            best,
            base,
            linear,
            cost,
            search.steps + solution.stats["num_steps"],
            search.attempts + jnp.where(uses_all_data, 1, 0),
            stopped,
            # a flat body, at the limit of what is physical, is often a local minimum: search on
            stopped & (misfit <= limit) & ~_is_flat(linear, model_of(base)),
        )

    first_base = jax.tree.map(lambda leaf: leaf[0], bases)
    _, struct = jax.eval_shape(misfits, first_scaled, (first_base, recording, noise))
    empty_linear = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), struct)
    # the starting body, for the case that no attempt has a finite cost
    body = entries_of(inertia_of_second_moments(initial_moments), model_of(first_base).entries)
    empty_linear = empty_linear._replace(at=empty_linear.at.at[: body.shape[0]].set(body))
    first_search = _Search(
        jnp.asarray(0),
        first_scaled,
        first_scaled,
        first_base,
        empty_linear,
        jnp.asarray(jnp.inf, dtype),
        jnp.asarray(0),
        jnp.asarray(0),
        jnp.asarray(False),
        jnp.asarray(False),
    )
    job_count = len(jobs["base"])
    last_search = jax.lax.while_loop(lambda s: (s.job < job_count) & ~s.good, attempt, first_search)
    model = model_of(last_search.base)
    return Solution(
        parameters_of(last_search.best),
        model,
        whole_of(last_search.linear.at, model.entries),
        last_search.linear,
        last_search.cost,
        last_search.steps,
        last_search.attempts,
        last_search.stopped,
        expected,
    )


def _bias_of_rates(
    recording: Recording, options: FitOptions, gyroscope: Gyroscope
) -> Float[Array, " 3"] | None:
    """The bias to start from, in calibrated rates: the mean difference from the rates of attitudes,
    or zero without attitudes; None where it is not fitted."""
    if recording.omega is None or not (options.bias or gyroscope.bias_std):
        return None
    if recording.wxyz is None or options.mounting:
        return jnp.zeros(3, recording.omega.dtype)
    both_present = recording.present[:, 1:] * recording.present[:, :-1]
    turns = turns_of_rates(recording) - turns_between_samples(recording)
    total = jnp.sum(both_present * jnp.diff(recording.times, axis=-1))
    return jnp.sum(both_present[..., None] * turns, axis=(0, 1)) / jnp.where(total > 0, total, 1)


def _is_flat(linear: Linear, model: Model) -> Array:
    """Whether the body is nearly flat."""
    if model.entries == 0:
        return jnp.asarray(False)
    tensor = whole_of(linear.at, model.entries)
    return is_nearly_flat(tensor, eigh(tensor)[0])


def _sensor_start(
    recording: Recording, gyroscope: Gyroscope, bias: Array | None, dtype: jnp.dtype
) -> dict[str, Array | None]:
    """Starting values of the gyroscope's unknowns: the calibrated ones (zero), and ``bias``, which
    is converted from rates to readings; none without a gyroscope."""
    if recording.omega is None:
        return {}
    walk = (recording.times.shape[0], WALK_KNOTS, 3)
    if bias is not None and gyroscope.gain is not None:
        bias = gyroscope.gain.astype(dtype) @ bias
    return {
        "bias": bias,
        "gain": jnp.zeros(9, dtype) if gyroscope.gain_std.any() else None,
        "delay": jnp.zeros((), dtype) if gyroscope.delay_std else None,
        "walk": jnp.zeros(walk, dtype) if gyroscope.bias_walk else None,
    }


def _data_count(recording: Recording) -> Float[Array, ""]:
    """Number of measured values."""
    channels = (recording.omega, recording.wxyz, recording.force)
    return size_of_data(recording, 3 * sum(channel is not None for channel in channels))


def _sequence_of_fits(bases: int, attempts: int) -> dict[str, np.ndarray]:
    """The fits in their order: two starts to all data, then each start to growing parts.

    ``anew``: whether a fit begins at the starting values instead of the end of the previous one.
    """
    tries = [[(base, 1.0, True)] for base in range(min(bases, 2))]
    for base in range(bases):
        tries.append([(base, part, part == _PARTS[0]) for part in _PARTS])
    rows = [row for attempt_rows in tries[: max(attempts, 1)] for row in attempt_rows]
    base, part, anew = zip(*rows, strict=True)
    return {"base": np.array(base), "part": np.array(part), "anew": np.array(anew)}


def misfit_of(linear: Linear, robust: Huber | None) -> Float[Array, ""]:
    """The sum of squares to compare with the noise; outliers count as ``robust.threshold``."""
    square = linear.residuals**2
    return jnp.sum(square if robust is None else jnp.minimum(square, robust.threshold**2))


def _expected_square_sum(recording: Recording, options: FitOptions) -> Float[Array, ""]:
    """The sum of squares that noise alone would leave.

    An unknown noise is estimated from neighbouring samples: of the rates, or without rates, of the
    accumulated rotation vectors (body axes).
    """
    expected = _data_count(recording)
    if noise_is_trusted(options):
        return expected
    if recording.omega is None:
        values = turns_between_samples(recording)
        values = jnp.pad(jnp.cumsum(values, axis=1), ((0, 0), (1, 0), (0, 0)))
        noise = require_channel("attitude_noise", recording.attitude_noise)[..., None]
    else:
        values = recording.omega
        noise = require_channel("omega_noise", recording.omega_noise)
    variance = jax.vmap(neighbour_noise_variance)(recording.times, values, recording.present)
    variance = variance / jnp.mean(noise, axis=(1, 2)) ** 2
    # infinite for recordings without five samples in a row
    is_finite = jnp.isfinite(variance)
    count = jnp.maximum(jnp.sum(is_finite), 1).astype(variance.dtype)
    mean = jnp.sum(jnp.where(is_finite, variance, 0)) / count
    mean = jnp.where(jnp.any(is_finite), mean, jnp.inf)
    # noise-free readings can be fitted only to the optimiser's tolerance
    rounding = float(jnp.finfo(mean.dtype).eps) ** 0.75
    least_variance = rounding**2 * jnp.mean((values / noise) ** 2)
    return expected * jnp.maximum(mean, least_variance)


def _weight(recording: Recording, rates: Array) -> Float[Array, ""]:
    """Factor of the residuals that gives data of norm ten, for which the optimiser's initial
    damping of one is mild.

    The damping is absolute: it would have no effect on residuals in units of a small noise.
    """
    total = jnp.zeros((), rates.dtype)
    if recording.omega is not None:
        noise = require_channel("omega_noise", recording.omega_noise)
        total += jnp.sum(recording.present[..., None] * (rates / noise) ** 2)
    if recording.wxyz is not None:
        noise = require_channel("attitude_noise", recording.attitude_noise)
        total += jnp.sum(recording.present / noise**2)
    if recording.force is not None:
        noise = require_channel("force_noise", recording.force_noise)
        total += jnp.sum(recording.present[..., None] * (recording.force / noise) ** 2)
    mean = total / rates.shape[0]
    return 10 / jnp.sqrt(jnp.where(mean > 0, mean, 1))


def _beside(steps: Float[Array, "r t-1 c"]) -> Float[Array, "r t c"]:
    """Sum, at each sample, of the values of the intervals before and after it."""
    before, after = (jnp.pad(steps, ((0, 0), side, (0, 0))) for side in ((1, 0), (0, 1)))
    return before + after


def _rates(recording: Recording) -> Float[Array, "r t 3"]:
    """Measured rates, or those between successive attitudes; gaps filled by interpolation."""
    if recording.omega is None:
        # at each sample the mean over the adjacent intervals whose two ends are present
        both_present = recording.present[:, 1:] * recording.present[:, :-1]
        steps = jnp.diff(recording.times, axis=-1)
        rates = both_present[..., None] * turns_between_samples(recording) / steps[..., None]
        sums, counts = (_beside(x) for x in (rates, both_present[..., None]))
        values, has_rate = sums / jnp.maximum(counts, 1), (counts[..., 0] > 0).astype(rates.dtype)
        return interpolate_gaps(recording.times, has_rate, values)
    return interpolate_gaps(recording.times, recording.present, recording.omega)


def _bases(
    recording: Recording,
    rates: Array,
    motion: AbstractMotion,
    unknown: AbstractInertiaUnknown,
    initial: Inertia | None,
) -> tuple[Base, Array]:
    """Starting bodies (leading axis), the most promising first, and its second moments."""
    if unknown.columns().shape[1] == 0:
        whole_moments = jnp.eye(3, dtype=rates.dtype)
        return jax.tree.map(lambda leaf: leaf[None], base_of(whole_moments, True)), whole_moments
    wheel_momentum = None
    if isinstance(motion, SteppedMotion) and motion.spin_inertia is not None:
        axis = jnp.asarray(motion.axis, rates.dtype)
        wheel = require_channel("wheel", recording.wheel)
        wheel_momentum = motion.spin_inertia * wheel[..., None] * axis[None, None]
    whole_moments, piece_moments, _ = regression(
        rates, recording.times, recording.present, wheel_momentum
    )
    if initial is not None:
        whole_moments = nearest_physical(second_moments(initial.tensor))
    bodies = jnp.stack([whole_moments, piece_moments, *alternative_starts(rates, whole_moments)])
    if unknown.columns().shape[1] == 3:
        bodies = bodies * jnp.eye(3, dtype=bodies.dtype)[None]
    scale_known = motion.fixes_scale()
    return jax.vmap(lambda sigma: base_of(sigma, scale_known))(bodies), bodies[0]


def _scale(
    begin: Parameters, recording: Recording, rates: Array, gyroscope: Gyroscope
) -> Parameters:
    """Typical sizes of the unknowns: in these units one damping suits them all."""
    typical = jnp.sqrt(jnp.mean(rates**2)) + jnp.finfo(rates.dtype).tiny
    of_reading = typical
    if gyroscope.gain is not None:
        of_reading = typical * jnp.max(jnp.abs(gyroscope.gain)).astype(rates.dtype)
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
        bias=like(begin.bias, of_reading),
        mounting=like(begin.mounting, one),
        lever=like(begin.lever, length),
        motion=jax.tree.map(_size, begin.motion),
        gain=like(begin.gain, jnp.asarray(0.1, rates.dtype)),
        delay=like(begin.delay, jnp.mean(jnp.diff(recording.times))),
        walk=like(begin.walk, of_reading),
    )


def _size(start: Array) -> Array:
    """Sizes of the unknowns of an array: of their starting values; for a zero that of the largest
    one in the array, or one."""
    largest = jnp.max(jnp.abs(start), initial=0)
    beside = jnp.where(largest > 0, largest, 1)
    return jnp.where(start != 0, jnp.abs(start), beside)
