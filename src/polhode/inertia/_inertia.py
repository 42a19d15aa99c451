"""The inertia of a rigid body about a fixed point or its centre of mass, in body axes."""

from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from polhode._checks import as_float_array, is_concrete, require
from polhode.inertia._cholesky import inertia_from_log_cholesky, inertia_to_log_cholesky
from polhode.inertia._eigen import principal
from polhode.inertia._input import (
    as_floats,
    check_moments,
    check_tensor,
    require_positive,
    tolerance,
)
from polhode.inertia._shapes import AbstractShaped, Symmetry
from polhode.inertia._tensor import check_points, of_points, turned
from polhode.rotation import to_matrix


class Inertia(AbstractShaped):
    """Inertia tensor I of a rigid body in body axes, kg m^2 (document 003; theory section 7).

    Exactly one of two leaves holds the numbers: ``diagonal`` (..., 3) when the body axes are
    principal axes, ``full`` (..., 3, 3) otherwise. Leading axes are a batch of bodies. Build it
    with the ``from_...`` constructors: they check the numbers; this one does not.
    """

    diagonal: Float[Array, "*b 3"] | None = None
    full: Float[Array, "*b 3 3"] | None = None
    symmetry: Symmetry = eqx.field(static=True, default=Symmetry.NONE)

    core_ranks = {"diagonal": 1, "full": 2}  # noqa: RUF012

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
        return cls(_checked("moments", as_float_array("moments", moments, (3,))))

    @classmethod
    def axisymmetric(cls, transverse: ArrayLike, axial: ArrayLike) -> Self:
        """A symmetric top: moments (transverse, transverse, axial), symmetry axis body z.

        Both of shape (...), kg m^2, broadcast together. Raises as ``from_moments`` does.
        """
        first, last = as_floats(transverse=(transverse, ()), axial=(axial, ()))
        moments = jnp.stack([first, first, last], axis=-1)
        name = "(transverse, transverse, axial)"
        return cls(_checked(name, moments), None, Symmetry.AXISYMMETRIC)

    @classmethod
    def spherical(cls, moment: ArrayLike) -> Self:
        """All moments equal (sphere, cube, ...): ``moment`` of shape (...), kg m^2, positive."""
        single = as_float_array("moment", moment, ())
        require_positive("moment", single)
        return cls(jnp.stack([single] * 3, axis=-1), None, Symmetry.SPHERICAL)

    @classmethod
    def from_tensor(cls, tensor: ArrayLike) -> Self:
        """Inertia tensor (..., 3, 3) in any body axes, kg m^2: symmetric, products negative-signed.

        The off-diagonal entries are ``-integral x y dm`` (theory section 7). Raises ValueError for
        a wrong shape, NaN or infinity, a tensor that is not symmetric, or one whose principal
        moments are not positive or break the triangle inequality.
        """
        array = as_float_array("tensor", tensor, (3, 3))
        check_tensor("tensor", array)
        return cls(full=(array + jnp.swapaxes(array, -1, -2)) / 2)

    @classmethod
    def from_points(cls, masses: ArrayLike, positions: ArrayLike) -> Self:
        """Point masses (..., n), kg, at ``positions`` (..., n, 3), m, about the origin.

        ``I = sum m (x.x 1 - x x^T)`` (document 003 display 24). The origin is the point that the
        body turns about; for a free body use ``MassProperties.from_points``, whose ``inertia`` is
        about the centre of mass. Raises ValueError for an empty set, a negative mass, points
        that all lie on one line through the origin, NaN or infinity.
        """
        masses, positions = as_floats(masses=(masses, (None,)), positions=(positions, (None, 3)))
        check_points(masses, positions)
        tensor = of_points(masses, positions)
        check_tensor("the inertia of the points", tensor)
        return cls(full=tensor)

    @classmethod
    def _of_shape(cls, mass: Array, moments: Array, symmetry: Symmetry) -> Self:
        return cls(_checked("the principal moments", moments), None, symmetry)

    @classmethod
    def from_log_cholesky(cls, parameters: ArrayLike) -> Self:
        """A physical inertia from any real 6-vector (..., 6); see ``to_log_cholesky``."""
        array = as_float_array("parameters", parameters, (6,))
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

    def turned(self, wxyz: Float[Array, "*#b 4"]) -> Self:
        """The body turned by the unit quaternion (..., 4) in its axes: ``R I R^T``, a full tensor.

        ``axes`` of the result is such a turn: ``Inertia(moments).turned(axes)`` is the body again.
        """
        return type(self)(full=turned(self.tensor, to_matrix(wxyz)))

    def to_principal(self) -> tuple[Self, Float[Array, "*b 4"]]:
        """The same body in principal axes, and the turn ``wxyz`` from those to the present axes.

        ``wxyz`` is a constant for derivatives, and the products of inertia about it are dropped:
        for derivatives of a motion with respect to a full tensor use ``principal``.
        """
        if self.diagonal is not None:
            unit = jnp.asarray([1, 0, 0, 0], self.dtype)
            return self, jnp.broadcast_to(unit, (*self.batch_shape, 4))
        moments, wxyz, _ = principal(self.full)
        return type(self)(moments), wxyz

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


def _checked(name, moments):
    if is_concrete(moments):
        check_moments(name, np.asarray(moments, np.float64), tolerance(moments))
    return moments
