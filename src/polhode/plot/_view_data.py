"""What a page of ``plot.view`` knows of its bodies: numbers, surfaces, the place of the eye."""

import base64
import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from polhode._trajectory import Trajectory
from polhode.inertia._mesh import as_triangles, load_mesh
from polhode.plot._samples import Samples, as_samples, box_sides, matrices
from polhode.rotation import matrix_to_wxyz

MOST_SAMPLES = 20_000
"""Samples of all shown bodies together that a page holds; more are thinned."""

QUARTER = np.pi / 2
"""Largest turn [rad] between samples across which a page interpolates."""

_MOST_BODIES = 12
_COLORS = ("#f0803c", "#2fbf8f", "#4a97e8")  # of the faces of a box, by body axis


@dataclasses.dataclass(frozen=True)
class Body:
    """One body in the order of time: ts (T,), wxyz, omega_body, momentum (T, 3) in space."""

    ts: np.ndarray
    wxyz: np.ndarray
    omega_body: np.ndarray
    momentum: np.ndarray
    tensor: np.ndarray

    @classmethod
    def sorted(cls, ts, wxyz, omega_body, momentum, tensor) -> "Body":
        """The body with its samples in the order of time, which may run backwards."""
        order = np.argsort(ts)
        return cls(ts[order], wxyz[order], omega_body[order], momentum[order], tensor)

    @property
    def free(self) -> bool:
        """Whether momentum in space stays, and is that of the body alone (no wheels).

        To a thousandth, which no eye can tell.
        """
        own = np.einsum("tij,jk,tk->ti", matrices(self.wxyz), self.tensor, self.omega_body)
        size = np.linalg.norm(self.momentum, axis=-1).max()
        steady = np.ptp(self.momentum, axis=0) <= 1e-3 * size
        return bool(steady.all() and (np.abs(own - self.momentum) <= 1e-3 * size).all())


def chosen(what: Any, bodies: Sequence[int] | None) -> list[Body]:
    """The bodies to show, by number, of one motion or of several."""
    several = what if isinstance(what, list) else [what]
    found: list[Body] = []
    for one in several:
        found += [one] if isinstance(one, Body) else bodies_of(one)
    numbers = list(range(len(found)) if bodies is None else bodies)
    if not 1 <= len(numbers) <= _MOST_BODIES:
        raise ValueError(
            f"a page shows 1 to {_MOST_BODIES} bodies, got {len(numbers)}: pick some with bodies=."
        )
    wrong = [number for number in numbers if not -len(found) <= number < len(found)]
    if wrong:
        raise ValueError(f"bodies must be below the number of bodies, {len(found)}, got {wrong}.")
    picked = [found[number] for number in numbers]
    for number, body in zip(numbers, picked, strict=True):
        if not all(np.isfinite(x).all() for x in (body.ts, body.wxyz, body.omega_body)):
            raise ValueError(
                f"body {number} did not finish, its samples are not all finite: leave it out with"
                " bodies=."
            )
    return picked


def bodies_of(what: Trajectory | Samples) -> list[Body]:
    """The bodies of a motion, batch axes flattened."""
    made = as_samples(what)
    wxyz, tensor = made.need("wxyz", "a page"), made.need("tensor", "a page")
    if isinstance(what, Trajectory):  # that of rotors included
        momentum = np.asarray(what.momentum_space, np.float64).reshape(made.omega_body.shape)
    else:
        momentum = made.momentum_space
    samples = zip(made.ts, wxyz, made.omega_body, momentum, tensor, strict=True)
    return [Body.sorted(*parts) for parts in samples]


def per_body(mesh: Any, count: int) -> list[Any]:
    if not isinstance(mesh, list):
        return [mesh] * count
    if len(mesh) != count:
        raise ValueError(f"a list of meshes must have one for each of {count} bodies, {len(mesh)}.")
    return mesh


