"""The inertia of a rigid body about a fixed point or its centre of mass, in body axes."""

import enum
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from polhode.inertia._cholesky import inertia_from_log_cholesky, inertia_to_log_cholesky
from polhode.inertia._eigen import principal
from polhode.inertia._input import as_floats, require, require_positive, tolerance, values


class Symmetry(enum.Enum):
    """Which moments are known, by construction, to be equal (static: it selects the program)."""

    NONE = "no two moments known to be equal"
    AXISYMMETRIC = "the moments about body x and y are equal"
    SPHERICAL = "all three moments are equal"


class Inertia(eqx.Module):
    """Inertia tensor I of a rigid body in body axes, kg m^2 (document 003; theory section 7).

    Exactly one of two leaves holds the numbers: ``diagonal`` (..., 3) when the body axes are
    principal axes, ``full`` (..., 3, 3) otherwise. Leading axes are a batch of bodies. Build it
    with the ``from_...`` constructors: they check the numbers; this one does not.
    """

    diagonal: Float[Array, "*b 3"] | None = None
    full: Float[Array, "*b 3 3"] | None = None
    symmetry: Symmetry = eqx.field(static=True, default=Symmetry.NONE)

    def __check_init__(self):
        require(
            (self.diagonal is None) != (self.full is None),
            "Inertia holds either principal moments or a full tensor, not both and not neither; "
            "use Inertia.from_moments or Inertia.from_tensor.",
        )

    @classmethod
    def from_moments(cls, moments: ArrayLike) -> Self:
        """Principal moments (..., 3), kg m^2, about body x, y, z, which are principal axes.

        Raises ValueError for a wrong shape, values that are not positive and finite, or moments
        that no body has (one greater than the sum of the two others; flat bodies, where it
        equals the sum, pass).
        """
        return cls(diagonal=_checked_moments("moments", as_floats("moments", moments, (3,))))

    @classmethod
    def axisymmetric(cls, transverse: ArrayLike, axial: ArrayLike) -> Self:
        """A symmetric top: moments (transverse, transverse, axial), symmetry axis body z.

        Both of shape (...), kg m^2, broadcast together. Raises as ``from_moments`` does.
        """
        first, last = as_floats("transverse", transverse, ()), as_floats("axial", axial, ())
        require(
            first.dtype == last.dtype,
            f"transverse and axial must have one dtype, got {first.dtype} and {last.dtype}.",
        )
        first, last = jnp.broadcast_arrays(first, last)
        moments = jnp.stack([first, first, last], axis=-1)
        return cls(_checked_moments("(transverse, transverse, axial)", moments), None, _AXIAL)

    @classmethod
    def spherical(cls, moment: ArrayLike) -> Self:
        """All moments equal (sphere, cube, ...): ``moment`` of shape (...), kg m^2, positive."""
        single = as_floats("moment", moment, ())
        require_positive("moment", single)
        return cls(jnp.stack([single] * 3, axis=-1), None, Symmetry.SPHERICAL)

    @classmethod
    def from_tensor(cls, tensor: ArrayLike) -> Self:
        """Inertia tensor (..., 3, 3) in any body axes, kg m^2: symmetric, products negative-signed.

        The off-diagonal entries are ``-integral x y dm`` (theory section 7). Raises ValueError for
        a wrong shape, NaN or infinity, a tensor that is not symmetric, or one whose principal
        moments are not positive or break the triangle inequality.
        """
        array = as_floats("tensor", tensor, (3, 3))
        _check_tensor(array)
        return cls(full=(array + jnp.swapaxes(array, -1, -2)) / 2)

    @classmethod
    def from_log_cholesky(cls, parameters: ArrayLike) -> Self:
        """A physical inertia from any real 6-vector (..., 6); see ``to_log_cholesky``."""
        array = as_floats("parameters", parameters, (6,))
        return cls(full=inertia_from_log_cholesky(array))

    def to_log_cholesky(self) -> Float[Array, "*b 6"]:
        """Unconstrained parameters (..., 6) of the tensor: log-Cholesky of its second moments.

        A flat body lies on the boundary, where the parameters are infinite.
        """
        return inertia_to_log_cholesky(self.tensor)

    @property
    def is_principal(self) -> bool:
        """Whether the body axes are principal axes by construction (static)."""
        return self.diagonal is not None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.full.shape[:-2] if self.diagonal is None else self.diagonal.shape[:-1]

    @property
    def dtype(self):
        """Floating dtype of the numbers."""
        return (self.full if self.diagonal is None else self.diagonal).dtype

    @property
    def moments(self) -> Float[Array, "*b 3"]:
        """Principal moments, kg m^2: as given, or ascending for a full tensor.

        Differentiable; for equal moments of a full tensor see ``principal``.
        """
        return principal(self.full)[0] if self.diagonal is None else self.diagonal

    @property
    def axes(self) -> Float[Array, "*b 4"] | None:
        """Turn ``wxyz`` from principal to body axes, or None when they are the same.

        Carries no derivative (``principal`` says how to get derivatives right).
        """
        return principal(self.full)[1] if self.diagonal is None else None

    @property
    def tensor(self) -> Float[Array, "*b 3 3"]:
        """The tensor in body axes, kg m^2."""
        if self.diagonal is None:
            return self.full
        return self.diagonal[..., None] * jnp.broadcast_to(
            jnp.eye(3, dtype=self.dtype), (*self.batch_shape, 3, 3)
        )

    def momentum(self, omega: Float[Array, "*#b 3"]) -> Float[Array, "*b 3"]:
        """Body momentum ``I omega``, kg m^2/s, of body rates (..., 3), rad/s."""
        if self.diagonal is not None:
            return jnp.multiply(*_aligned(self.diagonal, omega))
        rows = [jnp.sum(jnp.multiply(*_aligned(self.full[..., i, :], omega)), -1) for i in range(3)]
        return jnp.stack(rows, axis=-1)

    def rates(self, momentum: Float[Array, "*#b 3"]) -> Float[Array, "*b 3"]:
        """Body rates ``I^-1 L``, rad/s, of body momenta (..., 3), kg m^2/s."""
        if self.diagonal is not None:
            moments, momentum = _aligned(self.diagonal, momentum)
            return momentum / moments
        batch = jnp.broadcast_shapes(self.batch_shape, momentum.shape[:-1])
        tensor = jnp.broadcast_to(self.full, (*batch, 3, 3))
        return _solve(tensor, jnp.broadcast_to(momentum, (*batch, 3)))


