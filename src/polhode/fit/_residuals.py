"""Residuals of a fit in units of the noise, and their Jacobian by blocks."""

import dataclasses
from collections.abc import Callable
from functools import reduce
from operator import add
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from polhode._checks import ArrayLike
from polhode._kernels import kernel
from polhode.fit._model import (
    AbstractMotion,
    Base,
    Parameters,
    Predicted,
    entries_of,
    tensor_of,
    whole_of,
)
from polhode.fit._numerics import triangle
from polhode.fit._options import Gyroscope, Huber, calibrate
from polhode.fit._recording import (
    Recording,
    central_slope,
    require_channel,
    rotation_vector_between,
)
from polhode.rotation import conjugate, multiply, rotate, rotation_vector_to_wxyz

# Residuals: data minus model in units of the noise.

# Standard deviation of the prior for an entry of the gain that is exactly known.
_EXACT = 1e-9


class Model(eqx.Module):
    """The model of a fit: it maps ``Parameters`` and a ``Recording`` to residuals.

    **Fields:** ``motion``; ``base``, ``columns`` (static): origin and directions of
    ``Parameters.shape``; ``attitude`` (r, 4): first recorded attitudes, to which
    ``Parameters.attitude`` is relative, or None; ``robust``: a ``Huber`` or None; ``scale_known``
    (static): whether ``shape`` includes the size of the inertia; ``gyroscope``: its delay and the
    standard deviations of its calibration.
    """

    motion: AbstractMotion
    base: Base
    attitude: Float[Array, "r 4"] | None = None
    robust: Huber | None = None
    columns: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=())
    scale_known: bool = eqx.field(static=True, default=False)
    gyroscope: Gyroscope = Gyroscope()

    @property
    def entries(self) -> int:
        """Number of unknown entries of the tensor (static): 6, 3 (no products) or 0."""
        if not any(self.columns):
            return 0
        return 6 if any(any(row) for row in self.columns[3:]) else 3

    def tensor(self, parameters: Parameters) -> Float[Array, "3 3"]:
        """Inertia tensor (3, 3) in sensor axes, kg m^2 (or to scale)."""
        return tensor_of(parameters.shape, self.base, np.array(self.columns))


def predict(
    parameters: Parameters, recording: Recording, model: Model, tensor: Array | None = None
) -> Predicted:
    """Motion of every recording (leading axis r) for these parameters, body axes.

    ``tensor`` (3, 3): inertia in place of that of ``parameters.shape``. Returns ``omega``,
    ``omega_dot`` (r, T, 3) and ``wxyz`` (r, T, 4), the last two None where they are not computed.
    """
    if tensor is None:
        tensor = model.tensor(parameters)
    attitude = model.attitude
    if attitude is not None and parameters.attitude is not None:
        attitude = multiply(attitude, rotation_vector_to_wxyz(parameters.attitude))

    is_delayed = bool(model.gyroscope.delay) or parameters.delay is not None
    acceleration = is_delayed or recording.force is not None

    def predict_recording(omega, wxyz, times, wheel):
        return model.motion(tensor, omega, wxyz, times, wheel, parameters.motion, acceleration)

    return jax.vmap(predict_recording)(parameters.omega, attitude, recording.times, recording.wheel)


def residuals(
    parameters: Parameters, recording: Recording, model: Model, tensor: Array | None = None
) -> dict[str, Float[Array, "r t 3"]]:
    """Residuals of rates, attitudes (rotation vectors) and accelerometer, over their noise.

    ``recording`` carries one leading axis r: recordings of one body, with the readings as recorded.
    They are zero at gaps, and at a saturated reading while the model is beyond the limit. Any
    optimiser can minimise the sum of squares; ``jax.grad`` and ``jax.jacfwd`` differentiate it.
    """
    recording = calibrate(recording, model.gyroscope)
    return residuals_of_motion(
        predict(parameters, recording, model, tensor), parameters, recording, model
    )


