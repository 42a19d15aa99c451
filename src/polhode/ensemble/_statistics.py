"""Statistics over the bodies of an ensemble at each time, with or instead of trajectories."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from polhode import rotation
from polhode._trajectory import Trajectory
from polhode.ensemble._store import Store, plain_number

SUMMARY_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclasses.dataclass(frozen=True)
class Statistic:
    """One quantity whose distribution over the bodies is computed at every time.

    ``quantity(trajectory)`` returns (bodies, T). Mean, standard deviation, minimum and maximum are
    always computed; with ``low < high`` also a histogram of ``bins`` equal bins between them (and
    two for values outside), which gives quantiles to within a bin. Bodies that did not finish are
    not counted. Raises ValueError for an invalid range or number of bins.
    """

    name: str
    quantity: Callable[[Trajectory], Array]
    units: str = "1"
    low: float | None = None
    high: float | None = None
    bins: int = 100

    def __post_init__(self):
        for name in ("low", "high", "bins"):
            object.__setattr__(self, name, plain_number(getattr(self, name)))
        if not self.name.isidentifier():
            raise ValueError(f"the name of a statistic must be an identifier, got {self.name!r}.")
        if (self.low is None) != (self.high is None):
            raise ValueError(f"statistic {self.name}: give both low and high, or neither.")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"statistic {self.name}: low {self.low} must be below {self.high}.")
        if self.bins < 1:
            raise ValueError(f"statistic {self.name}: bins must be positive, got {self.bins}.")

    @property
    def edges(self) -> np.ndarray:
        """(bins + 1,) edges of the histogram."""
        assert self.low is not None
        assert self.high is not None
        return np.linspace(self.low, self.high, self.bins + 1)


def rate(trajectory: Trajectory) -> Array:
    """|omega| [rad/s]."""
    return jnp.linalg.norm(trajectory.omega_body, axis=-1)


def tilt(trajectory: Trajectory) -> Array:
    """Angle [rad] between the body's z axis and that of space."""
    matrix = rotation.wxyz_to_matrix(trajectory.wxyz)
    return jnp.arctan2(jnp.hypot(matrix[..., 0, 2], matrix[..., 1, 2]), matrix[..., 2, 2])


def energy(trajectory: Trajectory) -> Array:
    """Kinetic plus potential energy [J]."""
    return trajectory.energy


def momentum(trajectory: Trajectory) -> Array:
    """Magnitude of the angular momentum [kg m^2/s]."""
    return jnp.linalg.norm(trajectory.momentum_body, axis=-1)


QUANTITIES = {
    "rate": (rate, "rad s-1"),
    "tilt": (tilt, "rad"),
    "energy": (energy, "J"),
    "momentum": (momentum, "kg m2 s-1"),
}
"""Quantities that scene files can name, with their units."""


def summarise(statistic: Statistic, trajectory: Trajectory, is_body: Bool[Array, " n"]) -> dict:
    """Count, mean, sum of squared deviations, extremes and histogram of a block, as arrays (T,).

    Only bodies that exist (``is_body``, not padding) and finished are counted. The histogram
    (T, bins + 2) starts with the values below the range and ends with those above it.
    """
    values: Float[Array, "n t"] = statistic.quantity(trajectory)
    counted = (is_body & trajectory.successful)[:, None] & jnp.isfinite(values)
    count = jnp.sum(counted, axis=0, dtype=jnp.int32)
    weight = jnp.maximum(count, 1).astype(values.dtype)
    mean = jnp.sum(jnp.where(counted, values, 0), axis=0) / weight
    summary = {
        "count": count,
        "mean": mean,
        "squares": jnp.sum(jnp.where(counted, (values - mean[None]) ** 2, 0), axis=0),
        "least": jnp.min(jnp.where(counted, values, jnp.inf), axis=0),
        "greatest": jnp.max(jnp.where(counted, values, -jnp.inf), axis=0),
    }
    if statistic.low is not None:
        edges = jnp.asarray(statistic.edges, values.dtype)
        place = jnp.searchsorted(edges, values, side="right")
        place = jnp.where(values == edges[-1], statistic.bins, place)  # the last bin is closed
        place = jnp.where(counted, place, 0)
        columns = jnp.broadcast_to(jnp.arange(values.shape[1])[None], values.shape)
        empty = jnp.zeros((values.shape[1], statistic.bins + 2), jnp.int32)
        summary["histogram"] = empty.at[columns, place].add(counted.astype(jnp.int32))
    return summary


