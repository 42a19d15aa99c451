"""A page that shows moving bodies: one HTML file, drawn by three.js, which needs no network."""

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

import numpy as np

from polhode._trajectory import Trajectory
from polhode.files._atomic import whole_file
from polhode.plot._samples import Samples
from polhode.plot._scale import Scale
from polhode.plot._view_data import (
    MOST_SAMPLES,
    Body,
    camera,
    chosen,
    drawn,
    note,
    per_body,
)
from polhode.plot._view_file import read

_SHOWN_TURNS = 0.4  # turns that the fastest body makes in a second of the page


@dataclasses.dataclass(frozen=True)
class View:
    """A page, as text: notebooks show it; ``write(path)`` makes a file, ``open(path)`` shows it."""

    html: str
    height: int = 560

    def write(self, path: str | os.PathLike) -> Path:
        """Write the page, whole or not at all; returns the path."""
        path = Path(path)
        with whole_file(path) as temporary:
            temporary.write_text(self.html, encoding="utf-8")
        return path

    def open(self, path: str | os.PathLike) -> bool:
        """Write the page and show it in the user's web browser; whether there is one."""
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

    Each body is shown twice. Left, the body turns with its axes, the space axes, the angular
    momentum L and the angular velocity. Right, Poinsot's picture: the inertia ellipsoid rolls on
    the plane normal to the angular momentum; the angular velocity traces the polhode on it and
    the herpolhode in the plane. Where torques act, the ellipsoid is that of the energy at each
    time, and the plane the one that touches it.

    **Arguments:**

    - ``what``: a trajectory, a ``plot.samples``, or a list of them, whose bodies (batch axes
      flattened) stand side by side, 12 at most; ``bodies`` picks some by number.
    - ``path``: the file to write, or None. The page needs nothing but the file: no network.
    - ``mesh``: the body's surface in body axes, its origin the point that the body turns about: a
      pair (vertices (v, 3), faces (f, 3)), a ``trimesh.Trimesh``, the path of a mesh file, or a
      list of one for each body. None: the homogeneous box with the same inertia. It is drawn to
      fit the picture, whatever its size.
    - ``names``, ``axis_names``, ``title``: of the bodies, of the body axes, of the page.
    - ``seconds``: time of the page that the whole motion takes; None: the fastest body makes
      0.4 turns in a second.
    - ``scale``: units of time and rate that are shown; None: those that suit the duration.

    Numbers are kept in single precision. Of bodies with more than 20,000 samples together, every
    k-th and the last are kept, k the least that suffices. Between samples attitudes are
    interpolated, unless a body turns more than a quarter turn from one sample to the next: then
    the page steps from sample to sample, and says so. ``page.html#t=12.5`` opens at that time.

    Raises ValueError for too many bodies or times, meshes and names that do not fit them, and for
    a motion that is not finite; TypeError for other kinds of input.
    """
    shown = chosen(what, bodies)
    start = min(float(one.ts[0]) for one in shown)
    duration = max(float(one.ts[-1]) for one in shown) - start
    if not duration > 0:
        raise ValueError("a page needs at least two different times, got one.")
    scale = Scale.of(duration) if scale is None else scale
    if seconds is None:
        fastest = max(np.linalg.norm(one.omega_body, axis=-1).max() for one in shown)
        seconds = max(8.0, float(fastest) * duration / (2 * np.pi) / _SHOWN_TURNS)
    if not seconds > 0:
        raise ValueError(f"seconds must be positive, got {seconds}.")
    if names is not None and len(names) != len(shown):
        raise ValueError(f"names must name the {len(shown)} bodies, got {len(names)}.")
    most = max(2, MOST_SAMPLES // len(shown))
    meshes = per_body(mesh, len(shown))
    several = [drawn(one, start, most, m) for one, m in zip(shown, meshes, strict=True)]
    for body, name in zip(several, names or [""] * len(several), strict=True):
        body["name"] = str(name)
    free = all(one.free for one in shown)
    up, eye = camera([one.momentum for one in shown] if free else [])
    motion = {
        "title": title,
        "note": note(several),
        "unit": {"time": scale.time, "seconds": scale.seconds, "rate": scale.rate,
                 "rate_size": scale.radians_per_second},
        "start": start,
        "duration": duration,
        "pace": duration / seconds,
        "axis_names": list(axis_names),
        "plane": "invariable plane" if free else "tangent plane",
        "rolling": "The inertia ellipsoid rolls on the invariable plane" if free
                   else "The inertia ellipsoid and the plane that touches it",
        "hidden": [f"path of body {axis_names[2]}"] if free else [],
        "up": up,
        "eye": eye,
        "bodies": several,
    }  # fmt: skip
    made = View(_page(title or "polhode", motion))
    if path is not None:
        made.write(path)
    return made


def view_file(
    path: str | os.PathLike,
    output: str | os.PathLike | None = None,
    *,
    bodies: Sequence[int] | None = None,
    **options: Any,
) -> View:
    """The page of a NetCDF file that ``polhode run`` wrote.

    ``output``: the HTML file to write, or None. ``bodies``: clones by number; None: the first
    three. Other ``options`` are those of ``view``; the title is that of the file. Moments and axes
    of the body are those of the scene file, whose text the NetCDF file holds. Raises ImportError
    without xarray and h5netcdf, FileNotFoundError without the file, ValueError for a file that
    lacks what is shown.
    """
    found, title = read(path)
    numbers = range(min(3, len(found))) if bodies is None else list(bodies)
    if len(found) > 1:
        named = ["nominal body" if number == 0 else f"clone {number}" for number in numbers]
        options = {"names": named, **options}
    return view(found, output, bodies=numbers, **{"title": title, **options})


def _page(title: str, motion: dict[str, Any]) -> str:
    folder = files("polhode.plot") / "viewer"
    names = ("page.html", "viewer.js", "three.min.js", "three.LICENSE.txt")
    text = {name: (folder / name).read_text(encoding="utf-8") for name in names}
    # "</" would end the script that holds the numbers
    packed = json.dumps(motion, allow_nan=False).replace("<", "\\u003c")
    return Template(text["page.html"]).substitute(
        title=html.escape(title),
        motion=packed,
        library=text["three.min.js"],
        licence=text["three.LICENSE.txt"],
        viewer=text["viewer.js"],
    )
