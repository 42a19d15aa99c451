"""Shared by all benchmarks: timing, and reading and writing of results.

A result is one JSON file with the fields ``name``, ``command``, ``date``, ``commit``,
``versions``, ``machine``, ``flags``, ``threads`` and ``numbers``; figures and tables are made from
such files only. Results from before ``commit`` was recorded have ``committed_with`` instead: the
commit that added the file to the repository. For single-threaded results call ``one_thread()``
before the first import of jax.
"""

import argparse
import compileall
import importlib.metadata
import importlib.util
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

RESULTS = Path(__file__).resolve().parent / "results"
"""The committed results of the last full runs."""

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "out" / "benchmarks"
"""Default folder for results."""

PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "numpy")
ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def one_thread() -> None:
    """Restrict XLA to one thread and this process to one core; no effect once jax is imported."""
    os.environ.setdefault("XLA_FLAGS", ONE_THREAD)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def compile_package() -> None:
    """Write the bytecode of the package, as pip does at installation.

    Otherwise, under PYTHONDONTWRITEBYTECODE, each new process compiles the sources of the checkout,
    which its measured time would include.
    """
    compileall.compile_dir(ROOT / "src", quiet=1)


def commit() -> str | None:
    """The measured commit, with ``-dirty`` if its code was changed; None if it is unknown.

    It is unknown without git, and if polhode is imported from outside this checkout. Results and
    generated pages do not count as changes.
    """
    spec = importlib.util.find_spec("polhode")
    if spec is None or not Path(str(spec.origin)).resolve().is_relative_to(ROOT):
        return None
    code = ("src", "benchmarks", ":!benchmarks/results", ":!benchmarks/README.md")
    try:
        head = _git("rev-parse", "HEAD")
        return head + ("-dirty" if _git("status", "--porcelain", "--", *code) else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def today() -> str:
    """The date in UTC."""
    return datetime.now(UTC).date().isoformat()


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def machine() -> dict[str, Any]:
    """Processor, model, cores, memory and any accelerator of this machine, without its name."""
    processor, model = platform.machine(), platform.processor()
    about = Path("/proc/cpuinfo")
    if about.exists():
        lines = [line.partition(":") for line in reversed(about.read_text().splitlines())]
        fields = {name.strip(): value.strip() for name, _, value in lines}
        flags = set(fields.get("flags", "").split())
        wide = [name for name in ("avx512f", "avx2", "avx") if name in flags]
        processor += f" with {wide[0].upper().removesuffix('F')}" if wide else ""
        model = fields.get("model name", model)
    found: dict[str, Any] = {"processor": processor, "model": model, "cores": os.cpu_count()}
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        found["memory_GB"] = round(memory / 2**30)
    found["system"] = platform.system()
    if "jax" in sys.modules:
        device = sys.modules["jax"].devices()[0]
        found["device"] = device.device_kind if device.platform != "cpu" else "cpu"
    return found


def versions(*more: str) -> dict[str, str | None]:
    """Versions of Python, polhode, JAX and the named packages; None if not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in ("polhode", *PACKAGES, *more):
        if name in sys.modules and hasattr(sys.modules[name], "__version__"):
            found[name] = sys.modules[name].__version__
            continue
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def threads() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def command(module: str) -> str:
    """The command of this run without its output options."""
    words, given = [], iter(sys.argv[1:])
    for word in given:
        if word in ("--output", "--out", "--lines"):
            next(given, None)
        elif not word.startswith(("--output=", "--out=", "--lines=")):
            words.append(word)
    return " ".join(["python -m", f"benchmarks.{module}", *words])


def write(
    name: str,
    numbers: Any,
    *,
    path: str | os.PathLike | None = None,
    packages: tuple = (),
    module: str | None = None,
) -> Path:
    """Write the ``numbers`` of benchmark ``name`` to a JSON file; returns its path.

    ``path``: by default ``out/benchmarks/<name>.json``. ``packages``: other programs whose versions
    are recorded. ``module``: the module in the recorded command, by default ``name``. NaN and
    infinite values become null. The file is written atomically.
    """
    from polhode._atomic import atomic_write

    path = OUT / f"{name}.json" if path is None else Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    report = {
        "name": name,
        "command": command(module or name),
        "date": today(),
        "commit": commit(),
        "versions": versions(*packages),
        "machine": machine(),
        "flags": os.environ.get("XLA_FLAGS", ""),
        "threads": threads(),
        "numbers": _plain(numbers),
    }
    with atomic_write(path) as partial:
        Path(partial).write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    return path


def recordings(
    about: str, usual: Path, switches: dict[str, str] | None = None
) -> argparse.Namespace:
    """Parse the options of a benchmark on recordings that are not part of the project.

    Exits if the recordings are absent.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--data", type=Path, default=usual)
    parser.add_argument("--output", type=Path)
    for name, meaning in (switches or {}).items():
        parser.add_argument(f"--{name}", action="store_true", help=meaning)
    options = parser.parse_args()
    if not options.data.exists():
        parser.exit(2, f"no recordings in {options.data}; give their folder by --data\n")
    return options


def read(what: str | os.PathLike) -> dict[str, Any]:
    """Read a result, given as a file or as the name of a committed result."""
    path = Path(what)
    if path.suffix != ".json":
        path = RESULTS / f"{what}.json"
    report = json.loads(path.read_text())
    if missing := {"name", "command", "versions", "machine", "numbers"} - set(report):
        raise ValueError(f"{path.name} is no result of benchmarks: it lacks {sorted(missing)}.")
    return report


def _plain(value):
    """A copy that JSON can represent: lists for arrays, null for NaN, floats of five digits."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value


class Timing(NamedTuple):
    """Seconds of one call: median and minimum of the repeats, half the interquartile range over the
    median, number of repeats, and seconds of the first call (including compilation).
    """

    median: float
    least: float
    spread: float
    repeats: int
    first: float


def clock(call: Callable[[], Any], **options) -> Timing:
    """``in_turn`` for a single call."""
    return in_turn({"": call}, **options)[""]


def in_turn(
    calls: Mapping[str, Callable[[], Any]],
    *,
    repeats: int = 7,
    least: float = 5e-3,
    budget: float = 1.0,
    processor_time: bool = False,
) -> dict[str, Timing]:
    """Time several calls alternately; each must block until its result is ready.

    Alternation makes ratios robust against changes of the machine's speed. Each repeat lasts at
    least ``least`` seconds: short calls are repeated within it, after one call that is not timed. A
    call is no longer repeated once it has used ``budget`` seconds, but is timed at least twice, or
    once if a single call exceeds the budget. The first call of each is not part of the median.
    ``processor_time``: measure the CPU time of this process rather than wall time, which includes
    the load of other processes.
    """
    now = time.process_time if processor_time else time.perf_counter
    first, count, spent = {}, {}, dict.fromkeys(calls, 0.0)
    spans: dict[str, list[float]] = {name: [] for name in calls}
    for name, call in calls.items():
        begin = now()
        call()
        first[name] = now() - begin
        begin = now()
        call()
        once = now() - begin
        spent[name] = once
        count[name] = max(1, math.ceil(least / max(once, 1e-9)))
        if count[name] == 1:
            spans[name].append(once)
    for _ in range(repeats):
        for name, call in calls.items():
            enough = 1 if spans[name] and spans[name][0] > budget else 2
            if len(spans[name]) >= enough and spent[name] > budget:
                continue
            if len(spans[name]) >= repeats:
                continue
            if count[name] > 1:
                call()  # not timed: the other calls have evicted this one's data from the caches
            begin = now()
            for _ in range(count[name]):
                call()
            span = now() - begin
            spent[name] += span
            spans[name].append(span / count[name])
    return {name: _summary(spans[name], first[name]) for name in calls}


def _summary(spans: list[float], first: float) -> Timing:
    middle = statistics.median(spans)
    spread = 0.0
    if len(spans) > 1:
        low, _, high = statistics.quantiles(spans, n=4, method="inclusive")
        spread = (high - low) / 2 / middle
    return Timing(middle, min(spans), spread, len(spans), first)
