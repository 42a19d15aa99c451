"""Time of a new process to import the names of a scene, compared with the underlying libraries.

    python -m benchmarks.imports [--runs 7] [--output out/imports.json]

Minimum wall time of each import over alternating runs; compare times of one run only.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

from benchmarks import _report

PROGRAMS = {
    "import jax": "import jax",
    "import equinox": "import equinox",
    "import diffrax": "import diffrax",
    "names of a free body": "import polhode as ph; ph.Scene, ph.State, ph.Inertia, ph.simulate",
    "names of an integrated scene": (
        "import polhode as ph; ph.Scene, ph.State, ph.Inertia, ph.simulate, ph.UniformGravity,"
        " ph.LinearDamping, ph.LiePoisson, ph.Extrapolation"
    ),
    "all names": "import polhode as ph; [getattr(ph, name) for name in dir(ph)]",
}


def measure(programs: dict[str, str], runs: int) -> list[dict]:
    """Minimum seconds of a new process for each program."""
    _report.compile_package()
    least = dict.fromkeys(programs, float("inf"))
    for _ in range(runs):
        for name, program in programs.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True)
            least[name] = min(least[name], time.perf_counter() - start)
    return [{"program": name, "seconds": seconds} for name, seconds in least.items()]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    rows = measure(PROGRAMS, options.runs)
    for row in rows:
        print(f"{row['program']:30} {row['seconds']:6.2f} s")
    path = _report.write("imports", {"runs": options.runs, "rows": rows}, path=options.output)
    print(f"written: {path.name}")


if __name__ == "__main__":
    main()
