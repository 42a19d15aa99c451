"""Attitudes from rates, physical tensors from unconstrained unknowns, and starting points of a fit.

Only public names of ``polhode.fit`` are used.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from polhode.inertia import inertia_of_second_moments, principal, second_moments
from polhode.rotation import multiply, rotation_vector_to_wxyz, wxyz_to_matrix

# scale of the smooth lower bound of the second moments' eigenvalues, relative to their sum
_SOFT = 5e-3
# lower bound of the second moments of a start, relative to their sum
_FLATTEST = 3e-3
# number of parts of a recording in each of which the start assumes a constant momentum
_PIECES = 6
_ROUNDS = 3
SCALE = np.array([1, 1, 1, 0, 0, 0]) / np.sqrt(3)
"""The direction of the six entries that changes only the size of a tensor."""


def entries_of(tensor: Float[Array, "3 3"]) -> Float[Array, " 6"]:
    """Entries xx, yy, zz, yz, zx, xy."""
    rows, columns = jnp.asarray([0, 1, 2, 1, 2, 0]), jnp.asarray([0, 1, 2, 2, 0, 1])
    return tensor[rows, columns]


def symmetric_matrix(entries: Float[Array, " 6"]) -> Float[Array, "3 3"]:
    """The matrix with entries xx, yy, zz, yz, zx, xy."""
    return entries[jnp.asarray([[0, 5, 4], [5, 1, 3], [4, 3, 2]])]


def central_differences(
    values: Float[Array, "t 3"], times: Float[Array, " t"]
) -> Float[Array, "t 3"]:
    """Derivatives at samples of any spacing; one-sided at the ends."""
    step = jnp.diff(times)[:, None]
    between = jnp.diff(values, axis=0) / step
    inner = (between[1:] * step[:-1] + between[:-1] * step[1:]) / (step[1:] + step[:-1])
    return jnp.concatenate([between[:1], inner, between[-1:]])


def interpolate_gaps(
    times: Float[Array, " t"], present: Float[Array, " t"], values: Float[Array, "t 3"]
) -> Float[Array, "t 3"]:
    """Values with linearly interpolated gaps, and constant before the first and after the last."""
    count = times.shape[0]
    place = jnp.arange(count)
    before = jax.lax.cummax(jnp.where(present > 0, place, -1))
    after = jax.lax.cummin(jnp.where(present > 0, place, count), reverse=True)
    before, after = (
        jnp.where(before < 0, after, before),
        jnp.where(after == count, before, after),
    )
    span = times[after] - times[before]
    share = jnp.where(span > 0, (times - times[before]) / jnp.where(span > 0, span, 1), 0)
    return values[before] + share[:, None] * (values[after] - values[before])


def attitudes(
    omega: Float[Array, "t 3"], slope: Float[Array, "t 3"], times: Float[Array, " t"]
) -> Float[Array, "t 3 3"]:
    """Attitude matrices relative to the first sample, from rates and their derivatives.

    Cubic Hermite interpolation; two Magnus steps of order 4 (two Gauss points) per interval.
    """
    step = jnp.diff(times)[:, None]
    offset = math.sqrt(3) / 12

    def rate_at(s):
        late, start, end = s * s * (3 - 2 * s), s * (1 - s) ** 2, -s * s * (1 - s)
        value = (1 - late) * omega[:-1] + late * omega[1:]
        return value + step * (start * slope[:-1] + end * slope[1:])

    def half(middle):
        first, second = rate_at(middle - offset), rate_at(middle + offset)
        return step / 4 * (first + second) + step**2 / 4 * offset * jnp.cross(first, second)

    turns = multiply(rotation_vector_to_wxyz(half(0.25)), rotation_vector_to_wxyz(half(0.75)))
    unit = jnp.asarray([[1, 0, 0, 0]], omega.dtype)
    return wxyz_to_matrix(jnp.concatenate([unit, _running_products(turns, unit)]))


def _running_products(turns: Float[Array, "n 4"], unit: Float[Array, "1 4"]) -> Array:
    # prefix products within the rows of a square array, then over the rows: derivatives of this
    # compile in half the time of those of ``associative_scan``
    count = turns.shape[0]
    side = math.isqrt(count - 1) + 1
    padded = jnp.concatenate([turns, jnp.broadcast_to(unit, (side * side - count, 4))])

    def append(before, turn):
        product = multiply(before, turn)
        return product, product

    start = jnp.broadcast_to(unit, (side, 4))
    _, within = jax.lax.scan(append, start, jnp.swapaxes(padded.reshape(side, side, 4), 0, 1))
    _, rows = jax.lax.scan(append, unit[0], within[-1])
    before = jnp.concatenate([unit, rows[:-1]])
    return multiply(before[:, None], jnp.swapaxes(within, 0, 1)).reshape(-1, 4)[:count]


def inverse_of(matrix: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Inverses of symmetric matrices, by explicit formulas."""
    determinant, cofactors = cofactors_of(matrix)
    return cofactors / determinant[..., None, None]


