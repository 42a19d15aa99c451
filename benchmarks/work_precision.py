"""Error against run time of polhode and its peers on families of rigid bodies.

    python -m benchmarks.work_precision [FAMILY ...] [--quick] [--output out/work_precision.json]

Families: benchmarks/problems.py; peers: benchmarks/peers; truth: benchmarks/truth.py. One thread
on one core. Every program of a table moves the same bodies and is timed in turn with the others;
compiling is apart. ``--quick`` takes fewer tolerances, bodies and families (under three minutes).
"""

import argparse
from pathlib import Path

from benchmarks import _report

if __name__ == "__main__":
    _report.one_thread()

import jax
import numpy as np

from benchmarks import peers, problems, truth

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
    """Write what there is so far."""
    packages = tuple(p for module in installed.values() for p in module.PACKAGES)
    numbers = {"quick": options.quick, "missing": missing, "tables": tables}
    return _report.write("work_precision", numbers, path=options.output, packages=packages)


if __name__ == "__main__":
    main()
