"""``python -m benchmarks``: run all benchmarks, draw figures, write the results page.

python -m benchmarks [--quick] [--output FOLDER]   every benchmark, each in its own process
python -m benchmarks figures FILE ... [--output FOLDER]
python -m benchmarks page                          results page, tables in README.md
"""

import argparse
import importlib.util
import subprocess
import sys
import time
from pathlib import Path

from benchmarks import _figures, _page, _report

QUICK: dict[str, list[str]] = {
    "imports": ["--runs", "3"],
    "work_precision": ["--quick"],
    "gradients": ["--quick"],
    "scene_cost": ["--quick"],
    "conservation": ["--quick"],
}
_NAMES = (
    *("imports", "first_calls", "plain_calls", "work_precision", "gradients", "controllers"),
    *("conservation", "scene_cost", "scaling", "free_body", "torqued", "error_control"),
    *("rotation_stress", "stress", "identification", "satellites", "throw_design"),
    *("throws_synthetic", "accelerator", "engines"),
)
FULL: dict[str, list[str]] = {name: [] for name in _NAMES}
FULL["error_control"] = ["--bodies", "100"]


def run(quick: bool, folder: Path) -> int:
    """Run benchmarks and draw their figures; returns the number of failed benchmarks."""
    failed, began = 0, time.perf_counter()
    for name, given in (QUICK if quick else FULL).items():
        if importlib.util.find_spec(f"benchmarks.{name}") is None:
            continue
        print(f"\n=== {name}", flush=True)
        target = folder / f"{name}.json"
        words = [sys.executable, "-m", f"benchmarks.{name}", *given, "--output", str(target)]
        failed += subprocess.run(words).returncode != 0
    made = sorted(folder.glob("*.json"))
    for path in _figures.draw(made, folder):
        print(f"figure: {path}")
    print(f"{time.perf_counter() - began:.0f} s in all, {failed} failed")
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, under five minutes")
    parser.add_argument("--output", type=Path, default=_report.OUT, help="folder for what is made")
    actions = parser.add_subparsers(dest="action")
    figures = actions.add_parser("figures", help="draw figures from results")
    figures.add_argument("files", nargs="+", type=Path)
    figures.add_argument("--output", type=Path, default=_report.OUT)
    figures.add_argument("--format", choices=("svg", "png"), default="svg")
    actions.add_parser("page", help="write benchmarks/README.md and tables in README.md")
    options = parser.parse_args()
    if options.action == "figures":
        for path in _figures.draw(options.files, options.output, f".{options.format}"):
            print(path)
        return 0
    if options.action == "page":
        merged = _page.merged()
        if merged:
            for name, families in (("work_precision", ()), ("work_precision_main", _figures.MAIN)):
                drawn = _figures.work_precision(merged, families)
                _figures.save(drawn, _report.RESULTS / f"{name}.svg")
        others = [_report.RESULTS / f"{name}.json" for name in _figures.DRAWN]
        _figures.draw([path for path in others if path.exists()], _report.RESULTS)
        for path in _page.write():
            print(path.relative_to(_page.ROOT))
        return 0
    options.output.mkdir(parents=True, exist_ok=True)
    return run(options.quick, options.output)


if __name__ == "__main__":
    sys.exit(main())
