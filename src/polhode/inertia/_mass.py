"""Mass, centre of mass and inertia together: composite bodies, points, meshes."""

from collections.abc import Iterable
from os import PathLike
from typing import Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_floats,
    is_concrete,
    require,
    require_positive,
)
from polhode.inertia._cholesky import (
    inertia_of_second_moments,
    pseudo_from_log_cholesky,
    pseudo_to_log_cholesky,
)
from polhode.inertia._inertia import Inertia
from polhode.inertia._input import (
    check_moments,
    check_tensor,
    tolerance,
)
from polhode.inertia._mesh import check_mesh, load_mesh, mesh_integrals
from polhode.inertia._shapes import AbstractShaped, Symmetry
from polhode.inertia._tensor import check_points, of_points, offset
from polhode.rotation import normalise, rotate


class MassProperties(AbstractShaped):
    """Mass (...), kg; centre of mass (..., 3), m; inertia about it, all in the body's axes.

    ``a + b`` joins bodies given in the same axes, ``a - b`` cuts b out of a, ``moved`` places a
    part. Parts may be thin rods or points, which alone have no inertia to turn with.
    """

    mass: Float[Array, "*b"]
    centre: Float[Array, "*b 3"]
    central: Inertia

    @classmethod
    def of(cls, mass: ArrayLike, centre: ArrayLike, inertia: Inertia) -> Self:
        """From known values; ``inertia`` about the centre of mass ``centre`` (..., 3)."""
        mass, centre = as_floats(mass=(mass, ()), centre=(centre, (3,)))
        require_positive("mass", mass)
        if not isinstance(inertia, Inertia):
            raise TypeError(
                "inertia must be a ph.Inertia, such as ph.Inertia.from_moments([1., 2., 3.]), got"
                f" {type(inertia).__name__}."
            )
        return cls(mass, centre, inertia)

    @classmethod
    def from_points(cls, masses: ArrayLike, positions: ArrayLike) -> Self:
        """Point masses (..., n), kg, at ``positions`` (..., n, 3), m; any number from one up.

        Raises ValueError for an empty set, a negative mass, NaN or infinity.
        """
        masses, positions = as_floats(masses=(masses, (None,)), positions=(positions, (None, 3)))
        check_points(masses, positions)
        mass = jnp.sum(masses, axis=-1)
        centre = jnp.sum(masses[..., None] * positions, axis=-2) / mass[..., None]
        central = of_points(masses, positions - centre[..., None, :])
        return cls(mass, centre, Inertia(full=central, physical=True))

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        density: ArrayLike | None = None,
        mass: ArrayLike | None = None,
    ) -> Self:
        """The homogeneous body inside a closed triangle mesh, by exact integrals.

        ``vertices`` (..., v, 3), m, differentiable; ``faces`` (f, 3) integers, counter-clockwise
        seen from outside, the same for a whole batch; either ``density``, kg/m^3, or ``mass``, kg.
        Raises ValueError for holes, inverted faces, vertex numbers out of range, an enclosed
        volume that is not positive, TypeError for faces that are not integers.
        """
        require(
            (density is None) != (mass is None),
            "a mesh needs either density (kg/m^3) or mass (kg), got both or neither.",
        )
        vertices, faces = check_mesh(vertices, faces)
        volume, centre, sigma = mesh_integrals(vertices, faces)
        name, given = ("density", density) if mass is None else ("mass", mass)
        amount = jnp.broadcast_to(as_float_array(name, given).astype(volume.dtype), volume.shape)
        require_positive(name, amount)
        rho, total = (amount, amount * volume) if mass is None else (amount / volume, amount)
        tensor = rho[..., None, None] * inertia_of_second_moments(sigma)
        check_tensor("the inertia of the mesh", tensor)
        return cls(total, centre, Inertia(full=tensor, physical=True))

    @classmethod
    def from_mesh_file(
        cls,
        path: str | PathLike[str],
        *,
        density: ArrayLike | None = None,
        mass: ArrayLike | None = None,
        unit: float = 1.0,
    ) -> Self:
        """As ``from_mesh``, from a file (STL, OBJ, PLY, ...) read by trimesh.

        ``unit``: metres per unit of length of the file (0.001 for millimetres). Raises ImportError
        without trimesh (extra ``mesh``), ValueError for an unreadable file or a bad mesh.
        """
        vertices, faces = load_mesh(path)
        return cls.from_mesh(vertices * unit, faces, density=density, mass=mass)

    @classmethod
    def from_log_cholesky(cls, parameters: ArrayLike) -> Self:
        """A physical body from any real 10-vector (..., 10).

        ``(alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3)`` of Rucker and Wensing 2022, eq. 12:
        the log-Cholesky factor of the pseudo-inertia; mass ``exp(2 alpha)``, centre of mass t.
        """
        mass, centre, tensor = pseudo_from_log_cholesky(
            as_float_array("parameters", parameters, (10,))
        )
        return cls(mass, centre, Inertia(full=tensor, physical=True))

    @classmethod
    def _of_shape(cls, mass: Array, moments: Array, symmetry: Symmetry) -> Self:
        mass = jnp.broadcast_to(mass, moments.shape[:-1])
        return cls(mass, jnp.zeros_like(moments), Inertia.of_symmetry(moments, symmetry))

    def to_log_cholesky(self) -> Float[Array, "*b 10"]:
        """Inverse of ``from_log_cholesky``; infinite for a flat body, which is on the boundary."""
        return pseudo_to_log_cholesky(self.mass, self.centre, self.central.tensor)

    @property
    def inertia(self) -> Inertia:
        """Inertia about the centre of mass; ValueError if it is that of no extended body."""
        if not self.central.is_principal:
            check_tensor("the inertia", self.central.tensor)
        elif is_concrete(self.central):
            moments = self.central.moments
            check_moments("the moments", np.asarray(moments, np.float64), tolerance(moments))
        return self.central

    def about(self, point: ArrayLike) -> Inertia:
        """Inertia about a fixed ``point`` (..., 3) of the body, m (parallel-axis theorem)."""
        at = as_float_array("point", point, (3,)).astype(self.mass.dtype)
        batch = jnp.broadcast_shapes(at.shape, self.centre.shape)
        shift = jnp.broadcast_to(self.centre, batch) - jnp.broadcast_to(at, batch)
        return Inertia.from_tensor(
            _sum(self.central.tensor, offset(jnp.broadcast_to(self.mass, batch[:-1]), shift))
        )

    def moved(self, offset: ArrayLike = (0.0, 0.0, 0.0), wxyz: ArrayLike | None = None) -> Self:
        """The body rotated about its origin by ``wxyz`` (..., 4), then translated by ``offset``.

        ``offset`` (..., 3), m, and the turn are given in the axes of the assembly; a quaternion
        that is not of unit length is normalised. A zero one raises ValueError.
        """
        dtype = self.mass.dtype
        shift = as_float_array("offset", offset, (3,)).astype(dtype)
        centre, central = self.centre, self.central
        if wxyz is not None:
            turn = normalise(as_float_array("wxyz", wxyz, (4,)).astype(dtype))
            batch = jnp.broadcast_shapes(turn.shape[:-1], self.mass.shape)
            turn = jnp.broadcast_to(turn, (*batch, 4))
            centre = rotate(turn, jnp.broadcast_to(centre, (*batch, 3)))
            central = central.turned(turn)
        batch = jnp.broadcast_shapes(shift.shape, centre.shape)
        centre = jnp.broadcast_to(centre, batch) + jnp.broadcast_to(shift, batch)
        return type(self)(jnp.broadcast_to(self.mass, batch[:-1]), centre, central)

    def __add__(self, other: "MassProperties") -> Self:
        return self._joined(other, 1)

    def __sub__(self, other: "MassProperties") -> Self:
        return self._joined(other, -1)

    def _joined(self, other: "MassProperties", sign: int) -> Self:
        if not isinstance(other, MassProperties):
            raise TypeError(
                "ph.MassProperties join with ph.MassProperties, got"
                f" {type(other).__name__}: the place of a part needs its mass and centre too."
            )
        ours, theirs = jnp.broadcast_arrays(self.mass, other.mass)
        theirs = sign * theirs
        mass = ours + theirs
        require_positive("the mass that remains", mass)
        fraction = theirs / mass
        gap = _sum(other.centre, -self.centre)
        lifted = jnp.broadcast_to(fraction[..., None], gap.shape)
        centre = _sum(self.centre, lifted * gap)
        parts = _sum(self.central.tensor, sign * other.central.tensor)
        central = _sum(parts, offset(ours * fraction, gap))
        return type(self)(mass, centre, Inertia(full=central, physical=True))


def compose(parts: Iterable[MassProperties]) -> MassProperties:
    """One rigid body of all ``parts``, each given in (or ``moved`` to) the same axes."""
    parts = list(parts)
    require(len(parts) > 0, "a composite body needs at least one part, got none.")
    whole = parts[0]
    for part in parts[1:]:
        whole = whole + part
    return whole


def _sum(left: Array, right: Array) -> Array:
    left, right = jnp.broadcast_arrays(left, right)
    return left + right
