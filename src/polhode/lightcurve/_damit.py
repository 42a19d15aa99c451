"""Export of a solution as the numbers and the shape file of a tumbler in the DAMIT database."""

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from polhode import rotation
from polhode._atomic import atomic_write
from polhode._closed_forms import Mode

if TYPE_CHECKING:
    from polhode.lightcurve._solutions import Solution

COLUMNS = ("lambda", "beta", "P_psi", "P_phi", "I1", "I2", "phi0", "psi0", "JD0")

_CONVENTIONS = """\
# Free precession: r_ecl = Rz(lambda) Ry(90 deg - beta) Rz(phi) Rx(theta) Rz(psi) r_body
# d phi/dt = L (sin(psi)^2 / I1 + cos(psi)^2 / I2), d psi/dt = cos(theta) (L / I3 - d phi/dt)
# lambda, beta [deg]: direction of the angular momentum in the frame of the light curve
# P_psi [h]: period of psi; P_phi [h]: 360 deg over the mean rate of phi
# I1, I2: moments about x and y in the unit of the moment about z, I3 = 1
# phi0, psi0 [deg] at JD0, where 0 < theta < 90 deg; theta and L follow from the periods
"""

_HOURS = 24.0


def write_damit(solution: "Solution", folder: str | PathLike[str], *, jd_of_zero: float) -> Path:
    """Write ``tumbler.csv`` and ``shape.txt`` of a solution; see ``Solution.to_damit``."""
    folder = Path(folder)
    if solution.mode not in (Mode.SAM, Mode.LAM):
        raise ValueError(
            f"this solution is {Mode(solution.mode).name}: tumblers of DAMIT are in the short-axis"
            " mode or in the long-axis mode."
        )
    if solution.harmonics is not None:
        raise ValueError(
            "the shape of this solution is a convex surface known by its curvature, without"
            " vertices: export a solution with the shape of an ellipsoid."
        )
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}: make it first.")
    axes = axis_order(solution)
    numbers = tumbler_of(solution, axes, jd_of_zero)
    row = ",".join(repr(numbers[name]) for name in COLUMNS)
    with atomic_write(folder / "tumbler.csv") as temporary:
        temporary.write_text(f"{_CONVENTIONS}{','.join(COLUMNS)}\n{row}\n", encoding="utf-8")
    vertices, faces = ellipsoid_mesh(solution.axes)
    with atomic_write(folder / "shape.txt") as temporary:
        temporary.write_text(_shape(vertices @ axes, faces), encoding="utf-8")
    return folder


def axis_order(solution: "Solution") -> np.ndarray:
    """Axes x, y, z of DAMIT as columns (3, 3) in the body axes of the solution, right-handed.

    z is the principal axis about which psi circulates: that of the largest moment in the short-axis
    mode, of the smallest one in the long-axis mode; its direction is that within 90 degrees of the
    angular momentum. Of the others x has the smaller moment.
    """
    momentum = solution.moments * solution.omega_body
    order = np.argsort(solution.moments)
    x, y, z = order if solution.mode == Mode.SAM else (order[1], order[2], order[0])
    axes = np.zeros((3, 3))
    axes[x, 0] = axes[y, 1] = 1
    axes[z, 2] = 1 if momentum[z] >= 0 else -1
    if np.linalg.det(axes) < 0:
        axes[:, 1] *= -1
    return axes


def tumbler_of(solution: "Solution", axes: np.ndarray, jd_of_zero: float) -> dict[str, float]:
    """The numbers of ``COLUMNS``: degrees, hours and moments over that about z."""
    matrix = np.asarray(rotation.wxyz_to_matrix(np.asarray(solution.wxyz, float)))
    momentum = matrix @ (solution.moments * solution.omega_body)
    momentum = momentum / np.linalg.norm(momentum)
    longitude, latitude = (
        np.arctan2(momentum[1], momentum[0]),
        np.arcsin(np.clip(momentum[2], -1, 1)),
    )
    # columns of Rz(lambda) Ry(90 deg - beta)
    c, s = np.cos(longitude), np.sin(longitude)
    frame = np.array(
        [
            [np.sin(latitude) * c, -s, np.cos(latitude) * c],
            [np.sin(latitude) * s, c, np.cos(latitude) * s],
            [-np.cos(latitude), 0, np.sin(latitude)],
        ]
    )
    precessing = frame.T @ matrix @ axes  # Rz(phi) Rx(theta) Rz(psi)
    phi = np.arctan2(precessing[0, 2], -precessing[1, 2])
    psi = np.arctan2(precessing[2, 0], precessing[2, 1])
    moments = np.abs(axes).T @ solution.moments
    short = solution.mode == Mode.SAM
    P_phi = solution.P_phi_short_axis if short else solution.P_phi
    return {
        "lambda": float(np.degrees(longitude) % 360),
        "beta": float(np.degrees(latitude)),
        "P_psi": float(_HOURS * solution.P_psi),
        "P_phi": float(_HOURS * P_phi),
        "I1": float(moments[0] / moments[2]),
        "I2": float(moments[1] / moments[2]),
        "phi0": float(np.degrees(phi) % 360),
        "psi0": float(np.degrees(psi) % 360),
        "JD0": float(solution.epoch + jd_of_zero),
    }


def ellipsoid_mesh(axes: np.ndarray, rows: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and triangles (f, 3), counterclockwise from outside, on an ellipsoid."""
    polar = np.pi * np.arange(1, rows) / rows
    round_ = np.pi * np.arange(2 * rows) / rows
    ring = np.stack([np.cos(round_), np.sin(round_)], axis=-1)
    points = [
        np.concatenate([np.sin(a) * ring, np.full((2 * rows, 1), np.cos(a))], axis=-1)
        for a in polar
    ]
    vertices = np.concatenate([[[0.0, 0, 1]], *points, [[0.0, 0, -1]]])
    k = np.arange(2 * rows)
    after, last = (k + 1) % (2 * rows), len(vertices) - 1
    faces = [np.stack([0 * k, 1 + k, 1 + after], axis=-1)]
    for start in range(1, last - 2 * rows, 2 * rows):
        low = start + 2 * rows
        faces.append(np.stack([start + k, low + k, low + after], axis=-1))
        faces.append(np.stack([start + k, low + after, start + after], axis=-1))
    start = last - 2 * rows
    faces.append(np.stack([start + k, np.full_like(k, last), start + after], axis=-1))
    return vertices * np.asarray(axes), np.concatenate(faces)


def _shape(vertices: np.ndarray, faces: np.ndarray) -> str:
    """Counts, vertices, and the numbers of the vertices of each facet, counted from 1."""
    lines = [f"{len(vertices)} {len(faces)}"]
    lines += [" ".join(f"{x:.12g}" for x in vertex) for vertex in vertices]
    lines += [" ".join(str(i + 1) for i in face) for face in faces]
    return "\n".join(lines) + "\n"