def residuals_of_motion(
    motion: Predicted, parameters: Parameters, recording: Recording, model: Model
) -> dict[str, Float[Array, "r t 3"]]:
    """``residuals`` for a predicted motion; ``recording`` is calibrated (``calibrate``)."""
    weight = recording.present[..., None]
    parts = {}
    if recording.omega is not None:
        noise = require_channel("omega_noise", recording.omega_noise)
        residual = (
            weight * (recording.omega - _readings(motion, parameters, recording, model)) / noise
        )
        if recording.saturated is not None:
            # A reading at the upper limit is only a lower bound of the rate, and conversely.
            side = recording.saturated
            residual = jnp.where(side > 0, jnp.maximum(residual, 0), residual)
            residual = jnp.where(side < 0, jnp.minimum(residual, 0), residual)
        parts["omega"] = residual
    if recording.wxyz is not None:
        noise = require_channel("attitude_noise", recording.attitude_noise)
        rotation_error = rotation_vector_between(motion.wxyz, recording.wxyz)
        parts["attitude"] = weight * rotation_error / noise[..., None]
    if recording.force is not None:
        if motion.omega_dot is None:
            raise ValueError(
                "force_body needs a motion that gives angular accelerations: FreeMotion or "
                f"SteppedMotion, got {type(model.motion).__name__}."
            )
        noise = require_channel("force_noise", recording.force_noise)
        lever = jnp.broadcast_to(parameters.lever, motion.omega.shape)
        simulated_force = jnp.cross(motion.omega_dot, lever) + jnp.cross(
            motion.omega, jnp.cross(motion.omega, lever)
        )
        parts["force"] = weight * (recording.force - simulated_force) / noise
    if model.robust is not None:
        parts = {name: model.robust(part) for name, part in parts.items()}
    return parts


def _readings(
    motion: Predicted, parameters: Parameters, recording: Recording, model: Model
) -> Float[Array, "r t 3"]:
    """Noise-free readings of the gyroscope, in the units of ``Recording.omega``."""
    omega = motion.omega
    if model.gyroscope.delay or parameters.delay is not None:
        # Taylor series to second order: delays are short compared with the time scale of the rates.
        delay = model.gyroscope.delay
        delay = delay if parameters.delay is None else delay + parameters.delay
        slope = motion.omega_dot
        if slope is None:
            slope = jax.vmap(central_slope)(omega, recording.times)
        bend = jax.vmap(central_slope)(slope, recording.times)
        omega = omega - delay * slope + delay**2 / 2 * bend
    if parameters.mounting is not None:
        turn = conjugate(rotation_vector_to_wxyz(parameters.mounting))
        omega = rotate(jnp.broadcast_to(turn, (*omega.shape[:-1], 4)), omega)
    if parameters.gain is not None:
        errors = parameters.gain.reshape(3, 3)
        omega = omega + sum(errors[None, None, :, j] * omega[..., j, None] for j in range(3))
    gain = model.gyroscope.gain
    if parameters.bias is not None:
        omega = omega + _in_rates(parameters.bias, gain)[None, None]
    if parameters.walk is not None:
        omega = omega + jax.vmap(walk_of)(_in_rates(parameters.walk, gain), recording.times)
    return omega


def _in_rates(readings: Float[Array, "*b 3"], gain: Array | None) -> Float[Array, "*b 3"]:
    """``gain^-1 readings``, by the adjugate: a linear solver could not run in the fused kernel."""
    if gain is None:
        return readings
    columns = jnp.unstack(gain.astype(readings.dtype), axis=1)
    rows = [jnp.cross(columns[k - 2], columns[k - 1]) for k in range(3)]
    back = jnp.stack(rows) / jnp.sum(columns[0] * rows[0])
    return jnp.sum(back * readings[..., None, :], axis=-1)


def walk_of(steps: Float[Array, "k 3"], times: Float[Array, " t"]) -> Float[Array, "t 3"]:
    """The bias relative to its start; it changes by ``steps`` over k equal parts of ``times``."""
    count = steps.shape[0]
    part = (times - times[0]) / (times[-1] - times[0]) * count
    elapsed = jnp.clip(part[:, None] - jnp.arange(count, dtype=times.dtype)[None], 0, 1)
    return jnp.einsum("tk,ki->ti", elapsed, steps)


class Prior(NamedTuple):
    """Precisions (inverse variances) of the priors, by name as in ``Parameters``."""

    gain: Float[Array, " 9"] | None
    bias: Float[Array, " 3"] | None
    delay: Float[Array, ""] | None
    walk: Float[Array, "r k 3"] | None
    motion: list[Array | None]