_AXIAL = Symmetry.AXISYMMETRIC


def _aligned(left, right):
    shape = jnp.broadcast_shapes(left.shape, right.shape)
    return jnp.broadcast_to(left, shape), jnp.broadcast_to(right, shape)


def _solve(tensor, vector):
    """Solution of a symmetric positive definite 3x3 system by its L D L^T factors, elementwise."""
    a, p, q, r = (tensor[..., 0, 0], tensor[..., 1, 0], tensor[..., 2, 0], tensor[..., 2, 1])
    x, y, z = (vector[..., i] for i in range(3))
    l10, l20 = p / a, q / a
    d1 = tensor[..., 1, 1] - l10 * p
    e21 = r - l20 * p
    l21 = e21 / d1
    d2 = tensor[..., 2, 2] - l20 * q - l21 * e21
    y = y - l10 * x
    z = (z - l20 * x - l21 * y) / d2
    y = y / d1 - l21 * z
    return jnp.stack([x / a - l10 * y - l20 * z, y, z], axis=-1)


def _check_tensor(array):
    seen = values(array)
    if seen is None or seen.size == 0:
        return
    require(
        bool(np.isfinite(seen).all()),
        "tensor must be finite, got NaN or infinite entries; check where they come from.",
    )
    slack = tolerance(array) * np.abs(seen).max(axis=(-2, -1), keepdims=True)
    skew = np.abs(seen - np.swapaxes(seen, -1, -2))
    require(
        bool((skew <= slack).all()),
        f"tensor must be symmetric, got entries that differ by up to {skew.max():g} from their "
        "transposed ones; pass (A + A.T) / 2 if that is what is meant.",
    )
    _check_moments(
        "the principal moments of tensor",
        np.linalg.eigvalsh((seen + np.swapaxes(seen, -1, -2)) / 2),
        tolerance(array),
    )


def _checked_moments(name, array):
    seen = values(array)
    if seen is not None and seen.size:
        _check_moments(name, seen, tolerance(array))
    return array


def _check_moments(name, seen, slack):
    require(
        bool(np.isfinite(seen).all() and (seen > 0).all()),
        f"{name} must be positive and finite (kg m^2), got {_worst(seen, seen.min(axis=-1))}; a "
        "moment is zero only for a point or a line, which has no defined rotation about itself.",
    )
    excess = 2 * seen.max(axis=-1) - seen.sum(axis=-1)
    require(
        bool((excess <= slack * seen.max(axis=-1)).all()),
        f"{name} must satisfy the triangle inequality (each at most the sum of the two others), "
        f"got {_worst(seen, -excess)}; check units, and that these are moments of inertia, not "
        "second moments or a gyration tensor.",
    )


def _worst(seen, badness):
    """The first row with a NaN, or the one of smallest ``badness``."""
    rows, scores = seen.reshape(-1, seen.shape[-1]), np.reshape(badness, -1)
    return np.array2string(rows[int(np.argmin(np.where(np.isnan(scores), -np.inf, scores)))])
