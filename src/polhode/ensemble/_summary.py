"""What the statistics of all blocks come to, once every chunk is finished."""

from typing import Any

import numpy as np

from polhode.ensemble._statistics import Statistic, merge, quantile
from polhode.ensemble._store import Store, consolidate

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def write_summaries(store: Store, statistics: tuple[Statistic, ...]) -> None:
    """Add NAME_summary_mean, _std, _min, _max (time) and, with a histogram, its sum over the
    bodies, bin edges and quantiles. Written again by every call: always the same numbers.
    """
    for s in statistics:
        name = s.name
        count, mean, squares = merge(
            *(store.group[f"{name}_{part}"][:] for part in ("count", "mean", "squares"))
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            found = {
                "count": (count.astype(np.int64), "1"),
                "mean": (np.where(count > 0, mean, np.nan), s.units),
                "std": (np.sqrt(squares / count), s.units),
                "min": (store.group[f"{name}_least"][:].min(axis=0), s.units),
                "max": (store.group[f"{name}_greatest"][:].max(axis=0), s.units),
            }
        for kind, (values, units) in found.items():
            _put(store, f"{name}_summary_{kind}", values, ("time",), units)
        if s.low is None:
            continue
        histogram = store.group[f"{name}_histogram"]
        total = np.zeros(histogram.shape[1:], np.int64)
        for k in range(histogram.shape[0]):
            total += histogram[k]
        _put(store, f"{name}_summary_histogram", total, ("time", f"{name}_bin"), "1")
        _put(store, f"{name}_edges", s.edges, (f"{name}_edge",), s.units)
        rows = np.stack([quantile(total, s.edges, q) for q in QUANTILES])
        _put(store, f"{name}_quantiles", rows, ("quantile", "time"), s.units)
        _put(store, "quantile", np.array(QUANTILES), ("quantile",), "1")

    if statistics:
        consolidate(store.path)


def _put(store: Store, name: str, values: np.ndarray, dimensions: tuple, units: str) -> None:
    array: Any = store.group.create_array(
        name, shape=values.shape, chunks=values.shape, dtype=values.dtype,
        dimension_names=dimensions, attributes={"units": units}, overwrite=True,
    )  # fmt: skip
    array[...] = values
