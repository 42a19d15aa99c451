"""The unknowns of a fit as plain numbers that may take any value, and the body that they mean."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.fit._matrices import inverse
from polhode.inertia import inertia_of_second_moments, principal
from polhode.inertia._physical import symmetric
from polhode.rotation import wxyz_to_matrix

# Eigenvalues of the second moments, relative to their sum, around which a flat body is near.
_SOFT = 5e-3


def entries_of(tensor: Float[Array, "3 3"], count: int = 6) -> Float[Array, " e"]:
    """The ``count`` unknown entries: xx, yy, zz and, of 6, yz, zx, xy; none where it is known."""
    a, b, c = tensor[0, 0], tensor[1, 1], tensor[2, 2]
    return jnp.stack([a, b, c, tensor[1, 2], tensor[2, 0], tensor[0, 1]])[:count]


def whole_of(entries: Float[Array, " e"], count: int = 6) -> Float[Array, "3 3"]:
    """The tensor of its ``count`` (3 or 6) entries, products zero where they are absent.

    Of none: any, for a motion that does not ask for it.
    """
    if count == 0:
        return jnp.eye(3, dtype=entries.dtype)
    return symmetric(entries[:3], entries[3:6] if count == 6 else jnp.zeros_like(entries[:3]))


class Parameters(eqx.Module):
    """Unconstrained unknowns of one body and its recordings (None: not fitted).

    **Fields:** ``shape`` (k,): free entries of the Cholesky factor, relative to the start;
    ``omega`` (r, 3), rad/s: rates at the first time of each recording; ``attitude`` (r, 3), rad:
    rotation vector (body axes) from the start attitude to the initial one; ``bias`` (3,), rad/s, of
    the gyroscope; ``mounting`` (3,), rad: rotation vector of the sensor axes; ``lever`` (3,), m:
    accelerometer position from the centre of mass; ``motion``: the motion's own unknowns; ``gain``
    (9,): errors of the gyroscope's gain matrix beside the calibrated one, row by row; ``delay``, s,
    of its readings; ``walk`` (r, k, 3), rad/s: changes of its bias over each of k equal parts of a
    recording.
    """

    shape: Float[Array, " k"]
    omega: Float[Array, "r 3"]
    attitude: Float[Array, "r 3"] | None = None
    bias: Float[Array, " 3"] | None = None
    mounting: Float[Array, " 3"] | None = None
    lever: Float[Array, " 3"] | None = None
    motion: Any = None
    gain: Float[Array, " 9"] | None = None
    delay: Float[Array, ""] | None = None
    walk: Float[Array, "r k 3"] | None = None


class AbstractInertiaUnknown(eqx.Module):
    """Which inertias are possible: entries of the second moments that are free."""

    @abc.abstractmethod
    def columns(self) -> np.ndarray:
        """Free directions (6, k) of the six entries (three diagonal ones first), orthonormal."""


class FullTensor(AbstractInertiaUnknown):
    """Any tensor in sensor axes: six numbers, of which free motion shows five."""

    def columns(self) -> np.ndarray:
        return np.eye(6)


class MomentsOnly(AbstractInertiaUnknown):
    """Sensor axes are principal axes: three numbers, of which free motion shows two."""

    def columns(self) -> np.ndarray:
        return np.eye(6)[:, :3]


class NoInertia(AbstractInertiaUnknown):
    """The inertia is not unknown, or belongs to the unknowns of the motion."""

    def columns(self) -> np.ndarray:
        return np.zeros((6, 0))


# scaling a body changes its ratios not at all: with the size unknown the sum is kept
SCALE = np.array([1, 1, 1, 0, 0, 0]) / np.sqrt(3)


def free_columns(unknown: AbstractInertiaUnknown, scale_known: bool) -> np.ndarray:
    """Directions that the data can show: all, or those at right angles to the scale."""
    columns = unknown.columns()
    if scale_known:
        return columns
    flat = columns - np.outer(SCALE, SCALE @ columns)
    left, size, _ = np.linalg.svd(flat, full_matrices=False)
    return left[:, size > 0.5]


class Base(NamedTuple):
    """Where ``Parameters.shape`` counts from.

    ``entries`` (6,): of a symmetric matrix S (diagonal, then yz, zx, xy), kg m^2; ``soft``, kg m^2:
    the size of its eigenvalues below which the second moments bend away from zero.
    """

    entries: Float[Array, " 6"]
    soft: Float[Array, ""]


def base_of(sigma: Float[Array, "3 3"], scale_known: bool) -> Base:
    """The base whose tensor at ``shape = 0`` has second moments ``sigma``, or their shape."""
    total = sigma[0, 0] + sigma[1, 1] + sigma[2, 2]
    if not scale_known:
        sigma, total = sigma / total, jnp.ones_like(total)
    soft = _SOFT * total
    matrix = sigma - soft**2 / 4 * inverse(sigma)
    return Base(entries_of(matrix), soft)


def tensor_of(shape: Float[Array, " k"], base: Base, columns: np.ndarray) -> Array:
    """Inertia tensor (3, 3) at ``shape``: physical for any real numbers.

    Second moments ``(S + sqrt(S^2 + soft^2)) / 2`` of a symmetric matrix S that is linear in
    ``shape``. Away from flat bodies that is S itself: what data leave undetermined is a straight
    valley in the entries of the tensor, and a curved one in those of a Cholesky factor, where an
    optimiser crawls. Towards minus infinity an eigenvalue leads to a flat body.
    """
    scale = base.soft / _SOFT
    y = base.entries + scale * jnp.sum(jnp.asarray(columns, shape.dtype) * shape[None], axis=1)
    values, axes, (yz, zx, xy) = principal(whole_of(y))
    root = jnp.sqrt(values**2 + base.soft**2)
    # without cancellation for negative eigenvalues
    bent = jnp.where(values > 0, (values + root) / 2, base.soft**2 / (2 * (root - values)))

    def slope(i, j):
        # divided difference of the function above; the products that it multiplies are zero, and
        # carry the tangent of turning axes
        return (1 + (values[i] + values[j]) / (root[i] + root[j])) / 2

    inner = symmetric(bent, (slope(1, 2) * yz, slope(2, 0) * zx, slope(0, 1) * xy))
    turn = wxyz_to_matrix(axes)
    exact = jax.lax.Precision.HIGHEST
    sigma = jnp.einsum("ij,jk,lk->il", turn, inner, turn, precision=exact)
    return inertia_of_second_moments(sigma)