def prior_of(parameters: Parameters, recording: Recording, model: Model) -> Prior:
    """The ``Prior`` of the unknowns; None where an unknown is absent or has no prior."""
    sensor, dtype = model.gyroscope, recording.times.dtype

    def precision(std, like):
        return None if like is None else jnp.broadcast_to(jnp.asarray(std, dtype) ** -2, like.shape)

    # an exactly known entry remains an unknown, which a narrow prior fixes
    widths = np.maximum(sensor.gain_std.ravel(), _EXACT)
    walk = None
    if parameters.walk is not None:
        span = recording.times[:, -1] - recording.times[:, 0]
        walk = parameters.walk.shape[1] / (sensor.bias_walk**2 * span)
        walk = jnp.broadcast_to(walk[:, None, None], parameters.walk.shape)
    return Prior(
        precision(widths, parameters.gain),
        precision(sensor.bias_std, parameters.bias) if sensor.bias_std else None,
        precision(sensor.delay_std, parameters.delay) if sensor.delay_std else None,
        walk,
        [
            None if std is None else jnp.broadcast_to(std, leaf.shape).astype(dtype) ** -2
            for std, leaf in zip(
                model.motion.prior_std(), jax.tree.leaves(parameters.motion), strict=True
            )
        ],
    )


def prior_residuals(parameters: Parameters, recording: Recording, model: Model) -> list[Array]:
    """Differences of the unknowns from their prior means, over the standard deviations."""
    prior = prior_of(parameters, recording, model)
    parts = [
        (precision, getattr(parameters, name))
        for name, precision in prior._asdict().items()
        if name != "motion" and precision is not None
    ]
    leaves = jax.tree.leaves(parameters.motion), jax.tree.leaves(model.motion.start())
    for precision, value, start in zip(prior.motion, *leaves, strict=True):
        if precision is not None:
            parts.append((precision, value - jnp.asarray(start, value.dtype)))
    return [(jnp.sqrt(precision) * value).ravel() for precision, value in parts]


def square_sum(residuals: Array, total: Array, robust: Huber | None) -> Float[Array, ""]:
    """Sum of squares of the residuals (r, t, c) of ``total`` values.

    With a robust loss, of which ``residuals`` are the result, that of normal noise as large as the
    residuals within the threshold are.
    """
    if robust is None:
        return jnp.sum(residuals**2)
    residuals = robust.inverse(residuals)
    is_inner = jnp.abs(residuals) <= robust.threshold
    inner_count = total - jnp.sum((~is_inner).astype(total.dtype))
    mean_square = jnp.sum(jnp.where(is_inner, residuals**2, 0)) / jnp.maximum(inner_count, 1)
    return total * mean_square / robust.inner_variance.astype(total.dtype)


def prior_cost(parameters: Parameters, recording: Recording, model: Model) -> Float[Array, ""]:
    """Half the sum of squares of ``prior_residuals``."""
    total = jnp.zeros((), recording.times.dtype)
    for part in prior_residuals(parameters, recording, model):
        total = total + jnp.sum(part**2) / 2
    return total


def log_density(
    recording: Recording,
    model: Model,
    prior: Callable[[Parameters], Array] | None = None,
    *,
    noise: ArrayLike = 1.0,
) -> Callable[[Parameters], Float[Array, ""]]:
    """Logarithm of the posterior density of ``Parameters``, up to a constant, for any sampler.

    ``recording`` as in ``residuals`` (one leading axis: ``stack([recording])``), ``model`` that of
    a fit, whose ``parameters`` are a suitable start for the sampler. ``prior`` adds the logarithm
    of a density (None: flat in the parameters, that is in the second moments away from flat
    bodies); the priors of the fit (calibration, ``prior_std``) are always included. ``noise``:
    standard deviation of the residuals over the noise of the recording; where the noise is not
    known, ``Fit.noise``.
    The result is a density for BlackJAX; its negative is a ``potential_fn`` for NumPyro.
    """

    variance = jnp.asarray(noise) ** 2

    def density(parameters):
        parts = residuals(parameters, recording, model)
        misfit = -reduce(add, (jnp.sum(part**2) for part in parts.values())) / variance / 2
        misfit = misfit - prior_cost(parameters, recording, model)
        return misfit if prior is None else misfit + prior(parameters)

    return density


# Residuals and their Jacobian in one pass, stored by blocks.
#
# Unknowns that recordings share (the tensor, a bias, a drag) fill one block per recording, unknowns
# of a recording (initial rates and attitude) another. The zeros between the blocks are neither
# computed nor stored: cost and memory grow linearly with the number of recordings.


