"""An HTML page with moving bodies: a single file, rendered by three.js, that works offline."""

import base64
import dataclasses
import html
import json
import os
import webbrowser
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import jax.numpy as jnp
import numpy as np

from polhode._atomic import atomic_write
from polhode._extras import imported
from polhode._trajectory import Trajectory
from polhode.inertia._inertia import inertia_at
from polhode.inertia._mass import as_triangles, load_mesh
from polhode.plot._samples import Samples, Scale, as_samples, box_sides, matrices
from polhode.rotation import matrix_to_wxyz

MOST_SAMPLES = 20_000
"""Maximum number of samples in a page, over all bodies; of more samples every k-th is taken."""

QUARTER = np.pi / 2
"""Largest rotation [rad] between samples for which a page interpolates attitudes."""

_MOST_BODIES = 12
_COLORS = ("#f0803c", "#2fbf8f", "#4a97e8")  # faces of a box, by body axis


@dataclasses.dataclass(frozen=True)
class Body:
    """Samples of one body, by increasing time: ts (T,), wxyz (T, 4), omega_body (T, 3), momentum
    (T, 3) in space, and its tensor (3, 3)."""

    ts: np.ndarray
    wxyz: np.ndarray
    omega_body: np.ndarray
    momentum: np.ndarray
    tensor: np.ndarray

    @classmethod
    def sorted(cls, ts, wxyz, omega_body, momentum, tensor) -> "Body":
        """The body with its samples sorted by time, which may decrease in the arguments."""
        order = np.argsort(ts)
        return cls(ts[order], wxyz[order], omega_body[order], momentum[order], tensor)

    @property
    def free(self) -> bool:
        """Whether the momentum in space is constant and that of the body alone (no wheels).

        The tolerance is a thousandth, which is not visible in a page.
        """
        body_momentum = np.einsum(
            "tij,jk,tk->ti", matrices(self.wxyz), self.tensor, self.omega_body
        )
        size = np.linalg.norm(self.momentum, axis=-1).max()
        constant = np.ptp(self.momentum, axis=0) <= 1e-3 * size
        return bool(constant.all() and (np.abs(body_momentum - self.momentum) <= 1e-3 * size).all())


def chosen_bodies(what: Any, bodies: Sequence[int] | None) -> list[Body]:
    """The bodies of one motion or of several that have these numbers."""
    several = what if isinstance(what, Sequence) else [what]
    candidates: list[Body] = []
    for one in several:
        candidates += [one] if isinstance(one, Body) else bodies_of(one)
    numbers = list(range(len(candidates)) if bodies is None else bodies)
    if not 1 <= len(numbers) <= _MOST_BODIES:
        raise ValueError(
            f"a page shows 1 to {_MOST_BODIES} bodies, got {len(numbers)}: pick some with bodies=."
        )
    outside = [number for number in numbers if not -len(candidates) <= number < len(candidates)]
    if outside:
        raise ValueError(
            f"bodies must be below the number of bodies, {len(candidates)}, got {outside}."
        )
    picked = [candidates[number] for number in numbers]
    for number, body in zip(numbers, picked, strict=True):
        if not all(np.isfinite(x).all() for x in (body.ts, body.wxyz, body.omega_body)):
            raise ValueError(
                f"body {number} did not finish, its samples are not all finite: leave it out with"
                " bodies=."
            )
    return picked


def bodies_of(what: Trajectory | Samples) -> list[Body]:
    """The bodies of a motion, batch axes flattened."""
    data = as_samples(what)
    wxyz, tensor = data.need("wxyz", "a page"), data.need("tensor", "a page")
    samples = zip(data.ts, wxyz, data.omega_body, data.momentum_space, tensor, strict=True)
    return [Body.sorted(*parts) for parts in samples]


def per_body(mesh: Any, count: int) -> list[Any]:
    if not isinstance(mesh, list):
        return [mesh] * count
    if len(mesh) != count:
        raise ValueError(f"a list of meshes must have one for each of {count} bodies, {len(mesh)}.")
    return mesh


