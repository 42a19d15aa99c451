"""Mass, centre of mass and inertia together: composite bodies, points, triangle meshes."""

from collections.abc import Iterable
from os import PathLike
from os.path import basename, isfile
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from polhode._checks import (
    ArrayLike,
    as_float_array,
    as_floats,
    as_positive,
    batch_of,
    is_concrete,
    require,
    require_positive,
)
from polhode._extras import imported
from polhode._parts import Printable
from polhode.inertia._inertia import Inertia
from polhode.inertia._physical import (
    check_moments,
    check_points,
    check_tensor,
    inertia_of_second_moments,
    of_points,
    offset,
    pseudo_from_log_cholesky,
    pseudo_to_log_cholesky,
    tolerance,
)
from polhode.inertia._shapes import AbstractShaped, Symmetry
from polhode.rotation import normalise, rotate


class MassProperties(AbstractShaped, Printable):
    """Mass (...), kg; centre of mass (..., 3), m; inertia about it, all in the body's axes.

    ``a + b`` joins bodies given in the same axes, ``a - b`` cuts b out of a, ``moved`` places a
    part. Parts may be thin rods or points, whose own inertia is singular.
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
        """Point masses (..., n), kg, at ``positions`` (..., n, 3), m, with n >= 1.

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
        The wall of a cavity is a shell that faces inwards. Raises ValueError for holes, inverted
        or repeated faces, an inverted shell that is not inside of another one, vertex numbers out
        of range, an enclosed volume that is not positive, TypeError for faces that are not
        integers.
        """
        require(
            (density is None) != (mass is None),
            "a mesh needs either density (kg/m^3) or mass (kg), got both or neither.",
        )
        vertices, faces = check_mesh(vertices, faces)
        volume, centre, sigma = mesh_integrals(vertices, faces)
        name, amount_given = ("density", density) if mass is None else ("mass", mass)
        amount = as_float_array(name, amount_given).astype(volume.dtype)
        try:
            fits = np.broadcast_shapes(amount.shape, volume.shape) == volume.shape
        except ValueError:
            fits = False
        if not fits:
            raise ValueError(
                f"{name} must be one number, or one for each mesh of the batch {volume.shape}, got"
                f" the shape {amount.shape}."
            )
        amount = jnp.broadcast_to(amount, volume.shape)
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
        without trimesh (extra ``mesh``), ValueError for an unreadable file or a bad mesh,
        TypeError or ValueError for a unit that is not a positive number.
        """
        as_positive("unit", unit, hint="metres per unit of length of the file")
        vertices, faces = load_mesh(path)
        return cls.from_mesh(vertices * unit, faces, density=density, mass=mass)

    @classmethod
    def from_urdf(cls, path: str | PathLike[str], link: str) -> Self:
        """Mass properties of a link in a URDF file, in the axes of the link.

        ``centre`` is measured from the origin of the link. URDF files are in SI units. Raises
        FileNotFoundError, and ValueError for a file that is not URDF, a link that is missing or
        has no inertia, and unphysical moments.
        """
        from polhode.inertia._robots import read_urdf  # imported here because it imports SciPy

        return cls._of_file(path, link, *read_urdf(path, link))

    @classmethod
    def from_mjcf(cls, path: str | PathLike[str], body: str) -> Self:
        """Mass properties of a body in an MJCF file, read by MuJoCo, in the axes of the body.

        ``centre`` is measured from the origin of the body. Where the file has no ``inertial``
        element, MuJoCo computes one from the geoms. Raises as ``from_urdf``, and ImportError
        without mujoco (extra ``robots``).
        """
        from polhode.inertia._robots import read_mjcf  # imported here because it imports SciPy

        return cls._of_file(path, body, *read_mjcf(path, body))

    @classmethod
    def _of_file(
        cls,
        path: str | PathLike[str],
        part: str,
        mass: float,
        centre: np.ndarray,
        tensor: np.ndarray,
    ) -> Self:
        """The body from numbers of a file; errors name the part and the file."""
        try:
            return cls.of(mass, centre, Inertia.from_tensor(tensor))
        except ValueError as error:
            raise ValueError(f"{part!r} of {basename(path)}: {error}") from error

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
        tensor = self.central.tensor
        batch = np.broadcast_shapes(self.mass.shape, self.centre.shape[:-1], tensor.shape[:-2])
        return pseudo_to_log_cholesky(
            jnp.broadcast_to(self.mass, batch),
            jnp.broadcast_to(self.centre, (*batch, 3)),
            jnp.broadcast_to(tensor, (*batch, 3, 3)),
        )

    @property
    def inertia(self) -> Inertia:
        """Inertia about the centre of mass; ValueError for a point or a thin line."""
        if not self.central.is_principal:
            check_tensor("the inertia", self.central.tensor)
        elif is_concrete(self.central):
            moments = self.central.moments
            check_moments("the moments", np.asarray(moments, np.float64), tolerance(moments))
        return self.central

    def about(self, point: ArrayLike) -> Inertia:
        """Inertia about a ``point`` (..., 3) [m] of the body, by the parallel-axis theorem."""
        at = as_float_array("point", point, (3,)).astype(self.mass.dtype)
        batch = (*batch_of(point=(at, 1), centre=(self.centre, 1)), 3)
        shift = jnp.broadcast_to(self.centre, batch) - jnp.broadcast_to(at, batch)
        return Inertia.from_tensor(
            _sum(self.central.tensor, offset(jnp.broadcast_to(self.mass, batch[:-1]), shift))
        )

    def moved(self, offset: ArrayLike = (0.0, 0.0, 0.0), wxyz: ArrayLike | None = None) -> Self:
        """The body rotated about its origin by ``wxyz`` (..., 4), then translated by ``offset``.

        ``offset`` (..., 3), m, and the rotation are given in the axes of the assembly; a quaternion
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
        return self._join(other, 1)

    def __sub__(self, other: "MassProperties") -> Self:
        return self._join(other, -1)

    def _join(self, other: "MassProperties", sign: int) -> Self:
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
    body = parts[0]
    for part in parts[1:]:
        body = body + part
    return body


def _sum(left: Array, right: Array) -> Array:
    left, right = jnp.broadcast_arrays(left, right)
    return left + right


def as_triangles(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, np.ndarray]:
    """Vertices (..., v, 3) as floats and faces (f, 3) as integers; TypeError or ValueError."""
    vertices = as_float_array("vertices", vertices, (None, 3))
    if not is_concrete(faces):
        raise TypeError(
            "faces must be known when the function is traced, got a traced array; close over them "
            "instead of passing them through jit or vmap."
        )
    faces = np.asarray(faces)
    require(
        faces.ndim == 2 and faces.shape[1] == 3 and len(faces) > 0,
        f"faces must have shape (f, 3) with f > 0 (triangles), got {faces.shape}.",
    )
    if not np.issubdtype(faces.dtype, np.integer):
        raise TypeError(f"faces must hold vertex numbers (integers), got dtype {faces.dtype}.")
    count = vertices.shape[-2]
    require(
        faces.min() >= 0 and faces.max() < count,
        f"faces must refer to vertices 0 to {count - 1}, got {faces.min()} to {faces.max()}; "
        "does the file count from 1?",
    )
    return vertices, faces


def check_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, np.ndarray]:
    """``as_triangles`` for a closed, oriented surface.

    Raises ValueError if the surface has holes, repeated faces or faces of opposite orientation, or
    (for concrete vertices) does not enclose a positive volume or has an inverted shell that is not
    the wall of a cavity.
    """
    vertices, faces = as_triangles(vertices, faces)
    _check_closed(faces)
    if is_concrete(vertices) and vertices.size:
        with jax.ensure_compile_time_eval():  # concrete numbers: evaluated now, even under jit
            volume = np.asarray(mesh_integrals(vertices, faces)[0])
        require(
            volume > 0,
            f"the mesh must enclose a positive volume, got {volume.min():g}; a negative one means "
            "that all faces are inverted (wind them counter-clockwise seen from outside: "
            "faces[:, ::-1]).",
        )
        _check_shells(np.asarray(vertices, np.float64), faces)
    return vertices, faces


def _check_closed(faces: np.ndarray) -> None:
    """ValueError unless every edge is used as often in one direction as in the other."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, which, used = np.unique(
        low.astype(np.int64) * (int(faces.max()) + 1) + high,
        return_inverse=True,
        return_counts=True,
    )
    open_edges = int((used % 2).sum())
    require(
        open_edges == 0,
        f"the mesh must be closed, got {open_edges} of {len(used)} edges with a hole beside them; "
        "fill the holes, or merge duplicate vertices.",
    )
    balance = np.bincount(which, weights=np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0))
    wrong = int((balance != 0).sum())
    require(
        wrong == 0,
        f"the faces must be wound alike, got {wrong} of {len(used)} edges between faces of "
        "opposite orientation; some faces are inverted: reverse their vertex order.",
    )
    if used.max() > 2:  # edges of repeated faces are used four times or more
        _, which = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
        orientation = np.sign(np.diff(faces.astype(np.int64), axis=1, append=faces[:, :1]))
        net = np.bincount(which.ravel(), weights=orientation.prod(axis=1))
        repeated = int((abs(net) > 1).sum())
        require(
            repeated == 0,
            f"the mesh has {repeated} faces more than once, so that what they enclose would count"
            " more than once: remove the repeated faces.",
        )


