"""``python -m benchmarks [--quick]``: the tables one after the other, each in its own process."""

import argparse
import subprocess
import sys

TABLES = {
    "document_000": ([], []),
    "charts": (["--bodies", "200", "--euler-bodies", "10"], []),
    "scene_cost": (["--bodies", "200"], []),
}
"""Module -> options of the quick and of the full table."""


def main() -> int:
    """Run them; the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, a few minutes")
    options = parser.parse_args()
    failed = 0
    for name, (quick, full) in TABLES.items():
        print(f"\n{name}", flush=True)
        given = quick if options.quick else full
        failed += (
            subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *given]).returncode != 0
        )
    return failed


if __name__ == "__main__":
    sys.exit(main())
