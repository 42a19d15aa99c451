"""Starting values from the data: linear regression on the conservation of angular momentum.

The rates are integrated to the attitude R(t) relative to the first sample. The angular momentum
``R (I omega + h) = L`` is constant, which is linear in the six entries of I and the three of L. No
noisy rates are differentiated.
"""

import math
from functools import reduce
from operator import mul

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.fit._model import free_acceleration, whole_of
from polhode.fit._numerics import eigh, solve
from polhode.fit._recording import central_slope
from polhode.inertia import Inertia, inertia_of_second_moments, second_moments
from polhode.rotation import multiply, rotation_vector_to_wxyz, wxyz_to_matrix

# least second moment of a starting body, as a part of their sum
_FLATTEST = 3e-3
# rounds of the regression; each interpolates the rates with the tensor of the round before
_ROUNDS = 3
# pieces of each recording in the second regression
_PIECES = 6


def integrate(
    omega: Float[Array, "t 3"], slope: Float[Array, "t 3"], times: Float[Array, " t"]
) -> Float[Array, "t 4"]:
    """Attitude quaternions relative to the first sample, from rates and their derivatives.

    Cubic Hermite interpolation, two Magnus steps of order 4 (two Gauss points) per interval.
    """
    step = jnp.diff(times)[:, None]
    offset = jnp.asarray(3, omega.dtype) ** 0.5 / 12

    def rate_at(s):
        # Hermite's basis on [0, 1]
        end_weight = s * s * (3 - 2 * s)
        start, end = s * (1 - s) ** 2, -s * s * (1 - s)
        return (
            (1 - end_weight) * omega[:-1]
            + end_weight * omega[1:]
            + step * (start * slope[:-1] + end * slope[1:])
        )

    def half(middle):
        first_rate, second_rate = rate_at(middle - offset), rate_at(middle + offset)
        return step / 4 * (first_rate + second_rate) + step**2 / 4 * offset * jnp.cross(
            first_rate, second_rate
        )

    turns = multiply(rotation_vector_to_wxyz(half(0.25)), rotation_vector_to_wxyz(half(0.75)))
    unit = jnp.asarray([[1, 0, 0, 0]], omega.dtype)
    return jnp.concatenate([unit, _products(turns, unit)])


def _products(turns: Float[Array, "n 4"], unit: Float[Array, "1 4"]) -> Float[Array, "n 4"]:
    """Cumulative products of quaternions: along all rows of a square array, then over its rows.

    It runs as fast as ``associative_scan`` and is a smaller program: its derivatives compile in
    half the time.
    """
    count = turns.shape[0]
    side = math.isqrt(count - 1) + 1
    padded_turns = jnp.concatenate([turns, jnp.broadcast_to(unit, (side * side - count, 4))])

    def on(product, turn):
        next_product = multiply(product, turn)
        return next_product, next_product

    start = jnp.broadcast_to(unit, (side, 4))
    _, within = jax.lax.scan(on, start, jnp.swapaxes(padded_turns.reshape(side, side, 4), 0, 1))
    _, rows = jax.lax.scan(on, unit[0], within[-1])
    row_starts = jnp.concatenate([unit, rows[:-1]])
    return multiply(row_starts[:, None], jnp.swapaxes(within, 0, 1)).reshape(-1, 4)[:count]


