"""`polhode run` of a scene with an [ensemble]: into a Zarr store, chunk by chunk."""

import argparse
import math
import re
import sys
from pathlib import Path

from polhode.cli._options import whole_number

_SIZES = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_OPTIONS = ("memory", "chunk", "devices", "process", "processes", "coordinator", "cluster",
            "patience", "no_verify")  # fmt: skip


def byte_count(text: str) -> int:
    """An argparse type: 4GB, 500MB, 2e9."""
    match = re.fullmatch(r"([0-9.]+(?:e[0-9]+)?)\s*([kmgt]?)b?", text.strip().lower())
    try:
        return int(float(match[1]) * _SIZES[match[2]])
    except (TypeError, ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 4GB") from None


def _device_count(text: str) -> int | None:
    return None if text == "all" else whole_number(1)(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return value


def add_options(command: argparse.ArgumentParser) -> None:
    """Options that only a scene with an [ensemble] takes; absent unless given."""
    group = command.add_argument_group("for a scene with an [ensemble]")
    absent = argparse.SUPPRESS
    group.add_argument("--memory", type=byte_count, default=absent, metavar="SIZE",
                       help="memory to stay within, such as 2GB")  # fmt: skip
    group.add_argument("--chunk", type=whole_number(1), default=absent, metavar="N",
                       help="bodies per chunk, instead of the library's choice")  # fmt: skip
    group.add_argument("--devices", type=_device_count, default=absent, metavar="N|all",
                       help="number of devices to share the bodies among (default: 1)")  # fmt: skip
    group.add_argument("--process", type=whole_number(0), default=absent, metavar="I",
                       help="number of this process, from 0")  # fmt: skip
    group.add_argument("--processes", type=whole_number(1), default=absent, metavar="N",
                       help="number of processes that share the store")  # fmt: skip
    group.add_argument("--coordinator", default=absent, metavar="HOST:PORT",
                       help="where process 0 waits for the others (jax.distributed); "
                       "needs --processes and --process")  # fmt: skip
    group.add_argument("--cluster", action="store_true", default=absent,
                       help="let JAX find coordinator and numbers: SLURM, Open MPI, Kubernetes, "
                       "or JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES, JAX_PROCESS_ID")  # fmt: skip
    group.add_argument("--patience", type=_seconds, default=absent, metavar="S",
                       help="seconds to wait for the other processes (default: 300)")  # fmt: skip
    group.add_argument("--no-verify", action="store_true", default=absent,
                       help="take finished chunks for good without reading them")  # fmt: skip


def refuse_options(arguments: argparse.Namespace, file) -> None:
    """SceneFileError for an option that needs an [ensemble] which the scene does not have."""
    from polhode.io import SceneFileError

    for name in _OPTIONS:
        if hasattr(arguments, name):
            raise SceneFileError(
                file.path, "[ensemble]", "missing table",
                f"--{name.replace('_', '-')} on the command line",
                "a scene with an [ensemble]", "add [ensemble], or drop the option",
            )  # fmt: skip


def run(arguments: argparse.Namespace, file, output: Path | None) -> int:
    """Stream the ensemble into its store; 0, or 1 when some bodies did not finish."""
    from rich.console import Console

    messages = Console(stderr=True)
    messages.quiet = arguments.quiet or not messages.is_terminal
    path = Path(output or file.output.file or f"{file.path.stem}.zarr")
    if path.suffix != ".zarr":
        path = path.with_name(path.name + ".zarr")
    options = {name: getattr(arguments, name) for name in _OPTIONS if hasattr(arguments, name)}
    with messages.status("starting ..."):
        import jax

        jax.config.update("jax_enable_x64", True)
        from polhode.ensemble import build_ensemble, stream
        from polhode.io import build_method

        _meet(path, options)
        ensemble, statistics = build_ensemble(file, arguments.precision)
    options["verify"] = not options.pop("no_verify", False)
    if "devices" in options:
        options["devices"] = _devices(options["devices"])
    text = file.path.read_text(encoding="utf-8")
    words = {"title": file.title, "scene": text, "scene_source": file.source, "frame": file.frame}
    try:
        with _Meter(messages) as meter:
            stream(
                ensemble, file.times.seconds, path,
                method=build_method(file), rtol=file.method.rtol,
                trajectories=file.ensemble.trajectories, statistics=statistics,
                attributes=words, progress=meter, warn=_warn, **options,
            )  # fmt: skip
    except KeyboardInterrupt:
        print("\npolhode: interrupted; the same command finishes what is missing", file=sys.stderr)
        return 130
    if not arguments.quiet:
        last = meter.last
        rate = "nothing was missing" if last.rate is None else f"{last.rate:,.0f} bodies/s"
        print(f"{last.done:,} bodies ({last.reused:,} from before), {rate}\nwritten: {path}")
    return _failures(path)


def _meet(path: Path, options: dict) -> None:
    """Find the number of this process and of all, with the others where they are to meet; before
    anything is computed. The options of that go out of ``options``.
    """
    from polhode.ensemble import StoreError, claimed, join

    cluster, coordinator = options.pop("cluster", False), options.pop("coordinator", None)
    patience = {"patience": options.pop("patience")} if "patience" in options else {}
    known = options.get("processes"), options.get("process")
    if coordinator is None and not cluster:
        if known[0] is None and known[1] is not None:
            raise StoreError("--process needs --processes, the number of all of them.")
        if (known[0] or 1) > 1 and known[1] is None:
            raise StoreError("--processes needs --process, the number of this one, from 0.")
        if patience:
            raise StoreError("--patience needs --coordinator or --cluster.")
        return
    if coordinator is not None and not cluster and None in known:
        raise StoreError("--coordinator needs --processes and --process.")
    # two processes of one number on this machine are told apart before they disturb the others
    with claimed(path, *known):
        options["process"], options["processes"] = join(coordinator, *known, **patience)[:2]


def _warn(words: str) -> None:
    print(f"polhode: {words}", file=sys.stderr)


def _devices(count: int | None) -> list:
    import jax

    found = jax.local_devices()
    if count is not None and count > len(found):
        raise RuntimeError(f"--devices {count}: this machine has {len(found)} (use fewer, or all)")
    return found[:count]


class _Meter:
    """Progress with rate and remaining time, for people who watch; remembers the last report."""

    def __init__(self, messages):
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        self.last = None
        self.bar = Progress(
            TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TextColumn("bodies"),
            TextColumn("{task.fields[rest]}"), console=messages, transient=True,
        )  # fmt: skip
        self.task = self.bar.add_task("", total=None, rest="compiling ...")

    def __enter__(self):
        self.bar.start()
        return self

    def __exit__(self, *_):
        self.bar.stop()

    def __call__(self, report) -> None:
        self.last = report
        rest = "compiling ..."
        if report.rate is not None:
            seconds = math.ceil(report.remaining)
            rest = f"{report.rate:,.0f} bodies/s, {seconds // 60}:{seconds % 60:02d} left"
        self.bar.update(self.task, completed=report.done, total=report.total, rest=rest)


def _failures(path: Path) -> int:
    import numpy as np
    import zarr

    status = zarr.open_array(path / "status", mode="r")
    failed, step = 0, status.chunks[0]
    for start in range(0, status.shape[0], step):
        failed += int((np.asarray(status[start : start + step]) > 0).sum())
    if failed:
        print(f"polhode: {failed:,} bodies did not finish; see `status` in {path}", file=sys.stderr)
    return 1 if failed else 0
