"""A start from the data alone: linear regression on the conservation of angular momentum.

With the attitude R(t) relative to the first sample, found by integrating the rates, the momentum
``R (I omega + h) = L`` is constant, which is linear in the six entries of I and the three of L and
needs no differentiation of noisy rates.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from polhode.fit._parameters import rotation_of
from polhode.inertia import inertia_of_second_moments, inertia_to_log_cholesky, second_moments
from polhode.rotation import multiply, to_matrix

# second moments below this part of their sum are lifted to it before the logarithm is taken
_FLATTEST = 3e-3


def integrate(omega: Float[Array, "t 3"], times: Float[Array, " t"]) -> Float[Array, "t 4"]:
    """Attitude quaternions relative to the first sample, by Magnus steps."""
    step = jnp.diff(times)[:, None]
    first, second = omega[:-1], omega[1:]
    # rates linear between samples: their mean, and the commutator of both ends
    vector = step / 2 * (first + second) + step**2 / 12 * jnp.cross(first, second)
    turns = rotation_of(vector)
    path = jax.lax.associative_scan(multiply, turns)
    unit = jnp.asarray([[1, 0, 0, 0]], omega.dtype)
    return jnp.concatenate([unit, path])


def _design(omega: Float[Array, "t 3"]) -> Float[Array, "t 3 6"]:
    """``I omega`` as a matrix times (xx, yy, zz, yz, zx, xy)."""
    x, y, z = (omega[..., i] for i in range(3))
    o = jnp.zeros_like(x)
    rows = [[x, o, o, o, z, y], [o, y, o, z, o, x], [o, o, z, y, x, o]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _physical(entries: Float[Array, " 6"]) -> Float[Array, "3 3"]:
    """The nearest tensor of a body that is not too flat."""
    a, b, c, p, q, r = entries
    tensor = jnp.stack([jnp.stack([a, r, q]), jnp.stack([r, b, p]), jnp.stack([q, p, c])])
    values, axes = jnp.linalg.eigh(second_moments(tensor))
    least = _FLATTEST * jnp.sum(jnp.abs(values))
    values = jnp.maximum(values, least)
    return inertia_of_second_moments(jnp.einsum("ij,j,kj->ik", axes, values, axes))


def regression(
    omega: Float[Array, "r t 3"],
    times: Float[Array, "r t"],
    present: Float[Array, "r t"],
    momentum: Float[Array, "r t 3"] | None = None,
) -> tuple[Float[Array, " 6"], Float[Array, ""]]:
    """Log-Cholesky start (6,) and the mean square misfit of the regression, relative.

    ``momentum``: body components of a wheel's momentum; without it the tensor is scaled to unit
    Frobenius norm, since only its shape shows.
    """
    attitude = jax.vmap(integrate)(omega, times)
    turn = to_matrix(attitude) * present[..., None, None]
    body = jnp.einsum("rtij,rtjk->rtik", turn, _design(omega))
    total = jnp.sum(present, axis=1)[:, None, None]
    # eliminate each recording's constant momentum: subtract the mean
    mean = jnp.sum(body, axis=1) / total
    centred = (body - mean[:, None]) * present[..., None, None]
    gram = jnp.einsum("rtij,rtik->jk", centred, centred)
    if momentum is None:
        metric = jnp.asarray([1, 1, 1, 2, 2, 2], omega.dtype) ** 0.5
        values, vectors = jnp.linalg.eigh(gram / metric[:, None] / metric[None])
        entries = vectors[:, 0] / metric
        entries = entries * jnp.where(jnp.sum(entries[:3]) < 0, -1, 1).astype(entries.dtype)
        misfit = values[0] / jnp.sum(values)
    else:
        carried = jnp.einsum("rtij,rtj->rti", turn, momentum)
        carried = carried - (jnp.sum(carried, axis=1) / total[:, :, 0])[:, None]
        carried = carried * present[..., None]
        right = -jnp.einsum("rtij,rti->j", centred, carried)
        entries = jnp.linalg.solve(gram, right)
        rest = jnp.einsum("rtij,j->rti", centred, entries) + carried
        misfit = jnp.sum(rest**2) / jnp.sum(carried**2)
    return inertia_to_log_cholesky(_physical(entries)), misfit


def alternatives(omega: Float[Array, "r t 3"], first: Float[Array, " 6"]) -> list[Array]:
    """Other starts (6,): long, flat and middling bodies along the directions that rates prefer."""
    spread = jnp.einsum("rti,rtj->ij", omega, omega)
    _, axes = jnp.linalg.eigh(spread)
    size = jnp.mean(first[:3])
    found = []
    for widths in ((1.0, 0.4, 0.2), (0.2, 0.4, 1.0), (0.4, 1.0, 0.2)):
        sigma = jnp.einsum("ij,j,kj->ik", axes, jnp.asarray(widths, omega.dtype), axes)
        start = inertia_to_log_cholesky(inertia_of_second_moments(sigma))
        shift = jnp.asarray([1, 1, 1, 0, 0, 0], omega.dtype) * (size - jnp.mean(start[:3]))
        found.append(start + shift)
    return found
