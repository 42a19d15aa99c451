"""The unknowns of a fit as plain numbers that may take any value, and the body that they mean."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode.inertia import inertia_of_second_moments


class Parameters(eqx.Module):
    """Unconstrained unknowns of one body and its recordings (absent ones are None).

    **Fields:** ``shape`` (k,): free entries of the Cholesky factor, relative to the start;
    ``omega`` (r, 3), rad/s: rates at the first time of each recording; ``attitude`` (r, 3), rad:
    rotation vector (body axes) from the start attitude to the initial one; ``bias`` (3,), rad/s, of
    the gyroscope; ``mounting`` (3,), rad: rotation vector of the sensor axes; ``lever`` (3,), m:
    accelerometer position from the centre of mass; ``motion``: the motion's own unknowns.
    """

    shape: Float[Array, " k"]
    omega: Float[Array, "r 3"]
    attitude: Float[Array, "r 3"] | None = None
    bias: Float[Array, " 3"] | None = None
    mounting: Float[Array, " 3"] | None = None
    lever: Float[Array, " 3"] | None = None
    motion: Any = None


class AbstractInertiaUnknown(eqx.Module):
    """Which inertias are possible: entries of the triangular factor that are free."""

    @abc.abstractmethod
    def columns(self) -> np.ndarray:
        """Free directions (6, k) of the six entries (three diagonal ones first), orthonormal."""


class FullTensor(AbstractInertiaUnknown):
    """Any tensor in sensor axes: six numbers, of which free motion shows five."""

    def columns(self):
        return np.eye(6)


class MomentsOnly(AbstractInertiaUnknown):
    """Sensor axes are principal axes: three numbers, of which free motion shows two."""

    def columns(self):
        return np.eye(6)[:, :3]


# stretching the whole factor scales the body and changes nothing else
_SCALE = np.array([1, 1, 1, 0, 0, 0]) / np.sqrt(3)


def free_columns(unknown: AbstractInertiaUnknown, scale_known: bool) -> np.ndarray:
    """Directions that the data can show: all, or those at right angles to the scale."""
    columns = unknown.columns()
    if scale_known:
        return columns
    flat = columns - np.outer(_SCALE, _SCALE @ columns)
    left, size, _ = np.linalg.svd(flat, full_matrices=False)
    return left[:, size > 0.5]


def tensor_of(shape: Float[Array, " k"], base: Float[Array, " 6"], columns: np.ndarray) -> Array:
    """Inertia tensor (3, 3) at ``shape``: physical for any real numbers, flat bodies included.

    Second moments ``(B S)(B S)^T``: B is the Cholesky factor of ``base`` (log-Cholesky parameters),
    S the upper triangle with diagonal ``1 + y1, 1 + y2, 1 + y3`` and y4, y5, y6 above it,
    ``y = columns shape``. Relative to the start all unknowns are of order one, and a flat body
    lies at finite ones, where the logarithm of a diagonal would have to run to minus infinity.
    """
    y = jnp.sum(jnp.asarray(columns, base.dtype) * shape[None], axis=1)
    widths = jnp.exp(base[:3])
    outer = _triangle(widths, base[3:] * widths[jnp.asarray([1, 2, 2])])
    inner = _triangle(1 + y[:3], y[3:])
    factor = [
        [sum(outer[i][k] * inner[k][j] for k in range(i, j + 1)) for j in range(3)]
        for i in range(3)
    ]
    sigma = [
        [sum(factor[i][k] * factor[j][k] for k in range(3)) for j in range(3)] for i in range(3)
    ]
    return inertia_of_second_moments(jnp.stack([jnp.stack(row) for row in sigma]))


def _triangle(diagonal, above):
    a, b, c = diagonal
    p, q, r = above
    o = jnp.zeros_like(a)
    return [[a, p, q], [o, b, r], [o, o, c]]


def rotation_of(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion of a rotation vector, smooth at zero."""
    square = jnp.sum(vector * vector, axis=-1, keepdims=True)
    safe = jnp.where(square > 0, square, 1)
    angle = jnp.sqrt(safe)
    # at exactly zero the series: sin(a/2)/a = 1/2 and cos(a/2) = 1 - a^2/8
    ratio = jnp.where(square > 0, jnp.sin(angle / 2) / angle, 0.5 - square / 48)
    scalar = jnp.where(square > 0, jnp.cos(angle / 2), 1 - square / 8)
    return jnp.concatenate([scalar, ratio * vector], axis=-1)
