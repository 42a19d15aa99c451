"""Light curves from files: CSV with a header line, ALCDEF, and DAMIT's lc.txt."""

import csv
from os import PathLike
from pathlib import Path

import numpy as np

from polhode.lightcurve._data import LightCurve

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
        return _alcdef(path, lines, calibrated)
    if len(content[0].split()) == 1 and content[0].strip().isdigit():
        return _damit(path, lines)
    return _table(path, lines, vectors, calibrated, reduced)


def _number(path, line: int, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{path}: line {line}, {name} must be a number, got {text!r}.") from None


def _rows(path, lines) -> tuple[dict[str, list[str]], list[int]]:
    """Columns of cells by lower-case name, and the number of each row's line."""
    kept = [(k + 1, s) for k, s in enumerate(lines) if s.strip() and not s.lstrip().startswith("#")]
    if not kept:
        raise ValueError(f"{path} is empty; expected a header line and rows.")
    mark = next((m for m in ",;\t" if m in kept[0][1]), None)

    def cells(text):
        found = next(csv.reader([text], delimiter=mark)) if mark else text.split()
        return [c.strip() for c in found]

    names = [name.lower() for name in cells(kept[0][1])]
    table, numbers = [], []
    for number, text in kept[1:]:
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

    def values(names, needed=True):
        for name in names:
            if name in columns:
                cells = zip(numbers, columns[name], strict=True)
                return np.array([_number(path, k, name, c) for k, c in cells])
        if needed:
            raise ValueError(
                f"{path} must have a column {' or '.join(names)}; its columns are"
                f" {', '.join(columns)}."
            )
        return None

    t = values(_TIME)
    sigma = values(("sigma", "mag_err", "magerr", "error"), needed=False)
    magnitude = values(("magnitude", "mag"), needed=False)
    notes = []
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
        t, magnitude, sun, observer, sigma=0.0 if sigma is None else sigma, group=group,
        calibrated=calibrated, reduced=reduced, notes=notes,
    )  # fmt: skip


def _six(path, columns, numbers):
    """The vectors (n, 6), or None without such columns."""
    names = [n if n in columns else n.replace("observer", "earth") for n in _VECTORS]
    missing = [n for n in names if n not in columns]
    if len(missing) == 6:
        return None
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)} of its vectors.")
    return np.array([
        [_number(path, line, n, columns[n][k]) for n in names] for k, line in enumerate(numbers)
    ])  # fmt: skip


def _interpolated(path, t) -> np.ndarray:
    columns, numbers = _rows(path, Path(path).read_text(encoding="utf-8-sig").splitlines())
    six = _six(path, columns, numbers)
    name = next((n for n in _TIME if n in columns), None)
    if six is None or name is None:
        raise ValueError(f"{path} must have the columns jd, {', '.join(_VECTORS)}.")
    at = np.array([_number(path, k, name, c) for k, c in zip(numbers, columns[name], strict=True)])
    margin = np.diff(at).max() if at.size > 1 else 0
    if np.any(np.diff(at) <= 0) or t.min() < at[0] - margin or t.max() > at[-1] + margin:
        raise ValueError(
            f"{path}: the times of the vectors must increase and cover the light curve,"
            f" {t.min():.5f} to {t.max():.5f}; they are {at[0]:.5f} to {at[-1]:.5f}."
        )
    return np.stack([np.interp(t, at, column) for column in six.T], -1)


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
    data = np.array(table)
    # by its documentation: JD corrected for light time, intensity reduced to 1 au
    return LightCurve.of(
        data[:, 0], -2.5 * np.log10(data[:, 1]), data[:, 2:5], data[:, 5:8], group=group,
        calibrated=all(kinds), at_body=True, reduced=True,
    )  # fmt: skip


def _alcdef(path, lines, calibrated: bool) -> LightCurve:
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
            numbers = [_number(path, number, "DATA", c) for c in cells[:3] if c.strip()]
            table.append((*numbers, 0.0)[:3])
            group.append(f"{session:04d}")
            rays.append(tuple(keys.get(k) for k in ("PHASE", "PABL", "PABB")))
        elif name:
            keys[name] = value
    if len(table) == 0:
        raise ValueError(f"{path} holds no DATA lines.")
    data = np.array(table)
    known = all(all(_is_number(x) for x in ray) for ray in rays)
    sun = observer = None
    notes = ["ALCDEF gives no distances: nights have free offsets, times keep their light time."]
    if known:
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
        data[:, 0], data[:, 1], sun, observer, sigma=data[:, 2], group=group, notes=notes,
        calibrated=calibrated,
    )  # fmt: skip


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
