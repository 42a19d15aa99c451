"""Error against run time of polhode and other programs on families of rigid bodies.

    python -m benchmarks.work_precision [FAMILY ...] [--quick] [--output out/work_precision.json]

Families: benchmarks/problems.py; other programs: benchmarks/peers; references: benchmarks/truth.py.
One thread on one core. All programs of a table simulate the same bodies and are timed alternately;
compilation is listed separately. ``--quick`` uses fewer tolerances, bodies and families (under
three minutes).
"""

import argparse
import itertools
import math
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import numpy as np

from benchmarks import peers, problems, truth

OURS = "polhode"
LEVELS = (1e-3, 1e-6, 1e-9, 1e-12)
"""Errors [rad] at which times are compared."""
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13, 1e-14)
QUICK_TOLERANCES = (1e-5, 1e-8, 1e-11)
QUICK = (
    ("free", 1000, "float64"),
    ("separatrix", 1000, "float64"),
    ("lagrange", 1000, "float64"),
    ("heavy_top", 1000, "float64"),
    ("gradient", 1000, "float64"),
    ("free", 1, "float64"),
    ("free", 1000, "float32"),
)
FULL = (
    *((name, 1000, "float64") for name in problems.PROBLEMS),
    *(
        (name, n, "float64")
        for name in ("free", "lagrange", "heavy_top", "gradient")
        for n in (1, 100_000)
    ),
    *((name, 1000, "float32") for name in ("free", "lagrange", "heavy_top")),
)


def table(family, n, dtype, tolerances, quick, repeats=7, budget=1.0) -> list[dict]:
    """Rows of one table: every program at every setting, with time, spread and errors."""
    from benchmarks.peers import polhode_own

    problem = problems.PROBLEMS[family]
    others, _ = peers.load()
    kind = np.dtype(dtype).type
    todo = {}
    for module in (polhode_own, *others.values()):
        for program in module.programs(problem, n, kind, list(tolerances), quick):
            todo[module.NAME, program.label, program.setting] = program
    exact = truth.truth(problem)
    found = {key: problems.errors(exact, *program.call()) for key, program in todo.items()}
    timings = _report.in_turn(
        {key: program.call for key, program in todo.items()}, repeats=repeats, budget=budget
    )
    rows = []
    for key, program in todo.items():
        wall = timings[key]
        rows.append(
            {
                "peer": key[0],
                "program": key[1],
                "setting": key[2],
                "bodies_run": program.bodies,
                "ns_per_body": wall.median / program.bodies * 1e9,
                "spread": wall.spread,
                "repeats": wall.repeats,
                "compile_s": program.compile_s,
                **found[key],
            }
        )
    return rows


def is_default(row: dict) -> bool:
    """Whether a row is that of the method that polhode chooses."""
    return row["peer"] == OURS and row["program"].startswith("default")


def time_at(rows: list[dict], level: float, error: str = "attitude_median") -> float | None:
    """Time [ns per body] of one program to reach an error; None if it does not reach it.

    Times are interpolated between neighbouring settings on logarithmic scales, never extrapolated:
    if all settings are more accurate than requested, the cheapest one counts.
    """
    points = [
        (max(row[error], 1e-17), row["ns_per_body"])
        for row in rows
        if row[error] is not None and not row["failed"]
    ]
    times = [time for value, time in points if value <= level]
    if not times:
        return None
    best = min(times)
    for left, right in itertools.pairwise(points):
        (high, cheap), (low, dear) = sorted((left, right), key=lambda p: -p[0])
        if low <= level < high and cheap < dear:
            share = math.log(level / high) / math.log(low / high)
            best = min(best, cheap * (dear / cheap) ** share)
    return best


def time_to_error(tables: list[dict], error: str = "attitude_median") -> list[dict]:
    """Per table and program: time [us per body] of its best method to each error, its smallest
    error, and the longest compilation. For polhode, only the default counts, whose method may
    change with the tolerance.
    """
    found = []
    for entry in tables:
        programs: dict[str, dict[str, list[dict]]] = {}
        for row in entry["rows"]:
            if row["peer"] != OURS or is_default(row):
                name = OURS if row["peer"] == OURS else row["program"]
                programs.setdefault(row["peer"], {}).setdefault(name, []).append(row)
        for peer, curves in programs.items():
            rows = list(itertools.chain.from_iterable(curves.values()))
            line = {"scene": entry["title"], "bodies": entry["bodies"], "dtype": entry["dtype"]}
            line["program"] = peer
            for level in LEVELS:
                times = [time_at(curve, level, error) for curve in curves.values()]
                reached = [time / 1e3 for time in times if time is not None]
                line[f"us_to_{level:.0e}_rad"] = min(reached, default=None)
            line["best_rad"] = min(row[error] for row in rows if row[error] is not None)
            compiled = [row["compile_s"] for row in rows if row["compile_s"] is not None]
            line["compile_s"] = max(compiled, default=None)
            found.append(line)
    return found


