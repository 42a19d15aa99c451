"""Time from a new process to the names of a scene, beside the libraries that polhode builds on.

    python -m benchmarks.imports [--runs 7]

Least wall time of each import over the runs, alternated; compare within one run only.
"""

import argparse
import subprocess
import sys
import time

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7)
    runs = parser.parse_args().runs
    least = dict.fromkeys(PROGRAMS, float("inf"))
    for _ in range(runs):
        for name, program in PROGRAMS.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True)
            least[name] = min(least[name], time.perf_counter() - start)
    for name, seconds in least.items():
        print(f"{name:30} {seconds:6.2f} s")


if __name__ == "__main__":
    main()
