"""How far the data of a fit determine its unknowns: information, covariance, null directions."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from polhode.fit._numerics import eigh
from polhode.fit._options import Huber
from polhode.fit._recording import Recording, is_measured, size_of_data
from polhode.fit._residuals import prior_of, square_sum
from polhode.fit._solve import Solution

# Component of a quantity along null directions, relative to it, above which it is undetermined.
_MAX_NULL_PART = 1e-3


class NullSpace(eqx.Module):
    """Directions of the p unknowns that the data do not determine.

    **Fields:** ``directions`` (..., p, p): as columns, zero for the others, orthonormal in
    ``unit`` (..., p), the scales of the unknowns.
    """

    directions: Float[Array, "*b p p"]
    unit: Float[Array, "*b p"]

    def undetermines(
        self, derivative: Float[Array, "q p"], size: Array | None = None
    ) -> Bool[Array, " q"]:
        """Whether quantities with this ``derivative`` have a component along a null direction.

        ``size`` (q,): change of each quantity to which the component is compared; None: the norm of
        its derivative in ``unit``.
        """
        part = jnp.sqrt(jnp.sum((derivative @ self.directions) ** 2, axis=1))
        size = self.size_of(derivative) if size is None else size
        return part > _MAX_NULL_PART * size

    def size_of(self, derivative: Float[Array, "q p"]) -> Float[Array, " q"]:
        """Norms of the rows of ``derivative`` in ``unit``."""
        return jnp.sqrt(jnp.sum((derivative * self.unit[None]) ** 2, axis=1))


class Determination(NamedTuple):
    """How far the data determine p unknowns: ``information`` and ``covariance`` (p, p); ``null``
    and the number ``null_count`` of its directions; ``noise``: standard deviation of the residuals
    over the assumed one; ``count``: number of unknowns that the data determine."""

    information: Array
    covariance: Array
    null: NullSpace
    null_count: Array
    noise: Array
    count: Array


def determination_of(solution: Solution, recording: Recording, trust_noise: bool) -> Determination:
    """``Determination`` from the Jacobian of a fit; unknowns in the order shared, then own.

    Unknowns with a prior (the sensor's calibration) are eliminated: conditional on them the
    covariance of the others is the pseudo-inverse of their information. Null directions then follow
    from the data alone, whatever the prior, and in single precision too.
    """
    linear, robust = solution.linear, solution.model.robust
    residuals, weights = linear.residuals, None
    if robust is not None:
        weights = _expected_weights(residuals, recording, robust, trust_noise)
    information = linear.information(weights)
    dtype = information.dtype
    has_prior, precision = _priors(solution, recording)
    free_indices = np.flatnonzero(~has_prior)
    free_information = information[np.ix_(free_indices, free_indices)]
    # Scaled to unit diagonal: the threshold of a null direction must not depend on units.
    size = jnp.sqrt(jnp.diagonal(free_information))
    safe = jnp.where(size > 0, size, 1)
    values, vectors = eigh(free_information / safe[:, None] / safe[None])
    determined = values > 1e3 * float(jnp.finfo(dtype).eps) * values[-1]
    inverse_values = jnp.where(determined, 1 / jnp.where(determined, values, 1), 0)
    covariance = (vectors * inverse_values[None]) @ vectors.T / safe[:, None] / safe[None]
    null = NullSpace(jnp.where(determined, 0, 1)[None] * vectors / safe[:, None], 1 / safe)
    count = jnp.sum(determined).astype(dtype)
    total = size_of_data(recording, residuals.shape[-1])
    square = square_sum(residuals, total, robust)
    if not has_prior.any():
        noise = jnp.sqrt(square / jnp.maximum(total - count, 1))
        variance = jnp.asarray(1, dtype) if trust_noise else noise**2
        null_count = jnp.sum(~determined)
        return Determination(information, covariance * variance, null, null_count, noise, count)
    with_prior_index = np.flatnonzero(has_prior)
    cross = information[np.ix_(free_indices, with_prior_index)]
    width = precision**-0.5
    correction = covariance @ cross
    # Information of the data about the calibration, in units of the prior's standard deviation.
    block = information[np.ix_(with_prior_index, with_prior_index)]
    data = (block - cross.T @ correction) * width[:, None] * width[None]
    gained_information, axes = eigh((data + data.T) / 2)
    # It is the difference of two large matrices: values below the rounding error count as zero.
    rounding = 1e3 * float(jnp.finfo(dtype).eps) * jnp.max(jnp.diagonal(block) * width**2)
    gained_information = jnp.where(gained_information > rounding, gained_information, 0)
    # Degrees of freedom: an unknown with a prior counts by the fraction that the data determine.
    # That depends on the noise; one fixed-point step suffices.
    noise = jnp.sqrt(square / jnp.maximum(total - count, 1))
    count = count + jnp.sum(gained_information / (gained_information + noise**2))
    noise = jnp.sqrt(square / jnp.maximum(total - count, 1))
    variance = jnp.asarray(1, dtype) if trust_noise else noise**2
    # Posterior covariance of the calibration: 1 / (information / variance + 1) by eigenvectors.
    spread = (
        axes * (1 / (gained_information / jnp.where(variance > 0, variance, 1) + 1))[None]
    ) @ axes.T
    spread = jnp.where(variance > 0, spread, 0) if not trust_noise else spread
    spread = spread * width[:, None] * width[None]
    cross_covariance = -correction @ spread
    full_covariance = jnp.zeros_like(information)
    full_covariance = full_covariance.at[np.ix_(free_indices, free_indices)].set(
        covariance * variance - cross_covariance @ correction.T
    )
    full_covariance = (
        full_covariance.at[np.ix_(free_indices, with_prior_index)]
        .set(cross_covariance)
        .at[np.ix_(with_prior_index, free_indices)]
        .set(cross_covariance.T)
    )
    full_covariance = full_covariance.at[np.ix_(with_prior_index, with_prior_index)].set(spread)
    directions, unit = jnp.zeros_like(information), jnp.zeros(has_prior.size, dtype)
    full_null = NullSpace(
        directions.at[np.ix_(free_indices, free_indices)].set(null.directions),
        unit.at[free_indices].set(null.unit).at[with_prior_index].set(width),
    )
    with_prior = information.at[with_prior_index, with_prior_index].add(precision * variance)
    null_count = jnp.sum(~determined)
    return Determination(with_prior, full_covariance, full_null, null_count, noise, count)


def _expected_weights(
    residuals: Array, recording: Recording, robust: Huber, trust_noise: bool
) -> Float[Array, "r c"]:
    """Information of a residual with a robust loss over that of normal noise alone, by channel.

    The covariance of an M-estimator is that of least squares times E(psi^2) / E(psi')^2, psi the
    derivative of the loss (P. J. Huber, Robust Statistics, 1981, section 7.6). Expectations: psi'
    is the part of the residuals within the threshold, which have the variance of the noise.
    """
    measured = is_measured(recording, residuals.shape[-1])
    is_inner = measured & (jnp.abs(robust.inverse(residuals)) <= robust.threshold)
    count, inner_count = (jnp.sum(x.astype(residuals.dtype), axis=1) for x in (measured, is_inner))
    inner = jnp.where(count > 0, inner_count / jnp.where(count > 0, count, 1), 1)
    total = jnp.sum(count)
    variance = 1 if trust_noise else square_sum(residuals, total, robust) / total
    outer_variance = robust.threshold**2 / jnp.where(variance > 0, variance, 1)
    mean_square = inner * robust.inner_variance.astype(inner.dtype) + (1 - inner) * outer_variance
    return inner**2 / mean_square


def _priors(solution: Solution, recording: Recording) -> tuple[np.ndarray, Array]:
    """Which unknowns have a prior (static; order shared, then own), and the precisions of those."""
    parameters, model = solution.parameters, solution.model
    prior = prior_of(parameters, recording, model)
    shared = [np.zeros(model.entries, bool)]
    motion = jax.tree.leaves(parameters.motion)
    for name in ("bias", "mounting", "lever", "motion", "gain", "delay"):
        if name == "motion":
            for leaf, precision in zip(motion, prior.motion, strict=True):
                shared.append(np.full(leaf.size, precision is not None))
            continue
        size = sum(leaf.size for leaf in jax.tree.leaves(getattr(parameters, name)))
        shared.append(np.full(size, getattr(prior, name, None) is not None))
    of_recording = [
        np.zeros(0 if x is None else 3, bool) for x in (parameters.omega, parameters.attitude)
    ]
    walk = np.ones(0 if parameters.walk is None else parameters.walk[0].size, bool)
    recordings = parameters.omega.shape[0]
    has_prior = np.concatenate([*shared, *[np.concatenate([*of_recording, walk])] * recordings])
    precisions = [prior.bias, *prior.motion, prior.gain, prior.delay, prior.walk]
    flat = [jnp.ravel(x) for x in precisions if x is not None]
    dtype = parameters.omega.dtype
    return has_prior, jnp.concatenate([jnp.zeros(0, dtype), *flat]).astype(dtype)
