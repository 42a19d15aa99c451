"""``LightCurve``: photometry with the directions to Sun and observer."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from polhode._checks import ArrayLike
from polhode.lightcurve._brightness import Points, seeliger_sphere

LIGHT_TIME = 499.00478384 / 86400  # days per au
_DOUBLED = math.radians(40)  # phase angle at which the floor has doubled
_FAR = 1e4  # longest vector that is plausible in au
_ROUNDED = 1e-4  # unit vectors written with few digits differ from length 1 by less
# Larger values are not magnitudes: the Sun has -27, the faintest stars observed 32.
_FAINTEST = 45.0
# Tolerance [au] about 1 au of the distance between the Sun and an observer near the Earth.
_ORBIT = 0.03
# Least number of points of a night at its brightest magnitude that suggests saturation.
_REPEATED = 4
# Least number of points of a light curve.
FEWEST_POINTS = 8
# Points per call of a compiled program: light curves are padded to multiples of it, and a search
# uses this many points.
BLOCK = 160


class LightCurve(NamedTuple):
    """Photometry of one body. Build with ``LightCurve.of`` or ``read_light_curve``.

    Times in days (such as Julian dates), at which the light left the body; magnitudes reduced to
    1 au from Sun and observer, where distances are known; unit vectors from the body to Sun and
    observer in one space frame, None where unknown.
    """

    t: np.ndarray  # (n,)
    magnitude: np.ndarray  # (n,)
    sigma: np.ndarray  # (n,) [mag], 0 where unknown
    group: np.ndarray  # (n,) number of the night or observer
    names: tuple[str, ...]  # of the groups
    sun: np.ndarray | None  # (n, 3)
    observer: np.ndarray | None  # (n, 3)
    calibrated: bool  # whether the groups share a zero point, but for small errors
    notes: tuple[str, ...] = ()  # assumptions made when the data were read

    def __str__(self) -> str:
        sigma = np.median(self.sigma)
        return (
            f"LightCurve: {self.t.size} points of {len(self.names)} group(s), day {self.t[0]:.10g}"
            f" to {self.t[-1]:.10g}, magnitudes {self.magnitude.min():.4g} to"
            f" {self.magnitude.max():.4g}, median error {f'{sigma:.2g}' if sigma else 'unknown'},"
            f" {'with' if self.sun is not None else 'without'} directions"
        )

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
        """A light curve from observations, corrected for light time and reduced to 1 au.

        ``t`` (n,) [day]; ``magnitude`` (n,); ``sun``, ``observer`` (n, 3): vectors from the body
        [au], or unit vectors if the distances are unknown. ``at_body``: times are already corrected
        for light time; ``reduced``: 5 log10(r Delta) is already subtracted. ``sigma``: standard
        deviations [mag], 0 or NaN: unknown. ``group`` (n,): names of nights or observers.
        ``calibrated``: groups share a zero point but for small errors. Raises ValueError for shapes
        that differ, values not finite, negative ``sigma``, and times that are all the same or whose
        precision is too low for their intervals.
        """
        given_times = np.asarray(t)
        t, magnitude = given_times.astype(float), np.asarray(magnitude, float)
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
                " or counts, or placeholders such as 99.99 of missing values. Give"
                " -2.5 log10(flux), or name the column flux; leave points without a value out."
            )
        if np.ptp(t) == 0:
            raise ValueError(f"all {t.size} times are {t[0]}: a light curve must span some time.")
        _require_digits(given_times)
        if (sun is None) != (observer is None):
            raise ValueError("give both the vectors to the Sun and to the observer, or neither.")
        if sun is not None:
            sun, r = _directions("sun", sun, t.size)
            observer, delta = _directions("observer", observer, t.size)
            far = has_distances(delta)
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
        if np.any(np.isinf(sigma)):
            raise ValueError(
                f"sigma must be finite; that of point {np.argmax(np.isinf(sigma))} is not. Leave"
                " the point out, or give 0 where the error is unknown."
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
        """Normal points: means of the points of one group within ``width`` days.

        Known errors are combined; the error of a mean with a point of unknown error is unknown.
        Fits of many noisy points become as fast as those of few. ``width`` should be below a
        twentieth of the shortest period of interest.
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

        Three neighbours must be of one group and within a twentieth of the light curve and half a
        day. An upper bound where the brightness is curved between them. NaN with fewer than four
        such triples.
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
        """With the scatter of neighbours, or ``default`` [mag], for errors that are unknown."""
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

    def require_points(self) -> None:
        """ValueError for fewer than ``FEWEST_POINTS`` points."""
        if self.t.size < FEWEST_POINTS:
            raise ValueError(
                f"a light curve needs at least {FEWEST_POINTS} points, this one has {self.t.size}:"
                " means of wide bins leave few."
            )

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
        """Columns (c, n) of the offsets in a linear model, and the precisions of their priors (c,).

        One constant, and a deviation of each group with standard deviation ``offset_sigma`` [mag]
        (default: 0.2 if calibrated, else infinite: one free offset for each group).
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

        It is multiplied by 1 + (phase angle / 40 deg)^2. From 2 to 120 degrees the misfit of the
        best ellipsoid to other convex bodies grows like this within a factor of two. Without the
        factor the few points of a flyby at 90 degrees and more would outweigh all others.
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


def has_distances(lengths: np.ndarray) -> bool:
    """Whether vectors of these lengths state distances, in contrast to unit vectors."""
    return bool(np.abs(lengths - 1).max() > _ROUNDED)


def _require_digits(times: np.ndarray) -> None:
    """ValueError for times (n,) of which the dtype does not resolve the intervals to a tenth."""
    if times.dtype.kind != "f" or times.dtype.itemsize >= 8:
        return
    resolution = float(np.spacing(np.abs(times).max()))
    if resolution > 0.1 * np.median(np.diff(np.unique(times.astype(float)))):
        raise ValueError(
            f"times of up to {np.abs(times).max():.8g} d in {times.dtype} are resolved to"
            f" {resolution:.2g} d only: give them in float64 (of NumPy, or of JAX with"
            " jax_enable_x64)."
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
    """A note if Sun and observer, (n, 3) [au] from the body, are not about 1 au apart."""
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
        # rounded magnitudes repeat all values, a saturated detector only the brightest
        many = max(_REPEATED, 0.1 * counts.sum())
        if len(values) > 1 and counts[0] >= max(many, 5 * counts[1]):
            flat.append(str(name))
    if flat:
        notes.append(
            f"Of group(s) {', '.join(flat[:5])} many points have the brightest magnitude exactly,"
            " as of a saturated detector: leave these points out."
        )
    return notes