def _check_shells(vertices: np.ndarray, faces: np.ndarray) -> None:
    """ValueError unless every inverted shell of the meshes (..., v, 3) lies inside of another."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = vertices.shape[-2]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).astype(np.int64)
    graph = coo_array((np.ones(len(edges), bool), tuple(edges.T)), (count, count))
    _, shell = np.unique(connected_components(graph)[1][faces[:, 0]], return_inverse=True)
    shells = int(shell.max()) + 1
    if shells == 1:
        return
    for mesh in vertices.reshape(-1, count, 3):
        corners = mesh[faces] - mesh.mean(axis=0)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volumes = np.bincount(shell, weights=np.sum(corners[:, 0] * normals, axis=-1))
        # flat shells, whose volume is a rounding error, do not matter
        negative = np.flatnonzero(volumes < -1e-9 * abs(volumes).sum()).tolist()
        inverted = [k for k in negative if not _is_cavity(k, corners, normals, shell)]
        require(
            not inverted,
            f"{len(inverted)} of {shells} separate shells of the mesh are inverted and not the wall"
            " of a cavity inside of another one, so that their volume would be subtracted: reverse"
            " the vertex order of their faces.",
        )


def _is_cavity(k: int, corners: np.ndarray, normals: np.ndarray, shell: np.ndarray) -> bool:
    """Whether the inverted shell ``k`` lies inside of the others, by their winding number."""
    areas = np.where(shell == k, np.linalg.norm(normals, axis=-1), -1)
    largest = int(np.argmax(areas))
    # a point between the shell and the others if it touches one of them: normals point inwards
    inwards = 1e-6 * normals[largest] / np.sqrt(areas[largest])
    a, b, c = np.moveaxis(corners[shell != k] - corners[largest].mean(axis=0) - inwards, 1, 0)
    # solid angles of triangles: Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30 (1983)
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    dots = [np.sum(x * y, axis=-1) for x, y in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    angles = 2 * np.arctan2(np.sum(a * np.cross(b, c), axis=-1), below)
    return bool(angles.sum() > 2 * np.pi)


@jax.jit  # outside jit too, one program for all operations
def mesh_integrals(
    vertices: Float[Array, "*b v 3"], faces: Int[Array | np.ndarray, "f 3"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Float[Array, "*b 3 3"]]:
    """Volume, centre and central second moments per density [m^5] inside a closed mesh.

    Exact sums over the tetrahedra that the faces span with a common apex; differentiable with
    respect to the vertices (``integral x x^T`` over a tetrahedron with apex 0 and corners a, b, c
    is ``det(a, b, c)/120 (s s^T + a a^T + b b^T + c c^T)``, ``s = a + b + c``).
    """
    # The integrals do not depend on the apex, which only reduces rounding errors: no derivative.
    apex = jax.lax.stop_gradient(jnp.mean(vertices, axis=-2, keepdims=True))
    local = vertices - apex
    corners = [[local[..., faces[:, k], i] for i in range(3)] for k in range(3)]
    a, b, c = corners
    determinant = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    total = [a[i] + b[i] + c[i] for i in range(3)]
    volume = jnp.sum(determinant, axis=-1) / 6
    centre = [jnp.sum(determinant * total[i], axis=-1) / (24 * volume) for i in range(3)]

    def second(i, j):
        products = total[i] * total[j] + a[i] * a[j] + b[i] * b[j] + c[i] * c[j]
        return jnp.sum(determinant * products, axis=-1) / 120 - volume * centre[i] * centre[j]

    rows = [jnp.stack([second(min(i, j), max(i, j)) for j in range(3)], -1) for i in range(3)]
    return volume, jnp.stack(centre, axis=-1) + apex[..., 0, :], jnp.stack(rows, axis=-2)


def load_mesh(path: str | PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a mesh file (STL, OBJ, PLY, ...), read by trimesh.

    Raises ImportError without trimesh, FileNotFoundError for a missing file, ValueError if it
    cannot be read as one mesh.
    """
    trimesh = imported("reading mesh files", "trimesh", extra="mesh")
    if not isfile(path):
        raise FileNotFoundError(f"there is no mesh file {path}.")
    try:
        mesh = trimesh.load_mesh(path, process=True)
    except Exception as error:
        raise ValueError(f"{path} could not be read as a mesh: {error}") from error
    faces = np.asarray(getattr(mesh, "faces", np.zeros((0, 3), int)))
    require(len(faces) > 0, f"{path} must hold one mesh of triangles, got {type(mesh).__name__}.")
    return np.asarray(mesh.vertices, np.float64), faces