class Linear(NamedTuple):
    """Residuals (c channels side by side), linearised at one point.

    ``shared``, ``own``, ``factored_residuals``: column blocks of the triangular factor R of a
    recording's matrix ``[derivatives by shared unknowns, by own unknowns, residuals] = Q R``. Its
    sums of squares and products are those of all samples, so that an optimiser works on a few rows.
    ``at``: the shared unknowns at that point. ``products``: for a robust loss, sums of products of
    the derivatives before the loss (unknowns in the order shared, own), by channel; else None.
    """

    residuals: Float[Array, "r t c"]
    shared: Float[Array, "r q s"]
    own: Float[Array, "r q o"]
    factored_residuals: Float[Array, "r q"]
    at: Float[Array, " s"]
    products: Float[Array, "r c u u"] | None = None

    def residuals_near(
        self, shared: Float[Array, " s"], own: Float[Array, "r o"]
    ) -> Float[Array, "r q"]:
        """``factored_residuals`` after small changes of the unknowns, to first order."""
        return (
            self.factored_residuals
            + jnp.einsum("rqs,s->rq", self.shared, shared)
            + jnp.einsum("rqo,ro->rq", self.own, own)
        )

    def scaled(self, sizes: Float[Array, " s"]) -> "Linear":
        """The same residuals by shared unknowns divided by ``sizes``."""
        products = self.products
        if products is not None:
            scale = jnp.concatenate([sizes, jnp.ones(self.own.shape[-1], sizes.dtype)])
            products = products * (scale[:, None] * scale[None])[None, None]
        return self._replace(shared=self.shared * sizes[None, None], products=products)

    def information(self, weights: Float[Array, "r c"] | None = None) -> Float[Array, "p p"]:
        """``J^T J`` in the order shared, then own unknowns recording by recording.

        ``weights``: of the channels of each recording in ``products``; None: without a robust loss.
        """
        (recordings, _, size), count = self.own.shape, self.shared.shape[-1]
        if weights is None:
            rows = jnp.concatenate([self.shared, self.own], axis=-1)
            products = jnp.einsum("rqu,rqv->ruv", rows, rows)
        else:
            products = jnp.einsum("rc,rcuv->ruv", weights, self.products)
        corner = jnp.sum(products[:, :count, :count], axis=0)
        side = jnp.moveaxis(products[:, :count, count:], 0, 1)
        side = side.reshape(corner.shape[0], recordings * size)
        blocks = products[:, count:, count:]
        own_blocks = (
            jnp.eye(recordings, dtype=corner.dtype)[:, None, :, None] * blocks[:, :, None, :]
        )
        below = own_blocks.reshape(recordings * size, recordings * size)
        return jnp.block([[corner, side], [side.T, below]])


class Unknowns(NamedTuple):
    """The unknowns of a fit as flat arrays, and the inverse map.

    ``shared`` (s,): the tensor's entries, bias, mounting, lever, the motion's own, gain and delay;
    ``own`` (r, o): rates, attitude and the walk of the bias of each recording. ``of_motion``,
    ``of_own`` (static): which of them the motion depends on; all others belong to the sensors.
    ``parameters``: function of ``shared`` and one row of ``own`` that returns the ``Parameters`` of
    that recording and the tensor.
    """

    shared: Float[Array, " s"]
    own: Float[Array, "r o"]
    of_motion: np.ndarray
    of_own: np.ndarray
    parameters: Callable[[Array, Array], tuple[Parameters, Array]]


def unknowns(parameters: Parameters, model: Model) -> Unknowns:
    """``Unknowns`` of these parameters. Entries of the tensor take the place of ``shape``, because
    they are regular coordinates for flat bodies too."""
    count = model.entries
    entries = entries_of(model.tensor(parameters), count)
    sensors = (parameters.bias, parameters.mounting, parameters.lever)
    calibration = (parameters.gain, parameters.delay)
    other_unknowns, back = ravel_pytree((sensors, parameters.motion, calibration))
    shared = jnp.concatenate([entries, other_unknowns.astype(entries.dtype)])
    own = [parameters.omega]
    if parameters.attitude is not None:
        own.append(parameters.attitude)
    motion_count = sum(part.shape[1] for part in own)
    if parameters.walk is not None:
        own.append(parameters.walk.reshape(parameters.walk.shape[0], -1))
    own = jnp.concatenate(own, axis=1)
    no_shape = jnp.zeros(0, entries.dtype)
    sizes = [
        sum(leaf.size for leaf in jax.tree.leaves(part))
        for part in (sensors, parameters.motion, calibration)
    ]
    of_motion = np.repeat([True, False, True, False], [count, *sizes])
    of_own = np.arange(own.shape[1]) < motion_count

    def parameters_of(shared, own):
        (bias, mounting, lever), motion, (gain, delay) = back(shared[count:])
        attitude = None if parameters.attitude is None else own[None, 3:6]
        walk = None if parameters.walk is None else own[motion_count:].reshape(1, -1, 3)
        values = Parameters(
            no_shape, own[None, :3], attitude, bias, mounting, lever, motion, gain, delay, walk
        )
        return values, whole_of(shared[:count], count)

    return Unknowns(shared, own, of_motion, of_own, parameters_of)


