"""``LightCurve``: photometry with the directions to Sun and observer, and its file formats."""

import csv
import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from polhode._checks import ArrayLike
from polhode.lightcurve._brightness import Points, seeliger_sphere

# A light curve: times, magnitudes, who saw them, and where Sun and observer stood.

LIGHT_TIME = 499.00478384 / 86400  # days per au
_DOUBLED = math.radians(40)  # phase angle at which the floor has doubled
_FAR = 1e4  # au, beyond which vectors are not in au
_ROUNDED = 1e-4  # lengths that differ from 1 by less are those of unit vectors in a few digits
# Magnitudes beyond this are none: the Sun has -27, the faintest stars seen 32.
_FAINTEST = 45.0
# Deviation of the distance from Sun to observer from 1 au that an observer near the Earth has [au].
_ORBIT = 0.03
# Points of one night at its brightest magnitude that count as saturated, at least.
_REPEATED = 4
# Points that a light curve has at least.
FEWEST_POINTS = 8
# Points of one program: light curves are padded to multiples, and a search looks at so many.
BLOCK = 160


class LightCurve(NamedTuple):
    """Photometry of one body. Build with ``LightCurve.of`` or ``read_light_curve``.

    Times in days (such as Julian dates), at which the light left the body; magnitudes reduced to
    1 au from Sun and observer, where distances are known; unit vectors from the body to Sun and
    observer in one space frame, None where unknown.
    """

    t: np.ndarray  # (n,)
    magnitude: np.ndarray  # (n,)
    sigma: np.ndarray  # (n,), 0 where not given
    group: np.ndarray  # (n,) number of the night or observer
    names: tuple[str, ...]  # of the groups
    sun: np.ndarray | None  # (n, 3)
    observer: np.ndarray | None  # (n, 3)
    calibrated: bool  # magnitudes of different groups may be compared
    notes: tuple[str, ...] = ()  # what a reader had to assume

    @classmethod
    def of(
        cls,
        t: ArrayLike,
        magnitude: ArrayLike,
        sun: ArrayLike | None = None,
        observer: ArrayLike | None = None,
        *,
        sigma: ArrayLike = 0.0,
        group: ArrayLike | Sequence[str] | None = None,
        calibrated: bool = False,
        at_body: bool = False,
        reduced: bool = False,
        notes: Sequence[str] = (),
    ) -> "LightCurve":
        """Check and reduce observations.

        ``t`` (n,) [day]; ``magnitude`` (n,); ``sun``, ``observer`` (n, 3): vectors from the body
        [au], or unit vectors where distances are unknown or already taken off (``at_body``: light
        time, ``reduced``: 5 log10(r Delta)). ``sigma``: standard deviations, 0 or NaN: unknown.
        ``group`` (n,): names of nights or observers. ``calibrated``: groups share a zero point
        but for small errors. Raises ValueError for shapes that differ, values not finite, negative
        ``sigma``, and times that are all the same.
        """
        t, magnitude = np.asarray(t, float), np.asarray(magnitude, float)
        if t.ndim != 1 or t.shape != magnitude.shape or t.size < FEWEST_POINTS:
            raise ValueError(
                f"a light curve needs at least {FEWEST_POINTS} times and as many magnitudes, got"
                f" shapes {t.shape} and {magnitude.shape}."
            )
        bad = np.flatnonzero(~(np.isfinite(t) & np.isfinite(magnitude)))
        if bad.size:
            raise ValueError(f"times and magnitudes must be finite; point {bad[0]} is not.")
        if np.abs(magnitude).max() > _FAINTEST:
            raise ValueError(
                f"magnitudes reach {magnitude[np.argmax(np.abs(magnitude))]:.5g}: these are fluxes"
                " or counts. Give -2.5 log10(flux), or name the column flux."
            )
        if np.ptp(t) == 0:
            raise ValueError(f"all {t.size} times are {t[0]}: a light curve must span some time.")
        if (sun is None) != (observer is None):
            raise ValueError("give both the vectors to the Sun and to the observer, or neither.")
        if sun is not None:
            sun, r = _directions("sun", sun, t.size)
            observer, delta = _directions("observer", observer, t.size)
            far = np.abs(delta - 1).max() > _ROUNDED
            if far or np.abs(r - 1).max() > _ROUNDED:
                notes = (*notes, *_distance_notes(sun * r[:, None], observer * delta[:, None]))
            if far and not at_body:
                t = t - LIGHT_TIME * delta
            if far and not reduced:
                magnitude = magnitude - 5 * np.log10(r * delta)
        group = np.zeros(t.size, int) if group is None else np.asarray(group)
        if group.shape != t.shape:
            raise ValueError(f"group must name each of {t.size} points, got {group.shape}.")
        names, number = np.unique(group, return_inverse=True)
        sigma = np.asarray(sigma, float)
        if sigma.shape not in ((), t.shape):
            raise ValueError(
                f"sigma must be one number or one of each of {t.size} points, got shape"
                f" {sigma.shape}."
            )
        sigma = np.broadcast_to(sigma, t.shape)
        if np.any(sigma < 0):
            raise ValueError(
                f"sigma must not be negative; that of point {np.argmax(sigma < 0)} is"
                f" {sigma[np.argmax(sigma < 0)]:.6g}. Give 0 where the error is unknown."
            )
        order = np.argsort(t, kind="stable")
        notes = (*notes, *_photometry_notes(magnitude, number, names))
        copies = t.size - len(np.unique(np.stack([t, magnitude, number]), axis=1).T)
        if copies:
            text = f"{copies} point(s) are exact copies of others: their errors count twice."
            notes = (*notes, text)

        def sort(x):
            return None if x is None else np.ascontiguousarray(x[order])

        return cls(
            sort(t),
            sort(magnitude),
            sort(np.nan_to_num(sigma)),
            sort(number),
            tuple(str(x) for x in names),
            sort(sun),
            sort(observer),
            bool(calibrated),
            tuple(notes),
        )

    def binned(self, width: float) -> "LightCurve":
        """Means of the points of one group within ``width`` days: normal points.

        Errors given are combined, and a mean that holds a point of unknown error has none; many
        noisy points cost no more than few good ones. ``width`` should be below a twentieth of the
        shortest period sought.
        """
        if not width > 0:
            raise ValueError(f"width must be a positive number of days, got {width}.")
        cell = np.floor((self.t - self.t[0]) / width).astype(int)
        _, place = np.unique(np.stack([cell, self.group]), axis=1, return_inverse=True)
        place = place.reshape(-1)
        many = np.bincount(place)

        def mean(x):
            return np.bincount(place, x) / many

        def means(x):
            if x is None:
                return None
            x = np.stack([mean(c) for c in x.T], -1)
            return x / np.linalg.norm(x, axis=1, keepdims=True)

        sigma = np.sqrt(np.bincount(place, self.sigma**2)) / many
        sigma = np.where(np.bincount(place, self.sigma == 0) > 0, 0.0, sigma)
        rows = (mean(self.t), mean(self.magnitude), sigma, np.rint(mean(self.group)).astype(int))
        order = np.argsort(rows[0], kind="stable")
        sun, observer = (
            None if v is None else v[order] for v in map(means, (self.sun, self.observer))
        )
        t, magnitude, sigma, group = (x[order] for x in rows)
        return self._replace(
            t=t, magnitude=magnitude, sigma=sigma, group=group, sun=sun, observer=observer
        )

    def scatter(self) -> float:
        """Noise of the points [mag], from their scatter about straight lines between neighbours.

        Of points of one group, less than a twentieth of the light curve and half a day apart: an
        upper bound where the brightness bends between them. NaN where there are fewer than four.
        """
        t, m = self.t, self.magnitude
        together = (self.group[2:] == self.group[:-2]) & (self.group[1:-1] == self.group[:-2])
        near = together & (t[2:] - t[:-2] < min(0.5, np.ptp(t) / 20)) & (t[2:] > t[:-2])
        index = np.flatnonzero(near)
        if index.size < 4:
            return math.nan
        part = (t[index + 1] - t[index]) / (t[index + 2] - t[index])
        rest = m[index + 1] - (1 - part) * m[index] - part * m[index + 2]
        rest = rest / np.sqrt(1 + part**2 + (1 - part) ** 2)
        return float(1.4826 * np.median(np.abs(rest)))

    def with_errors(self, default: float) -> "LightCurve":
        """Points without an error get the scatter of neighbours, or ``default`` [mag]."""
        missing = ~(self.sigma > 0)
        if not missing.any():
            return self
        estimate = self.scatter()
        is_known = math.isfinite(estimate) and estimate > 0
        size = estimate if is_known else default
        whose = "No point has an error" if missing.all() else "Not every point has an error"
        text = f"{whose}: {size:.2g} mag is taken" + (
            ", from the scatter of neighbours." if is_known else ", the floor."
        )
        sigma = np.where(missing, size, self.sigma)
        return self._replace(sigma=sigma, notes=(*self.notes, text))

    @property
    def alpha(self) -> np.ndarray:
        """Phase angles (n,) [rad]. Raises ValueError where the directions are unknown."""
        sun, observer = self._known_directions()
        across = np.linalg.norm(np.cross(sun, observer), axis=1)
        return np.arctan2(across, np.sum(sun * observer, axis=1))

    def _known_directions(self) -> tuple[np.ndarray, np.ndarray]:
        if self.sun is None or self.observer is None:
            raise ValueError(
                "this light curve has no vectors to Sun and observer: only its frequencies can be"
                " sought. Give them (columns sun_x ... observer_z of a CSV file)."
            )
        return self.sun, self.observer

    def columns(self, offset_sigma: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Offsets as columns (c, n) and 1 / sigma^2 of each (c,).

        One constant, and a deviation of each group with standard deviation ``offset_sigma``
        (default: 0.2 mag when calibrated, free otherwise).
        """
        if offset_sigma is None:
            offset_sigma = 0.2 if self.calibrated else math.inf
        if not offset_sigma > 0:
            raise ValueError(f"offset_sigma must be positive, got {offset_sigma}.")
        own = (self.group[None] == np.arange(len(self.names))[:, None]).astype(float)
        if len(self.names) == 1:
            return own, np.zeros(1)
        if math.isinf(offset_sigma):
            return own, np.zeros(len(own))
        return np.vstack([np.ones((1, self.t.size)), own]), np.r_[
            0.0, np.full(len(own), offset_sigma**-2.0)
        ]

    def points(self, floor: float, offset_sigma: float | None = None) -> Points:
        """Arrays for the model; ``floor`` [mag] is added to the errors in quadrature.

        It grows by 1 + (phase angle / 40 deg)^2: so does, within a factor of two, the misfit of the
        best ellipsoid to convex bodies that are none, from 2 to 120 degrees. Without it the few
        points of a flyby at 90 degrees and more decide against all others.
        """
        sun, observer = self._known_directions()
        n, (columns, stiffness) = self.t.size, self.columns(offset_sigma)
        missing, spare = -n % BLOCK, -len(columns) % 4
        floors = floor * (1 + (self.alpha / _DOUBLED) ** 2)
        weight = np.pad(1 / (self.sigma**2 + floors**2), (0, missing))
        columns = np.pad(columns, ((0, spare), (0, missing)))
        stiffness = np.pad(stiffness, (0, spare), constant_values=1.0)

        def row(x):
            return jnp.asarray(np.pad(x, (0, missing), mode="edge"))[None]

        alpha = row(self.alpha)
        return Points(
            row(self.t - self.t[0]),
            tuple(map(row, sun.T)),
            tuple(map(row, observer.T)),
            alpha,
            -2.5 * jnp.log10(jnp.maximum(seeliger_sphere(alpha), 1e-12)),
            row(self.magnitude),
            jnp.asarray(weight)[None],
            jnp.asarray(columns),
            jnp.asarray(stiffness),
        )


def _directions(name: str, vectors, count: int) -> tuple[np.ndarray, np.ndarray]:
    vectors = np.asarray(vectors, float)
    if vectors.shape != (count, 3):
        raise ValueError(f"{name} must have shape ({count}, 3), got {vectors.shape}.")
    length = np.linalg.norm(vectors, axis=1)
    if not np.all(np.isfinite(length) & (length > 0)):
        raise ValueError(f"{name} must hold finite vectors that are not zero.")
    if length.max() > _FAR:
        raise ValueError(
            f"{name} must hold vectors in au: the longest has length {length.max():.4g}, as one in"
            " km."
        )
    return vectors / length[:, None], length


def _distance_notes(sun: np.ndarray, observer: np.ndarray) -> list[str]:
    """A note where Sun and observer, (n, 3) [au] from the body, are not one au apart."""
    apart = np.linalg.norm(sun - observer, axis=1)
    if np.abs(apart - 1).max() < _ORBIT:
        return []
    return [
        f"Sun and observer are {apart.min():.3g} to {apart.max():.3g} au apart, and the Earth and"
        " the Sun 0.98 to 1.02: unless the observer is elsewhere, the vectors do not start at the"
        " body, or are in different frames or units."
    ]


def _photometry_notes(magnitude: np.ndarray, group: np.ndarray, names: np.ndarray) -> list[str]:
    """Notes on magnitudes that look like fluxes, and on nights that look saturated."""
    notes = []
    if magnitude.min() > 0 and abs(magnitude.mean() - 1) < 1e-3:
        notes.append(
            "The magnitudes have a mean of 1, as a normalised flux: of a flux give -2.5"
            " log10(flux), or name the column flux."
        )
    flat = []
    for k, name in enumerate(names):
        values, counts = np.unique(magnitude[group == k], return_counts=True)
        # rounded magnitudes repeat all their values, a saturated star only the brightest
        many = max(_REPEATED, 0.1 * counts.sum())
        if len(values) > 1 and counts[0] >= max(many, 5 * counts[1]):
            flat.append(str(name))
    if flat:
        notes.append(
            f"Of group(s) {', '.join(flat[:5])} many points have the brightest magnitude exactly,"
            " as of a saturated detector: leave these points out."
        )
    return notes


# Light curves from files: CSV with a header line, ALCDEF, and DAMIT's lc.txt.

_TIME = ("jd", "time", "t", "mjd", "bjd")
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
    ``sigma`` (``mag_err``; in the unit of the brightness), ``group`` (``observer``, ``night``,
    ``block``). Times are those at the observer, not corrected for light time, and brightness is
    not reduced for distance, except a flux of mean 1. ``vectors``: a second CSV of ``jd`` and the
    six components, interpolated linearly, for a file that has none. ALCDEF: magnitudes with their
    geometry from PHASE, PABL and PABB. DAMIT: intensities with vectors. Of CSV and ALCDEF:
    ``calibrated``: groups share a zero point but for small errors; ``reduced``: brightness is
    reduced for distance already.

    Raises FileNotFoundError, and ValueError that names the line or column that is wrong.
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
        return _alcdef(path, lines, vectors, calibrated)
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
    """Columns of cells by lower-case name, and the number of each row's line."""
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

    def values(names, required=True):
        for name in names:
            if name in columns:
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
    sigma = values(("sigma", "mag_err", "magerr", "error"), required=False)
    magnitude = values(("magnitude", "mag"), required=False)
    if magnitude is None:
        flux = values(("magnitude", "mag", "flux", "brightness", "intensity"))
        assert flux is not None  # it is needed
        if not np.all(flux > 0):
            line = numbers[int(np.flatnonzero(~(flux > 0))[0])]
            raise ValueError(f"{path}: line {line}: a flux must be positive.")
        magnitude = -2.5 * np.log10(flux)
        if not reduced and abs(flux.mean() - 1) < 0.1:
            reduced = True
            notes.append("The flux has mean 1: taken as reduced for distance.")
        if sigma is not None:
            sigma = 2.5 / np.log(10) * sigma / flux
    group = next(
        (columns[n] for n in ("group", "observer", "night", "session", "block") if n in columns),
        None,
    )
    six = _six(path, columns, numbers)
    if six is None and vectors is not None:
        six = _interpolated(vectors, t)
    sun, observer = (None, None) if six is None else (six[:, :3], six[:, 3:])
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
    # length and direction apart: the chord between two directions is too short
    between = np.stack([np.interp(t, at, column) for column in six.T], -1).reshape(-1, 2, 3)
    lengths = np.linalg.norm(six.reshape(-1, 2, 3), axis=-1)
    wanted = np.stack([np.interp(t, at, column) for column in lengths.T], -1)
    return (between * (wanted / np.linalg.norm(between, axis=-1))[..., None]).reshape(-1, 6)


def _damit(path, lines) -> LightCurve:
    """Blocks of ``points calibrated`` and rows of JD, intensity, vectors to Sun and Earth."""
    rows = [(k + 1, line.split()) for k, line in enumerate(lines) if line.strip()]
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
    # by its documentation: JD corrected for light time, intensity reduced to 1 au
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


def _alcdef(path, lines, vectors, calibrated: bool) -> LightCurve:
    """Sessions of KEYWORD=value and DATA=JD|magnitude|error lines."""
    table, group, keys, session, rays = [], [], {}, 0, []
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
            given = cells[:2] if len(cells) == 2 or not cells[2].strip() else cells[:3]
            numbers = [_number(path, number, "DATA", c) for c in given]
            # public files write -9.99 or the like for an unknown error
            table.append((*numbers[:2], max((*numbers, 0.0)[2], 0.0)))
            group.append(f"{session:04d}")
            rays.append(tuple(keys.get(k) for k in ("PHASE", "PABL", "PABB")))
        elif name:
            keys[name] = value
    if len(table) == 0:
        raise ValueError(f"{path} holds no DATA lines.")
    data = np.array(table)
    are_numbers = all(all(_is_number(x) for x in ray) for ray in rays)
    sun = observer = None
    notes = ["ALCDEF gives no distances: nights have free offsets, times keep their light time."]
    if vectors is not None:
        six = _interpolated(vectors, data[:, 0])
        sun, observer, notes = six[:, :3], six[:, 3:], []
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
    )


def _is_number(text) -> bool:
    try:
        return text is not None and np.isfinite(float(text))
    except ValueError:
        return False


def _ray(longitude, latitude):
    """From the body: the bisector's published coordinates point to the body."""
    return -np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ],
        -1,
    )
