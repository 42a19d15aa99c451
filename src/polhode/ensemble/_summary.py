"""The statistics of all bodies, reduced from the chunks of a store in their order."""

import numpy as np

from polhode.ensemble._statistics import Moments, Statistic, quantile
from polhode.ensemble._store import Store

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def write_summaries(store: Store, statistics: tuple[Statistic, ...]) -> None:
    """Write NAME_summary_mean, _std, _min, _max (time) and, with a histogram, its sum over the
    bodies, its edges and quantiles. Every call writes the same numbers.
    """
    for s in statistics:
        name = s.name
        moments = Moments.zero(store.layout[f"{name}_count"].shape[1])
        least, greatest, total = np.inf, -np.inf, 0
        for k in range(store.chunks):

            def part(kind: str, k=k, name=name) -> np.ndarray:
                key = f"{name}_{kind}"
                return store.arrays[key][store.layout[key].region(k)]

            moments = moments.add(part("count"), part("mean"), part("squares"))
            least = np.minimum(least, part("least").min(axis=0))
            greatest = np.maximum(greatest, part("greatest").max(axis=0))
            if s.low is not None:
                total = total + part("histogram")[0]
        count = moments.count
        with np.errstate(invalid="ignore", divide="ignore"):
            summary = {
                "count": (count.astype(np.int64), "1"),
                "mean": (np.where(count > 0, moments.mean, np.nan), s.units),
                "std": (np.sqrt(moments.squares / count), s.units),
                "min": (np.asarray(least), s.units),
                "max": (np.asarray(greatest), s.units),
            }
        for kind, (values, units) in summary.items():
            store.put(f"{name}_summary_{kind}", values, ("time",), units)
        if s.low is None:
            continue
        histogram = np.asarray(total)
        store.put(f"{name}_summary_histogram", histogram, ("time", f"{name}_bin"), "1")
        store.put(f"{name}_edges", s.edges, (f"{name}_edge",), s.units)
        rows = np.stack([quantile(histogram, s.edges, q) for q in QUANTILES])
        store.put(f"{name}_quantiles", rows, ("quantile", "time"), s.units)
        store.put("quantile", np.array(QUANTILES), ("quantile",), "1")
    if statistics:
        store.consolidate()