def _design(omega: Float[Array, "t 3"]) -> Float[Array, "t 3 6"]:
    """``I omega`` as a matrix times (xx, yy, zz, yz, zx, xy)."""
    x, y, z = jnp.unstack(omega, axis=-1)
    o = jnp.zeros_like(x)
    rows = [[x, o, o, o, z, y], [o, y, o, z, o, x], [o, o, z, y, x, o]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def nearest_physical(sigma: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Second moments of the nearest body that is not too flat."""
    values, axes = eigh(sigma)
    min_moment = _FLATTEST * jnp.sum(jnp.abs(values))
    values = jnp.maximum(values, min_moment)
    return jnp.einsum("ij,j,kj->ik", axes, values, axes)


def regression(
    omega: Float[Array, "r t 3"],
    times: Float[Array, "r t"],
    present: Float[Array, "r t"],
    momentum: Float[Array, "r t 3"] | None = None,
) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"], Float[Array, ""]]:
    """Starting second moments (3, 3) by two regressions, and the relative misfit of the first.

    The first treats the momentum as constant over each recording, the second over pieces of it,
    which tolerates errors of the integrated attitude and a slow loss of momentum.

    ``momentum``: body components of a wheel's momentum. Without it the tensor is scaled to unit
    Frobenius norm, since the data determine only its shape, and the rates between the samples are
    interpolated with the derivatives that Euler's equations give for the tensor of the previous
    round: recordings with few samples per turn need that.
    """

    count = times.shape[1]
    all_samples = jnp.ones((1, count), omega.dtype)
    # short pieces, in which the error of the integrated attitude remains small
    place = np.arange(count) * _PIECES // count
    pieces = jnp.asarray(place == np.arange(_PIECES)[:, None], omega.dtype)

    def centred(values, parts):
        # eliminate the constant momentum of each part: subtract its mean
        shape = (*present.shape, *[1] * (values.ndim - 2))
        weight = parts[None] * present[:, None]
        total = jnp.sum(weight, axis=2)
        safe = jnp.where(total > 0, total, 1)
        mean = jnp.einsum("rpt,rt...->rp...", weight, values)
        mean = mean / safe.reshape(*safe.shape, *shape[2:])
        return (values - jnp.einsum("pt,rp...->rt...", parts, mean)) * present.reshape(shape)

    def rows_of(slope):
        attitude = jax.vmap(integrate)(omega, slope, times)
        turn = wxyz_to_matrix(attitude) * present[..., None, None]
        return turn, jnp.einsum("rtij,rtjk->rtik", turn, _design(omega))

    def square(rows):
        return jnp.einsum("rtij,rtik->jk", rows, rows)

    first_derivatives = jax.vmap(central_slope)(omega, times)
    if momentum is None:
        metric = jnp.asarray([1, 1, 1, 2, 2, 2], omega.dtype) ** 0.5

        def null(gram):
            values, vectors = eigh(gram / metric[:, None] / metric[None])
            entries = vectors[:, 0] / metric
            entries = entries * jnp.where(jnp.sum(entries[:3]) < 0, -1, 1).astype(entries.dtype)
            return nearest_physical(second_moments(whole_of(entries))), values[0] / jnp.sum(values)

        def refine(_, carry):
            _, rows = rows_of(carry[0])
            grams = jnp.stack([square(centred(rows, parts)) for parts in (all_samples, pieces)])
            sigma, misfit = jax.vmap(null)(grams)
            body = Inertia(full=inertia_of_second_moments(sigma[1]))
            return free_acceleration(body, omega), sigma, misfit

        unit = jnp.eye(3, dtype=omega.dtype)
        start = (first_derivatives, jnp.stack([unit, unit]), jnp.zeros(2, omega.dtype))
        _, sigma, misfit = jax.lax.fori_loop(0, _ROUNDS, refine, start)
        return sigma[0], sigma[1], misfit[0]
    turn, rows = rows_of(first_derivatives)
    rotated_momentum = jnp.einsum("rtij,rtj->rti", turn, momentum)
    solutions = []
    for parts in (all_samples, pieces):
        body, push = centred(rows, parts), centred(rotated_momentum, parts)
        entries = solve(square(body), -jnp.einsum("rtij,rti->j", body, push))
        residual = jnp.einsum("rtij,j->rti", body, entries) + push
        sigma = nearest_physical(second_moments(whole_of(entries)))
        solutions.append((sigma, jnp.sum(residual**2) / jnp.sum(push**2)))
    return solutions[0][0], solutions[1][0], solutions[0][1]


def alternative_starts(
    omega: Float[Array, "r t 3"], initial_moments: Float[Array, "3 3"]
) -> list[Array]:
    """Other second moments: elongated, flat and intermediate bodies, with axes of the rates."""
    spread = jnp.einsum("rti,rtj->ij", omega, omega)
    _, axes = eigh(spread)
    size = initial_moments[0, 0] + initial_moments[1, 1] + initial_moments[2, 2]
    return [
        size * jnp.einsum("ij,j,kj->ik", axes, jnp.asarray(widths, omega.dtype), axes)
        for widths in ((0.6, 0.25, 0.15), (0.15, 0.25, 0.6), (0.25, 0.6, 0.15))
    ]


def neighbour_noise_variance(
    times: Float[Array, " t"], omega: Float[Array, "t 3"], present: Float[Array, " t"]
) -> Float[Array, ""]:
    """Variance of the noise, from each sample's difference to the cubic through four neighbours.

    An upper bound on average: with coarse sampling the motion itself adds to it. Infinite if no
    five successive samples are present.
    """
    offset = jnp.stack([times[k : times.shape[0] - 4 + k] for k in range(5)]) - times[None, 2:-2]
    value = jnp.stack([omega[k : times.shape[0] - 4 + k] for k in range(5)])
    windows = jnp.stack([present[k : times.shape[0] - 4 + k] for k in range(5)])
    others = (0, 1, 3, 4)
    weights = [
        reduce(mul, (offset[j] / (offset[j] - offset[k]) for j in others if j != k)) for k in others
    ]
    guess = sum(w[:, None] * value[k] for w, k in zip(weights, others, strict=True))
    share = 1 + sum(w * w for w in weights)
    complete = jnp.prod(windows, axis=0)
    total = jnp.sum(complete)
    square = jnp.sum(complete * jnp.sum((value[2] - guess) ** 2, axis=1) / share) / 3
    return jnp.where(total > 0, square / jnp.where(total > 0, total, 1), jnp.inf)