def fastest_peer(lines: list[dict]) -> list[dict]:
    """Per table and error, from the rows of ``time_to_error``: the fastest other program, and its
    time over that of polhode's default.
    """
    tables: dict[tuple, list[dict]] = {}
    for line in lines:
        tables.setdefault((line["scene"], line["bodies"], line["dtype"]), []).append(line)

    def words(ours: float | None, others: list[tuple[float, str]]) -> str:
        if not others:
            return "none" if ours is None else f"only {OURS}"
        time, peer = min(others)
        return f"only {peer}" if ours is None else f"{time / ours:.3g} x {peer}"

    found = []
    for (scene, bodies, dtype), group in tables.items():
        line = {"scene": scene, "bodies": bodies, "dtype": dtype}
        for level in LEVELS:
            times = {row["program"]: row[f"us_to_{level:.0e}_rad"] for row in group}
            ours = times.pop(OURS, None)
            others = [(time, peer) for peer, time in times.items() if time is not None]
            line[f"to_{level:.0e}_rad"] = words(ours, others)
        found.append(line)
    return found


def default_errors(tables: list[dict]) -> list[dict]:
    """Tolerance and error of polhode's default where it integrates."""
    return [
        {
            "scene": entry["title"],
            "bodies": entry["bodies"],
            "dtype": entry["dtype"],
            "rtol": row["setting"],
            "median_rad": row["attitude_median"],
            "worst_rad": row["attitude_worst"],
            "us_per_body": row["ns_per_body"] / 1e3,
        }
        for entry in tables
        for row in entry["rows"]
        if is_default(row) and row["setting"] != "exact"
    ]


def derived(tables: list[dict]) -> dict[str, list[dict]]:
    """The short tables of the results page."""
    median, worst = (time_to_error(tables, f"attitude_{of}") for of in ("median", "worst"))
    return {
        "fastest_peer_median_body": fastest_peer(median),
        "fastest_peer_worst_body": fastest_peer(worst),
        "time_to_error_median_body": median,
        "default_errors": default_errors(tables),
    }


def show(entry: dict) -> None:
    """Print a table."""
    print(f"\n{entry['title']}: N = {entry['bodies']:,}, {entry['dtype']}")
    print(f"{'':54}{'us/body':>10}{'+-%':>5}{'median':>9}{'worst':>9} rad  {'compile s':>9}")
    for row in entry["rows"]:
        name = f"{row['peer']} {row['program']}"[:45]
        compiled = "" if row["compile_s"] is None else f"{row['compile_s']:.2f}"
        print(
            f"{name:<45}{row['setting']:>9}{row['ns_per_body'] / 1e3:>10.3g}"
            f"{100 * row['spread']:>5.0f}{row['attitude_median']:>9.1e}"
            f"{row['attitude_worst']:>9.1e}{compiled:>15}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("families", nargs="*", help="all of the set when none is named")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--bodies", type=int, nargs="+", help="numbers of bodies; all when none")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    installed, missing = peers.load()
    for name, why in missing.items():
        print(f"missing: {name} ({why})")
    tables = []
    for family, n, dtype in QUICK if options.quick else FULL:
        if options.families and family not in options.families:
            continue
        if options.bodies and n not in options.bodies:
            continue
        rows = table(
            family,
            n,
            dtype,
            QUICK_TOLERANCES if options.quick else TOLERANCES,
            options.quick,
            options.repeats,
            0.3 if options.quick else 0.5,
        )
        problem = problems.PROBLEMS[family]
        entry = {
            "family": family,
            "title": problem.title,
            "bodies": n,
            "dtype": dtype,
            "horizon": problem.horizon,
            "saves": problem.saves,
            "rows": rows,
        }
        tables.append(entry)
        show(entry)
        written(options, installed, missing, tables)
    path = written(options, installed, missing, tables)
    print(f"\nwritten: {path.name}")


def written(options, installed, missing, tables) -> Path:
    """Write the results so far."""
    packages = tuple(p for module in installed.values() for p in module.PACKAGES)
    numbers = {"quick": options.quick, "missing": missing, "tables": tables, **derived(tables)}
    return _report.write("work_precision", numbers, path=options.output, packages=packages)


if __name__ == "__main__":
    main()