def cofactors_of(matrix: Float[Array, "*b 3 3"]) -> tuple[Array, Array]:
    """Determinants and cofactors of symmetric matrices."""
    a, b, c = (matrix[..., k, k] for k in range(3))
    p, q, r = matrix[..., 1, 2], matrix[..., 2, 0], matrix[..., 0, 1]
    rows = [
        [b * c - p * p, p * q - r * c, r * p - q * b],
        [p * q - r * c, a * c - q * q, q * r - p * a],
        [r * p - q * b, q * r - p * a, a * b - r * r],
    ]
    cofactors = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return jnp.sum(matrix[..., 0, :] * cofactors[..., 0, :], axis=-1), cofactors


class Origin(NamedTuple):
    """Origin of the unconstrained unknowns of a tensor, and the scale of their nonlinearity."""

    entries: Float[Array, " 6"]
    soft: Float[Array, ""]


def origin_of(sigma: Float[Array, "3 3"]) -> Origin:
    """The origin at which the tensor has the second moments ``sigma``."""
    soft = _SOFT * jnp.trace(sigma)
    return Origin(entries_of(sigma - soft**2 / 4 * inverse_of(sigma)), soft)


def tensor_of(shape: Float[Array, " 6"], origin: Origin, columns: np.ndarray) -> Array:
    """Inertia tensor (3, 3), physical for any ``shape``, whose directions are ``columns`` (6, 6).

    The second moments are ``(S + sqrt(S^2 + soft^2)) / 2`` of a symmetric matrix S that is linear
    in ``shape``, as in ``polhode.fit.FullTensor``: directions that the data do not determine are
    straight valleys of the likelihood.
    """
    change = jnp.sum(jnp.asarray(columns, shape.dtype) * shape[None], axis=1)
    values, axes, products = principal(
        symmetric_matrix(origin.entries + origin.soft / _SOFT * change)
    )
    root = jnp.sqrt(values**2 + origin.soft**2)
    # avoids cancellation for negative eigenvalues
    bent = jnp.where(values > 0, (values + root) / 2, origin.soft**2 / (2 * (root - values)))

    # Divided differences of the same function times the products of the principal axes. These are
    # zero, but their tangents are those of the rotating axes.
    first, second = jnp.asarray([1, 2, 0]), jnp.asarray([2, 0, 1])
    ratio = (1 + (values[first] + values[second]) / (root[first] + root[second])) / 2
    inner = symmetric_matrix(jnp.concatenate([bent, ratio * products]))
    turn = wxyz_to_matrix(axes)
    sigma = jnp.einsum("ij,jk,lk->il", turn, inner, turn, precision=jax.lax.Precision.HIGHEST)
    return inertia_of_second_moments(sigma)