def with_entries(x: Array, places: np.ndarray, values: Array) -> Array:
    """``x`` (n,) with ``values`` at ``places``, by a gather: a scatter would leave the kernel."""
    order = np.arange(x.shape[0])
    order[places] = x.shape[0] + np.arange(places.size)
    return jnp.concatenate([x, values])[order]


def linearise(
    shared: Array, own: Array, layout: Unknowns, recording: Recording, model: Model
) -> Linear:
    """Residuals and Jacobian of all recordings: the motion appears once in the program.

    ``layout`` gives the order of ``shared`` and ``own``. The motion, which is the expensive part,
    is differentiated by the unknowns that it depends on only. The sensors' unknowns act on the
    predicted motion, so that their derivatives cost almost nothing.
    """
    motion_places, own_motion_places = (
        np.flatnonzero(layout.of_motion),
        np.flatnonzero(layout.of_own),
    )
    sensor_places, own_sensor_places = (
        np.flatnonzero(~layout.of_motion),
        np.flatnonzero(~layout.of_own),
    )

    def at(own, single, attitude):
        one_recording = jax.tree.map(lambda leaf: leaf[None], single)
        start = None if attitude is None else attitude[None]
        one_model = dataclasses.replace(model, attitude=start, robust=None)

        def flat(motion, parameters):
            parts = residuals_of_motion(motion, parameters, one_recording, one_model)
            return jnp.concatenate([part[0] for part in parts.values()], axis=-1)

        def residuals_at(motion_unknowns, own_motion_unknowns):
            parameters, tensor = layout.parameters(
                with_entries(shared, motion_places, motion_unknowns),
                with_entries(own, own_motion_places, own_motion_unknowns),
            )
            motion = predict(parameters, one_recording, one_model, tensor)
            rows = flat(motion, parameters)
            return rows, (rows, motion)

        def sensor_residuals(sensor_unknowns, own_sensor_unknowns):
            parameters, _ = layout.parameters(
                with_entries(shared, sensor_places, sensor_unknowns),
                with_entries(own, own_sensor_places, own_sensor_unknowns),
            )
            return flat(motion, parameters)

        slopes = jax.jacfwd(residuals_at, argnums=(0, 1), has_aux=True)
        (by_shared, by_own), (rows, motion) = slopes(shared[motion_places], own[own_motion_places])
        if sensor_places.size or own_sensor_places.size:
            by_sensors, own_by_sensors = jax.jacfwd(sensor_residuals, argnums=(0, 1))(
                shared[sensor_places], own[own_sensor_places]
            )
            by_shared = jnp.concatenate([by_shared, by_sensors], axis=-1)
            by_own = jnp.concatenate([by_own, own_by_sensors], axis=-1)
            by_shared = by_shared[..., np.argsort(np.concatenate([motion_places, sensor_places]))]
            by_own = by_own[..., np.argsort(np.concatenate([own_motion_places, own_sensor_places]))]
        return by_shared, by_own, rows

    by_shared, by_own, rows = kernel(jax.vmap(at))(own, recording, model.attitude)
    products = None
    if model.robust is not None:
        derivatives = jnp.concatenate([by_shared, by_own], axis=-1)
        products = jnp.einsum("rtcu,rtcv->rcuv", derivatives, derivatives)
        rows, slope = jax.jvp(model.robust, (rows,), (jnp.ones_like(rows),))
        by_shared, by_own = slope[..., None] * by_shared, slope[..., None] * by_own
    columns = jnp.concatenate([by_shared, by_own, rows[..., None]], axis=-1)
    columns = columns.reshape(rows.shape[0], -1, columns.shape[-1])
    factor = triangle(columns)
    count = shared.shape[0]
    parts = factor[..., :count], factor[..., count:-1], factor[..., -1]
    return Linear(rows, *parts, shared, products)