def drawn(body: Body, start: float, most: int, mesh: Any) -> dict[str, Any]:
    """What the page knows of one body."""
    step = max(1, -(-(len(body.ts) - 1) // (most - 1)))
    kept = np.unique(np.append(np.arange(0, len(body.ts), step), len(body.ts) - 1))
    moments, turn = np.linalg.eigh(body.tensor)
    turn[:, 0] *= np.linalg.det(turn)  # right-handed
    energy = np.einsum("ti,ij,tj->t", body.omega_body, body.tensor, body.omega_body).max()
    rates = np.linalg.norm(body.omega_body, axis=-1)
    gaps = np.diff(body.ts[kept]) * np.maximum(rates[kept][1:], rates[kept][:-1])
    return {
        "ts": _packed(body.ts[kept] - start),
        "wxyz": _packed(body.wxyz[kept]),
        "omega_body": _packed(body.omega_body[kept]),
        "momentum_space": _packed(body.momentum[kept]),
        "tensor": [float(x) for x in body.tensor.reshape(-1)],
        "principal": [float(x) for x in np.asarray(matrix_to_wxyz(jnp.asarray(turn)))],
        "semi": [float(x) for x in 1 / np.sqrt(moments)],
        "rate_scale": float(np.sqrt(moments[0] / energy)) if energy > 0 else 1.0,
        "most_rate": float(rates.max()),
        "most_momentum": float(np.linalg.norm(body.momentum, axis=-1).max()),
        "coarse": bool(gaps.size and gaps.max() > QUARTER),
        "step": step,
        "solid": _box(moments, turn) if mesh is None else _mesh(mesh),
    }


def _packed(array: Any, dtype: str = "<f4") -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype).tobytes()).decode("ascii")


def _solid(vertices, faces, colors) -> dict[str, Any]:
    size = np.linalg.norm(vertices, axis=-1).max()
    return {
        "vertices": _packed(vertices / size),
        "faces": _packed(faces, "<u4"),
        "colors": None if colors is None else _packed(colors),
    }


def _box(moments: np.ndarray, turn: np.ndarray) -> dict[str, Any]:
    """The homogeneous box with these moments; a hue for each body axis, paler on its far side."""
    half = box_sides(moments)
    vertices, colors, faces = [], [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            first, second = (axis + 1) % 3, (axis + 2) % 3
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner = np.zeros(3)
                corner[[axis, first, second]] = sign, sign * a, b
                vertices.append(turn @ (corner * half))
            nearest = int(np.argmax(np.abs(turn[:, axis])))
            hue = _linear(_COLORS[nearest])
            colors += [hue if sign * turn[nearest, axis] > 0 else 0.35 * hue + 0.45] * 4
            at = len(vertices) - 4
            faces += [[at, at + 1, at + 2], [at, at + 2, at + 3]]
    return _solid(np.array(vertices), np.array(faces), np.array(colors))


def _linear(color: str) -> np.ndarray:
    """Linear light (3,) of a colour such as "#2fbf8f", which is what a renderer adds up."""
    return (np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255) ** 2.2


def _mesh(mesh: Any) -> dict[str, Any]:
    if isinstance(mesh, (str, os.PathLike)):
        mesh = load_mesh(mesh)
    elif hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        mesh = (mesh.vertices, mesh.faces)
    if not isinstance(mesh, tuple) or len(mesh) != 2:
        raise TypeError(
            "mesh must be a pair (vertices, faces), a trimesh.Trimesh or the path of a mesh file,"
            f" got {type(mesh).__name__}."
        )
    vertices, faces = as_triangles(*mesh)
    if vertices.ndim != 2:
        raise ValueError(f"a mesh of one body needs vertices (v, 3), got {vertices.shape}.")
    return _solid(np.asarray(vertices), faces, None)


def camera(momenta: list[np.ndarray]) -> tuple[list[float], list[float]]:
    """The way up, and that to the eye: up is the momentum that all share, else space z."""
    up = np.array([0.0, 0.0, 1.0])
    units = [m[0] / n for m in momenta if (n := np.linalg.norm(m[0])) > 0]
    if units and min(unit @ units[0] for unit in units) > 0.99:
        up = units[0]
    side = np.eye(3)[int(np.argmin(np.abs(up)))]
    side -= up * (up @ side)
    side /= np.linalg.norm(side)
    eye = 0.94 * (0.8 * side + 0.6 * np.cross(up, side)) + 0.34 * up
    return [float(x) for x in up], [float(x) for x in eye]


def note(several: list[dict[str, Any]]) -> str:
    """What the reader of the page has to know about what is shown."""
    notes = []
    step = max(body["step"] for body in several)
    if step > 1:
        notes.append(f"One sample in {step} is shown.")
    if any(body["coarse"] for body in several):
        notes.append(
            "A body turns more than a quarter turn between samples: the picture steps from sample"
            " to sample, and does not show the motion between them."
        )
    return " ".join(notes)
