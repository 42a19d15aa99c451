"""What changed between two result files beyond noise."""

import statistics
from typing import Any

TIMES = ("ns", "us", "wall", "seconds", "time")
ERRORS = ("median", "worst", "error", "p90")
LABELS = (
    "family", "case", "title", "bodies", "dtype", "peer", "program", "solver", "method", "scene",
    "name", "setting", "rtol", "tolerance", "quantity", "saves", "horizon",
    "function", "region", "conversion", "t", "top", "order",
)  # fmt: skip


def flatten(value: Any, path: tuple = ()) -> dict[tuple, float]:
    """Leaves that are numbers, by path; items of lists are named by their labels."""
    if isinstance(value, dict):
        found = {}
        for key, item in value.items():
            if key not in LABELS or isinstance(item, dict | list):
                found |= flatten(item, (*path, key))
        return found
    if isinstance(value, list):
        found, names = {}, set()
        for index, item in enumerate(value):
            name: Any = index
            if isinstance(item, dict):
                labels = tuple(str(item[key]) for key in LABELS if key in item)
                name = ", ".join(labels) or index
                if name in names:
                    name = f"{name}, {index}"
                names.add(name)
            found |= flatten(item, (*path, name))
        return found
    if isinstance(value, bool) or not isinstance(value, int | float):
        return {}
    return {path: float(value)}


def kind(path: tuple) -> str:
    """'compile', 'time', 'spread', 'error' or 'other', by the name of the leaf."""
    name = str(path[-1])
    if name in ("spread", "repeats"):
        return "spread"
    if "compile" in name:
        return "compile"
    if name.split("_")[0] in TIMES or name.endswith("_s") or "ns_per" in name:
        return "time"
    return "error" if any(word in name for word in ERRORS) else "other"


def compare(old: dict, new: dict, noise: float = 0.1) -> dict[str, Any]:
    """Changes beyond noise between two results of one benchmark.

    Times: relative to the median change of all times (the machine may have been slower); noise is
    ``noise`` plus three times the two spreads written beside them. Compile times change beyond a
    half, errors beyond a factor of 2, other numbers beyond 1e-3. Returns ``pace`` (median of new
    over old times), ``changed`` (path, kind, old, new, factor), ``gone``, ``fresh``, and
    ``largest``: the largest deviation of a time's ratio from the pace, and ``typical``.
    """
    if old["name"] != new["name"]:
        raise ValueError(f"results of different benchmarks: {old['name']} and {new['name']}.")
    before, after = flatten(old["numbers"]), flatten(new["numbers"])
    both = [path for path in before if path in after]
    ratios = {
        path: after[path] / before[path]
        for path in both
        if kind(path) == "time" and before[path] > 0 and after[path] > 0
    }
    pace = statistics.median(ratios.values()) if ratios else 1.0
    changed = []
    for path in both:
        a, b = before[path], after[path]
        what = kind(path)
        factor = b / a if a else float("inf") if b else 1.0
        if what == "time" and path in ratios:
            factor = ratios[path] / pace
            spread = (*path[:-1], "spread")
            allowed = 1 + noise + 3 * (before.get(spread, 0.0) + after.get(spread, 0.0))
        elif what in ("time", "compile"):
            allowed = 1.5
        elif what == "error":
            allowed = 2.0
        elif what == "spread":
            continue
        else:
            allowed = 1.001
        if not 1 / allowed <= factor <= allowed:
            changed.append((path, what, a, b, factor))
    off = [max(r / pace, pace / r) - 1 for r in ratios.values()]
    return {
        "pace": pace,
        "times": len(ratios),
        "typical": statistics.median(off) if off else 0.0,
        "largest": max(off, default=0.0),
        "changed": changed,
        "gone": [path for path in before if path not in after],
        "fresh": [path for path in after if path not in before],
    }


def show(found: dict[str, Any]) -> str:
    """The comparison in words."""
    lines = [
        f"{found['times']} times, pace new/old {found['pace']:.3f}; ratios between them differ by"
        f" {100 * found['typical']:.1f} % (median), {100 * found['largest']:.1f} % (largest)"
    ]
    for path, what, a, b, factor in found["changed"]:
        word = "" if what not in ("time", "compile") else " slower" if factor > 1 else " faster"
        where = " / ".join(map(str, path))
        lines.append(f"{what:8}{a:>11.4g} -> {b:<11.4g} x{factor:.3g}{word}  {where}")
    for name in ("gone", "fresh"):
        lines += [f"{name:8}{' / '.join(map(str, path))}" for path in found[name]]
    if len(lines) == 1:
        lines.append("nothing changed beyond noise")
    return "\n".join(lines)
