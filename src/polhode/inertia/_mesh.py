"""Homogeneous bodies bounded by triangle meshes: exact volume integrals."""

from os import PathLike
from os.path import isfile

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from polhode._checks import ArrayLike, as_float_array, is_concrete, require
from polhode._extras import imported


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
    """``as_triangles`` of a closed, oriented surface.

    Raises ValueError when the surface has holes, faces wound against their neighbours, or
    (vertices known) does not enclose a positive volume.
    """
    vertices, faces = as_triangles(vertices, faces)
    _check_closed(faces)
    if is_concrete(vertices) and vertices.size:
        with jax.ensure_compile_time_eval():  # the numbers are known, also under jit
            volume = np.asarray(mesh_integrals(vertices, faces)[0])
        require(
            volume > 0,
            f"the mesh must enclose a positive volume, got {volume.min():g}; a negative one means "
            "that all faces are inverted (wind them counter-clockwise seen from outside: "
            "faces[:, ::-1]).",
        )
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


@jax.jit  # one program, not one for each operation
def mesh_integrals(
    vertices: Float[Array, "*b v 3"], faces: Int[Array | np.ndarray, "f 3"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b 3"], Float[Array, "*b 3 3"]]:
    """Volume, centre and central second moments (kg m^2 per kg m^-3) inside a closed mesh.

    Exact sums over the tetrahedra that the faces span with an inner point; differentiable with
    respect to the vertices (``integral x x^T`` over a tetrahedron with apex 0 and corners a, b, c
    is ``det(a, b, c)/120 (s s^T + a a^T + b b^T + c c^T)``, ``s = a + b + c``).
    """
    # The integrals do not depend on the apex: it only keeps the summands small, so it is constant.
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

    Raises ImportError without trimesh, FileNotFoundError without the file, ValueError when it
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