class Moments(NamedTuple):
    """Counts, means and sums of squared deviations of the bodies so far, each (T,) of float64."""

    count: np.ndarray
    mean: np.ndarray
    squares: np.ndarray

    @classmethod
    def zero(cls, times: int) -> "Moments":
        return cls(np.zeros(times), np.zeros(times), np.zeros(times))

    def add(self, count: np.ndarray, mean: np.ndarray, squares: np.ndarray) -> "Moments":
        """The moments after adding those of further blocks (blocks, T) by Chan et al. (1979).

        Blocks are added one by one, so that the result does not depend on the size of the chunks.
        """
        total, average, spread = self
        for n, m, s in zip(count.astype(float), mean.astype(float), squares.astype(float)):
            total_count = np.maximum(total + n, 1)
            difference = m - average
            average = average + difference * n / total_count
            spread = spread + s + difference**2 * total * n / total_count
            total = total + n
        return Moments(total, average, spread)


def quantile(histogram: np.ndarray, edges: np.ndarray, q: float) -> np.ndarray:
    """The q-quantile at each time from histograms (T, bins + 2), linear within a bin.

    NaN where it lies outside the edges or the histogram is empty.
    """
    sums = np.cumsum(histogram, axis=-1, dtype=float)
    out = np.full(len(sums), np.nan)
    for k, row in enumerate(sums):
        target = q * row[-1]
        j = int(np.searchsorted(row, target, side="left"))
        if row[-1] and 1 <= j < len(edges):
            part = (target - row[j - 1]) / (row[j] - row[j - 1])
            out[k] = edges[j - 1] + part * (edges[j] - edges[j - 1])
    return out


def write_summaries(store: Store, statistics: tuple[Statistic, ...]) -> None:
    """Write NAME_summary_count, _mean, _std, _min, _max (time) and, with a histogram, its sum over
    the chunks, its edges and quantiles. Every call writes the same numbers.
    """
    for s in statistics:
        name = s.name
        moments = Moments.zero(store.layout[f"{name}_count"].shape[1])
        minimum, maximum, histogram = np.inf, -np.inf, np.zeros((), np.int64)
        for k in range(store.chunks):
            count, mean, squares, least, greatest = (
                store.read(f"{name}_{kind}", k)
                for kind in ("count", "mean", "squares", "least", "greatest")
            )
            moments = moments.add(count, mean, squares)
            minimum = np.minimum(minimum, least.min(axis=0))
            maximum = np.maximum(maximum, greatest.max(axis=0))
            if s.low is not None:
                histogram = histogram + store.read(f"{name}_histogram", k)[0]
        count = moments.count
        with np.errstate(invalid="ignore", divide="ignore"):
            summary = {
                "count": (count.astype(np.int64), "1"),
                "mean": (np.where(count > 0, moments.mean, np.nan), s.units),
                "std": (np.sqrt(moments.squares / count), s.units),
                "min": (np.where(count > 0, minimum, np.nan), s.units),
                "max": (np.where(count > 0, maximum, np.nan), s.units),
            }
        for kind, (values, units) in summary.items():
            store.put(f"{name}_summary_{kind}", values, ("time",), units)
        if s.low is None:
            continue
        store.put(f"{name}_summary_histogram", histogram, ("time", f"{name}_bin"), "1")
        store.put(f"{name}_edges", s.edges, (f"{name}_edge",), s.units)
        rows = np.stack([quantile(histogram, s.edges, q) for q in SUMMARY_QUANTILES])
        store.put(f"{name}_quantiles", rows, ("quantile", "time"), s.units)
        store.put("quantile", np.array(SUMMARY_QUANTILES), ("quantile",), "1")
    if statistics:
        store.consolidate()
