"""Files: reading light curves in CSV, ALCDEF and DAMIT format, and writing solutions for DAMIT."""

import csv
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from polhode import rotation
from polhode._atomic import atomic_write
from polhode._closed_forms import Mode
from polhode.lightcurve._data import LIGHT_TIME, LightCurve, has_distances

if TYPE_CHECKING:
    from polhode.lightcurve._solutions import Solution

# Light curves from files: CSV with a header line, ALCDEF, and DAMIT's lc.txt.

_TIME = ("jd", "time", "t", "mjd", "bjd", "hjd")
_ERROR = ("sigma", "mag_err", "magerr", "e_mag", "dmag", "flux_err", "err", "error", "uncertainty")
_GROUP = ("group", "observer", "night", "session", "block")
_VECTORS = tuple(f"{body}_{c}" for body in ("sun", "observer") for c in "xyz")


def read_light_curve(
    path: str | PathLike[str],
    vectors: str | PathLike[str] | None = None,
    *,
    calibrated: bool = False,
    reduced: bool = False,
) -> LightCurve:
    """A ``LightCurve`` from a file, whose format is recognised from its contents.

    CSV: columns ``jd`` (or ``time``, ``t``; days), ``magnitude`` (``mag``) or ``flux``
    (``brightness``), ``sun_x`` ... ``observer_z`` (``earth_x``; from the body, au), and optionally
    ``sigma`` (``mag_err``, ``err``, ``uncertainty``, ...; in the unit of the brightness),
    ``group`` (``observer``, ``night``, ``block``); ``LightCurve.notes`` names columns that are not
    read. Times are those at the observer, not corrected for light time (in a column ``bjd`` or
    ``hjd`` those at the Sun), and brightness is not reduced for distance, except a flux of mean 1.
    ``vectors``: a second CSV of ``jd`` and the six components, interpolated linearly, for a file
    without them. ALCDEF: magnitudes with their geometry from PHASE, PABL and PABB; sessions whose
    LTCAPP or REDUCEDMAGS is not NONE are already corrected for light time or reduced. DAMIT:
    intensities with vectors. For CSV and ALCDEF: ``calibrated``: groups share a zero point but for
    small errors; ``reduced``: brightness is already reduced for distance.

    Raises FileNotFoundError, and ValueError with the line or column that is wrong.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not text in UTF-8.") from None
    content = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not content:
        raise ValueError(f"{path} is empty; expected a light curve.")
    if any(line.strip().upper().startswith("STARTMETADATA") for line in content[:50]):
        return _alcdef(path, lines, vectors, calibrated, reduced)
    if len(content[0].split()) == 1 and content[0].strip().isdigit():
        if vectors is not None:
            raise ValueError(f"{path} holds vectors of its own: leave those of {vectors} out.")
        return _damit(path, lines)
    return _table(path, lines, vectors, calibrated, reduced)


def _number(path, line: int, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{path}: line {line}, {name} must be a number, got {text!r}.") from None


def _rows(path, lines) -> tuple[dict[str, list[str]], list[int]]:
    """Columns of cells by lower-case name, and the line number of each row."""
    content = [
        (k + 1, s) for k, s in enumerate(lines) if s.strip() and not s.lstrip().startswith("#")
    ]
    if not content:
        raise ValueError(f"{path} is empty; expected a header line and rows.")
    separator = next((m for m in ",;\t" if m in content[0][1]), None)

    def cells(text):
        row_cells = next(csv.reader([text], delimiter=separator)) if separator else text.split()
        return [c.strip() for c in row_cells]

    names = [name.lower() for name in cells(content[0][1])]
    twice = sorted({name for name in names if name and names.count(name) > 1})
    if twice:
        raise ValueError(f"{path} has more than one column {', '.join(twice)}: rename the others.")
    table, numbers = [], []
    for number, text in content[1:]:
        row = cells(text)
        if len(row) != len(names):
            raise ValueError(
                f"{path}: line {number} has {len(row)} cells, its header {len(names)}."
            )
        table.append(row)
        numbers.append(number)
    if not table:
        raise ValueError(f"{path} has a header line and no rows after it.")
    return {name: [row[k] for row in table] for k, name in enumerate(names)}, numbers


def _table(path, lines, vectors, calibrated: bool, reduced: bool) -> LightCurve:
    columns, numbers = _rows(path, lines)
    read = {*_TIME, *_GROUP, *_VECTORS, *(name.replace("observer", "earth") for name in _VECTORS)}

    def values(names, required=True):
        for name in names:
            if name in columns:
                read.add(name)
                cells = zip(numbers, columns[name], strict=True)
                return np.array([_number(path, k, name, c) for k, c in cells])
        if required:
            raise ValueError(
                f"{path} must have a column {' or '.join(names)}; its columns are"
                f" {', '.join(columns)}."
            )
        return None

    t, notes = values(_TIME), []
    several = [name for name in _TIME if name in columns]
    if len(several) > 1:
        notes.append(f"Of the columns {', '.join(several)} the first is taken for the time.")
    sigma = values(_ERROR, required=False)
    magnitude = values(("magnitude", "mag"), required=False)
    if magnitude is None:
        flux = values(("magnitude", "mag", "flux", "brightness", "intensity"))
        assert flux is not None  # for the type checker: ``values`` raises ValueError
        if not np.all(flux > 0):
            line = numbers[int(np.flatnonzero(~(flux > 0))[0])]
            raise ValueError(f"{path}: line {line}: a flux must be positive.")
        magnitude = -2.5 * np.log10(flux)
        if not reduced and abs(flux.mean() - 1) < 0.1:
            reduced = True
            notes.append("The flux has mean 1: taken as reduced for distance.")
        if sigma is not None:
            sigma = 2.5 / np.log(10) * sigma / flux
    group = next((columns[name] for name in _GROUP if name in columns), None)
    unread = [name for name in columns if name and name not in read]
    if unread:
        notes.append(f"Columns that are not read: {', '.join(unread)}.")
    six = _six(path, columns, numbers)
    if six is None and vectors is not None:
        six = _interpolated(vectors, t)
    sun, observer = (None, None) if six is None else (six[:, :3], six[:, 3:])
    if several in (["bjd"], ["hjd"]) and six is not None:
        t = _at_observer(t, sun, observer)
    return LightCurve.of(
        t,
        magnitude,
        sun,
        observer,
        sigma=0.0 if sigma is None else sigma,
        group=group,
        calibrated=calibrated,
        reduced=reduced,
        notes=notes,
    )


def _at_observer(t, sun, observer) -> np.ndarray:
    """Times of observation from barycentric ones, which refer to the light's passage at the Sun.

    The light is treated as that of a star in the body's direction, as is usual for such times.
    """
    delta = np.linalg.norm(observer, axis=1)
    if not has_distances(delta):
        return t
    return t + LIGHT_TIME * (delta - np.sum(sun * observer, axis=1) / delta)


def _six(path, columns, numbers):
    """The vectors (n, 6), or None without such columns."""
    names = [n if n in columns else n.replace("observer", "earth") for n in _VECTORS]
    missing = [n for n in names if n not in columns]
    if len(missing) == 6:
        return None
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)} of its vectors.")
    return np.array(
        [[_number(path, line, n, columns[n][k]) for n in names] for k, line in enumerate(numbers)]
    )


def _interpolated(path, t) -> np.ndarray:
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not text in UTF-8: expected a CSV file.") from None
    columns, numbers = _rows(path, lines)
    six = _six(path, columns, numbers)
    name = next((n for n in _TIME if n in columns), None)
    if six is None or name is None:
        raise ValueError(f"{path} must have the columns jd, {', '.join(_VECTORS)}.")
    at = np.array([_number(path, k, name, c) for k, c in zip(numbers, columns[name], strict=True)])
    if np.any(np.diff(at) <= 0) or t.min() < at[0] or t.max() > at[-1]:
        raise ValueError(
            f"{path}: the times of the vectors must increase and cover the light curve,"
            f" {t.min():.5f} to {t.max():.5f}; they are {at[0]:.5f} to {at[-1]:.5f}."
        )
    # lengths are interpolated separately: the chord between two directions is too short
    between = np.stack([np.interp(t, at, column) for column in six.T], -1).reshape(-1, 2, 3)
    lengths = np.linalg.norm(six.reshape(-1, 2, 3), axis=-1)
    length = np.stack([np.interp(t, at, column) for column in lengths.T], -1)
    return (between * (length / np.linalg.norm(between, axis=-1))[..., None]).reshape(-1, 6)


def _damit(path, lines) -> LightCurve:
    """Blocks of ``points calibrated`` and rows of JD, intensity, vectors to Sun and Earth."""
    rows = [
        (k + 1, line.split())
        for k, line in enumerate(lines)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    count, place, table, group, kinds = int(rows[0][1][0]), 1, [], [], []
    if count == 0:
        raise ValueError(f"{path} announces no light curve.")
    for block in range(count):
        if place >= len(rows):
            raise ValueError(f"{path} announces {count} light curves and holds {block}.")
        line, head = rows[place]
        if not head[0].isdigit() or int(head[0]) == 0:
            raise ValueError(
                f"{path}: line {line}, number of points must be a whole number above 0, got"
                f" {head[0]!r}."
            )
        points = int(head[0])
        kinds.append(len(head) > 1 and head[1] == "1")
        body = rows[place + 1 : place + 1 + points]
        if len(body) < points:
            raise ValueError(f"{path}: line {line} announces {points} points, got {len(body)}.")
        for number, cells in body:
            if len(cells) < 8:
                raise ValueError(
                    f"{path}: line {number} must hold 8 numbers (JD, intensity, vectors to the Sun"
                    f" and to the Earth), got {len(cells)}."
                )
            table.append([_number(path, number, "a cell", c) for c in cells[:8]])
            if not table[-1][1] > 0:
                raise ValueError(f"{path}: line {number}: an intensity must be positive.")
            group.append(f"{block + 1:04d}")
        place += 1 + points
    if place < len(rows):
        raise ValueError(
            f"{path}: {len(rows) - place} line(s) from line {rows[place][0]} on belong to none of"
            f" the {count} light curves and their numbers of points."
        )
    data = np.array(table)
    # DAMIT's documentation: JD corrected for light time, intensity reduced to 1 au
    return LightCurve.of(
        data[:, 0],
        -2.5 * np.log10(data[:, 1]),
        data[:, 2:5],
        data[:, 5:8],
        group=group,
        calibrated=all(kinds),
        at_body=True,
        reduced=True,
    )


def _alcdef(path, lines, vectors, calibrated: bool, reduced: bool) -> LightCurve:
    """Sessions of KEYWORD=value and DATA=JD|magnitude|error lines."""
    table, group, keys, session, rays, applied = [], [], {}, 0, [], []
    for number, line in enumerate(lines, 1):
        name, _, value = (part.strip() for part in line.partition("="))
        name = name.upper()
        if name == "STARTMETADATA":
            session, keys = session + 1, {}
        elif name == "DATA":
            mark = {"PIPE": "|", "TAB": "\t"}.get(keys.get("DELIMITER", "PIPE").upper(), "|")
            cells = value.split(mark)
            if len(cells) < 2:
                raise ValueError(f"{path}: line {number} must be DATA=JD|magnitude, got {line!r}.")
            used = cells[:2] if len(cells) == 2 or not cells[2].strip() else cells[:3]
            numbers = [_number(path, number, "DATA", c) for c in used]
            # public files contain numbers such as -9.99 for an unknown error
            table.append((*numbers[:2], max((*numbers, 0.0)[2], 0.0)))
            group.append(f"{session:04d}")
            rays.append(tuple(keys.get(k) for k in ("PHASE", "PABL", "PABB")))
            corrections = (keys.get(k, "").upper() for k in ("LTCAPP", "REDUCEDMAGS"))
            applied.append([word not in ("", "NONE", "FALSE") for word in corrections])
        elif name:
            keys[name] = value
    if len(table) == 0:
        raise ValueError(f"{path} holds no DATA lines.")
    data = np.array(table)
    are_numbers = all(all(_is_number(x) for x in ray) for ray in rays)
    sun = observer = None
    nights = "" if calibrated else "nights have free offsets, "
    notes = [f"ALCDEF gives no distances: {nights}times keep their light time."]
    if vectors is not None:
        six = _interpolated(vectors, data[:, 0])
        sun, observer, notes = six[:, :3], six[:, 3:], []
        r, delta = (np.linalg.norm(v, axis=1) for v in (sun, observer))
        # undo corrections of the file, which ``LightCurve.of`` applies to all points
        if has_distances(delta):
            at_body, is_reduced = np.array(applied).T
            data[:, 0] += np.where(at_body, LIGHT_TIME * delta, 0)
            data[:, 1] += np.where(is_reduced & (not reduced), 5 * np.log10(r * delta), 0)
    elif are_numbers:
        phase, longitude, latitude = np.radians(np.array(rays, float)).T
        sun = _ray(longitude - phase / 2, latitude)
        observer = _ray(longitude + phase / 2, latitude)
        notes.append(
            "Directions to Sun and observer are those of the phase angle bisector, half of the"
            " phase angle to either side along the ecliptic: approximate."
        )
    else:
        notes.append("Not every session has PHASE, PABL and PABB: no directions.")
    return LightCurve.of(
        data[:, 0],
        data[:, 1],
        sun,
        observer,
        sigma=data[:, 2],
        group=group,
        notes=notes,
        calibrated=calibrated,
        reduced=reduced,
    )


def _is_number(text) -> bool:
    try:
        return text is not None and np.isfinite(float(text))
    except ValueError:
        return False


def _ray(longitude, latitude):
    """Unit vectors from the body. The coordinates of the bisector point to the body: minus."""
    return -np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ],
        -1,
    )


# Export of a solution as the parameters and the shape file of a tumbler in DAMIT.

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

    z is the principal axis about which psi circulates: the one of the largest moment in the
    short-axis mode, of the smallest in the long-axis mode; it points to within 90 degrees of the
    angular momentum. Of the other two, x has the smaller moment.
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
    """The numbers of ``COLUMNS``: degrees, hours, and moments relative to that about z."""
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
    """Text of a shape file: counts, vertices, and the vertex numbers (from 1) of each facet."""
    lines = [f"{len(vertices)} {len(faces)}"]
    lines += [" ".join(f"{x:.12g}" for x in vertex) for vertex in vertices]
    lines += [" ".join(str(i + 1) for i in face) for face in faces]
    return "\n".join(lines) + "\n"