def start_by_regression(
    omega: Float[Array, "r t 3"],
    times: Float[Array, "r t"],
    present: Float[Array, "r t"],
    carried: Float[Array, "r t 3"] | None,
) -> Float[Array, "3 3"]:
    """Second moments for which ``R (I omega + h)`` varies least within pieces of the recordings.

    ``carried``: momentum of the wheel, body axes. Without a wheel the tensor has unit Frobenius
    norm, and rates between samples follow from Euler's equations with the tensor of the previous
    iteration.
    """
    place = np.arange(times.shape[1]) * _PIECES // times.shape[1]
    pieces = jnp.asarray(place == np.arange(_PIECES)[:, None], omega.dtype)
    weight = pieces[None] * present[:, None]
    total = jnp.sum(weight, axis=2)

    def centred(values):
        # the constant momentum of each piece is eliminated with its mean
        mean = jnp.einsum("rpt,rtik->rpik", weight, values)
        mean = mean / jnp.where(total > 0, total, 1)[..., None, None]
        rest = values - jnp.einsum("pt,rpik->rtik", pieces, mean)
        return rest * present[..., None, None]

    def rows_of(slope):
        turn = jax.vmap(attitudes)(omega, slope, times) * present[..., None, None]
        return turn, turn @ _momentum_by_entries(omega)

    first = jax.vmap(central_differences)(omega, times)
    if carried is not None:
        turn, rows = rows_of(first)
        body, push = centred(rows), centred(turn @ carried[..., None])[..., 0]
        square = jnp.einsum("rtij,rtik->jk", body, body)
        entries = jnp.linalg.solve(square, -jnp.einsum("rtij,rti->j", body, push))
        return _nearest_physical(entries)
    metric = jnp.asarray([1, 1, 1, 2, 2, 2], omega.dtype) ** 0.5

    def again(_, carry):
        slope, _ = carry
        body = centred(rows_of(slope)[1])
        square = jnp.einsum("rtij,rtik->jk", body, body)
        _, vectors = jnp.linalg.eigh(square / metric[:, None] / metric[None])
        entries = vectors[:, 0] / metric
        entries = entries * jnp.where(jnp.sum(entries[:3]) < 0, -1, 1).astype(omega.dtype)
        sigma = _nearest_physical(entries)
        tensor = inertia_of_second_moments(sigma)
        momentum = jnp.einsum("ij,rtj->rti", tensor, omega)
        slope = jnp.einsum("ij,rtj->rti", inverse_of(tensor), jnp.cross(momentum, omega))
        return slope, sigma

    _, sigma = jax.lax.fori_loop(0, _ROUNDS, again, (first, jnp.eye(3, dtype=omega.dtype)))
    return sigma


def _momentum_by_entries(omega: Float[Array, "r t 3"]) -> Float[Array, "r t 3 6"]:
    """``I omega`` as a matrix times the entries of I."""
    unit = jnp.eye(6, dtype=omega.dtype)
    basis = jax.vmap(symmetric_matrix)(unit)
    return jnp.einsum("kij,rtj->rtik", basis, omega)


def _nearest_physical(entries: Float[Array, " 6"]) -> Float[Array, "3 3"]:
    values, axes, _ = principal(second_moments(symmetric_matrix(entries)))
    values = jnp.maximum(values, _FLATTEST * jnp.sum(jnp.abs(values)))
    turn = wxyz_to_matrix(axes)
    return jnp.einsum("ij,j,kj->ik", turn, values, turn)


def whiteness_of(rest: Float[Array, "r t 3"], present: Float[Array, "r t"], lags: int = 5) -> Array:
    """Ljung-Box probability of the first autocorrelations of all channels together.

    Recordings without samples are ignored. Chi-square with many degrees of freedom by Wilson and
    Hilferty (PNAS 17 (1931) 684).
    """
    total = jnp.sum(present, axis=-1)[:, None]
    has_power = total > 0
    total = jnp.where(has_power, total, lags + 1)
    rest = (rest - (jnp.sum(rest, axis=1) / total)[:, None]) * present[..., None]
    power = jnp.sum(rest**2, axis=1)
    statistic = jnp.zeros((), rest.dtype)
    for lag in range(1, lags + 1):
        lagged = jnp.sum(rest[:, lag:] * rest[:, :-lag], axis=1)
        correlation = lagged / jnp.where(power > 0, power, 1)
        statistic += jnp.sum(correlation**2 / (total - lag) * total * (total + 2))
    degrees = lags * rest.shape[-1] * jnp.sum(has_power).astype(rest.dtype)
    spread = 2 / (9 * degrees)
    return norm.sf(((statistic / degrees) ** (1 / 3) - 1 + spread) / spread**0.5)