def drawing_of(body: Body, start: float, max_samples: int, mesh: Any) -> dict[str, Any]:
    """The data of one body for the page."""
    step = max(1, -(-(len(body.ts) - 1) // (max_samples - 1)))
    rows = np.unique(np.append(np.arange(0, len(body.ts), step), len(body.ts) - 1))
    moments, turn = np.linalg.eigh(body.tensor)
    turn[:, 0] *= np.linalg.det(turn)  # right-handed
    energy = np.einsum("ti,ij,tj->t", body.omega_body, body.tensor, body.omega_body).max()
    rates = np.linalg.norm(body.omega_body, axis=-1)
    gaps = np.diff(body.ts[rows]) * np.maximum(rates[rows][1:], rates[rows][:-1])
    return {
        "ts": _packed(body.ts[rows] - start),
        "wxyz": _packed(body.wxyz[rows]),
        "omega_body": _packed(body.omega_body[rows]),
        "momentum_space": _packed(body.momentum[rows]),
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
    """The homogeneous box with these moments; a colour for each body axis, paler on the negative
    side."""
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
    """Linear intensities (3,), which a renderer uses, of a colour such as "#2fbf8f"."""
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
    """Directions up and to the camera. Up is the common direction of the momenta, or space z."""
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
    """A note for the page on samples that are left out or not interpolated."""
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


_EXPECTED = "expected a NetCDF file (.nc) that `polhode run` wrote"
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_NEEDED = ("wxyz", "omega_body", "momentum_space", "moments")


def read(path: str | os.PathLike) -> tuple[list[Body], str]:
    """The bodies of a file that ``polhode run`` wrote, and its title."""
    # the engine h5netcdf needs h5py; scene files need pydantic
    xarray = imported("reading NetCDF", "xarray", "h5netcdf", "h5py", "pydantic")
    from polhode.files import build_inertia, parse_scene

    _require_hdf5(Path(path))
    _require_content(path)
    with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as data:
        has_body_axis = data["wxyz"].ndim > 2
        parts = [np.asarray(data[name], np.float64) for name in _NEEDED]
        wxyz, omega, momentum, moments = parts
        ts = np.asarray(data["time" if "time" in data.coords else "ts"], np.float64)
        text, title = data.attrs["scene"], str(data.attrs.get("title", ""))
    if has_body_axis and moments.ndim > 1:
        # clones with different moments, which are principal moments along the body axes
        tensors = moments[:, :, None] * np.eye(3)
    else:
        scene = parse_scene(text, path, files=False)
        # of the files that a scene names, only those of a variable inertia are needed
        if scene.inertia.table is not None:
            scene = parse_scene(text, path)
        inertia = build_inertia(scene, jnp.result_type(float))
        # a variable inertia is drawn as it is at the first time
        tensors = np.asarray(inertia_at(inertia, ts.flat[0]).tensor, np.float64)
    count = wxyz.shape[0] if has_body_axis else 1
    ts = np.broadcast_to(ts, (count, ts.shape[-1]))
    tensors = np.broadcast_to(tensors, (count, 3, 3))
    arrays = [x.reshape(count, *x.shape[-2:]) for x in (wxyz, omega, momentum)]
    return [Body.sorted(*body) for body in zip(ts, *arrays, tensors, strict=True)], title


def _require_hdf5(path: Path) -> None:
    """Check that the path is an HDF5 file, the format of NetCDF-4.

    Raises FileNotFoundError for a missing file, ValueError for a folder and for other formats.
    """
    if path.is_dir():
        kind = "the Zarr store of an ensemble" if path.suffix == ".zarr" else "a folder"
        raise ValueError(f"{path} is {kind}: {_EXPECTED}.")
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: {_EXPECTED}.")
    if not path.is_file():
        raise ValueError(f"{path} is not a regular file: {_EXPECTED}.")
    with open(path, "rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            raise ValueError(f"{path} is not NetCDF-4: {_EXPECTED}.")


def _require_content(path: str | os.PathLike) -> None:
    """Check that the file contains the variables, because xarray's own errors are less clear."""
    h5py = imported("reading NetCDF", "h5py")
    try:
        with h5py.File(path, "r") as file:
            missing = [name for name in _NEEDED if name not in file]
            if "scene" not in file.attrs:
                missing.append("the text of its scene")
    except OSError as error:
        raise ValueError(f"{path} is damaged ({error}): {_EXPECTED}.") from error
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}: {_EXPECTED}.")


_SHOWN_TURNS = 0.4  # revolutions of the fastest body per second of playback


@dataclasses.dataclass(frozen=True)
class View:
    """An HTML page. Notebooks display it; ``write(path)`` saves it, ``open(path)`` shows it too."""

    html: str
    height: int = 560

    def write(self, path: str | os.PathLike) -> Path:
        """Write the page atomically; returns the path."""
        path = Path(path)
        with atomic_write(path) as temporary:
            temporary.write_text(self.html, encoding="utf-8")
        return path

    def open(self, path: str | os.PathLike) -> bool:
        """Write the page and open it in the web browser; returns whether there is one."""
        return webbrowser.open(self.write(path).resolve().as_uri())

    def _repr_html_(self) -> str:
        page = html.escape(self.html, quote=True)
        return f'<iframe srcdoc="{page}" width="100%" height="{self.height}" style="border:0">'


def view(
    what: Trajectory | Samples | Sequence[Trajectory | Samples | Body],
    path: str | os.PathLike | None = None,
    *,
    mesh: Any = None,
    bodies: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    axis_names: tuple[str, str, str] = ("x", "y", "z"),
    title: str = "",
    seconds: float | None = None,
    scale: Scale | None = None,
) -> View:
    """A page with the moving bodies side by side, a time slider and a play button.

    Each body is shown twice. Left: the rotating body with its axes, the space axes, the angular
    momentum L and the angular velocity. Right, Poinsot's picture: the inertia ellipsoid rolls on
    the plane normal to the angular momentum; the angular velocity traces the polhode on it and the
    herpolhode in the plane. Where torques act, the ellipsoid is that of the energy at each time,
    and the plane the one that touches it.

    **Arguments:**

    - ``what``: a trajectory, a ``plot.samples``, or a list of them. Their bodies (batch axes
      flattened), 12 at most, are shown side by side; ``bodies`` selects some by number.
    - ``path``: the file to write, or None. The page needs no other file and no network.
    - ``mesh``: the body's surface in body axes, with the origin at the point about which the body
      rotates: a pair (vertices (v, 3), faces (f, 3)), a ``trimesh.Trimesh``, the path of a mesh
      file, or a list with one of these for each body. None: the homogeneous box with the same
      inertia. It is scaled to fit the picture.
    - ``names``, ``axis_names``, ``title``: of the bodies, of the body axes, of the page.
    - ``seconds``: playback time of the whole motion; None: the fastest body makes 0.4 revolutions
      per second.
    - ``scale``: units of time and rate in the page; None: units that suit the duration.

    Numbers are stored in single precision. If the bodies have more than 20,000 samples in total,
    the page contains only every k-th and the last one, with the smallest sufficient k. Attitudes
    are interpolated between samples, unless a body rotates by more than a quarter revolution from
    one sample to the next: then the page shows samples only, with a note. ``page.html#t=12.5``
    opens at that time.

    Raises ValueError for too many bodies, fewer than two times, meshes and names that do not fit
    the bodies, and for a motion that is not finite; TypeError for other kinds of input.
    """
    bodies_drawn = chosen_bodies(what, bodies)
    start = min(float(one.ts[0]) for one in bodies_drawn)
    duration = max(float(one.ts[-1]) for one in bodies_drawn) - start
    if not duration > 0:
        raise ValueError("a page needs at least two different times, got one.")
    scale = Scale.of(duration) if scale is None else scale
    if seconds is None:
        fastest = max(np.linalg.norm(one.omega_body, axis=-1).max() for one in bodies_drawn)
        seconds = max(8.0, float(fastest) * duration / (2 * np.pi) / _SHOWN_TURNS)
    if not seconds > 0:
        raise ValueError(f"seconds must be positive, got {seconds}.")
    if names is not None and len(names) != len(bodies_drawn):
        raise ValueError(f"names must name the {len(bodies_drawn)} bodies, got {len(names)}.")
    max_samples = max(2, MOST_SAMPLES // len(bodies_drawn))
    meshes = per_body(mesh, len(bodies_drawn))
    several = [
        drawing_of(one, start, max_samples, m) for one, m in zip(bodies_drawn, meshes, strict=True)
    ]
    for body, name in zip(several, names or [""] * len(several), strict=True):
        body["name"] = str(name)
    free = all(one.free for one in bodies_drawn)
    up, eye = camera([one.momentum for one in bodies_drawn] if free else [])
    motion = {
        "title": title,
        "note": note(several),
        "unit": {
            "time": scale.time,
            "seconds": scale.seconds,
            "rate": scale.rate,
            "rate_size": scale.radians_per_second,
        },
        "start": start,
        "duration": duration,
        "pace": duration / seconds,
        "axis_names": list(axis_names),
        "plane": "invariable plane" if free else "tangent plane",
        "rolling": "The inertia ellipsoid rolls on the invariable plane"
        if free
        else "The inertia ellipsoid and the plane that touches it",
        "hidden": [f"path of body {axis_names[2]}"] if free else [],
        "up": up,
        "eye": eye,
        "bodies": several,
    }
    page = View(_page(title or "polhode", motion))
    if path is not None:
        page.write(path)
    return page


def view_file(
    path: str | os.PathLike,
    output: str | os.PathLike | None = None,
    *,
    bodies: Sequence[int] | None = None,
    **options: Any,
) -> View:
    """The page of a NetCDF file that ``polhode run`` wrote.

    ``output``: the HTML file to write, or None. ``bodies``: clones by number; None: the first
    three. Other ``options`` are those of ``view``; the default title is that of the file. Moments
    and axes of the body are those of the scene file, whose text the NetCDF file contains. Raises
    ImportError without xarray and h5netcdf, FileNotFoundError for a missing file, ValueError for a
    file without the required variables.
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            f"path must be that of a NetCDF file, got {type(path).__name__}: a trajectory is shown"
            " by plot.view."
        )
    body, title = read(path)
    numbers = range(min(3, len(body))) if bodies is None else list(bodies)
    if len(body) > 1:
        clone_names = ["nominal body" if number == 0 else f"clone {number}" for number in numbers]
        options = {"names": clone_names, **options}
    return view(body, output, bodies=numbers, **{"title": title, **options})


def _page(title: str, motion: dict[str, Any]) -> str:
    folder = files("polhode.plot") / "viewer"
    names = ("page.html", "viewer.js", "three.min.js", "three.LICENSE.txt")
    text = {name: (folder / name).read_text(encoding="utf-8") for name in names}
    # "</" would end the script element that contains the numbers
    packed = json.dumps(motion, allow_nan=False).replace("<", "\\u003c")
    return Template(text["page.html"]).substitute(
        title=html.escape(title),
        motion=packed,
        library=text["three.min.js"],
        licence=text["three.LICENSE.txt"],
        viewer=text["viewer.js"],
    )
